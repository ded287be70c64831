"""Uncertainty of positions as ellipses: covariances in the world, their outlines, enlargement."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import congruence

SIGMAS = 3.0
"""How many standard deviations an ellipse reaches."""

_CORNERS = 33
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def world_position_covariances(poses: FloatArray, covariances: FloatArray) -> FloatArray:
    """Position covariances (k, 3, 3) in the world of poses with tangent covariances (k, 6, 6)."""
    return congruence(poses[:, :3, :3], covariances[:, 3:, 3:])


def in_plane(covariances: FloatArray, plane: FloatArray) -> FloatArray:
    """Covariances (k, 2, 2) in the plane whose axes are the rows of ``plane`` (2, 3)."""
    return congruence(np.broadcast_to(plane, (len(covariances), 2, 3)), covariances)


def outlines(centres: FloatArray, covariances: FloatArray, scale: float = 1.0) -> FloatArray:
    """Closed polylines (k, corners, 2) of SIGMAS standard deviations about centres (k, 2).

    Args:
        centres: (k, 2).
        covariances: (k, 2, 2); where one is not finite, its polyline is NaN.
        scale: enlarges all of them.
    """
    known = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    variances, directions = np.linalg.eigh(np.where(known[:, None, None], covariances, 0.0))
    radii = SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    around = np.einsum("kij,kj,mj->kmi", directions, radii, circle)
    around[~known] = np.nan
    return np.asarray(centres[:, None] + scale * around)


def exaggeration(covariances: FloatArray, span: float) -> int:
    """Factor that makes the larger half of the ellipses at least 2 % of ``span`` wide."""
    if not len(covariances):
        return 1
    width = 2.0 * SIGMAS * np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0))
    typical = float(np.percentile(width, 75.0))
    for factor in _FACTORS:
        if factor * typical >= 0.02 * span:
            return factor
    return 1 if typical == 0.0 else _FACTORS[-1]
