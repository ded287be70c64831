"""Factors of homing against their specification, derivatives against finite differences."""

from __future__ import annotations

from collections.abc import Callable

import factor_specifications as residuals
import gtsam
import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import bearings
from fgslam.factors import bearing as f, bearing as r
from fgslam.factors.graphs import landmark_key, pose_key, target_key, velocity_key

POSE = np.array([1.2, -0.5, 0.7])
POINTS = np.array([[3.0, 2.0], [-1.0, 0.4], [1.5, -3.0], [1.1, 2.0]])
HEIGHTS = np.array([0.4, -0.8, 1.1, 0.2])


def differences(function: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """Central differences (m, n)."""
    step = 1e-6
    columns = [
        (function(at + step * unit) - function(at - step * unit)) / (2.0 * step)
        for unit in np.eye(len(at))
    ]
    return np.stack(columns, axis=-1)


def pose2(pose: FloatArray) -> gtsam.Pose2:
    return gtsam.Pose2(*pose)


def test_printed_equation_8_is_wrong_and_the_corrected_right() -> None:
    """True 14.14 degrees, as printed 92.80, sign corrected alone 2.33, order alone 94.35."""
    point = np.array([3.0, 2.0])
    corrected = bearings(POSE, point[None])[0]
    truth = np.arctan2(2.5, 1.8) - 0.7
    c, s = np.cos(0.7), np.sin(0.7)
    positive = np.array([[c, -s], [s, c]])
    readings = (
        positive @ point - POSE[:2],
        positive.T @ point - POSE[:2],
        positive @ (point - POSE[:2]),
    )
    angles = [np.rad2deg(np.arctan2(y, x)) for x, y in readings]
    assert corrected == pytest.approx(truth, abs=1e-15)
    np.testing.assert_allclose(np.rad2deg(corrected), 14.14, atol=0.005)
    np.testing.assert_allclose(angles, [92.80, 2.33, 94.35], atol=0.005)


def test_robot_and_target_models_are_one() -> None:
    target = np.array([np.hypot(1.2, -0.5), np.arctan2(-0.5, 1.2), 0.7])
    np.testing.assert_allclose(r.target_pose(target), POSE, atol=1e-15)
    offset = POINTS - r.target_pose(target)[:2]
    equation_9 = np.arctan2(offset[:, 1], offset[:, 0]) - target[2]
    np.testing.assert_allclose(r.bearing(POSE, POINTS, equation_9), 0.0, atol=1e-15)


def test_derivatives_of_bearings_and_elevations() -> None:
    zero = np.zeros(len(POINTS))
    by_pose, by_point = r.bearing_jacobians(POSE, POINTS)
    np.testing.assert_allclose(
        by_pose, differences(lambda p: r.bearing(p, POINTS, zero), POSE), atol=1e-8
    )
    up_pose, up_point, up_height = r.elevation_jacobians(POSE, POINTS, HEIGHTS)
    up = differences(lambda p: r.elevation(p, POINTS, HEIGHTS, zero), POSE)
    np.testing.assert_allclose(up_pose, up, atol=1e-8)
    for k, point in enumerate(POINTS):
        one = differences(lambda p: r.bearing(POSE, p[None], np.zeros(1)), point)
        np.testing.assert_allclose(by_point[k], one[0], atol=1e-8)
        tall = HEIGHTS[k : k + 1]
        one = differences(lambda p, h=tall: r.elevation(POSE, p[None], h, np.zeros(1)), point)
        np.testing.assert_allclose(up_point[k], one[0], atol=1e-8)
        one = differences(lambda h, p=point: r.elevation(POSE, p[None], h, np.zeros(1)), tall)
        np.testing.assert_allclose(up_height[k], one[0, 0], atol=1e-8)


def test_derivatives_by_polar_coordinates_are_d9() -> None:
    polar = np.array([2.0, 0.6])
    pose = POSE
    point = r.polar_points(polar[None])
    q = point[0] - pose[:2]
    squared = q @ q
    d9 = np.array(
        [
            (q[0] * np.sin(0.6) - q[1] * np.cos(0.6)) / squared,
            polar[0] * (q @ np.array([np.cos(0.6), np.sin(0.6)])) / squared,
        ]
    )
    chained = r.bearing_jacobians(pose, point)[1][0] @ r.polar_jacobians(polar[None])[0]
    np.testing.assert_allclose(chained, d9, atol=1e-14)
    target = np.array([1.3, -0.4, 0.7])
    by = r.bearing_jacobians(r.target_pose(target), POINTS)[0] @ r.target_jacobian(target)
    numeric = differences(
        lambda t: r.bearing(r.target_pose(t), POINTS, np.zeros(len(POINTS))), target
    )
    np.testing.assert_allclose(by, numeric, atol=1e-8)


def test_triangulation_is_exact_and_its_derivatives_right() -> None:
    theta, psi = 0.3, -0.5
    target = np.array([np.cos(theta), np.sin(theta), psi])
    start, end = bearings(np.zeros(3), POINTS), bearings(target, POINTS)
    distance, by = r.triangulated((theta, psi), start, end)
    np.testing.assert_allclose(distance, np.linalg.norm(POINTS, axis=1), rtol=1e-12)
    for k in range(len(POINTS)):
        inputs = np.array([theta, psi, start[k], end[k]])
        numeric = differences(lambda v: r.triangulated((v[0], v[1]), v[2:3], v[3:4])[0], inputs)
        np.testing.assert_allclose(by[k], numeric[0], rtol=1e-6)


def test_derivatives_of_the_initial_vector_and_of_elevation_pairs() -> None:
    _, by = r.direction_and_turn(POSE, 0.1, 0.2)
    numeric = differences(lambda p: r.direction_and_turn(p, 0.1, 0.2)[0], POSE)
    np.testing.assert_allclose(by, numeric, atol=1e-8)
    measured = np.array([0.2, 0.15])

    def pair(v: FloatArray) -> FloatArray:
        return np.array([r.elevation_pair(v[:3], v[3:5], v[5:])[0]])

    _, by_target, by_point, by_up = r.elevation_pair(POSE, POINTS[0], measured)
    numeric = differences(pair, np.concatenate([POSE, POINTS[0], measured]))
    np.testing.assert_allclose(np.concatenate([by_target, by_point, by_up]), numeric[0], atol=1e-8)


# --------------------------------------------------------------------------------------------
# GTSAM's side


def all_factors() -> list[tuple[object, FloatArray]]:
    """Factors with the residual that the specification gives at :func:`all_values`."""
    make = f.BearingFactors()
    x, t, landmark = pose_key(1), target_key(), landmark_key(0)
    point, target = POINTS[0], np.array([0.8, 0.3, 0.2])
    pair = np.array([0.2, 0.15])
    factors = (
        (make.bearing(x, landmark, 0.4, 0.1), r.bearing(POSE, point[None], np.array([0.4]))),
        (
            make.elevation_pair(t, landmark, pair, np.full(2, 0.01), np.append(target, point)),
            np.array([r.elevation_pair(target, point, pair)[0]]),
        ),
        (
            f.vector_factor(t, 0.5, 0.1, np.diag([0.01, 0.02])),
            r.direction_and_turn(target, 0.5, 0.1)[0],
        ),
    )
    return list(factors)


def all_values() -> gtsam.Values:
    values = gtsam.Values()
    values.insert(pose_key(1), pose2(POSE))
    values.insert(target_key(), gtsam.Pose2(0.8, 0.3, 0.2))
    values.insert(landmark_key(0), POINTS[0])
    return values


@pytest.mark.parametrize("row", range(3))
def test_factors_are_their_specification(row: int) -> None:
    factor, residual = all_factors()[row]
    np.testing.assert_allclose(factor.unwhitenedError(all_values()), residual, atol=1e-14)


@pytest.mark.parametrize("row", range(3))
def test_factors_linearise_as_they_move(row: int) -> None:
    factor, _ = all_factors()[row]
    values = all_values()
    whitened, _ = factor.linearize(values).jacobian()
    keys = list(factor.keys())
    sizes = {key: {"l": 2}.get(chr(gtsam.Symbol(key).chr()), 3) for key in keys}

    def moved(step: FloatArray) -> FloatArray:
        delta = gtsam.VectorValues()
        for key, part in zip(keys, np.split(step, np.cumsum([*sizes.values()])[:-1]), strict=True):
            delta.insert(key, part)
        whole: FloatArray = factor.whitenedError(values.retract(delta))
        return whole

    numeric = differences(moved, np.zeros(sum(sizes.values())))
    np.testing.assert_allclose(whitened, numeric, rtol=1e-6, atol=1e-6)


def test_motion_factor_is_white_noise_on_acceleration() -> None:
    before, after = np.array([0.2, 0.1, -0.3]), np.array([0.6, 0.15, 0.2])
    speed, next_speed = np.array([0.7, 0.05, 0.4]), np.array([0.9, -0.1, 0.6])
    density, step = np.array([0.01, 0.002, 0.5]), 0.4
    factor = f.motion_factor(
        (pose_key(0), velocity_key(0), 1.0), (pose_key(1), velocity_key(1), 1.0 + step), density
    )
    values = gtsam.Values()
    values.insert(pose_key(0), pose2(before))
    values.insert(pose_key(1), pose2(after))
    values.insert(velocity_key(0), speed)
    values.insert(velocity_key(1), next_speed)
    residual = residuals.constant_velocity(before, speed, after, next_speed, step)
    np.testing.assert_allclose(factor.unwhitenedError(values), residual, atol=1e-12)
    root = factor.noiseModel().R()
    covariance = np.linalg.inv(root.T @ root)
    expected = residuals.constant_velocity_covariance(density, step)
    np.testing.assert_allclose(covariance, expected, rtol=1e-9, atol=1e-12)


def test_leg_and_priors_hold_the_frame() -> None:
    values = gtsam.Values()
    values.insert(pose_key(0), gtsam.Pose2())
    values.insert(target_key(), gtsam.Pose2(0.6, 0.9, 0.2))
    leg = f.leg_factor(pose_key(0), target_key())
    np.testing.assert_allclose(leg.unwhitenedError(values), [np.hypot(0.6, 0.9) - 1.0])
    assert f.start_prior(pose_key(0)).error(values) == 0.0
