"""Folders of images: our own layout, and any two folders or names with a side."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from dataset_builders import (
    CALIBRATION,
    HEIGHT,
    WIDTH,
    codes,
    curve,
    image_folder,
    loose,
    opened_loose,
    picture,
    save,
    write_calibration,
    write_tum,
)

from fgslam.cameras.calib_json import raw_values
from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rig import read_calibration_file
from fgslam.cameras.write_formats import write_calibration as write_file
from fgslam.core.errors import CalibrationError, DatasetError, FgslamError, FrameError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, pose, right_from_left_camera
from fgslam.core.log import ImageSequence
from fgslam.core.sensors import body_is_camera
from fgslam.core.sides import camera_pairs, is_view
from fgslam.datasets.images import read_grey_image
from fgslam.datasets.layouts import find_cameras, recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import ImageFolderSettings, KittiRawSettings
from fgslam.datasets.times import pair_files, written_stamps
from fgslam.runs.bare import bare_experiment

# --------------------------------------------------------------------------------------------
# Image folder


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
    (root / "top").rename(root / "third")
    two = opened(root)
    assert corners(two, 1) == [11, 61]
    assert two.rig.cameras == 2


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
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
    assert_one_line(str(beyond.value), "start is 6", "0 to 5", "choose less")
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


def test_truth_in_nanoseconds_is_that_in_seconds(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    write_tum(root / "gt_left_cam.txt", 0.1 * np.arange(6), curve(6))
    expected = opened(root).ground_truth
    write_tum(root / "gt_left_cam.txt", 1e8 * np.arange(6), curve(6))
    recording = opened(root)
    assert expected is not None
    assert recording.ground_truth is not None
    np.testing.assert_allclose(recording.ground_truth.timestamps, expected.timestamps, atol=1e-9)
    np.testing.assert_allclose(recording.ground_truth.poses, expected.poses, atol=1e-12)
    assert "are read as nanoseconds" in recording.notes[-1]


def test_truth_with_commas_and_names_of_columns_is_read(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    rows = [f"{0.1 * k:.1f},0,0,{0.1 * k:.1f},0,0,0,1" for k in range(6)]
    text = "\n".join(["timestamp,x,y,z,qx,qy,qz,qw", *rows])
    (root / "groundtruth.txt").write_text(text, encoding="utf-8")
    truth = opened(root).ground_truth
    assert truth is not None
    assert truth.frame == "right"
    np.testing.assert_allclose(truth.poses[5, :3, 3], [0.2, 0.0, 0.5], rtol=0.0, atol=1e-9)
    (root / "groundtruth.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 6, encoding="utf-8")
    with pytest.raises(DatasetError, match="12 numbers are poses without times, as KITTI's; write"):
        opened(root)


def test_truth_of_another_clock_is_refused_with_both_spans(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    stamps = 1305031102.17 + 0.1 * np.arange(6)
    write_tum(root / "gt_right_cam.txt", stamps, curve(6))
    with pytest.raises(DatasetError) as refused:
        opened(root)
    spans = ("1305031102.170 to 1305031102.670 s", "the recording from 0.000 to 0.500 s")
    assert_one_line(str(refused.value), "gt_right_cam.txt", *spans, "move the file elsewhere")
    (root / "gt_right_cam.txt").rename(tmp_path / "kept.txt")  # as the message says
    assert opened(root).ground_truth is None


def test_frames_before_the_truth_begins_are_no_other_clock(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    write_tum(root / "gt_right_cam.txt", 0.1 * np.arange(3, 6), curve(3))
    truth = opened(root, stop=2).ground_truth
    assert truth is not None
    assert len(truth) == 0


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


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (truncate, ["truncated", "copy the file again"]),
        (flip_bit, ["damaged", "copy the file again"]),
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
    (empty_camera, DatasetError, ["left", "restore them"]),
    (no_common_frame, DatasetError, ["not one of 6 frames", "2 cameras", "check"]),
    (two_images_of_a_frame, DatasetError, ["left", "two of 3", "remove"]),
    (times(""), DatasetError, ["no frame at all", "check"]),
    (times("0 0.0\n1 0.1\n2 0.1\n"), DatasetError, ["times.txt, line 3", "0.100000", "line 2"]),
    (times("0 0.0\n1\n"), DatasetError, ["line 2", "1 columns, expected 2", "complete"]),
    (times("0 0.0\n1 soon\n"), DatasetError, ["line 2", "'soon'", "not a number"]),
    (times("0 0.0\n0 1.0\n"), DatasetError, ["line 2", "image number 0", "twice"]),
    (times("0 0.0\n1e300 1.0\n"), DatasetError, ["line 2", "1e+300 is not a whole number"]),
    (calibrated(fx=float("nan")), CalibrationError, ["calib.json", "fx is nan", "correct"]),
    (calibrated(baseline_m=0.0), CalibrationError, ["baseline_m is 0", "positive"]),
    (calibrated(baseline_m=-0.2), CalibrationError, ["baseline_m is -0.2", "swap the folders"]),
    (calibrated(width=32.5), CalibrationError, ["width is 32.5", "whole number"]),
    (calibrated(width=64), CalibrationError, ["32x24", "64x24", "scale"]),
    (calibrated(bTc=[[1, 0], [0, 1]]), CalibrationError, ["bTc", "rigid 4x4"]),
    (calibrated(rectified=False), CalibrationError, ["not rectified", "rectify them"]),
    (without_key, CalibrationError, ["no 'height'", "add it"]),
    (
        renamed_key('"baseline_m"', '"baseline"'),
        CalibrationError,
        ["no 'baseline_m'", "if 'baseline' means it, rename it", "metres"],
    ),
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
    (root / "top").rename(root / "third")
    assert opened(root).rig.cameras == 2


def test_calibrated_top_camera_without_images_is_noted(tmp_path: Path) -> None:
    root = image_folder(tmp_path, top=True)
    (root / "top").rename(root / "Top")
    assert opened(root).rig.cameras == 2
    assert "no top/: read as two cameras" in opened(root).notes[0]


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


# --------------------------------------------------------------------------------------------
# Loose images


STAMP = 1_403_715_273_262_142_976


NAMES: dict[str, Callable[[int], tuple[str, str]]] = {
    "left, right": lambda k: (f"left/{k}.png", f"right/{k}.png"),
    "cam0/data, cam1/data": lambda k: (f"cam0/data/{k}.png", f"cam1/data/{k}.png"),
    "side in both": lambda k: (f"left/left_{k}.png", f"right/right_{k}.png"),
    "side behind": lambda k: (f"{k}_left.png", f"{k}_right.png"),
    "cam0, cam1 in one": lambda k: (f"cam0_{k}.png", f"cam1_{k}.png"),
    "WebP, capitals": lambda k: (f"Left Camera/im {k}.WEBP", f"Right Camera/im {k}.WEBP"),
    "the same numbers": lambda k: (f"left/a{k}.png", f"right/b{k}.png"),
    "other names": lambda k: (f"left/a{k}.png", f"right/b{k + 1}.png"),
}


# --------------------------------------------------------------------------------------------
# Names and pairs


@pytest.mark.parametrize("name", NAMES)
def test_any_names_in_natural_order(tmp_path: Path, name: str) -> None:
    root = loose(tmp_path / "walk", NAMES[name], [2, 9, 10, 100])
    assert recognise_layout(root) == {"kind": "loose_images", "path": str(root)}
    recording = opened_loose(root)
    assert codes(recording) == [(10, 60), (11, 61), (12, 62), (13, 63)]
    by_order = name == "other names"
    assert any("paired by their order" in note for note in recording.notes) == by_order


def test_a_pattern_of_files(tmp_path: Path) -> None:
    root = loose(tmp_path, lambda k: (f"{k}_left.png", f"{k}_right.png"), [1, 2, 30])
    assert len(opened_loose(root / "?_*.png")) == 2
    assert "2 frames at 10 Hz" in bare_experiment(root / "?_*.png").description


def test_what_has_no_partner_is_counted_or_refused(tmp_path: Path) -> None:
    root = loose(tmp_path, NAMES["left, right"], [1, 2, 3, 4])
    (root / "left" / "2.png").unlink()
    recording = opened_loose(root)
    assert codes(recording) == [(10, 60), (12, 62), (13, 63)]
    assert "1 right images have no partner of their name" in recording.notes[0]
    for k in (1, 3, 4):
        (root / "left" / f"{k}.png").rename(root / "left" / f"a{k}.png")
    with pytest.raises(DatasetError, match="3 images of the left camera and 4 of the right one, a"):
        opened_loose(root)


def test_words_that_hold_another_are_none() -> None:
    views = ("theatre_left", "overflow_R", "display_0", "unmasked", "image_02")
    others = ("heat_map", "left_mask", "depth01", "flow_0", "disp_occ_1", "labels", "semantics")
    assert all(map(is_view, views))
    assert not any(map(is_view, others))


def test_words_that_hold_a_side_are_none() -> None:
    assert camera_pairs(["bright", "bleft"]) == ()
    assert camera_pairs(["camera_left", "camera_right", "imu"]) == (
        ("camera_left", "camera_right"),
    )
    assert camera_pairs(["frontleft", "frontright", "back", "upleft"]) == (
        ("frontleft", "frontright"),
    )
    assert camera_pairs(["0001.png", "0002.png"], any_number=False) == ()


# --------------------------------------------------------------------------------------------
# Times


LISTS: dict[str, tuple[str, list[str], str]] = {
    "seconds": ("times.txt", ["0.0", "0.2", "0.4"], ""),
    "name and time": ("times.txt", ["3 0.4", "1 0.0", "2 0.2"], ""),
    "number, time and file": (
        "right_images.txt",
        ["# id timestamp image_name", *(f"{k} 9.{2 * k} right/{k + 1}.png" for k in range(3))],
        "",
    ),
    "file, time and exposure": ("times.txt", [f"{k} 5.{2 * k} 7" for k in (1, 2, 3)], ""),
    "nanoseconds": ("timestamps.txt", [str(STAMP + k * 200_000_000) for k in range(3)], "nano"),
    "dates": ("timestamps.txt", [f"2011-09-26 13:02:25.{k}00000001" for k in (1, 3, 5)], ""),
}


@pytest.mark.parametrize("name", LISTS)
def test_lists_of_times(tmp_path: Path, name: str) -> None:
    file, lines, unit = LISTS[name]
    root = loose(tmp_path, NAMES["left, right"], [1, 2, 3])
    (root / file).write_text("\n".join(lines), encoding="utf-8")
    recording = opened_loose(root)
    steps = recording.timestamps - recording.timestamps[0]
    assert np.allclose(steps, [0.0, 0.2, 0.4], rtol=0.0, atol=1e-6)
    assert any(f"taken as {unit}" in note for note in recording.notes) == bool(unit)


def test_times_by_place_count_images_without_a_partner(tmp_path: Path) -> None:
    """A list of one time a line is of all images of the right camera, and so is a rate."""
    root = loose(tmp_path, NAMES["left, right"], [0, 1, 2, 3])
    (root / "left" / "1.png").unlink()
    np.testing.assert_allclose(opened_loose(root, fps=10.0).timestamps, [0.0, 0.2, 0.3])
    (root / "times.txt").write_text("5.0\n5.5\n6.0\n7.0", encoding="utf-8")
    np.testing.assert_allclose(opened_loose(root).timestamps, [5.0, 6.0, 7.0])
    (root / "times.txt").write_text("5.0\n6.0\n7.0", encoding="utf-8")
    with pytest.raises(DatasetError, match="has 3 times for 4 images"):
        opened_loose(root)


def test_names_that_are_times_and_no_times_at_all(tmp_path: Path) -> None:
    numbers = [STAMP + k * 50_000_000 for k in range(3)]
    named = opened_loose(loose(tmp_path / "a", NAMES["left, right"], numbers))
    assert np.allclose(np.diff(named.timestamps), 0.05, rtol=0.0, atol=1e-6)
    root = loose(tmp_path / "b", NAMES["left, right"], [1, 2, 3])
    assert "no list of times: taken as 10 frames a second" in opened_loose(root).notes[0]
    assert np.allclose(
        opened_loose(root, fps=25.0).timestamps, [0.0, 0.04, 0.08], rtol=0.0, atol=1e-12
    )


MINUTE = datetime(2026, 11, 23, 23, 59, 59, 900_000, UTC)  # frames 2 to 5 are of the next day


def named(k: int, form: str, places: int = 3) -> str:
    moment = MINUTE + timedelta(milliseconds=50 * k)
    return moment.strftime(form).replace("#", f"{moment.microsecond:06d}"[:places])


@pytest.mark.parametrize(
    ("form", "places"),
    [
        ("%Y-%m-%dT%H-%M-%S.#Z_{}", 3),
        ("%Y%m%d_%H%M%S_#_{}", 6),
        ("2026-11-23-23-10-50_%Y-%m-%d-%H-%M-%S-#_{}", 3),
    ],
)
def test_names_that_are_dates(tmp_path: Path, form: str, places: int) -> None:
    left, right = (form.replace("{}", side) + ".png" for side in ("left", "right"))
    root = loose(tmp_path, lambda k: (named(k, left, places), named(k, right, places)), [*range(6)])
    recording = opened_loose(root)
    expected = MINUTE.timestamp() + 0.05 * np.arange(6)
    np.testing.assert_allclose(recording.timestamps, expected, rtol=0.0, atol=1e-6)
    assert "times are the dates in the names of the images" in recording.notes


def late(k: int, form: str, by_ms: int) -> str:
    moment = MINUTE + timedelta(milliseconds=50 * k + by_ms)
    return f"{form}/{moment:%Y%m%d_%H%M%S}_{moment.microsecond:06d}.png"


def test_names_that_are_times_pair_by_them(tmp_path: Path) -> None:
    """Each camera is started by itself, and has lost another image: by order none would fit."""
    root = loose(tmp_path, lambda k: (late(k, "left", 0), late(k, "right", 3)), [*range(7)])
    (root / late(2, "left", 0)).unlink()
    (root / late(4, "right", 3)).unlink()
    recording = opened_loose(root)
    assert codes(recording) == [(10 + k, 60 + k) for k in (0, 1, 3, 5, 6)]
    assert "1 right images have no partner within 20 ms and are left out" in recording.notes
    assert any("differ in time by 3 ms in the median" in note for note in recording.notes)


@pytest.mark.parametrize(
    "form", ["20261123_235959_{k:06d}_{{}}", "20261399_235959_{k}_{{}}", "20261123_235959_{{}}_{k}"]
)
def test_dates_that_are_no_times_of_images(tmp_path: Path, form: str) -> None:
    """A counter behind one date; no date; the camera between both."""
    name = lambda k: form.format(k=k) + ".png"  # noqa: E731 - one line
    root = loose(tmp_path, lambda k: (name(k).format("l"), name(k).format("r")), [*range(5)])
    recording = opened_loose(root)
    np.testing.assert_allclose(np.diff(recording.timestamps), 0.1, rtol=0.0, atol=1e-9)
    assert any("no list of times" in note for note in recording.notes)


def paired(root: Path, lefts: list[str], rights: list[str], **options: Any) -> list[list[str]]:
    """Names (left, right) of the pairs of empty files, and the notes."""
    for folder, names in (("left", lefts), ("right", rights)):
        (root / folder).mkdir(parents=True)
        for name in names:
            (root / folder / f"{name}.png").touch()
    found = find_cameras(root)
    assert found is not None
    pairs, notes, _ = pair_files(found, **options)
    return [[left.stem, right.stem] for right, left in pairs] + [list(notes)]


def test_what_is_behind_an_underscore_is_a_fraction(tmp_path: Path) -> None:
    """At 1 Hz the seconds alone would pair images 940 ms apart."""
    rights = [f"{1_700_000_001 + k}_010000" for k in range(4)]
    lefts = [f"{1_700_000_000 + k}_995000" for k in range(4)]
    assert paired(tmp_path, lefts, rights)[:-1] == [
        list(p) for p in zip(lefts, rights, strict=True)
    ]


def test_clocks_of_their_own_are_paired_by_their_constant_offset(tmp_path: Path) -> None:
    """Names by str(time.time()): .98 lies before .1234567 of the next, not by its digits."""
    rights = ["1700000001.1234567", "1700000001.98", "1700000002.5"]
    lefts = ["1700007001.1234", "1700007001.98", "1700007002.5"]
    *pairs, notes = paired(tmp_path, lefts, rights)
    assert pairs == [list(pair) for pair in zip(lefts, rights, strict=True)]
    assert any("7000 s ahead of" in note for note in notes)


def test_a_board_at_rest_is_paired_without_times(tmp_path: Path) -> None:
    lefts = [f"20230101_1200{s}_{ms}" for s, ms in ((10, 100), (14, 900), (19, 300))]
    rights = [f"20230101_1200{s}_{ms}" for s, ms in ((10, 800), (15, 310), (19, 305))]
    expected = [list(pair) for pair in zip(lefts, rights, strict=True)]
    assert paired(tmp_path / "a", lefts, rights, at_once=False)[:-1] == expected
    assert len(paired(tmp_path / "b", lefts, rights)) == 2, "of those in motion one pair is near"


@pytest.mark.parametrize(
    "names",
    [
        [f"20230101_120000_{k:02d}" for k in range(30)],
        [f"20230101_{k:06d}" for k in range(40)],
        [f"1700000000_{k:06d}" for k in range(40)],
    ],
)
def test_counters_are_no_times(names: list[str]) -> None:
    assert written_stamps([Path(f"{name}.png") for name in names], ()) is None


def test_times_that_look_like_counters_are_times() -> None:
    """Images every second at noon, and many whose milliseconds take nearly all values."""
    noon = [Path(f"20230101_1200{k:02d}.png") for k in range(40)]
    milliseconds = np.cumsum(np.full(900, 37))
    dense = [Path(f"{1_700_000_000 + t // 1000}_{t % 1000:03d}.png") for t in milliseconds]
    for files, step in ((noon, 1.0), (dense, 0.037)):
        written = written_stamps(files, ())
        assert written is not None
        np.testing.assert_allclose(np.diff(written[0]), step, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["0.0", "0.1"], "has 2 times for 3 images"),
        (["0.0", "x", "0.2"], "line 2: 'x' is no time"),
        (["0.0", "0.2", "0.2"], "the time of image 3 does not come after that of image 2"),
        (["1 0.0", "2 0.1", "7 0.2"], "neither column names all images"),
    ],
)
def test_bad_lists_of_times(tmp_path: Path, lines: list[str], message: str) -> None:
    root = loose(tmp_path, NAMES["left, right"], [1, 2, 3])
    (root / "times.txt").write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(DatasetError, match=message) as caught:
        opened_loose(root)
    assert "\n" not in str(caught.value)


# --------------------------------------------------------------------------------------------
# Pictures


def test_a_phone_that_was_turned_is_turned_back(tmp_path: Path) -> None:
    """EXIF orientation 6: the camera was turned to the right, the picture is stored lying."""
    root = loose(tmp_path, NAMES["left, right"], [1])
    upright = cv2.resize(picture(3)[:6, :8], (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    stored = cv2.rotate(upright, cv2.ROTATE_90_COUNTERCLOCKWISE)
    for side in ("left", "right"):
        (root / side / "1.png").unlink()
        (root / side / "1.jpg").write_bytes(turned_jpeg(stored, 6))
    shown = opened_loose(root).frame(0).images[0]
    assert np.abs(shown.astype(int) - upright).max() < 12


def turned_jpeg(image: np.ndarray, orientation: int) -> bytes:
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]


def test_a_calibration_of_another_size_and_none(tmp_path: Path) -> None:
    root = loose(tmp_path, NAMES["left, right"], [1])
    write_calibration(root, width=64, height=48)
    with pytest.raises(CalibrationError, match="for images of 64x48 pixels, the images have 32x24"):
        opened_loose(root)
    (root / "calib.json").unlink()
    with pytest.raises(
        CalibrationError, match=r"give a calibration: .*calib\.json.* --camera FILE"
    ):
        opened_loose(root)


def test_odometry_beside_the_images(tmp_path: Path) -> None:
    root = loose(tmp_path, NAMES["left, right"], [1, 2, 3])
    poses = np.stack([pose(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(3)])
    write_tum(root / "odometry.txt", 0.1 * np.arange(3), poses)
    step = opened_loose(root).odometry(1)
    assert step is not None
    assert step.motion[0, 3] == pytest.approx(0.1, abs=1e-9)


def test_a_camera_that_nothing_places_looks_along_the_wheels_way(tmp_path: Path) -> None:
    root = loose(tmp_path, NAMES["left, right"], [1, 2, 3])
    (root / "odom.csv").write_text("0.0, 1.0, 0.0\n0.3, 1.0, 0.0\n", encoding="utf-8")
    camera = tmp_path / "kalibr.yaml"  # of the cameras alone, no robot's
    write_file(read_calibration_file(root / "calib.json"), camera)
    recording = opened_loose(root, camera_file=str(camera))
    np.testing.assert_array_equal(recording.rig.bTc, BODY_FORWARD_LEFT_UP_FROM_CAMERA)
    assert "taken to look straight ahead from there" in recording.notes[0]
    turned = opened_loose(root, camera_file=str(camera), camera_yaw_deg=90.0)
    np.testing.assert_allclose(turned.rig.bTc[:3, 2], [0.0, 1.0, 0.0], atol=1e-12)
    assert not any("straight ahead" in note for note in turned.notes)
    (root / "odom.csv").rename(root / "imu.csv")  # whose axes are the camera's
    alone = opened_loose(root, camera_file=str(camera))
    assert body_is_camera(alone.rig.bTc)
    assert not any("straight ahead" in note for note in alone.notes)


# --------------------------------------------------------------------------------------------
# KITTI raw


def kitti_raw(root: Path, cameras: tuple[str, str] = ("00", "01")) -> Path:
    """A drive of three frames, 0.1 s apart; baseline 0.4 m at fx 30."""
    drive = root / "2011_09_26" / "2011_09_26_drive_0001_sync"
    for number, code in zip(cameras, (60, 10), strict=True):
        folder = drive / f"image_{number}"
        for k in range(3):
            save(folder / "data" / f"{k:010d}.png", picture(code + k))
        times = "".join(f"2011-09-26 13:02:25.{k}00000000\n" for k in range(3))
        (folder / "timestamps.txt").write_text(times, encoding="utf-8")
    focal, row = CALIBRATION["fx"], "0 0 0 1 0"
    lines = ["calib_time: 09-Jan-2012 13:57:47"]
    for number, shift in zip(cameras, (0.0, -12.0), strict=True):
        lines.append(f"S_rect_{number}: {WIDTH:.6e} {HEIGHT:.6e}")
        lines.append(f"P_rect_{number}: {focal} 0 15.5 {shift} 0 {focal} 11.5 {row}")
    (drive.parent / "calib_cam_to_cam.txt").write_text("\n".join(lines), encoding="utf-8")
    return drive


@pytest.mark.parametrize("cameras", [("00", "01"), ("02", "03")])
def test_a_drive_of_kitti_raw(tmp_path: Path, cameras: tuple[str, str]) -> None:
    drive = kitti_raw(tmp_path, cameras)
    for given in (drive, drive.parent):
        assert recognise_layout(given) == {"kind": "kitti_raw", "path": str(given)}
        recording = open_recording(KittiRawSettings(path=str(given)))
        assert recording.rig.baseline == pytest.approx(0.4, abs=1e-12)
        assert codes(recording) == [(10, 60), (11, 61), (12, 62)]
        assert np.allclose(np.diff(recording.timestamps), 0.1, rtol=0.0, atol=1e-6)
    assert recording.name == "2011_09_26_drive_0001_sync"


def test_kitti_raw_that_lacks_a_left_image(tmp_path: Path) -> None:
    drive = kitti_raw(tmp_path)
    next((drive / "image_00" / "data").glob("*1.png")).unlink()
    recording = open_recording(KittiRawSettings(path=str(drive)))
    assert np.allclose(np.diff(recording.timestamps), 0.2, rtol=0.0, atol=1e-6)


def test_kitti_raw_that_lacks_a_part(tmp_path: Path) -> None:
    drive = kitti_raw(tmp_path)
    (drive.parent / "calib_cam_to_cam.txt").rename(drive.parent / "elsewhere.txt")
    with pytest.raises(CalibrationError, match=r"no calib_cam_to_cam\.txt in it or next to it"):
        open_recording(KittiRawSettings(path=str(drive)))
    (drive / "image_01").rename(drive / "image_07")
    with pytest.raises(DatasetError, match="has no two cameras' images"):
        open_recording(KittiRawSettings(path=str(drive)))


def test_one_folder_may_number_the_cameras_last(tmp_path: Path) -> None:
    """As Basalt and Kalibr's targets are stored: moment, then camera; not frames that go on."""
    for k in (0, 2, 10):
        for camera in (0, 1):
            save(tmp_path / f"{k}_{camera}.png", picture(10 * k + camera))
    found = find_cameras(tmp_path)
    assert found is not None
    pairs, notes, _ = pair_files(found)
    names = [(left.name, right.name) for right, left in pairs]
    assert names == [("0_0.png", "0_1.png"), ("2_0.png", "2_1.png"), ("10_0.png", "10_1.png")]
    assert notes == ()
    save(tmp_path / "10_2.png", picture(1))
    assert find_cameras(tmp_path) is None, "three numbers: these count something else"


