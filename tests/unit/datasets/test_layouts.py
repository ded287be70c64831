"""Layouts of data sets that people have, by their names of folders and files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bags import stereo, write_bag
from dataset_builders import (
    CALIBRATION,
    HEIGHT,
    WIDTH,
    codes,
    loose,
    opened_loose,
    picture,
    save,
)

from fgslam.core.errors import DatasetError
from fgslam.datasets.layouts import colour_and_depth, recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import (
    BagSettings,
    KittiRawSettings,
    RecordedOdometrySettings,
    RgbdSettings,
)

NAMES: dict[str, Callable[[int], tuple[str, str]]] = {
    "TartanAir": lambda k: (f"image_left/{k:06d}_left.png", f"image_right/{k:06d}_right.png"),
    "TartanAir V2": lambda k: (
        f"image_lcam_front/{k:06d}_lcam_front.png",
        f"image_rcam_front/{k:06d}_rcam_front.png",
    ),
    "letters behind cam": lambda k: (f"camL_{k}.png", f"camR_{k}.png"),
    "infra in one folder": lambda k: (f"infra1_{k}.png", f"infra2_{k}.png"),
    "RealSense's viewer": lambda k: (f"{k}_Infrared_1.png", f"{k}_Infrared_2.png"),
    "UZH-FPV": lambda k: (f"image_0_{k}.png", f"image_1_{k}.png"),
    "Hamlyn": lambda k: (f"image01/{k}.png", f"image02/{k}.png"),
    "New College": lambda k: (f"{k}-left.pnm", f"{k}-right.pnm"),
}


@pytest.mark.parametrize("name", NAMES)
def test_names_that_data_sets_give(tmp_path: Path, name: str) -> None:
    root = loose(tmp_path / "walk", NAMES[name])
    for folder in ("depth01", "depth02"):  # no cameras, though they come first
        save(root / folder / "0.png", picture(0))
    save(root / "mask_left.png", picture(0))
    save(root / "mask_right.png", picture(0))
    assert recognise_layout(root)["kind"] == "loose_images"
    assert codes(opened_loose(root)) == [(10, 60), (11, 61), (12, 62)]


def test_names_with_a_time_in_them_are_times(tmp_path: Path) -> None:
    """As Malaga's: the rest of the names stays; a serial number in it is no time."""
    times = ("1261228749.918590", "1261228749.968589", "1261228750.018594")

    def names(k: int) -> tuple[str, str]:
        return f"img_40123456789_{times[k]}_left.png", f"img_40123456789_{times[k]}_right.png"

    recording = opened_loose(loose(tmp_path, names))
    assert np.allclose(recording.timestamps, [float(t) for t in times], rtol=0.0, atol=1e-6)
    assert recording.notes == ()
    counted = loose(tmp_path / "b", lambda k: (f"a{10**9 + k}_L.png", f"a{10**9 + k}_R.png"))
    assert "no list of times" in opened_loose(counted).notes[0]


def test_folders_that_hold_a_pair_each_are_no_cameras(tmp_path: Path) -> None:
    """pair_000 and pair_001 are moments, not cameras; one of them alone is a recording."""
    root = loose(tmp_path / "set", lambda k: (f"pair_{k:03d}/left.png", f"pair_{k:03d}/right.png"))
    with pytest.raises(
        DatasetError, match=r"in it has .*pair_000 or .*pair_001 or .*pair_002: giv"
    ):
        recognise_layout(root)


def test_a_recording_further_inside_is_named(tmp_path: Path) -> None:
    loose(tmp_path / "run" / "stereo", lambda k: (f"left/{k}.png", f"right/{k}.png"))
    save(tmp_path / "run" / "mono" / "1.png", picture(1))
    with pytest.raises(DatasetError, match=r"in it has .*/run/stereo: give that folder"):
        recognise_layout(tmp_path)


