"""Drives of KITTI raw with their inertial data, in the native layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_builders import CALIBRATION, HEIGHT, WIDTH, picture, save
from scipy.spatial.transform import Rotation

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, DatasetError, FgslamError
from fgslam.core.geometry import inverse, pose, so3_exp
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import KittiRawSettings
from fgslam.runs.bare import bare_experiment

FRAMES, PERIOD = 12, 0.1
SPEED, TURN = 8.0, 0.4  # m/s, rad/s to the left
RADIUS = 6_378_137.0
TO_SCANNER = pose(so3_exp(np.array([0.01, -0.02, 0.005])), np.array([-0.81, 0.32, -0.80]))
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
TO_CAMERA = pose(AXES @ so3_exp(np.array([0.0, 0.01, 0.0])), np.array([0.0, -0.08, -0.27]))
UPRIGHT = pose(so3_exp(np.array([0.004, 0.007, -0.01])), np.zeros(3))


def driven(times: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) of the unit in a circle, tilted, from a heading of 0.7."""
    yaw = 0.7 + TURN * times
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    angles = np.column_stack([yaw, np.full_like(yaw, 0.03), np.full_like(yaw, -0.02)])
    poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    radius = SPEED / TURN
    poses[:, 0, 3] = radius * (np.sin(yaw) - np.sin(0.7))
    poses[:, 1, 3] = radius * (np.cos(0.7) - np.cos(yaw))
    return poses


def row(wTi: FloatArray) -> str:
    """The numbers of a moment; places by the inverse of Mercator's projection at 49 degrees."""
    latitude = np.radians(49.0)
    scale = np.cos(latitude) * RADIUS
    north = np.log(np.tan(0.25 * np.pi + 0.5 * latitude)) + wTi[1, 3] / scale
    yaw, pitch, roll = Rotation.from_matrix(wTi[:3, :3]).as_euler("ZYX")
    values = np.zeros(30)
    values[0] = np.degrees(2.0 * np.arctan(np.exp(north)) - 0.5 * np.pi)
    values[1] = 8.0 + np.degrees(wTi[0, 3] / scale)
    values[2] = 110.0 + wTi[2, 3]
    values[3:6] = roll, pitch, yaw
    values[8], values[22] = SPEED, TURN
    return " ".join(f"{v:.15g}" for v in values)


def stamps(times: FloatArray) -> str:
    return "".join(f"2011-09-26 13:02:{5.0 + t:013.10f}\n" for t in times)


def motion(path: Path, aTb: FloatArray) -> None:
    words = " ".join(f"{v:.12g}" for v in aTb[:3, :3].ravel())
    place = " ".join(f"{v:.12g}" for v in aTb[:3, 3])
    path.write_text(f"calib_time: 1-Jan-2012 00:00:00\nR: {words}\nT: {place}\n", encoding="utf-8")


def drive(root: Path) -> Path:
    date = root / "2011_09_26"
    out = date / "2011_09_26_drive_0005_sync"
    frames = PERIOD * np.arange(FRAMES)
    for number, code in (("00", 60), ("01", 10)):
        for k in range(FRAMES):
            save(out / f"image_{number}" / "data" / f"{k:010d}.png", picture(code + k))
        text = stamps(frames + 0.01)
        (out / f"image_{number}" / "timestamps.txt").write_text(text, encoding="utf-8")
    data = out / "oxts" / "data"
    data.mkdir(parents=True)
    for k, wTi in enumerate(driven(frames)):
        (data / f"{k:010d}.txt").write_text(row(wTi), encoding="utf-8")
    (out / "oxts" / "timestamps.txt").write_text(stamps(frames), encoding="utf-8")
    focal = CALIBRATION["fx"]
    upright = " ".join(f"{v:.12g}" for v in UPRIGHT[:3, :3].ravel())
    lines = [f"R_rect_00: {upright}"]
    for number, shift in (("00", 0.0), ("01", -0.4 * focal)):
        lines.append(f"S_rect_{number}: {WIDTH} {HEIGHT}")
        lines.append(f"P_rect_{number}: {focal} 0 15.5 {shift} 0 {focal} 11.5 0 0 0 1 0")
    (date / "calib_cam_to_cam.txt").write_text("\n".join(lines), encoding="utf-8")
    motion(date / "calib_imu_to_velo.txt", TO_SCANNER)
    motion(date / "calib_velo_to_cam.txt", TO_CAMERA)
    return out


