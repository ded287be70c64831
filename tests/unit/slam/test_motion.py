"""What predicts the motion: odometry by the lever arm, constant velocity."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
from simulated import RIG, assert_same_bits

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import CameraRig, Increment, Odometry
from fgslam.core.store import restore, state_of
from fgslam.core.types import EgoMotionStatus, Prediction, UpdateStats
from fgslam.frontend.tracking.ego_motion import unmeasured
from fgslam.slam.motion import (
    START_ACCELERATION_SIGMA,
    START_VELOCITY_SIGMA,
    ConstantVelocityMotion,
    OdometryMotion,
)
from fgslam.slam.pipeline import observe

TWIST = np.array([0.05, -0.3, 0.1, 0.4, -0.1, 1.2])  # rad/s and m/s in the camera's frame


def mounted(lever_arm: tuple[float, float, float]) -> CameraRig:
    bTc = g.BODY_FORWARD_LEFT_UP_FROM_CAMERA.copy()
    bTc[:3, 3] = lever_arm
    return dataclasses.replace(RIG, bTc=bTc)


def odometry_motion(rig: CameraRig) -> OdometryMotion:
    return OdometryMotion(rig.bTc, "recorded", ConstantVelocityMotion())


def spin(angle: float, sigma: float = 0.01) -> Odometry:
    motion = g.se3_exp(np.array([0.0, 0.0, angle, 0.0, 0.0, 0.0]))
    return Odometry(motion, np.diag([1e-12, 1e-12, sigma**2, 1e-12, 1e-12, 1e-12]))


# --------------------------------------------------------------------------------------------
# Lever arm


def test_a_spin_of_the_robot_is_an_arc_at_the_camera() -> None:
    """The camera half a metre ahead swings sideways while it turns."""
    angle, arm = np.deg2rad(30.0), 0.5
    moved = odometry_motion(mounted((arm, 0.0, 0.8))).between(0.5, spin(angle))
    assert moved is not None
    assert moved.measured
    # Turning left in body axes: the camera goes left (-x) and back by the cosine.
    expected = [-arm * np.sin(angle), 0.0, -arm * (1 - np.cos(angle))]
    np.testing.assert_allclose(moved.motion[:3, 3], expected, atol=1e-12)
    np.testing.assert_allclose(g.so3_log(moved.motion[:3, :3]), [0.0, -angle, 0.0], atol=1e-12)


def test_uncertain_turning_is_uncertain_swinging() -> None:
    """The lever arm couples yaw with sideways motion, in the frame of the new pose."""
    arm, sigma = 0.5, 0.01
    moved = odometry_motion(mounted((arm, 0.0, 0.8))).between(0.5, spin(0.3, sigma))
    assert moved is not None
    c = moved.covariance
    assert c[1, 1] == pytest.approx(sigma**2, rel=1e-6)
    assert c[3, 3] == pytest.approx((arm * sigma) ** 2, rel=1e-4)
    assert c[1, 3] == pytest.approx(arm * sigma**2, rel=1e-4)


def test_the_cameras_covariance_matches_monte_carlo() -> None:
    rng = np.random.default_rng(3)
    rig = mounted((0.5, -0.2, 0.8))
    rig = dataclasses.replace(rig, bTc=rig.bTc @ g.se3_exp(np.array([0.3, 0.2, -0.1, 0, 0, 0])))
    sigma = np.array([0.01, 0.02, 0.03, 0.02, 0.05, 0.01])
    step = g.se3_exp(np.array([0.0, 0.1, 0.4, 0.3, -0.1, 0.0]))
    stated = odometry_motion(rig).between(0.5, Odometry(step, np.diag(sigma**2)))
    assert stated is not None
    errors = []
    for _ in range(6000):
        drawn = step @ g.se3_exp(sigma * rng.standard_normal(6))
        camera = g.inverse(rig.bTc) @ drawn @ rig.bTc
        errors.append(g.se3_log(g.inverse(stated.motion) @ camera))
    measured = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(stated.covariance), np.diag(stated.covariance)))
    np.testing.assert_allclose(measured / scale, stated.covariance / scale, rtol=0, atol=0.06)


def at(wTc: FloatArray, sigma: float = 0.0) -> Prediction:
    """A measured pose, as exact as stated."""
    return Prediction(wTc, sigma**2 * np.eye(6))


def test_constant_velocity_bridges_a_gap() -> None:
    motion = odometry_motion(mounted((0.3, 0.0, 0.5)))
    alone = ConstantVelocityMotion()
    for t in (0.0, 0.5):
        wTc = g.se3_exp(TWIST * t)
        motion.observe(t, at(wTc), measured=True)
        alone.observe(t, at(wTc), measured=True)
    bridged = motion.between(1.5, None)
    assert bridged is not None
    assert not bridged.measured
    assert_same_bits(bridged, alone.between(1.5))
    np.testing.assert_allclose(bridged.motion, g.se3_exp(TWIST), atol=1e-12)
    # After the gap the odometry is back.
    motion.observe(1.5, at(g.se3_exp(TWIST * 1.5)), measured=True)
    assert motion.between(2.0, spin(0.1)).measured


# --------------------------------------------------------------------------------------------
# Constant velocity


@pytest.mark.parametrize("start", [np.zeros(6), np.array([0.3, 1.0, -0.5, 4.0, 5.0, 6.0])])
def test_constant_twists_are_predicted_exactly(start: FloatArray) -> None:
    motion = ConstantVelocityMotion()
    origin = g.se3_exp(start)
    # Uneven times on purpose.
    times = [0.0, 0.5, 0.7, 1.7, 2.0]
    for k, t in enumerate(times):
        step = motion.between(t)
        assert step is None or not step.measured
        if k >= 2:
            assert step is not None
            predicted = origin @ g.se3_exp(TWIST * times[k - 1]) @ step.motion
            np.testing.assert_allclose(predicted, origin @ g.se3_exp(TWIST * t), atol=1e-12)
        motion.observe(t, at(origin @ g.se3_exp(TWIST * t)), measured=True)


def test_uncertainty_grows_with_the_square_of_the_interval() -> None:
    """A random change of velocity: sigma dt^2, about and along the camera's axes."""
    motion = ConstantVelocityMotion()
    motion.observe(0.0, at(np.eye(4)), measured=True)
    motion.observe(0.5, at(g.se3_exp(0.5 * TWIST)), measured=True)
    for dt in (0.1, 0.2, 1.0):
        step = motion.between(0.5 + dt)
        assert step is not None
        expected = np.diag((START_ACCELERATION_SIGMA * dt**2) ** 2)
        np.testing.assert_allclose(step.covariance, expected, rtol=1e-12)


