"""Bags of one camera and its depth: topics, encodings, registration, place on the robot."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bags import (
    PERIOD_NS,
    START_NS,
    Written,
    camera_info,
    in_frames,
    odometry,
    raw_image,
    tf_static,
    write_bag,
)
from dataset_builders import CALIBRATION, HEIGHT, WIDTH, picture

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, DatasetError, FrameError
from fgslam.core.geometry import pose
from fgslam.datasets.depth import BASELINE_M
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import BagSettings, RecordedOdometrySettings
from fgslam.runs.bare import bare_experiment

SHIFT = 10  # pixels, by which what is seen from the left is further right
DEPTH_M = CALIBRATION["fx"] * BASELINE_M / SHIFT
COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"


def in_millimetres(metres: FloatArray) -> dict[str, Any]:
    return raw_image((1000.0 * metres).round().astype(np.uint16), "16UC1")


def in_metres(metres: FloatArray) -> dict[str, Any]:
    return raw_image(metres.astype(np.float32), "32FC1", padding=8)


def packed(metres: FloatArray) -> dict[str, Any]:
    """As compressed_depth_image_transport packs integers: a header, then PNG."""
    data = cv2.imencode(".png", (1000.0 * metres).round().astype(np.uint16))[1].tobytes()
    return compressed("16UC1; compressedDepth png", bytes(12) + data)


def packed_floats(metres: FloatArray) -> dict[str, Any]:
    """Floats are coded by their inverse, with the two numbers in the header."""
    a = 100.0 * 101.0
    b = 1.0 - a / 10.0
    coded = np.where(metres > 0.0, a / np.where(metres > 0.0, metres, 1.0) + b, 0.0)
    data = cv2.imencode(".png", coded.astype(np.uint16))[1].tobytes()
    return compressed("32FC1; compressedDepth png", struct.pack("<iff", 0, a, b) + data)


def compressed(form: str, data: bytes) -> dict[str, Any]:
    return {"format": form, "data": np.frombuffer(data, np.uint8)}


def image(topic: str, k: int, fields: dict[str, Any]) -> Written:
    kind = "CompressedImage" if "format" in fields else "Image"
    return topic, START_NS + k * PERIOD_NS, f"sensor_msgs/msg/{kind}", fields


def walk(encode: Any = in_millimetres, names: tuple[str, str] = (COLOUR, DEPTH)) -> list[Written]:
    """Three frames of a wall; of frame k the colours' corner pixel is 10 + k."""
    wall = np.full((HEIGHT, WIDTH), DEPTH_M)
    out = []
    for k in range(3):
        out.append(image(names[0], k, raw_image(np.dstack([picture(10 + k)] * 3), "bgr8")))
        out.append(image(names[1], k, encode(wall)))
        info = names[0].rpartition("/")[0] + "/camera_info"
        stamp = START_NS + k * PERIOD_NS
        out.append((info, stamp, "sensor_msgs/msg/CameraInfo", camera_info(0.0)))
    return out


def opened(path: Path, **settings: Any) -> Recording:
    return open_recording(BagSettings(path=str(path), **settings), RecordedOdometrySettings())


FORMS = {
    "millimetres, ROS 1": (
        ".bag",
        in_millimetres,
        ("/camera/rgb/image_color", "/camera/depth/image"),
    ),
    "metres": (".mcap", in_metres, ("/camera/rgb/image_color", "/camera/depth/image")),
    "packed": (".mcap", packed, (COLOUR, f"{DEPTH}/compressedDepth")),
    "packed floats": (
        ".mcap",
        packed_floats,
        ("/rgb/image_raw", "/depth_to_rgb/image_raw/compressedDepth"),
    ),
    "a camera called depth": (
        ".mcap",
        in_metres,
        ("/depth_cam/image_raw", "/depth_cam/depth/image_raw"),
    ),
    "DepthAI": (".db3", in_millimetres, ("/oak/rgb/image_raw", "/oak/stereo/image_raw")),
}


@pytest.mark.parametrize("name", FORMS)
def test_colour_and_depth_are_a_pair(tmp_path: Path, name: str) -> None:
    ending, encode, names = FORMS[name]
    recording = opened(write_bag(tmp_path / f"walk{ending}", walk(encode, names)))
    assert len(recording) == 3
    assert recording.rig.baseline == BASELINE_M
    right, left = recording.frame(2).images
    assert np.array_equal(right, picture(12))
    # Coded inverses are whole numbers, which shifts pixels of noise by a few thousandths.
    most = 2 if name == "packed floats" else 0
    assert np.abs(left[:, SHIFT:].astype(int) - right[:, :-SHIFT]).max() <= most
    assert f"{names[1]} is the depth of {names[0]}" in recording.notes[0]


