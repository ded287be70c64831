"""Images against odometry: faults of either are decided rightly, and named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from passing import PASSING_RIG, SCENE, pair_of

from fgslam.core.arrays import BoolArray
from fgslam.core.geometry import inverse, pose
from fgslam.core.sensors import Odometry
from fgslam.core.store import restore, state_of
from fgslam.core.types import Estimate
from fgslam.runs.report import located
from fgslam.slam.results import SessionResult
from fgslam.slam.session import Session
from fgslam.slam.witnesses import Proofs, Witnesses, has_moved

KIND = "landmark_kalman"  # the fastest
FRAMES = 13
BEGINS = 5  # a fault that is not there from the start
NOISE = np.diag(np.repeat([2e-3, 2e-3], 3) ** 2)


def way(k: int) -> float:
    """Metres to the right after k frames: faster and slower."""
    return 0.05 * k + 0.05 * float(np.sin(0.8 * k))


def driven(
    reported: Callable[[int, float], float] = lambda k, step: step,
    board: Callable[[int], tuple[float, float, float] | None] = lambda k: None,
    moved: Callable[[int], float] = way,
) -> Session:
    """A drive to the right past the scene.

    Args:
        reported: of a frame and the true step, the odometry's, metres.
        board: depth, left and right edge of what is seen before it, seen from the camera.
        moved: where the camera is in each frame.
    """
    session, rng = Session(PASSING_RIG, KIND), np.random.default_rng(3)
    for k in range(FRAMES):
        x, planes = moved(k), list(SCENE)
        if (there := board(k)) is not None:
            planes.append((there[0], x + there[1], x + there[2]))
        step = reported(k, x - moved(k - 1)) + rng.normal(0.0, 1e-3)
        odometry = Odometry(pose(np.eye(3), np.array([step, 0.0, 0.0])), NOISE)
        session.track(0.1 * k, pair_of(planes, x, 0.0), odometry if k else None)
    return session


def error_m(found: SessionResult, moved: Callable[[int], float] = way) -> float:
    """Of the last pose."""
    where = found.trajectory.poses[-1][:3, 3]
    return float(np.linalg.norm(where - [moved(FRAMES - 1) - moved(0), 0.0, 0.0]))


def moved_within_3_sigma(estimate: Estimate, lag: int, true: float) -> BoolArray:
    """(n - lag,) whether motions over so many frames are as far to the right as is true."""
    poses = estimate.trajectory.poses
    off = (inverse(poses[:-lag]) @ poses[lag:])[:, 0, 3] - true
    return np.abs(off) <= 3.0 * np.sqrt(estimate.relative[lag][:, 3, 3])


def codes(found: SessionResult) -> list[str]:
    return [note.code for note in found.notes if not isinstance(note, str)]


def test_witnesses_that_agree_leave_the_drive_as_it_is() -> None:
    with driven() as session:
        assert session.pipeline.witnesses.found == []
        assert codes(session.result()) == []
        assert error_m(session.result()) < 0.01


@pytest.mark.parametrize(
    ("reported", "code"),
    [
        (lambda k, step: 100.0 * step, "odometry_scaled"),
        (lambda k, step: 0.0 if k >= BEGINS else step, "odometry_stuck"),
        (lambda k, step: -step if k >= BEGINS else step, "odometry_reversed"),
        (lambda k, step: step + 0.3 * (k % 3) if k >= BEGINS else step, "odometry_slips"),
        (
            lambda k, step: (10.0 if 0 <= k - BEGINS < 3 else 1.0) * step,
            "odometry_slips",
        ),  # and ends
    ],
)
def test_odometry_that_errs_is_named_and_does_no_harm(
    reported: Callable[[int, float], float], code: str
) -> None:
    with driven(reported) as session:
        assert codes(session.result()) == [code]
        assert error_m(session.result()) < 0.02
        assert located(session.recorder, session.pipeline.tracker.parts).enough


@pytest.mark.parametrize("order", [{6: 7, 7: 6}, {5: 6, 6: 7, 7: 5, 8: 9, 9: 10, 10: 8}])
def test_images_out_of_order_are_named_and_do_no_harm(order: dict[int, int]) -> None:
    """They jump to and fro, while odometry goes on evenly."""

    def shown(k: int) -> float:
        return way(order.get(k, k))

    with driven(lambda k, _: way(k) - way(k - 1), moved=shown) as session:
        found = session.result()
        assert codes(found) == ["images_out_of_order"]
        (note,) = (one for one in found.notes if not isinstance(one, str))
        assert set(note.frames) <= set(range(min(order), max(order) + 2))
        assert error_m(found) < 0.02
        parts, known = session.pipeline.tracker.parts, session.pipeline.witnesses.misplaced
        share = located(session.recorder, parts, None, known)
        assert set(note.frames) == set(known)
        assert share.frames <= FRAMES - len(note.frames)


def test_images_out_of_order_are_named_without_odometry() -> None:
    """A velocity that stays explains them in another order; real steps back explain none."""
    order = {7: 8, 8: 7}
    for moved, named in (
        (lambda k: 0.05 * order.get(k, k), [7, 8]),
        (lambda k: 0.05 * min(k, 8) - 0.05 * max(k - 8, 0), []),  # turns back
        (lambda k: 0.05 * k + 0.03 * (k % 2) * (k > 6), []),  # shakes
    ):
        with Session(PASSING_RIG, KIND) as session:
            for k in range(11):
                session.track(0.1 * k, pair_of(list(SCENE), moved(k), 0.0))
            assert session.pipeline.witnesses.disordered == named


def test_odometry_of_other_axes_is_named() -> None:
    with Session(PASSING_RIG, KIND) as session:
        for k in range(FRAMES):
            motion = pose(np.eye(3), np.array([0.0, 0.0, way(k) - way(k - 1)]))
            images = pair_of(list(SCENE), way(k), 0.0)
            session.track(0.1 * k, images, Odometry(motion, NOISE) if k else None)
        found = session.result()
    assert codes(found) == ["odometry_turned"]
    assert error_m(found) < 0.02


def test_scales_that_differ_by_less_than_a_frame_shows_are_both_held() -> None:
    """A baseline stated 1.2 times too long: no frame contradicts odometry, all together do."""
    rig = replace(PASSING_RIG, baseline=1.2 * PASSING_RIG.baseline)
    with Session(rig, KIND) as session:
        for k in range(FRAMES):
            step = Odometry(pose(np.eye(3), np.array([way(k) - way(k - 1), 0.0, 0.0])), 4.0 * NOISE)
            session.track(0.1 * k, pair_of(list(SCENE), way(k), 0.0), step if k else None)
        found = session.result()
    assert codes(found) == ["scale_doubted"]
    off = error_m(found)
    assert off > 0.08
    assert off < 3.0 * np.sqrt(np.trace(found.covariances[-1][3:, 3:]))
    assert off < 3.0 * np.sqrt(np.trace(found.online_covariances[-1][3:, 3:]))


def test_a_difference_of_scales_beyond_noise_is_held_before_it_is_named() -> None:
    """Of three percent none may be a fault, but one of both is off by so much."""
    variances = []
    for ratio in (1.0, 1.04):
        with driven(lambda k, _, by=ratio: 0.1 * by, moved=lambda k: 0.1 * k) as session:
            found = session.result()
        assert codes(found) == []
        variances.append((found.covariances[-1][3, 3], found.online_covariances[-1][3, 3]))
    apart = 0.04 * 0.1 * (FRAMES - 1)
    assert (np.diff(variances, axis=0) > (0.5 * apart) ** 2).all()


def test_odometry_of_a_standing_robot_has_no_scale() -> None:
    """It is noise alone, and images show nothing of it: no scale of zero."""
    with driven(moved=lambda k: 0.0) as session:
        assert codes(session.result()) == []


def test_odometry_that_jumps_to_and_fro_is_no_fault_of_the_images() -> None:
    with driven(lambda k, step: step + (k >= BEGINS) * (0.3 if k % 2 else -0.1)) as session:
        assert codes(session.result()) == ["odometry_slips"]
        assert error_m(session.result()) < 0.02


def test_odometry_that_errs_does_not_narrow_where_the_next_frame_is_looked_for() -> None:
    """A frame of few matches, held to such a prediction, would seem to agree with it."""
    exact = Odometry(np.eye(4), np.zeros((6, 6)))
    with driven() as session:
        assert session.pipeline.witnesses.widened(exact) is exact
    with driven(lambda k, step: (10.0 if k >= BEGINS else 1.0) * step) as session:
        widened = session.pipeline.witnesses.widened(exact)
        last = way(FRAMES - 1) - way(FRAMES - 2)
        assert widened is not None
        assert np.sqrt(widened.covariance[3, 3]) == pytest.approx(9.0 * last, rel=0.1)


@pytest.mark.parametrize(
    ("board", "named"),
    [
        (lambda k: (1.0, -0.7, 0.05), True),  # the robot's own hood, half of the view
        (lambda k: (1.0, 0.8 - 0.16 * k, 2.0 - 0.16 * k), True),  # passes
        (lambda k: (1.0, -0.4, 0.5) if BEGINS <= k < BEGINS + 6 else None, False),  # carried along
    ],
)
def test_what_moves_by_itself_does_not_carry_the_pose_along(
    board: Callable[[int], tuple[float, float, float] | None], named: bool
) -> None:
    with driven(board=board) as session:
        found = session.result()
        assert [code[:5] for code in codes(found)] == ["body_"] * named
        assert error_m(found) < 0.03
        assert error_m(found) < 3.0 * np.sqrt(np.trace(found.covariances[-1][3:, 3:]))


def test_a_view_filled_from_the_start_is_undecided_and_the_covariance_holds_both() -> None:
    """The robot stands, and all that is seen passes it: as if its wheels were stuck."""

    def stands(k: int) -> float:
        return 0.0

    with driven(board=lambda k: (1.0, -3.0 - 0.05 * k, 3.0 - 0.05 * k), moved=stands) as session:
        found = session.result()
        assert codes(found) == ["witnesses_undecided"]
        assert set(found.column("status")[2:]) == {"contradicted"}
        off = error_m(found, stands)
        assert off > 0.4
        assert off < 3.0 * np.sqrt(np.trace(found.covariances[-1][3:, 3:]))
        assert off < 3.0 * np.sqrt(np.trace(found.online_covariances[-1][3:, 3:]))
        estimate = session.pipeline.estimate()
        assert all(moved_within_3_sigma(estimate, lag, 0.0).all() for lag in (1, 5))


def test_what_passed_a_standing_robot_is_recognised_when_the_scene_is_back() -> None:
    """The pose goes back to odometry's chain, and so do the frames between."""

    def stands(k: int) -> float:
        return way(min(k, 4))

    def train(k: int) -> tuple[float, float, float] | None:
        return (1.0, -4.0 + 0.06 * k, 3.0 + 0.06 * k) if BEGINS <= k < BEGINS + 3 else None

    with driven(board=train, moved=stands) as session:
        found = session.result()
        assert error_m(found, stands) < 0.02
        there = found.trajectory.poses[:, 0, 3]
        np.testing.assert_allclose(there[5:], way(4) - way(0), rtol=0.0, atol=0.03)
        estimate = session.pipeline.estimate()
        assert moved_within_3_sigma(estimate, 5, stands(9) - stands(4))[4]
        steps = estimate.relative[1][BEGINS - 1 : BEGINS + 1, 3, 3]  # by odometry alone
        assert (steps >= NOISE[3, 3]).all()
        assert np.isnan(estimate.online_relative[1][BEGINS]).all()  # it was elsewhere


