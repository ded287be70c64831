"""Stereo films, really encoded: both views in one film, or a film of each camera."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import textured_wall
from dataset_builders import write_calibration

import fgslam as fg
from fgslam.cameras.calib_json import raw_values
from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.settings import EquirectangularSettings
from fgslam.core.arrays import Image
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.geometry import pose
from fgslam.core.sides import camera_pairs, camera_trio
from fgslam.datasets.layouts import recognise_layout
from fgslam.datasets.opening import open_omni, open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import OmniVideoSettings, VideoSettings
from fgslam.datasets.video import VideoFrames
from fgslam.runs.bare import bare_experiment

SIZE = (64, 48)
_NEAR = 3  # grey levels that the codec may change in even areas


def view(level: int, size: tuple[int, int] = SIZE) -> Image:
    return np.full((size[1], size[0]), level, np.uint8)


def film(path: Path, frames: list[Image], rate: float = 20.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    code = "MJPG" if path.suffix == ".avi" else "mp4v"
    size = (frames[0].shape[1], frames[0].shape[0])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), rate, size)
    for image in frames:
        writer.write(np.dstack([image, image, image]))
    writer.release()
    return path


def turned_by_180(path: Path) -> Path:
    """States in the film's track header that frames are to be shown upside down (tkhd's matrix)."""
    data = bytearray(path.read_bytes())
    at = data.find(b"tkhd") + 4 + 4 + 20 + 16  # version and flags, times and numbers of version 0
    for place in (at, at + 16):
        data[place : place + 4] = (-(1 << 16)).to_bytes(4, "big", signed=True)
    path.write_bytes(data)
    return path


def stereo_frames(join: Callable[[list[Image]], Image], count: int = 6) -> list[Image]:
    """Left views of 40, 50, ... and right ones of 140, 150, ..."""
    return [join([view(40 + 10 * k), view(140 + 10 * k)]) for k in range(count)]


def calibrated(root: Path) -> None:
    root.mkdir(exist_ok=True, parents=True)
    write_calibration(root, width=SIZE[0], height=SIZE[1], cx=31.5, cy=23.5)


def opened(path: Path, **settings: Any) -> Recording:
    return open_recording(VideoSettings(path=str(path), **settings))


def levels(recording: Recording, i: int) -> np.ndarray:
    return np.array([np.median(image) for image in recording.frame(i).images])


def uneven(path: Path, lengths: list[int]) -> None:
    """Gives every frame its own length: the film's table of them (stts) is in its last box."""
    data = bytearray(path.read_bytes())
    at = data.find(b"stts") - 4
    old = int.from_bytes(data[at : at + 4], "big")
    entries = b"".join((1).to_bytes(4, "big") + n.to_bytes(4, "big") for n in lengths)
    new = (16 + len(entries)).to_bytes(4, "big") + b"stts" + bytes(4)
    new += len(lengths).to_bytes(4, "big") + entries
    data[at : at + old] = new
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        box = data.find(name) - 4
        size = int.from_bytes(data[box : box + 4], "big") + len(new) - old
        data[box : box + 4] = size.to_bytes(4, "big")
    path.write_bytes(data)


def test_frames_of_a_phone_have_their_own_times(tmp_path: Path) -> None:
    """Of 20 frames a second by their mean, as long as the light needs; --fps says otherwise."""
    calibrated(tmp_path)
    path = film(tmp_path / "walk.mp4", stereo_frames(np.hstack))
    even = opened(path)
    np.testing.assert_allclose(np.diff(even.timestamps), 0.05, rtol=0.0, atol=1e-9)
    assert not any("apart" in note for note in even.notes)
    uneven(path, [256, 768, 256, 1024, 256, 512])  # 512 are 50 ms
    recording = opened(path)
    expected = [0.0, 0.025, 0.1, 0.125, 0.225, 0.25]
    np.testing.assert_allclose(recording.timestamps, expected, rtol=0.0, atol=1e-6)
    assert "frames are 25 to 100 ms apart: each has its own time" in recording.notes
    assert levels(recording, 5).tolist() == pytest.approx([190, 90], abs=_NEAR)
    all_around = open_omni(OmniVideoSettings(path=str(path), camera=EquirectangularSettings()))
    np.testing.assert_allclose(all_around.timestamps, expected, rtol=0.0, atol=1e-6)
    stated = opened(path, fps=10.0)
    np.testing.assert_allclose(np.diff(stated.timestamps), 0.1, rtol=0.0, atol=1e-9)


