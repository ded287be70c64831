"""A trajectory as a ROS 2 bag (.mcap): the camera in the axes of ROS, for RViz and Foxglove."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.files import clear_output_errors, write_bytes
from fgslam.core.geometry import quaternion_from_rotation
from fgslam.core.trajectories import Trajectory

SUFFIX = ".mcap"
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
        write_bytes(path, (bag / f"{bag.name}{SUFFIX}").read_bytes())


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
