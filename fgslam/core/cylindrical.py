"""The cylindrical view of a pair: a cylinder along the baseline, both directions equidistant.

The epipolar equidistant rectification of Abraham and Foerstner (2005). A row is a plane through the
baseline, its ``elevation = atan2(y, z)``; a column is the angle within that plane,
``angle = atan2(x, hypot(y, z))``; both are scaled by the focal length, in pixels a radian. So the
views of a point share a row, and the disparity is its parallax: the difference of the two angles.
What an ideal perspective camera of the same numbers would measure follows exactly.
Derived in docs/derivations/stereo_measurement.md.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.sensors import CameraRig

_NEAR_AXIS = 1e-4  # radians, below which a series is exact


def view_angles(rig: CameraRig, measurement: FloatArray) -> tuple[FloatArray, ...]:
    """Angle in right and left view, and elevation (n,) each, of (column, row, disparity) (n, 3)."""
    right = (measurement[:, 0] - rig.cx) / rig.fx
    return right, right + measurement[:, 2] / rig.fx, (measurement[:, 1] - rig.cy) / rig.fy


def view_rays(angle: FloatArray, elevation: FloatArray) -> FloatArray:
    """Rays (n, 3) of length 1 in the camera's axes."""
    across = np.cos(angle)
    return np.column_stack([np.sin(angle), across * np.sin(elevation), across * np.cos(elevation)])


def project(rig: CameraRig, points: FloatArray) -> FloatArray:
    """(column, row, disparity) (n, 3) of points (n, 3) off the baseline's line."""
    x, y, z = points.T
    away = np.hypot(y, z)
    angle = np.arctan2(x, away)
    parallax = np.arctan2(x + rig.baseline, away) - angle
    return np.column_stack(
        [rig.cx + rig.fx * angle, rig.cy + rig.fy * np.arctan2(y, z), rig.fx * parallax]
    )


def projection_jacobian(rig: CameraRig, points: FloatArray) -> FloatArray:
    """d(column, row, disparity)/d(point) (n, 3, 3) at points (n, 3)."""
    y, z = points[:, 1], points[:, 2]
    away2 = y * y + z * z
    right, left = (_angle_slopes(points, shift) for shift in (0.0, rig.baseline))
    out = np.empty((len(points), 3, 3))
    out[:, 0] = rig.fx * right
    out[:, 1] = rig.fy * np.column_stack([np.zeros_like(y), z / away2, -y / away2])
    out[:, 2] = rig.fx * (left - right)
    return out


def _angle_slopes(points: FloatArray, shift: float) -> FloatArray:
    """(n, 3) derivative of the angle from a camera that sits ``shift`` to the left."""
    x, y, z = points[:, 0] + shift, points[:, 1], points[:, 2]
    away = np.hypot(y, z)
    across = x / away
    slopes = np.column_stack([away, -across * y, -across * z])
    return np.asarray(slopes / (x * x + away * away)[:, None])


def triangulate(rig: CameraRig, measurement: FloatArray) -> FloatArray:
    """Points (n, 3) of (column, row, disparity) (n, 3); inverse of :func:`project`."""
    right, left, elevation = view_angles(rig, measurement)
    away = rig.baseline * np.cos(left) / np.sin(left - right)  # to the right camera, times cos
    return np.column_stack(
        [
            away * np.sin(right),
            away * np.cos(right) * np.sin(elevation),
            away * np.cos(right) * np.cos(elevation),
        ]
    )


def point_jacobian(rig: CameraRig, measurement: FloatArray) -> FloatArray:
    """d(point)/d(column, row, disparity) (n, 3, 3)."""
    right, left, elevation = view_angles(rig, measurement)
    sine, cosine = np.sin(left - right), np.cos(right)
    away = rig.baseline * np.cos(left) * cosine / sine  # from the baseline
    down, ahead = np.sin(elevation), np.cos(elevation)
    by_angle = -rig.baseline * np.sin(left + right) / sine / rig.fx
    by_parallax = -rig.baseline * cosine**2 / sine**2 / rig.fx
    out = np.zeros((len(measurement), 3, 3))
    out[:, 0, 0] = rig.baseline * np.cos(left + right) / sine / rig.fx
    out[:, 0, 2] = -rig.baseline * np.sin(right) * cosine / sine**2 / rig.fx
    out[:, 1, 0], out[:, 2, 0] = by_angle * down, by_angle * ahead
    out[:, 1, 1], out[:, 2, 1] = away * ahead / rig.fy, -away * down / rig.fy
    out[:, 1, 2], out[:, 2, 2] = by_parallax * down, by_parallax * ahead
    return out


