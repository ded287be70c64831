"""Landmarks seen again after a drift: one says nothing, several that agree say where it is."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import RIG

from fgslam.backend.smoothers.returning import LEAST, SeenAgain
from fgslam.backend.smoothers.window_parts import Landmarks
from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray

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
    return SeenAgain(np.arange(count), seen, noise).returned(known, WTF, drift)


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
    assert SeenAgain(np.arange(1), point + SIGMA_M, noise).returned(known, np.eye(4), still).all()


def test_what_is_too_far_to_be_placed_is_left_out() -> None:
    points = np.array([[0.0, 0.0, 3.0], [0.5, 0.2, 400.0]])
    measured = np.concatenate([g.project(RIG, points), [[100.0, 80.0, -0.5], [100.0, 80.0, 0.0]]])
    noise = np.tile(0.09 * np.eye(3), (4, 1, 1))
    seen = SeenAgain.of(RIG, np.array([5, 7, 8, 9]), np.tile(WTF, (4, 1, 1)), measured, noise)
    assert seen.variables.tolist() == [5]
    np.testing.assert_allclose(seen.points, g.transform_to_world(WTF, points[:1]), atol=1e-9)
