"""Bearings and elevations in the plane, as pure functions with their derivatives.

The specification of the factors of homing and the measurement model of its filter: eqs 7 to 9 as
corrected in sign and order. Residuals are *predicted minus measured*. Poses are (x, y, psi)
arrays and derivatives are by these three numbers, not in a tangent space.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import bearings, between, rotation, unit, wrap

_SMALL = 1e-5  # radians: below it the series of the logarithm is exact to rounding


def bearing(pose: FloatArray, points: FloatArray, measured: FloatArray) -> FloatArray:
    """(n,) residuals, wrapped, of bearings (n,) to points (n, 2) from a pose (eqs 7, 9)."""
    return wrap(bearings(pose, points) - measured)


def bearing_jacobians(pose: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of bearings by the pose, (n, 3), and by their points, (n, 2)."""
    offset = points - pose[:2]
    squared = np.einsum("ij,ij->i", offset, offset)[:, None]
    across = np.column_stack([-offset[:, 1], offset[:, 0]]) / squared
    return np.column_stack([-across, np.full(len(points), -1.0)]), across


def polar_points(polar: FloatArray) -> FloatArray:
    """(n, 2) points of (distance, bearing) rows (n, 2): P = d u(delta)."""
    return np.asarray(polar[:, :1] * unit(polar[:, 1]))


def polar_jacobians(polar: FloatArray) -> FloatArray:
    """(n, 2, 2) derivatives of :func:`polar_points` by (distance, bearing)."""
    along = unit(polar[:, 1])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    return np.stack([along, polar[:, :1] * across], axis=-1)


def target_pose(target: FloatArray) -> FloatArray:
    """(3,) pose (x_t, y_t, psi_t) of (D_t, theta_t, psi_t): what eq. 9 leaves unsaid."""
    return np.append(target[0] * unit(target[1]), target[2])


def target_jacobian(target: FloatArray) -> FloatArray:
    """(3, 3) derivative of :func:`target_pose`."""
    out = np.eye(3)
    out[:2, :2] = polar_jacobians(target[None, :2])[0]
    return out


def elevation(
    pose: FloatArray, points: FloatArray, heights: FloatArray, measured: FloatArray
) -> FloatArray:
    """(n,) residuals of elevations of points (n, 2) at heights (n,) above the camera's plane."""
    distance = np.linalg.norm(points - pose[:2], axis=1)
    return np.asarray(np.arctan2(heights, distance) - measured)