def test_frames_of_one_camera_are_no_pairs(tmp_path: Path) -> None:
    for k in range(4):
        save(tmp_path / f"frame_{k}.png", picture(k))
    assert find_cameras(tmp_path) is None


# --------------------------------------------------------------------------------------------
# Which camera of the calibration is which


def write_chain(root: Path, *places: tuple[float, float]) -> None:
    """A camchain of cameras at (x, y) metres, all alike."""
    chain = {}
    for k, at in enumerate(places):
        values = {
            "camera_model": "pinhole",
            "intrinsics": [40.0, 40.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2],
            "distortion_model": "radtan",
            "distortion_coeffs": [0.0] * 4,
            "resolution": [WIDTH, HEIGHT],
        }
        if k:
            before = np.subtract(places[k - 1], at)
            values["T_cn_cnm1"] = pose(np.eye(3), np.array([*before, 0.0])).tolist()
        chain[f"cam{k}"] = values
    (root / "camchain.yaml").write_text(yaml.safe_dump(chain))


@pytest.mark.parametrize(
    ("places", "baseline"),
    [
        (((0.0, 0.0), (0.1, 0.0), (0.2, 0.0)), 0.1),  # in a line: not the outer two
        (((0.0, 0.0), (0.1, 0.0), (0.0, 0.2)), 0.1),  # in an L
    ],
)
def test_images_of_two_cameras_are_of_the_first_two_of_three(
    tmp_path: Path, places: tuple[tuple[float, float], ...], baseline: float
) -> None:
    root = loose(tmp_path / "walk", NAMES["cam0, cam1 in one"], [0, 1])
    (root / "calib.json").unlink()
    write_chain(root, *places)
    recording = opened_loose(root)
    assert recording.rig.baseline == pytest.approx(baseline)
    assert recording.rig.vertical_baseline is None
    assert codes(recording) == [(10, 60), (11, 61)]
    assert "the first two are taken" in " ".join(recording.notes)


@pytest.mark.parametrize(
    ("name", "expected"), [("cam0/data, cam1/data", (60, 10)), ("left, right", (10, 60))]
)
def test_numbered_images_are_those_of_the_numbered_cameras(
    tmp_path: Path, name: str, expected: tuple[int, int]
) -> None:
    """Camera 0 is the right one by its calibration; what is called right stays right."""
    root = loose(tmp_path / "walk", NAMES[name], [0])
    (root / "calib.json").unlink()
    write_chain(root, (0.1, 0.0), (0.0, 0.0))
    recording = opened_loose(root)
    assert codes(recording) == [expected]
    assert ("lower number is the right one" in " ".join(recording.notes)) == (expected[0] == 60)
