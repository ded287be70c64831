from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from dataset_builders import curve, image_folder, picture, save, write_tum

from fgslam.core.arrays import FloatArray
from fgslam.core.log import ImageSequence
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Trajectory
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording, with_synthetic_odometry
from fgslam.datasets.settings import (
    ImageFolderSettings,
    SyntheticOdometrySettings,
)
from fgslam.runs.findings import Finding, Level
from fgslam.runs.inspect import (
    check_calibration,
    check_images,
    check_odometry,
    check_odometry_against_truth,
    check_sequence,
    check_timing,
    check_truth,
    facts_of,
)


def opened(root: Path, **settings: object) -> Recording:
    return open_recording(ImageFolderSettings(path=str(root), **settings))  # type: ignore[arg-type]


def texts(findings: tuple[Finding, ...], least: Level = Level.WARNING) -> str:
    levels = [Level.INFO, Level.WARNING, Level.PROBLEM]
    return " | ".join(f.text for f in findings if levels.index(f.level) >= levels.index(least))


def test_sound_recording_has_facts_and_no_warning(tmp_path: Path) -> None:
    root = image_folder(tmp_path / "sound", 20)
    write_tum(root / "gt_right_cam.txt", 0.1 * np.arange(20), curve(20))
    write_tum(root / "odometry.txt", 0.1 * np.arange(20), body_poses(opened(root), curve(20)))
    findings = check_sequence(opened(root))
    assert texts(findings) == ""
    facts = dict(facts_of(opened(root)))
    assert facts["recording"] == "sound"
    assert facts["frames"] == "20 over 1.9 s"
    assert facts["rate"] == "10 Hz"
    assert facts["cameras"] == "2, 32x24"
    assert facts["baseline"] == "0.2 m"
    info = texts(findings, Level.INFO)
    assert "covers 19 of 19 (100 %) steps" in info
    assert "covers 20 of 20 (100 %) frames, path length 9.7" in info
    assert "differs from truth by" in info


def body_poses(recording: Recording, cameras: np.ndarray) -> np.ndarray:
    return cameras @ np.linalg.inv(recording.rig.bTc)


def test_findings_come_worst_first(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    save(root / "left" / "000002.png", np.zeros((24, 32), np.uint8))
    (root / "right" / "000004.png").unlink()
    levels = [f.level for f in check_sequence(opened(root))]
    order = [Level.PROBLEM, Level.WARNING, Level.INFO]
    assert levels == sorted(levels, key=order.index)
    assert set(levels) == set(order)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0, "the left image is all black (too dark) in 1 of 6 (16.7 %) sampled frames: 3"),
        (255, "the left image is all white (over-exposed) in 1 of 6"),
        (90, "the left image is all flat (without any structure) in 1 of 6"),
    ],
)
def test_images_without_content(tmp_path: Path, value: int, words: str) -> None:
    root = image_folder(tmp_path)
    save(root / "left" / "000003.png", np.full((24, 32), value, np.uint8))
    found = check_images(opened(root))
    assert words in texts(found, Level.PROBLEM)


def test_sampling_reads_no_more_than_asked(tmp_path: Path) -> None:
    read: list[int] = []
    recording = opened(image_folder(tmp_path, 40))

    def counted(index: int, colour: bool) -> tuple[np.ndarray, ...]:
        read.append(index)
        return recording.load_images(index, colour)

    assert check_images(replace(recording, load_images=counted), 5) == ()
    assert read == [0, 10, 20, 29, 39]


def test_same_camera_twice_and_unequal_brightness(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    for k in range(6):
        save(root / "left" / f"{k:06d}.png", picture(10 + k))
    assert "right and left image are identical in 6 of 6" in texts(check_images(opened(root)))
    for k in range(6):
        save(root / "left" / f"{k:06d}.png", picture(60 + k) // 3)
    assert "right camera is 3" in texts(check_images(opened(root)))


RIG = CameraRig(640, 480, 500.0, 500.0, 320.0, 240.0, 0.12, None, np.eye(4))


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (replace(RIG, cx=700.0), "principal point (700.0, 240.0) lies outside the 640x480"),
        (replace(RIG, fy=600.0), "fx and fy differ"),
        (replace(RIG, fx=40.0, fy=40.0), "field of view of 166 degrees"),
        (replace(RIG, fx=5e4, fy=5e4), "field of view of 1 degrees"),
        (replace(RIG, baseline=120.0), "baseline of 120 m is unusual; is it in metres"),
        (replace(RIG, vertical_baseline=1e-4), "vertical baseline of 0.0001 m"),
    ],
)
def test_unusual_calibration(rig: CameraRig, words: str) -> None:
    assert check_calibration(RIG) == ()
    assert words in texts(check_calibration(rig))


def test_gaps_in_time() -> None:
    assert check_timing(0.1 * np.arange(9)) == ()
    stamps = np.array([0.0, 0.1, 0.2, 0.3, 0.9, 1.0, 1.3, 1.4])
    found = texts(check_timing(stamps))
    assert "2 of 7 steps" in found
    assert "0.6 s, follows frame 3" in found
    assert "only 2 frames" in texts(check_timing(np.array([0.0, 1.0])))