def test_frames_of_two_films_that_drift_apart_are_paired_by_time(tmp_path: Path) -> None:
    """Of one number up to 20 ms apart, then, with other lengths, up to 75 ms."""
    calibrated(tmp_path)
    for side, level in (("left", 40), ("right", 140)):
        film(tmp_path / f"{side}.mp4", [view(level + 10 * k) for k in range(6)])
    uneven(tmp_path / "right.mp4", [512, 717, 410, 512, 409, 512])
    recording = opened(tmp_path)
    assert "frames of one number differ in time by up to 20 ms in the films" in recording.notes
    assert len(recording) == 6
    uneven(tmp_path / "right.mp4", [256, 256, 256, 1024, 768, 512])
    recording = opened(tmp_path)
    np.testing.assert_allclose(recording.timestamps, [0.0, 0.05, 0.25], rtol=0.0, atol=1e-6)
    assert np.abs(levels(recording, 1) - [160, 50]).max() <= _NEAR
    left_out = "3 {} images have no partner within 20 ms and are left out"
    assert {left_out.format("right"), left_out.format("left")} <= set(recording.notes)


@pytest.mark.parametrize("missed", [False, True])
def test_frames_whose_times_jitter_belong_together_by_number_until_one_is_missed(
    tmp_path: Path, missed: bool
) -> None:
    """Each eighth frame of the right camera is late by 0.7 of a frame; then one is missed."""
    calibrated(tmp_path)
    for side, level in (("left", 20), ("right", 60)):
        film(tmp_path / f"{side}.mp4", [view(level + 2 * k) for k in range(48)])
    late = [358 if k % 8 == 3 else 0 for k in range(49)]  # 512 are 50 ms
    lengths = [512 + late[k + 1] - late[k] for k in range(48)]
    lengths[20] += 512 * missed
    uneven(tmp_path / "right.mp4", lengths)
    recording = opened(tmp_path)
    how = "time" if missed else "number"
    assert f"paired by their {how}:" in " ".join(recording.notes)
    assert len(recording) == (41 if missed else 48)


def test_films_of_other_rates_are_paired_by_time(tmp_path: Path) -> None:
    calibrated(tmp_path)
    film(tmp_path / "left.avi", [view(20 + 4 * k) for k in range(41)], 20.0)
    film(tmp_path / "right.avi", [view(50 + 10 * k) for k in range(17)], 8.0)
    recording = opened(tmp_path)
    np.testing.assert_allclose(recording.timestamps, 0.25 * np.arange(9), rtol=0.0, atol=1e-9)
    assert np.abs(levels(recording, 7) - [190, 160]).max() <= _NEAR
    assert "the left film has 20 frames a second, the right 8" in recording.notes
    assert "32 left images have no partner within 20 ms and are left out" in recording.notes
    assert "paired by their time: both must begin at one time" in " ".join(recording.notes)
    assert len(opened(tmp_path, fps=8.0)) == 17


@pytest.mark.parametrize("ending", [".avi", ".mp4"])
@pytest.mark.parametrize(("name", "join"), [("side by side", np.hstack), ("over under", np.vstack)])
def test_both_views_in_one_film(
    tmp_path: Path, ending: str, name: str, join: Callable[[list[Image]], Image]
) -> None:
    calibrated(tmp_path)
    path = film(tmp_path / f"walk{ending}", stereo_frames(join))
    assert recognise_layout(path)["kind"] == recognise_layout(tmp_path)["kind"] == "video"
    recording = opened(path)
    assert (len(recording), recording.rig.width, recording.rig.height) == (6, *SIZE)
    for i in (0, 5, 2):
        assert np.abs(levels(recording, i) - [140 + 10 * i, 40 + 10 * i]).max() <= _NEAR
    assert np.allclose(np.diff(recording.timestamps), 0.05, rtol=0.0, atol=1e-9)
    assert recording.notes == (f"the film is taken as {name}",)
    assert "walk: film, 2 cameras 64x48; 6 frames at 20 Hz" in bare_experiment(path).description
    assert recording.colour(1)[0].shape == (SIZE[1], SIZE[0], 3)


def test_a_film_of_each_camera(tmp_path: Path) -> None:
    calibrated(tmp_path / "films")
    for name, level, count in (("left", 40, 5), ("right", 140, 4)):
        frames = [view(level + 10 * k) for k in range(count)]
        film(tmp_path / "films" / f"cam_{name}.avi", frames)
    for given in (tmp_path / "films", tmp_path / "films" / "cam_*.avi"):
        recording = opened(given)
        assert len(recording) == 4
        assert np.abs(levels(recording, 2) - [160, 60]).max() <= _NEAR
        assert any("the left film has 5 frames, the right one 4" in n for n in recording.notes)


