"""Nearest descriptors among many, whose owners come and go.

An inverted file (Sivic and Zisserman 2003; Jegou et al. 2011): descriptors lie in the cells of a
fixed vocabulary, and a query compares those of the nearest cells only, exactly. Small contents are
compared in full. The vocabulary does not depend on the content, and what is held is kept in order:
so the answer depends on what the index holds, not on how it came in, and a map that was saved and
loaded answers as before, to the bit. Measured against libraries' indices in docs/map_results.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fgslam.types import ByteArray, FloatArray, IntArray

VOCABULARY_FILE = Path(__file__).with_name("vocabulary.npz")

_CHUNK = 4096  # descriptors compared at a time; their distances stay in the cache
_EXACT = 6000  # contents up to here are compared in full, which costs no more
_PROBES = 12  # cells searched for each query, of 256


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
        self._words: IntArray = np.empty(0, np.int64)
        self._descriptors: ByteArray = np.empty((0, 128), np.uint8)
        self._starts: IntArray = np.zeros(len(_vocabulary()) + 1, np.int64)
        self._sorted = True

    def __len__(self) -> int:
        """Number of descriptors held."""
        return len(self._owners)

    def add(self, owners: IntArray, descriptors: ByteArray) -> None:
        """Adds descriptors (m, 128) of owners (m,), which may repeat and may be known already."""
        self._owners = np.concatenate([self._owners, np.asarray(owners, np.int64)])
        self._words = np.concatenate([self._words, _nearest_words(descriptors, 1)[:, 0]])
        self._descriptors = np.concatenate([self._descriptors, descriptors])
        self._sorted = False

    def remove(self, owners: IntArray) -> None:
        """Forgets all descriptors of the owners; unknown ones are no error."""
        keep = ~np.isin(self._owners, owners)
        self._owners, self._words = self._owners[keep], self._words[keep]
        self._descriptors = self._descriptors[keep]
        self._sorted = False

    def query(self, descriptors: ByteArray, neighbours: int) -> Neighbours:
        """The nearest stored descriptors of each of (q, 128), at most ``neighbours``.

        Approximate in contents of more than a few thousand: a neighbour in a cell that the query
        does not search is not found. Distances are exact.
        """
        self._sort()
        asked = descriptors.astype(np.float32)
        if len(self) <= _EXACT or not len(asked):
            return self._in_full(asked, neighbours)
        return self._probed(asked, descriptors, neighbours)

    def _sort(self) -> None:
        """Brings what is held into the order of cells, then owners, then descriptors."""
        if self._sorted:
            return
        order = np.lexsort((_fingerprints(self._descriptors), self._owners, self._words))
        self._owners, self._words = self._owners[order], self._words[order]
        self._descriptors = self._descriptors[order]
        self._starts = np.searchsorted(self._words, np.arange(len(_vocabulary()) + 1))
        self._sorted = True

    def _in_full(self, asked: npt.NDArray[np.float32], neighbours: int) -> Neighbours:
        owners = np.full((len(asked), neighbours), -1, np.int64)
        squared = np.full((len(asked), neighbours), np.inf, np.float32)
        for start in range(0, len(self), _CHUNK):
            part = slice(start, start + _CHUNK)
            found = _squared(asked, self._descriptors[part])
            columns = _smallest(found, neighbours)
            squared = np.hstack([squared, np.take_along_axis(found, columns, axis=1)])
            owners = np.hstack([owners, self._owners[part][columns]])
            owners, squared = _ordered(owners, squared, neighbours)
        return Neighbours(owners, np.sqrt(squared.astype(np.float64)))

    def _probed(
        self, asked: npt.NDArray[np.float32], descriptors: ByteArray, neighbours: int
    ) -> Neighbours:
        """Searches the cells nearest to each query, cell by cell for all queries that want it."""
        cells = _nearest_words(descriptors, _PROBES)
        sizes = np.diff(self._starts)[cells]
        offsets = np.cumsum(sizes, axis=1) - sizes
        width = max(int(sizes.sum(axis=1).max()), neighbours)
        squared = np.full((len(asked), width), np.inf, np.float32)
        rows = np.full((len(asked), width), -1, np.int32)
        wanted = np.argsort(cells, axis=None, kind="stable")
        bounds = np.searchsorted(cells.ravel()[wanted], np.arange(len(self._starts)))
        for cell in np.flatnonzero((np.diff(bounds) > 0) & (np.diff(self._starts) > 0)):
            query, probe = np.divmod(wanted[bounds[cell] : bounds[cell + 1]], cells.shape[1])
            held = np.arange(self._starts[cell], self._starts[cell + 1])
            at = offsets[query, probe][:, None] + np.arange(len(held))
            squared[query[:, None], at] = _squared(asked[query], self._descriptors[held])
            rows[query[:, None], at] = held
        columns = _smallest(squared, neighbours)
        near = np.take_along_axis(squared, columns, axis=1)
        row = np.take_along_axis(rows, columns, axis=1)
        owners = np.where(row >= 0, self._owners[row], -1)
        owners, near = _ordered(owners, near, neighbours)
        return Neighbours(owners, np.sqrt(near.astype(np.float64)))


@lru_cache(maxsize=1)
def _vocabulary() -> ByteArray:
    """(w, 128) the cells' centres; made by scripts/make_vocabulary.py."""
    with np.load(VOCABULARY_FILE, allow_pickle=False) as stored:
        return np.asarray(stored["words"], np.uint8)


def _fingerprints(descriptors: ByteArray) -> IntArray:
    """(m,) a number of each descriptor's bytes, by which an owner's views are put in order."""
    weights = np.random.default_rng(0).integers(-(2**62), 2**62, (16, 2))
    halves = np.ascontiguousarray(descriptors).view(np.int64)
    mixed = (halves ^ (halves >> 29)) * weights[:, 0]
    return np.asarray(np.sum((mixed ^ (mixed >> 32)) * weights[:, 1], axis=1))


def _nearest_words(descriptors: ByteArray, count: int) -> IntArray:
    """The cells (m, count) whose centres are nearest, nearest first."""
    out = np.empty((len(descriptors), count), np.int64)
    for start in range(0, len(descriptors), _CHUNK):
        part = slice(start, start + _CHUNK)
        squared = _squared(descriptors[part].astype(np.float32), _vocabulary())
        if count == 1:
            out[part, 0] = np.argmin(squared, axis=1)
        else:
            out[part] = np.argsort(squared, axis=1, kind="stable")[:, :count]
    return out


def _squared(asked: npt.NDArray[np.float32], held: ByteArray) -> npt.NDArray[np.float32]:
    """Squared distances (q, m); exact in float32: all sums of 128 products are below 2^24."""
    values = held.astype(np.float32)
    norms = np.einsum("ij,ij->i", asked, asked)[:, None] + np.einsum("ij,ij->i", values, values)
    return np.asarray(norms - 2.0 * (asked @ values.T), np.float32)


def _smallest(values: npt.NDArray[np.float32], count: int) -> IntArray:
    """Columns of the smallest values of each row, in any order."""
    if values.shape[1] <= count:
        return np.tile(np.arange(values.shape[1]), (len(values), 1))
    return np.asarray(np.argpartition(values, count - 1, axis=1)[:, :count])


def _ordered(
    owners: IntArray, squared: npt.NDArray[np.float32], count: int
) -> tuple[IntArray, npt.NDArray[np.float32]]:
    """The nearest ``count`` of each row, by distance, then owner."""
    order = np.lexsort((owners, squared), axis=1)[:, :count]
    return np.take_along_axis(owners, order, axis=1), np.take_along_axis(squared, order, axis=1)
