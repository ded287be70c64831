"""Parts of `fgslam inspect`: recognising layouts, matching by descriptors, telling causes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from dataset_builders import euroc, image_folder, kitti, picture, save, write_tum
from scipy.spatial.transform import Rotation

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.geometry import pose
from fgslam.datasets.layouts import kitti_drives, recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import ImageFolderSettings, RecordedOdometrySettings
from fgslam.frontend.features.matching import mutual_nearest
from fgslam.runs.findings import Finding, Level, finding
from fgslam.runs.inspect import check_clock, inspect_recording, render_report
from fgslam.runs.inspect_matches import LEFT_RIGHT, Matches, check_disparity_gates, check_pair

AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

# --------------------------------------------------------------------------------------------
# Layouts


def test_euroc_is_recognised_from_both_folders(tmp_path: Path) -> None:
    cameras = (pose(AHEAD, np.zeros(3)), pose(AHEAD, np.array([0.0, -0.1, 0.0])))
    root = euroc(tmp_path, cameras)
    for folder in (root, root / "mav0"):
        assert recognise_layout(folder) == {"kind": "euroc", "path": str(folder)}


def test_kitti_is_recognised_from_its_root_and_from_a_drive(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path, 3, "06")
    (root / "sequences" / "11").mkdir()
    (root / "sequences" / "notes").mkdir()
    assert kitti_drives(root) == ("06", "11")
    expected = {"kind": "kitti", "path": str(root), "sequence": "06"}
    assert recognise_layout(root) == expected
    assert recognise_layout(root / "sequences" / "06") == expected


def test_report_on_kitti_names_the_drive_and_the_others(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path, 4, "06")
    (root / "sequences" / "07").mkdir()
    report = " ".join(inspect_recording(root).split())
    assert "recording KITTI 06" in report
    assert 'dataset.sequence "06"' in report
    assert f"other drives 07: inspect {root}/sequences/NN" in report


def test_a_kitti_drive_without_its_root_is_a_folder_of_images(tmp_path: Path) -> None:
    root, _ = kitti(tmp_path / "a", 3)
    moved = tmp_path / "drive"
    (root / "sequences" / "06").rename(moved)
    assert recognise_layout(moved) == {"kind": "loose_images", "path": str(moved)}
    assert "frames                  3 over 0.2 s" in inspect_recording(moved)
    (moved / "image_1").rename(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match="move it to ROOT/sequences/00"):
        recognise_layout(moved)


@pytest.mark.parametrize("inside", [".", "images", "cam0/data"])
def test_images_of_one_camera_are_called_so(tmp_path: Path, inside: str) -> None:
    (tmp_path / "gyro.csv").write_text("time,gyro_x,gyro_y,gyro_z\n0,0,0,0\n", encoding="utf-8")
    for k in range(4):
        save(tmp_path / inside / f"{k:06d}.png", picture(k))
    if inside != ".":
        with pytest.raises(DatasetError, match=rf"in it has {tmp_path / inside}: give that folder"):
            recognise_layout(tmp_path)
    words = r"one camera alone is not enough, with a gyroscope, too .* shows both views"
    with pytest.raises(DatasetError, match=words):
        inspect_recording(tmp_path / inside)


def test_unknown_layout_lists_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "calib.json").write_text("{}", encoding="utf-8")
    with pytest.raises(DatasetError) as caught:
        recognise_layout(tmp_path)
    text = str(caught.value)
    assert "image folder (lacks left, right, times.txt)" in text
    assert "KITTI odometry (lacks sequences/NN, or of one drive image_0, image_1" in text
    assert "EuRoC native (lacks mav0/cam0, mav0/cam1)" in text
    assert "\n" not in text


def test_run_folder_and_missing_folder(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("name: a", encoding="utf-8")
    with pytest.raises(DatasetError, match=r"is a run folder, .*made from: .*config\.yaml$"):
        recognise_layout(tmp_path)
    with pytest.raises(DatasetError, match="no such folder or experiment file"):
        recognise_layout(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="is neither a folder nor an experiment"):
        recognise_layout(picture_file(tmp_path))


def picture_file(folder: Path) -> Path:
    save(folder / "000000.png", picture(1))
    return folder / "000000.png"


# --------------------------------------------------------------------------------------------
# Matching by descriptors


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(0, 120, (count, 128), dtype=np.uint8)


def exhaustive(a: np.ndarray, b: np.ndarray, ratio: float) -> list[tuple[int, int]]:
    """In whole numbers; the first of several that are equally near."""
    squared = ((a[:, None].astype(np.int64) - b[None].astype(np.int64)) ** 2).sum(axis=2)
    found = []
    for i, row in enumerate(squared):
        j = int(row.argmin())
        second = np.delete(row, j).min() if len(b) > 1 else np.inf
        if squared[:, j].argmin() == i and row[j] < ratio**2 * second:
            found.append((i, j))
    return found


@pytest.mark.parametrize("largest", [2, 120, 256])
def test_matches_equal_those_of_exhaustive_search(rng: np.random.Generator, largest: int) -> None:
    total = 0
    for rows, columns in [(40, 50), (1, 1), (1, 9), (9, 1), (2, 2), (7, 7), (50, 13)]:
        a, b = (rng.integers(0, largest, (n, 128), dtype=np.uint8) for n in (rows, columns))
        alike = min(rows, columns) // 2 + 1
        a[-1] = a[0]  # two that are equally near
        b[:alike] = np.where(rng.random((alike, 128)) < 0.6, a[-alike:], b[:alike])
        b[-1] = b[0] if columns > 2 else b[-1]
        expected = exhaustive(a, b, 0.9)
        found = [index.tolist() for index in mutual_nearest(a, b, 0.9)]
        assert list(zip(*found, strict=True)) == expected
        total += len(expected)
    assert total >= 10


# --------------------------------------------------------------------------------------------
# Matches


def reported(findings: Iterable[Finding], level: Level) -> str:
    return " | ".join(f.text for f in findings if f.level is level)


def judged(rows: FloatArray, disparities: FloatArray, roll: float = 0.0) -> list[Finding]:
    """Findings of 400 matches over one image, whose rows grow with the column by ``roll``."""
    places = np.random.default_rng(0).uniform(0.0, 300.0, (len(rows), 2))
    across = rows + roll * (places[:, 0] - 150.0)
    frame = np.zeros(len(rows), np.int64)
    matches = Matches(frame, np.arange(len(rows)), across, disparities, places)
    return check_pair(matches, frame[:1], LEFT_RIGHT)


@pytest.mark.parametrize(
    ("roll", "level"), [(0.0, None), (np.radians(0.5), Level.WARNING), (0.03, Level.PROBLEM)]
)
def test_small_turns_warn_and_large_ones_are_problems(
    rng: np.random.Generator, roll: float, level: Level | None
) -> None:
    rows, disparities = rng.normal(0.0, 0.2, 400), rng.uniform(2.0, 30.0, 400)
    wrong = rng.random(400) < 0.1
    rows[wrong], disparities[wrong] = rng.uniform(-90, 90, (2, wrong.sum()))
    worst = [f for f in judged(rows, disparities, roll) if f.level is not Level.INFO]
    assert [f.level for f in worst] == ([] if level is None else [level])
    if level is not None:
        assert "the left image is turned clockwise by about" in worst[0].text


def test_scatter_without_a_pattern_is_not_called_a_turn(rng: np.random.Generator) -> None:
    found = reported(judged(rng.uniform(-6.0, 6.0, 400), np.full(400, 9.0)), Level.PROBLEM)
    assert "turned clockwise" not in found
    assert "lens distortion" in found


def test_negative_disparities_short_of_a_swap(rng: np.random.Generator) -> None:
    rows, disparities = rng.normal(0.0, 0.25, 400), rng.uniform(1.0, 40.0, 400)
    disparities[:120] *= -1.0
    found = judged(rows, disparities)
    assert reported(found, Level.PROBLEM) == ""
    assert "30 % of matches have negative disparity" in reported(found, Level.WARNING)


def test_too_few_matches_to_judge() -> None:
    found = reported(judged(np.zeros(19), -np.ones(19)), Level.WARNING)
    assert "only 19 matches" in found
    assert "swapped" not in found


def test_disparity_gates() -> None:
    disparities = np.linspace(2.0, 38.0, 100)
    assert check_disparity_gates(disparities, 1.0, 40.0) == []
    far = reported(check_disparity_gates(disparities, 25.0, 40.0), Level.WARNING)
    assert "64 % of matches have less than frontend.stereo.min_disparity_px = 25" in far


# --------------------------------------------------------------------------------------------
# The odometry's clock


def winding_drive(root: Path, late: float, turning: float = 1.0) -> Path:
    """60 frames in 6 s of a body that turns to and fro; the odometry is stamped ``late`` s late."""
    image_folder(root, 60)
    stamps, fine = 0.1 * np.arange(60), 0.02 * np.arange(-50, 400)
    yaw = 0.4 * turning * (1.0 - np.cos(1.5 * stamps))
    rotations = [Rotation.from_euler("z", angle).as_matrix() @ AHEAD for angle in yaw]
    poses = np.array([pose(rotation, np.zeros(3)) for rotation in rotations])
    write_tum(root / "gt_right_cam.txt", stamps, poses)
    rates = 0.6 * turning * np.sin(1.5 * fine)
    rows = [f"{t + late:.3f},0,{rate:.9f}" for t, rate in zip(fine, rates, strict=True)]
    (root / "odom.csv").write_text("\n".join(rows), encoding="utf-8")
    return root


def clock(root: Path, offset: float = 0.0) -> str:
    odometry = RecordedOdometrySettings(time_offset_s=offset)
    recording = open_recording(ImageFolderSettings(path=str(root)), odometry)
    return reported(check_clock(recording), Level.WARNING)


@pytest.mark.parametrize("late", [0.06, -0.12, 0.4])
def test_shifted_clock_is_measured_and_the_advised_offset_corrects_it(
    tmp_path: Path, late: float
) -> None:
    root = winding_drive(tmp_path, late)
    assert f"shifted by {-late:+.3f} s" in clock(root)
    assert clock(root, -late) == ""


def test_sound_clock_and_straight_drive_give_no_finding(tmp_path: Path) -> None:
    assert clock(winding_drive(tmp_path / "sound", 0.0)) == ""
    assert clock(winding_drive(tmp_path / "straight", 0.1, turning=0.0)) == ""


# --------------------------------------------------------------------------------------------
# The report


def test_report_puts_facts_above_and_findings_below() -> None:
    findings = (
        finding("odometry_malformed", text="bad. " * 30),
        finding("note", text="gap"),
        finding("odometry_covers", share="all"),
        finding("disparities", count=9, median=1.0, percent=60.0),
    )
    blocks = render_report((("frames", "9"),), (("SIFT features", "many"),), findings).split("\n\n")
    assert blocks[0] == "frames         9"
    assert blocks[1] == "odometry       covers all steps"
    assert blocks[2].startswith("SIFT features  many\nthree cameras  both disparities of 9")
    lines = blocks[3].splitlines()
    assert lines[0].startswith("PROBLEM  odometry: bad.")
    assert lines[1].startswith("         bad.")
    assert lines[-1] == "WARNING  recording: gap"
    assert blocks[4] == "1 problem and 1 warning: problems spoil a run, or the frames named."
