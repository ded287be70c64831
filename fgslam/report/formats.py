"""Results for other tools: .ply and .pcd maps, .g2o graphs, COLMAP models, ROS 2 bags."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.errors import DatasetError, OutputError
from fgslam.core.files import clear_output_errors, write_bytes, write_text
from fgslam.core.geometry import congruence, inverse, quaternion_from_rotation
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Trajectory, pose_rows

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


GRAPH_SUFFIX = ".g2o"
EXACT_SIGMA = 1e-6
"""Standard deviation (m, rad) in place of zero: a file of information cannot say `exact`."""

_OFFSET_ID = 0  # of the sensor in the pose's frame: the identity, poses are the camera's own
_UPPER3, _UPPER6 = np.triu_indices(3), np.triu_indices(6)
# From our tangent [rotation vector, translation] to g2o's [translation, quaternion's vector].
_OURS_OF_G2O = np.block([[np.zeros((3, 3)), 2.0 * np.eye(3)], [np.eye(3), np.zeros((3, 3))]])


@dataclass(frozen=True, slots=True, eq=False)
class PoseLandmarkGraph:
    """Poses, landmarks and what was measured between them; rows name poses and landmarks.

    Attributes:
        poses: (n, 4, 4) ``wTc``; the first one is held fixed.
        landmarks: (m, 3) world, metres.
        motion_from, motion_to: (k,) rows of the poses that an odometry edge joins.
        motions: (k, 4, 4) measured pose of the second in the frame of the first.
        motion_covariances: (k, 6, 6) in the tangent space at the second, [rotation, translation].
        seen_from, seen: (l,) rows of pose and landmark of an observation.
        points: (l, 3) where it was seen, in the camera's frame, metres.
        point_covariances: (l, 3, 3) metres squared.
    """

    poses: FloatArray
    landmarks: FloatArray
    motion_from: IntArray
    motion_to: IntArray
    motions: FloatArray
    motion_covariances: FloatArray
    seen_from: IntArray
    seen: IntArray
    points: FloatArray
    point_covariances: FloatArray


def require_graph_suffix(path: Path) -> None:
    """Raises OutputError unless the file's name ends in .g2o."""
    if path.suffix.lower() != GRAPH_SUFFIX:
        raise OutputError(
            f"cannot write {path}: unknown graph format '{path.suffix}'; use {GRAPH_SUFFIX}"
        )


def write_g2o(path: Path, graph: PoseLandmarkGraph, remarks: Sequence[str] = ()) -> None:
    """Writes a graph atomically; the same graph gives the same bytes.

    Vertices are numbered from 0: the poses in their order, then the landmarks in theirs.

    Args:
        path: the .g2o file.
        graph: what to write.
        remarks: put into comment lines in front.

    Raises:
        OutputError: another ending, a number that is not finite, or writing failed.
    """
    require_graph_suffix(path)
    _require_finite(path, graph)
    blocks = [
        *(f"# {remark}\n" for remark in remarks),
        f"PARAMS_SE3OFFSET {_OFFSET_ID} 0 0 0 0 0 0 1\n",
        *_vertices(graph),
        *_motions(graph),
        *_observations(graph),
    ]
    write_text(path, "".join(blocks))


def g2o_information(covariances: FloatArray) -> FloatArray:
    """Information (k, 6, 6) in g2o's error from covariances (k, 6, 6) in our tangent space."""
    return congruence(
        np.broadcast_to(_OURS_OF_G2O.T, covariances.shape), information_of(covariances)
    )


def information_of(covariances: FloatArray) -> FloatArray:
    """Inverses (k, d, d) of covariances, no direction being known better than EXACT_SIGMA."""
    variances, directions = np.linalg.eigh(covariances)
    inverse = 1.0 / np.maximum(variances, EXACT_SIGMA**2)
    return congruence(directions * np.sqrt(inverse)[:, None, :], np.eye(covariances.shape[-1]))


def _vertices(graph: PoseLandmarkGraph) -> Iterator[str]:
    numbers = np.arange(len(graph.poses))
    yield _lines("VERTEX_SE3:QUAT %d" + 7 * " %.12g", numbers[:, None], pose_rows(graph.poses))
    if len(graph.poses):
        yield "FIX 0\n"
    landmarks = len(graph.poses) + np.arange(len(graph.landmarks))
    yield _lines("VERTEX_TRACKXYZ %d" + 3 * " %.12g", landmarks[:, None], graph.landmarks)


def _motions(graph: PoseLandmarkGraph) -> Iterator[str]:
    upper = g2o_information(graph.motion_covariances)[:, _UPPER6[0], _UPPER6[1]]
    ends = np.column_stack([graph.motion_from, graph.motion_to])
    row_format = "EDGE_SE3:QUAT %d %d" + 7 * " %.12g" + 21 * " %.9g"
    yield _lines(row_format, ends, np.column_stack([pose_rows(graph.motions), upper]))


