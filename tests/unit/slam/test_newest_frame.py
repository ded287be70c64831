"""What a slow session gets from a fast camera: the newest frame, with all of the odometry."""

from __future__ import annotations

import threading

import numpy as np
import pytest

import fgslam as fg
from fgslam.core.geometry import se3_exp
from fgslam.errors import SessionError

IMAGES = (np.zeros((4, 4), np.uint8),) * 2
STEP = se3_exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.5]))


def odometry(sigma: float) -> fg.Odometry:
    return fg.Odometry(STEP, sigma**2 * np.eye(6))


def test_a_frame_that_no_caller_took_is_replaced_and_counted() -> None:
    frames = fg.NewestFrame()
    for t in (1.0, 2.0, 3.0):
        frames.put(t, IMAGES)
    frames.close()
    assert [t for t, _, _ in frames] == [3.0]
    assert frames.dropped == 2


def test_the_odometry_of_frames_left_out_is_part_of_the_next_ones() -> None:
    frames = fg.NewestFrame()
    for t in (1.0, 2.0, 3.0):
        frames.put(t, IMAGES, odometry(0.1))
    taken = frames.take()
    assert taken is not None
    joined = taken[2]
    assert isinstance(joined, fg.Odometry)
    np.testing.assert_allclose(joined.motion, STEP @ STEP @ STEP, rtol=0, atol=1e-12)
    assert (np.diag(joined.covariance) > 3 * 0.1**2 - 1e-12).all()
    frames.put(4.0, IMAGES, STEP)
    frames.put(5.0, IMAGES, odometry(0.1))
    plain = frames.take()
    assert plain is not None
    np.testing.assert_allclose(np.asarray(plain[2]), STEP @ STEP, rtol=0, atol=1e-12)


def test_motion_over_a_frame_without_odometry_is_not_known() -> None:
    frames = fg.NewestFrame()
    frames.put(1.0, IMAGES, STEP)
    frames.put(2.0, None)
    frames.put(3.0, IMAGES, STEP)
    taken = frames.take()
    assert taken is not None
    assert taken[2] is None


def test_taking_waits_for_the_camera_and_ends_with_it() -> None:
    frames = fg.NewestFrame()
    assert frames.take(timeout=0.001) is None
    camera = threading.Thread(target=lambda: (frames.put(1.0, IMAGES), frames.close()))
    camera.start()
    assert [t for t, _, _ in frames] == [1.0]
    camera.join()
    with pytest.raises(SessionError, match="closed"):
        frames.put(2.0, IMAGES)


def test_a_camera_loop_may_fill_its_arrays_again() -> None:
    left, step = np.full((4, 4), 9, np.uint8), np.eye(4)
    frames = fg.NewestFrame()
    frames.put(1.0, (left, left), step)
    left[:], step[:] = 77, 0.0
    taken = frames.take()
    assert taken is not None
    assert taken[1] is not None
    assert (np.asarray(taken[1]) == 9).all()
    np.testing.assert_array_equal(np.asarray(taken[2]), np.eye(4))
