"""Fixed lag: what leaves stays as it was, effort and memory are bounded, failures repaired."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from simulated import assert_same_bits, play
from smoothing import (
    FREE,
    answer,
    assert_finite,
    ate,
    blackout,
    build,
    drawn,
    position_sigma,
    run,
    unseen,
)

from fgslam.backend.settings import FixedLagSettings
from fgslam.backend.smoothers.elimination import UndeterminedError
from fgslam.backend.smoothers.lag import FixedLagSolver
from fgslam.backend.smoothers.smoother import Smoother
from fgslam.backend.smoothers.window import LandmarkUndeterminedError
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.store import restore, state_of
from fgslam.core.types import Prediction

LAG = FixedLagSettings(lag_frames=5)


def spoil(estimator: Any, error: Exception) -> None:
    """The window's next solution fails with this error, those after it are found."""
    window = estimator.solver.window
    solve, errors = window.solve, [error]

    def failing(*arguments: Any) -> Any:
        if errors:
            raise errors.pop()
        return solve(*arguments)

    window.solve = failing


def undetermined(variable: int) -> LandmarkUndeterminedError:
    return LandmarkUndeterminedError(variable, "its observations do not determine it")


def smoother(settings: FixedLagSettings = LAG) -> Smoother:
    made = build(settings)
    assert isinstance(made, Smoother)
    return made


def test_no_lag_at_all_is_refused() -> None:
    with pytest.raises(EstimatorError, match="no lag; set"):
        build(FixedLagSettings(lag_frames=None, lag_s=None))


@pytest.mark.parametrize("lag", [{"lag_frames": 4}, {"lag_frames": None, "lag_s": 2.0}])
def test_poses_older_than_the_lag_never_change_again(lag: dict[str, float | None]) -> None:
    """Frames come every half second."""
    simulation, estimator = drawn(1, frames=14), smoother(FixedLagSettings(**lag))
    history = []
    for increment in simulation.increments:
        play(estimator, [increment], FREE)
        history.append(estimator.estimate())
    for earlier, later in itertools.pairwise(history):
        kept = max(len(earlier.trajectory) - 5, 0)
        for a, b in (
            (earlier.trajectory.poses, later.trajectory.poses),
            (earlier.covariances, later.covariances),
        ):
            np.testing.assert_array_equal(a[:kept], b[:kept])
    last, before = history[-1].trajectory.poses, history[-2].trajectory.poses
    assert (last[-5:-1] != before[-4:]).any()


def test_a_frame_s_covariance_when_it_leaves_is_the_last_one_within() -> None:
    simulation, estimator = drawn(1, frames=14), smoother()
    inside = {}
    for k, increment in enumerate(simulation.increments):
        play(estimator, [increment], FREE)
        if k >= 5:
            inside[k - 5] = estimator.estimate().covariances[k - 5]
    final = estimator.estimate().covariances
    for frame, covariance in inside.items():
        np.testing.assert_allclose(final[frame], covariance, rtol=1e-9, atol=1e-18)


def test_factors_and_variables_do_not_grow_with_the_run() -> None:
    simulation = drawn(2, frames=70, points=140, prune_after=8)
    estimator = smoother()
    counts = []
    for increment in simulation.increments:
        play(estimator, [increment], FREE)
        window = estimator.solver.window
        counts.append(
            (
                len(window.observed.frame),
                len(window.landmarks.variables),
                window.prior.hidden,
                len(window.frames),
                estimator.builder.graph.size() + len(estimator.builder.observed),
                len(estimator.builder.admission.by_last_sighting),
            )
        )
    seen = np.array([len(x.observations) for x in simulation.increments])
    early, late = np.array(counts[10:30]), np.array(counts[50:])
    # The views differ by what there is to see.
    per_frame = seen[50:].mean() / seen[10:30].mean()
    assert (late[:, :2].mean(axis=0) <= 1.3 * per_frame * early[:, :2].mean(axis=0)).all()
    every = np.array(counts)
    # No more than the landmarks can depend on, and the poses that left since that was looked at.
    assert (every[:, 2] <= 3 * every[:, 1].max() + 30).all()
    assert (late[:, 3] == 6).all()
    assert (late[:, 4] == 0).all()
    assert late[:, 5].mean() <= 1.3 * per_frame * early[:, 5].mean()


