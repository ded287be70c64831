from dataclasses import replace

import numpy as np
import pytest

from fgslam.core import geometry
from fgslam.worlds.driving import wheel_odometry
from fgslam.worlds.settings import LabDriveSettings, WheelOdometrySettings
from tests.simulated import plan_drive

QUIET = WheelOdometrySettings(scale_error=0.0, noise=0.0)


@pytest.fixture
def no_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("FLOOR_M", 1e-9), ("FLOOR_DEG", 1e-9), ("HEIGHT_M_SQRT_M", 0.0)):
        monkeypatch.setattr(wheel_odometry, name, value)


def arc(way: float, turn: float) -> np.ndarray:
    """Two body poses, the second ``way`` metres on along an arc of ``turn`` radians."""
    forward = np.array([0.0, 0.0, turn, way, 0.0, 0.0])
    start = geometry.pose(geometry.so3_exp(np.array([0, 0, 0.7])), np.array([1.0, -2.0, 0.0]))
    return np.stack([start, start @ geometry.se3_exp(forward)])


def errors(settings: WheelOdometrySettings, poses: np.ndarray, draws: int) -> np.ndarray:
    """(draws, steps, 6) tangent errors of the measured increments at the new body pose."""
    truth = geometry.inverse(poses[:-1]) @ poses[1:]
    out = []
    for seed in range(draws):
        measured = wheel_odometry.simulate(settings, poses, np.random.default_rng(seed))
        out.append(
            [
                geometry.se3_log(geometry.inverse(t) @ m.motion)
                for t, m in zip(truth, measured, strict=True)
            ]
        )
    return np.array(out)


@pytest.mark.parametrize(
    ("way", "turn"), [(0.2, 0.0), (0.08, 0.06), (0.0, 0.087), (0.15, -0.03), (0.0, 0.0)]
)
def test_stated_covariance_is_that_of_the_samples(way: float, turn: float) -> None:
    settings = WheelOdometrySettings(scale_error=0.08)
    poses = arc(way, turn)
    xi = errors(settings, poses, 1500)[:, 0]
    stated = wheel_odometry.simulate(settings, poses, np.random.default_rng(0))[0].covariance
    white = np.linalg.solve(np.linalg.cholesky(stated), xi.T)
    # Entries of a sample covariance of n unit normals scatter by sqrt(2/n) and sqrt(1/n).
    np.testing.assert_allclose(white @ white.T / len(xi), np.eye(6), atol=5 * np.sqrt(2 / len(xi)))
    assert np.abs(white.mean(axis=1)).max() < 5 / np.sqrt(len(xi))


@pytest.mark.usefixtures("no_floor")
def test_cutting_the_way_into_more_frames_leaves_the_drift_as_it_is() -> None:
    settings = replace(QUIET, noise=1.0)
    total = []
    for frames in (200, 400):
        drive = plan_drive(
            LabDriveSettings(path="waypoints", waypoints_m=((-3.0, 1.2), (3.0, 1.2)), frames=frames)
        )
        poses = drive.body_poses(drive.timestamps)
        covariance = np.zeros((6, 6))
        for step in wheel_odometry.simulate(settings, poses, np.random.default_rng(0)):
            covariance = geometry.compose_covariance(step.motion, covariance, step.covariance)
        total.append(np.sqrt(np.diag(covariance)))
    np.testing.assert_allclose(total[0], total[1], rtol=0.03, atol=1e-6)


@pytest.mark.usefixtures("no_floor")
def test_scale_errors_are_one_number_a_drive() -> None:
    settings = replace(QUIET, scale_error=0.06)
    drive = plan_drive(LabDriveSettings())
    poses = drive.body_poses(drive.timestamps)
    truth = geometry.inverse(poses[:-1]) @ poses[1:]
    measured = wheel_odometry.simulate(settings, poses, np.random.default_rng(3))
    xi = np.array(
        [
            geometry.se3_log(geometry.inverse(t) @ m.motion)
            for t, m in zip(truth, measured, strict=True)
        ]
    )
    turn = np.arctan2(truth[:, 1, 0], truth[:, 0, 0])
    turning = turn > 0.01
    ratio = xi[turning, 2] / turn[turning]
    assert np.ptp(ratio) < 1e-6
    assert abs(ratio[0]) > 1e-3
    straight = np.linalg.norm(truth[:, :3, 3], axis=1)
    along = np.linalg.norm(xi[:, 3:], axis=1) / straight
    assert np.ptp(along[straight > 0.02]) < 1e-3


def test_default_drift_is_that_of_an_indoor_robot() -> None:
    """About 2 % of the distance over some metres, 1 to 2 degrees in a quarter turn."""
    settings = WheelOdometrySettings()
    line = plan_drive(
        LabDriveSettings(path="waypoints", waypoints_m=((-2.5, 1.2), (2.5, 1.2)), frames=None)
    )
    poses = line.body_poses(line.timestamps)
    steps = [wheel_odometry.simulate(settings, poses, np.random.default_rng(s)) for s in range(120)]
    ends = np.array([np.linalg.multi_dot([m.motion for m in drive]) for drive in steps])
    true_end = geometry.inverse(poses[0]) @ poses[-1]
    error = np.linalg.norm(ends[:, :2, 3] - true_end[:2, 3], axis=1)
    assert 0.01 < np.sqrt(np.mean(error**2)) / 5.0 < 0.03
    quarter = wheel_odometry.increment_variances(settings, np.array([1.5]), np.array([np.pi / 2]))
    by_scale = settings.scale_error * np.pi / 2
    assert 1.0 < np.rad2deg(np.sqrt(quarter[0, 2] + by_scale**2)) < 2.0


def test_covariances_are_positive_definite_even_at_rest() -> None:
    still = np.repeat(arc(0.0, 0.0)[:1], 3, axis=0)
    for step in wheel_odometry.simulate(QUIET, still, np.random.default_rng(0)):
        assert np.linalg.eigvalsh(step.covariance).min() > 0.0


def test_same_seed_same_odometry_and_other_seed_other() -> None:
    poses = arc(0.2, 0.05)
    once, again, other = (
        wheel_odometry.simulate(WheelOdometrySettings(), poses, np.random.default_rng(s))[0].motion
        for s in (4, 4, 5)
    )
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once, other)
