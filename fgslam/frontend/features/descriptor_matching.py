"""Matching by descriptors alone, without any knowledge of the cameras' geometry."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import ByteArray, IntArray


def mutual_nearest(a: ByteArray, b: ByteArray, ratio: float = 0.8) -> tuple[IntArray, IntArray]:
    """Pairs of descriptors that are each other's nearest, and clearly so (Lowe 2004, 7.1).

    Args:
        a: (n, 128) descriptors.
        b: (m, 128) descriptors.
        ratio: the distance is less than this fraction of that to the second nearest in ``b``.

    Returns:
        Indices (k,) into ``a``, ascending, and (k,) into ``b``.
    """
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    squared = _squared_distances(a, b)
    i = np.arange(len(a))
    j = np.argmin(squared, axis=1)
    best = squared[i, j]
    mutual = np.argmin(squared, axis=0)[j] == i
    squared[i, j] = np.inf
    keep = mutual & (best < ratio * ratio * squared.min(axis=1))
    return i[keep], j[keep]


def _squared_distances(a: ByteArray, b: ByteArray) -> npt.NDArray[np.float32]:
    # Exact in float32: every sum of 128 products of bytes is below 2^24.
    x, y = a.astype(np.float32), b.astype(np.float32)
    norms = np.einsum("ij,ij->i", x, x)[:, None] + np.einsum("ij,ij->i", y, y)
    return np.asarray(norms - 2.0 * (x @ y.T), np.float32)