def test_blind_frames_lose_certainty_and_the_velocity_with_it() -> None:
    motion = ConstantVelocityMotion()
    motion.observe(0.0, at(np.eye(4)), measured=True)
    motion.observe(0.5, at(g.se3_exp(0.5 * TWIST)), measured=True)
    fresh = motion.between(1.0)
    motion.observe(1.0, at(np.eye(4)), measured=False)  # an unmeasured pose
    motion.observe(1.5, at(np.eye(4)), measured=False)
    blind = motion.between(2.0)
    assert fresh is not None
    assert blind is not None
    # 1.27 m/s and 0.32 rad/s, wandering by 3 m/s^2 and 100 degrees/s^2 an axis for 1.5 s.
    kept = [0.1025 / (0.1025 + 3 * np.deg2rad(150.0) ** 2), 1.61 / (1.61 + 3 * 4.5**2)]
    expected = np.repeat(kept, 3) * 0.5 * TWIST
    np.testing.assert_allclose(g.se3_log(blind.motion), expected, rtol=1e-9)
    ratio = np.sqrt(np.diag(blind.covariance) / np.diag(fresh.covariance))
    np.testing.assert_allclose(ratio, 3.0, rtol=1e-12)
    # Seeing again, the velocity is the mean one since it was last measured.
    motion.observe(2.0, at(g.se3_exp(2.0 * TWIST)), measured=True)
    again = motion.between(2.5)
    assert again is not None
    np.testing.assert_allclose(again.motion, g.se3_exp(0.5 * TWIST), atol=1e-12)


def test_a_car_keeps_its_velocity_through_a_gap() -> None:
    """10 m/s for ten seconds: a second without images changes little."""
    motion = ConstantVelocityMotion()
    step = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    for k in range(100):
        motion.observe(0.1 * k, at(g.se3_exp(k * step)), measured=True)
    for k in range(100, 110):
        motion.observe(0.1 * k, at(np.eye(4)), measured=False)
    expected = motion.between(11.0)
    assert expected is not None
    assert expected.motion[2, 3] == pytest.approx(1.0, abs=1e-3)


def test_a_step_that_nothing_measured_is_at_most_free() -> None:
    motion = ConstantVelocityMotion()
    motion.observe(0.0, at(np.eye(4)), measured=True)
    motion.observe(0.5, at(g.se3_exp(0.5 * TWIST)), measured=True)
    step = motion.between(100.0)
    assert step is not None
    np.testing.assert_allclose(np.sqrt(np.diag(step.covariance)), [3.0] * 3 + [30.0] * 3)


