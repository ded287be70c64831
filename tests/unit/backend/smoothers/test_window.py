"""A window of poses and landmarks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.linalg import block_diag
from simulated import RIG, play
from smoothing import FREE, SMOOTHERS, answer, blackout, build, drawn

from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import FixedLagSettings
from fgslam.backend.smoothers.elimination import Eliminated
from fgslam.backend.smoothers.lag import FixedLagSolver
from fgslam.backend.smoothers.smoother import Smoother
from fgslam.backend.smoothers.window import LEAST, Landmarks, SeenAgain, Window
from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.correction import term_names

# ------------------------------------------------------------------------------------------
# The fixed lag's window: what has left counts the same, once and where it was first linearised


FRAMES, FIRST = 14, 8


def whole_window() -> Window:
    """Of all frames; none has left."""
    estimator = build(FixedLagSettings(lag_frames=30))
    play(estimator, drawn(5, frames=FRAMES, points=80, prune_after=8).increments, FREE)
    assert isinstance(estimator, Smoother)
    assert isinstance(estimator.solver, FixedLagSolver)
    return estimator.solver.window


@pytest.fixture
def window() -> Window:
    """Of all frames; none has left."""
    return whole_window()


def covariances(window: Window, variables: IntArray) -> FloatArray:
    """Of the last poses together, and of each landmark, linearised where the window is."""
    rows = np.searchsorted(window.landmarks.variables, variables)
    found = Eliminated(window.equations())
    poses = [window.frames.index(frame) for frame in range(FIRST, FRAMES)]
    return np.asarray(block_diag(found.poses(poses), *found.landmarks()[rows]))


def assert_same(found: FloatArray, expected: FloatArray) -> None:
    """To a millionth of each deviation."""
    sigma = np.sqrt(np.diagonal(expected))
    known = sigma > 0.0
    difference = ((found - expected) / np.outer(sigma, sigma))[np.ix_(known, known)]
    np.testing.assert_allclose(difference, 0.0, rtol=0, atol=1e-6)


def test_what_has_left_leaves_the_covariances_as_they_were(window: Window) -> None:
    inside = np.unique(window.observed.points[window.observed.poses >= FIRST])
    expected = covariances(window, inside)
    window.let_go_before(FIRST)
    assert window.frames == list(range(FIRST, FRAMES))
    np.testing.assert_array_equal(window.landmarks.variables, inside)
    assert_same(covariances(window, inside), expected)


def test_fewer_hidden_numbers_say_the_same(window: Window) -> None:
    for frame in range(1, FIRST):  # one by one, as in a drive
        window.let_go_before(frame)
    for variable in window.prior.variables[6:].tolist():
        window.take_out(variable)
    inside = window.landmarks.variables
    expected = covariances(window, inside)
    assert window.prior.hidden > 3 * len(window.prior.variables)
    window.prior = window.prior.compressed()
    assert window.prior.hidden <= 3 * len(window.prior.variables)
    assert_same(covariances(window, inside), expected)


def test_the_place_of_rest_stays(window: Window) -> None:
    """A pose and a landmark that the prior speaks of move; its gradient moves along."""
    for _ in range(5):
        window.solve()
    window.let_go_before(FIRST)
    poses, points = window.poses.copy(), window.landmarks.points.copy()
    window.landmarks = dataclasses.replace(window.landmarks, points=points + 0.01)
    window.solve()
    np.testing.assert_allclose(window.poses, poses, rtol=0, atol=1e-4)
    np.testing.assert_allclose(window.landmarks.points, points, rtol=0, atol=1e-3)


def test_what_has_left_follows_the_rig_as_if_it_were_measured_again(window: Window) -> None:
    change, before, again = turned(1e-4), window.poses.copy(), whole_window()
    again.remeasure(change)  # all of it
    for one in (window, again):
        for frame in range(1, FIRST + 1):
            one.let_go_before(frame)
    window.remeasure(change)  # some has left
    for one in (window, again):
        for _ in range(5):
            one.solve()
    moved = np.linalg.norm(again.poses[:, :3, 3] - before[FIRST:, :3, 3], axis=1)
    apart = np.linalg.norm(again.poses[:, :3, 3] - window.poses[:, :3, 3], axis=1)
    assert moved.min() > 1e-3
    np.testing.assert_allclose(apart, 0.0, rtol=0, atol=0.1 * moved.min())


def test_what_has_left_was_measured_by_the_rig_before_it_moved(window: Window) -> None:
    window.let_go_before(FIRST)
    before = window.prior
    window.remeasure(turned(1e-4, since=FIRST))
    np.testing.assert_array_equal(window.prior.gradient[..., 0], before.gradient[..., 0])
    window.remeasure(turned(1e-4, since=FIRST))
    np.testing.assert_array_equal(window.prior.gradient[..., 0], before.gradient[..., 0])


def turned(radians: float, since: int = 0) -> RigChange:
    """The left camera, in yaw."""
    return RigChange(RIG, radians * (np.array(term_names(RIG)) == "left.yaw"), since)


def test_an_observation_is_weighed_and_linearised_where_the_prior_was(window: Window) -> None:
    window.let_go_before(FIRST)
    tied = np.isin(window.observed.points, window.prior.variables)
    before = window.linearise(window.observed).rows
    moved = dataclasses.replace(window.landmarks, points=window.landmarks.points + 0.5)
    window.landmarks = moved
    after = window.linearise(window.observed).rows
    assert tied.sum() > 50
    np.testing.assert_array_equal(after.by_point[tied], before.by_point[tied])
    far = np.linalg.norm(after.residual, axis=1) > 10.0 * np.linalg.norm(before.residual, axis=1)
    assert far[tied].mean() > 0.5
    assert (after.by_point[~tied] != before.by_point[~tied]).any()


# ------------------------------------------------------------------------------------------
# Landmarks seen again after a drift: one counts for nothing, several that agree place it


WTF = g.se3_exp(np.array([0.1, 0.8, 0.0, 3.0, 0.0, -2.0]))
MOTION = np.array([0.0, 0.08, 0.0, 1.0, 0.0, -0.7])
DRIFT = np.diag([1e-6, 0.1**2, 1e-6, 1.0, 1e-4, 1.0])
SIGMA_M = 0.02


def returned(count: int, wrong: int, drift: FloatArray = DRIFT) -> BoolArray:
    """Of landmarks at a place that has drifted by MOTION, the last ones others than they seem."""
    rng = np.random.default_rng(3)
    local = rng.uniform([-2.0, -1.0, 2.0], [2.0, 1.0, 6.0], (count, 3))
    moved = g.transform_to_world(g.se3_exp(MOTION), local)
    moved[count - wrong :] = local[count - wrong :] + rng.uniform(-1.0, 1.0, (wrong, 3))
    there, seen = (g.transform_to_world(WTF, points) for points in (local, moved))
    noise = np.tile(SIGMA_M**2 * np.eye(3), (count, 1, 1))
    seen = seen + SIGMA_M * rng.standard_normal(seen.shape)
    known = Landmarks(np.arange(count), there, there, np.linalg.inv(noise))
    near = np.ones(count, np.bool_)
    return SeenAgain(np.arange(count), seen, noise, near).returned(known, WTF, drift)


@pytest.mark.parametrize(("right", "wrong"), [(1, 0), (0, 1), (LEAST - 1, 0), (0, 12)])
def test_too_few_that_agree_are_not_back_where_much_may_have_drifted(
    right: int, wrong: int
) -> None:
    assert not returned(right + wrong, wrong).any()


def test_those_that_agree_are_back_and_the_others_are_not() -> None:
    found = returned(count=12, wrong=4)
    assert found[:8].all()
    assert not found[8:].any()


def test_one_alone_is_back_where_less_has_drifted_than_it_is_uncertain_by() -> None:
    still = 1e-8 * np.eye(6)
    assert not returned(1, 1, still).any()
    assert not returned(1, 0, still).any()  # a metre off
    point = np.array([[0.0, 0.0, 3.0]])
    noise = SIGMA_M**2 * np.eye(3)[None]
    known = Landmarks(np.arange(1), point, point, np.linalg.inv(noise))
    seen = SeenAgain(np.arange(1), point + SIGMA_M, noise, np.ones(1, np.bool_))
    assert seen.returned(known, np.eye(4), still).all()


FAR_PX = np.array([0.3, 0.3, 0.2])


def far_away(turn: float) -> tuple[SeenAgain, Landmarks]:
    """Eight landmarks whose depth no single observation fixes, by a camera that has turned."""
    rng = np.random.default_rng(5)
    local = rng.uniform([-25.0, -18.0, 60.0], [25.0, 18.0, 90.0], (8, 3))
    points = g.transform_to_world(WTF, local)
    truly = WTF @ g.se3_exp(np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0]))
    measured = RIG.predict(g.transform_to_camera(truly, points))
    measured += FAR_PX * rng.standard_normal(measured.shape)
    measured[0, 2] = -0.1
    known = Landmarks(np.arange(8), points, points, np.tile(np.eye(3), (8, 1, 1)))
    poses, noise = np.tile(WTF, (8, 1, 1)), np.tile(np.diag(FAR_PX**2), (8, 1, 1))
    return SeenAgain.of(RIG, known, poses, measured, noise), known


def test_landmarks_too_far_to_be_placed_agree_by_where_they_are_seen() -> None:
    """Waiting for a depth that none of them fixes, all of them would be lost to the window."""
    turned, known = far_away(0.04)
    assert turned.variables.tolist() == list(range(8))
    assert not turned.near.any()
    assert np.isfinite(turned.points).all()
    assert turned.returned(known, WTF, DRIFT).all()
    off = known.points + np.random.default_rng(7).uniform(-9.0, 9.0, (8, 3))
    elsewhere = Landmarks(known.variables, off, off, known.information)
    assert not turned.returned(elsewhere, WTF, DRIFT).any()


def test_of_what_is_near_the_observation_alone_places_it() -> None:
    points = np.array([[0.0, 0.0, 3.0], [0.5, 0.2, 400.0], [0.0, 0.0, -3.0]])
    ahead = np.where(points[:, 2:] > 0.0, points, 4.0)
    known = Landmarks(np.array([5, 7, 8]), *2 * [g.transform_to_world(WTF, points)], *[np.eye(3)])
    measured, noise = RIG.predict(ahead), np.tile(0.09 * np.eye(3), (3, 1, 1))
    measured[2, 2] = -0.5  # and behind the camera, by what was known: of no use
    seen = SeenAgain.of(RIG, known, np.tile(WTF, (3, 1, 1)), measured, noise)
    assert (seen.variables.tolist(), seen.near.tolist()) == ([5, 7], [True, False])
    np.testing.assert_allclose(seen.points, known.points[:2], atol=1e-6)


@pytest.mark.parametrize("kind", ["isam2, every frame", "sliding_window"])
def test_matches_that_agree_on_no_pose_move_none(kind: str) -> None:
    """Of a frame in the dark three are left by chance, and were rejected when it was driven."""
    increments = drawn(4).increments
    unseen = blackout(increments, range(8, 9))
    few = np.flatnonzero(~increments[8].observations.is_new)[:3]
    observed = increments[8].observations.select(few)
    observed = dataclasses.replace(observed, measurement=observed.measurement + 3.0 * np.eye(3)[0])
    chance = dataclasses.replace(unseen[8], observations=observed, rejected=np.ones(3, np.bool_))
    wrong = answer(SMOOTHERS[kind], [*unseen[:8], chance, *unseen[9:]])
    right = answer(SMOOTHERS[kind], unseen)
    off = wrong.trajectory.poses - right.trajectory.poses
    np.testing.assert_allclose(off, 0.0, rtol=0.0, atol=1e-6)  # what the solver leaves
