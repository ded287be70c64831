"""Landmark maps as point clouds: .ply (everything), .pcd (single precision).

Written with NumPy alone, so that no viewer's library is needed; the same map gives the same
bytes. Coordinates are those of the world frame: the reference camera's first frame, x right,
y DOWN, z forward, metres. The .ply is also how a map is read back (:func:`read_ply`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.errors import DatasetError, OutputError
from fgslam.core.files import write_bytes

Records: TypeAlias = npt.NDArray[np.void]

_COVARIANCE_NAMES = ("cxx", "cxy", "cxz", "cyy", "cyz", "czz")
_UPPER = np.triu_indices(3)
_INT32_MAX = 2**31 - 1

# One landmark in the .ply file; `packed`, little-endian, as the format wants it.
_PLY_DTYPE = np.dtype(
    [(name, "<f8") for name in "xyz"]
    + [(name, "u1") for name in ("red", "green", "blue")]
    + [(name, "<i4") for name in ("landmark_id", "hits", "misses")]
    + [(name, "<f8") for name in _COVARIANCE_NAMES]
    + [(name, "u1") for name in ("valid", "permanent")]
)
# PCL's point types are single precision; double x, y, z would not be recognised by its tools.
_PCD_DTYPE = np.dtype(
    [(name, "<f4") for name in "xyz"]
    + [(name, "<u4") for name in ("rgb", "landmark_id", "hits", "misses")]
    + [(name, "<f4") for name in _COVARIANCE_NAMES]
    + [(name, "u1") for name in ("valid", "permanent")]
)
_PLY_TYPES = {
    "f8": "double",
    "f4": "float",
    "i4": "int",
    "u4": "uint",
    "i2": "short",
    "u2": "ushort",
    "i1": "char",
    "u1": "uchar",
}
_PLY_SYNONYMS = {
    "float64": "f8",
    "float32": "f4",
    "int32": "i4",
    "uint32": "u4",
    "int16": "i2",
    "uint16": "u2",
    "int8": "i1",
    "uint8": "u1",
} | {name: code for code, name in _PLY_TYPES.items()}
_NORMALS = {".ply": ("nx", "ny", "nz"), ".pcd": ("normal_x", "normal_y", "normal_z")}
_PLY_COMMENTS = (
    "comment fgslam landmark map 1",
    "comment world = first reference camera: x right, y down, z forward, metres",
    "comment cxx .. czz: covariance of the position in the world, metres squared",
)


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints(Rows):
    """The landmarks of a run, as they are handed to other tools; one row each.

    Attributes:
        ids: (n,) landmark identities, 0 to 2^31 - 1.
        positions: (n, 3) world, metres.
        covariances: (n, 3, 3) world, metres squared.
        colours: (n, 3) red, green, blue, uint8.
        hits: (n,) frames that matched the landmark.
        misses: (n,) frames that expected and did not find it.
        valid: (n,) seen often enough to be trusted (Se et al. 6.1).
        permanent: (n,) never pruned (Se et al. 6.2).
        normals: (n, 3) world, unit vectors out of the surface towards the camera, or None.
    """

    ids: IntArray
    positions: FloatArray
    covariances: FloatArray
    colours: ByteArray
    hits: IntArray
    misses: IntArray
    valid: BoolArray
    permanent: BoolArray
    normals: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.ids)
        shapes = {
            "positions": (n, 3),
            "covariances": (n, 3, 3),
            "colours": (n, 3),
            "hits": (n,),
            "misses": (n,),
            "valid": (n,),
            "permanent": (n,),
        } | ({} if self.normals is None else {"normals": (n, 3)})
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, not {shape}")


def write_map(path: Path, points: MapPoints, remark: str = "") -> None:
    """Write a map in the format that the suffix names: `.ply` or `.pcd`.

    Args:
        path: the file to write, atomically.
        points: the landmarks.
        remark: ASCII, put into a comment of the file.

    Raises:
        OutputError: the suffix is another one, a landmark is not finite, or writing failed.
    """
    writers = {".ply": write_ply, ".pcd": write_pcd}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise OutputError(
            f"cannot write {path}: unknown map format '{path.suffix}'; use .ply or .pcd"
        )
    writer(path, points, remark)


# --------------------------------------------------------------------------------------------
# PLY


def write_ply(path: Path, points: MapPoints, remark: str = "") -> None:
    """Write a binary little-endian .ply with every property of every landmark, exactly.

    Args:
        path: the file to write, atomically.
        points: the landmarks.
        remark: ASCII, put into a comment of the header.

    Raises:
        OutputError: a landmark is not finite, an id needs more than 31 bits, or writing failed.
    """
    _require_writable(path, points)
    records = np.empty(len(points), _with_normals(_PLY_DTYPE, points, ".ply"))
    for column, name in enumerate("xyz"):
        records[name] = points.positions[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        records[name] = points.colours[:, column]
    _fill_bookkeeping(records, points)
    header = ["ply", "format binary_little_endian 1.0", *_PLY_COMMENTS]
    header += [f"comment {remark}"] if remark else []
    header += [f"element vertex {len(points)}"]
    header += [
        f"property {_PLY_TYPES[records.dtype[name].str[1:]]} {name}"
        for name in records.dtype.names or ()
    ]
    header += ["end_header\n"]
    write_bytes(path, "\n".join(header).encode("ascii") + records.tobytes())


def read_ply(path: Path) -> MapPoints:
    """Read a map that :func:`write_ply` wrote.

    Raises:
        DatasetError: the file is missing, cut off, or not a landmark map of this program.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}; check the path") from error
    end = content.find(b"end_header\n")
    if not content.startswith(b"ply") or end < 0:
        raise DatasetError(f"{path} is not a .ply file; give the map.ply of a run folder")
    dtype, count = _parse_ply_header(path, content[:end].decode("ascii", errors="replace"))
    body = content[end + len(b"end_header\n") :]
    missing = [name for name in _PLY_DTYPE.names or () if name not in (dtype.names or ())]
    if missing:
        raise DatasetError(
            f"{path} has no property '{missing[0]}'; give the map.ply of a run folder"
        )
    if len(body) < count * dtype.itemsize:
        raise DatasetError(
            f"{path} is cut off: {len(body)} bytes of landmarks instead of "
            f"{count * dtype.itemsize}; run the experiment again"
        )
    return _from_records(np.frombuffer(body, dtype, count))


