"""Range-bearing factors against their specification, on all of the sphere and at its seams.

GTSAM's bearing has tangent directions of its own, which jump; the sensor's azimuth jumps dead
astern and has no meaning at the poles. Neither may show.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import factor_specifications as residuals
import gtsam
import numpy as np
import pytest
from factor_checks import (
    assert_as_specified,
    assert_near,
    numerical_jacobian,
    random_covariance,
    random_pose,
    root_information,
    values_of,
)

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import RangeBearingSensor
from fgslam.factors.landmark import RangeBearingFactors, bearing_axes
from fgslam.factors.noise import Whitening

SENSOR = RangeBearingSensor(20.0, g.BODY_FORWARD_LEFT_UP_FROM_CAMERA)
UNEVEN = np.diag([0.03, 0.005, 0.04]) ** 2
EVEN = np.diag([0.02, 0.02, 0.05]) ** 2
# Azimuth and elevation beside every kind of seam of GTSAM's directions, and of the azimuth.
SEAMS = [(0.1, 0.1), (0.0, 0.0), (np.pi / 2, 1e-3), (-np.pi / 4, 0.01), (np.pi, 0.0), (-3.1, 0.04)]
SEAMS += [(np.pi / 4, np.arctan(np.sqrt(0.5))), (-2.4, -0.7), (0.785, 1.2)]
AN_ELEVATION = np.array([0.0, 0.02, 0.0])
CLEAR = [(0.5, 0.05), (1.0, -0.1), (-2.2, 0.15)]


def make(measured: FloatArray, covariance: FloatArray) -> Any:
    return RangeBearingFactors(Whitening()).factor(0, 1, measured, covariance)


def point_at(wTc: FloatArray, measured: FloatArray) -> FloatArray:
    return g.transform_to_world(wTc, g.triangulate(SENSOR, measured[None, :]))[0]


def on_sphere(measured: FloatArray, covariance: FloatArray) -> FloatArray:
    """The covariance along growing azimuth, growing elevation and range, to first order."""
    scale = np.array([np.cos(measured[1]), 1.0, 1.0])
    return covariance * np.outer(scale, scale)


def specified(wTc: FloatArray, point: FloatArray, measured: FloatArray) -> FloatArray:
    """Residual (3,) along the measured bearing's axes, and the range's."""
    turn = residuals.range_bearing_on_sphere(wTc, point, measured)
    return np.append(bearing_axes(measured)[:, :2].T @ turn[:3], turn[3])


def hessian(factor: Any, values: Any) -> tuple[FloatArray, FloatArray]:
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    return graph.linearize(values).hessian()


# --------------------------------------------------------------------------------------------
# The specification itself


def test_the_axes_are_the_measurements_derivatives() -> None:
    for azimuth, elevation in SEAMS + CLEAR:
        measured = np.array([azimuth, elevation, 1.0])
        axes = bearing_axes(measured)
        assert_near(axes.T @ axes, np.eye(3), 1e-15)
        step = 1e-6 * np.eye(3)
        by_azimuth, by_elevation = (
            (
                g.triangulate(SENSOR, (measured + step[i])[None, :])
                - g.triangulate(SENSOR, (measured - step[i])[None, :])
            )[0]
            / 2e-6
            for i in (0, 1)
        )
        assert_near(by_azimuth, np.cos(elevation) * axes[:, 0], 1e-9)
        assert_near(by_elevation, axes[:, 1], 1e-9)


def test_on_the_sphere_or_in_angles_residuals_agree_to_first_order(
    rng: np.random.Generator,
) -> None:
    """Their difference falls with the square of the residual, wherever azimuth has a meaning."""
    for azimuth, elevation in SEAMS + CLEAR:
        direction = rng.standard_normal(3)
        gap = []
        for size in (1e-2, 1e-3):
            measured = np.array([azimuth, elevation, 4.0])
            wTc = random_pose(rng)
            point = point_at(wTc, measured + size * direction)
            angles = residuals.range_bearing(SENSOR, wTc, point, measured)
            flat = angles * [np.cos(elevation), 1.0, 1.0]
            gap.append(float(np.abs(specified(wTc, point, measured) - flat).max()))
        assert gap[0] < 5.0 * 1e-4 * float(direction @ direction)
        assert gap[1] < 0.02 * gap[0] + 1e-14


# --------------------------------------------------------------------------------------------
# Factors


@pytest.mark.parametrize("covariance", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("place", SEAMS + CLEAR)
def test_information_at_the_truth_is_exact(
    place: tuple[float, float], covariance: FloatArray, rng: np.random.Generator
) -> None:
    measured = np.array([*place, 5.0])
    for _ in range(5):
        wTc = random_pose(rng, 3.0)
        point = point_at(wTc, measured)
        factor = make(measured, covariance)
        values = values_of(wTc, point)
        assert factor.error(values) < 1e-20
        residual = partial(residuals.range_bearing, SENSOR, measured=measured)
        root = root_information(covariance)
        a = root @ np.hstack([numerical_jacobian(residual, [wTc, point], i) for i in (0, 1)])
        information, gradient = hessian(factor, values)
        # The second-order term of the circle's radius is what is left: var(e) tan(e)^2.
        rounding = 1e-7 + covariance[1, 1] * np.tan(place[1]) ** 2
        assert_near(information, a.T @ a, rounding * np.abs(a.T @ a).max())
        assert_near(gradient, np.zeros(9), 1e-8 * np.abs(a).max())


def gtsams_residual(wTc: FloatArray, point: FloatArray, measured: FloatArray) -> FloatArray:
    """In C++: the turn back to the measured bearing, along the predicted one's directions."""
    local = g.transform_to_camera(wTc, point[None, :])[0]
    predicted = local / np.linalg.norm(local)
    back = residuals.turn_between(predicted, bearing_axes(measured)[:, 2])
    bearing = -gtsam.Unit3(predicted).basis().T @ back
    return np.append(bearing, np.linalg.norm(local) - measured[2])


