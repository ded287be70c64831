from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import stereo, write_bag
from dataset_builders import (
    HEIGHT,
    WIDTH,
    euroc,
    image_folder,
    kitti,
    picture,
    save,
    write_calibration,
)
from pydantic import TypeAdapter, ValidationError

from fgslam.core.geometry import pose
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import (
    ConstantVelocitySettings,
    EurocSettings,
    ImageFolderSettings,
    KittiSettings,
    OdometrySettings,
    RecordedOdometrySettings,
    SyntheticOdometrySettings,
)
from fgslam.runs.bare import bare_experiment

AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def test_each_kind_opens_its_layout(tmp_path: Path) -> None:
    folder = image_folder(tmp_path / "folder", 3)
    drive, _ = kitti(tmp_path / "drive", 4)
    cameras = (pose(AHEAD, np.zeros(3)), pose(AHEAD, np.array([0.0, -0.1, 0.0])))
    flight = euroc(tmp_path / "flight", cameras, 5)
    counts = [
        len(open_recording(ImageFolderSettings(path=str(folder)))),
        len(open_recording(KittiSettings(path=str(drive), sequence="06"))),
        len(open_recording(EurocSettings(path=str(flight)))),
    ]
    assert counts == [3, 4, 5]


def two_folders(root: Path) -> Path:
    return of_images(root, "left/{}.png", "right/{}.png")


def one_folder(root: Path) -> Path:
    return of_images(root, "{}_left.png", "{}_right.png")


def of_images(root: Path, left: str, right: str) -> Path:
    for k in range(3):
        save(root / left.format(k), picture(60 + k))
        save(root / right.format(k), picture(10 + k))
    write_calibration(root)
    return root


def films(root: Path) -> Path:
    root.mkdir()
    for name in ("left.avi", "right.avi"):
        code = cv2.VideoWriter.fourcc(*"MJPG")
        writer = cv2.VideoWriter(str(root / name), code, 20.0, (WIDTH, HEIGHT))
        for k in range(3):
            writer.write(np.dstack([picture(10 + k)] * 3))
        writer.release()
    write_calibration(root)
    return root


def bag(root: Path) -> Path:
    root.mkdir()
    write_bag(root / "walk.bag", stereo(3))
    return root


def depth(root: Path) -> Path:
    for k in range(3):
        save(root / "color" / f"{k}.png", np.dstack([picture(10 + k)] * 3))
        save(root / "depth" / f"{k}.png", np.full((HEIGHT, WIDTH), 2000, np.uint16))
    write_calibration(root)
    return root


@pytest.mark.parametrize("make", [image_folder, two_folders, one_folder, films, bag, depth])
def test_files_that_macos_hides_beside_others_are_none(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    root = make(tmp_path / "walk")
    expected = bare_experiment(root).said
    for path in [path for path in root.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\x00\x05\x16\x07Mac OS X" + bytes(60))
    assert bare_experiment(root).said == expected


def test_noise_settings_reach_the_odometry(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    (root / "odom.csv").write_text("0,1,0\n0.3,1,0\n0.6,1,0\n", encoding="utf-8")
    noisy = RecordedOdometrySettings(speed_sigma_mps=7.0)
    step = open_recording(ImageFolderSettings(path=str(root)), noisy).odometry(1)
    assert step is not None
    assert np.sqrt(step.covariance[3, 3]) == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("recorded", RecordedOdometrySettings),
        ("constant_velocity", ConstantVelocitySettings),
        ("synthetic", SyntheticOdometrySettings),
    ],
)
def test_kind_of_odometry_selects_its_settings(kind: str, expected: type) -> None:
    read = TypeAdapter(OdometrySettings).validate_python({"kind": kind})
    assert type(read) is expected


@pytest.mark.parametrize(
    "values",
    [
        {"path": "x", "strid": 2},
        {"path": "x", "stride": 0},
        {"path": "x", "start": -1},
        {"path": ""},
        {"path": "x", "lever_arm_m": [1.0, 2.0]},
        {"path": "x", "camera_yaw_deg": float("nan")},
        {},
    ],
)
def test_bad_settings_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        TypeAdapter(ImageFolderSettings).validate_python(values)


def test_settings_of_odometry_refuse_nonsense() -> None:
    adapter = TypeAdapter(OdometrySettings)
    for values in (
        {"kind": "recorded", "speed_sigma_mps": 0.0},
        {"kind": "synthetic", "rotation_sigma_deg": -1.0},
        {"kind": "constant_velocity", "translation_sigma_mps2": [1.0, 0.0, 1.0]},
        {"kind": "wheels"},
    ):
        with pytest.raises(ValidationError):
            adapter.validate_python(values)