def size_distances(rig: CameraRig, points: FloatArray) -> FloatArray:
    """(n,) distances by which sizes in the image shrink: the focal length times size over them.

    Of a perspective view the depth (Se et al. 3.1). On a cylinder a small thing is as wide as its
    distance makes it and as high as that to the baseline: their geometric mean.
    """
    if not rig.cylindrical:
        return points[:, 2]
    away2 = points[:, 1] ** 2 + points[:, 2] ** 2
    return np.asarray((away2 * (away2 + points[:, 0] ** 2)) ** 0.25)


def are_beyond(rig: CameraRig, points: FloatArray, nearest_m: float) -> BoolArray:
    """(n,) which points (n, 3) of the camera's frame are before it, farther than ``nearest_m``.

    In depth; in a cylindrical view, at whose rim all depths are small, in distance.
    """
    if not rig.cylindrical:
        return np.asarray(points[:, 2] > nearest_m)
    return np.asarray((points[:, 2] > 0.0) & (np.linalg.norm(points, axis=1) > nearest_m))


def as_perspective(rig: CameraRig, measurement: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What the ideal perspective rig of the same numbers measures, and its Jacobian.

    Args:
        rig: with a cylindrical view.
        measurement: (n, 3) column, row, disparity in it.

    Returns:
        (n, 3) column, row, disparity of the perspective rig, and (n, 3, 3) their derivatives.
    """
    right, left, elevation = view_angles(rig, measurement)
    ahead, slope = np.cos(elevation), np.tan(elevation)
    near, far = np.tan(right), np.tan(left)
    column, disparity = rig.fx * near / ahead, rig.fx * (far - near) / ahead
    out = np.column_stack([rig.cx + column, rig.cy + rig.fy * slope, disparity])
    jacobian = np.zeros((len(out), 3, 3))
    jacobian[:, 0, 0] = (1.0 + near**2) / ahead
    jacobian[:, 0, 1] = column * slope / rig.fy
    jacobian[:, 1, 1] = 1.0 + slope**2
    jacobian[:, 2, 0] = (far**2 - near**2) / ahead
    jacobian[:, 2, 1] = disparity * slope / rig.fy
    jacobian[:, 2, 2] = (1.0 + far**2) / ahead
    return out, jacobian


def from_perspective(rig: CameraRig, measurement: FloatArray) -> FloatArray:
    """Measurements (n, 3) in the cylindrical view; inverse of :func:`as_perspective`."""
    x, y = (measurement[:, 0] - rig.cx) / rig.fx, (measurement[:, 1] - rig.cy) / rig.fy
    away = np.hypot(y, 1.0)
    right, left = np.arctan2(x, away), np.arctan2(x + measurement[:, 2] / rig.fx, away)
    return np.column_stack(
        [rig.cx + rig.fx * right, rig.cy + rig.fy * np.arctan(y), rig.fx * (left - right)]
    )


# --------------------------------------------------------------------------------------------
# What displaces its pixels


def turns_of_cylinder(angles: FloatArray) -> FloatArray:
    """(k, 2, 3) by which a turn of the camera in yaw, pitch and roll moves (angle, elevation).

    Signs as of :data:`fgslam.core.rig_correction.TERMS`.
    """
    tangent, elevation = np.tan(angles[:, 0]), angles[:, 1]
    sine, cosine = np.sin(elevation), np.cos(elevation)
    across = np.stack([cosine, np.zeros_like(sine), -sine], axis=1)
    down = np.stack([tangent * sine, np.ones_like(sine), tangent * cosine], axis=1)
    return np.stack([across, down], axis=1)


def on_fisheye(angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (k, 2) of an equidistant fisheye's image that look along (angle, elevation) (k, 2).

    Radians from its middle, with the slopes (k, 2, 2) of angle and elevation by them.
    """
    rays = view_rays(*angles.T)
    sine, cosine = np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]
    off = np.arctan2(sine, cosine)
    share = np.sinc(off / np.pi)  # sin(off) / off
    points = rays[:, :2] / share[:, None]
    bend = np.where(off > _NEAR_AXIS, (cosine - share) / np.maximum(off, _NEAR_AXIS) ** 2, -1 / 3)
    by_points = np.empty((len(rays), 3, 2))
    by_points[:, :2] = share[:, None, None] * np.eye(2)
    by_points[:, :2] += bend[:, None, None] * points[:, :, None] * points[:, None]
    by_points[:, 2] = -share[:, None] * points
    y, z = rays[:, 1], rays[:, 2]
    away2 = y * y + z * z
    by_ray = np.zeros((len(rays), 2, 3))
    by_ray[:, 0, 0] = 1.0 / np.sqrt(away2)
    by_ray[:, 1, 1:] = np.column_stack([z, -y]) / away2[:, None]
    return points, by_ray @ by_points
