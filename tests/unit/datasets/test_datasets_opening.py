from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_builders import euroc, image_folder, kitti
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
