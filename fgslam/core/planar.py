"""Poses and bearings in the plane: the geometry of homing.

A planar pose is an array (x, y, psi): metres (or legs, where scale is unknown) and radians,
counter-clockwise. ``wTr`` = (x, y, psi) takes a point from the robot's axes (x forward, y left)
to the world's. Arrays of poses are (n, 3). Covariances of planar poses are of these three numbers
themselves, in the order (x, y, psi) and along the *world's* axes; unlike spatial poses they are not
in a tangent space.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray


def wrap(angle: FloatArray) -> FloatArray:
    """Angles in radians, wrapped to [-pi, pi)."""
    wrapped = (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi
    # The remainder of a tiny negative number rounds up to the divisor itself.
    return np.asarray(np.where(wrapped >= np.pi, -np.pi, wrapped))


def wrapped_pose(pose: FloatArray) -> FloatArray:
    """(3,) the same pose, its heading within half a turn: steps of a solver may lead beyond."""
    out = np.array(pose, dtype=np.float64)
    out[2:] = wrap(out[2:])
    return out


def unit(angle: FloatArray) -> FloatArray:
    """(..., 2) unit vectors (cos, sin) of angles (...)."""
    angle = np.asarray(angle, dtype=np.float64)
    out = np.empty((*angle.shape, 2))  # what stacks its parts takes longer than their sines
    np.cos(angle, out=out[..., 0])
    np.sin(angle, out=out[..., 1])
    return out


def rotation(angle: float) -> FloatArray:
    """(2, 2) matrix that turns a vector counter-clockwise by ``angle`` radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def compose(aTb: FloatArray, bTc: FloatArray) -> FloatArray:
    """(..., 3) ``aTc`` of poses (..., 3) and (..., 3)."""
    aTb, bTc = np.asarray(aTb, dtype=np.float64), np.asarray(bTc, dtype=np.float64)
    c, s = np.cos(aTb[..., 2]), np.sin(aTb[..., 2])
    x = aTb[..., 0] + c * bTc[..., 0] - s * bTc[..., 1]
    y = aTb[..., 1] + s * bTc[..., 0] + c * bTc[..., 1]
    return _poses(x, y, aTb[..., 2] + bTc[..., 2])


def inverse(aTb: FloatArray) -> FloatArray:
    """(..., 3) ``bTa``."""
    aTb = np.asarray(aTb, dtype=np.float64)
    c, s = np.cos(aTb[..., 2]), np.sin(aTb[..., 2])
    x = -c * aTb[..., 0] - s * aTb[..., 1]
    y = s * aTb[..., 0] - c * aTb[..., 1]
    return _poses(x, y, -aTb[..., 2])


def _poses(x: FloatArray, y: FloatArray, turn: FloatArray) -> FloatArray:
    """(..., 3) of coordinates and headings (...), these still to be wrapped."""
    out = np.empty((*np.shape(x), 3))
    out[..., 0], out[..., 1], out[..., 2] = x, y, wrap(turn)
    return out


def between(wTa: FloatArray, wTb: FloatArray) -> FloatArray:
    """(..., 3) ``aTb``: pose b as seen from a."""
    return compose(inverse(wTa), wTb)


def to_robot(wTr: FloatArray, points: FloatArray) -> FloatArray:
    """(n, 2) points of the world in the robot's axes: R(psi)^T (P - p), eq. 8 corrected."""
    return (np.asarray(points) - wTr[:2]) @ rotation(float(wTr[2]))


def bearings(wTr: FloatArray, points: FloatArray) -> FloatArray:
    """(n,) bearings of points (n, 2) from a pose, counter-clockwise from its heading (eqs 7, 9)."""
    seen = to_robot(wTr, points)
    return np.arctan2(seen[:, 1], seen[:, 0])


def circular_median(angles: FloatArray) -> float:
    """The angle of (n,) wrapped ones, n > 0, with the least sum of absolute differences to all."""
    apart = np.abs(angles[:, None] - angles)
    apart = np.minimum(apart, np.abs(2.0 * np.pi - apart))
    return float(angles[int(np.argmin(apart.sum(axis=0)))])
