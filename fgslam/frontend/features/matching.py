"""Matching of features: candidate pairs between two sets, and the choice among them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from fgslam.core.planar import wrap
from fgslam.frontend.features.settings import AppearanceSettings

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
    counts = np.searchsorted(ordered, center + reach, side="right") - first
    i = np.repeat(np.arange(len(center)), counts)
    starts = np.cumsum(counts) - counts
    j = np.arange(len(i)) - np.repeat(starts - first, counts)
    return i, order[j]


def alike(
    scale: tuple[FloatArray, FloatArray],
    orientation: tuple[FloatArray, FloatArray],
    max_scale_ratio: float,
    max_angle: float,
) -> BoolArray:
    """Whether the pairs' scales and orientations agree within the gates (Se et al. 2.2)."""
    a, b = scale
    close = (a <= b * max_scale_ratio) & (b <= a * max_scale_ratio)
    return np.asarray(close & (np.abs(wrap(orientation[0] - orientation[1])) <= max_angle))


def descriptor_distance(a: ByteArray, b: ByteArray) -> FloatArray:
    """Euclidean distances (k,) of descriptors (k, 128); a SIFT descriptor's norm is 512."""
    # float32 represents every sum of 128 squared byte differences exactly (below 2^24).
    difference = a.astype(np.float32) - b.astype(np.float32)
    squared = np.einsum("ij,ij->i", difference, difference)
    return np.asarray(np.sqrt(squared.astype(np.float64)))


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
    squared[i, j] = np.inf
    clear = best < ratio * ratio * squared.min(axis=1)
    squared[i, j] = best
    # Columns are slow to search: only those that somebody clearly wants.
    i, j = i[clear], j[clear]
    mutual = np.argmin(squared[:, j], axis=0) == i
    return i[mutual], j[mutual]


def _squared_distances(a: ByteArray, b: ByteArray) -> npt.NDArray[np.float32]:
    # Exact in float32: every sum of 128 products of bytes is below 2^24.
    x, y = a.astype(np.float32), b.astype(np.float32)
    out = np.asarray((-2.0 * x) @ y.T, np.float32)
    out += np.einsum("ij,ij->i", x, x)[:, None]
    out += np.einsum("ij,ij->i", y, y)
    return out
