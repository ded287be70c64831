"""A path as it is remembered: the features of its images, in order, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.array_files import ArrayFile, joined, of_rows, offsets, split, write_arrays
from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.errors import StoredMapError
from fgslam.core.homing import ColumnSegments, OmniFeatures, UprightFeatures

FILE = ArrayFile(
    name="fgslam path memory",
    versions=(1,),
    error=StoredMapError,
    give="give a file that holds one",
    again="write it again",
)


@dataclass(frozen=True, slots=True, eq=False)
class PathMemory:
    """Target images of a path.

    Attributes:
        images: their features, in the order in which they are to be reached.
        names: of the images, for people; as many.
    """

    images: tuple[OmniFeatures, ...]
    names: tuple[str, ...]

    @staticmethod
    def of(images: Sequence[OmniFeatures], names: Sequence[str] | None = None) -> PathMemory:
        """A memory; images without names are numbered.

        Raises:
            StoredMapError: there is not one name an image.
        """
        chosen = tuple(str(k) for k in range(len(images))) if names is None else tuple(names)
        if len(chosen) != len(images):
            raise StoredMapError(
                f"path: {len(chosen)} names for {len(images)} images; give one name an image"
            )
        return PathMemory(tuple(images), chosen)

    def __len__(self) -> int:
        return len(self.images)

    def save(self, path: str | Path) -> float:
        """Writes the memory atomically.

        Returns:
            Kilobytes (of 1000 bytes) an image.

        Raises:
            OutputError: it cannot be written.
        """
        return save_images(FILE, path, self.images, self.names)

    @staticmethod
    def load(path: str | Path) -> PathMemory:
        """Reads a memory; pixel positions of features are NaN.

        Raises:
            StoredMapError: the file is missing, truncated, damaged, foreign or of another version.
        """
        images, names, _ = load_images(FILE, path)
        return PathMemory(images, names)


# --------------------------------------------------------------------------------------------
# Files of named images


def save_images(
    kind: ArrayFile,
    path: str | Path,
    images: Sequence[OmniFeatures],
    names: Sequence[str],
    others: StateArrays | None = None,
) -> float:
    """Writes features and names of images atomically, and ``others`` beside them.

    Returns:
        Kilobytes (of 1000 bytes) an image.

    Raises:
        OutputError: the file cannot be written.
    """
    arrays = kind.header(names=list(names)) | pack_features(images) | (others or {})
    return write_arrays(Path(path), arrays, compressed=True) / 1000.0 / max(len(images), 1)


def load_images(
    kind: ArrayFile, path: str | Path
) -> tuple[tuple[OmniFeatures, ...], tuple[str, ...], StateArrays]:
    """Features and names of images, and all arrays of their file.

    Raises:
        StoredMapError: the file is missing, truncated, damaged, foreign or of another version.
    """
    arrays = kind.load(Path(path))
    names = kind.read_header(arrays, str(path)).get("names")
    images = unpack_features(arrays, str(path))
    if not isinstance(names, list) or len(names) != len(images):
        raise StoredMapError(f"{path}: not one name an image; write the file again")
    return images, tuple(str(name) for name in names), arrays


# --------------------------------------------------------------------------------------------
# Features of many images as plain arrays: SIFT descriptors are bytes; angles, sizes and column
# descriptors float32 (1e-7 of themselves); deviations and colours float16 (5e-4 of themselves).
# Where a feature lay in the image is not kept: it is NaN after reading.


_FEATURES = ArrayFile(
    name="fgslam features",
    versions=(1,),
    error=StoredMapError,
    give="give a file that holds some",
    again="write the file again",
)

# Arrays by what their first axis counts, with type and the shape of an item.
_SIFT: dict[str, tuple[type, tuple[int, ...]]] = {
    "sift_bearing": (np.float32, ()),
    "sift_elevation": (np.float32, ()),
    "sift_spread": (np.float16, (3,)),  # two deviations and the correlation
    "sift_scale": (np.float32, ()),
    "sift_descriptors": (np.uint8, (128,)),
    "sift_colour": (np.float16, (3,)),
}
_COLUMNS: dict[str, tuple[type, tuple[int, ...]]] = {
    "column_bearing": (np.float32, ()),
    "column_sigma_bearing": (np.float16, ()),
    "column_tangents": (np.float32, (2,)),
    "column_sigma_tangents": (np.float16, (2,)),
    "column_descriptors": (np.float32, (11,)),  # float16 changed one column match in seven
}


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
        OmniFeatures(_sift_of(s), _column_segments(c)) for s, c in zip(sift, columns, strict=True)
    )


def _split(
    arrays: Mapping[str, Any],
    start: str,
    specification: Mapping[str, tuple[type, tuple[int, ...]]],
    where: str,
) -> list[dict[str, Any]]:
    rows = _FEATURES.require_offsets(arrays, start, None, where)
    kinds = {name: (np.dtype(kind).kind, item) for name, (kind, item) in specification.items()}
    _FEATURES.require(arrays, of_rows(rows, kinds), where)
    whole = {name: split(arrays[name], arrays[start]) for name in specification}
    return [
        {name: parts[k] for name, parts in whole.items()} for k in range(len(arrays[start]) - 1)
    ]


# --------------------------------------------------------------------------------------------
# One image


def _sift_arrays(features: UprightFeatures) -> dict[str, Any]:
    deviations = np.sqrt(features.covariance[:, [0, 1], [0, 1]])
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = features.covariance[:, 0, 1] / deviations.prod(axis=1)
    return {
        "sift_bearing": features.bearing,
        "sift_elevation": features.elevation,
        "sift_spread": np.column_stack([deviations, np.nan_to_num(correlation)]),
        "sift_scale": features.scale,
        "sift_descriptors": features.descriptors,
        "sift_colour": features.colour,
    }


def _sift_of(part: Mapping[str, Any]) -> UprightFeatures:
    n = len(part["sift_bearing"])
    spread = _doubles(part["sift_spread"])
    covariance = np.empty((n, 2, 2))
    covariance[:, [0, 1], [0, 1]] = spread[:, :2] ** 2
    covariance[:, 0, 1] = covariance[:, 1, 0] = spread.prod(axis=1)
    return UprightFeatures(
        pixels=np.full((n, 2), np.nan),
        bearing=_doubles(part["sift_bearing"]),
        elevation=_doubles(part["sift_elevation"]),
        covariance=covariance,
        scale=_doubles(part["sift_scale"]),
        descriptors=part["sift_descriptors"],
        colour=_doubles(part["sift_colour"]),
    )


def _column_arrays(segments: ColumnSegments) -> dict[str, Any]:
    return {
        "column_bearing": segments.bearing,
        "column_sigma_bearing": segments.sigma_bearing,
        "column_tangents": segments.tangents,
        "column_sigma_tangents": segments.sigma_tangents,
        "column_descriptors": segments.descriptors,
    }


def _column_segments(part: Mapping[str, Any]) -> ColumnSegments:
    return ColumnSegments(
        bearing=_doubles(part["column_bearing"]),
        sigma_bearing=_doubles(part["column_sigma_bearing"]),
        tangents=_doubles(part["column_tangents"]),
        sigma_tangents=_doubles(part["column_sigma_tangents"]),
        descriptors=_doubles(part["column_descriptors"]),
    )


def _doubles(array: np.ndarray[Any, Any]) -> FloatArray:
    return array.astype(np.float64)
