"""The kernel of the ego-motion against the same in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.types import Floor
from fgslam.frontend.tracking.pose_fit import ROBUST, fit_pose

CAMERA = np.array([300.0, 310.0, 160.0, 120.0, 0.12])
DOWN = np.array([0.0, 0.96, 0.28])


def problem(seed: int, turn: float) -> tuple[FloatArray, ...]:
    """Points, measurements with outliers, information; a predicted pose, a weak prior."""
    rng = np.random.default_rng(seed)
    local = rng.uniform([-2.0, -1.0, 3.0], [2.0, 1.0, 9.0], (60, 3))
    wTc = g.se3_exp(np.array([0.1, turn, -0.1, 0.3, 0.1, 0.5]))
    seen = np.column_stack([
        CAMERA[2] + CAMERA[0] * local[:, 0] / local[:, 2],
        CAMERA[3] + CAMERA[1] * local[:, 1] / local[:, 2],
        CAMERA[0] * CAMERA[4] / local[:, 2],
    ])  # fmt: skip
    seen += rng.normal(0.0, 0.3, seen.shape)
    seen[:6] += rng.uniform(-20.0, 20.0, (6, 3))
    roots = rng.normal(size=(60, 3, 3))
    information = roots @ roots.transpose(0, 2, 1) + 4.0 * np.eye(3)
    predicted = g.se3_exp(rng.normal(0.0, 0.05, 6)) @ wTc
    prior = np.diag([10.0, 20.0, 30.0, 5.0, 6.0, 7.0])
    return g.transform_to_world(wTc, local), seen, information, predicted, prior, wTc


def fits(
    given: tuple[FloatArray, ...], kernel: str, dof: Any, start: FloatArray, steps: int = 30
) -> list[Any]:
    """Pose, hessian with gradient, and state, by both."""
    points, seen, information, predicted, prior, _ = given
    local, out = g.transform_to_camera(predicted, points), []
    basis = Floor(dof, DOWN).basis(predicted)
    for work in (fit_pose, fit_pose.numpy):
        pose, system, state = g.inverse(predicted) @ start, np.zeros((2, 7, 6)), np.zeros(2)
        work(local, seen, information, CAMERA, prior, basis, ROBUST.index(kernel), 1e-9, steps,
             pose, system, state, np.zeros((7, 6, 6)))  # fmt: skip
        out.append((predicted @ pose, system[0], state))
    return out


@pytest.mark.parametrize("dof", [6, 5, 3])
@pytest.mark.parametrize("kernel", ROBUST)
def test_pose_and_hessian_are_those_of_numpy(kernel: str, dof: int) -> None:
    given = problem(0, 0.2)
    (pose, system, state), (other, expected, steps) = fits(given, kernel, dof, given[3])
    np.testing.assert_allclose(pose, other, rtol=0, atol=1e-9)
    np.testing.assert_allclose(system[:6], expected[:6], rtol=1e-6, atol=1e-4)
    np.testing.assert_array_equal(state, steps)
    assert 2 < state[0] <= 30
    assert state[1] == 1.0
    if (kernel, dof) == ("cauchy", 6):
        assert np.abs(g.se3_log(g.inverse(given[5]) @ pose)).max() < 0.02
    if dof == 3:  # a turn about the vertical, and level steps
        moved = pose @ g.inverse(given[3])
        np.testing.assert_allclose(moved[:3, :3] @ DOWN, DOWN, rtol=0, atol=1e-12)
        assert DOWN @ (pose - given[3])[:3, 3] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("turn", [1e-13, 1e-6, 0.5, 1.2, 1.9, 3.1])
def test_a_prediction_far_off_pulls_as_in_numpy(turn: float) -> None:
    """The deviation from it is a large turn, beyond a right angle as well; in the first step."""
    given = problem(1, 0.0)
    far = g.se3_exp(np.array([0.3 * turn, turn, 0.1 * turn, 0.4, 0.0, 0.3]))
    moved = (*given[:3], given[5] @ g.inverse(far), *given[4:])
    found = [system for _, system, _ in fits(moved, "cauchy", 6, given[5], steps=1)]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("case", ["behind", "no match"])
def test_what_determines_no_pose_is_stated(case: str) -> None:
    given = problem(2, 0.1)
    behind = given[3] @ g.se3_exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    start = behind if case == "behind" else given[3]
    if case == "no match":
        none = (np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3)))
        given = (*none, given[3], np.zeros((6, 6)), given[5])
    for pose, _, state in fits(given, "cauchy", 6, start):
        np.testing.assert_array_equal(state, [1.0, 0.0])
        np.testing.assert_allclose(pose, start, rtol=0, atol=1e-12)
