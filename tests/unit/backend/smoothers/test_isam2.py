"""iSAM2."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from simulated import assert_same_bits, play
from smoothing import (
    FREE,
    Failing,
    answer,
    assert_finite,
    ate,
    build,
    drawn,
    relinearise_beyond,
    unseen,
)

from fgslam.backend.settings import Isam2Settings
from fgslam.backend.smoothers.smoother import MapSmoother
from fgslam.core.errors import EstimatorError
from fgslam.core.store import restore, state_of
from fgslam.factors.graphs import landmark_key, pose_key, poses_of_frame

EVERY_FRAME = Isam2Settings(update_every=1)
FAILED = """
Indeterminant linear system detected while working near variable
{key} (Symbol: l5).

Thrown when a linear system is ill-posed.
"""


def spoil(estimator: MapSmoother, key: int) -> None:
    estimator.solver.tree = Failing(estimator.solver.tree, FAILED.format(key=key))


def played(frames: int, settings: Isam2Settings = EVERY_FRAME) -> tuple[Any, MapSmoother]:
    simulation = drawn(8, frames=24)
    estimator = build(settings)
    assert isinstance(estimator, MapSmoother)
    play(estimator, simulation.increments[:frames], FREE)
    return simulation, estimator


# --------------------------------------------------------------------------------------------
# When the solver fails


@pytest.mark.parametrize(
    "settings",
    [EVERY_FRAME, Isam2Settings(), Isam2Settings(keyframe_every=4)],
    ids=["every frame", "buffered", "keyframes"],
)
def test_failure_at_a_landmark_is_repaired_with_a_remark(settings: Isam2Settings) -> None:
    simulation, estimator = played(13, settings)
    variable = estimator.builder.admission.tracks[5].variable
    sightings = estimator.builder.admission.tracks[5].sightings
    spoil(estimator, landmark_key(variable))
    play(estimator, simulation.increments[13:], FREE)
    found = estimator.estimate()
    assert_finite(found)
    (remark,) = found.remarks
    assert remark.startswith("landmark 5 (seen ")
    assert "left the system indeterminate at frame " in remark
    assert remark.endswith("taken out of the graph, iSAM2 rebuilt from the last estimate")
    assert int(remark.split("seen ")[1].split()[0]) >= sightings
    assert "\n" not in remark
    assert ate(found, simulation) < 0.01


def test_after_the_repair_it_is_as_if_the_landmark_had_never_been_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    relinearise_beyond(monkeypatch, 1e-9)
    settings = Isam2Settings(update_every=1)
    simulation, estimator = played(15, settings)
    spoil(estimator, landmark_key(estimator.builder.admission.tracks[5].variable))
    play(estimator, simulation.increments[15:16], FREE)
    without = answer(settings, unseen(simulation.increments[:16], 5, range(16)))
    found = estimator.estimate()
    np.testing.assert_allclose(found.trajectory.poses, without.trajectory.poses, rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.covariances, without.covariances, rtol=1e-2, atol=1e-10)
    rows = found.landmarks.rows(without.landmarks.ids)
    sigma = np.sqrt(np.diagonal(without.landmarks.covariances, axis1=1, axis2=2))
    offset = found.landmarks.positions[rows] - without.landmarks.positions
    assert np.abs(offset / sigma).max() < 0.05


def test_a_removed_landmark_returns_at_twice_the_parallax() -> None:
    simulation, estimator = played(6)
    before = estimator.builder.admission.tracks[5].variable
    spoil(estimator, landmark_key(before))
    play(estimator, simulation.increments[6:7], FREE)
    track = estimator.builder.admission.tracks[5]
    assert track.least_parallax == 6.0
    play(estimator, simulation.increments[7:], FREE)
    assert track.variable > before
    found = estimator.estimate()
    offset = found.landmarks.positions[found.landmarks.rows(np.array([5]))[0]]
    assert np.linalg.norm(offset - simulation.points_by_id[5]) < 0.1


@pytest.mark.parametrize(
    "message",
    ["something\nelse", FAILED.format(key=landmark_key(9999))],
    ids=["no variable", "unknown landmark"],
)
def test_failure_beyond_repair_is_one_clear_line(message: str) -> None:
    simulation, estimator = played(10)
    estimator.solver.tree = Failing(estimator.solver.tree, message)
    with pytest.raises(
        EstimatorError, match=r"^isam2: the solver failed at frame 10 \("
    ) as reported:
        play(estimator, simulation.increments[10:11], FREE)
    assert "\n" not in str(reported.value)
    assert "fgslam inspect" in str(reported.value)


def test_a_pose_that_defeats_cholesky_is_solved_by_qr() -> None:
    simulation, estimator = played(10)
    straight = played(11)[1].estimate()
    estimator.solver.tree = Failing(estimator.solver.tree, FAILED.format(key=pose_key(3)))
    play(estimator, simulation.increments[10:11], FREE)
    found = estimator.estimate()
    assert [words for words in found.remarks if "with QR" in words]
    offset = found.trajectory.poses[:, :3, 3] - straight.trajectory.poses[:, :3, 3]
    assert np.abs(offset).max() < 1e-3


def test_a_pose_that_defeats_qr_too_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation, estimator = played(10)
    failing = Failing(estimator.solver.tree, FAILED.format(key=pose_key(3)))
    monkeypatch.setattr(estimator.solver, "new_tree", lambda: failing)
    estimator.solver.tree = failing
    with pytest.raises(EstimatorError, match="isam2: the solver failed at frame 10"):
        play(estimator, simulation.increments[10:11], FREE)


def test_a_solver_that_fails_again_and_again_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation, estimator = played(10)
    solver = estimator.solver.tree
    variables = iter(range(10_000))

    def failing() -> Failing:
        return Failing(solver, FAILED.format(key=landmark_key(next(variables))))

    monkeypatch.setattr(estimator.solver, "new_tree", failing)
    estimator.solver.tree = failing()
    with pytest.raises(EstimatorError, match="isam2: the solver failed at frame 10"):
        play(estimator, simulation.increments[10:11], FREE)
    assert next(variables) <= 22


# --------------------------------------------------------------------------------------------
# Rhythm, ordering, covariances


def test_orderings_give_the_same_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    relinearise_beyond(monkeypatch, 1e-9)
    simulation = drawn(9, frames=24)
    found = [answer(Isam2Settings(ordering_window=w), simulation.increments) for w in (0, 3, 30)]
    for other in found[1:]:
        np.testing.assert_allclose(
            other.trajectory.poses, found[0].trajectory.poses, rtol=0, atol=1e-6
        )
        np.testing.assert_allclose(
            other.landmarks.covariances, found[0].landmarks.covariances, rtol=1e-4, atol=1e-9
        )


def test_tracker_answers_between_updates_of_the_graph() -> None:
    simulation, estimator = played(0, Isam2Settings(update_every=5))
    sizes = []
    for increment in simulation.increments[:12]:
        play(estimator, [increment], FREE)
        sizes.append(estimator.solver.values.size())
    grown = np.flatnonzero(np.diff(sizes, prepend=0))
    assert grown.tolist() == [0, 5, 10]
    assert len(estimator.estimate().trajectory) == 12


@pytest.mark.parametrize(
    ("at", "every"),
    [(5, 1), (10, 4), (13, 4)]
    + [pytest.param(*pair, marks=pytest.mark.slow) for pair in ((5, 4), (10, 1), (13, 1))],
)
def test_restored_between_updates_and_keyframes_it_continues_to_the_bit(
    every: int, at: int
) -> None:
    settings = dataclasses.replace(Isam2Settings(), keyframe_every=every)
    increments = drawn(9, frames=18).increments
    straight, first, second = build(settings), build(settings), build(settings)
    play(straight, increments, FREE)
    play(first, increments[:at], FREE)
    restore(second, {name: np.array(array) for name, array in state_of(first).items()})
    assert_same_bits(second.estimate(), first.estimate())
    third = build(settings)
    restore(third, state_of(second))
    play(third, increments[at:], FREE)
    assert_same_bits(third.estimate(), straight.estimate())
    with pytest.raises(EstimatorError, match="only a new estimator"):
        restore(straight, state_of(first))


def test_landmarks_behind_a_camera_are_put_back_before_it() -> None:
    """Where a bad step has left them nothing holds them, and the solver fails on each in turn."""
    simulation, estimator = played(13)
    solver, builder = estimator.solver, estimator.builder
    tracks = [track for _, track in builder.admission.in_graph()][:30]
    for track in tracks:
        wTc = poses_of_frame(solver.values, track.last.frame)
        solver.values.update(landmark_key(track.variable), wTc[:3, 3] - 2.0 * wTc[:3, 2])
    spoil(estimator, landmark_key(tracks[0].variable))
    play(estimator, simulation.increments[13:], FREE)
    found = estimator.estimate()
    assert_finite(found)
    (remark,) = found.remarks
    assert remark.startswith("30 landmarks came out behind a camera at frame 13: put where")
    assert ate(found, simulation) < 0.01


class Mute(Failing):
    """A solver that is updated, but cannot tell a covariance."""

    def update(self, *arguments: Any) -> Any:
        return self._solver.update(*arguments)

    def marginalCovariance(self, key: int) -> None:
        raise RuntimeError(FAILED.format(key=key))


def test_a_covariance_that_the_tree_cannot_tell_is_asked_of_a_new_one() -> None:
    simulation, estimator = played(13)
    estimator.solver.tree = Mute(estimator.solver.tree, "")
    play(estimator, simulation.increments[13:], FREE)
    found = estimator.estimate()
    assert_finite(found)
    assert found.remarks[0].endswith("iSAM2 rebuilt, with QR from here on")
    assert ate(found, simulation) < 0.01
