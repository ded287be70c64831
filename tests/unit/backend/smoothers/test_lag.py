"""The smoothers of a window: fixed lag and sliding window."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from simulated import RIG, Simulation, play
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

from fgslam.backend.loops import Constraint
from fgslam.backend.protocol import Estimator
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import BatchSettings, FixedLagSettings, SlidingWindowSettings
from fgslam.backend.smoothers.elimination import (
    Eliminated,
    UndeterminedError,
    UndeterminedLandmarkError,
)
from fgslam.backend.smoothers.graph import Smoothed
from fgslam.backend.smoothers.lag import FixedLagSolver, SlidingWindowSolver
from fgslam.backend.smoothers.smoother import MapSmoother, Smoother
from fgslam.backend.smoothers.window import HeldLandmarks, Solved, Window
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.correction import term_names
from fgslam.core.errors import EstimatorError
from fgslam.core.sensors import Increment
from fgslam.core.types import LandmarkMap, Prediction
from fgslam.evaluation.statistics import pose_nees

# ------------------------------------------------------------------------------------------
# Fixed lag: what leaves stays as it was, effort and memory are bounded, failures repaired


LAG = FixedLagSettings(lag_frames=5)


def spoil(estimator: Any, error: Any) -> None:
    """The window's next solution fails with this error, or one made of it; later ones do not."""
    window = estimator.solver.window
    solve, errors = window.solve, [error]

    def failing(*arguments: Any) -> Any:
        if errors:
            error = errors.pop()
            raise error(window) if callable(error) else error
        return solve(*arguments)

    window.solve = failing


def undetermined(variable: int) -> Callable[[Window], UndeterminedLandmarkError]:
    def error(window: Window) -> UndeterminedLandmarkError:
        return UndeterminedLandmarkError(np.flatnonzero(window.landmarks.variables == variable))

    return error


def smoother(settings: FixedLagSettings = LAG) -> Smoother:
    made = build(settings)
    assert isinstance(made, Smoother)
    return made


def test_poses_older_than_the_lag_never_change_again() -> None:
    simulation, estimator = drawn(1, frames=14), smoother(FixedLagSettings(lag_frames=4))
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
                len(window.observed),
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
    *taken, unknown = found.remarks
    assert unknown.startswith("covariances of motions between final poses are not known")
    assert [r.split(" (")[0] for r in taken] == ["landmark 28", "landmark 5"]
    for frame, remark in zip((9, 11), taken, strict=True):
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


@pytest.mark.parametrize(
    "error", [UndeterminedError("a pose"), np.linalg.LinAlgError("odd\nwords")]
)
def test_failure_beyond_repair_is_one_clear_line(error: Exception) -> None:
    simulation, estimator = drawn(8, frames=12), smoother()
    play(estimator, simulation.increments[:9], FREE)
    spoil(estimator, error)
    with pytest.raises(EstimatorError, match=r"^fixed_lag: the solver failed at frame 9 \(") as e:
        play(estimator, simulation.increments[9:10], FREE)
    assert "\n" not in str(e.value)
    assert "fgslam inspect" in str(e.value)


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


def test_a_frame_located_by_landmarks_of_the_lag_counts_nothing_twice() -> None:
    """Its factors hold it there; a prior from the same matches would be the same evidence."""
    increments = drawn(3, frames=14).increments
    marked = [dataclasses.replace(each, relocalised=each.index % 3 == 2) for each in increments]
    plain, located = (
        play(build(FixedLagSettings(lag_frames=6)), given, FREE)[-1]
        for given in (increments, marked)
    )
    sigmas = [np.sqrt(np.diag(stats.covariance)) for stats in (plain, located)]
    assert (sigmas[1] > 0.9 * sigmas[0]).all()


# ------------------------------------------------------------------------------------------
# Sliding window: old landmarks come back with what was known of them; everything in the answer


SHORT = SlidingWindowSettings(window=6, update_every=2)
ROUND = 40
CIRCLE = {
    "frames": 60,
    "points": 50,
    "twist": (0.0, 2.0 * np.pi / ROUND, 0.0, 0.01, 0.0, 0.15),
    "prune_after": 10**6,
}


def solver_of(estimator: Estimator) -> SlidingWindowSolver:
    assert isinstance(estimator, MapSmoother)
    assert isinstance(estimator.solver, SlidingWindowSolver)
    return estimator.solver


def live(seed: int, settings: SlidingWindowSettings = SHORT) -> tuple[FloatArray, FloatArray]:
    """Distances (n,) of a drive round in a circle and on, and squared errors in deviations (n,)."""
    drive: Simulation = drawn(seed, **CIRCLE)
    stats = play(build(settings), drive.increments, FREE)
    poses, covariances = np.array([s.wTc for s in stats]), np.array([s.covariance for s in stats])
    found = pose_nees(poses[1:], covariances[1:], drive.poses[1:])
    return np.linalg.norm(poses[:, :3, 3] - drive.poses[:, :3, 3], axis=1), found.values


