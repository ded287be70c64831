import numpy as np
import pytest

from fgslam.core.errors import ConfigError
from fgslam.worlds.driving.paths import MAX_ACCELERATION_M_S2, Drive
from fgslam.worlds.settings import LabDriveSettings
from tests.simulated import plan_drive

SQUARE = ((-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0))

DRIVES = [
    LabDriveSettings(),
    LabDriveSettings(frames=None),
    LabDriveSettings(path="laps", laps=2, frames=None),
    LabDriveSettings(path="laps", laps=5, frames=2000),
    LabDriveSettings(path="waypoints", waypoints_m=SQUARE, frames=None),
    LabDriveSettings(path="waypoints", waypoints_m=SQUARE, closed=True, frames=None),
    LabDriveSettings(path="waypoints", waypoints_m=((0.0, -1.0), (2.0, -1.0)), frames=None),
    LabDriveSettings(frames=None, max_speed_m_s=0.8, max_turn_deg_s=40.0, frame_rate_hz=10.0),
]


def steps(drive: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Metres and radians between consecutive frames."""
    poses = drive.body_poses(drive.timestamps)
    motions = np.linalg.inv(poses[:-1]) @ poses[1:]
    way = np.linalg.norm(motions[:, :3, 3], axis=1)
    return way, np.abs(np.arctan2(motions[:, 1, 0], motions[:, 0, 0]))


def names(settings: LabDriveSettings) -> str:
    return f"{settings.path}-{settings.frames}-{settings.max_speed_m_s}"


@pytest.mark.parametrize("settings", DRIVES, ids=names)
def test_speed_limits_hold_between_frames(settings: LabDriveSettings) -> None:
    way, turn = steps(plan_drive(settings))
    assert way.max() <= settings.max_speed_m_s / settings.frame_rate_hz + 1e-9
    assert np.rad2deg(turn.max()) <= settings.max_turn_deg_s / settings.frame_rate_hz + 1e-3


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
    law = plan_drive(settings).law
    speed = np.diff(law.arc) / np.diff(law.seconds)
    middle = 0.5 * (law.seconds[1:] + law.seconds[:-1])
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
    drive = plan_drive(LabDriveSettings(path="waypoints", waypoints_m=SQUARE, frames=None))
    for point in SQUARE:
        assert np.linalg.norm(drive.path.xy - point, axis=1).min() < 5e-3


def test_frames_given_are_frames_driven() -> None:
    for frames in (160, 249, 1000):
        drive = plan_drive(LabDriveSettings(frames=frames))
        assert len(drive.timestamps) == frames
        assert drive.law.duration == pytest.approx(drive.timestamps[-1])


def test_too_few_frames_are_refused_with_the_least_number() -> None:
    with pytest.raises(ConfigError, match=r"takes at least \d+ frames") as caught:
        plan_drive(LabDriveSettings(frames=50))
    least = int(str(caught.value).split("at least ")[1].split()[0])
    assert len(plan_drive(LabDriveSettings(frames=least)).timestamps) == least
    with pytest.raises(ConfigError):
        plan_drive(LabDriveSettings(frames=least - 1))


@pytest.mark.parametrize(
    ("points", "closed"),
    [((), False), (((0.0, 0.0),), False), (((0.0, 0.0), (0.0, 0.0)), False), (SQUARE[:2], True)],
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