def test_a_sudden_turn_found_again_is_the_velocity_from_there() -> None:
    motion = ConstantVelocityMotion()
    motion.observe(0.0, at(np.eye(4)), measured=True)
    motion.observe(0.5, at(np.eye(4)), measured=True)
    motion.regained(1.0, g.se3_exp(0.5 * TWIST))
    step = motion.between(1.5)
    assert step is not None
    np.testing.assert_allclose(step.motion, g.se3_exp(0.5 * TWIST), atol=1e-12)


def test_nothing_is_known_of_the_velocity_after_a_gap() -> None:
    motion = ConstantVelocityMotion()
    motion.observe(0.0, at(np.eye(4)), measured=True)
    motion.observe(0.5, at(g.se3_exp(0.5 * TWIST)), measured=True)
    motion.observe(1.0, at(np.eye(4)), measured=False)
    motion.regained(1.5, g.se3_exp(0.5 * TWIST))
    step = motion.between(2.0)
    assert step is not None
    np.testing.assert_array_equal(step.motion, np.eye(4))
    assert step.covariance[3, 3] == pytest.approx((0.5 * START_VELOCITY_SIGMA[3]) ** 2)


def test_a_motion_that_no_frame_saw_is_no_part_of_the_velocity() -> None:
    """Frame 0 was blind, frame 1 founded the map where the camera had got to unseen."""
    motion = ConstantVelocityMotion()
    motion.observe(0.0, at(np.eye(4)), measured=False)
    motion.observe(0.1, at(np.eye(4)), measured=True)
    motion.observe(0.2, at(g.se3_exp(0.1 * TWIST)), measured=True)
    step = motion.between(0.3)
    assert step is not None
    np.testing.assert_allclose(step.motion, g.se3_exp(0.1 * TWIST), atol=1e-12)


def test_an_unmeasured_start_teaches_no_standstill() -> None:
    motion = ConstantVelocityMotion()
    motion.observe(0.0, at(np.eye(4)), measured=False)
    motion.observe(0.1, at(np.eye(4)), measured=False)
    step = motion.between(0.2)
    assert step is not None
    assert step.covariance[3, 3] == pytest.approx((0.1 * START_VELOCITY_SIGMA[3]) ** 2)


@pytest.mark.parametrize("found", [False, True])
def test_what_the_estimator_corrects_is_no_motion(found: bool) -> None:
    """A pose is tracked on the map as it was; map and pose are then moved together."""
    motion, step, last = ConstantVelocityMotion(), g.se3_exp(0.5 * TWIST), np.eye(4)
    by = g.se3_exp(np.array([0.1, 0.0, 0.2, 1.0, -2.0, 0.5]))
    for k in range(4):
        tracked = unmeasured(at(last @ step), EgoMotionStatus.OK)
        seen = dataclasses.replace(Increment.of(k, 0.5 * k, None), relocalised=found)
        last = by @ tracked.wTc
        observe(motion, seen, tracked, UpdateStats(last, np.eye(6), 9, 0.0, 0))
    expected = motion.between(2.0)
    assert expected is not None
    np.testing.assert_allclose(expected.motion, step, atol=1e-12)


@pytest.mark.parametrize("carried", [False, True])
def test_a_displacement_does_not_change_the_velocity(carried: bool) -> None:
    """Corrected, it keeps the one that it had; carried, it begins as at first."""
    motion, rested = (ConstantVelocityMotion() for _ in range(2))
    motion.observe(0.0, at(np.eye(4)), measured=True)
    motion.observe(0.5, at(g.se3_exp(0.5 * TWIST)), measured=True)
    elsewhere = g.pose(np.eye(3), np.array([7.0, 0.0, -3.0]))
    motion.displaced(1.0, elsewhere @ g.se3_exp(TWIST), carried)
    step = motion.between(1.5)
    assert step is not None
    assert not step.measured
    expected = np.eye(4) if carried else g.se3_exp(0.5 * TWIST)
    np.testing.assert_allclose(step.motion, expected, atol=1e-12)
    if carried:
        rested.observe(1.0, at(np.eye(4)), measured=True)
        np.testing.assert_array_equal(step.covariance, rested.between(1.5).covariance)
    motion.observe(1.5, at(elsewhere @ g.se3_exp(1.5 * TWIST)), measured=True)
    np.testing.assert_allclose(motion.between(2.0).motion, g.se3_exp(0.5 * TWIST), atol=1e-12)


