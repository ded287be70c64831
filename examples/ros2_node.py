# %% [markdown]
# # A ROS 2 node
#
# Two image topics with their `camera_info` in, the camera's pose out. The node is a thin shell
# around `StereoMapper`, which takes messages of rclpy and of rosbags alike: without ROS, a bag
# plays through the same code.
#
#     python ros2_node.py                 # with ROS 2 sourced: a node
#     python ros2_node.py my_bag.mcap     # anywhere
#
# Tested with the messages of rosbags; a running ROS 2 was not at hand.

# %%
import dataclasses
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader

import fgslam as fg
from fgslam.cameras.formats import read_camera_info_pair
from fgslam.cameras.rig import rig_of
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    inverse,
    pose,
    rotation_from_quaternion,
)
from fgslam.datasets.bag_messages import calibration_of, image_of, motion_of
from fgslam.report.formats import pose_message

SIDES = ("left", "right")
TOLERANCE_S = 0.005  # between the stamps of one pair


def seconds(message: Any) -> float:
    """The stamp of a message."""
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


# %% [markdown]
# ## Messages in, steps out


# %%
class StereoMapper:
    """Pairs images by their stamps and tracks them, once both cameras' `camera_info` is there."""

    def __init__(self, estimator: str = "landmark_kalman") -> None:
        self.estimator = estimator
        self.infos: dict[str, dict[str, Any]] = {}
        self.waiting: dict[str, Any] = {}
        self.slam: fg.Slam | None = None
        self.body: FloatArray | None = None  # by the odometry, now and at the last frame
        self.body_before: FloatArray | None = None

    def info(self, side: str, message: Any) -> None:
        """Takes a CameraInfo; the second one begins the session."""
        self.infos[side] = calibration_of(message)
        if self.slam is None and len(self.infos) == len(SIDES):
            names, trees = zip(*((Path(s), self.infos[s]) for s in SIDES), strict=True)
            rig = rig_of(read_camera_info_pair((names[0], names[1]), (trees[0], trees[1])))
            # Where the camera sits on the robot is tf's to say; here its axes alone.
            rig = dataclasses.replace(rig, bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA)
            self.slam = fg.Slam(rig, self.estimator)

    def odometry(self, message: Any) -> None:
        """Takes an Odometry; the motion between two frames is what both poses make of it."""
        values = motion_of(message)
        self.body = pose(rotation_from_quaternion(values[3:]), values[:3])

    def image(self, side: str, message: Any) -> fg.Step | None:
        """Takes an Image or CompressedImage; the step where it completes a pair."""
        self.waiting[side] = message
        if self.slam is None or len(self.waiting) < len(SIDES):
            return None
        left, right = (self.waiting[name] for name in SIDES)
        if abs(seconds(left) - seconds(right)) > TOLERANCE_S:
            return None
        self.waiting.clear()
        moved = None
        if self.body is not None and self.body_before is not None:
            moved = inverse(self.body_before) @ self.body
        self.body_before = self.body
        images = [image_of(one, name) for name, one in zip(SIDES, (left, right), strict=True)]
        return self.slam.track(seconds(right), images, moved)


# %% [markdown]
# ## The node
#
# `rclpy` is imported here only. Images are taken with a queue of one: a pair that comes while
# another is tracked replaces the one that waits.


# %%
def run_node() -> None:
    """Subscribes to left/ and right/image_raw, camera_info and odom; publishes fgslam/pose."""
    try:
        rclpy = import_module("rclpy")
    except ImportError:
        raise SystemExit("no rclpy here: source ROS 2, or give a bag") from None
    sensors, nav, poses = (import_module(f"{n}_msgs.msg") for n in ("sensor", "nav", "geometry"))
    types = {f"{package}/msg/{name}": getattr(import_module(f"{package}.msg"), name)
             for package, name in POSE_PARTS}  # fmt: skip
    rclpy.init()
    node, mapper = rclpy.create_node("fgslam"), StereoMapper()
    out = node.create_publisher(poses.PoseWithCovarianceStamped, "fgslam/pose", 10)

    def seen(side: str, message: Any) -> None:
        step = mapper.image(side, message)
        if step is not None:
            stamp = round(1e9 * step.timestamp)
            out.publish(pose_message(types, stamp, step.wTc, step.covariance))

    for side in SIDES:
        node.create_subscription(
            sensors.Image, f"{side}/image_raw", lambda m, side=side: seen(side, m), 1
        )
        node.create_subscription(
            sensors.CameraInfo, f"{side}/camera_info", lambda m, side=side: mapper.info(side, m), 1
        )
    node.create_subscription(nav.Odometry, "odom", mapper.odometry, 10)
    try:
        rclpy.spin(node)
    finally:
        if mapper.slam is not None and len(mapper.slam):
            mapper.slam.result().map.save("ros2.fgmap")


POSE_PARTS = [
    ("builtin_interfaces", "Time"),
    ("std_msgs", "Header"),
    *(("geometry_msgs", name) for name in ("Point", "Quaternion", "Pose", "PoseWithCovariance")),
    ("geometry_msgs", "PoseWithCovarianceStamped"),
]


# %% [markdown]
# ## A bag in its place


# %%
def play(bag: Path) -> StereoMapper:
    """The bag's messages in their order; topics are told by `left`, `right` and their type."""
    mapper = StereoMapper()
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            kind, topic = connection.msgtype.rpartition("/")[2], connection.topic
            if kind not in ("Image", "CompressedImage", "CameraInfo", "Odometry"):
                continue
            message = reader.deserialize(raw, connection.msgtype)
            side = "left" if "left" in topic else "right"
            if kind == "Odometry":
                mapper.odometry(message)
            elif kind == "CameraInfo":
                mapper.info(side, message)
            elif (step := mapper.image(side, message)) is not None:
                print(f"{step.timestamp:.3f} s {step.status.value}: {len(step.matches)} matches")
    return mapper


if __name__ == "__main__":
    if len(sys.argv) > 1:
        play(Path(sys.argv[1]))
    else:
        run_node()