def elevation_jacobians(
    pose: FloatArray, points: FloatArray, heights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives by the pose, (n, 3), by the points, (n, 2), and by the heights, (n,)."""
    offset = points - pose[:2]
    distance = np.linalg.norm(offset, axis=1)
    squared = distance**2 + heights**2
    by_point = -(heights / (squared * distance))[:, None] * offset
    return np.column_stack([-by_point, np.zeros(len(points))]), by_point, distance / squared


def elevation_pair(
    target: FloatArray, point: FloatArray, elevations: FloatArray
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Elevation from the target of a landmark whose height the one from the start gives.

    The height d tan(alpha) is put in, d the distance from the start: the two elevations' factors
    with the height eliminated, to first order.

    Args:
        target: (3,) pose; the start is the origin.
        point: (2,) landmark.
        elevations: (2,) measured from start and target, radians.

    Returns:
        Residual, radians; its derivatives by target (3,), point (2,) and both elevations (2,).
    """
    pose, tangent = np.asarray(target), np.tan(elevations[0])
    distance = np.hypot(*point)
    height = np.array([distance * tangent])
    by_pose, by_point, by_height = elevation_jacobians(pose, point[None], height)
    residual = elevation(pose, point[None], height, elevations[1:])[0]
    raised = by_height[0] * tangent / distance * point
    by_elevations = np.array([by_height[0] * distance * (1.0 + tangent**2), -1.0])
    return float(residual), by_pose[0], by_point[0] + raised, by_elevations


def direction_and_turn(
    target: FloatArray, direction: float, turn: float
) -> tuple[FloatArray, FloatArray]:
    """What the initialisation measured of the target's pose (III-B): residual and derivative.

    Args:
        target: (3,) pose in the start frame.
        direction: theta, radians.
        turn: psi, radians.

    Returns:
        (2,) wrapped residuals and (2, 3) derivative.
    """
    x, y, psi = target
    residual = wrap(np.array([np.arctan2(y, x) - direction, psi - turn]))
    squared = x**2 + y**2
    return residual, np.array([[-y / squared, x / squared, 0.0], [0.0, 0.0, 1.0]])


# --------------------------------------------------------------------------------------------
# Triangulation from start and target (III-C)


def triangulated(
    vector: tuple[float, float], start: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances from the start, in legs, and their derivatives.

    Args:
        vector: (theta, psi).
        start: (n,) delta, bearings from the start.
        target: (n,) delta', bearings from the target.

    Returns:
        (n,) distances d, not positive where the rays do not meet; (n, 4) derivatives by (theta,
        psi, delta, delta'). Parallel rays give values that are not finite.
    """
    theta, psi = vector
    seen = target + psi
    with np.errstate(divide="ignore", invalid="ignore"):
        sine = np.sin(seen - start)
        distance = np.sin(seen - theta) / sine
        by_target = np.sin(theta - start) / sine**2
        by_start = distance * np.cos(seen - start) / sine
        by_direction = -np.cos(seen - theta) / sine
    return distance, np.column_stack([by_direction, by_target, by_start, by_target])


# --------------------------------------------------------------------------------------------
# Motion


def constant_velocity(
    before: FloatArray, speed: FloatArray, after: FloatArray, next_speed: FloatArray, step: float
) -> FloatArray:
    """Residual (6,) of white noise on acceleration between two poses (Barfoot 2017, 11.1).

    Args:
        before: (3,) pose.
        speed: (3,) velocity there, in the robot's own axes: forward, left, turning.
        after: (3,) pose.
        next_speed: (3,) velocity there.
        step: seconds between them.
    """
    moved = se2_log(between(before, after))
    carried = _log_derivative(moved) @ next_speed
    return np.concatenate([moved - step * speed, carried - speed])


def constant_velocity_covariance(density: FloatArray, step: float) -> FloatArray:
    """(6, 6) covariance of it, of densities (3,) of accelerations forward, left and turning."""
    powers = np.array([[step**3 / 3.0, step**2 / 2.0], [step**2 / 2.0, step]])
    return np.kron(powers, np.diag(density))


def se2_log(motion: FloatArray) -> FloatArray:
    """Tangent vector (3,), [translation, rotation], of a planar motion (x, y, psi)."""
    half = 0.5 * motion[2]
    cotangent = 1.0 - half**2 / 3.0 if abs(half) < _SMALL else half / np.tan(half)
    straight = np.array([[cotangent, half], [-half, cotangent]])
    return np.append(straight @ motion[:2], motion[2])


def _log_derivative(tangent: FloatArray) -> FloatArray:
    """(3, 3) derivative of the logarithm by a step on the right of the motion.

    The logarithm is (M(w) t, w) of a motion (t, w); a step (a, b) makes it (t + R(w) a, w + b).
    """
    w = tangent[2]
    half = 0.5 * w
    if abs(half) < _SMALL:
        cotangent, slope = 1.0 - half**2 / 3.0, -w / 6.0
    else:
        cotangent = half / np.tan(half)
        slope = 0.5 * (1.0 / np.tan(half) - half / np.sin(half) ** 2)
    straight = np.array([[cotangent, half], [-half, cotangent]])
    by_turn = np.array([[slope, 0.5], [-0.5, slope]])
    moved = np.linalg.solve(straight, tangent[:2])
    out = np.eye(3)
    out[:2, :2] = straight @ rotation(w)
    out[:2, 2] = by_turn @ moved
    return out
