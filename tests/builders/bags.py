"""Small bags with known content, written by rosbags, for the reader's tests."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from dataset_builders import CALIBRATION, HEIGHT, WIDTH, picture
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.geometry import quaternion_from_rotation

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
LATE_NS = 3_000_000  # by which the bag's time is later than the stamp

Written: TypeAlias = tuple[str, int, str, dict[str, Any]]
"""Topic, stamp, message type and fields."""


def stereo(
    frames: int = 4,
    encode: Callable[[Image], dict[str, Any]] | None = None,
    names: tuple[str, str] = ("/cam/left", "/cam/right"),
    skew_ns: int = 0,
) -> list[Written]:
    """Frame k has corner pixels 10 + k (right) and 60 + k (left); camera_info of a rectified rig.

    The left image is ``skew_ns`` later.
    """
    encode = encode or raw_image
    out: list[Written] = []
    for k in range(frames):
        stamp = START_NS + k * PERIOD_NS
        for name, code, late in ((names[0], 60, skew_ns), (names[1], 10, 0)):
            fields = encode(picture(code + k))
            kind = "CompressedImage" if "format" in fields else "Image"
            ending = "/image_raw/compressed" if "format" in fields else "/image_raw"
            out.append((name + ending, stamp + late, f"sensor_msgs/msg/{kind}", fields))
            shift = 0.0 if code == 60 else -CALIBRATION["fx"] * CALIBRATION["baseline_m"]
            info = ("sensor_msgs/msg/CameraInfo", camera_info(shift))
            out.append((f"{name}/camera_info", stamp + late, *info))
    return out


def raw_image(image: Image, encoding: str = "mono8", padding: int = 0) -> dict[str, Any]:
    """Fields of an Image; the rows end in ``padding`` bytes."""
    rows = np.ascontiguousarray(image).view(np.uint8).reshape(image.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    return {
        "height": image.shape[0],
        "width": image.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": rows.shape[1],
        "data": rows.ravel(),
    }


def compressed_image(image: Image, ending: str = ".png") -> dict[str, Any]:
    """Fields of a CompressedImage."""
    return {"format": ending[1:], "data": cv2.imencode(ending, image)[1].ravel()}


def camera_info(shift: float) -> dict[str, Any]:
    """Of images that are rectified already; ``shift`` is -fx times the baseline."""
    fx, fy, cx, cy = (CALIBRATION[name] for name in ("fx", "fy", "cx", "cy"))
    return {
        "height": HEIGHT,
        "width": WIDTH,
        "distortion_model": "plumb_bob",
        "d": np.zeros(5),
        "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]),
        "r": np.eye(3).ravel(),
        "p": np.array([fx, 0, cx, shift, 0, fy, cy, 0, 0, 0, 1, 0.0]),
        "binning_x": 0,
        "binning_y": 0,
    }


def odometry(stamps_ns: Iterable[int], poses: FloatArray, topic: str = "/odom") -> list[Written]:
    """nav_msgs/Odometry of positions and yaw (n, 4)."""
    out: list[Written] = []
    for stamp, (x, y, z, yaw) in zip(stamps_ns, poses, strict=True):
        pose = (x, y, z, 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
        out.append((topic, stamp, "nav_msgs/msg/Odometry", {"pose": pose}))
    return out


def twists(stamps_ns: Iterable[int], speed: float, yaw_rate: float) -> list[Written]:
    """geometry_msgs/TwistStamped of one speed and turn."""
    fields = {"twist": (speed, yaw_rate)}
    return [("/twist", stamp, "geometry_msgs/msg/TwistStamped", fields) for stamp in stamps_ns]


def gyroscope(stamps_ns: Iterable[int], rate: FloatArray, topic: str = "/imu") -> list[Written]:
    """sensor_msgs/Imu of one angular velocity (3,)."""
    return [(topic, stamp, "sensor_msgs/msg/Imu", {"rate": rate}) for stamp in stamps_ns]


def tf_static(transforms: Iterable[tuple[str, str, FloatArray]]) -> list[Written]:
    """One tf_static of parents, children and their poses (4, 4) in them."""
    return [("/tf_static", START_NS, "tf2_msgs/msg/TFMessage", {"transforms": list(transforms)})]


def in_frames(messages: Iterable[Written], frames: Mapping[str, str]) -> list[Written]:
    """The messages with the frames of those topics that begin with a key."""
    out = []
    for topic, stamp, kind, fields in messages:
        frame = next((f for name, f in frames.items() if topic.startswith(name)), None)
        out.append((topic, stamp, kind, fields if frame is None else {**fields, "frame": frame}))
    return out


def write_bag(path: Path, written: Iterable[Written], packed: bool = False) -> Path:
    """The bag; its ending says which kind. Of ROS 2 the file inside its folder.

    ``packed``: with compressed chunks, lz4 in ROS 1 and zstd in MCAP; SQLite's file as a whole.
    """
    ros1 = path.suffix == ".bag"
    made = Maker(_types(ros1), ros1)
    messages = sorted(written, key=lambda each: each[1])
    if ros1:
        bag = Writer1(path)
        if packed:
            bag.set_compression(Writer1.CompressionFormat.LZ4)
        with bag as writer:
            made.write(writer, messages)
        return path
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    folder = path.with_suffix("")
    bag2 = Writer2(folder, version=9, storage_plugin=plugin)
    if packed:
        mcap = plugin == StoragePlugin.MCAP
        mode = CompressionMode.STORAGE if mcap else CompressionMode.FILE
        bag2.set_compression(mode, CompressionFormat.ZSTD)
    with bag2 as writer:
        made.write(writer, messages)
    return next(folder.glob(f"{path.name}*"))


@cache  # it compiles what it serialises, once
def _types(ros1: bool) -> Typestore:
    if not ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    tf = get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
    store.register(tf)
    return store


@dataclass
class Maker:
    """Makes messages of one version of ROS, and writes them."""

    store: Any
    ros1: bool
    connections: dict[str, Any] = field(default_factory=dict)

    def write(self, writer: Any, messages: Iterable[Written]) -> None:
        for topic, stamp, kind, fields in messages:
            if topic not in self.connections:
                made = writer.add_connection(topic, kind, typestore=self.store)
                self.connections[topic] = made
            message = self.message(kind, stamp, fields)
            serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
            raw = bytes(serialize(message, kind))[: fields.get("kept_bytes")]
            writer.write(self.connections[topic], stamp + LATE_NS, raw)

    def message(self, kind: str, stamp: int, fields: dict[str, Any]) -> Any:
        values = dict(fields)
        frame = values.pop("frame", "camera")
        values.pop("kept_bytes", None)
        if kind.endswith("TFMessage"):
            made = [self._transform(stamp, *each) for each in fields["transforms"]]
            return self.store.types[kind](transforms=made)
        if kind.endswith("CameraInfo"):
            x, y, width, height = values.pop("roi", (0, 0, 0, 0))
            roi = self._make("sensor_msgs/msg/RegionOfInterest", x, y, height, width, False)
            values |= {"roi": roi}
            if self.ros1:
                values = {k.upper() if len(k) == 1 else k: v for k, v in values.items()}
        elif kind.endswith(("Odometry", "PoseWithCovarianceStamped")):
            x, y, z, qx, qy, qz, qw = fields["pose"]
            pose = self._make(
                "geometry_msgs/msg/Pose",
                self._make("geometry_msgs/msg/Point", x, y, z),
                self._make("geometry_msgs/msg/Quaternion", qx, qy, qz, qw),
            )
            covariance = fields.get("covariance", np.zeros(36))
            held = self._make("geometry_msgs/msg/PoseWithCovariance", pose, covariance)
            values = {"pose": held}
            if kind.endswith("Odometry"):
                twist = self._twist(0.0, 0.0), np.zeros(36)
                values |= {
                    "child_frame_id": fields.get("child", "base_link"),
                    "twist": self._make("geometry_msgs/msg/TwistWithCovariance", *twist),
                }
        elif kind.endswith("TwistStamped"):
            values = {"twist": self._twist(*fields["twist"])}
        elif kind.endswith("Float32"):
            return self.store.types[kind](**values)
        elif kind.endswith("Imu"):
            values = self._imu(fields["rate"])
        return self.store.types[kind](header=self._header(stamp, frame), **values)

    def _transform(self, stamp: int, parent: str, child: str, place: FloatArray) -> Any:
        quaternion = quaternion_from_rotation(place[:3, :3]).tolist()
        transform = self._make(
            "geometry_msgs/msg/Transform",
            self._make("geometry_msgs/msg/Vector3", *place[:3, 3].tolist()),
            self._make("geometry_msgs/msg/Quaternion", *quaternion),
        )
        header = self._header(stamp, parent)
        return self._make("geometry_msgs/msg/TransformStamped", header, child, transform)

    def _imu(self, rate: FloatArray) -> dict[str, Any]:
        vector, none = "geometry_msgs/msg/Vector3", np.zeros(9)
        return {
            "orientation": self._make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
            "orientation_covariance": none,
            "angular_velocity": self._make(vector, *map(float, rate)),
            "angular_velocity_covariance": none,
            "linear_acceleration": self._make(vector, 0.0, 0.0, 9.8),
            "linear_acceleration_covariance": none,
        }

    def _make(self, kind: str, *values: Any) -> Any:
        return self.store.types[kind](*values)

    def _twist(self, speed: float, yaw_rate: float) -> Any:
        vector = "geometry_msgs/msg/Vector3"
        linear, angular = (
            self._make(vector, speed, 0.0, 0.0),
            self._make(vector, 0.0, 0.0, yaw_rate),
        )
        return self._make("geometry_msgs/msg/Twist", linear, angular)

    def _header(self, stamp: int, frame: str) -> Any:
        time = self._make("builtin_interfaces/msg/Time", *divmod(stamp, 1_000_000_000))
        values = {"stamp": time, "frame_id": frame, **({"seq": 0} if self.ros1 else {})}
        return self.store.types["std_msgs/msg/Header"](**values)
