"""Constant velocity between many planar poses at once, with derivatives by poses and velocities.

The specification is :func:`fgslam.factors.bearing_residuals.constant_velocity`; GTSAM's factor is
``WnoaMotionFactorPose2``.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import between

_SMALL = 1e-2  # radians: below it the series of the cotangent is exact to rounding


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
