"""Sliding window: old landmarks come back with what was known of them; everything in the answer."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG, Simulation, play
from smoothing import FREE, answer, assert_consistent, build, drawn

from fgslam.backend.loops import Constraint
from fgslam.backend.protocol import Estimator
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import BatchSettings, SlidingWindowSettings
from fgslam.backend.smoothers.elimination import Eliminated, UndeterminedError
from fgslam.backend.smoothers.graph import Drive
from fgslam.backend.smoothers.lag import SlidingWindowSolver
from fgslam.backend.smoothers.smoother import MapSmoother
from fgslam.backend.smoothers.window import HeldLandmarks, Solved, Window
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.correction import term_names
from fgslam.core.sensors import Increment
from fgslam.core.types import LandmarkMap, Prediction
from fgslam.evaluation.statistics import pose_nees

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
def test_pose_of_every_frame_is_as_uncertain_as_it_says_before_and_after_a_return() -> None:
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


def test_a_place_that_is_like_any_pose_that_left_says_the_same(
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
    beside = returned.window.frames[0]
    if tie.follows is not None:
        beside = returned.frame_of(tie.follows)
    frames = beside, returned.frame_of(0)
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


@pytest.mark.slow
def test_answer_is_consistent_over_20_drives() -> None:
    assert_consistent(SHORT)


def test_what_is_known_too_unevenly_is_begun_anew_with_a_remark(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive, estimator, solve = drawn(8, frames=16), build(SHORT), Window.solve
    failed = []

    def once(self: Window) -> Solved:
        if self.frames[-1] >= 10 and not failed:
            failed.append(self.frames[0])
            raise UndeterminedError(0, "not determined")
        return solve(self)

    monkeypatch.setattr(Window, "solve", once)
    stats = play(estimator, drive.increments, FREE)
    off = [np.linalg.norm(s.wTc[:3, 3] - x[:3, 3]) for s, x in zip(stats, drive.poses, strict=True)]
    assert len(failed) == 1
    assert max(off) < 0.03
    assert sum("begun anew" in remark for remark in estimator.estimate().remarks) == 1


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
    assert seen.frame.max() == 6
    for frame, variable, found in zip(seen.frame, seen.variable, seen.measurement, strict=True):
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
    beside = g.se3_exp(np.array([0.0, 0.3, 0.0, 0.5, 0.0, 0.0])) @ window.poses[-1]
    there = Prediction(beside, 1e-6 * np.eye(6))
    loop = Constraint(2, window.frames[-1], g.inverse(solver.poses[2]) @ beside, 1e-6 * np.eye(6))
    solver.loops.accept(loop)
    solver.move_by_loop(there, loop, Drive(estimator.tracker.chain, window.poses[-1]))
    np.testing.assert_array_equal(held.points[ours & outside], points[ours & outside])
    np.testing.assert_array_equal(window.landmarks.mean[inside], mean[inside])
    went = np.linalg.norm(held.points - points, axis=1)[~ours & outside & (held.homes > 10)]
    assert went.min() > 0.01
    assert np.linalg.norm(window.landmarks.mean - mean, axis=1)[~inside].min() > 0.01


def test_a_landmark_that_was_another_is_this_drive_s_and_goes_with_it() -> None:
    held, all_of_them = HeldLandmarks(), np.arange(3)
    for k in all_of_them.tolist():
        held.enter(np.full(3, float(k)))
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