def test_further_pairs_of_folders_are_said(tmp_path: Path) -> None:
    root = loose(tmp_path, lambda k: (f"lcam_back/{k}.png", f"rcam_back/{k}.png"))
    loose(tmp_path, lambda k: (f"lcam_front/{k}.png", f"rcam_front/{k}.png"))
    assert "also there: lcam_front with rcam_front; leave one pair" in opened_loose(root).notes[0]


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_first_and_second_camera_of_eth3d(tmp_path: Path, side: float) -> None:
    """Which of the two is the left one, its calibration says."""
    stamps = [f"{5096.154125 + 0.037 * k:.6f}.png" for k in range(3)]
    root = loose(tmp_path / "walk", lambda k: (f"rgb2/{stamps[k]}", f"rgb/{stamps[k]}"))
    (root / "calib.json").unlink()
    camera = {"camera_model": "pinhole", "intrinsics": [30, 30, 15.5, 11.5], "resolution": [32, 24]}
    step = [[1, 0, 0, -0.2 * side], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    chain = {"cam0": camera, "cam1": camera | {"T_cn_cnm1": step}}
    (root / "camchain.yaml").write_text(json.dumps(chain))
    recording = opened_loose(root)
    assert recording.rig.baseline == pytest.approx(0.2)
    assert codes(recording)[1] == ((11, 61) if side < 0.0 else (61, 11))
    assert np.allclose(np.diff(recording.timestamps), 0.037, rtol=0.0, atol=1e-6)


def test_a_pair_beside_colour_and_depth_is_chosen_by_the_user(tmp_path: Path) -> None:
    root = loose(tmp_path, lambda k: (f"infra1/{k}.png", f"infra2/{k}.png"))
    for name in ("color", "depth"):
        save(root / name / "0.png", picture(0))
    with pytest.raises(DatasetError, match="equally well: colour and depth; folder of images; say"):
        recognise_layout(root)
    assert recognise_layout(root, "loose_images")["kind"] == "loose_images"


def test_depth_registered_to_colour_comes_before_depth_as_measured(tmp_path: Path) -> None:
    """OpenLORIS has both, of one size."""
    for name in ("color", "depth", "aligned_depth"):
        (tmp_path / name).mkdir()
    assert colour_and_depth(tmp_path) == (tmp_path / "color", tmp_path / "aligned_depth")


def test_colour_and_depth_of_several_cameras_name_the_folder(tmp_path: Path) -> None:
    """As Virtual KITTI 2 has them: rgb/ holds folders of two cameras."""
    loose(tmp_path / "rgb", lambda k: (f"Camera_0/{k}.png", f"Camera_1/{k}.png"))
    loose(tmp_path / "depth", lambda k: (f"Camera_0/{k}.png", f"Camera_1/{k}.png"))
    with pytest.raises(DatasetError, match=r"in it has \S*/rgb: give that folder"):
        recognise_layout(tmp_path)


@pytest.mark.parametrize(
    "names",
    [("frame{:06d}.jpg", "depth{:06d}.png"), ("frame-{:06d}.color.png", "frame-{:06d}.depth.png")],
)
def test_colour_and_depth_in_one_folder(tmp_path: Path, names: tuple[str, str]) -> None:
    """As Replica and 7-Scenes have them; the largest integer is no depth there."""
    depth = np.full((HEIGHT, WIDTH), 240, np.uint16)  # 0.24 m: 10 px at 30 px and 0.08 m
    depth[:, :8] = 65535
    for k in (9, 10):
        save(tmp_path / names[0].format(k), np.dstack([np.full((HEIGHT, WIDTH), k, np.uint8)] * 3))
        save(tmp_path / names[1].format(k), depth)
    lens = {"width": WIDTH, "height": HEIGHT, "fx": 30, "fy": 30, "ppx": 15.5, "ppy": 11.5}
    (tmp_path / "camera.json").write_text(json.dumps(lens), encoding="utf-8")
    assert recognise_layout(tmp_path)["kind"] == "rgbd"
    recording = open_recording(RgbdSettings(path=str(tmp_path), depth_scale=1000.0))
    right, left = recording.frame(1).images
    assert abs(int(right[0, 0]) - 10) <= 1
    assert np.array_equal(left[:, 18:], right[:, 8:-10])
    assert recording.notes[-1].endswith("its median is 0.24 m")
    (tmp_path / names[1].format(9)).rename(tmp_path / names[1].format(11))
    with pytest.raises(DatasetError):
        recognise_layout(tmp_path)


def test_kitti_360(tmp_path: Path) -> None:
    drive = tmp_path / "data_2d_raw" / "2013_05_28_drive_0000_sync"
    for number, code in (("00", 60), ("01", 10)):
        for k in range(3):
            save(drive / f"image_{number}" / "data_rect" / f"{k:010d}.png", picture(code + k))
        times = "".join(f"2013-05-28 08:46:02.{k}04000000\n" for k in range(3))
        (drive / f"image_{number}" / "timestamps.txt").write_text(times, encoding="utf-8")
    lines = ["calib_time: 30-Aug-2018 10:04:35"]
    for number, shift in (("00", 0.0), ("01", -12.0)):
        lines.append(f"S_rect_{number}: {WIDTH} {HEIGHT}")
        lines.append(f"P_rect_{number}: {CALIBRATION['fx']} 0 15.5 {shift} 0 30 11.5 0 0 0 1 0")
    (tmp_path / "calibration").mkdir()
    (tmp_path / "calibration" / "perspective.txt").write_text("\n".join(lines), encoding="utf-8")
    for given in (tmp_path, drive.parent, drive):
        assert recognise_layout(given)["kind"] == "kitti_raw"
        recording = open_recording(KittiRawSettings(path=str(given)))
        assert recording.rig.baseline == pytest.approx(0.4, abs=1e-12)
        assert codes(recording) == [(10, 60), (11, 61), (12, 62)]


def test_a_bag_that_is_compressed_as_a_whole(tmp_path: Path) -> None:
    file = write_bag(tmp_path / "packed.db3", stereo(3), packed=True)
    assert file.name == "packed.db3.zstd"
    for given in (file, file.parent):
        assert recognise_layout(given)["kind"] == "bag"
        again = open_recording(BagSettings(path=str(given)), RecordedOdometrySettings())
        assert codes(again) == [(10, 60), (11, 61), (12, 62)]
    (file.parent / "metadata.yaml").unlink()
    with pytest.raises(DatasetError, match=r"is packed.* zstd -d packed\.db3\.zstd"):
        open_recording(BagSettings(path=str(file)), RecordedOdometrySettings())
