"""Nearest descriptors among many.

An inverted file (Sivic and Zisserman 2003; Jegou et al. 2011): descriptors lie in the cells of a
fixed vocabulary, and a query compares those of the nearest cells only, exactly. Small contents are
compared in full. The vocabulary does not depend on the content, and equally near descriptors come
in the order in which they are held: so a map that was saved and loaded answers as before, to the
bit. Measured against libraries' indices in docs/map_results.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgslam.frontend.vocabulary import nearest_words, vocabulary, words_of
from fgslam.map_types import Words
from fgslam.types import ByteArray, FloatArray, IntArray

_CHUNK = 4096  # descriptors compared at a time; their distances stay in the cache
_EXACT = 6000  # contents up to here are compared in full, which costs no more
_PROBES = 12  # cells searched for each query, of 256
_LEADING = 1024  # of a query's distances bound the rest: those of its nearest cells

_Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Neighbours:
    """What the index knows of each asked descriptor, nearest first, then by row.

    Attributes:
        rows: (q, k) rows of held descriptors; -1 where the index holds fewer.
        distances: (q, k) Euclidean, a descriptor's norm being 512; infinite where the row is -1.
    """

    rows: IntArray
    distances: FloatArray


class AppearanceIndex:
    """SIFT descriptors, found by what is near; the answer depends on nothing else."""

    def __init__(self, descriptors: ByteArray, words: Words | None = None) -> None:
        """Holds ``descriptors`` (m, 128), which are not copied and must not change.

        ``words`` (m,) are those of :func:`fgslam.frontend.vocabulary.words_of`, where known.
        """
        self._descriptors = descriptors
        self._small = len(descriptors) <= _EXACT
        if not self._small:
            words = words_of(descriptors) if words is None else words
            self._order = np.argsort(words, kind="stable")
            counts = np.bincount(words, minlength=len(vocabulary()))
            self._starts = np.concatenate([[0], np.cumsum(counts)])

    def __len__(self) -> int:
        """Number of descriptors held."""
        return len(self._descriptors)

    def query(self, descriptors: ByteArray, neighbours: int) -> Neighbours:
        """The nearest stored descriptors of each of (q, 128), at most ``neighbours``.

        Approximate in contents of more than a few thousand: a neighbour in a cell that the query
        does not search is not found. Distances are exact.
        """
        asked = descriptors.astype(np.float32)
        if self._small or not len(asked):
            query, row, squared = self._in_full(asked, neighbours)
        else:
            query, row, squared = self._probed(
                asked, nearest_words(descriptors, _PROBES), neighbours
            )
        order = np.lexsort((row, squared, query))
        query, row, squared = query[order], row[order], squared[order]
        rank = np.arange(len(query)) - np.searchsorted(query, query)
        first = rank < neighbours
        query, rank = query[first], rank[first]
        rows = np.full((len(asked), neighbours), -1, np.int64)
        distances = np.full((len(asked), neighbours), np.inf)
        rows[query, rank] = row[first]
        own = np.einsum("ij,ij->i", asked, asked)
        distances[query, rank] = np.sqrt((squared[first] + own[query]).astype(np.float64))
        return Neighbours(rows, distances)

    def _in_full(self, asked: _Floats, neighbours: int) -> tuple[IntArray, IntArray, _Floats]:
        """Candidates: queries, rows and squared distances less the query's own square."""
        found = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32))]
        for start in range(0, len(self), _CHUNK):
            squared = _squared(-2.0 * asked, self._descriptors[start : start + _CHUNK])
            query, column = _smallest(squared, neighbours)
            found.append((query, start + column, squared[query, column]))
        query, row, near = (np.concatenate(part) for part in zip(*found, strict=True))
        return query, row, near

    def _probed(
        self, asked: _Floats, cells: IntArray, neighbours: int
    ) -> tuple[IntArray, IntArray, _Floats]:
        """As :meth:`_in_full`, of ``cells`` (q, p): cell by cell for all queries that want it."""
        sizes = np.diff(self._starts)[cells]
        ends = np.cumsum(sizes, axis=1)
        squared = np.full((len(asked), max(int(ends[:, -1].max()), 1)), np.inf, np.float32)
        wanted = np.argsort(cells, axis=None, kind="stable")
        bounds = np.searchsorted(cells.ravel()[wanted], np.arange(len(self._starts)))
        doubled = -2.0 * asked
        for cell in np.flatnonzero((np.diff(bounds) > 0) & (np.diff(self._starts) > 0)).tolist():
            query, probe = np.divmod(wanted[bounds[cell] : bounds[cell + 1]], cells.shape[1])
            held = self._descriptors[self._order[self._starts[cell] : self._starts[cell + 1]]]
            at = ends[query, probe]
            for i, end, values in zip(
                query.tolist(), at.tolist(), _squared(doubled[query], held), strict=True
            ):
                squared[i, end - len(held) : end] = values
        query, column = _smallest(squared, neighbours)
        probe = (column[:, None] >= ends[query]).sum(axis=1)
        place = self._starts[cells[query, probe] + 1] + column - ends[query, probe]
        return query, self._order[place], squared[query, column]


def _squared(doubled: _Floats, held: ByteArray) -> _Floats:
    """Squared distances (q, m) less the queries' squares, of -2 times the queries (q, 128).

    Exact in float32: all sums of 128 products of bytes, and their doubles, are below 2^24.
    """
    values = held.astype(np.float32)
    out = np.asarray(doubled @ values.T, np.float32)
    out += np.einsum("ij,ij->i", values, values)
    return out


def _smallest(values: _Floats, count: int) -> tuple[IntArray, IntArray]:
    """Rows and columns of the finite values (q, m) that may be among each row's smallest ``count``.

    All that are no larger than so many of the leading ones: ties are never cut.
    """
    bound = np.full(len(values), np.finfo(np.float32).max)
    leading = values[:, :_LEADING]
    if leading.shape[1] > count:
        nearest = np.partition(leading, count - 1, axis=1)[:, count - 1]
        bound = np.minimum(bound, nearest)
    return np.divmod(np.flatnonzero(values <= bound[:, None]), values.shape[1])
