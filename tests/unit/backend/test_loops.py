"""Loop closures and relocalised frames in every estimator, on a simulated drive that returns."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
from loops import CLOSED, ROUND, Returned, Rounds, drive_rounds
from simulated import (
    RIG,
    Drive,
    assert_same_bits,
    play,
    play_directly,
    simulate,
    visible,
)
from smoothing import FREE, PIXELS, build

from fgslam.backend import loops
from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import (
    BatchSettings,
    DeadReckoningSettings,
    EkfSettings,
    EstimatorSettings,
    FixedLagSettings,
    Isam2Settings,
    LandmarkKalmanGraphSettings,
    LandmarkKalmanSettings,
    SlidingWindowSettings,
)
from fgslam.backend.smoothers.graph import LONG_UNSEEN, found_again
from fgslam.backend.smoothers.lag import SlidingWindowSolver
from fgslam.backend.smoothers.smoother import MapSmoother
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.store import restore, state_of
from fgslam.core.types import Estimate
from fgslam.evaluation.statistics import pose_nees
from fgslam.factors.graphs import landmark_key, poses_of_frame

CLOSING: dict[str, EstimatorSettings] = {
    "landmark_kalman": LandmarkKalmanSettings(),
    "landmark_kalman_graph": LandmarkKalmanGraphSettings(),
    "ekf": EkfSettings(),
    "fixed_lag": FixedLagSettings(),
    "sliding_window": SlidingWindowSettings(),
    "isam2": Isam2Settings(),
    "isam2, keyframes": Isam2Settings(keyframe_every=4),
    "batch": BatchSettings(),
}
REVISING = [name for name in CLOSING if name not in ("ekf", "fixed_lag")]
"""Those that correct what lies behind."""
SEED = 4
LIE = (0.0, 0.5, 0.0, 1.0, 0.0, 0.5)
every = pytest.mark.parametrize("name", CLOSING)


@cache
def returned(lies: bool = False, seed: int = SEED) -> Returned:
    rounds = Rounds(lies=((CLOSED, LIE),) if lies else ())
    return drive_rounds(rounds, np.random.default_rng(seed))


@cache
def at_end(name: str, lies: bool, /) -> tuple[Estimator, Estimate]:
    """The estimator and its answer after the drive; the loop was closed, or a wrong one refused."""
    estimator = build(CLOSING[name])
    play(estimator, returned(lies).increments, FREE)
    return estimator, estimator.estimate()


def errors(estimate: Estimate, drive: Returned) -> FloatArray:
    poses = estimate.trajectory.poses
    return np.linalg.norm(poses[:, :3, 3] - drive.poses[: len(poses), :3, 3], axis=1)


@every
def test_the_camera_is_back_in_the_old_map(name: str) -> None:
    without, after = (errors(at_end(name, lies)[1], returned()) for lies in (True, False))
    assert without[CLOSED:].mean() > 0.08
    # Where it drove the first time it is right to a few centimetres.
    assert after[CLOSED:].mean() < 0.6 * without[CLOSED:].mean()


@pytest.mark.parametrize("name", REVISING)
def test_the_drive_is_corrected_backwards(name: str) -> None:
    without, after = (errors(at_end(name, lies)[1], returned()) for lies in (True, False))
    late = slice(2 * ROUND // 3, CLOSED)
    assert after[late].mean() < 0.75 * without[late].mean()
    assert after.max() < without.max()


def test_a_loop_within_the_sliding_window_is_a_factor_more() -> None:
    """The window does not move along as one piece, nor the drive's start with it."""
    drive = returned()
    increments = drive.increments[: CLOSED + 1]
    estimator = build(SlidingWindowSettings(window=len(drive.increments), update_every=5))
    online = play(estimator, increments, FREE)
    before = errors(at_end("sliding_window", True)[1], drive)[CLOSED]
    off = np.linalg.norm(online[-1].wTc[:3, 3] - drive.poses[CLOSED, :3, 3])
    assert off < 0.6 * before
    assert isinstance(estimator, MapSmoother)
    solver = estimator.solver
    assert isinstance(solver, SlidingWindowSolver)
    np.testing.assert_allclose(solver.poses[0], drive.poses[0], rtol=0, atol=1e-6)


