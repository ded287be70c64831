"""The ROS 2 node without ROS: its conversions with the messages of rosbags, its shell with a
stand-in for rclpy that hands them over."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import bags
import cv2
import numpy as np
import pytest
import recordings
from rosbags.typesys import Stores, get_typestore

from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, inverse
from fgslam.core.saved_map import load_map

SCRIPT = Path(__file__).parents[2] / "examples" / "ros2_node.py"
FRAMES = 4


@pytest.fixture(scope="module")
def node() -> Any:
    spec = importlib.util.spec_from_file_location("ros2_node", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert "rclpy" not in sys.modules
    return module


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> list[bags.Written]:
    """Boards seen by two cameras, their camera_info, and odometry between the images."""
    folder = recordings.write_recording(tmp_path_factory.mktemp("boards"), FRAMES, top=False)
    odometry = np.loadtxt(folder / "odometry.txt")
    out: list[bags.Written] = []
    for k in range(FRAMES):
        stamp = bags.START_NS + round(1e9 * recordings.PERIOD_S) * k
        out.append(("/odom", stamp - 1, "nav_msgs/msg/Odometry", {"pose": odometry[k, 1:]}))
        for side, baseline in (("left", 0.0), ("right", recordings.BASELINE)):
            image = cv2.imread(str(folder / side / f"{k:06d}.png"), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            fields = bags.raw_image(image.astype(np.uint8))
            info = ("sensor_msgs/msg/CameraInfo", camera_info(baseline))
            out.append((f"/{side}/camera_info", stamp, *info))
            out.append((f"/{side}/image_raw", stamp, "sensor_msgs/msg/Image", fields))
    return out


def camera_info(baseline: float) -> dict[str, Any]:
    f, cx, cy = recordings.FOCAL, (recordings.WIDTH - 1) / 2, (recordings.HEIGHT - 1) / 2
    return bags.camera_info(0.0) | {
        "height": recordings.HEIGHT,
        "width": recordings.WIDTH,
        "k": np.array([f, 0, cx, 0, f, cy, 0, 0, 1.0]),
        "p": np.array([f, 0, cx, -f * baseline, 0, f, cy, 0, 0, 0, 1, 0.0]),
    }


def assert_near_the_path(poses: Any) -> None:
    truth = recordings.camera_path(FRAMES)
    expected = np.array([inverse(truth[0]) @ wTc for wTc in truth])
    np.testing.assert_allclose(poses[:, :3, 3], expected[:, :3, 3], rtol=0, atol=0.01)


@pytest.mark.parametrize("ending", [".mcap", ".bag"])
def test_a_bag_is_mapped_message_by_message(
    node: Any, written: list[bags.Written], tmp_path: Path, ending: str
) -> None:
    slam = node.play(bags.write_bag(tmp_path / f"boards{ending}", written)).slam
    assert_near_the_path(slam.result().trajectory.poses)
    assert slam.rig.baseline == pytest.approx(recordings.BASELINE)
    measured = [increment.odometry is not None for increment in slam.log]
    assert measured == [False, True, True, True]


def test_images_of_different_moments_are_no_pair(node: Any, written: list[bags.Written]) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    maker, mapper = bags.Maker(store, ros1=False), node.StereoMapper()
    for topic, stamp, kind, fields in written[:5]:  # odometry, both cameras' info and images
        message = maker.message(kind, stamp, fields)
        if kind.endswith("CameraInfo"):
            mapper.info(topic.split("/")[1], message)
        elif kind.endswith("Image"):
            images = message
    early = maker.message("sensor_msgs/msg/Image", bags.START_NS - 10**7, written[2][3])
    assert mapper.image("left", early) is None
    assert mapper.image("right", images) is None
    on_time = maker.message("sensor_msgs/msg/Image", bags.START_NS, written[2][3])
    step = mapper.image("left", on_time)
    assert step is not None
    assert step.index == 0


class Rclpy(ModuleType):
    """Hands all messages to the subscriptions in their order; keeps what is published."""

    def __init__(self, messages: list[tuple[str, Any]]) -> None:
        super().__init__("rclpy")
        self.messages, self.callbacks, self.published = messages, dict[str, Any](), list[Any]()

    def init(self) -> None:
        """Nothing to begin."""

    def create_node(self, name: str) -> Any:
        publisher = SimpleNamespace(publish=self.published.append)
        return SimpleNamespace(
            create_publisher=lambda kind, topic, depth: publisher,
            create_subscription=lambda kind, topic, call, depth: self.callbacks.update(
                {topic: call}
            ),
        )

    def spin(self, node: Any) -> None:
        for topic, message in self.messages:
            self.callbacks[topic.removeprefix("/")](message)


def test_the_node_publishes_a_pose_for_each_pair_and_saves_its_map(
    node: Any, written: list[bags.Written], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    maker = bags.Maker(store, ros1=False)
    rclpy = Rclpy([(topic, maker.message(kind, t, v)) for topic, t, kind, v in written])
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    for package in ("sensor_msgs", "nav_msgs", "geometry_msgs", "std_msgs", "builtin_interfaces"):
        names = [name for name in store.types if name.startswith(f"{package}/msg/")]
        types = {name.rpartition("/")[2]: store.types[name] for name in names}
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", SimpleNamespace(**types))
    monkeypatch.chdir(tmp_path)
    node.run_node()
    places = [message.pose.pose.position for message in rclpy.published]
    in_ros = np.array([[p.x, p.y, p.z] for p in places])
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, 3] = in_ros @ BODY_FORWARD_LEFT_UP_FROM_CAMERA[:3, :3]
    assert_near_the_path(poses)
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in rclpy.published]
    sent = [stamp for topic, stamp, *_ in written if topic == "/right/image_raw"]
    np.testing.assert_allclose(stamps, sent, rtol=0, atol=300)  # a double's seconds of 2023
    assert len(load_map(Path("ros2.fgmap")).landmarks) > 50


def test_without_ros_one_line_says_so(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(SystemExit, match=r"^no rclpy here: source ROS 2, or give a bag$"):
        node.run_node()
