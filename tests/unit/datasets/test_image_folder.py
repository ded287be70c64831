from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from dataset_builders import (
    CALIBRATION,
    HEIGHT,
    WIDTH,
    curve,
    image_folder,
    picture,
    save,
    write_calibration,
    write_tum,
)

from fgslam.cameras.calib_json import raw_values
from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.core.errors import CalibrationError, DatasetError, FgslamError, FrameError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, pose, right_from_left_camera
from fgslam.core.log import ImageSequence
from fgslam.datasets.images import read_grey_image
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import ImageFolderSettings


def opened(root: Path, **settings: object) -> Recording:
    return open_recording(ImageFolderSettings(path=str(root), **settings))  # type: ignore[arg-type]


def corners(recording: Recording, i: int) -> list[int]:
    return [int(image[0, 0]) for image in recording.frame(i).images]


def assert_one_line(message: str, *parts: str) -> None:
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_stereo_folder_gives_right_then_left_images_with_stamps(tmp_path: Path) -> None:
    recording = opened(image_folder(tmp_path / "drive"))
    assert isinstance(recording, ImageSequence)
    assert recording.name == "drive"
    assert len(recording) == 6
    np.testing.assert_allclose(recording.timestamps, 0.1 * np.arange(6))
    assert corners(recording, 4) == [14, 64]
    np.testing.assert_array_equal(recording.frame(2).images[0], picture(12))
    rig = recording.rig
    assert (rig.width, rig.height, rig.fx, rig.fy) == (32, 24, 30.0, 31.0)
    assert (rig.cx, rig.cy, rig.baseline) == (15.5, 11.5, 0.2)
    assert rig.cameras == 2
    assert recording.notes == ()
    assert recording.ground_truth is None
    assert recording.odometry(1) is None


def test_top_camera_comes_third_and_can_be_left_out(tmp_path: Path) -> None:
    root = image_folder(tmp_path, top=True)
    three = opened(root)
    assert corners(three, 1) == [11, 61, 111]
    assert three.rig.vertical_baseline == 0.15
    two = opened(root, use_top=False)
    assert corners(two, 1) == [11, 61]
    assert two.rig.cameras == 2


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        ({"start": 2}, [2, 3, 4, 5]),
        ({"stop": 3}, [0, 1, 2]),
        ({"stop": 99, "stride": 2}, [0, 2, 4]),
        ({"start": 1, "stop": 6, "stride": 4}, [1, 5]),
    ],
)
def test_selection_keeps_the_recordings_own_numbers_and_stamps(
    tmp_path: Path, selection: dict[str, int], expected: list[int]
) -> None:
    recording = opened(image_folder(tmp_path), **selection)
    assert [recording.frame(i).index for i in range(len(recording))] == expected
    np.testing.assert_allclose(recording.timestamps, 0.1 * np.array(expected))
    assert [corners(recording, i)[0] for i in range(len(recording))] == [10 + k for k in expected]