TRIO = ("left", "right", "top")


def three_films(folder: Path, names: tuple[str, ...], counts: tuple[int, ...] = (4, 4, 4)) -> Path:
    """Grey levels 40, 50, ... of the first camera, from 140 and from 200 on of the others."""
    for name, level, count in zip(names, (40, 140, 200), counts, strict=True):
        film(folder / f"{name}.mp4", [view(level + 10 * k) for k in range(count)])
    return folder


def raw_trio(path: Path, places: list[list[float]], sided: bool) -> Path:
    """Calibration of three cameras at these places (3,), x to the right and y down."""
    matrix = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
    cameras = tuple(
        RawCamera(*SIZE, matrix, np.array([-0.1, 0.0, 0.0, 0.0]), pose(np.eye(3), np.array(place)))
        for place in places
    )
    values = raw_values(Calibration("made", "made", cameras, sided=sided))
    path.write_text(json.dumps(values), encoding="utf-8")
    return path


def test_a_film_of_each_of_three_cameras(tmp_path: Path) -> None:
    write_calibration(
        tmp_path, width=64, height=48, cx=31.5, cy=23.5, fy=30.0, vertical_baseline_m=0.1
    )
    three_films(tmp_path, TRIO, (5, 4, 4))
    assert recognise_layout(tmp_path)["kind"] == "video"
    recording = opened(tmp_path)
    assert (len(recording), recording.rig.cameras) == (4, 3)
    assert np.abs(levels(recording, 2) - [160, 60, 220]).max() <= _NEAR
    assert len(recording.colour(1)) == 3
    notes = " ".join(recording.notes)
    assert "three films are paired by their number: all must begin at one time" in notes
    assert "the left film has 5 frames, the third one 4" in notes
    assert "film, 3 cameras 64x48; 4 frames at 20 Hz" in bare_experiment(tmp_path).description


def test_three_films_are_paired_by_time_where_one_parts_from_the_others(tmp_path: Path) -> None:
    write_calibration(
        tmp_path, width=64, height=48, cx=31.5, cy=23.5, fy=30.0, vertical_baseline_m=0.1
    )
    for name, level in (("left", 20), ("right", 80)):
        film(tmp_path / f"{name}.avi", [view(level + 2 * k) for k in range(20)], 20.0)
    film(tmp_path / "top.avi", [view(140 + 10 * k) for k in range(10)], 10.0)
    recording = opened(tmp_path)
    np.testing.assert_allclose(recording.timestamps, 0.1 * np.arange(10), rtol=0.0, atol=1e-9)
    assert np.abs(levels(recording, 7) - [108, 48, 210]).max() <= _NEAR
    assert "10 right images have no partner within 20 ms and are left out" in recording.notes


@pytest.mark.parametrize(
    ("names", "places", "sided", "expected"),
    [  # the corner of the L is the right camera, then the left and the top one
        (("cam0", "cam1", "cam2"), [[0, 0, 0], [0.2, 0, 0], [0.2, -0.1, 0]], False, [140, 40, 200]),
        (("cam0", "cam1", "cam2"), [[0.2, -0.1, 0], [0.2, 0, 0], [0, 0, 0]], False, [140, 200, 40]),
        (TRIO, [[0.2, -0.1, 0], [0.2, 0, 0], [0, 0, 0]], True, [140, 200, 40]),
        (TRIO, [[0.2, -0.1, 0], [0.2, 0, 0], [0, 0, 0]], False, [140, 40, 200]),
        (("cam0", "cam1", "cam2"), [[0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]], False, [200, 40]),
    ],
)
def test_which_of_three_films_is_of_which_camera(
    tmp_path: Path, names: tuple[str, ...], places: list[list[float]], sided: bool, expected: list
) -> None:
    """Numbers, and files that call their cameras left and right, count in the file's order."""
    three_films(tmp_path / "films", names)
    rig = raw_trio(tmp_path / "rig.json", places, sided)
    recording = opened(tmp_path / "films", camera_file=str(rig))
    assert np.abs(levels(recording, 0) - expected).max() <= _NEAR


