"""Parts of `fgslam inspect`: recognising layouts, matching by descriptors, telling causes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_builders import euroc, image_folder, kitti, picture, save, write_tum
from scipy.spatial.transform import Rotation

from fgslam.core.errors import DatasetError
from fgslam.core.geometry import pose
from fgslam.datasets.layouts import kitti_drives, recognise_layout
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import ImageFolderSettings, RecordedOdometrySettings
from fgslam.frontend.features.matching import mutual_nearest
from fgslam.runs.findings import Finding, Level
from fgslam.runs.inspect import check_clock, inspect_recording, render_report
from fgslam.runs.inspect_matches import (
    LEFT_RIGHT,
    TOP_RIGHT,
    Pair,
    check_disparity_agreement,
    check_disparity_gates,
    check_epipolar,
    check_features,
    check_steadiness,
    check_stereo_counts,
    fit_turn,
)

AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

# --------------------------------------------------------------------------------------------
# Layouts


def test_image_folder_is_recognised(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    assert recognise_layout(root) == {"kind": "image_folder", "path": str(root)}


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


def test_half_an_image_folder_gets_its_readers_message(tmp_path: Path) -> None:
    save(tmp_path / "left" / "000000.png", picture(1))
    with pytest.raises(DatasetError, match="has no folder right; a recording of one camera"):
        inspect_recording(tmp_path)


def test_image_folder_reader_names_the_layout_that_it_finds_instead(tmp_path: Path) -> None:
    cameras = (pose(AHEAD, np.zeros(3)), pose(AHEAD, np.array([0.0, -0.1, 0.0])))
    flying = euroc(tmp_path / "drone", cameras)
    driving, _ = kitti(tmp_path / "car", 3, "06")
    (tmp_path / "nothing").mkdir()
    expected = {
        flying: r"no folder left; this is an EuRoC native folder: --set dataset\.kind=euroc$",
        driving: r"this is a KITTI odometry folder: --set dataset\.kind=kitti "
        r"--set dataset\.sequence=06$",
        driving / "sequences" / "06": r"--set dataset\.kind=kitti --set dataset\.path=.*/car",
        tmp_path / "nothing": "no folder left; a recording of one camera cannot be used",
    }
    for folder, words in expected.items():
        with pytest.raises(DatasetError, match=words):
            open_recording(ImageFolderSettings(path=str(folder)))


@pytest.mark.parametrize("inside", [".", "images", "cam0/data"])
def test_images_of_one_camera_are_called_so(tmp_path: Path, inside: str) -> None:
    (tmp_path / "gyro.csv").write_text("time,gyro_x,gyro_y,gyro_z\n0,0,0,0\n", encoding="utf-8")
    for k in range(4):
        save(tmp_path / inside / f"{k:06d}.png", picture(k))
    with pytest.raises(
        DatasetError, match=r"holds images of one camera only; .* a gyroscope, too.* side by"
    ):
        recognise_layout(tmp_path)


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


def test_noisy_copies_find_each_other(rng: np.random.Generator) -> None:
    a = descriptors(rng, 60)
    order = rng.permutation(60)
    b = np.clip(a[order].astype(int) + rng.integers(-9, 10, a.shape), 0, 255).astype(np.uint8)
    i, j = mutual_nearest(a, b)
    np.testing.assert_array_equal(i, np.arange(60))
    np.testing.assert_array_equal(order[j], np.arange(60))


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


def test_ambiguous_and_absent_descriptors_do_not_match(rng: np.random.Generator) -> None:
    a = descriptors(rng, 3)
    i, _ = mutual_nearest(a, np.concatenate([a, a[:1]]))
    np.testing.assert_array_equal(i, [1, 2])
    for first, second in ((a[:0], a), (a, a[:0])):
        i, j = mutual_nearest(first, second)
        assert len(i) == len(j) == 0


# --------------------------------------------------------------------------------------------
# Causes


def reported(findings: tuple[Finding, ...], level: Level) -> str:
    return " | ".join(f.text for f in findings if f.level is level)


@pytest.mark.parametrize("pair", [LEFT_RIGHT, TOP_RIGHT])
def test_turn_and_growth_are_recovered_among_outliers(rng: np.random.Generator, pair: Pair) -> None:
    places = rng.uniform(0.0, 400.0, (600, 2))
    along, across = places[:, pair.axis] - 200.0, places[:, 1 - pair.axis] - 200.0
    offsets = 0.4 + 0.02 * along - 0.01 * across + rng.normal(0.0, 0.2, 600)
    wrong = rng.random(600) < 0.15
    offsets[wrong] = rng.uniform(-150.0, 150.0, wrong.sum())
    turn = fit_turn(offsets, places, pair)
    assert turn.roll == pytest.approx(0.02, abs=5e-4)
    assert turn.growth == pytest.approx(-0.01, abs=5e-4)
    assert turn.roll_matters
    assert np.median(np.abs(turn.residuals[~wrong] - np.median(turn.residuals))) < 0.2


@pytest.mark.parametrize(
    ("roll", "level"), [(0.0, None), (np.radians(0.5), Level.WARNING), (0.03, Level.PROBLEM)]
)
def test_small_turns_warn_and_large_ones_are_problems(
    rng: np.random.Generator, roll: float, level: Level | None
) -> None:
    places = rng.uniform(0.0, 300.0, (400, 2))
    offsets = roll * (places[:, 0] - 150.0) + rng.normal(0.0, 0.2, 400)
    found = check_epipolar(offsets, rng.uniform(2.0, 30.0, 400), LEFT_RIGHT, places)
    worst = [f for f in found if f.level is not Level.INFO]
    assert [f.level for f in worst] == ([] if level is None else [level])
    if level is not None:
        assert "the left image is turned clockwise by about" in worst[0].text


def test_scatter_without_a_pattern_is_not_called_a_turn(rng: np.random.Generator) -> None:
    places = rng.uniform(0.0, 300.0, (400, 2))
    offsets = rng.uniform(-6.0, 6.0, 400)
    found = reported(check_epipolar(offsets, np.full(400, 9.0), LEFT_RIGHT, places), Level.PROBLEM)
    assert "turned clockwise" not in found
    assert "lens distortion" in found


def test_crossed_disparity_is_not_called_unrectified(rng: np.random.Generator) -> None:
    found = check_epipolar(rng.uniform(3.0, 30.0, 200), rng.normal(0.0, 0.2, 200), TOP_RIGHT)
    problems = reported(found, Level.PROBLEM)
    assert "the top camera seems to lie next to the right one" in problems
    assert "rectified" not in problems


def test_steady_offsets_are_no_finding_and_jumps_name_their_frames() -> None:
    frames = np.array([0, 5, 10, 15, 20])
    steady = np.array([0.1, 0.2, np.nan, 0.1, 0.15])
    assert check_steadiness(steady, frames) == ()
    found = reported(check_steadiness(steady + np.array([0, 0, 0, 2, 0]), frames), Level.WARNING)
    assert "(+0.10 to +2.10 px), most in frames 15:" in found
    assert check_steadiness(np.array([0.0, 9.0]), frames[:2]) == ()


def test_disparities_of_three_cameras(rng: np.random.Generator) -> None:
    horizontal = rng.uniform(3.0, 30.0, 300)
    vertical = horizontal + rng.normal(0.0, 0.2, 300)
    assert reported(check_disparity_agreement(horizontal, vertical), Level.WARNING) == ""
    found = reported(check_disparity_agreement(horizontal, 0.9 * vertical), Level.WARNING)
    assert "is 0.90" in found
    few = reported(check_disparity_agreement(horizontal[:9], vertical[:9]), Level.WARNING)
    assert "only 9 features are matched in all three images" in few


def test_feature_counts() -> None:
    assert check_features(np.array([[300, 320], [310, 290]])) == ()
    found = reported(check_features(np.array([[300, 20], [310, 30]])), Level.WARNING)
    assert "the left images have only 25 SIFT features" in found
    assert "the right images have 305 features but the left ones 25" in found


def test_too_few_stereo_matches_name_their_frames() -> None:
    frames = np.array([3, 6, 9])
    assert check_stereo_counts(np.array([15, 90, 40]), frames) == ()
    found = reported(check_stereo_counts(np.array([15, 14, 0]), frames), Level.WARNING)
    assert "2 of 3 frames have fewer than 15 matches: 6, 9" in found


def test_disparity_gates() -> None:
    disparities = np.linspace(2.0, 38.0, 100)
    assert check_disparity_gates(disparities, 1.0, 40.0) == ()
    near = reported(check_disparity_gates(disparities, 1.0, 30.0), Level.WARNING)
    assert "22 % of matches have more than frontend.stereo.max_disparity_px = 30" in near
    assert "raise it to 40" in near
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


@pytest.mark.parametrize("late", [0.06, -0.12])
def test_shifted_clock_is_measured_and_the_advised_offset_corrects_it(
    tmp_path: Path, late: float
) -> None:
    root = winding_drive(tmp_path, late)
    assert f"shifted by {-late:+.2f} s" in clock(root)
    assert clock(root, -late) == ""


def test_sound_clock_and_straight_drive_give_no_finding(tmp_path: Path) -> None:
    assert clock(winding_drive(tmp_path / "sound", 0.0)) == ""
    assert clock(winding_drive(tmp_path / "straight", 0.1, turning=0.0)) == ""


# --------------------------------------------------------------------------------------------
# The report


def test_report_puts_facts_above_and_findings_below() -> None:
    findings = (
        Finding("odometry_malformed", {"text": "bad. " * 30}),
        Finding("note", {"text": "gap"}),
        Finding("odometry_covers", {"share": "all"}),
        Finding("disparities", {"count": 9, "median": 1.0, "percent": 60.0}),
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
