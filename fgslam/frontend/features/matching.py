"""Matching of features: candidate pairs between two sets, and the choice among them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, Float32, FloatArray, IntArray
from fgslam.core.geometry import wrap
from fgslam.core.kernels import Kernel
from fgslam.core.types import Words
from fgslam.frontend.settings import AppearanceSettings

MAX_DISTANCE = 350.0  # of descriptors of the same point, whose norm is 512
RATIO = 0.85  # of the best distance to the second best, at most


def pairs_within(
    center: FloatArray, reach: FloatArray | float, values: FloatArray
) -> tuple[IntArray, IntArray]:
    """All pairs (i, j) with ``|values[j] - center[i]| <= reach[i]``.

    Args:
        center: (n,) centre of each window.
        reach: (n,) or scalar half width.
        values: (m,) in any order.

    Returns:
        Indices (k,) into ``center``, ascending, and (k,) into ``values``.
    """
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    first = np.searchsorted(ordered, center - reach, side="left")
    last = np.searchsorted(ordered, center + reach, side="right")
    i, j = _every(first, last)
    return i, order[j]


def _every(first: IntArray, last: IntArray) -> tuple[IntArray, IntArray]:
    """All pairs (k,) of i and the numbers from first[i] up to last[i] (n,)."""
    counts = last - first
    i = np.repeat(np.arange(len(counts)), counts)
    return i, np.arange(len(i)) - np.repeat(np.cumsum(counts) - last, counts)


def alike(
    scale: tuple[FloatArray, FloatArray],
    orientation: tuple[FloatArray, FloatArray],
    max_scale_ratio: float,
    max_angle: float,
) -> BoolArray:
    """Whether the pairs' scales and orientations agree within the gates (Se et al. 2.2)."""
    a, b = scale
    close = (a <= b * max_scale_ratio) & (b <= a * max_scale_ratio)
    turned = wrap(orientation[0][close] - orientation[1][close])
    close[close] = np.abs(turned) <= max_angle
    return np.asarray(close)


def _pairs_in_gates(
    first: Any,
    last: Any,
    wanted: Any,
    seen: Any,
    ratio: float,
    angle: float,
    found: Any,
    count: Any,
) -> None:
    k = 0
    for i in range(len(wanted)):
        w = wanted[i]
        for j in range(first[i], last[i]):
            s = seen[j]
            near = (abs(s[0] - w[0]) <= w[2]) & ((abs(s[1] - w[1]) <= w[3]) | (s[4] > 0.0))
            if not near & (w[4] <= s[2] * ratio) & (s[2] <= w[4] * ratio):
                continue
            turns = (w[5] - s[3]) / (2.0 * math.pi)
            if 2.0 * math.pi * abs(turns - np.floor(turns + 0.5)) <= angle:
                if k < found.shape[1]:
                    found[0, k], found[1, k] = i, j
                k += 1
    count[0] = k


def _pairs_in_gates_numpy(
    first: IntArray, last: IntArray, wanted: FloatArray, seen: FloatArray, ratio: float,
    angle: float, found: IntArray, count: IntArray,
) -> None:  # fmt: skip
    i, j = _every(first, last)
    w, s = wanted[i], seen[j]
    near = np.abs(s[:, 0] - w[:, 0]) <= w[:, 2]
    near &= (np.abs(s[:, 1] - w[:, 1]) <= w[:, 3]) | (s[:, 4] > 0.0)
    near &= alike((w[:, 4], s[:, 2]), (w[:, 5], s[:, 3]), ratio, angle)
    count[0] = near.sum()
    fits = min(count[0], found.shape[1])
    found[:, :fits] = np.stack([i, j])[:, near][:, :fits]


_KINDS = "i8[::1] i8[::1] f8[:,::1] f8[:,::1] f8 f8 i8[:,::1] i8[::1]"
pairs_in_gates = Kernel(_pairs_in_gates, _pairs_in_gates_numpy, _KINDS)
"""(first (n,), last (n,), wanted (n, 6), seen (m, 5), ratio of scales, angle, found, count (1,)):
pairs i, j with first[i] <= j < last[i] that agree in row, disparity, scale and orientation.

``wanted``: row, disparity, how far both may be off, scale, orientation; ``seen``: row, disparity,
scale, orientation, above 0 where no disparity was measured. Of ``found`` (2, k) as many as it has
room for."""