def test_three_films_of_a_wall_give_its_distance(tmp_path: Path) -> None:
    rig = textured_wall.RIG
    seen = [textured_wall.pictures(np.array([0.03 * k, 0.0, 0.0])) for k in range(5)]
    for place, name in ((1, "left"), (0, "right"), (2, "top")):
        film(tmp_path / f"{name}.mp4", [images[place] for images in seen])
    write_calibration(
        tmp_path, width=rig.width, height=rig.height, fx=rig.fx, fy=rig.fy, cx=rig.cx, cy=rig.cy,
        baseline_m=rig.baseline, vertical_baseline_m=rig.vertical_baseline,
    )  # fmt: skip
    recording = fg.open_recording(tmp_path)
    slam = fg.Slam(recording.rig, estimator="landmark_kalman")
    for t, images, odometry in recording:
        slam.track(t, images, odometry)
    result = slam.result()
    depths = result.map.positions[:, 2]
    assert len(depths) > 50
    assert abs(float(np.median(depths)) - textured_wall.WALL_M) < 0.03  # an error of 0.2 px
    np.testing.assert_allclose(result.trajectory.poses[-1, :3, 3], [0.12, 0, 0], rtol=0, atol=0.01)


def test_three_films_need_a_calibration_of_three(tmp_path: Path) -> None:
    calibrated(three_films(tmp_path, TRIO))
    with pytest.raises(CalibrationError, match="three cameras, but the calibration knows two; "):
        opened(tmp_path)
    (tmp_path / "top.mp4").rename(tmp_path / "other.mp4")
    with pytest.raises(DatasetError, match="neither one film nor one of a left and one of a right"):
        opened(tmp_path)


@pytest.mark.parametrize(
    "names",
    [
        ("GX010001", "GX010002", "GX010003"),
    ],
)
def test_three_clips_of_one_camera_are_no_three_cameras(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    write_calibration(
        tmp_path, width=64, height=48, cx=31.5, cy=23.5, fy=30.0, vertical_baseline_m=0.1
    )
    three_films(tmp_path, names)
    with pytest.raises(DatasetError, match="neither one film nor one of a left and one of a right"):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("names", "pairs"),
    [
        (("GX010001", "GX010002"), ()),
        (("20240101_120000", "20240101_120001"), ()),
        (("cam0", "cam1"), (("cam0", "cam1"),)),
        (("video_02", "video_03"), (("video_02", "video_03"),)),
        (("cam_0001", "cam_0002"), (("cam_0001", "cam_0002"),)),
    ],
)
def test_counters_of_clips_tell_no_side(
    names: tuple[str, ...], pairs: tuple[tuple[str, str], ...]
) -> None:
    assert camera_pairs(names) == pairs


@pytest.mark.parametrize(
    "names",
    [
        ("left", "right", "top"),
        ("cam0", "cam1", "cam2"),
        ("walk_camera_1", "walk_camera_2", "walk_camera_3"),
    ],
)
def test_three_names_of_sides_or_numbered_cameras_are_a_trio(names: tuple[str, ...]) -> None:
    assert camera_trio(names[::-1]) == names


def test_frames_are_chosen_and_the_rate_is_said(tmp_path: Path) -> None:
    calibrated(tmp_path)
    path = film(tmp_path / "a.avi", stereo_frames(np.hstack))
    recording = opened(path, start=1, stride=2, fps=10.0)
    assert np.allclose(recording.timestamps, [0.1, 0.3, 0.5], rtol=0.0, atol=1e-12)
    assert np.abs(levels(recording, 1) - [170, 70]).max() <= _NEAR


def test_threads_that_ask_ahead_get_their_frames_and_none_is_decoded_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = film(tmp_path / "a.avi", [view(5 * k) for k in range(40)])
    frames = VideoFrames(path)
    opens = []
    capture = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: opens.append(1) or capture(name))
    found: list[float] = []
    with ThreadPoolExecutor(4) as pool:
        for first in range(0, 40, 8):
            asked = reversed(range(first, first + 8))  # all ahead of each other
            found += reversed(list(pool.map(lambda k: float(np.median(frames.load(k))), asked)))
    assert np.abs(np.array(found) - 5.0 * np.arange(40)).max() <= _NEAR
    assert not opens


def test_a_film_that_is_cut_off(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (30, 48, 128), np.uint8)
    path = film(tmp_path / "a.avi", list(noise))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    frames = VideoFrames(path)
    assert 5 < frames.count < 30
    assert frames.load(frames.count - 1).shape == (48, 128, 3)


# --------------------------------------------------------------------------------------------
# Bad input