def test_frozen_cameras_are_a_fault_where_odometry_has_moved() -> None:
    frozen = [pair_of(list(SCENE), min(k, BEGINS) * 0.05, 0.0) for k in range(FRAMES)]
    step = Odometry(pose(np.eye(3), np.array([0.05, 0.0, 0.0])), NOISE)
    with Session(PASSING_RIG, KIND) as session:
        for k, images in enumerate(frozen):
            session.track(0.1 * k, images, step if k else None)
        found = session.result()
    assert set(found.column("status")[BEGINS + 1 :]) == {"camera_fault"}
    assert found.trajectory.poses[-1][0, 3] == pytest.approx(0.05 * (FRAMES - 1), abs=0.01)
    assert "cameras deliver" in str(found.notes[0])


def test_equal_images_of_a_standing_robot_are_no_fault() -> None:
    still = Odometry(np.eye(4), NOISE)
    with Session(PASSING_RIG, KIND) as session:
        for k in range(4):
            session.track(0.1 * k, pair_of(list(SCENE), 0.0, 0.0), still if k else None)
        assert set(session.result().column("status")[1:]) == {"ok"}


def test_a_robot_has_moved_where_its_odometry_leaves_no_doubt() -> None:
    motion = pose(np.eye(3), np.array([0.02, 0.0, 0.0]))
    assert has_moved(Odometry(motion, NOISE))
    assert not has_moved(Odometry(motion, 100.0 * NOISE))
    assert not has_moved(Odometry(motion, NOISE, measured=False))
    assert not has_moved(None)
    assert has_moved(Odometry(inverse(motion), np.zeros((6, 6))))


def test_a_landmark_is_proven_by_two_sightings_elsewhere_in_the_image() -> None:
    ids, places = np.array([2, 5]), np.array([[10.0, 10.0], [50.0, 50.0]])
    proofs = Proofs.none().seen(ids, places)
    for k in (1, 2):
        assert proofs.proven(ids) == 0
        proofs = proofs.seen(ids, places + k * np.array([[4.0, 0.0], [1.0, 0.0]]))
    assert proofs.proven(ids) == 1
    assert proofs.proven(np.array([2])) == 1


def test_state_goes_on_as_it_was() -> None:
    with driven(lambda k, step: 0.0 if k >= BEGINS else step) as session:
        known = session.pipeline.witnesses
        other = Witnesses(session.pipeline.tracker)
        restore(other, state_of(known))
        assert other.remarks() == known.remarks() != ()
        for name, array in state_of(known).items():
            np.testing.assert_array_equal(state_of(other)[name], array)