def opened(path: Path) -> Recording:
    return open_recording(KittiRawSettings(path=str(path)))


def test_oxts_are_odometry_and_truth_of_the_camera(tmp_path: Path) -> None:
    path = drive(tmp_path)
    recording = opened(path)
    right = pose(np.eye(3), np.array([0.4, 0.0, 0.0]))
    iTc = inverse(UPRIGHT @ TO_CAMERA @ TO_SCANNER) @ right
    np.testing.assert_allclose(recording.rig.bTc, iTc, rtol=0.0, atol=1e-9)
    truth = recording.ground_truth
    assert truth is not None
    # The last image is 10 ms after the last row: it has none.
    assert len(truth) == FRAMES - 1
    expected = driven(PERIOD * np.arange(FRAMES - 1) + 0.01) @ iTc
    expected = inverse(expected[0]) @ expected
    found = inverse(truth.poses[0]) @ truth.poses
    # Poses between rows are interpolated: a chord of 0.8 m is 2 mm off the circle.
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=3e-3)
    step = recording.odometry(3)
    assert step is not None
    assert np.linalg.norm(step.motion[:3, 3]) == pytest.approx(SPEED * PERIOD, abs=1e-3)
    assert np.arctan2(step.motion[1, 0], step.motion[0, 0]) == pytest.approx(0.04, abs=1e-6)
    assert "; odometry; truth, for evaluation only" in bare_experiment(path).said


def test_without_its_place_on_the_car_it_is_odometry_alone(tmp_path: Path) -> None:
    path = drive(tmp_path)
    (path.parent / "calib_imu_to_velo.txt").unlink()
    recording = opened(path)
    assert recording.ground_truth is None
    assert recording.odometry(1) is not None
    assert "and not as truth: next to calib_cam_to_cam.txt there are no" in recording.notes[-1]


def cut(path: Path) -> None:
    file = path / "oxts" / "data" / "0000000003.txt"
    file.write_text(file.read_text(encoding="utf-8")[:40], encoding="utf-8")


def no_number(path: Path) -> None:
    (path / "oxts" / "data" / "0000000003.txt").write_text("nan " * 30, encoding="utf-8")


def no_times(path: Path) -> None:
    (path / "oxts" / "timestamps.txt").unlink()


def backwards(path: Path) -> None:
    file = path / "oxts" / "timestamps.txt"
    lines = file.read_text(encoding="utf-8").splitlines()
    file.write_text("\n".join([lines[1], lines[0], *lines[2:]]), encoding="utf-8")


def turned(path: Path) -> None:
    (path.parent / "calib_velo_to_cam.txt").write_text("R: 1 0 0\nT: 0 0 0\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("spoil", "error", "words"),
    [
        (cut, DatasetError, r"0000000003\.txt: expected 30 numbers; restore"),
        (no_number, DatasetError, r"0000000003\.txt: expected 30 numbers"),
        (no_times, DatasetError, r"oxts has no timestamps\.txt; restore it"),
        (backwards, DatasetError, "time of image 2 does not come after"),
        (turned, CalibrationError, "R is .*, expected 9 finite numbers"),
    ],
)
def test_bad_inertial_data_are_one_line(
    tmp_path: Path, spoil: object, error: type[FgslamError], words: str
) -> None:
    path = drive(tmp_path)
    spoil(path)  # type: ignore[operator]
    with pytest.raises(error, match=words) as raised:
        opened(path)
    assert "\n" not in str(raised.value)
