"""One recording as a folder, in EuRoC's layout, as ROS 1 and ROS 2 bag: one answer, in any dialect.

Dialects are what tools call a lens, the zeros they pad its parameters with, and the clock of each
camera.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from bags import camera_info, in_frames, raw_image, tf_static, write_bag
from dataset_builders import HEIGHT, PERIOD_NS, START_NS, WIDTH, picture, save

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import pose
from fgslam.datasets.layouts import recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.runs.config import make_config

FOCAL = (60.0, 61.0, 15.0, 12.0)
BASELINE_M = 0.11
FRAMES = 3
APART = pose(np.eye(3), np.array([BASELINE_M, 0.0, 0.0]))  # of the right camera in the left one
CAMERAS = ("left", "right")


class Dialect(NamedTuple):
    """What the lens is called, its parameters, and by how much the left clock is ahead."""

    lens: str
    parameters: tuple[float, ...]
    ahead_ns: int = 0

    def stamp(self, camera: str, frame: int) -> int:
        return START_NS + frame * PERIOD_NS + (self.ahead_ns if camera == "left" else 0)


BROWN = (-0.03, 0.004, 0.0002, -0.0001)
FISHEYE = (-0.003, 0.04, -0.038, 0.006)
CLOCK = 37_250_000_000
PLAIN = {
    "brown": Dialect("radtan", BROWN),
    "fisheye": Dialect("equidistant", FISHEYE),
    "fov": Dialect("fov", (0.9,)),
}
DIALECTS = [
    ("brown", Dialect("plumb_bob", (*BROWN, 0.0))),
    ("brown", Dialect("radial-tangential", BROWN, CLOCK)),
    ("brown", Dialect("rational_polynomial", (*BROWN, *[0.0] * 10))),
    ("brown", Dialect("Brown Conrady", (*BROWN, 0.0, 0.0), -CLOCK)),
    ("fisheye", Dialect("fisheye", (*FISHEYE, 0.0))),
    ("fisheye", Dialect("Kannala_Brandt4", (*FISHEYE, *[0.0] * 4), CLOCK)),
    ("fov", Dialect("FOV", (0.9, 0.0, 0.0, 0.0, 0.0))),
]


def image(camera: str, frame: int) -> Any:
    return picture((10 if camera == "right" else 60) + frame)


def folder(root: Path, dialect: Dialect) -> Path:
    """Images named by their times, next to Kalibr's camchain."""
    for camera in CAMERAS:
        for k in range(FRAMES):
            save(root / camera / f"{dialect.stamp(camera, k)}.png", image(camera, k))
    chain = {
        f"cam{k}": {
            "camera_model": "pinhole",
            "intrinsics": list(FOCAL),
            "distortion_model": dialect.lens,
            "distortion_coeffs": list(dialect.parameters),
            "resolution": [WIDTH, HEIGHT],
            "T_cn_cnm1": np.linalg.inv(APART).tolist(),
        }
        for k in range(2)
    }
    (root / "camchain.yaml").write_text(yaml.safe_dump(chain), encoding="utf-8")
    return root


def euroc(root: Path, dialect: Dialect) -> Path:
    for k, (camera, bTc) in enumerate(zip(CAMERAS, (np.eye(4), APART), strict=True)):
        place = root / "mav0" / f"cam{k}"
        stamps = [dialect.stamp(camera, frame) for frame in range(FRAMES)]
        for frame, stamp in enumerate(stamps):
            save(place / "data" / f"{stamp}.png", image(camera, frame))
        (place / "data.csv").write_text("".join(f"{s},{s}.png\n" for s in stamps), encoding="utf-8")
        values = {
            "T_BS": {"rows": 4, "cols": 4, "data": bTc.ravel().tolist()},
            "intrinsics": list(FOCAL),
            "resolution": [WIDTH, HEIGHT],
            "distortion_model": dialect.lens,
            "distortion_coefficients": list(dialect.parameters),
        }
        (place / "sensor.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    return root


def bag(path: Path, dialect: Dialect) -> Path:
    fx, fy, cx, cy = FOCAL
    info = camera_info(0.0) | {
        "k": np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        "p": np.zeros(12),
        "d": np.array(dialect.parameters),
        "distortion_model": dialect.lens,
    }
    written = []
    for camera in CAMERAS:
        for frame in range(FRAMES):
            stamp, topic = dialect.stamp(camera, frame), f"/{camera}"
            kinds = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo")
            written.append((f"{topic}/image_raw", stamp, kinds[0], raw_image(image(camera, frame))))
            written.append((f"{topic}/camera_info", stamp, kinds[1], info))
    frames = {f"/{camera}": f"{camera}_optical" for camera in CAMERAS}
    messages = in_frames(written, frames)
    return write_bag(path, messages + tf_static([("left_optical", "right_optical", APART)]))


LAYOUTS: dict[str, Callable[[Path, Dialect], Path]] = {
    "folder": folder,
    "EuRoC": euroc,
    "ROS 1": lambda root, dialect: bag(root / "one.bag", dialect),
    "ROS 2": lambda root, dialect: bag(root / "two.mcap", dialect),
}


def opened(root: Path, layout: str, dialect: Dialect) -> Recording:
    root.mkdir()
    found = LAYOUTS[layout](root, dialect)
    keys = recognise_layout(found)
    return open_recording(make_config({"name": "x", "dataset": keys}, str(root)).dataset)  # type: ignore[arg-type]


def answer(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Numbers of the rig, stamps from the first on; and all pixels."""
    rig, stamps = recording.rig, recording.timestamps
    numbers = np.array([rig.fx, rig.fy, rig.cx, rig.cy, rig.baseline, *(stamps - stamps[0])])
    frames = [recording.frame(k).images for k in range(len(recording))]
    return numbers, np.array(frames, np.float64)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[FloatArray, FloatArray]]:
    root = tmp_path_factory.mktemp("plain")
    return {name: answer(opened(root / name, "EuRoC", its)) for name, its in PLAIN.items()}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("lens", "dialect"), DIALECTS)
def test_one_recording_has_one_answer(
    tmp_path: Path,
    plain: dict[str, tuple[FloatArray, FloatArray]],
    layout: str,
    lens: str,
    dialect: Dialect,
) -> None:
    recording = opened(tmp_path / "in", layout, dialect)
    numbers, pixels = answer(recording)
    np.testing.assert_allclose(numbers, plain[lens][0], rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(pixels, plain[lens][1])
    said = any("37.25 s" in note for note in recording.notes)
    assert said == (dialect.ahead_ns != 0)