def test_a_loop_within_a_lag_so_long_that_it_drifts_is_closed_and_a_wrong_one_refused() -> None:
    """The drift in between explains the one and not the other; nothing moves as one piece."""
    off, remarks = [], []
    for lies in (False, True):
        drive = returned(lies)
        estimator = build(FixedLagSettings(lag_frames=len(drive.increments)))
        online = play(estimator, drive.increments[: CLOSED + 1], FREE)
        off.append(np.linalg.norm(online[-1].wTc[:3, 3] - drive.poses[CLOSED, :3, 3]))
        found = estimator.estimate()
        remarks.append(next(r for r in found.remarks if "loop closure to frame" in r))
        first, meant = found.trajectory.poses[0], drive.poses[0]
        np.testing.assert_allclose(first, meant, rtol=0, atol=1e-6)
    assert off[0] < 0.6 * off[1]
    assert "the camera moved by" in remarks[0]
    assert "within the lag" in remarks[0]
    assert "refused" in remarks[1]


@every
def test_old_landmarks_stay_and_their_doubles_go(name: str) -> None:
    drive = returned()
    merged = drive.increments[CLOSED].loops[0].merged
    landmarks = at_end(name, False)[1].landmarks
    assert len(merged) > 10
    assert not np.isin(merged[:, 0], landmarks.ids).any()
    assert np.isin(merged[:, 1], landmarks.ids).all()
    off = np.linalg.norm(landmarks.positions - drive.points_by_id[landmarks.ids], axis=1)
    old = landmarks.rows(np.unique(merged[:, 1]))
    assert np.median(off[old]) < 0.15


@every
def test_closure_is_reported(name: str) -> None:
    reported = [
        words for words in at_end(name, False)[1].remarks if "loop closure to frame" in words
    ]
    assert len(reported) == 1
    assert f"frame {returned().increments[CLOSED].index}:" in reported[0]


@every
def test_a_wrong_loop_is_refused_and_changes_nothing(name: str) -> None:
    drive, (_, found) = returned(lies=True), at_end(name, True)
    reported = [words for words in found.remarks if "loop closure to frame" in words]
    assert len(reported) == 1
    assert "refused" in reported[0]
    if name not in ("landmark_kalman", "isam2"):
        return
    straight = build(CLOSING[name])
    play(straight, [dataclasses.replace(x, loops=()) for x in drive.increments], FREE)
    offset = found.trajectory.poses[:, :3, 3] - straight.estimate().trajectory.poses[:, :3, 3]
    # Frames that wait for an update of iSAM2 are hurried by a loop, refused or not; the lie is of
    # a metre at the end.
    assert np.abs(offset).max() < (1e-12 if name == "landmark_kalman" else 0.01)