def test_velocity_is_zero_and_uncertain_at_first() -> None:
    motion = ConstantVelocityMotion()
    motion.observe(3.0, at(g.se3_exp(TWIST)), measured=True)
    for dt in (0.1, 0.5):
        step = motion.between(3.0 + dt)
        assert step is not None
        assert not step.measured
        np.testing.assert_array_equal(step.motion, np.eye(4))
        expected = START_VELOCITY_SIGMA * dt
        np.testing.assert_allclose(np.sqrt(np.diag(step.covariance)), expected, rtol=1e-12)


@pytest.mark.parametrize("seen", [0, 2])
@pytest.mark.parametrize("kind", ["constant_velocity", "odometry"])
def test_a_restored_motion_continues_to_the_same_bits(seen: int, kind: str) -> None:
    def make():
        if kind == "constant_velocity":
            return ConstantVelocityMotion()
        return odometry_motion(RIG)

    first, second = make(), make()
    for k in range(seen):
        first.observe(0.5 * k, at(g.se3_exp(0.5 * k * TWIST)), measured=True)
    state = state_of(first)
    kept = copy.deepcopy(state)
    restore(second, {name: np.array(array) for name, array in state.items()})
    for k in range(seen, 6):
        a, b = first.between(0.5 * k, None), second.between(0.5 * k, None)
        assert (a is None) == (b is None)
        if a is not None:
            assert_same_bits(a, b)
        first.observe(0.5 * k, at(g.se3_exp(0.5 * k * TWIST)), measured=True)
        second.observe(0.5 * k, at(g.se3_exp(0.5 * k * TWIST)), measured=True)
    assert_same_bits(state, kept)
    assert_same_bits(state_of(first), state_of(second))


# --------------------------------------------------------------------------------------------
# Its noise


def driven(scale: float, frames: int, dt: float = 0.1, sigma: float = 0.0) -> list[FloatArray]:
    """Predicted deviations (6,) a frame, of accelerations of ``scale`` times ACCELERATION."""
    rng = np.random.default_rng(3)
    motion, wTc, twist = ConstantVelocityMotion(), np.eye(4), np.array(TWIST)
    out = []
    for k in range(frames):
        step = motion.between(k * dt)
        if k >= 2:
            out.append(np.sqrt(np.diag(step.covariance)) / dt**2)
        blur = g.se3_exp(sigma * rng.standard_normal(6))
        motion.observe(k * dt, at(wTc @ blur, sigma), measured=True)
        twist = twist + scale * ACCELERATION * dt * rng.standard_normal(6)
        wTc = wTc @ g.se3_exp(twist * dt)
    return out


ACCELERATION = np.array([0.2, 0.5, 0.1, 1.0, 0.3, 2.0])  # rad/s^2, m/s^2


@pytest.mark.parametrize("scale", [0.2, 1.0, 5.0])
def test_noise_is_that_of_the_motion_after_ten_frames(scale: float) -> None:
    """Within a factor of two: ten samples tell a deviation to a quarter (2.5 sigma)."""
    for ratio in driven(scale, 40)[10:]:
        ratio = ratio / (scale * ACCELERATION)
        assert np.exp(np.abs(np.log(ratio)).mean()) < 1.6
        assert ratio.max() < 3.0
        assert ratio.min() > 0.33


def test_noise_never_collapses_below_what_the_poses_leave_open() -> None:
    """A steady motion, measured to a millimetre and a milliradian, is trusted no better."""
    assert (driven(0.0, 200, sigma=1e-3)[-1] > 1e-3 / 0.1**2).all()
    assert (driven(0.0, 200)[-1] >= np.repeat([np.deg2rad(0.05), 1e-3], 3)).all()


def test_a_sudden_jolt_opens_the_prediction_at_once() -> None:
    motion, wTc, dt = ConstantVelocityMotion(), np.eye(4), 0.1
    for k in range(60):
        motion.observe(k * dt, at(wTc, 1e-4), measured=True)
        wTc = wTc @ g.se3_exp(dt * TWIST)
    jolt = np.array([0.0, 0.02, 0.0, 0.05, 0.0, 0.0])  # of the step
    motion.observe(60 * dt, at(wTc @ g.se3_exp(jolt), 1e-4), measured=True)
    sigma = np.sqrt(np.diag(motion.between(61 * dt).covariance))
    assert sigma[1] > 0.25 * jolt[1]
    assert sigma[3] > 0.25 * jolt[3]