def test_a_frame_that_left_keeps_no_array_of_its_window() -> None:
    """A view of one row would keep the poses of the whole lag for each frame of the run."""
    estimator = smoother()
    play(estimator, drawn(1, frames=10).increments, FREE)
    solver = estimator.solver
    assert isinstance(solver, FixedLagSolver)
    assert max(_held_by(pose) for pose in solver.poses[:-1]) == 4 * 4 * 8


def _held_by(array: FloatArray) -> int:
    """Bytes that an array keeps alive, itself or as a view of another."""
    return array.nbytes if array.base is None else _held_by(array.base)


def test_landmark_that_left_keeps_its_place_until_it_is_seen_again() -> None:
    simulation = drawn(8, frames=24)
    estimator = smoother()
    increments = unseen(simulation.increments, 28, range(5, 16))
    places = []
    for k, increment in enumerate(increments):
        play(estimator, [increment], FREE)
        found = estimator.estimate().landmarks
        row = found.rows(np.array([28]))[0]
        places.append((found.positions[row], found.covariances[row]))
        if k in (12, 15):
            assert estimator.builder.admission.tracks[28].variable == -1
            with pytest.raises(EstimatorError, match="landmark 28 waits outside the graph"):
                estimator.joint_covariance(np.array([28]))
    for k in range(11, 16):
        np.testing.assert_array_equal(places[k][0], places[10][0])
        np.testing.assert_array_equal(places[k][1], places[10][1])
    offset = places[15][0] - simulation.points_by_id[28]
    assert offset @ np.linalg.solve(places[15][1], offset) < 16.3
    assert (places[-1][0] != places[15][0]).any()


def test_a_blackout_longer_than_the_lag_is_bridged_and_never_forgotten() -> None:
    """All landmarks have left: what follows is as uncertain as the way through the dark."""
    simulation = drawn(3, frames=26)
    estimator, stats = run(LAG, blackout(simulation.increments, range(10, 20)))
    found = estimator.estimate()
    online = position_sigma(np.array([s.covariance for s in stats]))
    assert (np.diff(online[9:20]) > 0).all()
    assert online[19] > 5 * online[9]
    assert position_sigma(found.covariances)[20:].min() > 0.9 * online[19]
    error = np.linalg.norm(found.trajectory.poses[:, :3, 3] - simulation.poses[:, :3, 3], axis=1)
    assert (error[1:] < 4 * position_sigma(found.covariances)[1:]).all()


def test_repeated_failures_at_landmarks_are_repaired() -> None:
    simulation = drawn(8, frames=24)
    estimator = smoother()
    play(estimator, simulation.increments[:9], FREE)
    for k, identity in ((9, 28), (11, 5)):
        variable = estimator.builder.admission.tracks[identity].variable
        spoil(estimator, undetermined(variable))
        play(estimator, simulation.increments[k : k + 2], FREE)
        assert not estimator.builder.in_graph(variable)
    play(estimator, simulation.increments[13:], FREE)
    found = estimator.estimate()
    assert_finite(found)
    assert [r.split(" (")[0] for r in found.remarks] == ["landmark 28", "landmark 5"]
    for frame, remark in zip((9, 11), found.remarks, strict=True):
        assert f"left the system indeterminate at frame {frame}: taken out" in remark
        assert "\n" not in remark
    assert ate(found, simulation) < 0.015
    assert ate(found, simulation) < 1.5 * ate(answer(LAG, simulation.increments), simulation)


def test_the_rebuilt_window_is_as_uncertain_as_the_one_that_failed() -> None:
    simulation = drawn(8, frames=24)
    repaired, whole = smoother(), smoother()
    for estimator in (repaired, whole):
        play(estimator, simulation.increments[:12], FREE)
    variable = repaired.builder.admission.tracks[28].variable
    spoil(repaired, undetermined(variable))
    for estimator in (repaired, whole):
        play(estimator, simulation.increments[12:13], FREE)
    a, b = (position_sigma(e.estimate().covariances[-6:]) for e in (repaired, whole))
    # Of the landmarks' shared past only the oldest pose's part is kept.
    assert ((a > 0.95 * b) & (a < 2.0 * b)).all(), a / b