def resembling(
    i: IntArray,
    j: IntArray,
    descriptors: tuple[ByteArray, ByteArray],
    settings: AppearanceSettings,
) -> tuple[IntArray, IntArray, FloatArray]:
    """The pairs (k,) whose descriptors are close enough, and their distances.

    In `paper` mode there are no descriptors: every pair stays, at distance zero.
    """
    if settings.mode == "paper":
        return i, j, np.zeros(len(i))
    cost = descriptor_distance(descriptors[0][i], descriptors[1][j])
    near = cost <= MAX_DISTANCE
    return i[near], j[near], cost[near]


def descriptor_distance(a: ByteArray, b: ByteArray) -> FloatArray:
    """Euclidean distances (k,) of descriptors (k, 128); a SIFT descriptor's norm is 512."""
    # float32 represents every sum of 128 squared byte differences exactly (below 2^24).
    difference = a.astype(np.float32) - b.astype(np.float32)
    squared = np.einsum("ij,ij->i", difference, difference)
    return np.asarray(np.sqrt(squared.astype(np.float64)))


def pick(
    pairs: tuple[IntArray, IntArray, FloatArray], settings: AppearanceSettings
) -> tuple[IntArray, IntArray]:
    """One-to-one matches among resembling pairs, ascending in the first set.

    `paper` keeps unambiguous pairs; `descriptor` the mutually closest ones that beat the runner-up.
    """
    i, j, cost = pairs
    if settings.mode == "paper":
        keep = unambiguous(i, j)
    elif not len(i):
        return i, j
    else:
        keep = _wins(i, cost) & _wins(j, cost)
    return i[keep], j[keep]


def choose(
    i: IntArray,
    j: IntArray,
    descriptors: tuple[ByteArray, ByteArray],
    settings: AppearanceSettings,
) -> tuple[IntArray, IntArray]:
    """One-to-one matches among candidate pairs (k,) that passed every other gate."""
    return pick(resembling(i, j, descriptors, settings), settings)


def unambiguous(i: IntArray, j: IntArray) -> BoolArray:
    """Pairs both of whose members occur in no other pair (Se et al. 2.2: ambiguity discards)."""
    if not len(i):
        return np.zeros(0, np.bool_)
    return np.asarray((np.bincount(i)[i] == 1) & (np.bincount(j)[j] == 1))


def _wins(group: IntArray, cost: FloatArray) -> BoolArray:
    """Pairs that are the cheapest of their group, and clearly so."""
    order = np.lexsort((cost, group))
    first = np.ones(len(order), np.bool_)
    first[1:] = group[order][1:] != group[order][:-1]
    runner_up = np.full(len(order), np.inf)
    has_next = first[:-1] & ~first[1:]
    runner_up[:-1][has_next] = cost[order][1:][has_next]
    wins = np.zeros(len(order), np.bool_)
    wins[order] = first & (cost[order] <= RATIO * runner_up)
    return wins


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
    squared = squared_distances(a, b)
    i = np.arange(len(a))
    j = np.argmin(squared, axis=1)
    best = squared[i, j]
    squared[i, j] = np.inf
    clear = best < ratio * ratio * squared.min(axis=1)
    squared[i, j] = best
    # Columns are slow to search: only those that a row clearly prefers.
    i, j = i[clear], j[clear]
    mutual = np.argmin(squared[:, j], axis=0) == i
    return i[mutual], j[mutual]


def squared_distances(a: ByteArray, b: ByteArray) -> Float32:
    """Squared distances (n, m) of descriptors (n, 128) and (m, 128)."""
    # Exact in float32: every sum of 128 products of bytes is below 2^24.
    x, y = a.astype(np.float32), b.astype(np.float32)
    out = np.asarray((-2.0 * x) @ y.T, np.float32)
    out += np.einsum("ij,ij->i", x, x)[:, None]
    out += np.einsum("ij,ij->i", y, y)
    return out