def _observations(graph: PoseLandmarkGraph) -> Iterator[str]:
    upper = information_of(graph.point_covariances)[:, _UPPER3[0], _UPPER3[1]]
    ends = np.column_stack([graph.seen_from, len(graph.poses) + graph.seen])
    row_format = f"EDGE_SE3_TRACKXYZ %d %d {_OFFSET_ID}" + 3 * " %.12g" + 6 * " %.9g"
    yield _lines(row_format, ends, np.column_stack([graph.points, upper]))


def _lines(row_format: str, numbers: IntArray, values: FloatArray) -> str:
    buffer = io.StringIO()
    # Adding zero turns -0 into 0.
    np.savetxt(buffer, np.column_stack([numbers, values + 0.0]), fmt=row_format)
    return buffer.getvalue()


def _require_finite(path: Path, graph: PoseLandmarkGraph) -> None:
    for name in ("poses", "landmarks", "motions", "motion_covariances", "points"):
        array = getattr(graph, name)
        bad = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        if bad.any():
            raise OutputError(
                f"cannot write {path}: {name} {int(np.argmax(bad))} is not finite; the estimator "
                "diverged or the log is damaged, run the experiment again"
            )


_CAMERA = 1  # all images are of one camera: rectified rigs have equal intrinsics
_PIXEL_CENTRE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ImageModel:
    """Images (n), points (m) and where the ones show the others (k); rows name rows.

    Attributes:
        rig: the rectified cameras, for size and intrinsics.
        names: (n,) file names of the images, below the folder of images.
        poses: (n, 4, 4) ``wTi`` of each image's camera.
        ids: (m,) identities of the points, ascending.
        positions: (m, 3) world, metres.
        colours: (m, 3) red, green, blue.
        image: (k,) rows of the images that show a point, ascending.
        point: (k,) rows of the points.
        pixels: (k, 2) column and row, the first pixel's centre at zero.
    """

    rig: CameraRig
    names: tuple[str, ...]
    poses: FloatArray
    ids: IntArray
    positions: FloatArray
    colours: ByteArray
    image: IntArray
    point: IntArray
    pixels: FloatArray

    def errors(self) -> FloatArray:
        """(k,) pixels between where a point is seen and where it projects."""
        wTi = self.poses[self.image]
        apart = self.positions[self.point] - wTi[:, :3, 3]
        x, y, z = np.einsum("kji,kj->ik", wTi[:, :3, :3], apart)
        column = self.rig.cx + self.rig.fx * x / z
        row = self.rig.cy + self.rig.fy * y / z
        return np.asarray(np.hypot(column - self.pixels[:, 0], row - self.pixels[:, 1]))

    def point_errors(self) -> FloatArray:
        """(m,) pixels: of each point, the mean over its images."""
        total = np.bincount(self.point, self.errors(), len(self.ids))
        return np.asarray(total / np.maximum(np.bincount(self.point, minlength=len(self.ids)), 1))


def write_colmap(folder: Path, model: ImageModel) -> None:
    """Writes cameras.txt, images.txt and points3D.txt into a folder.

    Image and point numbers are rows plus one; the same model gives the same bytes.

    Raises:
        OutputError: a pose or point is not finite, or writing failed.
    """
    _require_finite_model(folder, model)
    table = _Table.of(model)
    for name, text in (
        ("cameras.txt", _camera_text(model.rig)),
        ("images.txt", _image_text(model, table)),
        ("points3D.txt", _point_text(model, table)),
    ):
        write_text(folder / name, text)


# --------------------------------------------------------------------------------------------
# COLMAP's tables


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """The model by image and by point.

    ``seven``: (n, 7) world-to-camera, w x y z and translation. ``first``: (n + 1,) first
    observation of each image. ``by_point``: (k,) observations ordered by point, and ``tracks``:
    (m + 1,) where each point's begin there. ``error``: (m,) mean of each point, pixels.
    """

    seven: FloatArray
    first: IntArray
    by_point: IntArray
    tracks: IntArray
    error: FloatArray

    @staticmethod
    def of(model: ImageModel) -> _Table:
        by_point = np.argsort(model.point, kind="stable")
        tracks = np.searchsorted(model.point[by_point], np.arange(len(model.ids) + 1))
        first = np.searchsorted(model.image, np.arange(len(model.names) + 1))
        seven = _world_to_camera(model.poses)
        return _Table(seven, first, by_point, tracks, model.point_errors())

    def track(self, model: ImageModel, row: int) -> IntArray:
        """(l, 2) number of the image and row among its observations, of each time it is seen."""
        seen = self.by_point[self.tracks[row] : self.tracks[row + 1]]
        image = model.image[seen]
        return np.column_stack([image + 1, seen - self.first[image]])


def _world_to_camera(poses: FloatArray) -> FloatArray:
    rows = pose_rows(np.array([inverse(wTi) for wTi in poses]).reshape(-1, 4, 4))
    return rows[:, [6, 3, 4, 5, 0, 1, 2]] + 0.0