def test_selection_without_frames_is_refused(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    with pytest.raises(DatasetError) as beyond:
        opened(root, start=6)
    assert_one_line(str(beyond.value), "start is 6", "0 to 5", "smaller")
    with pytest.raises(DatasetError) as nothing:
        opened(root, start=3, stop=3)
    assert_one_line(str(nothing.value), "stop (3)", "start (3)", "larger")


def test_frame_index_out_of_range(tmp_path: Path) -> None:
    recording = opened(image_folder(tmp_path))
    for bad in (-1, 6):
        with pytest.raises(IndexError):
            recording.frame(bad)
    with pytest.raises(IndexError):
        recording.odometry(0)


def test_truth_of_the_left_camera_becomes_the_right_ones(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    left = curve(6)
    write_tum(root / "gt_left_cam.txt", 0.1 * np.arange(6), left)
    truth = opened(root, start=1, stride=2).ground_truth
    assert truth is not None
    expected = right_from_left_camera(left, 0.2)[1::2]
    np.testing.assert_allclose(truth.poses, expected, atol=1e-8)
    np.testing.assert_allclose(truth.timestamps, [0.1, 0.3, 0.5])
    # The right camera is a baseline along the left one's x axis.
    offset = np.linalg.inv(left[1]) @ truth.poses[0]
    np.testing.assert_allclose(offset[:3, 3], [0.2, 0.0, 0.0], atol=1e-7)


def test_truth_of_the_right_camera_is_taken_as_it_is(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    write_tum(root / "gt_right_cam.txt", 0.1 * np.arange(6), curve(6))
    truth = opened(root).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.poses, curve(6), atol=1e-8)


def test_truth_that_covers_part_of_the_frames(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    write_tum(root / "gt_right_cam.txt", 0.1 * np.arange(2, 5), curve(6)[2:5])
    truth = opened(root).ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps, [0.2, 0.3, 0.4])


def test_mounting_from_calibration_and_from_settings(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    np.testing.assert_array_equal(opened(root).rig.bTc, BODY_FORWARD_LEFT_UP_FROM_CAMERA)
    bTc = BODY_FORWARD_LEFT_UP_FROM_CAMERA.copy()
    bTc[:3, 3] = [0.3, -0.1, 0.5]
    write_calibration(root, bTc=bTc.tolist())
    np.testing.assert_array_equal(opened(root).rig.bTc, bTc)
    turned = opened(root, camera_yaw_deg=90.0, lever_arm_m=(1.0, 2.0, 3.0)).rig.bTc
    # A camera turned to the left looks along the body's y axis.
    np.testing.assert_allclose(turned[:3, 2], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(turned[:3, 3], [1.0, 2.0, 3.0])


def test_missing_images_are_noted_and_raise_only_when_read(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    (root / "left" / "000003.png").unlink()
    (root / "right" / "000000.png").unlink()
    recording = opened(root)
    assert len(recording) == 6
    assert recording.notes == ("2 of 6 frames lack an image: 0 (right), 3 (left)",)
    assert corners(recording, 1) == [11, 61]
    with pytest.raises(FrameError) as error:
        recording.frame(3)
    assert_one_line(str(error.value), "left/000003.png", "No such file", "restore")


def truncate(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def flip_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(bytes(data))


def empty(path: Path) -> None:
    path.write_bytes(b"")


def no_image(path: Path) -> None:
    path.write_text("hello", encoding="utf-8")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (truncate, ["truncated", "copy the file again"]),
        (flip_bit, ["damaged", "copy the file again"]),
        (empty, ["empty", "copy the file again"]),
        (no_image, ["not an image", "restore"]),
    ],
)
def test_damaged_image_is_refused(tmp_path: Path, damage: object, words: list[str]) -> None:
    root = image_folder(tmp_path)
    damage(root / "right" / "000002.png")  # type: ignore[operator]
    recording = opened(root)
    assert corners(recording, 1) == [11, 61]
    with pytest.raises(FrameError) as error:
        recording.frame(2)
    assert_one_line(str(error.value), "right/000002.png", *words)


def test_png_cut_between_its_data_chunks_is_refused(tmp_path: Path) -> None:
    """The decoder would fill in grey: all chunks that are left are sound."""
    path = tmp_path / "noise.png"
    save(path, picture(3, 300, 200))
    data = path.read_bytes()
    chunks = [at for at in range(len(data)) if data[at : at + 4] == b"IDAT"]
    assert len(chunks) > 2
    np.testing.assert_array_equal(read_grey_image(path), picture(3, 300, 200))
    for cut in (chunks[1] - 4, chunks[2] - 4, len(data) - 12, len(data) - 1):
        path.write_bytes(data[:cut])
        with pytest.raises(FrameError, match=f"truncated at {cut} bytes"):
            read_grey_image(path)


def test_truncated_jpeg_is_refused(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    (root / "right" / "000002.png").unlink()
    save(root / "right" / "000002.jpg", picture(12))
    assert opened(root).frame(2).images[0].shape == (24, 32)
    truncate(root / "right" / "000002.jpg")
    with pytest.raises(FrameError, match=r"000002\.jpg is truncated"):
        opened(root).frame(2)


def test_later_frame_of_another_size(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    save(root / "left" / "000004.png", picture(64, 30, 24))
    with pytest.raises(FrameError) as error:
        opened(root).frame(4)
    assert_one_line(str(error.value), "left/000004.png", "30x24", "32x24", "restore")


def resize_left(root: Path) -> None:
    for k in range(6):
        save(root / "left" / f"{k:06d}.png", picture(60 + k, 16, 12))


def remove_camera(root: Path) -> None:
    for path in (root / "left").iterdir():
        path.unlink()
    (root / "left").rmdir()


def empty_camera(root: Path) -> None:
    for path in (root / "left").iterdir():
        path.unlink()


def no_common_frame(root: Path) -> None:
    for k in range(6):
        (root / ("left" if k % 2 else "right") / f"{k:06d}.png").unlink()


def times(text: str) -> object:
    return lambda root: (root / "times.txt").write_text(text, encoding="utf-8")


def calibrated(**changes: object) -> object:
    return lambda root: write_calibration(root, **changes)


def renamed_key(old: str, new: str) -> object:
    def rename(root: Path) -> None:
        path = root / "calib.json"
        path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")

    return rename


def without_key(root: Path) -> None:
    (root / "calib.json").write_text('{"width": 32}', encoding="utf-8")


def broken_json(root: Path) -> None:
    (root / "calib.json").write_text("{", encoding="utf-8")


def no_calibration(root: Path) -> None:
    (root / "calib.json").unlink()


def two_images_of_a_frame(root: Path) -> None:
    save(root / "left" / "3.jpg", picture(1))


BAD_RECORDINGS = [
    (resize_left, DatasetError, ["right 32x24, left 16x12", "one size"]),
    (remove_camera, DatasetError, ["no folder left", "one camera", "stereo pair"]),
    (empty_camera, DatasetError, ["left", "whole camera", "restore"]),
    (no_common_frame, DatasetError, ["not one of 6 frames", "2 cameras", "check"]),
    (two_images_of_a_frame, DatasetError, ["left", "two images of frame 3", "remove"]),
    (times(""), DatasetError, ["no frame at all", "check"]),
    (times("# number time\n"), DatasetError, ["no frame at all"]),
    (times("0 0.0\n1 0.1\n2 0.1\n"), DatasetError, ["times.txt, line 3", "0.100000", "line 2"]),
    (times("0 0.0\n\n1 0.2\n2 0.1\n"), DatasetError, ["line 4", "time order"]),
    (times("0 0.0\n1\n"), DatasetError, ["line 2", "1 columns, expected 2", "complete"]),
    (times("0 0.0\n1 soon\n"), DatasetError, ["line 2", "'soon'", "not a number"]),
    (times("0 0.0\n1 nan\n"), DatasetError, ["line 2", "nan", "not finite"]),
    (times("0 0.0\n0 1.0\n"), DatasetError, ["line 2", "image number 0", "twice"]),
    (times("0 0.0\n1e300 1.0\n"), DatasetError, ["line 2", "1e+300 is not a whole number"]),
    (times("0 0.0\n1.5 1.0\n"), DatasetError, ["line 2", "1.5", "whole number"]),
    (calibrated(fx=float("nan")), CalibrationError, ["calib.json", "fx is nan", "correct"]),
    (calibrated(cx=float("inf")), CalibrationError, ["cx is inf"]),
    (calibrated(fy="31"), CalibrationError, ["fy is '31'"]),
    (calibrated(baseline_m=0.0), CalibrationError, ["baseline_m is 0", "positive"]),
    (calibrated(baseline_m=-0.2), CalibrationError, ["baseline_m is -0.2", "swap the folders"]),
    (calibrated(width=32.5), CalibrationError, ["width is 32.5", "whole number"]),
    (calibrated(width=64), CalibrationError, ["32x24", "64x24", "scale"]),
    (calibrated(bTc=[[1, 0], [0, 1]]), CalibrationError, ["bTc", "rigid 4x4"]),
    (calibrated(bTc=np.diag([1, 1, -1, 1]).tolist()), CalibrationError, ["bTc", "rigid"]),
    (calibrated(rectified=False), CalibrationError, ["not rectified", "rectify them"]),
    (without_key, CalibrationError, ["no 'height'", "add it"]),
    (
        renamed_key('"baseline_m"', '"baseline"'),
        CalibrationError,
        ["no 'baseline_m'", "if 'baseline' means it, rename it", "metres"],
    ),
    (renamed_key('"fx"', '"gx"'), CalibrationError, ["no 'fx'; add it"]),
    (broken_json, CalibrationError, ["not JSON", "correct"]),
    (no_calibration, CalibrationError, ["calib.json", "No such file"]),
]


@pytest.mark.parametrize(("spoil", "error", "words"), BAD_RECORDINGS)
def test_bad_recording_is_refused_in_one_line(
    tmp_path: Path, spoil: object, error: type[FgslamError], words: list[str]
) -> None:
    root = image_folder(tmp_path)
    opened(root)
    spoil(root)  # type: ignore[operator]
    with pytest.raises(error) as raised:
        opened(root)
    assert type(raised.value) is error
    assert_one_line(str(raised.value), str(tmp_path), *words)


def test_absent_recording(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="does not exist; check dataset"):
        opened(tmp_path / "nowhere")


def test_of_three_cameras_in_a_line_the_outer_two_are_used(tmp_path: Path) -> None:
    """As ``fgslam calibrate trinocular`` writes them: left, right and the one in top/."""
    root = image_folder(tmp_path, top=True)
    matrix = np.array([[30.0, 0.0, 15.5], [0.0, 30.0, 11.5], [0.0, 0.0, 1.0]])
    cameras = tuple(
        RawCamera(WIDTH, HEIGHT, matrix, np.zeros(4), pose(np.eye(3), np.array([x, 0.0, 0.0])))
        for x in (0.0, 0.1, 0.3)
    )
    values = raw_values(Calibration("made", "made", cameras, sided=True))
    (root / "calib.json").write_text(json.dumps(values), encoding="utf-8")
    recording = opened(root)
    assert recording.rig.baseline == pytest.approx(0.3)
    assert corners(recording, 1) == [111, 61]  # the third one is the right one of the two
    assert "between the others, is not used" in recording.notes[0]


def test_top_camera_needs_a_vertical_baseline(tmp_path: Path) -> None:
    root = image_folder(tmp_path, top=True)
    write_calibration(root)
    with pytest.raises(CalibrationError, match="vertical_baseline_m"):
        opened(root)
    assert opened(root, use_top=False).rig.cameras == 2


def test_truth_with_a_bad_quaternion_names_the_line(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    (root / "gt_left_cam.txt").write_text("# t\n0 0 0 0 0 0 0 1\n0.1 0 0 0 1 1 0 1\n")
    with pytest.raises(DatasetError) as error:
        opened(root)
    assert_one_line(str(error.value), "gt_left_cam.txt, line 3", "quaternion", "order")


def test_calibrated_top_camera_without_images_is_noted(tmp_path: Path) -> None:
    root = image_folder(tmp_path, top=True)
    (root / "top").rename(root / "Top")
    assert opened(root).rig.cameras == 2
    assert "no top/: read as two cameras" in opened(root).notes[0]
    assert opened(root, use_top=False).notes == ()


def test_unlisted_images_are_noted(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    save(root / "left" / "000017.png", picture(1))
    assert opened(root).notes == ("1 images of left/ are not in times.txt and unused",)


def test_identity_depends_on_the_recording_not_on_the_selection(tmp_path: Path) -> None:
    first = opened(image_folder(tmp_path / "a"))
    again = opened(image_folder(tmp_path / "b"), start=2)
    assert first.identity == again.identity
    assert len(first.identity) == 64
    write_calibration(tmp_path / "b", fx=CALIBRATION["fx"] + 1e-6)
    changed = opened(tmp_path / "b").identity
    assert changed != first.identity
    (tmp_path / "a" / "left" / "000005.png").unlink()
    assert opened(tmp_path / "a").identity != first.identity