def test_a_film_of_no_frame_and_what_is_no_film(tmp_path: Path) -> None:
    calibrated(tmp_path)
    empty = tmp_path / "empty.avi"
    cv2.VideoWriter(str(empty), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, SIZE).release()
    for name, content in (("empty.avi", None), ("b.mp4", b"nonsense" * 99), ("c.avi", b"")):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(DatasetError, match=r"holds no frame") as caught:
            opened(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_a_calibration_of_another_size_or_none(tmp_path: Path) -> None:
    path = film(tmp_path / "a.avi", stereo_frames(np.hstack, 2))
    with pytest.raises(CalibrationError, match="another one by --camera FILE"):
        opened(path)
    write_calibration(tmp_path)
    with pytest.raises(CalibrationError, match="images of 32x24 pixels, the images have 64x48"):
        opened(path)


@pytest.mark.parametrize(
    ("join", "kept"), [(np.hstack, "63x46"), (np.vstack, "62x47"), (None, "62x46")]
)
def test_the_row_and_column_that_encoders_leave_out_are_told_and_filled_in(
    tmp_path: Path, join: Callable[[list[Image]], Image] | None, kept: str
) -> None:
    write_calibration(tmp_path, width=63, height=47, cx=31.0, cy=23.0)
    left, right = view(40, (63, 47)), view(140, (63, 47))
    if join is None:
        film(tmp_path / "left.mp4", [left, left])
        film(tmp_path / "right.mp4", [right, right])
    else:
        film(tmp_path / "a.mp4", [join([left, right])] * 2)
    recording = opened(tmp_path)
    assert recording.notes[0].startswith(f"the film's views are {kept}, calibrated for 63x47")
    assert [image.shape for image in recording.frame(1).images] == [(47, 63)] * 2
    assert np.abs(levels(recording, 1) - [140, 40]).max() <= _NEAR
    assert np.ptp(recording.frame(1).images[0]) <= _NEAR
    write_calibration(tmp_path, width=63, height=49, cx=31.0, cy=24.0)  # two rows are no last one
    with pytest.raises(CalibrationError, match=f"images of 63x49 pixels, the images have {kept}"):
        opened(tmp_path)


def test_a_film_as_large_as_one_view_is_of_one_camera(tmp_path: Path) -> None:
    calibrated(tmp_path)
    path = film(tmp_path / "a.avi", [view(40), view(50)])
    with pytest.raises(DatasetError, match=r"a\.avi is 64x48, as large as .* of one camera"):
        opened(path)


def test_a_film_of_a_mirror_goes_to_teach(tmp_path: Path) -> None:
    rows, columns = np.mgrid[:240, :320]
    away = np.hypot(rows - 118, columns - 162)
    waves = 120 + 60 * np.sign(np.sin(9 * np.arctan2(rows - 118, columns - 162)))
    round_picture = np.where(away < 110, waves, 12).astype(np.uint8)
    path = film(tmp_path / "walk.avi", [round_picture] * 3)
    with pytest.raises(DatasetError, match=rf"one mirror .*: fgslam teach {path} --camera FILE"):
        opened(path)


def test_films_that_are_no_pair(tmp_path: Path) -> None:
    for name in ("front", "back"):
        film(tmp_path / f"{name}.avi", [view(1)])
    with pytest.raises(DatasetError, match="neither one film nor one of a left and one of a right"):
        opened(tmp_path)
    with pytest.raises(DatasetError, match=r"film \(lacks one film, or one of a left and one of"):
        recognise_layout(tmp_path)


def test_a_film_that_states_a_rotation_is_shown_so_and_that_is_said(tmp_path: Path) -> None:
    """Two halves one above the other, left camera below: turned, it is above."""
    calibrated(tmp_path)
    over = turned_by_180(film(tmp_path / "walk.mp4", stereo_frames(lambda v: np.vstack(v[::-1]))))
    recording = opened(over)
    assert np.allclose(levels(recording, 0), (140, 40), atol=_NEAR)
    said = "walk.mp4 states that it is to be turned by 180 degrees"
    assert said in recording.notes[0]
    around = OmniVideoSettings(path=str(over), camera=EquirectangularSettings())
    assert said in open_omni(around).notes[0]


def test_images_on_their_side_are_called_so(tmp_path: Path) -> None:
    calibrated(tmp_path)
    for side in ("left", "right"):
        film(tmp_path / f"{side}.mp4", [view(90, SIZE[::-1])] * 2)
    with pytest.raises(CalibrationError, match="64x48 pixels, the images have 48x64: they lie on"):
        opened(tmp_path)
