from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_builders import curve, image_folder, write_tum
from scipy import stats

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.geometry import body_to_camera_motion, inverse, se3_log
from fgslam.core.log import ImageSequence
from fgslam.core.sensors import Odometry
from fgslam.datasets.odometry import SyntheticOdometry
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import ImageFolderSettings, SyntheticOdometrySettings

SETTINGS = SyntheticOdometrySettings()
FRAMES = 300


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = image_folder(tmp_path_factory.mktemp("synthetic"), FRAMES)
    write_tum(root / "gt_right_cam.txt", 0.1 * np.arange(FRAMES), curve(FRAMES))
    return root


def opened(root: Path, **settings: object) -> Recording:
    mounting = {"lever_arm_m": (0.5, -0.2, 1.0), "camera_yaw_deg": 10.0}
    return open_recording(ImageFolderSettings(path=str(root), **mounting, **settings))  # type: ignore[arg-type]


def step(sequence: SyntheticOdometry, i: int) -> Odometry:
    odometry = sequence.odometry(i)
    assert odometry is not None
    return odometry


def errors(sequence: SyntheticOdometry) -> FloatArray:
    """Whitened error (n, 6) of every step against the truth, in the body's tangent space."""
    truth = sequence.ground_truth
    assert truth is not None
    bTc = sequence.rig.bTc
    out = []
    for i in range(1, len(sequence)):
        given = step(sequence, i)
        camera = inverse(truth.poses[i - 1]) @ truth.poses[i]
        body = bTc @ camera @ inverse(bTc)
        xi = se3_log(inverse(body) @ given.motion)
        out.append(xi / np.sqrt(np.diag(given.covariance)))
    return np.array(out)


def test_synthetic_odometry_is_a_sequence_and_noted_as_synthetic(folder: Path) -> None:
    recording = opened(folder)
    sequence = SyntheticOdometry(recording, SETTINGS, 3)
    assert isinstance(sequence, ImageSequence)
    assert (sequence.name, sequence.identity) == (recording.name, recording.identity)
    assert len(sequence) == FRAMES
    np.testing.assert_array_equal(sequence.timestamps, recording.timestamps)
    np.testing.assert_array_equal(sequence.frame(5).images[1], recording.frame(5).images[1])
    assert any("synthetic" in n and "2 %" in n and "1 degrees" in n for n in sequence.notes)


def test_noise_is_the_stated_one(folder: Path) -> None:
    """Sound statistics: each axis' whitened errors are standard normal, uncorrelated."""
    white = errors(SyntheticOdometry(opened(folder), SETTINGS, 11))
    n = len(white)
    low, high = stats.chi2.ppf([0.001, 0.999], n) / n
    power = (white**2).mean(axis=0)
    assert np.all((power > low) & (power < high))
    assert np.all(np.abs(white.mean(axis=0)) < 3.3 / np.sqrt(n))
    correlation = np.corrcoef(white.T) - np.eye(6)
    assert np.abs(correlation).max() < 3.8 / np.sqrt(n)


def test_standard_deviations_follow_the_settings(folder: Path) -> None:
    sequence = SyntheticOdometry(opened(folder), SETTINGS, 1)
    truth = sequence.ground_truth
    assert truth is not None
    bTc = sequence.rig.bTc
    body = bTc @ inverse(truth.poses[0]) @ truth.poses[1] @ inverse(bTc)
    sigmas = np.sqrt(np.diag(step(sequence, 1).covariance))
    np.testing.assert_allclose(sigmas[:3], np.radians(1.0))
    np.testing.assert_allclose(sigmas[3:], 0.02 * np.linalg.norm(body[:3, 3]))


def test_without_noise_but_the_floor_it_is_the_truth(folder: Path) -> None:
    still = SyntheticOdometrySettings(translation_sigma_fraction=0.0, rotation_sigma_deg=0.0)
    sequence = SyntheticOdometry(opened(folder), still, 1)
    truth = sequence.ground_truth
    assert truth is not None
    for i in range(1, 8):
        found = step(sequence, i)
        sigmas = np.sqrt(np.diag(found.covariance))
        np.testing.assert_allclose(sigmas, np.repeat([np.radians(0.01), 0.001], 3))
        camera = body_to_camera_motion(found.motion, sequence.rig.bTc)
        expected = inverse(truth.poses[i - 1]) @ truth.poses[i]
        np.testing.assert_allclose(camera, expected, atol=5.0 * 0.001)


def test_seeds_repeat_and_differ(folder: Path) -> None:
    recording = opened(folder)
    first, again, other = (SyntheticOdometry(recording, SETTINGS, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(step(first, 9).motion, step(again, 9).motion)
    assert not np.allclose(step(first, 9).motion, step(other, 9).motion, atol=1e-6)
    assert not np.allclose(step(first, 9).motion, step(first, 10).motion, atol=1e-6)


def test_a_part_of_the_recording_repeats_the_same_noise(folder: Path) -> None:
    whole = SyntheticOdometry(opened(folder), SETTINGS, 5)
    part = SyntheticOdometry(opened(folder, start=100, stop=200), SETTINGS, 5)
    for i in (1, 50, 99):
        np.testing.assert_array_equal(step(part, i).motion, step(whole, 100 + i).motion)


def test_order_of_asking_does_not_matter(folder: Path) -> None:
    sequence = SyntheticOdometry(opened(folder), SETTINGS, 5)
    forwards = [step(sequence, i).motion for i in (1, 2, 3)]
    backwards = [step(sequence, i).motion for i in (3, 2, 1)][::-1]
    np.testing.assert_array_equal(forwards, backwards)


def test_needs_ground_truth(tmp_path: Path) -> None:
    recording = opened(image_folder(tmp_path))
    with pytest.raises(DatasetError, match=r"no ground truth.*choose recorded") as error:
        SyntheticOdometry(recording, SETTINGS, 1)
    assert "\n" not in str(error.value)


def test_gap_in_the_truth_leaves_the_step_without_odometry(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    keep = [0, 1, 4, 5]
    write_tum(root / "gt_right_cam.txt", 0.1 * np.array(keep), curve(6)[keep])
    sequence = SyntheticOdometry(opened(root), SETTINGS, 1)
    got = [sequence.odometry(i) is not None for i in range(1, 6)]
    assert got == [True, False, False, False, True]
    assert "2 frames have no ground truth, so no odometry" in sequence.notes
    with pytest.raises(IndexError):
        sequence.odometry(0)