# ------------------------------------------------------------------------------------------
# Nearest SIFT descriptors among many, by a fixed vocabulary

VOCABULARY_FILE = Path(__file__).with_name("vocabulary.npz")
CHUNK = 4096  # descriptors compared at a time; their distances stay in the cache


@lru_cache(maxsize=1)
def vocabulary() -> ByteArray:
    """(w, 128) the cells' centres."""
    with np.load(VOCABULARY_FILE, allow_pickle=False) as stored:
        return np.asarray(stored["words"], np.uint8)


def words_of(descriptors: ByteArray) -> Words:
    """The word (m,) of each descriptor (m, 128): the cell whose centre is nearest."""
    out = np.empty(len(descriptors), np.int16)
    for start in range(0, len(descriptors), CHUNK):
        part = slice(start, start + CHUNK)
        out[part] = np.argmin(_to_centres(descriptors[part]), axis=1)
    return out


def nearest_words(descriptors: ByteArray, count: int) -> IntArray:
    """The ``count`` nearest cells (m, count) of each of a frame's descriptors, nearest first."""
    order = np.argsort(_to_centres(descriptors), axis=1, kind="stable")
    return np.asarray(order[:, :count])


def _to_centres(descriptors: ByteArray) -> Float32:
    """Squared distances (m, w) to the centres, each row less the descriptor's own square.

    Exact in float32: all sums of 128 products of bytes, and their doubles, are below 2^24.
    """
    centres, squares = _centres()
    products = np.asarray(descriptors.astype(np.float32) @ centres, np.float32)
    return np.subtract(squares, products, out=products)


@lru_cache(maxsize=1)
def _centres() -> tuple[Float32, Float32]:
    """Twice the centres (128, w), and their squares (w,)."""
    values = vocabulary().astype(np.float32)
    return np.ascontiguousarray(2.0 * values.T), np.einsum("ij,ij->i", values, values)