def gtsams_covariance(measured: FloatArray, covariance: FloatArray) -> FloatArray:
    turn = np.eye(3)
    axes = bearing_axes(measured)
    turn[:2, :2] = gtsam.Unit3(axes[:, 2]).basis().T @ axes[:, :2]
    return turn @ on_sphere(measured, covariance) @ turn.T


@pytest.mark.parametrize("place", CLEAR)
def test_clear_of_seams_the_factor_is_gtsams(
    place: tuple[float, float], rng: np.random.Generator
) -> None:
    for _ in range(10):
        measured, wTc = np.array([*place, 5.0]), random_pose(rng, 3.0)
        covariance = random_covariance(rng, 3, 0.002)
        point = point_at(wTc, measured + 0.01 * rng.standard_normal(3))
        factor = make(measured, covariance)
        assert isinstance(factor, gtsam.BearingRangeFactor3D)
        # The circle's radius at elevation e has a second-order term, var(e) tan(e)^2.
        slack = covariance[1, 1] * np.tan(place[1]) ** 2 + 1e-10
        root = root_information(gtsams_covariance(measured, covariance))
        expected = root @ gtsams_residual(wTc, point, measured)
        found = factor.whitenedError(values_of(wTc, point))
        assert_near(found, expected, slack * max(1.0, np.abs(expected).max()) * 10.0)


@pytest.mark.parametrize("place", CLEAR)
def test_gtsams_jacobian_lacks_the_logarithms_which_is_a_second_order_effect(
    place: tuple[float, float], rng: np.random.Generator
) -> None:
    measured, wTc = np.array([*place, 5.0]), random_pose(rng)
    residual = partial(gtsams_residual, measured=measured)
    direction = rng.standard_normal(3)
    off = []
    for size in (0.04, 0.01):
        point = point_at(wTc, measured + size * direction)
        values = values_of(wTc, point)
        factor = gtsam.BearingRangeFactor3D(
            0,
            1,
            gtsam.Unit3(bearing_axes(measured)[:, 2]),
            measured[2],
            gtsam.noiseModel.Unit.Create(3),
        )
        a, _ = factor.linearize(values).jacobian()
        b = np.hstack([numerical_jacobian(residual, [wTc, point], i) for i in (0, 1)])
        off.append(np.abs(a - b).max())
    assert off[0] < float(direction @ direction) * 0.04
    assert off[1] < 0.4 * off[0]


