"""The fixed lag's window: what has left says the same, once and where it was first linearised."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import play
from smoothing import FREE, build, drawn

from fgslam.backend.settings import FixedLagSettings
from fgslam.backend.smoothers.elimination import Eliminated
from fgslam.backend.smoothers.lag import FixedLagSolver
from fgslam.backend.smoothers.smoother import Smoother
from fgslam.backend.smoothers.window import Window
from fgslam.core.arrays import FloatArray, IntArray

FRAMES, FIRST = 14, 8


@pytest.fixture
def window() -> Window:
    """Of all frames; none has left."""
    estimator = build(FixedLagSettings(lag_frames=30))
    play(estimator, drawn(5, frames=FRAMES, points=80, prune_after=8).increments, FREE)
    assert isinstance(estimator, Smoother)
    assert isinstance(estimator.solver, FixedLagSolver)
    return estimator.solver.window


def joint(window: Window, variables: IntArray) -> FloatArray:
    """Covariance of the last pose and of landmarks, linearised where the window is."""
    rows = np.searchsorted(window.landmarks.variables, variables)
    return Eliminated(window.equations()).joint(len(window.frames) - 1, rows)


def assert_same(found: FloatArray, expected: FloatArray) -> None:
    """To a millionth of each deviation."""
    sigma = np.sqrt(np.diagonal(expected))
    known = sigma > 0.0
    difference = ((found - expected) / np.outer(sigma, sigma))[np.ix_(known, known)]
    np.testing.assert_allclose(difference, 0.0, rtol=0, atol=1e-6)


def test_what_has_left_leaves_the_covariances_as_they_were(window: Window) -> None:
    inside = np.unique(window.observed.variable[window.observed.frame >= FIRST])
    expected = joint(window, inside)
    window.let_go_before(FIRST)
    assert window.frames == list(range(FIRST, FRAMES))
    np.testing.assert_array_equal(window.landmarks.variables, inside)
    assert_same(joint(window, inside), expected)


def test_fewer_hidden_numbers_say_the_same(window: Window) -> None:
    for frame in range(1, FIRST):  # one by one, as in a drive
        window.let_go_before(frame)
    for variable in window.prior.variables[6:].tolist():
        window.take_out(variable)
    inside = window.landmarks.variables
    expected = joint(window, inside)
    assert window.prior.hidden > 3 * len(window.prior.variables)
    window.prior = window.prior.compressed()
    assert window.prior.hidden <= 3 * len(window.prior.variables)
    assert_same(joint(window, inside), expected)


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


def test_an_observation_is_weighed_and_linearised_where_the_prior_was(window: Window) -> None:
    window.let_go_before(FIRST)
    tied = np.isin(window.observed.variable, window.prior.variables)
    before = window.linearise(window.observed).rows
    moved = dataclasses.replace(window.landmarks, points=window.landmarks.points + 0.5)
    window.landmarks = moved
    after = window.linearise(window.observed).rows
    assert tied.sum() > 50
    np.testing.assert_array_equal(after.by_point[tied], before.by_point[tied])
    far = np.linalg.norm(after.residual, axis=1) > 10.0 * np.linalg.norm(before.residual, axis=1)
    assert far[tied].mean() > 0.5
    assert (after.by_point[~tied] != before.by_point[~tied]).any()
