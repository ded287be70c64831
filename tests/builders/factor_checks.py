"""A GTSAM factor beside its specification in factor_specifications: values, cost, Jacobian."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import CameraRig

UNEVEN_RIG = CameraRig(
    width=640,
    height=480,
    fx=410.0,
    fy=395.0,
    cx=321.5,
    cy=236.25,
    baseline=0.12,
    vertical_baseline=0.09,
    bTc=g.pose(g.so3_exp(np.array([0.3, -1.1, 0.4])), np.array([0.2, -0.1, 0.7])),
)
"""Nothing equal or central in it, and a camera that looks down and sideways from the robot."""


def random_pose(rng: np.random.Generator, angle: float = 1.0) -> FloatArray:
    """Somewhere within a few metres, turned by about ``angle``."""
    axis = rng.standard_normal(3)
    turn = angle * rng.uniform(0.2, 1.0) * axis / np.linalg.norm(axis)
    return g.pose(g.so3_exp(turn), 2.0 * rng.standard_normal(3))


def random_covariance(rng: np.random.Generator, n: int, size: float = 1.0) -> FloatArray:
    """Full and well conditioned."""
    a = rng.standard_normal((n, n))
    return np.asarray(size**2 * (a @ a.T + 0.3 * np.eye(n)))


def values_of(*variables: FloatArray) -> Any:
    """Poses (4, 4) and points (3,) under the keys 0, 1, ..."""
    values = gtsam.Values()
    for key, variable in enumerate(variables):
        values.insert(key, gtsam.Pose3(variable) if variable.ndim == 2 else variable)
    return values


def root_information(covariance: FloatArray) -> FloatArray:
    """The upper triangular R with R^T R the inverse of a covariance: what GTSAM whitens by."""
    return np.linalg.cholesky(np.linalg.inv(covariance)).T


def moved(variable: FloatArray, tangent: FloatArray) -> FloatArray:
    """``T * Exp(xi)`` of a pose, ``p + xi`` of a point."""
    return variable @ g.se3_exp(tangent) if variable.ndim == 2 else variable + tangent


def numerical_jacobian(
    residual: Callable[..., FloatArray], variables: list[FloatArray], which: int
) -> FloatArray:
    """Derivative of a residual by the tangent of one variable; central differences, extrapolated.

    Two steps and Richardson's combination: errors of the fourth order in the step.
    """

    def at(tangent: FloatArray) -> FloatArray:
        changed = list(variables)
        changed[which] = moved(variables[which], tangent)
        return np.atleast_1d(residual(*changed))

    def central(axis: FloatArray, step: float) -> FloatArray:
        return (at(step * axis) - at(-step * axis)) / (2.0 * step)

    axes = np.eye(6 if variables[which].ndim == 2 else 3)
    columns = [(4.0 * central(axis, 5e-5) - central(axis, 1e-4)) / 3.0 for axis in axes]
    return np.stack(columns, axis=1)


def assert_as_specified(
    factor: Any,
    residual: Callable[..., FloatArray],
    variables: list[FloatArray],
    covariance: FloatArray,
) -> None:
    """Whitened error and cost to 1e-10, Jacobians to 1e-7, each relative to its largest number."""
    values = values_of(*variables)
    root = root_information(covariance)
    expected = root @ residual(*variables)
    scale = max(1.0, np.abs(expected).max())
    assert_near(factor.whitenedError(values), expected, 1e-10 * scale)
    cost = 0.5 * float(expected @ expected)
    assert abs(factor.error(values) - cost) <= 1e-10 * max(1.0, cost)
    a, b = factor.linearize(values).jacobian()
    assert_near(b, -expected, 1e-10 * scale)
    by_variable = [numerical_jacobian(residual, variables, i) for i in range(len(variables))]
    jacobian = root @ np.hstack(by_variable)
    assert_near(a, jacobian, 1e-7 * np.abs(jacobian).max())


def assert_near(found: FloatArray, expected: FloatArray, tolerance: float) -> None:
    """Equal up to an absolute tolerance."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
