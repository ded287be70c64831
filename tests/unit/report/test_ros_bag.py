"""A trajectory as a ROS 2 bag, read back by the library that reads bags without ROS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import se3_exp
from fgslam.report.formats import FRAME, TOPIC, write_mcap


def test_poses_are_in_the_axes_of_ros(tmp_path: Path) -> None:
    """One metre forward, turned to the right: x = 1, and a negative turn about z, which is up."""
    turned = se3_exp(np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0]))  # about the camera's y, down
    turned[:3, 3] = 0.0, 0.0, 1.0
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    path = tmp_path / "t.mcap"
    trajectory = Trajectory(np.array([1.25, 2.5]), np.array([np.eye(4), turned]))
    write_mcap(path, trajectory, np.array([covariance, np.full((6, 6), np.nan)]))
    with AnyReader([path]) as bag:
        assert [c.topic for c in bag.connections] == [TOPIC]
        read = [(t, bag.deserialize(raw, c.msgtype)) for c, t, raw in bag.messages()]
    assert [t for t, _ in read] == [1_250_000_000, 2_500_000_000]
    first, second = (message for _, message in read)
    assert first.header.frame_id == FRAME
    # Translation first; forward is the camera's z, left minus its x, up minus its y.
    assert np.diag(first.pose.covariance.reshape(6, 6)).tolist() == [6, 4, 5, 3, 1, 2]
    assert not second.pose.covariance.any()  # unknown
    place, turn = second.pose.pose.position, second.pose.pose.orientation
    np.testing.assert_allclose([place.x, place.y, place.z], [1, 0, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        [turn.x, turn.y, turn.z, turn.w],
        [0, 0, -np.sin(0.15), np.cos(0.15)],
        rtol=0,
        atol=1e-12,
    )
