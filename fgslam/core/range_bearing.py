"""The range-bearing sensor's equations; :mod:`fgslam.core.geometry` chooses between the sensors.

Points are (n, 3) in the sensor's frame, axes as a camera's (x right, y down, z forward), metres;
measurements (azimuth, elevation, range), radians and metres, as in
:class:`fgslam.core.sensors.RangeBearingSensor`. Derived in docs/derivations/range_bearing.md.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray


def project(points: FloatArray) -> FloatArray:
    """(azimuth, elevation, range) (n, 3) of points off the sensor's vertical axis."""
    x, y, z = points.T
    level = np.hypot(x, z)
    return np.column_stack([np.arctan2(x, z), np.arctan2(-y, level), np.hypot(level, y)])


def projection_jacobian(points: FloatArray) -> FloatArray:
    """d(azimuth, elevation, range)/d(point) (n, 3, 3), off the sensor's vertical axis."""
    x, y, z = points.T
    level2 = x * x + z * z
    level = np.sqrt(level2)
    distance2 = level2 + y * y
    distance = np.sqrt(distance2)
    out = np.zeros((len(points), 3, 3))
    out[:, 0, 0] = z / level2
    out[:, 0, 2] = -x / level2
    out[:, 1, 0] = x * y / (level * distance2)
    out[:, 1, 1] = -level / distance2
    out[:, 1, 2] = z * y / (level * distance2)
    out[:, 2] = points / distance[:, None]
    return out


def triangulate(measurement: FloatArray) -> FloatArray:
    """Points (n, 3) of (azimuth, elevation, range) (n, 3); the inverse of :func:`project`."""
    azimuth, elevation, distance = measurement.T
    level = distance * np.cos(elevation)
    return np.column_stack(
        [level * np.sin(azimuth), -distance * np.sin(elevation), level * np.cos(azimuth)]
    )


def triangulation_jacobian(measurement: FloatArray) -> FloatArray:
    """d(point)/d(azimuth, elevation, range) (n, 3, 3)."""
    azimuth, elevation, distance = measurement.T
    sin_a, cos_a = np.sin(azimuth), np.cos(azimuth)
    sin_e, cos_e = np.sin(elevation), np.cos(elevation)
    out = np.zeros((len(measurement), 3, 3))
    out[:, 0, 0], out[:, 2, 0] = distance * cos_e * cos_a, -distance * cos_e * sin_a
    out[:, 0, 1], out[:, 2, 1] = -distance * sin_e * sin_a, -distance * sin_e * cos_a
    out[:, 1, 1] = -distance * cos_e
    out[:, 0, 2], out[:, 1, 2], out[:, 2, 2] = cos_e * sin_a, -sin_e, cos_e * cos_a
    return out


def level_distance(points: FloatArray) -> FloatArray:
    """Distances (n,) from the sensor's vertical axis, on which the azimuth is undefined."""
    return np.hypot(points[:, 0], points[:, 2])