@pytest.mark.parametrize("place", [(0.1, 0.1), (np.pi, 1e-3), (-np.pi / 2, 0.0), (0.785, 0.6155)])
@pytest.mark.parametrize("size", [0.0, 1e-6, 0.05, 0.6])
def test_at_seams_the_factor_is_a_camera_turned_to_the_bearing(
    place: tuple[float, float], size: float, rng: np.random.Generator
) -> None:
    for _ in range(5):
        measured, wTc = np.array([*place, 5.0]), random_pose(rng, 3.0)
        covariance = UNEVEN + random_covariance(rng, 3, 0.001)
        factor = make(measured, covariance)
        assert isinstance(factor, gtsam.GenericStereoFactor3D)
        point = point_at(wTc, measured + size * rng.uniform(-1.0, 1.0, 3))
        assert_as_specified(
            factor, partial(turned, measured=measured), [wTc, point], as_seen(measured, covariance)
        )


def turned(wTc: FloatArray, point: FloatArray, measured: FloatArray) -> FloatArray:
    """The specification in GTSAM's coordinates: (u_left, u_right, v), right and down."""
    right, up, inverse = residuals.range_bearing_as_image(wTc, point, measured)
    return np.array([right, right - inverse, -up])


def as_seen(measured: FloatArray, covariance: FloatArray) -> FloatArray:
    """The covariance in those coordinates."""
    elevation, distance = measured[1:]
    radius = np.cos(elevation) ** 2 + np.sin(elevation) ** 2 * covariance[1, 1]
    image = np.diag([np.sqrt(radius), 1.0, -1.0 / distance**2])
    jacobian = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, -1.0, 0.0]]) @ image
    return jacobian @ covariance @ jacobian.T


@pytest.mark.parametrize("place", SEAMS + CLEAR)
def test_the_cost_is_that_of_the_angles_to_first_order(
    place: tuple[float, float], rng: np.random.Generator
) -> None:
    """Whichever factor it is: filters and graphs mean the same by a measurement.

    The relative difference of the costs falls as the deviation; at one deviation it is small.
    """
    worst = {1.0: 0.0, 0.01: 0.0}
    for _ in range(20):
        measured, wTc = np.array([*place, 5.0]), random_pose(rng, 3.0)
        covariance = random_covariance(rng, 3, 0.003) + 0.2 * UNEVEN
        drawn = rng.standard_normal(3)
        off = np.linalg.cholesky(covariance) @ drawn / np.linalg.norm(drawn)
        for size in worst:
            point = point_at(wTc, measured + size * off)
            angles = residuals.range_bearing(SENSOR, wTc, point, measured)
            cost = 0.5 * float(angles @ np.linalg.solve(covariance, angles))
            found = make(measured, covariance).error(values_of(wTc, point))
            worst[size] = max(worst[size], abs(found / cost - 1.0))
    assert worst[1.0] < 0.15
    slack = covariance[1, 1] * np.tan(place[1]) ** 2  # the circle's second-order term
    assert worst[0.01] < 0.02 * worst[1.0] + 4.0 * slack + 1e-9


# --------------------------------------------------------------------------------------------
# Seams and singular places


def test_gtsams_own_factor_jumps_where_its_directions_do() -> None:
    """Why there is a turned camera. Were this to fail, it could go."""
    measured = np.array([0.1, 0.1, 5.0])
    bearing = gtsam.Unit3(bearing_axes(measured)[:, 2])
    model = gtsam.noiseModel.Gaussian.Covariance(gtsams_covariance(measured, UNEVEN))
    theirs = gtsam.BearingRangeFactor3D(0, 1, bearing, 5.0, model)
    ours = make(measured, UNEVEN)
    sideways = np.array([0.03, 0.0, 0.0])
    cost = {}
    for name, factor in {"theirs": theirs, "ours": ours}.items():
        places = [point_at(np.eye(4), measured + sign * sideways) for sign in (-1.0, 1.0)]
        cost[name] = [factor.error(values_of(np.eye(4), place)) for place in places]
    assert cost["ours"] == pytest.approx([0.5, 0.5], rel=0.01)  # one standard deviation
    assert max(cost["theirs"]) > 15.0
    assert min(cost["theirs"]) < 0.6


