"""Results for other tools: .ply and .pcd maps, .g2o graphs, COLMAP models, ROS 2 bags."""

from __future__ import annotations

import io
import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.errors import DatasetError, OutputError
from fgslam.core.files import clear_output_errors, write_bytes, write_text
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    congruence,
    inverse,
    pose,
    quaternion_from_rotation,
    rotate_covariances,
)
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Trajectory, pose_rows

_COVARIANCE_NAMES = ("cxx", "cxy", "cxz", "cyy", "cyz", "czz")
_UPPER = np.triu_indices(3)
_INT32_MAX = 2**31 - 1
_PLY_TYPES = {"f8": "double", "f4": "float", "i4": "int", "u1": "uchar"}
_PCD_KINDS = {"f8": "f4", "f4": "f4", "i4": "u4", "u1": "u1"}
_PCD_NAMES = {"red": "rgb", "nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
_PLY_FORMAT = "format binary_little_endian 1.0"
_PLY_COMMENTS = (
    "fgslam landmark map 1",
    "world = first reference camera: {}, metres",
    "cxx .. czz: covariance of the position in the world, metres squared",
)


Axes: TypeAlias = Literal["camera", "ros"]
AXES: dict[Axes, str] = {
    "camera": "x right, y down, z forward",
    "ros": "x forward, y left, z up",  # REP 103
}
"""Of the world and of cameras."""
ROS_FROM_CAMERA = BODY_FORWARD_LEFT_UP_FROM_CAMERA[:3, :3]


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
        for each in fields(self):
            values = getattr(self, each.name)
            if values is not None and len(values) != len(self):
                raise ValueError(f"{each.name} has {len(values)} rows, not {len(self)}")


def write_map(path: Path, points: MapPoints, remark: str = "", axes: Axes = "camera") -> None:
    """Writes a map in the format that the suffix names: `.ply` or `.pcd`.

    A `.ply` has every property of every landmark exactly.

    Args:
        path: the file to write, atomically.
        points: the landmarks, in the axes of cameras.
        remark: ASCII, put into a comment of the file.
        axes: those to write them in.

    Raises:
        OutputError: the suffix is another one, a landmark is not finite, an id needs more than 31
            bits, or writing failed.
    """
    require_suffix(path, "map")
    _require_finite(path, positions=points.positions, covariances=points.covariances)
    if len(points) and (points.ids.min() < 0 or points.ids.max() > _INT32_MAX):
        raise OutputError(
            f"cannot write {path}: landmark ids must lie in 0 .. {_INT32_MAX}; renumber them"
        )
    if axes == "ros":
        positions, normals = points.positions @ ROS_FROM_CAMERA.T, points.normals
        points = replace(
            points,
            positions=positions,
            covariances=rotate_covariances(ROS_FROM_CAMERA, points.covariances),
            normals=None if normals is None else normals @ ROS_FROM_CAMERA.T,
        )
    records = np.empty(len(points), _ply_type(points.normals is not None))
    columns = [
        *(*points.positions.T, *points.colours.T, points.ids, points.hits, points.misses),
        *(*points.covariances[:, _UPPER[0], _UPPER[1]].T, points.valid, points.permanent),
        *(() if points.normals is None else points.normals.T),
    ]
    for name, values in zip(records.dtype.names or (), columns, strict=True):
        records[name] = values
    comments = [*(line.format(AXES[axes]) for line in _PLY_COMMENTS), remark]
    write_points(path, comments, vertex=records)


def require_suffix(path: Path, what: str, known: Sequence[str] = (".ply", ".pcd")) -> None:
    """Raises OutputError unless the format is a known one."""
    if path.suffix.lower() not in known:
        raise OutputError(
            f"cannot write {path}: unknown {what} format '{path.suffix}'; use {' or '.join(known)}"
        )


def write_points(path: Path, comments: Iterable[str], **elements: npt.NDArray[np.void]) -> None:
    """Writes elements as `.ply`, or their ``vertex`` as `.pcd`. Raises OutputError."""
    is_pcd = path.suffix.lower() == ".pcd"
    given = pcd_bytes(comments, elements["vertex"]) if is_pcd else ply_bytes(comments, **elements)
    write_bytes(path, given)


def ply_bytes(comments: Iterable[str], **elements: npt.NDArray[np.void]) -> bytes:
    """A binary little-endian .ply; a property of several values is a list, its length before it."""
    lines = ["ply", _PLY_FORMAT, *(f"comment {text}" for text in comments if text)]
    for name, records in elements.items():
        lines += [f"element {name} {len(records)}", *_ply_properties(records.dtype)]
    content = b"".join(records.tobytes() for records in elements.values())
    return "\n".join([*lines, "end_header\n"]).encode("ascii") + content


def _ply_type(has_normals: bool) -> np.dtype[Any]:
    """One landmark in a file."""
    kinds = [
        *(("<f8", "x y z"), ("u1", "red green blue"), ("<i4", "landmark_id hits misses")),
        *(("<f8", " ".join(_COVARIANCE_NAMES)), ("u1", "valid permanent")),
        ("<f4", "nx ny nz" if has_normals else ""),
    ]
    return np.dtype([(name, kind) for kind, names in kinds for name in names.split()])


def _ply_properties(dtype: np.dtype[Any]) -> list[str]:
    lines: list[str] = []
    for name in dtype.names or ():
        kind = _PLY_TYPES[dtype[name].base.str[1:]]
        if dtype[name].shape:  # the property before it is its length
            lines[-1] = f"property list uchar {kind} {name}"
        else:
            lines.append(f"property {kind} {name}")
    return lines


def read_ply(path: Path) -> MapPoints:
    """A map that :func:`write_ply` wrote.

    Raises:
        DatasetError: the file is missing, cut off, or not a landmark map of this program.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}; check the path") from error
    header, end, body = content.partition(b"end_header\n")
    lines = header.decode("ascii", errors="replace").splitlines()
    dtype = _ply_type(any(line.endswith(" nx") for line in lines))
    found = [line for line in lines if line.startswith(("format", "property"))]
    expected = [_PLY_FORMAT, *_ply_properties(dtype)]
    counts = [line for line in lines if re.fullmatch(r"element vertex \d+", line)]
    is_map = lines[:1] == ["ply"] and bool(end) and found == expected and len(counts) == 1
    count = int(counts[0].split()[2]) if is_map else 0
    if not is_map or len(body) < count * dtype.itemsize:
        raise DatasetError(
            f"{path} is no landmark map, or cut off; run the experiment again with --overwrite"
        )
    records = np.frombuffer(body, dtype, count)

    def columns(*names: str) -> npt.NDArray[Any]:
        return np.column_stack([records[name] for name in names])

    covariances = np.empty((count, 3, 3))
    covariances[:, _UPPER[0], _UPPER[1]] = columns(*_COVARIANCE_NAMES)
    covariances[:, _UPPER[1], _UPPER[0]] = columns(*_COVARIANCE_NAMES)
    has_normals = "nx" in (dtype.names or ())
    return MapPoints(
        ids=records["landmark_id"].astype(np.int64),
        positions=columns("x", "y", "z"),
        covariances=covariances,
        colours=columns("red", "green", "blue"),
        hits=records["hits"].astype(np.int64),
        misses=records["misses"].astype(np.int64),
        valid=records["valid"] != 0,
        permanent=records["permanent"] != 0,
        normals=columns("nx", "ny", "nz").astype(np.float64) if has_normals else None,
    )


def pcd_bytes(comments: Iterable[str], points: npt.NDArray[np.void]) -> bytes:
    """A binary .pcd 0.7 (PCL, Open3D, CloudCompare) of what a .ply calls its vertices.

    Single precision: PCL's point types are, and its tools do not know doubles as x, y, z.
    """
    red, green, blue = (points[name].astype(np.uint32) for name in ("red", "green", "blue"))
    columns = {
        _PCD_NAMES.get(name, name): points[name].astype(_PCD_KINDS[points.dtype[name].str[1:]])
        for name in points.dtype.names or ()
        if name not in ("green", "blue")
    }
    records = as_records(columns | {"rgb": (red << 16) | (green << 8) | blue})
    dtype = records.dtype
    kinds = [dtype[name] for name in dtype.names or ()]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {text}" for text in comments if text),
        "VERSION 0.7",
        f"FIELDS {' '.join(dtype.names or ())}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {len(records)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(records)}",
        "DATA binary\n",
    ]
    return "\n".join(lines).encode("ascii") + records.tobytes()


def as_records(columns: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.void]:
    """Rows of named columns (n,) or (n, k), packed, little-endian."""
    kinds = [(name, c.dtype.newbyteorder("<"), c.shape[1:]) for name, c in columns.items()]
    records = np.empty(len(next(iter(columns.values()))), np.dtype(kinds))
    for name, column in columns.items():
        records[name] = column
    return records


def _require_finite(path: Path, **arrays: FloatArray) -> None:
    """Raises OutputError, naming the first row that is not finite."""
    for name, values in arrays.items():
        bad = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
        if bad.any():
            raise OutputError(
                f"cannot write {path}: {name} {int(np.argmax(bad))} is not finite; the estimator "
                "diverged or the log is damaged, run the experiment again"
            )


# --------------------------------------------------------------------------------------------
# g2o

GRAPH = "graph", (".g2o",)
"""What it is called, and the ending of its files."""
EXACT_SIGMA = 1e-6
"""Standard deviation (m, rad) in place of zero: a file of information cannot say `exact`."""

_OFFSET_ID = 0  # of the sensor in the pose's frame: the identity, poses are the camera's own
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
    require_suffix(path, *GRAPH)
    arrays = ("poses", "landmarks", "motions", "motion_covariances", "points")
    _require_finite(path, **{name: getattr(graph, name) for name in arrays})
    n, (i3, j3), (i6, j6) = len(graph.poses), np.triu_indices(3), np.triu_indices(6)
    motions = g2o_information(graph.motion_covariances)[:, i6, j6]
    points = information_of(graph.point_covariances)[:, i3, j3]
    motion_ends = np.column_stack([graph.motion_from, graph.motion_to])
    seen_ends = np.column_stack([graph.seen_from, n + graph.seen])
    lines = io.StringIO()
    lines.writelines(f"# {remark}\n" for remark in remarks)
    lines.write(f"PARAMS_SE3OFFSET {_OFFSET_ID} 0 0 0 0 0 0 1\n")
    for tag, numbers, values, information in (
        ("VERTEX_SE3:QUAT %d", np.arange(n)[:, None], pose_rows(graph.poses), None),
        ("VERTEX_TRACKXYZ %d", n + np.arange(len(graph.landmarks))[:, None], graph.landmarks, None),
        ("EDGE_SE3:QUAT %d %d", motion_ends, pose_rows(graph.motions), motions),
        (f"EDGE_SE3_TRACKXYZ %d %d {_OFFSET_ID}", seen_ends, graph.points, points),
    ):
        table, row = [numbers, values], tag + values.shape[1] * " %.12g"
        if information is not None:
            table, row = [*table, information], row + information.shape[1] * " %.9g"
        # Adding zero turns -0 into 0.
        np.savetxt(lines, np.column_stack(table) + 0.0, fmt=row)
        if tag.startswith("VERTEX_SE3") and n:
            lines.write("FIX 0\n")
    write_text(path, lines.getvalue())


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


# --------------------------------------------------------------------------------------------
# COLMAP

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
    _require_finite(folder, poses=model.poses, positions=model.positions, pixels=model.pixels)
    rig = model.rig
    intrinsics = rig.fx, rig.fy, rig.cx + _PIXEL_CENTRE, rig.cy + _PIXEL_CENTRE
    cameras = [
        "# CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy",
        f"{_CAMERA} PINHOLE {rig.width} {rig.height} {_exact(intrinsics)}",
    ]
    first = np.searchsorted(model.image, np.arange(len(model.names) + 1))
    iTw = pose_rows(inverse(model.poses))
    seen = [
        f"{x:.9f} {y:.9f} {point}"
        for (x, y), point in zip(
            (model.pixels + _PIXEL_CENTRE).tolist(), (model.point + 1).tolist(), strict=True
        )
    ]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# X, Y, POINT3D_ID, ..."]
    # From x y z and quaternion x y z w to w x y z and x y z; adding zero turns -0 into 0.
    for row, seven in enumerate(iTw[:, [6, 3, 4, 5, 0, 1, 2]] + 0.0):
        images.append(f"{row + 1} {_exact(seven)} {_CAMERA} {model.names[row]}")
        images.append(" ".join(seen[first[row] : first[row + 1]]))
    by_point = np.argsort(model.point, kind="stable")
    track = np.searchsorted(model.point[by_point], np.arange(len(model.ids) + 1))
    errors = model.point_errors()
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, (IMAGE_ID, POINT2D_IDX), ..."]
    for row, (place, colour) in enumerate(zip(model.positions, model.colours, strict=True)):
        own = by_point[track[row] : track[row + 1]]
        image = model.image[own]
        where = np.column_stack([image + 1, own - first[image]]).ravel().tolist()
        numbers = f"{_exact(place)} {' '.join(map(str, colour.tolist()))} {errors[row]:.9g}"
        points.append(f"{row + 1} {numbers} {' '.join(map(str, where))}")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        write_text(folder / f"{name}.txt", "\n".join(lines) + "\n")


def _exact(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)


# --------------------------------------------------------------------------------------------
# ROS 2

MCAP_SUFFIX = ".mcap"
TOPIC = "/fgslam/pose"
FRAME = "map"
_KIND = "geometry_msgs/msg/PoseWithCovarianceStamped"


def write_trajectory(
    path: Path,
    trajectory: Trajectory,
    covariances: FloatArray | None = None,
    remark: str = "",
    axes: Axes = "camera",
) -> None:
    """Writes poses in the format that the suffix names: `.tum`, `.kitti`, `.csv` or `.mcap`.

    Args:
        path: the file; of a bag the axes are always those of REP 103.
        trajectory: of any frame, in the axes of cameras. A body has axes of its own, and only its
            world's are changed.
        covariances: for a bag, as :func:`write_mcap` takes them.
        remark: put into a comment line.
        axes: those to write them in.

    Raises:
        OutputError: the suffix is another one, a pose is not finite, or writing failed.
    """
    if path.suffix.lower() == MCAP_SUFFIX:
        write_mcap(path, trajectory, covariances)
        return
    if axes == "ros":
        turned = pose(ROS_FROM_CAMERA, np.zeros(3)) @ trajectory.poses
        turned[:, :3, :3] @= _own_axes(trajectory).T
        trajectory = replace(trajectory, poses=turned)
        remark = ", ".join(filter(None, (remark, f"axes of REP 103: {AXES[axes]}")))
    trajectory.save(path, remark)


def _own_axes(trajectory: Trajectory) -> FloatArray:
    """(3, 3) from the axes of what moves to those that it has in ROS."""
    return np.eye(3) if trajectory.frame == "body" else ROS_FROM_CAMERA


def write_mcap(path: Path, trajectory: Trajectory, covariances: FloatArray | None) -> None:
    """Writes `geometry_msgs/PoseWithCovarianceStamped` of the moving frame in :data:`FRAME`.

    Position and orientation are in the axes of REP 103 of the first camera, for the world and for
    a moving camera alike, a body's are its own; the covariance is about the axes of the world.

    Args:
        path: the .mcap file.
        trajectory: poses in the axes of cameras.
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
    own = _own_axes(trajectory)
    with tempfile.TemporaryDirectory() as folder, clear_output_errors(path):
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topic = writer.add_connection(TOPIC, _KIND, typestore=store)
            rows = zip(trajectory.timestamps, trajectory.poses, covariances, strict=True)
            for t, wTc, covariance in rows:
                stamp = round(float(t) * 1e9)
                message = pose_message(store.types, stamp, wTc, covariance, own)
                writer.write(topic, stamp, store.serialize_cdr(message, _KIND))
        write_bytes(path, (bag / f"{bag.name}{MCAP_SUFFIX}").read_bytes())


def pose_message(
    types: Mapping[str, Any],
    stamp: int,
    wTc: FloatArray,
    covariance: FloatArray,
    own_axes: FloatArray = ROS_FROM_CAMERA,
) -> Any:
    """A PoseWithCovarianceStamped, as :func:`write_mcap` writes it.

    Args:
        types: classes of the messages by their names, of rosbags or of ROS itself.
        stamp: nanoseconds.
        wTc: (4, 4) pose of the reference camera.
        covariance: (6, 6) of it; NaN for unknown.
        own_axes: (3, 3) from the camera's axes to those that it has in ROS.
    """
    covariance = np.nan_to_num(covariance)
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    turned = ROS_FROM_CAMERA @ wTc[:3, :3]
    x, y, z, w = quaternion_from_rotation(turned @ own_axes.T).tolist()
    to_world = np.zeros((6, 6))  # [translation, rotation] about the world's axes
    to_world[:3, 3:] = to_world[3:, :3] = turned
    time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    x_ahead, y_left, z_up = (ROS_FROM_CAMERA @ wTc[:3, 3]).tolist()
    point = types["geometry_msgs/msg/Point"](x=x_ahead, y=y_left, z=z_up)
    quaternion = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    pose = types["geometry_msgs/msg/PoseWithCovariance"](
        pose=types["geometry_msgs/msg/Pose"](position=point, orientation=quaternion),
        covariance=(to_world @ covariance @ to_world.T).reshape(-1),
    )
    return types[_KIND](header=types["std_msgs/msg/Header"](stamp=time, frame_id=FRAME), pose=pose)
