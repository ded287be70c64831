"""Nearest descriptors among many, whose owners come and go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgslam.types import ByteArray, FloatArray, IntArray

_CHUNK = 8192  # stored descriptors compared at a time; their distances stay in the cache


@dataclass(frozen=True, slots=True, eq=False)
class Neighbours:
    """What the index knows of each asked descriptor, nearest first, then by owner.

    Attributes:
        owners: (q, k) owners; -1 where the index holds fewer.
        distances: (q, k) Euclidean, a descriptor's norm being 512; infinite where the owner is -1.
    """

    owners: IntArray
    distances: FloatArray


class AppearanceIndex:
    """SIFT descriptors with the identities of their owners; the answer depends on nothing else."""

    def __init__(self) -> None:
        """Starts empty."""
        self._owners: IntArray = np.empty(0, np.int64)
        self._descriptors: npt.NDArray[np.float32] = np.empty((0, 128), np.float32)
        self._norms: npt.NDArray[np.float32] = np.empty(0, np.float32)

    def __len__(self) -> int:
        """Number of descriptors held."""
        return len(self._owners)

    def add(self, owners: IntArray, descriptors: ByteArray) -> None:
        """Adds descriptors (m, 128) of owners (m,), which may repeat and may be known already."""
        values = descriptors.astype(np.float32)
        self._owners = np.concatenate([self._owners, owners])
        self._descriptors = np.concatenate([self._descriptors, values])
        self._norms = np.concatenate([self._norms, np.einsum("ij,ij->i", values, values)])

    def remove(self, owners: IntArray) -> None:
        """Forgets all descriptors of the owners; unknown ones are no error."""
        keep = ~np.isin(self._owners, owners)
        self._owners = self._owners[keep]
        self._descriptors = self._descriptors[keep]
        self._norms = self._norms[keep]

    def query(self, descriptors: ByteArray, neighbours: int) -> Neighbours:
        """The nearest stored descriptors of each of (q, 128), at most ``neighbours``."""
        asked = descriptors.astype(np.float32)
        own = np.einsum("ij,ij->i", asked, asked)
        count = len(asked)
        owners = np.full((count, neighbours), -1, np.int64)
        squared = np.full((count, neighbours), np.inf, np.float32)
        for start in range(0, len(self), _CHUNK):
            part = slice(start, start + _CHUNK)
            # Exact in float32: every sum of 128 products of bytes is below 2^24.
            found = own[:, None] + self._norms[part] - 2.0 * (asked @ self._descriptors[part].T)
            rows = _smallest(found, neighbours)
            squared = np.hstack([squared, np.take_along_axis(found, rows, axis=1)])
            owners = np.hstack([owners, self._owners[part][rows]])
            order = np.lexsort((owners, squared), axis=1)[:, :neighbours]
            squared = np.take_along_axis(squared, order, axis=1)
            owners = np.take_along_axis(owners, order, axis=1)
        return Neighbours(owners, np.sqrt(squared.astype(np.float64)))


def _smallest(values: npt.NDArray[np.float32], count: int) -> IntArray:
    """Columns of the smallest values of each row, in any order."""
    if values.shape[1] <= count:
        return np.tile(np.arange(values.shape[1]), (len(values), 1))
    return np.asarray(np.argpartition(values, count - 1, axis=1)[:, :count])
