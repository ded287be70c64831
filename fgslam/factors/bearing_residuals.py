"""Bearings, elevations and motion in the plane, as pure functions with their derivatives.

The specification of the factors of homing and the measurement model of its filter: eqs 7 to 9 as
corrected in sign and order. Residuals are *predicted minus measured*. Poses are (x, y, psi)
arrays and derivatives are by these three numbers, not in a tangent space.
"""

from __future__ import annotations

import math

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import bearings, between, unit, wrap

_SMALL = 1e-2  # radians: below it the series of the cotangent is exact to rounding


def bearing(pose: FloatArray, points: FloatArray, measured: FloatArray) -> FloatArray:
    """(n,) residuals, wrapped, of bearings (n,) to points (n, 2) from a pose (eqs 7, 9)."""
    return wrap(bearings(pose, points) - measured)


def bearing_jacobians(pose: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of bearings by the pose, (n, 3), and by their points, (n, 2)."""
    offset = points - pose[:2]
    squared = np.einsum("ij,ij->i", offset, offset)
    by_pose, across = np.empty((len(points), 3)), np.empty((len(points), 2))
    np.divide(-offset[:, 1], squared, out=across[:, 0])
    np.divide(offset[:, 0], squared, out=across[:, 1])
    by_pose[:, :2], by_pose[:, 2] = -across, -1.0
    return by_pose, across


def polar_points(polar: FloatArray) -> FloatArray:
    """(n, 2) points of (distance, bearing) rows (n, 2): P = d u(delta)."""
    return np.asarray(polar[:, :1] * unit(polar[:, 1]))


def polar_jacobians(polar: FloatArray) -> FloatArray:
    """(n, 2, 2) derivatives of :func:`polar_points` by (distance, bearing)."""
    along = unit(polar[:, 1])
    out = np.empty((len(polar), 2, 2))
    out[:, :, 0] = along
    out[:, 0, 1], out[:, 1, 1] = -polar[:, 0] * along[:, 1], polar[:, 0] * along[:, 0]
    return out


def target_pose(target: FloatArray) -> FloatArray:
    """(3,) pose (x_t, y_t, psi_t) of (D_t, theta_t, psi_t): what eq. 9 leaves unsaid."""
    distance, direction, turn = target.tolist()
    return np.array([distance * math.cos(direction), distance * math.sin(direction), turn])


def target_jacobian(target: FloatArray) -> FloatArray:
    """(3, 3) derivative of :func:`target_pose`."""
    distance, direction, _ = target.tolist()
    c, s = math.cos(direction), math.sin(direction)
    return np.array([[c, -distance * s, 0.0], [s, distance * c, 0.0], [0.0, 0.0, 1.0]])


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
# Many views of the same points


def offsets(views: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(v, m) of points from views, along x and y."""
    return points[:, 0] - views[:, :1], points[:, 1] - views[:, 1:2]


def bearings_from_views(
    dx: FloatArray, dy: FloatArray, squared: FloatArray, numbers: int
) -> tuple[FloatArray, FloatArray]:
    """(v, m, 3) and (v, m, 2 or 3) derivatives of bearings by poses and points."""
    by_pose, by_point = np.empty((*dx.shape, 3)), np.zeros((*dx.shape, numbers))
    by_point[..., 0], by_point[..., 1] = -dy / squared, dx / squared
    by_pose[..., :2], by_pose[..., 2] = -by_point[..., :2], -1.0
    return by_pose, by_point


def elevations_from_views(
    dx: FloatArray, dy: FloatArray, squared: FloatArray, heights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The same of elevations of points at heights (m,)."""
    distance = np.sqrt(squared)
    whole = squared + heights**2
    by_pose, by_point = np.zeros((*dx.shape, 3)), np.empty((*dx.shape, 3))
    down = heights / (whole * distance)
    by_pose[..., 0], by_pose[..., 1] = down * dx, down * dy
    by_point[..., :2], by_point[..., 2] = -by_pose[..., :2], distance / whole
    return by_pose, by_point


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
# Motion: constant velocity between many poses at once; GTSAM's factor is WnoaMotionFactorPose2


def constant_velocities(
    poses: FloatArray, speeds: FloatArray, steps: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals and derivatives of a chain.

    Args:
        poses: (n + 1, 3) in the order of time.
        speeds: (n + 1, 3) velocities there, in the robot's own axes: forward, left, turning.
        steps: (n,) seconds between them.

    Returns:
        (n, 6) residuals, and (n, 6, 6) derivatives by (pose, velocity) before and after.
    """
    moved = between(poses[:-1], poses[1:])
    flat, derivative, curve = _log_terms(moved[:, 2])
    residual, by_moved, by_speed = _by_motion(moved, speeds[1:], (flat, derivative, curve))
    residual[:, :3] -= steps[:, None] * speeds[:-1]
    residual[:, 3:] -= speeds[:-1]
    by_before, by_after = _by_poses(poses[:-1], moved)
    before, after = np.zeros((2, len(steps), 6, 6))
    before[:, :, :3], after[:, :, :3] = by_moved @ by_before, by_moved @ by_after
    every = np.arange(3)
    before[:, every, 3 + every] = -steps[:, None]
    before[:, 3 + every, 3 + every] = -1.0
    after[:, 3:, 3:] = by_speed
    return residual, before, after


def motion_informations(steps: FloatArray, density: FloatArray) -> FloatArray:
    """(n, 6, 6) inverse covariances, of steps (n,) and the accelerations' densities (3,)."""
    place, cross, speed = 12.0 / steps**3, -6.0 / steps**2, 4.0 / steps
    powers = np.stack([place, cross, cross, speed], axis=-1).reshape(-1, 2, 2)
    return np.asarray(np.einsum("nab,ij->naibj", powers, np.diag(1.0 / density)).reshape(-1, 6, 6))


def _by_motion(
    moved: FloatArray, speed: FloatArray, terms: tuple[FloatArray, FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(Log m, J(m) v) with derivatives (n, 6, 3) by the motion m and J (n, 3, 3), that by v.

    Log m = (M(w) t, w) of m = (t, w), and J = [M R(w), M' t; 0, 1].
    """
    straight, derivative, curve = terms
    t, w = moved[:, :2, None], moved[:, 2]
    c, s = np.cos(w), np.sin(w)
    turn = np.stack([c, -s, s, c], axis=-1).reshape(-1, 2, 2)
    ahead = turn @ speed[:, :2, None]
    aside = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)  # of R' = R rotated by 90 degrees
    rate = speed[:, 2, None, None]
    bent = derivative @ t
    residual, by_moved = np.empty((len(moved), 6)), np.zeros((len(moved), 6, 3))
    residual[:, :2] = (straight @ t)[..., 0]
    residual[:, 2], residual[:, 5] = w, speed[:, 2]
    residual[:, 3:5] = (straight @ ahead + bent * rate)[..., 0]
    by_moved[:, :2, :2], by_moved[:, :2, 2] = straight, bent[..., 0]
    by_moved[:, 2, 2] = 1.0
    by_moved[:, 3:5, :2] = derivative * rate
    by_turn = derivative @ ahead + straight @ aside + curve * t * rate
    by_moved[:, 3:5, 2] = by_turn[..., 0]
    by_speed = np.zeros((len(moved), 3, 3))
    by_speed[:, :2, :2], by_speed[:, :2, 2], by_speed[:, 2, 2] = straight @ turn, bent[..., 0], 1.0
    return residual, by_moved, by_speed


def _log_terms(w: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M(w) = [k, w/2; -w/2, k], k = w/2 cot(w/2): (n, 2, 2); M'; and k'' (n, 1, 1)."""
    half = 0.5 * w
    small = np.abs(half) < _SMALL
    safe = np.where(small, 1.0, half)
    tangent, sine = np.tan(safe), np.sin(safe)
    square = half**2
    k = np.where(small, 1.0 - square / 3.0 - square**2 / 45.0, safe / tangent)
    series = -half / 3.0 - 2.0 / 45.0 * half * square
    slope = np.where(small, series, 0.5 * (1.0 / tangent - safe / sine**2))
    curve = np.where(small, -1.0 / 6.0 - square / 15.0, 0.5 * (safe / tangent - 1.0) / sine**2)
    fixed = np.full_like(w, 0.5)
    straight = np.stack([k, half, -half, k], axis=-1).reshape(-1, 2, 2)
    derivative = np.stack([slope, fixed, -fixed, slope], axis=-1).reshape(-1, 2, 2)
    return straight, derivative, curve[:, None, None]


def _by_poses(before: FloatArray, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3, 3) derivatives of a motion by both its poses."""
    c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
    by_before, by_after = np.zeros((2, len(before), 3, 3))
    by_after[:, 0, 0], by_after[:, 0, 1] = c, s
    by_after[:, 1, 0], by_after[:, 1, 1] = -s, c
    by_after[:, 2, 2] = 1.0
    by_before[:, :2, :2] = -by_after[:, :2, :2]
    by_before[:, 0, 2], by_before[:, 1, 2] = moved[:, 1], -moved[:, 0]
    by_before[:, 2, 2] = -1.0
    return by_before, by_after
