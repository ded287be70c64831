"""Features of many images as one compact ``.npz`` of plain arrays: no pixels, no pickle.

Features of all images lie one after the other, with offsets: those of image ``k`` are rows
``start[k]:start[k + 1]``. SIFT descriptors are bytes; angles, sizes and column descriptors float32
(1e-7 of themselves); deviations and colours float16 (5e-4 of themselves). Every member of the
archive carries a CRC, which reading checks. Where a feature lay in the image is not kept: it is NaN
after reading.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray, StateArrays
from fgslam.core.atomic_files import replacing
from fgslam.core.errors import MeasurementLogError, StoredMapError
from fgslam.core.homing import ColumnSegments, OmniFeatures, UprightFeatures
from fgslam.core.measurement_log import load_arrays

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
        "sift_start": _offsets([len(i.sift) for i in images]),
        "column_start": _offsets([len(i.columns) for i in images]),
    }
    sift = [_sift_arrays(i.sift) for i in images]
    columns = [_column_arrays(i.columns) for i in images]
    for specification, parts in ((_SIFT, sift), (_COLUMNS, columns)):
        for name, (kind, item) in specification.items():
            blank: np.ndarray[Any, Any] = np.empty((0, *item), dtype=kind)
            out[name] = np.concatenate([blank, *(p[name].astype(kind) for p in parts)])
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
        raise StoredMapError(f"{where}: array column_start is damaged; write the file again")
    return tuple(
        OmniFeatures(_sift(s), _column_segments(c)) for s, c in zip(sift, columns, strict=True)
    )


def save_archive(path: Path, form: str, version: int, header: Any, arrays: StateArrays) -> int:
    """Writes arrays with their header, whole or not at all; the same input gives the same bytes.

    Args:
        path: its folder must exist.
        form: name of the format.
        version: of the format.
        header: plain JSON values.
        arrays: without one called ``header``.

    Returns:
        Size of the file in bytes.

    Raises:
        OutputError: it cannot be written.
    """
    text = json.dumps({"format": form, "version": version, **header}, sort_keys=True)
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, header=np.array(text), **arrays)
        return file.tell()


def load_archive(path: Path, form: str, version: int) -> tuple[dict[str, Any], StateArrays]:
    """Header and arrays of a file that :func:`save_archive` wrote.

    Raises:
        StoredMapError: it is missing, truncated, damaged, foreign, or of another version.
    """
    try:
        arrays = load_arrays(path)
    except MeasurementLogError as error:
        raise StoredMapError(str(error)) from None
    try:
        header = json.loads(str(arrays.pop("header")))
    except (KeyError, json.JSONDecodeError):
        header = None
    if not isinstance(header, dict) or header.get("format") != form:
        raise StoredMapError(f"{path}: not an {form}; give a file that holds one")
    if header.get("version") != version:
        raise StoredMapError(
            f"{path}: {form} of version {header.get('version')}, this fgslam reads version "
            f"{version}; build it again or use the matching fgslam"
        )
    return header, arrays


def require_array(
    arrays: Mapping[str, Any], name: str, kind: str, shape: tuple[int, ...], where: str
) -> np.ndarray[Any, Any]:
    """An array of this kind (of ``numpy.dtype.kind``) and shape.

    Raises:
        StoredMapError: there is none.
    """
    array = arrays.get(name)
    if not isinstance(array, np.ndarray) or array.dtype.kind != kind or array.shape != shape:
        raise StoredMapError(f"{where}: array {name} is absent or damaged; write the file again")
    return array


def _offsets(sizes: Sequence[int]) -> IntArray:
    return np.cumsum([0, *sizes]).astype(np.int64)


def _split(
    arrays: Mapping[str, Any],
    offsets: str,
    specification: Mapping[str, tuple[type, tuple[int, ...]]],
    where: str,
) -> list[dict[str, Any]]:
    start = arrays.get(offsets)
    if not isinstance(start, np.ndarray) or start.dtype.kind != "i" or start.ndim != 1:
        raise StoredMapError(f"{where}: array {offsets} is absent or damaged; write the file again")
    if not len(start) or start[0] != 0 or (np.diff(start) < 0).any():
        raise StoredMapError(f"{where}: array {offsets} is damaged; write the file again")
    parts: list[dict[str, Any]] = [{} for _ in range(len(start) - 1)]
    for name, (kind, item) in specification.items():
        shape = (int(start[-1]), *item)
        whole = require_array(arrays, name, np.dtype(kind).kind, shape, where)
        for part, rows in zip(parts, np.split(whole, start[1:-1]), strict=len(parts) > 0):
            part[name] = rows
    return parts


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


def _sift(part: Mapping[str, Any]) -> UprightFeatures:
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
