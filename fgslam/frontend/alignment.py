"""Rigid motions that lay points onto points: Kabsch's rotation, and the turn on a floor."""

from __future__ import annotations

import numpy as np

from fgslam.floor import Floor
from fgslam.geometry import skew
from fgslam.types import FloatArray


def aligned_poses(local: FloatArray, world: FloatArray, floor: Floor) -> FloatArray:
    """Least-squares ``wTc`` (h, 4, 4) that take points of the camera to points of the world.

    Each of the h problems has m points of equal weight. In 6 degrees of freedom the rotation is
    Kabsch's, from three points or more (Kabsch 1976); with the floor's 3 it is the turn about the
    vertical, from two or more (Se et al.'s two-match alignment, design B4). With 5 the pose is
    Kabsch's, brought onto the floor.

    Args:
        local: (h, m, 3) in the camera's frame, metres.
        world: (h, m, 3) in the world.
        floor: which poses are possible.
    """
    local_mean, world_mean = local.mean(axis=1), world.mean(axis=1)
    a, b = local - local_mean[:, None], world - world_mean[:, None]
    cross = np.einsum("hmi,hmj->hij", b, a)
    rotations = _turns(cross, floor.down) if floor.dof == 3 else _rotations(cross)
    out = np.zeros((len(local), 4, 4))
    out[:, :3, :3] = rotations
    out[:, :3, 3] = world_mean - np.einsum("hij,hj->hi", rotations, local_mean)
    out[:, 3, 3] = 1.0
    if floor.dof == 6:
        return out
    return np.array([floor.constrain(wTc) for wTc in out])


def _rotations(cross: FloatArray) -> FloatArray:
    """Rotations (h, 3, 3) that maximise the trace with ``cross``; never a reflection."""
    u, _, vt = np.linalg.svd(cross)
    sign = np.linalg.det(u @ vt)
    u[:, :, 2] *= sign[:, None]
    return np.asarray(u @ vt)


def _turns(cross: FloatArray, down: FloatArray) -> FloatArray:
    """Rotations (h, 3, 3) about the vertical that maximise the trace with ``cross``."""
    skewed = skew(down)
    along = np.outer(down, down)
    # trace(R^T cross) = const + cos * trace((I - n n^T) cross) + sin * trace([n]x^T cross)
    cosine = np.einsum("ij,hij->h", np.eye(3) - along, cross)
    sine = np.einsum("ij,hij->h", skewed, cross)
    length = np.maximum(np.hypot(sine, cosine), 1e-300)
    cosine, sine = cosine / length, sine / length
    rotation = along + cosine[:, None, None] * (np.eye(3) - along)
    return np.asarray(rotation + sine[:, None, None] * skewed)
