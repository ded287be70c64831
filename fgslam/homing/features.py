"""Features of many images as the arrays of a file, each number as coarse as it may be.

Version 2: angles in steps of a ten-thousandth of a radian, a fiftieth of a feature's own deviation;
deviations and sizes as bytes on a logarithmic scale, 3 % of themselves; colours, 1 %; column
descriptors, which are compared in steep combinations, with 13 bits of mantissa. Version 1 had
float32 throughout. SIFT descriptors are bytes in both. Where a feature lay in the image is not
kept: it is NaN after reading.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.arrays import ByteArray, FloatArray, IntArray, StateArrays
from fgslam.core.bearings import (
    BearingMatches,
    ColumnSegments,
    FeatureKind,
    OmniFeatures,
    UprightFeatures,
)
from fgslam.core.errors import StoredMapError
from fgslam.core.store import ArrayFile, joined, of_rows, offsets, require_finite, split

VERSIONS = (2,)
"""Of files that hold features."""

_FEATURES = ArrayFile(
    name="fgslam features",
    versions=VERSIONS,
    error=StoredMapError,
    give="give a file that holds some",
    again="write the file again",
)

Array: TypeAlias = np.ndarray[Any, Any]
_Arrays: TypeAlias = dict[str, tuple[type, tuple[int, ...]]]
"""Arrays by what their first axis counts, with type and the shape of an item."""

_SIFT: _Arrays = {
    "sift_bearing": (np.int16, ()),
    "sift_elevation": (np.int16, ()),
    "sift_spread": (np.uint8, (2,)),
    "sift_correlation": (np.int8, ()),
    "sift_scale": (np.uint8, ()),
    "sift_descriptors": (np.uint8, (128,)),
    "sift_colour": (np.float16, (3,)),
}
_COLUMNS: _Arrays = {
    "column_bearing": (np.int16, ()),
    "column_sigma_bearing": (np.uint8, ()),
    "column_tangents": (np.float32, (2,)),
    "column_sigma_tangents": (np.uint8, (2,)),
    "column_descriptors": (np.float32, (11,)),
}
_ANGLE = 32767.0 / np.pi
_LEAST, _MOST = 1e-5, 10.0  # of what is kept as a byte, radians
_BYTE = 255.0 / np.log(_MOST / _LEAST)
_CORRELATION = 127.0
_MANTISSA = 10  # bits of 23 that are dropped


def pack_features(images: Sequence[OmniFeatures]) -> StateArrays:
    """All features of images, in their order, as the arrays of a file."""
    out: StateArrays = {
        "sift_start": offsets([len(i.sift) for i in images]),
        "column_start": offsets([len(i.columns) for i in images]),
    }
    sift = [_sift_arrays(i.sift) for i in images]
    columns = [_column_arrays(i.columns) for i in images]
    for specification, parts in ((_SIFT, sift), (_COLUMNS, columns)):
        for name, (kind, item) in specification.items():
            out[name] = joined([p[name].astype(kind) for p in parts], item, kind)
    return out


def unpack_features(arrays: Mapping[str, Any], where: str) -> tuple[OmniFeatures, ...]:
    """The features back.

    Args:
        arrays: as :func:`pack_features` made them; others among them are passed over.
        where: the file's name, for messages.

    Raises:
        StoredMapError: an array is absent or damaged.
    """
    sift = _split(arrays, "sift_start", _SIFT, where)
    columns = _split(arrays, "column_start", _COLUMNS, where)
    if len(sift) != len(columns):
        raise _FEATURES.damaged("column_start", where)
    return tuple(
        OmniFeatures(_sift_of(s), _columns_of(c)) for s, c in zip(sift, columns, strict=True)
    )


def _split(
    arrays: Mapping[str, Any], start: str, specification: _Arrays, where: str
) -> list[dict[str, Array]]:
    rows = _FEATURES.require_offsets(arrays, start, None, where)
    kinds = {name: (np.dtype(kind).kind, item) for name, (kind, item) in specification.items()}
    _FEATURES.require(arrays, of_rows(rows, kinds), where)
    _require_values(arrays, specification, where)
    whole = {name: split(arrays[name], arrays[start]) for name in specification}
    return [
        {name: parts[k] for name, parts in whole.items()} for k in range(len(arrays[start]) - 1)
    ]


_CODES: dict[str, float] = {
    "sift_bearing": np.pi * _ANGLE,
    "sift_elevation": 0.5 * np.pi * _ANGLE + 1.0,
    "sift_correlation": _CORRELATION,
    "column_bearing": np.pi * _ANGLE,
}
"""Largest whole numbers that features are kept as, of either sign."""


def _require_values(arrays: Mapping[str, Any], specification: _Arrays, where: str) -> None:
    """Raises StoredMapError for what no image's features are."""
    for name, (kind, _) in specification.items():
        if np.dtype(kind).kind == "f":
            require_finite(_FEATURES, arrays, (name,), where)
        elif name in _CODES and (np.abs(arrays[name].astype(np.int64)) > _CODES[name]).any():
            raise _FEATURES.damaged(name, where)