# --------------------------------------------------------------------------------------------
# Odometry and truth


def with_truth(root: Path, frames: int = 40) -> Path:
    image_folder(root, frames)
    write_tum(root / "gt_right_cam.txt", 0.1 * np.arange(frames), curve(frames))
    return root


def test_gap_in_the_odometry(tmp_path: Path) -> None:
    root = image_folder(tmp_path, 10)
    (root / "odom.csv").write_text("".join(f"{t},1,0\n" for t in (0, 0.1, 0.2, 0.705, 0.8, 0.9)))
    found = check_odometry(opened(root))
    assert "covers 3 of 9 (33.3 %) steps" in texts(found, Level.INFO)
    assert "none before frames 3, 4, 5, 6, 7, ...; constant velocity" in texts(found)


def test_broken_odometry_is_a_problem_not_an_exception(tmp_path: Path) -> None:
    root = with_truth(tmp_path)
    (root / "odom.csv").write_text("0,1,0\n1,nan,0\n")
    findings = check_sequence(opened(root))
    assert "odom.csv, line 2: forward speed is nan" in texts(findings, Level.PROBLEM)


def flight(standing: int, flying: int, rate: float, seed: int = 3) -> Trajectory:
    """A drone that stands, flies at up to 0.8 m/s, and stands again; truth good to 0.3 mm."""
    count = 2 * standing + flying
    speed = np.zeros(count)
    speed[standing : standing + flying] = 0.8 * np.sin(np.linspace(0.0, np.pi, flying))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.cumsum(speed) / rate
    poses[:, :3, 3] += 0.0003 * np.random.default_rng(seed).standard_normal((count, 3))
    return Trajectory(np.arange(count) / rate, poses)


@dataclass(frozen=True)
class WithTruth:
    """What the check of ground truth asks a recording for."""

    ground_truth: Trajectory

    @property
    def timestamps(self) -> FloatArray:
        return self.ground_truth.timestamps

    def __len__(self) -> int:
        return len(self.ground_truth)


@pytest.mark.parametrize("rate", [0.7, 200.0])
@pytest.mark.parametrize("flying", [6, 40])
def test_a_short_flight_after_long_standing_is_no_jump(rate: float, flying: int) -> None:
    truth = flight(300, flying, rate)
    assert "moves suddenly" not in texts(check_truth(cast(ImageSequence, WithTruth(truth))))


@pytest.mark.parametrize("rate", [0.7, 200.0])
@pytest.mark.parametrize("at", [100, 320])
def test_a_jump_is_found_while_standing_and_while_flying(rate: float, at: int) -> None:
    truth = flight(300, 40, rate)
    fastest = 0.8 / rate
    truth.poses[at:, 1, 3] += 0.1 + 20.0 * fastest
    assert f"before its poses {at}:" in texts(check_truth(cast(ImageSequence, WithTruth(truth))))


def test_one_bad_pose_is_found() -> None:
    truth = flight(300, 40, 20.0)
    truth.poses[50, 2, 3] += 1.0
    assert "before its poses 50, 51:" in texts(check_truth(cast(ImageSequence, WithTruth(truth))))


def test_sound_odometry_agrees_with_truth(tmp_path: Path) -> None:
    recording = opened(with_truth(tmp_path))
    synthetic = with_synthetic_odometry(recording, SyntheticOdometrySettings(), 2)
    found = check_odometry_against_truth(synthetic)
    assert texts(found) == ""
    assert "over 39 steps" in texts(found, Level.INFO)


@pytest.mark.parametrize(
    ("spoil", "name"),
    [
        (lambda motion: motion @ turn(2, np.radians(4.0)), "yaw"),
        (lambda motion: motion @ turn(0, np.radians(-4.0)), "roll"),
        (lambda motion: motion * scaled(3, 1.3), "forward motion"),
    ],
)
def test_odometry_that_contradicts_truth(
    tmp_path: Path, spoil: Callable[[np.ndarray], np.ndarray], name: str
) -> None:
    recording = opened(with_truth(tmp_path))
    synthetic = with_synthetic_odometry(recording, SyntheticOdometrySettings(), 2)
    steps = [synthetic.odometry(i) for i in range(1, 40)]
    spoilt = tuple(replace(s, motion=spoil(s.motion)) for s in steps if s is not None)
    bad = replace(recording, odometry_source=lambda _: spoilt)
    assert f"the error in {name} is" in texts(check_odometry_against_truth(bad))


def turn(axis: int, angle: float) -> np.ndarray:
    a, b = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(4)
    out[a, a] = out[b, b] = np.cos(angle)
    out[a, b], out[b, a] = -np.sin(angle), np.sin(angle)
    return out


def scaled(column: int, factor: float) -> np.ndarray:
    out = np.ones((4, 4))
    out[0, column] = factor
    return out
