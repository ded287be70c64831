"""Odometry's clock, unit and axes against turns that images show."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import OdometryError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, so3_exp, so3_log
from fgslam.core.sensors import CameraRig
from fgslam.datasets.clock import (
    FrameFeatures,
    Judged,
    SeenTurns,
    judged,
    judged_turns,
    stereo_features,
    turn_between,
)
from fgslam.datasets.odometry import (
    GyroscopeNoise,
    gyroscope_motions,
    integrate_rates,
    recorded_motions,
)
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import ImageFolderSettings, RecordedOdometrySettings

BIAS = np.radians([0.3, -1.2, 4.3])
FRAMES: FloatArray = np.linspace(1.0, 6.9, 60)
SAMPLES: FloatArray = np.linspace(0.0, 8.5, 426)


def shaken(stamps: FloatArray) -> FloatArray:
    """Rates (n, 3) of a camera in a hand."""
    x, y = np.sin(5.0 * stamps), np.cos(3.1 * stamps + 0.4)
    return np.column_stack([0.8 * x, 0.6 * y, 0.5 * x * y])


def seen_with(
    late: float = 0.0,
    axes: FloatArray | None = None,
    unit: float = 1.0,
    slow: float = 1.0,
    noise: float = 2e-3,
) -> SeenTurns:
    """Turns by images; and a gyroscope that is late, turned, in another unit, and biased."""
    true = slow * shaken(SAMPLES)
    rotations, _ = integrate_rates(SAMPLES, true, FRAMES)
    rng = np.random.default_rng(5)
    turns = np.array([so3_log(r) for r in rotations]) + noise * rng.standard_normal((59, 3))
    measured = unit * (true @ (np.eye(3) if axes is None else axes).T + BIAS)
    late_motions = partial(gyroscope_motions, SAMPLES + late, measured, noise=GyroscopeNoise())
    source = recorded_motions(lambda: late_motions)
    return SeenTurns("shaken", np.arange(1, 60), turns, FRAMES, source, by_gyroscope=True)


@pytest.mark.parametrize("late", [-0.17, 0.03, 0.2])
def test_an_injected_offset_is_found_and_said(late: float) -> None:
    found = judged(seen_with(late))
    assert found.time_offset_s == pytest.approx(-late, abs=0.005)
    assert not found.fault
    way = "ahead" if late > 0.0 else "behind"
    assert f"{way} by the turns that the images show" in found.note
    assert f"odometry.time_offset_s is {found.time_offset_s:.3f}" in found.note


def test_a_clock_that_is_right_is_left_alone() -> None:
    for seed_noise in (1e-4, 2e-2):
        assert judged(seen_with(noise=seed_noise)) == Judged()


def test_a_drive_that_hardly_turns_says_nothing_of_the_clock() -> None:
    assert judged(seen_with(0.1, slow=1e-3)) == Judged()


def test_degrees_are_said() -> None:
    with pytest.raises(OdometryError, match=r"turns [56]\d times as fast .* degrees/s"):
        judged(seen_with(unit=180.0 / np.pi, slow=0.05, noise=2e-4))


def test_a_gyroscope_in_other_axes_is_not_used() -> None:
    found = judged(seen_with(axes=so3_exp(np.array([0.0, 0.5 * np.pi, 0.0]))))
    assert found.fault
    assert "does not turn as the images do" in found.note
    assert "T_cam_imu" in found.note


def test_images_whose_matches_lie_in_one_place_say_no_turn() -> None:
    """A sticker before an even wall: OpenCV's solver ends with an exception there."""
    rng = np.random.default_rng(0)
    codes = rng.integers(0, 256, (40, 32), np.uint8)
    camera = np.array([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]])
    points = np.array([0.0, 0.0, 2.0]) + rng.normal(0.0, 1e-3, (40, 3))
    pixels = points @ camera.T
    look = FrameFeatures(pixels[:, :2] / pixels[:, 2:], codes, points)
    assert turn_between(look, look, camera) is None


def test_turns_are_seen() -> None:
    rig = CameraRig(
        400, 300, 120.0, 120.0, 199.5, 149.5, 0.1, None, BODY_FORWARD_LEFT_UP_FROM_CAMERA
    )
    rng = np.random.default_rng(2)
    points = rng.uniform([-4.0, -2.0, 1.0], [4.0, 2.0, 5.0], (200, 3))
    looks = np.eye(200, 32, dtype=np.uint8) + rng.integers(0, 255, (200, 32), dtype=np.uint8)
    turn = np.array([0.01, -0.05, 0.02])
    frames = []
    for at in (points, points @ so3_exp(turn)):
        measured = rig.predict(at)
        left = np.column_stack([measured[:, 0] + measured[:, 2], measured[:, 1]])
        frames.append(stereo_features(rig, (measured[:, :2], looks), (left, looks)))
    camera = np.array([[rig.fx, 0.0, rig.cx], [0.0, rig.fy, rig.cy], [0.0, 0.0, 1.0]])
    assert turn_between(*frames, camera) == pytest.approx(turn, abs=1e-6)


@pytest.mark.data
def test_the_clock_of_a_real_car_is_found_without_its_truth(shared_data: Path) -> None:
    """By the truth its odometry agrees best at -0.06 s (docs/datasets/images.md)."""
    folder = ImageFolderSettings(path=str(shared_data / "kitti_raw_0926_5hz"))
    shifted = open_recording(folder, RecordedOdometrySettings(time_offset_s=0.09))
    assert judged_turns(shifted).time_offset_s == pytest.approx(-0.15, abs=0.015)