def test_drift_goes_where_the_drive_returns_though_no_loop_is_announced() -> None:
    off, squared = zip(*(live(seed) for seed in (2, 4)), strict=True)
    drifted, back = np.array(off)[:, 25:ROUND], np.array(off)[:, ROUND + 5 :]
    assert np.sqrt((back**2).mean()) < 0.7 * np.sqrt((drifted**2).mean())  # fixed lag: 1.6
    assert 0.3 < np.array(squared)[:, ROUND:].mean() / 6.0 < 2.0


@pytest.mark.slow
def test_pose_of_every_frame_is_as_uncertain_as_stated_before_and_after_a_return() -> None:
    squared = np.array([live(100 + seed)[1] for seed in range(20)]) / 6.0
    assert 0.4 < squared[:, : ROUND - 1].mean() < 1.25
    assert 0.4 < squared[:, ROUND - 1 :].mean() < 1.25


def test_window_stays_as_long_as_it_is_set_and_places_leave_it() -> None:
    drive, estimator, places = drawn(3, **CIRCLE), build(SHORT), set()
    for increment in drive.increments:
        play(estimator, [increment], FREE)
        window = solver_of(estimator).window
        assert len(window.frames) <= SHORT.window + SHORT.update_every
        assert window.prior.kept == 6 * len(window.places)
        assert len(window.places) <= 3
        places |= set(window.places)
    assert len(places) > 1


@pytest.fixture(scope="module")
def returned() -> SlidingWindowSolver:
    """A few frames after the return."""
    estimator = build(SHORT)
    play(estimator, drawn(3, **CIRCLE).increments[:46], FREE)
    return solver_of(estimator)


def test_a_place_that_is_like_any_pose_that_left_counts_the_same(
    returned: SlidingWindowSolver, monkeypatch: pytest.MonkeyPatch
) -> None:
    window = returned.window
    assert window.places
    expected = last_pose(window)
    for prior in (window.prior.without_place(0), window.prior.without_place(0).compressed()):
        monkeypatch.setattr(window, "prior", prior)
        np.testing.assert_allclose(last_pose(window), expected, rtol=1e-5)


def last_pose(window: Window) -> FloatArray:
    """(6, 6) covariance, linearised where the window is."""
    return Eliminated(window.equations()).pose(len(window.frames) - 1)


def test_a_place_is_off_as_far_as_its_frame_had_drifted(returned: SlidingWindowSolver) -> None:
    """Given another that shares a part of it, and the rest."""
    tie, here = returned.tie_of(0), g.inverse(returned.window.poses[0])
    near = returned.window.frames[0]
    if tie.follows is not None:
        near = returned.frame_of(tie.follows)
    frames = near, returned.frame_of(0)
    other, own = (g.congruence(g.adjoint(here), returned.drift[frame]) for frame in frames)
    whole = g.congruence(tie.gain, other) + np.linalg.inv(tie.information)
    found, expected = np.sqrt(np.diagonal(whole)), np.sqrt(np.diagonal(own))
    assert (found > 0.98 * expected).all()
    assert (found < 1.1 * expected + 1.5e-4).all()


def test_answer_is_that_of_batch() -> None:
    drive = drawn(21, frames=21)
    found = answer(SHORT, drive.increments)
    best = answer(BatchSettings(gate_px=SHORT.gate_px), drive.increments)
    # Another tracker, another map between solutions: a landmark more or less is admitted.
    np.testing.assert_allclose(found.trajectory.poses, best.trajectory.poses, rtol=0, atol=2e-4)
    sigma, expected = (
        np.sqrt(np.diagonal(x.covariances[1:], axis1=1, axis2=2)) for x in (found, best)
    )
    np.testing.assert_allclose(sigma, expected, rtol=0.02)