def _camera_text(rig: CameraRig) -> str:
    numbers = rig.fx, rig.fy, rig.cx + _PIXEL_CENTRE, rig.cy + _PIXEL_CENTRE
    text = " ".join(f"{number:.17g}" for number in numbers)
    head = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy\n"
    return head + f"{_CAMERA} PINHOLE {rig.width} {rig.height} {text}\n"


def _image_text(model: ImageModel, table: _Table) -> str:
    seen = [
        f"{x:.9f} {y:.9f} {point}"
        for (x, y), point in zip(
            (model.pixels + _PIXEL_CENTRE).tolist(), (model.point + 1).tolist(), strict=True
        )
    ]
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# X, Y, POINT3D_ID, ..."]
    for row, name in enumerate(model.names):
        numbers = " ".join(f"{number:.17g}" for number in table.seven[row])
        lines.append(f"{row + 1} {numbers} {_CAMERA} {name}")
        lines.append(" ".join(seen[table.first[row] : table.first[row + 1]]))
    return "\n".join(lines) + "\n"


def _point_text(model: ImageModel, table: _Table) -> str:
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, (IMAGE_ID, POINT2D_IDX), ..."]
    for row, (place, colour) in enumerate(zip(model.positions, model.colours, strict=True)):
        numbers = " ".join(f"{number:.17g}" for number in place)
        track = " ".join(map(str, table.track(model, row).ravel().tolist()))
        tint = " ".join(map(str, colour.tolist()))
        lines.append(f"{row + 1} {numbers} {tint} {table.error[row]:.9g} {track}")
    return "\n".join(lines) + "\n"


def _require_finite_model(path: Path, model: ImageModel) -> None:
    for name in ("poses", "positions", "pixels"):
        if not np.isfinite(getattr(model, name)).all():
            raise OutputError(
                f"cannot write {path}: {name} are not all finite; the estimator diverged or the "
                "log is damaged, run the experiment again"
            )


MCAP_SUFFIX = ".mcap"
TOPIC = "/fgslam/pose"
FRAME = "map"
_KIND = "geometry_msgs/msg/PoseWithCovarianceStamped"

# REP 103: x forward, y left, z up; the camera has x right, y down, z forward.
_ROS_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def write_mcap(path: Path, trajectory: Trajectory, covariances: FloatArray | None) -> None:
    """Writes `geometry_msgs/PoseWithCovarianceStamped` of the camera in :data:`FRAME`.

    Position and orientation are in the axes of REP 103 of the first camera, for the world and for
    the moving frame alike; the covariance is about the axes of the world.

    Args:
        path: the .mcap file.
        trajectory: poses ``wTc`` of the reference camera.
        covariances: (n, 6, 6) in the tangent space at each pose, [rotation, translation]; None or
            NaN for unknown, which ROS writes as zeros.

    Raises:
        OutputError: it cannot be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    if covariances is None:
        covariances = np.zeros((len(trajectory), 6, 6))
    with tempfile.TemporaryDirectory() as folder, clear_output_errors(path):
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topic = writer.add_connection(TOPIC, _KIND, typestore=store)
            rows = zip(trajectory.timestamps, trajectory.poses, covariances, strict=True)
            for t, wTc, covariance in rows:
                stamp = round(float(t) * 1e9)
                message = pose_message(store.types, stamp, wTc, covariance)
                writer.write(topic, stamp, store.serialize_cdr(message, _KIND))
        write_bytes(path, (bag / f"{bag.name}{MCAP_SUFFIX}").read_bytes())


def pose_message(
    types: Mapping[str, Any], stamp: int, wTc: FloatArray, covariance: FloatArray
) -> Any:
    """A PoseWithCovarianceStamped, as :func:`write_mcap` writes it.

    Args:
        types: classes of the messages by their names, of rosbags or of ROS itself.
        stamp: nanoseconds.
        wTc: (4, 4) pose of the reference camera.
        covariance: (6, 6) of it; NaN for unknown.
    """
    covariance = np.nan_to_num(covariance)
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    turned = _ROS_FROM_CAMERA @ wTc[:3, :3]
    x, y, z, w = quaternion_from_rotation(turned @ _ROS_FROM_CAMERA.T).tolist()
    to_world = np.zeros((6, 6))  # [translation, rotation] about the world's axes
    to_world[:3, 3:] = to_world[3:, :3] = turned
    time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    x_ahead, y_left, z_up = (_ROS_FROM_CAMERA @ wTc[:3, 3]).tolist()
    point = types["geometry_msgs/msg/Point"](x=x_ahead, y=y_left, z=z_up)
    quaternion = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    pose = types["geometry_msgs/msg/PoseWithCovariance"](
        pose=types["geometry_msgs/msg/Pose"](position=point, orientation=quaternion),
        covariance=(to_world @ covariance @ to_world.T).reshape(-1),
    )
    return types[_KIND](header=types["std_msgs/msg/Header"](stamp=time, frame_id=FRAME), pose=pose)
