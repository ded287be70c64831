"""Smooth paths within limits, wheel odometry as stated, and a wheelchair under commands."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import plan_drive

from fgslam.core import geometry
from fgslam.core.errors import ConfigError
from fgslam.core.geometry import between
from fgslam.worlds import driving
from fgslam.worlds.driving import (
    MAX_ACCELERATION_M_S2,
    Wheelchair,
    fastest_times,
    increment_variances,
    round_corners,
    simulate_wheels,
)
from fgslam.worlds.lab import place_path
from fgslam.worlds.settings import (
    LabDriveSettings,
    WheelOdometrySettings,
)

SQUARE = ((-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0))

DRIVES = [
    LabDriveSettings(),
    LabDriveSettings(frames=None),
    LabDriveSettings(path="laps", laps=5, frames=2000),
    LabDriveSettings(path="waypoints", waypoints_m=SQUARE, closed=True, frames=None),
    LabDriveSettings(path="waypoints", waypoints_m=((0.0, -1.0), (2.0, -1.0)), frames=None),
    LabDriveSettings(frames=None, max_speed_m_s=0.8, max_turn_deg_s=40.0),
]


def names(settings: LabDriveSettings) -> str:
    return f"{settings.path}-{settings.frames}-{settings.max_speed_m_s}"


@pytest.mark.parametrize("settings", DRIVES, ids=names)
def test_limits_hold_at_every_instant(settings: LabDriveSettings) -> None:
    drive = plan_drive(settings)
    seconds = np.arange(0.0, drive.timestamps[-1], 0.02)
    planar = drive.planar(seconds)
    speed = np.linalg.norm(np.diff(planar[:, :2], axis=0), axis=1) / 0.02
    rate = np.abs(np.diff(planar[:, 2])) / 0.02
    assert speed.max() <= settings.max_speed_m_s * (1 + 1e-3)
    assert np.rad2deg(rate.max()) <= settings.max_turn_deg_s * (1 + 1e-2)


@pytest.mark.parametrize("settings", DRIVES, ids=names)
def test_acceleration_limit(settings: LabDriveSettings) -> None:
    path = place_path("lab", settings)
    speed_limit, turn_limit = settings.max_speed_m_s, np.deg2rad(settings.max_turn_deg_s)
    seconds = fastest_times(path, speed_limit, turn_limit, MAX_ACCELERATION_M_S2)
    speed = np.diff(path.arc) / np.diff(seconds)
    middle = 0.5 * (seconds[1:] + seconds[:-1])
    acceleration = np.abs(np.diff(speed) / np.diff(middle))
    # The first and last cell have the mean speed of a start from rest.
    assert acceleration[2:-2].max() <= MAX_ACCELERATION_M_S2 * 1.05


@pytest.mark.parametrize("settings", DRIVES, ids=names)
def test_robot_drives_the_way_it_faces(settings: LabDriveSettings) -> None:
    drive = plan_drive(settings)
    seconds = np.linspace(0.2, drive.timestamps[-1] - 0.2, 400)
    before, after = drive.planar(seconds - 1e-3), drive.planar(seconds + 1e-3)
    step = after[:, :2] - before[:, :2]
    moving = np.linalg.norm(step, axis=1) > 1e-6
    heading = np.arctan2(step[:, 1], step[:, 0])
    error = np.angle(np.exp(1j * (heading - drive.planar(seconds)[:, 2])))
    assert np.abs(error[moving]).max() < 2e-3


def test_paper_loop_goes_once_around_the_chair_and_returns() -> None:
    drive = plan_drive(LabDriveSettings())
    poses = drive.body_poses(drive.timestamps)
    assert len(poses) == 249
    np.testing.assert_array_equal(poses[-1], poses[0])
    in_start_frame = np.linalg.inv(poses[0]) @ poses
    assert in_start_frame[:, 0, 3].max() > 4.0
    # Once around the chair in the middle: the bearing from it turns full circle.
    bearing = np.unwrap(np.arctan2(poses[:, 1, 3], poses[:, 0, 3]))
    assert abs(bearing[-1] - bearing[0]) == pytest.approx(2 * np.pi, abs=1e-6)
    assert np.hypot(poses[:, 0, 3], poses[:, 1, 3]).min() > 0.8


@pytest.mark.parametrize("settings", [s for s in DRIVES if s.path == "laps" or s.closed], ids=names)
def test_closed_paths_end_where_they_began(settings: LabDriveSettings) -> None:
    drive = plan_drive(settings)
    poses = drive.body_poses(drive.timestamps)
    np.testing.assert_allclose(poses[-1], poses[0], atol=1e-12)
    just_before = drive.planar(drive.timestamps[-1:] - 1e-6)[0]
    assert np.linalg.norm(just_before[:2] - poses[0, :2, 3]) < 1e-4
    assert np.cos(just_before[2] - np.arctan2(poses[0, 1, 0], poses[0, 0, 0])) > 1 - 1e-8


def test_waypoints_are_passed() -> None:
    path = place_path("lab", LabDriveSettings(path="waypoints", waypoints_m=SQUARE, frames=None))
    for point in SQUARE:
        assert np.linalg.norm(path.xy - point, axis=1).min() < 5e-3


def test_too_few_frames_are_refused_with_the_least_number() -> None:
    with pytest.raises(ConfigError, match=r"takes at least \d+ frames") as caught:
        plan_drive(LabDriveSettings(frames=50))
    least = int(str(caught.value).split("at least ")[1].split()[0])
    assert len(plan_drive(LabDriveSettings(frames=least)).timestamps) == least
    with pytest.raises(ConfigError):
        plan_drive(LabDriveSettings(frames=least - 1))


@pytest.mark.parametrize(
    ("points", "closed"),
    [((), False), (((0.0, 0.0), (0.0, 0.0)), False), (SQUARE[:2], True)],
)
def test_waypoints_that_make_no_path(points: tuple[tuple[float, float], ...], closed: bool) -> None:
    with pytest.raises(ConfigError, match="waypoints_m"):
        plan_drive(
            LabDriveSettings(path="waypoints", waypoints_m=points, closed=closed, frames=None)
        )


def test_turning_back_on_the_spot_is_refused_with_its_place() -> None:
    there_and_back = ((0.0, -1.0), (2.0, -1.0), (0.0, -1.0))
    with pytest.raises(ConfigError, match=r"too sharply near \(2\.00, -1\.00\)"):
        plan_drive(LabDriveSettings(path="waypoints", waypoints_m=there_and_back, frames=None))


def test_rounded_corners_start_and_end_where_the_corners_do() -> None:
    corners = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 4.0], [9.0, 8.0]])
    path = round_corners(corners, 2.0)
    np.testing.assert_allclose(path.xy[[0, -1]], corners[[0, -1]], atol=1e-5)
    np.testing.assert_allclose(path.heading[-1], np.pi / 4, atol=1e-9)
    assert not path.closed
    # Nowhere further from the corners' polyline than a corner is cut.
    assert np.abs(path.curvature).max() < 1.2


def test_corners_too_near_for_their_bends_are_refused() -> None:
    with pytest.raises(ValueError, match="too near"):
        round_corners(np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 1.0], [9.0, 1.0]]), 2.0)


# --------------------------------------------------------------------------------------------
# Wheel odometry


QUIET = WheelOdometrySettings(scale_error=0.0, noise=0.0)


@pytest.fixture
def no_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("FLOOR_M", 1e-9), ("FLOOR_DEG", 1e-9), ("HEIGHT_M_SQRT_M", 0.0)):
        monkeypatch.setattr(driving, name, value)


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
        measured = simulate_wheels(settings, poses, np.random.default_rng(seed))
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
    stated = simulate_wheels(settings, poses, np.random.default_rng(0))[0].covariance
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
        for step in simulate_wheels(settings, poses, np.random.default_rng(0)):
            covariance = geometry.compose_covariance(step.motion, covariance, step.covariance)
        total.append(np.sqrt(np.diag(covariance)))
    np.testing.assert_allclose(total[0], total[1], rtol=0.03, atol=1e-6)


@pytest.mark.usefixtures("no_floor")
def test_scale_errors_are_one_number_a_drive() -> None:
    settings = replace(QUIET, scale_error=0.06)
    drive = plan_drive(LabDriveSettings())
    poses = drive.body_poses(drive.timestamps)
    truth = geometry.inverse(poses[:-1]) @ poses[1:]
    measured = simulate_wheels(settings, poses, np.random.default_rng(3))
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
    steps = [simulate_wheels(settings, poses, np.random.default_rng(s)) for s in range(120)]
    ends = np.array([np.linalg.multi_dot([m.motion for m in drive]) for drive in steps])
    true_end = geometry.inverse(poses[0]) @ poses[-1]
    error = np.linalg.norm(ends[:, :2, 3] - true_end[:2, 3], axis=1)
    assert 0.01 < np.sqrt(np.mean(error**2)) / 5.0 < 0.03
    quarter = increment_variances(settings, np.array([1.5]), np.array([np.pi / 2]))
    by_scale = settings.scale_error * np.pi / 2
    assert 1.0 < np.rad2deg(np.sqrt(quarter[0, 2] + by_scale**2)) < 2.0


# --------------------------------------------------------------------------------------------
# Wheelchair


@pytest.fixture
def exact_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SPEED_SCALE", "TURN_SCALE", "PULL_DEG_M", "SLIP_M_SQRT_M", "SLIP_DEG_SQRT_M"):
        monkeypatch.setattr(driving, name, 0.0)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_speed_follows_command_after_the_latency_and_within_limits() -> None:
    chair = Wheelchair(np.zeros(3), rng())
    chair.command(9.0, -9.0)
    speeds, turns = [], []
    for _ in range(200):
        chair.advance(0.01)
        speeds.append(chair.speed)
        turns.append(chair.turn_rate)
    waiting = round(driving.LATENCY_S / 0.01)
    assert np.array_equal(speeds[:waiting], np.zeros(waiting))
    assert speeds[waiting] == pytest.approx(driving.CHAIR_ACCELERATION_M_S2 * 0.01)
    assert np.diff(speeds).max() <= driving.CHAIR_ACCELERATION_M_S2 * 0.01 + 1e-12
    assert max(speeds) == pytest.approx(driving.MAX_SPEED_M_S)
    assert min(turns) == pytest.approx(-np.deg2rad(driving.MAX_TURN_DEG_S))
    limit = np.deg2rad(driving.CHAIR_TURN_ACCELERATION_DEG_S2) * 0.01
    assert np.abs(np.diff(turns)).max() <= limit + 1e-12


@pytest.mark.usefixtures("exact_drive")
def test_without_slip_it_drives_the_circle_of_its_command() -> None:
    chair = Wheelchair(np.array([1.0, 2.0, 0.4]), rng())
    chair.command(0.3, 0.2)
    chair.advance(5.0)
    first = chair.pose.copy()
    chair.advance(4.0)
    step = between(first, chair.pose)
    expected = 1.5 * np.array([np.sin(0.8), 1.0 - np.cos(0.8)])
    np.testing.assert_allclose(step[:2], expected, atol=1e-5)
    assert step[2] == pytest.approx(0.8)


def test_slip_has_the_stated_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """End points of 200 drives of 2 m scatter as the constants say."""
    monkeypatch.setattr(driving, "LATENCY_S", 0.0)
    monkeypatch.setattr(driving, "CHAIR_ACCELERATION_M_S2", 10.0)
    ends = []
    for seed in range(200):
        chair = Wheelchair(np.zeros(3), rng(seed))
        chair.command(0.5, 0.0)
        chair.advance(4.0)
        ends.append(chair.pose)
    heading = np.array(ends)[:, 2]
    way = np.linalg.norm(np.array(ends)[:, :2], axis=1)
    expected = np.deg2rad(np.hypot(2.0 * 1.0, 1.0 * np.sqrt(2.0)))
    # The standard error of a deviation from 200 samples is 5 %.
    assert heading.std() == pytest.approx(expected, rel=0.16)
    assert way.std() == pytest.approx(np.hypot(2.0 * 0.03, 0.02 * np.sqrt(2.0)), rel=0.16)
    assert abs(heading.mean()) < 4 * expected / 14


@pytest.mark.usefixtures("exact_drive")
def test_a_wall_stops_it_but_lets_it_turn_and_back_out() -> None:
    chair = Wheelchair(np.zeros(3), rng(), lambda place: bool(place[0] > 0.5))
    chair.command(0.5, 0.0)
    chair.advance(4.0)
    assert chair.collided
    assert 0.48 < chair.pose[0] <= 0.5
    chair.command(-0.3, 0.3)
    # Until the command takes effect it still pushes against the wall.
    chair.advance(0.2)
    chair.advance(1.8)
    assert not chair.collided
    assert chair.pose[0] < 0.3
    assert chair.pose[2] > 0.3


def test_steps_of_any_length_add_up() -> None:
    """Fifteen frames a second are no whole number of the integration's steps."""
    chair = Wheelchair(np.zeros(3), rng())
    for _ in range(150):
        chair.advance(1.0 / 15.0)
    assert chair.time == pytest.approx(10.0, abs=0.0051)


@pytest.mark.parametrize("speed", [np.nan, np.inf])
def test_commands_are_finite_and_time_goes_forwards(speed: float) -> None:
    chair = Wheelchair(np.zeros(3), rng())
    with pytest.raises(ValueError, match="not finite"):
        chair.command(speed, 0.0)
    with pytest.raises(ValueError, match="forwards"):
        chair.advance(0.0)