# --------------------------------------------------------------------------------------------
# One image to its arrays


def _sift_arrays(features: UprightFeatures) -> dict[str, Array]:
    deviations = np.sqrt(features.covariance[:, [0, 1], [0, 1]])
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = features.covariance[:, 0, 1] / deviations.prod(axis=1)
    return {
        "sift_bearing": _steps(features.bearing),
        "sift_elevation": _steps(features.elevation),
        "sift_spread": _bytes(deviations),
        "sift_correlation": np.round(_CORRELATION * np.clip(np.nan_to_num(correlation), -1, 1)),
        "sift_scale": _bytes(features.scale),
        "sift_descriptors": features.descriptors,
        "sift_colour": _coarse(features.colour),
    }


def _column_arrays(segments: ColumnSegments) -> dict[str, Array]:
    return {
        "column_bearing": _steps(segments.bearing),
        "column_sigma_bearing": _bytes(segments.sigma_bearing),
        "column_tangents": _shortened(segments.tangents),
        "column_sigma_tangents": _bytes(segments.sigma_tangents),
        "column_descriptors": _shortened(segments.descriptors),
    }


def _steps(angle: FloatArray) -> FloatArray:
    """Angles in [-pi, pi] as whole numbers."""
    return np.asarray(np.round(_ANGLE * angle))


def _bytes(values: FloatArray) -> FloatArray:
    """Positive values on a logarithmic scale as whole numbers, 0 to 255."""
    inside = np.clip(values, _LEAST, _MOST)
    return np.asarray(np.round(_BYTE * np.log(inside / _LEAST)))


def _shortened(values: FloatArray) -> Array:
    """Values as float32 that end in zeros, which a file's compression takes away."""
    bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
    half = np.uint32(1 << (_MANTISSA - 1))
    kept = (bits + half) & np.uint32(0xFFFFFFFF << _MANTISSA & 0xFFFFFFFF)
    return kept.view(np.float32)


def _coarse(values: FloatArray) -> Array:
    """Values as float16 with six bits of mantissa: 0.8 % of themselves."""
    bits = np.ascontiguousarray(values, np.float16).view(np.uint16)
    return ((bits + np.uint16(8)) & np.uint16(0xFFF0)).view(np.float16)


# --------------------------------------------------------------------------------------------
# And back


def _of_bytes(codes: Array) -> FloatArray:
    return np.asarray(_LEAST * np.exp(codes / _BYTE))


def _sift_of(part: Mapping[str, Array]) -> UprightFeatures:
    n = len(part["sift_bearing"])
    sigmas, correlation = _of_bytes(part["sift_spread"]), part["sift_correlation"] / _CORRELATION
    covariance = np.empty((n, 2, 2))
    covariance[:, [0, 1], [0, 1]] = sigmas**2
    covariance[:, 0, 1] = covariance[:, 1, 0] = sigmas[:, 0] * sigmas[:, 1] * correlation
    return UprightFeatures(
        pixels=np.full((n, 2), np.nan),
        bearing=part["sift_bearing"] / _ANGLE,
        elevation=part["sift_elevation"] / _ANGLE,
        covariance=covariance,
        scale=_of_bytes(part["sift_scale"]),
        descriptors=part["sift_descriptors"],
        colour=_doubles(part["sift_colour"]),
    )


def _columns_of(part: Mapping[str, Array]) -> ColumnSegments:
    return ColumnSegments(
        bearing=part["column_bearing"] / _ANGLE,
        sigma_bearing=_of_bytes(part["column_sigma_bearing"]),
        tangents=_doubles(part["column_tangents"]),
        sigma_tangents=_of_bytes(part["column_sigma_tangents"]),
        descriptors=_doubles(part["column_descriptors"]),
    )


def _doubles(array: Array) -> FloatArray:
    return array.astype(np.float64)


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