@pytest.mark.parametrize("covariance", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_residual_is_continuous_directly_behind_the_camera(covariance: FloatArray) -> None:
    """Azimuth pi - 0.001 measured, -pi + 0.001 expected: two milliradians off, not a whole turn."""
    measured = np.array([np.pi - 1e-3, 0.0, 5.0])
    point = point_at(np.eye(4), np.array([-np.pi + 1e-3, 0.0, 5.0]))
    factor = make(measured, covariance)
    expected = 0.5 * 0.002**2 / covariance[0, 0]
    assert factor.error(values_of(np.eye(4), point)) == pytest.approx(expected, rel=1e-4)
    found = residuals.range_bearing(SENSOR, np.eye(4), point, measured)
    assert_near(found, np.array([0.002, 0.0, 0.0]), 1e-12)


@pytest.mark.parametrize("elevation", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9])
@pytest.mark.parametrize("covariance", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_at_the_poles_the_landmark_is_known_to_second_order_sideways(
    elevation: float, covariance: FloatArray
) -> None:
    """Azimuth says little there: the circle's radius is the elevation's own deviation."""
    measured = np.array([0.7, elevation, 5.0])
    point = point_at(np.eye(4), measured)
    values = values_of(np.eye(4), point)
    factor = make(measured, covariance)
    assert factor.error(values) < 1e-12
    jacobian, rhs = factor.linearize(values).jacobian()
    assert np.isfinite(jacobian).all()
    assert np.isfinite(rhs).all()
    information, _ = hessian(factor, values)
    sideways = bearing_axes(measured)[:, 0]
    found = np.sqrt(1.0 / (sideways @ information[6:, 6:] @ sideways))
    sigma_a, sigma_e = np.sqrt(np.diagonal(covariance)[:2])
    assert found == pytest.approx(5.0 * sigma_a * sigma_e, rel=1e-4)


@pytest.mark.parametrize("place", [(0.1, 0.1), (0.5, 0.05)], ids=["turned", "gtsam"])
def test_the_opposite_bearing_is_finite(place: tuple[float, float]) -> None:
    measured = np.array([*place, 5.0])
    factor = make(measured, UNEVEN)
    values = values_of(np.eye(4), -point_at(np.eye(4), measured))
    error = factor.unwhitenedError(values)
    if isinstance(factor, gtsam.BearingRangeFactor3D):
        assert np.linalg.norm(error[:2]) == pytest.approx(np.pi, rel=1e-6)
    else:
        assert_near(error, np.full(3, 2.0), 0.0)
        point = -point_at(np.eye(4), measured)
        assert_near(turned(np.eye(4), point, measured), error, 0.0)
    jacobian, rhs = factor.linearize(values).jacobian()
    assert np.isfinite(jacobian).all()
    assert np.isfinite(rhs).all()


def test_turns_on_the_sphere() -> None:
    x, y, _ = np.eye(3)
    assert_near(residuals.turn_between(x, y), np.pi / 2 * y, 1e-15)
    assert_near(residuals.turn_between(x, x), np.zeros(3), 0.0)
    back = residuals.turn_between(x, -x)
    assert np.linalg.norm(back) == pytest.approx(np.pi, abs=1e-15)
    assert abs(back @ x) < 1e-15


def test_a_planar_sensor_with_equal_noise_stays_in_cpp() -> None:
    """Real recordings are such: no Python in the hot path."""
    for azimuth in np.linspace(-np.pi, np.pi, 101):
        factor = make(np.array([azimuth, 0.0, 3.0]), EVEN)
        assert isinstance(factor, gtsam.BearingRangeFactor3D)


def test_a_robust_kernel_sees_all_three_numbers_of_either_factor() -> None:
    kernel = Whitening("huber", 1.0)
    for place in [(0.1, 0.1), (0.5, 0.05)]:
        measured = np.array([*place, 5.0])
        values = values_of(np.eye(4), point_at(np.eye(4), np.array([*place, 5.16]) + AN_ELEVATION))
        plain = make(measured, UNEVEN).error(values)
        robust = RangeBearingFactors(kernel).factor(0, 1, measured, UNEVEN).error(values)
        norm = np.sqrt(2.0 * plain)
        assert norm > 4.0
        assert robust == pytest.approx(norm - 0.5, rel=1e-9)
