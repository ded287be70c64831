"""Features of images as a file keeps them, each number as coarse as it may be.

Angles in steps of a ten-thousandth of a radian, a fiftieth of a feature's own deviation;
deviations and sizes as bytes on a logarithmic scale, 3 % of themselves; colours, 1 %; column
descriptors, which are compared in steep combinations, with 13 bits of mantissa. Where a
feature lay in the image is not kept: it is NaN after reading.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import ByteArray, Float32, FloatArray, IntArray
from fgslam.core.bearings import (
    BearingMatches,
    ColumnSegments,
    FeatureKind,
    OmniFeatures,
    UprightFeatures,
)

_ANGLE = 32767.0 / np.pi
_LEAST, _MOST = 1e-5, 10.0  # of what is kept as a byte, radians
_BYTE = 255.0 / np.log(_MOST / _LEAST)
_CORRELATION = 127.0
_MANTISSA = 10  # bits of 23 that are dropped


@dataclass(frozen=True, slots=True, eq=False)
class CoarseSift:
    """SIFT features of one image as a file keeps them.

    Attributes:
        bearing, elevation: (n,) int16.
        spread: (n, 2) uint8, deviations of both; correlation: (n,) int8, between them.
        scale: (n,) uint8.
        descriptors: (n, 128) uint8.
        colour: (n, 3) float16.
    """

    bearing: npt.NDArray[np.int16]
    elevation: npt.NDArray[np.int16]
    spread: ByteArray
    correlation: npt.NDArray[np.int8]
    scale: ByteArray
    descriptors: ByteArray
    colour: npt.NDArray[np.float16]

    @staticmethod
    def of(features: UprightFeatures) -> CoarseSift:
        """The features, rounded."""
        deviations = np.sqrt(features.covariance[:, [0, 1], [0, 1]])
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation = features.covariance[:, 0, 1] / deviations.prod(axis=1)
        correlation = np.clip(np.nan_to_num(correlation), -1, 1)
        return CoarseSift(
            bearing=_steps(features.bearing),
            elevation=_steps(features.elevation),
            spread=_bytes(deviations),
            correlation=np.round(_CORRELATION * correlation).astype(np.int8),
            scale=_bytes(features.scale),
            descriptors=features.descriptors,
            colour=_coarse(features.colour),
        )

    def features(self) -> UprightFeatures:
        """The features back; their places in the image are NaN."""
        n, sigmas = len(self.bearing), _of_bytes(self.spread)
        covariance = np.empty((n, 2, 2))
        covariance[:, [0, 1], [0, 1]] = sigmas**2
        covariance[:, 0, 1] = covariance[:, 1, 0] = (
            sigmas[:, 0] * sigmas[:, 1] * (self.correlation / _CORRELATION)
        )
        return UprightFeatures(
            pixels=np.full((n, 2), np.nan),
            bearing=self.bearing / _ANGLE,
            elevation=self.elevation / _ANGLE,
            covariance=covariance,
            scale=_of_bytes(self.scale),
            descriptors=self.descriptors,
            colour=self.colour.astype(np.float64),
        )


@dataclass(frozen=True, slots=True, eq=False)
class CoarseColumns:
    """Column segments of one image as a file keeps them.

    Attributes:
        bearing: (n,) int16; sigma_bearing: (n,) uint8.
        tangents: (n, 2) float32; sigma_tangents: (n, 2) uint8.
        descriptors: (n, 11) float32.
    """

    bearing: npt.NDArray[np.int16]
    sigma_bearing: ByteArray
    tangents: Float32
    sigma_tangents: ByteArray
    descriptors: Float32

    @staticmethod
    def of(segments: ColumnSegments) -> CoarseColumns:
        """The segments, rounded."""
        return CoarseColumns(
            bearing=_steps(segments.bearing),
            sigma_bearing=_bytes(segments.sigma_bearing),
            tangents=_shortened(segments.tangents),
            sigma_tangents=_bytes(segments.sigma_tangents),
            descriptors=_shortened(segments.descriptors),
        )

    def segments(self) -> ColumnSegments:
        """The segments back."""
        return ColumnSegments(
            bearing=self.bearing / _ANGLE,
            sigma_bearing=_of_bytes(self.sigma_bearing),
            tangents=self.tangents.astype(np.float64),
            sigma_tangents=_of_bytes(self.sigma_tangents),
            descriptors=self.descriptors.astype(np.float64),
        )


@dataclass(frozen=True, slots=True, eq=False)
class CoarseFeatures:
    """Features of one image as a file keeps them."""

    sift: CoarseSift
    columns: CoarseColumns

    @staticmethod
    def of(image: OmniFeatures) -> CoarseFeatures:
        """The features, rounded."""
        return CoarseFeatures(CoarseSift.of(image.sift), CoarseColumns.of(image.columns))

    def features(self) -> OmniFeatures:
        """The features back."""
        return OmniFeatures(self.sift.features(), self.columns.segments())


def _steps(angle: FloatArray) -> npt.NDArray[np.int16]:
    """Angles in [-pi, pi] as whole numbers."""
    return np.round(_ANGLE * angle).astype(np.int16)


def _bytes(values: FloatArray) -> ByteArray:
    """Positive values on a logarithmic scale as whole numbers, 0 to 255."""
    inside = np.clip(values, _LEAST, _MOST)
    return np.asarray(np.round(_BYTE * np.log(inside / _LEAST)), np.uint8)


def _of_bytes(codes: ByteArray) -> FloatArray:
    return np.asarray(_LEAST * np.exp(codes / _BYTE))


def _shortened(values: FloatArray) -> Float32:
    """Values as float32 that end in zeros, which a file's compression takes away."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    half = np.uint32(1 << (_MANTISSA - 1))
    kept = (bits + half) & np.uint32(0xFFFFFFFF << _MANTISSA & 0xFFFFFFFF)
    return kept.view(np.float32)


def _coarse(values: FloatArray) -> npt.NDArray[np.float16]:
    """Values as float16 with six bits of mantissa: 0.8 % of themselves."""
    bits = np.ascontiguousarray(values, np.float16).view(np.uint16)
    return ((bits + np.uint16(8)) & np.uint16(0xFFF0)).view(np.float16)


# --------------------------------------------------------------------------------------------
# What is kept of a path image in 20 kB: features that are found again, all around, rounded
#
# A path image of a mirror camera has some 700 SIFT features and 350 column segments, a large
# panorama four times as many. The robot needs those that it will find again: those that the images
# before and after show, too. Their votes come first, then how strong they are; each sector of
# bearing gives its best in turn, as features on one side leave the homing vector open.
#
# Descriptors are rounded to three bits. What that costs is measured: docs/results/routes.md.


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
    lengths = np.abs(columns.tangents[:, 1] - columns.tangents[:, 0])
    shortest_last = np.argsort(np.argsort(-lengths, kind="stable"), kind="stable")
    chosen = _best(columns.bearing, votes.columns, shortest_last, MOST_COLUMNS)
    rounded = replace(sift, descriptors=_rounded(sift.descriptors))
    return OmniFeatures(rounded, columns.select(chosen))


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
