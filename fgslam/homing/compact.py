"""What is kept of a path image in 20 kB: features that are found again, all around, rounded.

A path image of a mirror camera has some 700 SIFT features and 350 column segments, a large panorama
four times as many. The robot needs those that it will find again: those that the images before and
after show, too. Their votes come first, then how strong they are; each sector of bearing gives its
best in turn, as features on one side leave the homing vector open.

Descriptors are rounded to three bits. What that costs is measured: docs/results/own_routes.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgslam.core.arrays import ByteArray, FloatArray, IntArray
from fgslam.core.homing import BearingMatches, ColumnSegments, FeatureKind, OmniFeatures

MOST_SIFT, MOST_COLUMNS = 300, 100
"""Kept of an image: 18 kB in a file, whose frame takes 3 kB."""

_SECTORS = 16  # of bearing
_LEVELS = 25.0  # of a descriptor's element, a square root of its share, which rarely exceeds 0.3
_MOST_LEVELS = 15  # their squares are bytes


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """How often each feature of one image was found again in others.

    Attributes:
        sift: (n,) of its SIFT features.
        columns: (m,) of its column segments.
    """

    sift: FloatArray
    columns: FloatArray

    @staticmethod
    def none(features: OmniFeatures) -> Votes:
        """Of an image that was compared with no other."""
        return Votes(np.zeros(len(features.sift)), np.zeros(len(features.columns)))

    def plus(self, matches: BearingMatches, weight: float, *, second: bool) -> Votes:
        """With those features of accepted matches that are of its first or ``second`` image."""
        rows = matches.index_b if second else matches.index_a
        added = []
        for kind, votes in ((FeatureKind.SIFT, self.sift), (FeatureKind.COLUMN, self.columns)):
            votes = votes.copy()
            votes[rows[matches.kind == int(kind)]] += weight
            added.append(votes)
        return Votes(added[0], added[1])


def compacted(features: OmniFeatures, votes: Votes | None = None) -> OmniFeatures:
    """Features of a path image to keep: some of them, with rounded descriptors.

    Args:
        features: of the image, strongest first.
        votes: of neighbouring images; None where there were none.
    """
    votes = votes or Votes.none(features)
    sift = features.sift
    sift = sift.select(_best(sift.bearing, votes.sift, np.arange(len(sift)), MOST_SIFT))
    columns = features.columns
    shortest_last = np.argsort(np.argsort(-_lengths(columns), kind="stable"), kind="stable")
    chosen = _best(columns.bearing, votes.columns, shortest_last, MOST_COLUMNS)
    rounded = replace(sift, descriptors=_rounded(sift.descriptors))
    return OmniFeatures(rounded, columns.select(chosen))


def _lengths(columns: ColumnSegments) -> FloatArray:
    return np.asarray(np.abs(columns.tangents[:, 1] - columns.tangents[:, 0]))


def _best(bearing: FloatArray, votes: FloatArray, weaker: IntArray, most: int) -> IntArray:
    """Rows, ascending, of at most so many; ``weaker`` is their rank among equal votes."""
    return best_all_around(bearing, np.lexsort((weaker, -votes)), most, _SECTORS)


def best_all_around(bearing: FloatArray, order: IntArray, most: int, sectors: int) -> IntArray:
    """Rows, ascending, of at most so many: the best of each sector of bearing in turn.

    Args:
        bearing: (n,) radians.
        order: (n,) rows, the best first.
        most: that are chosen.
        sectors: equal ones, all around.
    """
    sector = np.floor(np.mod(bearing[order], 2.0 * np.pi) / (2.0 * np.pi / sectors))
    rank = np.zeros(len(order), np.int64)
    for k in range(sectors):
        inside = sector == k
        rank[inside] = np.arange(np.count_nonzero(inside))
    return np.asarray(np.sort(order[np.argsort(rank, kind="stable")[:most]]), np.int64)


def _rounded(descriptors: ByteArray) -> ByteArray:
    """Descriptors (n, 128) whose square roots, as matching compares them, have a few levels."""
    values = descriptors.astype(np.float64)
    share = values / np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    levels = np.minimum(np.round(_LEVELS * np.sqrt(share)), _MOST_LEVELS)
    return np.asarray(levels**2, np.uint8)
