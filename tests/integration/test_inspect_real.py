"""`fgslam inspect` on real recordings, sound and spoilt (`shared/data`; linked, never copied)."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from fgslam.core.errors import DatasetError
from fgslam.runs.inspect import inspect_recording

pytestmark = pytest.mark.data


def source(shared_data: Path, name: str) -> Path:
    if not (shared_data / name).is_dir():
        pytest.skip(f"no recording {name} in {shared_data}: this test needs it")
    return shared_data / name


def linked(recording: Path, target: Path, **cameras: str) -> Path:
    """The recording by links, each camera's images taken from the folder that is given."""
    target.mkdir()
    for path in recording.iterdir():
        (target / path.name).symlink_to(recording / cameras.get(path.name, path.name))
    return target


def flat(report: str) -> str:
    return " ".join(report.split())


@pytest.mark.parametrize(
    "name",
    [
        "euroc_v101_kf100",
        "kitti06",
        pytest.param("kitti_raw_0926_5hz", marks=pytest.mark.slow),
        pytest.param("stanford_chess_grid", marks=pytest.mark.slow),
    ],
)
def test_real_recordings_have_no_problem(shared_data: Path, name: str) -> None:
    report = inspect_recording(source(shared_data, name), (), 5)
    assert "No problem" in report.splitlines()[-1]
    assert "epipolar:" not in report
    assert "matches:" not in report


def test_exchanged_folders_are_reported(shared_data: Path, tmp_path: Path) -> None:
    recording = source(shared_data, "kitti06")
    swapped = linked(recording, tmp_path / "swapped", left="right", right="left")
    report = inspect_recording(swapped, (), 5)
    assert "PROBLEM  epipolar: cameras look swapped: 9" in report


def test_turned_left_camera_is_measured(shared_data: Path, tmp_path: Path) -> None:
    recording = source(shared_data, "euroc_v101_kf100")
    root = linked(recording, tmp_path / "turned")
    (root / "left").unlink()
    (root / "left").mkdir()
    matrix = cv2.getRotationMatrix2D((187.5, 119.5), 1.0, 1.0)
    for k in range(40):
        name = f"left/{k:06d}.png"
        image = cv2.imread(str(recording / name), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(root / name), cv2.warpAffine(image, matrix, (376, 240)))
    report = flat(inspect_recording(root, ["dataset.stop=40"], 8))
    reported = report.partition("turned anticlockwise by about ")[2].split(" ", maxsplit=1)[0]
    assert float(reported) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow  # the same car's clock by default: tests/unit/datasets/test_clock.py
def test_clock_of_the_real_odometry(shared_data: Path) -> None:
    """-0.06 s is what the images alone gave (docs/datasets/images.md)."""
    root = source(shared_data, "kitti_raw_0926_5hz")
    assert "stamps are shifted by -0.06 s" in flat(inspect_recording(root, (), 1))
    corrected = inspect_recording(root, ["odometry.time_offset_s=-0.06"], 1)
    assert "odometry.time_offset_s" not in corrected


def test_experiment_on_a_real_recording(shared_data: Path, tmp_path: Path) -> None:
    root = source(shared_data, "kitti06")
    experiment = tmp_path / "drive.yaml"
    text = f"name: drive\ndataset: {{kind: image_folder, path: {root}, stop: 20}}\n"
    experiment.write_text(text + "odometry: {kind: constant_velocity}\n", encoding="utf-8")
    assert "frames 20 over" in flat(inspect_recording(experiment, (), 2))
    with pytest.raises(DatasetError, match=r"does not exist; check dataset\.path"):
        inspect_recording(experiment, [f"dataset.path={tmp_path / 'absent'}"])
