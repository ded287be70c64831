"""Whatever the waypoints and the limits, the robot keeps to them."""

import numpy as np
from hypothesis import assume, given, reject, strategies as st
from simulated import plan_drive

from fgslam.core.errors import ConfigError
from fgslam.worlds.driving import FRAME_RATE_HZ
from fgslam.worlds.settings import LabDriveSettings

coordinate = st.floats(-3.5, 3.5, allow_nan=False, width=32)
points = st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=6)


@given(
    points=points,
    closed=st.booleans(),
    speed=st.floats(0.1, 1.5),
    turn=st.floats(5.0, 60.0),
)
def test_no_step_exceeds_the_limits(
    points: list[tuple[float, float]], closed: bool, speed: float, turn: float
) -> None:
    ring = np.array([*points, points[0]] if closed else points)
    assume(np.linalg.norm(np.diff(ring, axis=0), axis=1).min() > 0.3)
    settings = LabDriveSettings(
        path="waypoints",
        waypoints_m=tuple(points),
        closed=closed,
        frames=None,
        max_speed_m_s=speed,
        max_turn_deg_s=turn,
    )
    try:
        drive = plan_drive(settings)
    except ConfigError:
        reject()
    poses = drive.body_poses(drive.timestamps)
    motions = np.linalg.inv(poses[:-1]) @ poses[1:]
    way = np.linalg.norm(motions[:, :3, 3], axis=1)
    turned = np.rad2deg(np.abs(np.arctan2(motions[:, 1, 0], motions[:, 0, 0])))
    assert way.max() <= speed / FRAME_RATE_HZ * (1 + 1e-6)
    assert turned.max() <= turn / FRAME_RATE_HZ * 1.01
    np.testing.assert_allclose(poses[0, :2, 3], points[0], atol=1e-9)
    last = points[0] if closed else points[-1]
    np.testing.assert_allclose(poses[-1, :2, 3], last, atol=1e-9)