def _parse_ply_header(path: Path, header: str) -> tuple[np.dtype[Any], int]:
    fields: list[tuple[str, str]] = []
    count = -1
    for line in header.splitlines():
        words = line.split()
        if words[:1] == ["format"] and words[1:2] != ["binary_little_endian"]:
            raise DatasetError(
                f"{path} is not binary little-endian; give the map.ply of a run folder"
            )
        if words[:2] == ["element", "vertex"] and len(words) == 3 and words[2].isdigit():
            count = int(words[2])
        if words[:1] == ["property"]:
            code = _PLY_SYNONYMS.get(words[1]) if len(words) == 3 else None
            if code is None:
                raise DatasetError(
                    f"{path} has a property that maps do not have: '{line}'; "
                    "give the map.ply of a run folder"
                )
            fields.append((words[2], f"<{code}"))
    if count < 0:
        raise DatasetError(f"{path} does not say how many points it holds; write it again")
    return np.dtype(fields), count


def _from_records(records: Records) -> MapPoints:
    covariances = np.empty((len(records), 3, 3))
    upper = np.column_stack([records[name] for name in _COVARIANCE_NAMES])
    covariances[:, _UPPER[0], _UPPER[1]] = upper
    covariances[:, _UPPER[1], _UPPER[0]] = upper
    return MapPoints(
        ids=records["landmark_id"].astype(np.int64),
        positions=np.column_stack([records[name] for name in "xyz"]).astype(np.float64),
        covariances=covariances,
        colours=np.column_stack([records[name] for name in ("red", "green", "blue")]),
        hits=records["hits"].astype(np.int64),
        misses=records["misses"].astype(np.int64),
        valid=records["valid"] != 0,
        permanent=records["permanent"] != 0,
        normals=_normals_in(records),
    )


def _normals_in(records: Records) -> FloatArray | None:
    names = _NORMALS[".ply"]
    if not set(names) <= set(records.dtype.names or ()):
        return None
    return np.column_stack([records[name] for name in names]).astype(np.float64)


# --------------------------------------------------------------------------------------------
# PCD


def write_pcd(path: Path, points: MapPoints, remark: str = "") -> None:
    """Write a binary .pcd 0.7 (PCL, Open3D, CloudCompare), single precision.

    Args:
        path: the file to write, atomically.
        points: the landmarks.
        remark: ASCII, put into a comment line.

    Raises:
        OutputError: as :func:`write_ply`.
    """
    _require_writable(path, points)
    records = np.empty(len(points), _with_normals(_PCD_DTYPE, points, ".pcd"))
    for column, name in enumerate("xyz"):
        records[name] = points.positions[:, column]
    red, green, blue = points.colours.astype(np.uint32).T
    records["rgb"] = (red << 16) | (green << 8) | blue
    _fill_bookkeeping(records, points)
    names = records.dtype.names or ()
    kinds = [records.dtype[name] for name in names]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *([f"# {remark}"] if remark else []),
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        "DATA binary\n",
    ]
    write_bytes(path, "\n".join(header).encode("ascii") + records.tobytes())


def _with_normals(dtype: np.dtype[Any], points: MapPoints, suffix: str) -> np.dtype[Any]:
    """The type of a landmark, with a normal at its end where there are normals."""
    if points.normals is None:
        return dtype
    return np.dtype([*dtype.descr, *((name, "<f4") for name in _NORMALS[suffix])])


def _fill_bookkeeping(records: Records, points: MapPoints) -> None:
    records["landmark_id"] = points.ids
    records["hits"] = points.hits
    records["misses"] = points.misses
    records["valid"] = points.valid
    records["permanent"] = points.permanent
    upper = points.covariances[:, _UPPER[0], _UPPER[1]]
    for column, name in enumerate(_COVARIANCE_NAMES):
        records[name] = upper[:, column]
    if points.normals is not None:
        for column, name in enumerate((records.dtype.names or ())[-3:]):
            records[name] = points.normals[:, column]


def _require_writable(path: Path, points: MapPoints) -> None:
    finite = np.isfinite(points.positions).all(axis=1)
    finite &= np.isfinite(points.covariances).all(axis=(1, 2))
    if not finite.all():
        worst = int(points.ids[int(np.argmin(finite))])
        raise OutputError(
            f"cannot write {path}: landmark {worst} is not finite; the estimator diverged, "
            "check the measurements of that landmark"
        )
    if len(points) and (points.ids.min() < 0 or points.ids.max() > _INT32_MAX):
        raise OutputError(
            f"cannot write {path}: landmark ids must lie in 0 .. {_INT32_MAX}; renumber them"
        )
