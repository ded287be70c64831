"""`fgslam inspect` on real recordings, sound and spoilt (`shared/data`; linked, never copied)."""

from __future__ import annotations

from pathlib import Path

import pytest

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


@pytest.mark.parametrize(
    "name",
    [
        "euroc_v101_kf100",
        "kitti06",
        pytest.param("kitti_raw_0926_5hz", marks=pytest.mark.slow),
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