def test_a_window_rebuilt_from_the_first_frame_on_has_one_prior() -> None:
    simulation = drawn(8, frames=8)
    prior = Prediction(np.eye(4), np.diag([1e-4] * 3 + [1e-2] * 3))
    repaired, whole = build(LAG, prior), build(LAG, prior)
    for estimator in (repaired, whole):
        play(estimator, simulation.increments[:3], FREE)
    assert isinstance(repaired, Smoother)
    variable = repaired.builder.admission.tracks[28].variable
    spoil(repaired, undetermined(variable))
    for estimator in (repaired, whole):
        play(estimator, simulation.increments[3:4], FREE)
    found = repaired.estimate()
    np.testing.assert_allclose(found.covariances[0], prior.covariance, rtol=1e-6, atol=1e-12)
    a, b = (position_sigma(e.estimate().covariances) for e in (repaired, whole))
    assert (a > 0.999 * b).all()


def test_rebuilt_poses_leave_when_their_lag_is_over() -> None:
    simulation, estimator = drawn(8, frames=24), smoother()
    play(estimator, simulation.increments[:12], FREE)
    variable = estimator.builder.admission.tracks[28].variable
    spoil(estimator, undetermined(variable))
    play(estimator, simulation.increments[12:15], FREE)
    assert estimator.solver.window.frames == list(range(9, 15))


def test_asking_changes_nothing_where_several_frames_leave_at_once() -> None:
    increments = [
        dataclasses.replace(x, timestamp=x.timestamp + (1.0 if x.index >= 9 else 0.0))
        for x in drawn(9, frames=14).increments
    ]
    step = increments[1].timestamp - increments[0].timestamp
    asked, left = (smoother(FixedLagSettings(lag_frames=None, lag_s=5.5 * step)) for _ in range(2))
    for increment in increments:
        play(asked, [increment], FREE)
        asked.estimate()
    play(left, increments, FREE)
    assert_same_bits(asked.estimate(), left.estimate())


@pytest.mark.parametrize(
    "error", [UndeterminedError(4, "a pose"), np.linalg.LinAlgError("odd\nwords")]
)
def test_failure_beyond_repair_is_one_clear_line(error: Exception) -> None:
    simulation, estimator = drawn(8, frames=12), smoother()
    play(estimator, simulation.increments[:9], FREE)
    spoil(estimator, error)
    with pytest.raises(EstimatorError, match=r"^fixed_lag: the solver failed at frame 9 \(") as e:
        play(estimator, simulation.increments[9:10], FREE)
    assert "\n" not in str(e.value)
    assert "fgslam inspect" in str(e.value)


@pytest.mark.parametrize("at", [3, 9])
def test_restored_smoother_continues_to_the_bit(at: int) -> None:
    increments = drawn(9, frames=14).increments
    straight, first, second = smoother(), smoother(), smoother()
    play(straight, increments, FREE)
    play(first, increments[:at], FREE)
    restore(second, {name: np.array(array) for name, array in state_of(first).items()})
    play(second, increments[at:], FREE)
    assert_same_bits(second.estimate(), straight.estimate())
    held = [i for i, track in second.builder.admission.tracks.items() if track.variable >= 0][:2]
    ids = np.array(held)
    assert_same_bits(second.joint_covariance(ids), straight.joint_covariance(ids))


def test_a_frame_located_without_a_prior_is_as_sure_as_the_map_around_it() -> None:
    """After so long in the dark that nothing it sees is within the lag."""
    increments = blackout(drawn(3, frames=13).increments, range(6, 12))
    estimator = build(FixedLagSettings(lag_frames=4))
    before = play(estimator, increments[:6], FREE)[-1]
    play(estimator, increments[6:12], FREE)
    located = dataclasses.replace(increments[12], relocalised=True)
    after = play(estimator, [located], FREE)[-1]
    assert located.observations.is_new.mean() < 0.5
    sigmas = [np.sqrt(np.diag(stats.covariance)) for stats in (before, after)]
    assert (sigmas[1] < 3.0 * sigmas[0]).all(), "not 3 rad and 30 m"


def test_a_frame_located_by_landmarks_of_the_lag_tells_nothing_twice() -> None:
    """Its factors hold it there; a prior from the same matches would be the same evidence."""
    increments = drawn(3, frames=14).increments
    marked = [dataclasses.replace(each, relocalised=each.index % 3 == 2) for each in increments]
    plain, located = (
        play(build(FixedLagSettings(lag_frames=6)), given, FREE)[-1]
        for given in (increments, marked)
    )
    sigmas = [np.sqrt(np.diag(stats.covariance)) for stats in (plain, located)]
    assert (sigmas[1] > 0.9 * sigmas[0]).all()