@pytest.mark.parametrize("name", ["landmark_kalman", "isam2", "ekf"])
def test_without_the_gate_the_wrong_loop_is_taken(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So it is the gate that refuses it."""
    monkeypatch.setattr(loops, "GATE_SIGMAS", np.inf)
    drive = returned(lies=True)
    increments = drive.increments[: CLOSED + 1]
    estimator = build(CLOSING[name])
    stats = play(estimator, increments, FREE)
    loop = increments[CLOSED].loops[0]
    claimed = drive.poses[loop.frame] @ loop.oTc
    turned = g.rotation_angle(claimed[:3, :3].T @ stats[-1].wTc[:3, :3])
    assert turned < 0.35  # the lie is of 0.5, and the filter believes it in part


@pytest.mark.parametrize("name", ["landmark_kalman", "ekf", "isam2, keyframes", "sliding_window"])
def test_state_and_replay_keep_every_bit_over_a_loop(name: str) -> None:
    increments = returned().increments
    straight = at_end(name, False)[0]
    first, second = build(CLOSING[name]), build(CLOSING[name])
    play_directly(first, increments[: CLOSED + 2], FREE)
    restore(second, {key: np.array(array) for key, array in state_of(first).items()})
    play_directly(second, increments[CLOSED + 2 :], FREE)
    assert_same_bits(state_of(second), state_of(straight))
    assert_same_bits(second.estimate(), straight.estimate())
    assert second.estimate().remarks == straight.estimate().remarks


@pytest.mark.parametrize("name", [name for name in CLOSING if name != "ekf"])
def test_a_loop_that_leads_nowhere_is_an_error(name: str) -> None:
    """The full filter asks for the landmarks, not for the frame."""
    increments = returned().increments[:6]
    loop = dataclasses.replace(returned().increments[CLOSED].loops[0], frame=5)
    estimator = build(CLOSING[name])
    play(estimator, increments[:5], FREE)
    with pytest.raises(EstimatorError, match="does not come before it"):
        play(estimator, [dataclasses.replace(increments[5], loops=(loop,))], FREE)


@pytest.mark.parametrize("name", ["isam2, keyframes", "landmark_kalman"])
def test_a_loop_on_an_exact_drive_changes_nothing(name: str) -> None:
    """Without noise the closure agrees with what is there."""
    drive = Drive(frames=CLOSED + 3, points=80, twist=Rounds().drive.twist, noise=0.0)
    exact = drive_rounds(Rounds(drive=drive), np.random.default_rng(SEED))
    estimator = build(CLOSING[name])
    play(estimator, exact.increments, FREE)
    estimate = estimator.estimate()
    assert errors(estimate, exact).max() < 1e-5
    assert sum("loop" in words for words in estimate.remarks) == 1


@pytest.mark.parametrize("name", ["isam2", "batch"])
def test_a_second_closure_that_agrees_moves_nothing(name: str) -> None:
    increments = list(returned().increments)
    k, loop = CLOSED + 3, increments[CLOSED].loops[0]
    oTc = g.inverse(returned().poses[loop.frame]) @ returned().poses[k]
    again = dataclasses.replace(loop, oTc=oTc, covariance=25.0 * loop.covariance)
    increments[k] = dataclasses.replace(increments[k], loops=(again,))
    estimator = build(CLOSING[name])
    play(estimator, increments, FREE)
    reported = [words for words in estimator.estimate().remarks if "loop closure" in words]
    assert len(reported) == 2
    assert "nothing moved" in reported[1]


def test_batch_solved_in_the_frame_of_a_loop_has_the_loop_in_its_answer() -> None:
    """The closing frame is one of those after which the batch solves, too."""
    increments = returned().increments[: CLOSED + 1]
    at_once = build(BatchSettings(solve_every=CLOSED + 1))
    stats = play(at_once, increments, FREE)
    assert stats[-1].closed == (True,)
    found = at_once.estimate().trajectory.poses
    later = build(BatchSettings())
    play(later, increments, FREE)
    np.testing.assert_allclose(found, later.estimate().trajectory.poses, rtol=0, atol=1e-5)
    np.testing.assert_allclose(found[-1], stats[-1].wTc, rtol=0, atol=0.02)


def test_refused_loop_leaves_the_answer_of_its_frame_alone() -> None:
    increments = list(returned(lies=True).increments[: CLOSED + 1])
    answers = []
    for closures in (increments[-1].loops, ()):
        estimator = build(BatchSettings(solve_every=CLOSED + 1))
        play(
            estimator, [*increments[:-1], dataclasses.replace(increments[-1], loops=closures)], FREE
        )
        answers.append(estimator.estimate())
    assert "refused" in answers[0].remarks[0]
    assert_same_bits(answers[0].trajectory, answers[1].trajectory)
    assert_same_bits(answers[0].covariances, answers[1].covariances)
    assert_same_bits(answers[0].landmarks, answers[1].landmarks)


def found_again_where_expected(estimator: Any, count: int) -> None:
    """Old landmarks, found again at the drifted pose where the drifted map has them: all wrong."""
    builder, solver = estimator.builder, estimator.solver
    frame = builder.frames[-1]
    pose = poses_of_frame(solver.values, frame)
    seen, when = builder.observed["variable"], builder.observed["frame"]
    old = np.setdiff1d(seen, seen[when > frame - LONG_UNSEEN])
    points = {v: solver.values.atPoint3(landmark_key(v)) for v in old.tolist()}
    local = g.transform_to_camera(pose, np.array(list(points.values())))
    rows = np.flatnonzero(visible(RIG, local))[:count]
    assert len(rows) == count
    builder.observed.append(
        {
            "frame": np.full(count, frame),
            "variable": np.array(list(points))[rows],
            "measurement": g.project(RIG, local[rows]),
            "covariance": np.tile(0.04 * np.eye(3), (count, 1, 1)),
            "gone": np.zeros(count, np.bool_),
        }
    )
    again = found_again(*builder.kept_observed()[:2])
    assert again[-count:].all()
    assert not again[:-count].any()


@pytest.mark.parametrize("more", [False, True])
def test_the_larger_number_of_matches_says_which_return_is_believed(more: bool) -> None:
    """A few landmarks found again by chance do not keep a loop from closing; many do."""
    before, closing = returned().increments[:CLOSED], returned().increments[CLOSED]
    (loop,) = closing.loops
    estimator = build(BatchSettings())
    play(estimator, before, FREE)
    found_again_where_expected(estimator, 9)
    if more:
        loop = dataclasses.replace(loop, observations=loop.observations.select(np.arange(5)))
    play(estimator, [dataclasses.replace(closing, loops=(loop,))], FREE)
    (remark,) = (each for each in estimator.estimate().remarks if "loop closure" in each)
    assert ("refused" in remark) == more, remark


@pytest.mark.slow
@pytest.mark.parametrize("name", ["isam2", "batch"])
def test_covariances_are_consistent_after_a_loop(name: str) -> None:
    """NEES of the pose midway and of the last one, over 30 drives: within its chi-square band."""
    values = {ROUND // 2: [], -1: []}
    for seed in range(30):
        drive = returned(seed=seed)
        estimator = build(CLOSING[name])
        play(estimator, drive.increments, FREE)
        estimate = estimator.estimate()
        for k, found in values.items():
            one = slice(k, None) if k == -1 else slice(k, k + 1)
            nees = pose_nees(
                estimate.trajectory.poses[one], estimate.covariances[one], drive.poses[one]
            )
            found.append(nees.per_dof)
    for found in values.values():
        assert abs(np.mean(found) - 1.0) < 4.0 * np.sqrt(2.0 / (6.0 * 30.0)), found


# --------------------------------------------------------------------------------------------
# Carried off


def carried_off(relocalised: bool) -> tuple[FloatArray, list[Increment]]:
    """Twenty frames of a drive, then frames 8 to 13 again, while the wheels say that it went on."""
    rng = np.random.default_rng(11)
    simulation = simulate(Drive(frames=20, points=120, prune_after=1000), rng)
    poses, increments = list(simulation.poses), list(simulation.increments)
    for k in range(8, 14):
        earlier, last = increments[k], len(increments)
        noise = PIXELS * rng.standard_normal(earlier.observations.measurement.shape)
        seen = dataclasses.replace(
            earlier.observations,
            measurement=earlier.observations.measurement + noise,
            is_new=np.zeros(len(noise), np.bool_),
        )
        step = Odometry(g.se3_exp(np.array(Drive().twist)), 1e-4 * np.eye(6))
        increments.append(
            dataclasses.replace(
                earlier,
                index=2 * last,
                timestamp=0.5 * last,
                odometry=step,
                observations=seen,
                rejected=np.zeros(len(noise), np.bool_),
                relocalised=relocalised and k == 8,
            )
        )
        poses.append(simulation.poses[k])
    return np.array(poses), increments


@pytest.mark.parametrize(
    "name", ["landmark_kalman", "ekf", "fixed_lag", "sliding_window", "isam2", "batch"]
)
def test_relocalised_robot_is_where_its_landmarks_are(name: str) -> None:
    poses, increments = carried_off(relocalised=True)
    estimator = build(CLOSING[name])
    stats = play(estimator, increments, FREE)
    online = np.array([s.wTc[:3, 3] for s in stats]) - poses[:, :3, 3]
    assert np.linalg.norm(online[20:], axis=1).max() < 0.05
    final = estimator.estimate().trajectory.poses[:, :3, 3] - poses[:, :3, 3]
    assert np.linalg.norm(final, axis=1).max() < 0.05


@pytest.mark.parametrize("name", ["isam2", "ekf"])
def test_odometry_of_a_carried_robot_would_mislead(name: str) -> None:
    """Unless the frame says that it was found without a prior."""
    poses, increments = carried_off(relocalised=False)
    estimator = build(CLOSING[name])
    stats = play(estimator, increments, FREE)
    online = np.array([s.wTc[:3, 3] for s in stats]) - poses[:, :3, 3]
    assert np.linalg.norm(online[20:], axis=1).max() > 0.2


def test_dead_reckoning_ignores_both() -> None:
    increments = returned().increments
    with_loops, without = (build(DeadReckoningSettings()) for _ in range(2))
    play(with_loops, increments, FREE)
    play(without, [dataclasses.replace(x, loops=()) for x in increments], FREE)
    assert_same_bits(with_loops.estimate(), without.estimate())