EXACT = 6000  # contents up to here are compared in full, which costs no more
PROBES = 12  # cells searched for each query, of 256
AT_ONCE = 1024  # queries; more than a frame has, and their distances are tens of megabytes
LEADING = 1024  # of a query's distances bound the rest: those of its nearest cells
Cell = tuple[ByteArray, Float32]
"""Descriptors (m, 128) of one cell, and their squares (m,)."""
Candidates = tuple[IntArray, IntArray, Float32]
"""Queries (c,), rows (c,) that may be among their nearest, squared distances less the query's own
square (c,)."""


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

        ``words`` (m,) are those of ``vocabulary.words_of``, where known.
        """
        self._descriptors = descriptors
        self._small = len(descriptors) <= EXACT
        if not self._small:
            words = words_of(descriptors) if words is None else words
            self._order = np.argsort(words, kind="stable")
            counts = np.bincount(words, minlength=len(vocabulary()))
            self._starts = np.concatenate([[0], np.cumsum(counts)])
            self._held: dict[int, Cell] = {}

    def __len__(self) -> int:
        """Number of descriptors held."""
        return len(self._descriptors)

    def query(self, descriptors: ByteArray, neighbours: int) -> Neighbours:
        """The nearest stored descriptors of each of (q, 128), at most ``neighbours``.

        Approximate in contents of more than a few thousand: a neighbour in a cell that the query
        does not search is not found. Distances are exact.
        """
        found = [
            self._some(descriptors[start : start + AT_ONCE], neighbours)
            for start in range(0, max(len(descriptors), 1), AT_ONCE)
        ]
        return Neighbours(
            np.concatenate([one.rows for one in found]),
            np.concatenate([one.distances for one in found]),
        )

    def _some(self, descriptors: ByteArray, neighbours: int) -> Neighbours:
        """The neighbours of so many descriptors that their distances fit into memory."""
        asked = descriptors.astype(np.float32)
        if self._small or not len(asked):
            query, row, squared = self._in_full(asked, neighbours)
        else:
            query, row, squared = self._probed(
                asked, nearest_words(descriptors, PROBES), neighbours
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

    def _in_full(self, asked: Float32, neighbours: int) -> Candidates:
        found = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32))]
        for start in range(0, len(self), CHUNK):
            squared = _squared(asked, self._descriptors[start : start + CHUNK])
            bound = _bound(squared, neighbours)
            query, column = np.nonzero(squared <= bound[:, None])
            found.append((query, start + column, squared[query, column]))
        query, row, near = (np.concatenate(part) for part in zip(*found, strict=True))
        return query, row, near

    def _probed(self, asked: Float32, cells: IntArray, neighbours: int) -> Candidates:
        """Searches ``cells`` (q, p): cell by cell, for all queries that want it.

        The distances lie behind each other as they are found: of each cell, of each query that
        wants it, to all that the cell holds. Those of a query's nearest cells bound the others.
        """
        wanted = np.argsort(cells, axis=None, kind="stable")
        query, cell = wanted // cells.shape[1], cells.ravel()[wanted]
        sizes = self._starts[cell + 1] - self._starts[cell]
        ends = np.cumsum(sizes)
        squared = np.empty(ends[-1], np.float32)
        first = np.searchsorted(cell, np.arange(len(self._starts))).tolist()
        for k in np.unique(cell).tolist():
            values, squares = self._cell(k)
            stop = ends[first[k + 1] - 1]
            part = squared[stop - len(values) * (first[k + 1] - first[k]) : stop]
            of = asked[query[first[k] : first[k + 1]]]
            _less_own(of, values.astype(np.float32), squares, part.reshape(len(of), len(values)))
        place = np.empty(cells.shape, np.int64)
        place.flat[wanted] = ends - sizes
        bound = _bound(self._leading(squared, place, cells), neighbours)
        near = np.flatnonzero(squared <= np.repeat(bound[query], sizes))
        at = np.searchsorted(ends, near, side="right")
        row = self._order[self._starts[cell[at]] + near - (ends - sizes)[at]]
        return query[at], row, squared[near]

    def _cell(self, k: int) -> Cell:
        """What a cell holds, found when it is first searched."""
        if k not in self._held:
            values = self._descriptors.take(
                self._order[self._starts[k] : self._starts[k + 1]], axis=0
            )
            wide = values.astype(np.float32)
            self._held[k] = values, np.vecdot(wide, wide)
        return self._held[k]

    def _leading(self, squared: Float32, place: IntArray, cells: IntArray) -> Float32:
        """Distances (q, m) of each query to what its nearest cells hold, padded with infinity."""
        sizes = self._starts[cells + 1] - self._starts[cells]
        ends = np.minimum(np.cumsum(sizes, axis=1), LEADING)
        out = np.full((len(cells), LEADING), np.inf, np.float32)
        starts = ends - np.diff(ends, axis=1, prepend=0)
        for i, probe in zip(*np.nonzero(ends > starts), strict=True):
            start, end, here = starts[i, probe], ends[i, probe], place[i, probe]
            out[i, start:end] = squared[here : here + end - start]
        return out


def _squared(asked: Float32, held: ByteArray, out: Float32 | None = None) -> Float32:
    """Squared distances (q, m) less the queries' own squares.

    Exact in float32: all sums of 128 products of bytes, and their doubles, are below 2^24.
    """
    values = held.astype(np.float32)
    return _less_own(asked, values, np.vecdot(values, values), out)


def _less_own(asked: Float32, values: Float32, squares: Float32, out: Float32 | None) -> Float32:
    """The same of values (m, 128) whose squares (m,) are known."""
    products = (values @ (-2.0 * asked).T).T  # this way round in half the time
    return np.add(products, squares, out=out)


def _bound(values: Float32, count: int) -> Float32:
    """A finite bound (q,) of each row's smallest ``count`` of (q, m); ties are never cut.

    No larger than that many of the leading ones, where there are so many.
    """
    bound = np.full(len(values), np.finfo(np.float32).max)
    leading = values[:, :LEADING]
    if leading.shape[1] > count:
        bound = np.minimum(bound, np.partition(leading, count - 1, axis=1)[:, count - 1])
    return bound