def test_the_noise_of_depth_is_part_of_the_experiment(tmp_path: Path) -> None:
    bare = bare_experiment(write_bag(tmp_path / "walk.mcap", walk()))
    # 30 px * 0.08 m * 1.425 mm, and 0.15 px by which a point is found again.
    assert bare.values["frontend"] == {"stereo": {"disparity_sigma_px": 0.15}}


def test_registered_depth_is_taken_and_other_depth_only_by_name(tmp_path: Path) -> None:
    own = "/camera/depth/image_rect_raw"
    raw = [image(own, k, in_metres(np.full((HEIGHT, WIDTH), 9.0))) for k in range(3)]
    frames = {COLOUR: "colour", DEPTH: "colour", own: "depth"}
    both = write_bag(tmp_path / "both.mcap", in_frames([*walk(), *raw], frames))
    assert DEPTH in opened(both).notes[0]
    alone = [each for each in in_frames([*walk(), *raw], frames) if each[0] != DEPTH]
    bag = write_bag(tmp_path / "alone.mcap", alone)
    with pytest.raises(
        CalibrationError, match=r"in the frame depth, .* in colour: depth must be r"
    ):
        opened(bag)
    assert "as it was chosen by --topics" in opened(bag, topics=(COLOUR, own)).notes[0]


def test_what_realsenses_viewer_records(tmp_path: Path) -> None:
    """Depth is that of the first infrared camera; the colour sensor sees from another place."""
    sensor = "/device_0/sensor_0"
    names = (f"{sensor}/Infrared_1/image/data", f"{sensor}/Depth_0/image/data")
    written = [
        (t.replace("/image/camera_info", "/info/camera_info"), *rest)
        for t, *rest in walk(names=names)
    ]
    assert len(opened(write_bag(tmp_path / "infra.bag", written))) == 3
    colour = [(t.replace("sensor_0/Infra", "sensor_1/Infra"), *rest) for t, *rest in written]
    with pytest.raises(CalibrationError, match=r"are of two sensors: depth must be registered"):
        opened(write_bag(tmp_path / "colour.bag", colour))


def test_the_largest_integer_is_no_depth(tmp_path: Path) -> None:
    def marked(metres: FloatArray) -> dict[str, Any]:
        millimetres = (1000.0 * metres).round().astype(np.uint16)
        millimetres[:, :16] = 65535
        return raw_image(millimetres, "16UC1")

    right, left = opened(write_bag(tmp_path / "a.mcap", walk(marked))).frame(0).images
    assert np.array_equal(left[:, 26:], right[:, 16:-10])
    assert left[:, 8:16].std() < 0.2 * right[:, 8:16].std(), "unknown, not at infinity"


def test_the_colour_camera_is_where_tf_static_has_it(tmp_path: Path) -> None:
    place = pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.2, -0.1, 0.5]))
    stamps = START_NS + PERIOD_NS * np.arange(3)
    poses = np.column_stack([0.1 * np.arange(3), np.zeros((3, 3))])
    frames = dict.fromkeys((COLOUR, DEPTH), "camera_optical")
    written = [*in_frames(walk(), frames), *odometry(stamps.tolist(), poses)]
    mounted = tf_static([("base_link", "camera_optical", place)])
    recording = opened(write_bag(tmp_path / "walk.mcap", [*written, *mounted]))
    assert np.allclose(recording.rig.bTc, place, rtol=0.0, atol=1e-12)


def test_what_is_no_depth_is_said(tmp_path: Path) -> None:
    def as_jpeg(metres: FloatArray) -> dict[str, Any]:
        return compressed("jpeg", cv2.imencode(".jpg", (99 * metres).astype(np.uint8))[1].tobytes())

    def as_rvl(metres: FloatArray) -> dict[str, Any]:
        return compressed("16UC1; compressedDepth rvl", bytes(40))

    def too_small(metres: FloatArray) -> dict[str, Any]:
        return in_millimetres(metres[::2, ::2])

    for encode, words in (
        (as_jpeg, "images of uint8 are no depth; record them as PNG"),
        (as_rvl, "depth in the format RVL is not read"),
        (too_small, "is 16x12, its colour image 32x24; depth must be registered"),
    ):
        bag = write_bag(tmp_path / f"{encode.__name__}.mcap", walk(encode))
        with pytest.raises(FrameError, match=words):
            opened(bag).frame(0)
    bag = write_bag(tmp_path / "view.mcap", walk())
    with pytest.raises(DatasetError, match=r"dataset\.unit_m is for two cameras"):
        opened(bag, unit_m=0.001)
    uncalibrated = [each for each in walk() if not each[0].endswith("camera_info")]
    with pytest.raises(CalibrationError, match=f"no camera_info belongs to {COLOUR}; give its cal"):
        opened(write_bag(tmp_path / "bare.mcap", uncalibrated))
