"""Folders of images with any names; drives of KITTI raw."""

from __future__ import annotations

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
    loose,
    opened_loose,
    picture,
    save,
    write_calibration,
    write_tum,
)

from fgslam.cameras.rig import read_calibration_file
from fgslam.cameras.write_formats import write_calibration as write_file
from fgslam.core.errors import CalibrationError, DatasetError, FrameError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, pose
from fgslam.core.sensors import body_is_camera
from fgslam.core.sides import camera_pairs, is_view
from fgslam.datasets.layouts import find_cameras, recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import (
    KittiRawSettings,
)
from fgslam.datasets.times import pair_files, written_stamps
from fgslam.runs.bare import bare_experiment

STAMP = 1_403_715_273_262_142_976
NAMES: dict[str, Callable[[int], tuple[str, str]]] = {
    "left, right": lambda k: (f"left/{k}.png", f"right/{k}.png"),
    "L, R": lambda k: (f"L/img{k}.png", f"R/img{k}.png"),
    "image_0, image_1": lambda k: (f"image_0/{k:04d}.png", f"image_1/{k:04d}.png"),
    "cam0/data, cam1/data": lambda k: (f"cam0/data/{k}.png", f"cam1/data/{k}.png"),
    "side in both": lambda k: (f"left/left_{k}.png", f"right/right_{k}.png"),
    "side behind": lambda k: (f"{k}_left.png", f"{k}_right.png"),
    "side before": lambda k: (f"left{k}.png", f"right{k}.png"),
    "letters": lambda k: (f"frame{k}-L.png", f"frame{k}-R.png"),
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
    assert "2 frames at 10 Hz" in bare_experiment(root / "?_*.png").said


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
    "time and file": ("times.csv", ["time,file", "5.0,1.png", "5.2,2.png", "5.4,right/3.png"], ""),
    "number, time and file": (
        "right_images.txt",
        ["# id timestamp image_name", *(f"{k} 9.{2 * k} right/{k + 1}.png" for k in range(3))],
        "",
    ),
    "file, time and exposure": ("times.txt", [f"{k} 5.{2 * k} 7" for k in (1, 2, 3)], ""),
    "nanoseconds": ("timestamps.txt", [str(STAMP + k * 200_000_000) for k in range(3)], "nano"),
    "milliseconds": ("times.txt", ["0", "200", "400"], "milli"),
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
        ("{}_%Y%m%d%H%M%S#", 3),
        ("IMG_{}_%Y-%m-%d %H.%M.%S,#", 2),
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
    pairs, notes = pair_files(found, **options)
    return [[left.stem, right.stem] for right, left in pairs] + [list(notes)]


def test_what_is_behind_an_underscore_is_a_fraction(tmp_path: Path) -> None:
    """At 1 Hz the seconds alone would pair images 940 ms apart."""
    rights = [f"{1_700_000_001 + k}_010000" for k in range(4)]
    lefts = [f"{1_700_000_000 + k}_995000" for k in range(4)]
    assert paired(tmp_path, lefts, rights)[:-1] == [
        list(p) for p in zip(lefts, rights, strict=True)
    ]


def test_clocks_of_their_own_go_by_order(tmp_path: Path) -> None:
    """Names by str(time.time()): .98 lies before .1234567 of the next, not by its digits."""
    rights = ["1700000001.1234567", "1700000001.98", "1700000002.5"]
    lefts = ["1700007001.1234", "1700007001.98", "1700007002.5"]
    *pairs, notes = paired(tmp_path, lefts, rights)
    assert pairs == [list(pair) for pair in zip(lefts, rights, strict=True)]
    assert "paired by their order: the times that their names are lie 7000 s apart" in notes[0]


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
        [f"20230101_120000_{k:04d}" for k in range(30)],
        [f"20230101_{k:06d}" for k in range(40)],
        [f"{k:010d}" for k in range(40)],
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


def test_colour_16_bits_and_grey_are_the_same_picture(tmp_path: Path) -> None:
    root = loose(tmp_path, NAMES["left, right"], [1, 2, 3])
    image = picture(11)
    save(root / "right" / "2.png", np.dstack([image, image, image]))
    save(root / "right" / "3.png", image.astype(np.uint16) << 8)
    recording = opened_loose(root)
    for i in (1, 2):
        assert np.array_equal(recording.frame(i).images[0], image)


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


def test_a_damaged_image_is_one_lost_frame(tmp_path: Path) -> None:
    root = loose(tmp_path, NAMES["left, right"], [1, 2, 3])
    file = root / "left" / "2.png"
    file.write_bytes(file.read_bytes()[:-30])
    recording = opened_loose(root)
    with pytest.raises(FrameError, match=r"2\.png is truncated"):
        recording.frame(1)
    assert recording.frame(2).images[1][0, 0] == 62


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
    pairs, notes = pair_files(found)
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
