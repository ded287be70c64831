"""Landmarks out of a filter's hands: they come back to the bit, or where closures have put them."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import RIG, Drive, play, simulate

from fgslam.backend.filters.landmark_kalman import LandmarkKalman
from fgslam.backend.filters.set_aside import SetAside, SetsAside
from fgslam.backend.settings import LandmarkKalmanGraphSettings, LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.estimates import LandmarkMap
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.slam.factory import make_estimator

TURNED = g.pose(g.so3_exp(np.array([0.0, 0.3, 0.0])), np.array([1.0, 0.0, 2.0]))


@pytest.mark.parametrize("kind", [LandmarkKalmanSettings, LandmarkKalmanGraphSettings])
def test_landmarks_come_back_to_the_bit(kind: type) -> None:
    simulation = simulate(Drive(frames=4), np.random.default_rng(1))
    estimator = make_estimator(RIG, kind())
    play(estimator, simulation.increments, EgoMotionSettings())
    assert isinstance(estimator, SetsAside)
    assert isinstance(estimator, LandmarkKalman)
    before, ids = estimator.state(), estimator.landmarks().ids.copy()
    gone = ids[::3]
    aside = estimator.held_aside(gone)
    estimator.give_up(gone)
    np.testing.assert_array_equal(estimator.landmarks().ids, np.setdiff1d(ids, gone))
    estimator.take_back(aside)
    after = estimator.state()
    assert before.keys() == after.keys()
    for name, array in before.items():
        np.testing.assert_array_equal(after[name], array, err_msg=name)


def test_landmarks_move_with_the_frame_that_first_saw_them() -> None:
    poses = np.stack([np.eye(4), TURNED])
    points = np.array([[1.0, 0.0, 4.0], [0.0, 1.0, 5.0], [2.0, 0.0, 3.0]])
    covariances = np.tile(np.diag([1.0, 2.0, 3.0]), (3, 1, 1))
    aside = SetAside(
        landmarks=LandmarkMap(np.array([3, 5, 9]), points, covariances),
        counts=np.ones(3, np.int64),
        homes=np.array([4, 7, -1]),
        lasts=np.array([4, 7, 7]),
        frames=np.array([4, 7]),
        timestamps=np.array([4.0, 7.0]),
        poses=poses,
        doubt_gain=np.tile(np.eye(3), (3, 1, 1)),
        doubt_information=covariances,
    )
    corrected = np.stack([np.eye(4), TURNED @ TURNED])  # frame 7 alone was moved
    moved = aside.moved(corrected)
    now = moved.landmarks
    np.testing.assert_allclose(now.positions[[0, 2]], points[[0, 2]], rtol=0, atol=1e-15)
    # Seen from frame 7 it lies where it lay.
    there = g.transform_to_camera(TURNED, points[1:2])
    np.testing.assert_allclose(
        g.transform_to_camera(corrected[1], now.positions[1:2]), there, rtol=0, atol=1e-12
    )
    by = (corrected[1] @ g.inverse(TURNED))[:3, :3]
    np.testing.assert_allclose(now.covariances[1], by @ covariances[1] @ by.T, rtol=0, atol=1e-12)
    # What the rig's doubt does to it is turned with it; nothing turns what stays.
    np.testing.assert_allclose(moved.doubt_gain[1], by, rtol=0, atol=1e-12)
    np.testing.assert_allclose(moved.doubt_information[1], now.covariances[1], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(moved.doubt_gain[[0, 2]], aside.doubt_gain[[0, 2]])
    assert aside.moved(poses) is aside


def test_a_landmark_started_anew_is_at_home_in_the_last_frame() -> None:
    """As a smoother's tracker starts one that has moved, after the frame; and it stays so."""
    simulation = simulate(Drive(frames=6), np.random.default_rng(1))
    estimator = make_estimator(RIG, LandmarkKalmanSettings())
    assert isinstance(estimator, LandmarkKalman)
    play(estimator, simulation.increments[:4], EgoMotionSettings())
    moved = simulation.increments[3].observations
    estimator.restart(moved)
    aside = estimator.held_aside(moved.ids)
    np.testing.assert_array_equal(aside.homes, 3)
    np.testing.assert_array_equal(aside.lasts, 3)
    np.testing.assert_array_equal(aside.frames, [3])
    play(estimator, simulation.increments[4:], EgoMotionSettings())
    left = np.intersect1d(moved.ids, estimator.landmarks().ids)
    np.testing.assert_array_equal(estimator.held_aside(left).homes, 3)
