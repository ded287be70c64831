from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_builders import kitti, picture, save

from fgslam.core.errors import CalibrationError, DatasetError, FgslamError, FrameError
from fgslam.core.log import ImageSequence
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import KittiSettings


def opened(root: Path, **settings: object) -> Recording:
    return open_recording(KittiSettings(path=str(root), **{"sequence": "06", **settings}))  # type: ignore[arg-type]


def test_native_layout(tmp_path: Path) -> None:
    root, left = kitti(tmp_path)
    recording = opened(root)
    assert isinstance(recording, ImageSequence)
    assert recording.name == "KITTI 06"
    assert [int(image[0, 0]) for image in recording.frame(3).images] == [13, 63]
    rig = recording.rig
    assert (rig.width, rig.height, rig.fx, rig.fy, rig.cx, rig.cy) == (32, 24, 30, 31, 15.5, 11.5)
    assert rig.baseline == pytest.approx(0.4)
    assert rig.cameras == 2
    np.testing.assert_allclose(recording.timestamps, 0.1 * np.arange(5))
    assert recording.ground_truth is not None
    offsets = np.linalg.inv(left) @ recording.ground_truth.poses
    np.testing.assert_allclose(offsets[:, :3, 3], np.tile([0.4, 0.0, 0.0], (5, 1)), atol=1e-8)
    assert recording.odometry(1) is None
    assert recording.notes == ()


@pytest.mark.parametrize("half_of_grey", [False, True])
def test_colour_cameras_have_lines_and_a_place_of_their_own(
    tmp_path: Path, half_of_grey: bool
) -> None:
    root, left = kitti(tmp_path)
    folder = root / "sequences" / "06"
    for grey, colour in (("image_0", "image_2"), ("image_1", "image_3")):
        (folder / grey).rename(folder / colour)
    if half_of_grey:
        (folder / "image_1").mkdir()
    with (folder / "calib.txt").open("a", encoding="utf-8") as file:
        for key, shift in (("P2", 1.5), ("P3", -13.5)):
            file.write(f"{key}: 30.0 0 15.5 {shift} 0 31.0 11.5 0 0 0 1 0\n")
    recording = opened(root)
    assert recording.rig.baseline == pytest.approx(0.5)
    assert [int(image[0, 0]) for image in recording.frame(3).images] == [13, 63]
    assert recording.ground_truth is not None
    offsets = np.linalg.inv(left) @ recording.ground_truth.poses
    np.testing.assert_allclose(offsets[:, :3, 3], np.tile([0.45, 0.0, 0.0], (5, 1)), atol=1e-8)


def test_selection_applies_to_truth_as_well(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path)
    whole, part = opened(root), opened(root, start=1, stride=2)
    assert part.ground_truth is not None
    assert whole.ground_truth is not None
    np.testing.assert_array_equal(part.ground_truth.poses, whole.ground_truth.poses[1::2])
    np.testing.assert_array_equal(part.ground_truth.timestamps, part.timestamps)
    assert part.frame(1).index == 3


def test_without_poses_there_is_no_truth(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path)
    (root / "poses" / "06.txt").unlink()
    assert opened(root).ground_truth is None


def test_missing_frame_is_noted_and_raises_when_read(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path)
    (root / "sequences" / "06" / "image_1" / "000000.png").unlink()
    recording = opened(root)
    assert recording.notes == ("1 of 5 frames lack an image: 0 (right)",)
    assert recording.frame(1).images[0].shape == (24, 32)
    with pytest.raises(FrameError, match=r"image_1/000000\.png cannot be read"):
        recording.frame(0)


def replaced(name: str, old: str, new: str) -> object:
    def spoil(folder: Path) -> None:
        path = folder / name
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new), encoding="utf-8")

    return spoil


def mono(folder: Path) -> None:
    (folder / "image_1").rename(folder / "image_7")


def other_size(folder: Path) -> None:
    for k in range(5):
        save(folder / "image_1" / f"{k:06d}.png", picture(k, 16, 12))


def no_calibration(folder: Path) -> None:
    (folder / "calib.txt").unlink()


BAD = [
    (mono, DatasetError, ["no image_1/", "both grey cameras", "unpack"]),
    (other_size, DatasetError, ["differ in size", "right 16x12", "left 32x24"]),
    (no_calibration, CalibrationError, ["calib.txt", "No such file", "restore"]),
    (replaced("calib.txt", "P1:", "P9:"), CalibrationError, ["calib.txt", "P1 is missing"]),
    (replaced("calib.txt", "-12.0", "nan"), CalibrationError, ["calib.txt: P1 is", "12 finite"]),
    (replaced("calib.txt", "-12.0", "12.0"), CalibrationError, ["baseline is -0.4", "swapped"]),
    (replaced("calib.txt", "-12.0", "0.0"), CalibrationError, ["baseline is 0", "positive"]),
    (
        replaced("calib.txt", "P1: 30.0", "P1: 33.0"),
        CalibrationError,
        ["P0 and P1", "not rectified"],
    ),
    (replaced("times.txt", "3.00", "2.00"), DatasetError, ["times.txt, line 4", "line 3", "order"]),
    (replaced("../../poses/06.txt", "e", "x"), DatasetError, ["06.txt, line 1", "not a number"]),
]


@pytest.mark.parametrize(("spoil", "error", "words"), BAD)
def test_bad_recording_is_refused_in_one_line(
    tmp_path: Path, spoil: object, error: type[FgslamError], words: list[str]
) -> None:
    root, _ = kitti(tmp_path)
    opened(root)
    spoil(root / "sequences" / "06")  # type: ignore[operator]
    with pytest.raises(error) as raised:
        opened(root)
    assert "\n" not in str(raised.value)
    for part in words:
        assert part in str(raised.value)


def test_absent_sequence(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path)
    with pytest.raises(DatasetError, match="sequences/07 does not exist"):
        opened(root, sequence="07")


def test_too_few_poses(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path)
    path = root / "poses" / "06.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:3]), encoding="utf-8")
    with pytest.raises(DatasetError, match=r"has 3 poses but times.txt has 5 frames; restore"):
        opened(root)


def test_pose_that_is_no_rotation_names_the_line(tmp_path: Path) -> None:
    root, left = kitti(tmp_path)
    left[2, :3, :3] *= 2.0
    np.savetxt(root / "poses" / "06.txt", left[:, :3].reshape(5, 12))
    with pytest.raises(DatasetError, match=r"06\.txt, line 3: not a rotation"):
        opened(root)
