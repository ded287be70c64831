"""Pixels to bearings and elevations with their covariance."""

from __future__ import annotations

import numpy as np

from fgslam.cameras.omni.protocol import OmniCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.planar import wrap

_STEP_PX = 0.05  # of the central difference: its error is a millionth of the derivative


def unit_rays(bearing: FloatArray, elevation: FloatArray) -> FloatArray:
    """(n, 3) rays of bearings and elevations (n,), radians; the inverse of :func:`angles_of`."""
    level = np.cos(elevation)
    return np.column_stack([level * np.cos(bearing), level * np.sin(bearing), np.sin(elevation)])


def angles_of(rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bearings and elevations (n,) of rays (n, 3), radians."""
    bearing = np.arctan2(rays[:, 1], rays[:, 0])
    elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    return bearing, elevation


def measure(
    camera: OmniCamera, pixels: FloatArray, sigma_px: float | FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What pixels measure, to first order in their noise.

    Args:
        camera: that took the image.
        pixels: (n, 2).
        sigma_px: standard deviation of each coordinate in pixels, one number or (n,).

    Returns:
        Bearing (n,) and elevation (n,) in radians, and covariance (n, 2, 2) of both; NaN outside
        the field of view. At its very border the derivative is one-sided.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    n = len(pixels)
    offsets = _STEP_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=np.float64)
    bearing, elevation = angles_of(camera.rays((offsets[:, None] + pixels[None]).reshape(-1, 2)))
    bearings, elevations = bearing.reshape(5, n), elevation.reshape(5, n)
    jacobian = np.empty((n, 2, 2))
    for axis in range(2):
        plus, minus = 1 + 2 * axis, 2 + 2 * axis
        jacobian[:, 0, axis] = _slope(bearings[[plus, 0, minus]])
        jacobian[:, 1, axis] = _slope(elevations[[plus, 0, minus]])
    variance = np.broadcast_to(np.square(sigma_px), (n,))
    covariance = (jacobian @ jacobian.transpose(0, 2, 1)) * variance[:, None, None]
    return bearings[0], elevations[0], covariance


def _slope(values: FloatArray) -> FloatArray:
    """(n,) derivative from (3, n) angles after, at and before; one-sided where one is NaN."""
    after, before = wrap(values[0] - values[1]), wrap(values[1] - values[2])
    both = 0.5 * (after + before)
    return np.asarray(
        np.where(np.isfinite(both), both, np.where(np.isfinite(after), after, before)) / _STEP_PX
    )
