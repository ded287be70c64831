"""Laws of the factors over all poses and measurements: nothing depends on where the world is."""

from __future__ import annotations

from typing import Any

import factor_specifications as residuals
import gtsam
import numpy as np
from factor_checks import values_of
from hypothesis import assume, example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from simulated import RIG

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import Odometry
from fgslam.core.types import Floor
from fgslam.factors.landmark import StereoFactors
from fgslam.factors.motion import floor_factors, odometry_factor
from fgslam.factors.noise import Whitening, positive_definite


def vectors(size: float, n: int = 3) -> st.SearchStrategy[FloatArray]:
    return arrays(np.float64, n, elements=st.floats(-size, size, allow_subnormal=False))


@st.composite
def poses(draw: st.DrawFn) -> FloatArray:
    return g.pose(g.so3_exp(draw(vectors(1.8))), draw(vectors(50.0)))


@st.composite
def verticals(draw: st.DrawFn) -> FloatArray:
    down = draw(vectors(1.0))
    assume(np.linalg.norm(down) > 1e-2)
    return down / np.linalg.norm(down)


@st.composite
def covariances(draw: st.DrawFn, sigma: float, n: int = 3) -> FloatArray:
    """Full, of condition numbers up to a million."""
    root = sigma * draw(arrays(np.float64, (n, n), elements=st.floats(-1.0, 1.0)))
    return np.asarray(root @ root.T + (1e-3 * sigma) ** 2 * np.eye(n))


def cost(factor: Any, *variables: FloatArray) -> float:
    return float(factor.error(values_of(*variables)))


def close(a: float, b: float, relative: float = 1e-6, absolute: float = 1e-9) -> bool:
    return abs(a - b) <= absolute + relative * max(abs(a), abs(b))


@given(poses(), vectors(1.0), covariances(0.5), poses())
def test_a_stereo_factor_is_its_specification_and_knows_no_world(
    wTc: FloatArray, offset: FloatArray, covariance: FloatArray, move: FloatArray
) -> None:
    local = np.array([0.3, -0.2, 2.5]) + offset
    point = g.transform_to_world(wTc, local[None, :])[0]
    measured = g.project(RIG, local[None, :])[0] + [1.0, -0.5, 0.3]
    factor = StereoFactors(RIG, Whitening()).factor(0, 1, measured, covariance)
    residual = residuals.stereo(RIG, wTc, point, measured)
    found = cost(factor, wTc, point)
    assert close(found, 0.5 * float(residual @ np.linalg.solve(covariance, residual)))
    elsewhere = g.transform_to_world(move, point[None, :])[0]
    assert close(found, cost(factor, move @ wTc, elsewhere))


@given(poses(), poses(), vectors(0.3, 6), poses())
def test_odometry_knows_no_world(
    before: FloatArray, motion: FloatArray, off: FloatArray, move: FloatArray
) -> None:
    after = before @ motion @ g.se3_exp(off)
    factor = odometry_factor(0, 1, Odometry(motion, 0.01 * np.eye(6)))
    found = cost(factor, before, after)
    assert close(found, 50.0 * float(off @ off), absolute=1e-8)
    assert close(found, cost(factor, move @ before, move @ after), absolute=1e-8)


@given(verticals(), poses(), st.floats(-np.pi, np.pi), vectors(50.0, 2))
def test_a_floor_costs_nothing_on_it_and_the_same_everywhere_at_a_heading(
    down: FloatArray, wTc: FloatArray, heading: float, shift: FloatArray
) -> None:
    """Sliding over the floor changes nothing; nor does turning, factor and pose together."""
    floor = Floor(3, down, False, 0.01, 0.01)
    on_it = floor.constrain(wTc)
    along = g.pose(g.so3_exp(heading * down), floor.horizontal @ shift)
    for here, there in zip(
        floor_factors(0, floor, wTc), floor_factors(0, floor, along @ wTc), strict=True
    ):
        assert cost(here, on_it) < 1e-12 * 50.0**2 / 0.01**2
        assert close(cost(here, wTc), cost(there, along @ wTc), absolute=1e-6)


ROUNDED_ABOVE_ZERO = np.array(
    [
        [0.0, 0.1114, 0.25],
        [1.0, 0.25, -1.0],
        [0.25, 0.25, 1.0],
        [0.25, 0.25, 0.25],
        [0.25, 0.25, 0.25],
        [0.25, 0.45263569, 0.25],
    ]
)
"""Root of a covariance of rank three whose smallest computed eigenvalue can be positive."""


@given(arrays(np.float64, (6, 3), elements=st.floats(-1.0, 1.0)), st.floats(1e-9, 1e3))
@example(ROUNDED_ABOVE_ZERO, 941.0)
def test_a_singular_covariance_becomes_definite_and_never_smaller(
    root: FloatArray, size: float
) -> None:
    covariance = size**2 * root @ root.T
    found = positive_definite(covariance)
    largest = max(float(np.linalg.eigvalsh(covariance)[-1]), 1e-12)
    gtsam.noiseModel.Gaussian.Covariance(found)
    assert np.linalg.eigvalsh(found)[0] > 0.5e-12
    assert np.linalg.eigvalsh(found - covariance)[0] > -1e-14 * largest
    assert np.linalg.eigvalsh(found - covariance)[-1] <= 1.01 * max(1e-12, 1e-6 * largest)