def test_what_is_known_too_unevenly_is_begun_again_with_a_remark(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive, estimator, solve = drawn(8, frames=16), build(SHORT), Window.solve
    failed = []

    def once(self: Window) -> Solved:
        if self.frames[-1] >= 10 and not failed:
            failed.append(self.frames[0])
            raise UndeterminedError("not determined")
        return solve(self)

    monkeypatch.setattr(Window, "solve", once)
    stats = play(estimator, drive.increments, FREE)
    off = [np.linalg.norm(s.wTc[:3, 3] - x[:3, 3]) for s, x in zip(stats, drive.poses, strict=True)]
    assert len(failed) == 1
    assert max(off) < 0.03
    assert sum("begun again" in remark for remark in estimator.estimate().remarks) == 1


def test_a_change_of_the_rig_is_solved_for_with_the_next_frame(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive, solved = drawn(3, frames=9), []
    estimator = build(SlidingWindowSettings(window=6, update_every=4))
    solve = SlidingWindowSolver.solve_if_due

    def noted(own: SlidingWindowSolver, frame: int, closes_loop: bool) -> Smoothed | None:
        found = solve(own, frame, closes_loop)
        solved.extend([frame] if found else [])
        return found

    monkeypatch.setattr(SlidingWindowSolver, "solve_if_due", noted)
    play(estimator, drive.increments[:4], FREE)
    solver_of(estimator).recalibrate(RigChange(RIG, np.zeros(len(term_names(RIG)))))
    play(estimator, drive.increments[4:], FREE)
    assert solved == [0, 2, 4, 8]


def test_a_change_of_the_rig_is_taken_once_also_by_frames_that_wait() -> None:
    estimator = build(SlidingWindowSettings(window=6, update_every=4))
    play(estimator, drawn(3, frames=7).increments, FREE)  # the last two wait for a solution
    solver, turned = solver_of(estimator), np.zeros(len(term_names(RIG)))
    turned[term_names(RIG).index("left.yaw")] = 1e-2
    change = RigChange(RIG, turned)
    solver.builder.recalibrate(change)
    solver.recalibrate(change)
    frames, variables, measured, _ = solver.builder.kept_observed()
    expected = dict(
        zip(zip(frames.tolist(), variables.tolist(), strict=True), measured, strict=True)
    )
    seen = solver.window.observed
    assert seen.poses.max() == 6
    for frame, variable, found in zip(seen.poses, seen.points, seen.measured, strict=True):
        np.testing.assert_allclose(found, expected[frame, variable], rtol=0, atol=1e-9)


def test_a_loop_moves_no_landmark_of_a_saved_map() -> None:
    """What is known of them stays, in the window and outside; those of the drive go with it."""
    drive, estimator = drawn(3, **CIRCLE), build(SHORT)
    saved = np.arange(0, 40, 2)
    known = LandmarkMap(saved, drive.points_by_id[saved], np.tile(1e-4 * np.eye(3), (20, 1, 1)))
    assert isinstance(estimator, MapSmoother)
    estimator.begin_in(known, np.full(20, 4), fixed=False)
    play(estimator, [matched(each, saved) for each in drive.increments[:44]], FREE)
    solver = solver_of(estimator)
    held, window = solver.held, solver.window
    ours = held.saved.copy()
    outside = ~np.isin(np.arange(len(held)), window.landmarks.variables)
    inside = ours[window.landmarks.variables]
    assert all(mask.sum() > 3 for mask in (ours & outside, inside, ~ours & outside, ~inside))
    points, mean = held.points.copy(), window.landmarks.mean.copy()
    near = g.se3_exp(np.array([0.0, 0.3, 0.0, 0.5, 0.0, 0.0])) @ window.poses[-1]
    there = Prediction(near, 1e-6 * np.eye(6))
    loop = Constraint(2, window.frames[-1], g.inverse(solver.poses[2]) @ near, 1e-6 * np.eye(6))
    solver.accept(loop)
    solver.move_by_loop(there, loop, estimator.tracker.chain)
    np.testing.assert_array_equal(held.points[ours & outside], points[ours & outside])
    np.testing.assert_array_equal(window.landmarks.mean[inside], mean[inside])
    went = np.linalg.norm(held.points - points, axis=1)[~ours & outside & (held.homes > 10)]
    assert went.min() > 0.01
    assert np.linalg.norm(window.landmarks.mean - mean, axis=1)[~inside].min() > 0.01


def test_a_landmark_that_was_another_is_this_drive_s_and_goes_with_it() -> None:
    held, all_of_them = HeldLandmarks(), np.arange(3)
    for k in all_of_them.tolist():
        held.enter(np.full((1, 3), float(k)))
        held.know(k, np.full(3, float(k)), np.eye(3), saved=True)
    held.begin(np.array([1]), np.full((1, 3), 7.0))
    assert held.saved.tolist() == [True, False, True]
    begun = held.of(all_of_them)
    np.testing.assert_array_equal(begun.points[1], begun.mean[1])
    np.testing.assert_array_equal(begun.information[1], np.zeros((3, 3)))
    held.left(begun, home=0)
    held.carried_along(g.se3_exp(np.array([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]))[None])
    assert held.points[:, 0].tolist() == [0.0, 9.0, 2.0]


def matched(increment: Increment, saved: IntArray) -> Increment:
    """With those of a saved map matched where they are seen first, not new."""
    seen = increment.observations
    seen = dataclasses.replace(seen, is_new=seen.is_new & ~np.isin(seen.ids, saved))
    return dataclasses.replace(increment, observations=seen)
