"""A gyroscope in the loop: its turn for the prediction, its bias and noise from the matches."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from simulated import RIG, Drive, assert_same_bits, simulate

from fgslam.backend.settings import Isam2Settings, LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import BiasEffect, Odometry
from fgslam.core.store import restore, state_of
from fgslam.core.types import Prediction
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.slam.motion import (
    ConstantVelocityMotion,
    GyroscopeError,
    OdometryMotion,
    turn_of_camera,
)
from fgslam.slam.replay import replay

SETTINGS = ConstantVelocitySettings()
START = float(np.radians(3.0))
TRUE_BIAS = np.radians([0.2, -1.2, 4.3])
DT, SIGMA = 0.05, 2e-4  # seconds; radians of a turn
PIXELS = np.repeat([5e-4, 0.004], 3)  # radians and metres that matches leave of a pose


def motion_model(bTc: FloatArray | None = None) -> OdometryMotion:
    bTc = np.eye(4) if bTc is None else bTc
    return OdometryMotion(bTc, "recorded", ConstantVelocityMotion())


def measured(rotation: FloatArray, noise: FloatArray, bias: FloatArray) -> Odometry:
    """What a gyroscope with this bias makes of a turn."""
    turned = rotation @ g.so3_exp(DT * bias + noise)
    effect = BiasEffect(-DT * np.eye(3), START**2, 1e-12)
    return Odometry.turn(turned, SIGMA**2 * np.eye(3), effect)


def matched(
    step: Odometry, before: Prediction, wTc: FloatArray, rng: np.random.Generator
) -> Prediction:
    """The pose as least squares over the prediction and matches of the true pose would have it."""
    prior = g.compose_covariance(step.motion, before.covariance, step.covariance)
    predicted = before.wTc @ step.motion
    seen = g.se3_log(g.inverse(predicted) @ wTc) + PIXELS * rng.standard_normal(6)
    gain = prior @ np.linalg.inv(prior + np.diag(PIXELS**2))
    return Prediction(predicted @ g.se3_exp(gain @ seen), prior - gain @ prior)


def driven(
    frames: int,
    seed: int,
    bias: FloatArray = TRUE_BIAS,
    excess: float = 1.0,
    corrected: FloatArray | None = None,
) -> tuple[OdometryMotion, list[float]]:
    """A hand-held camera with that gyroscope; and the angles by which its turns were mispredicted.

    The noise is ``excess`` times as large as stated; each frame the estimator has ``corrected`` the
    map and the pose by this motion of the world.
    """
    rng = np.random.default_rng(seed)
    motion = motion_model()
    wTc, at = np.eye(4), Prediction(np.eye(4), 1e-12 * np.eye(6))
    motion.observe(0.0, at, measured=True)
    errors = []
    for k in range(1, frames):
        twist = np.array([0.5 * np.sin(0.1 * k), 0.3 * np.cos(0.07 * k), 0.1, 0.3, 0.0, 0.2])
        step = g.se3_exp(DT * twist)
        noise = excess * SIGMA * rng.standard_normal(3)
        given = motion.between(DT * k, measured(step[:3, :3], noise, bias))
        assert given is not None
        errors.append(g.rotation_angle(given.motion[:3, :3].T @ step[:3, :3]))
        wTc = wTc @ step
        at = matched(given, at, wTc, rng)
        motion.observe(DT * k, at, measured=True)
        if corrected is not None:
            wTc, at = corrected @ wTc, Prediction(corrected @ at.wTc, at.covariance)
            motion.displaced(DT * k, at.wTc, carried=False)
    return motion, errors


def gyroscope_of(motion: OdometryMotion) -> GyroscopeError:
    return motion.gyroscope


# --------------------------------------------------------------------------------------------
# The prediction


def test_the_camera_turns_as_measured_and_goes_on_at_its_velocity() -> None:
    motion = motion_model()
    step = g.pose(np.eye(3), np.array([0.0, 0.0, 0.1]))
    motion.observe(0.0, Prediction(np.eye(4), 1e-8 * np.eye(6)), measured=True)
    motion.observe(0.1, Prediction(step, 1e-8 * np.eye(6)), measured=True)
    turn = Odometry.turn(g.so3_exp(np.array([0.0, 0.2, 0.0])), 1e-6 * np.eye(3))
    found = motion.between(0.2, turn)
    assert found is not None
    assert (found.measured, found.turned) == (False, True)
    np.testing.assert_allclose(found.motion[:3, :3], turn.motion[:3, :3], rtol=0.0, atol=1e-12)
    chord = 0.1 * np.sin(0.1) / 0.1  # of the arc that 0.1 m is
    assert np.linalg.norm(found.motion[:3, 3]) == pytest.approx(chord, abs=1e-9)
    np.testing.assert_allclose(found.covariance[:3, :3], 1e-6 * np.eye(3), rtol=0.0, atol=1e-12)
    guess = motion.between(0.2, None)
    assert guess is not None
    np.testing.assert_array_equal(found.covariance[3:, 3:], guess.covariance[3:, 3:])


def test_a_body_and_its_camera_turn_by_the_same_wherever_it_sits() -> None:
    bTc = g.BODY_FORWARD_LEFT_UP_FROM_CAMERA.copy()
    bTc[:3, 3] = (3.0, -2.0, 1.0)
    effect = BiasEffect(-0.1 * np.eye(3), START**2, 0.0)
    left = Odometry.turn(g.so3_exp(np.array([0.0, 0.0, 0.3])), np.diag([1.0, 2.0, 3.0]), effect)
    found = turn_of_camera(left, bTc)
    np.testing.assert_allclose(g.so3_log(found.motion[:3, :3]), [0.0, -0.3, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.diag(found.covariance)[:3], [2.0, 3.0, 1.0], atol=1e-12)
    assert found.bias is not None
    np.testing.assert_allclose(found.bias.jacobian, -0.1 * bTc[:3, :3].T, atol=1e-15)


# --------------------------------------------------------------------------------------------
# Bias and noise


def test_the_bias_is_found_with_its_covariance() -> None:
    """Normalised squares over 12 drives: 3 degrees of freedom each, at most 3 by the filter."""
    squares = []
    for seed in range(12):
        found = gyroscope_of(driven(60, seed)[0])
        error = found.bias - TRUE_BIAS
        covariance = state_of(found)["covariance"]
        assert np.degrees(np.abs(error).max()) < 0.5
        squares.append(error @ np.linalg.solve(covariance, error))
    # It leaves out that the pose before is off by the bias, too: too modest, never too sure.
    assert np.mean(squares) < 3.0 * (1.0 + 3.0 * np.sqrt(2.0 / (3.0 * 12)))


def test_a_known_bias_leaves_predictions_to_the_noise() -> None:
    errors = driven(150, 3)[1]
    assert np.degrees(errors[0]) > 0.2, "4.5 degrees/s over a twentieth of a second"
    assert np.degrees(np.median(errors[100:])) < 0.03


def test_noise_beyond_what_is_stated_is_noticed() -> None:
    def factor(excess: float) -> float:
        motions = [driven(60, seed, np.zeros(3), excess)[0] for seed in range(3)]
        return float(np.median([gyroscope_of(m).noise_factor for m in motions]))

    assert factor(1.0) < 2.0
    assert factor(30.0) > 30.0


def test_the_bias_is_learnt_on_a_map_that_is_corrected() -> None:
    errors = driven(150, 3, corrected=g.se3_exp(np.full(6, 0.05)))[1]
    assert np.degrees(np.median(errors[100:])) < 0.03


def test_nothing_is_learnt_from_where_it_was_carried() -> None:
    motion, _ = driven(50, 1)
    bias = gyroscope_of(motion).bias.copy()
    motion.displaced(10.0, g.se3_exp(np.ones(6)), carried=True)
    motion.between(10.05, measured(np.eye(3), np.zeros(3), TRUE_BIAS))
    motion.observe(10.05, Prediction(g.se3_exp(2 * np.ones(6)), 1e-6 * np.eye(6)), measured=True)
    np.testing.assert_array_equal(gyroscope_of(motion).bias, bias)


def test_it_continues_from_its_state_with_the_same_bits() -> None:
    motion, _ = driven(20, 1)
    other = motion_model()
    restore(other, {name: np.array(array) for name, array in state_of(motion).items()})
    for each in (motion, other):
        given = each.between(DT * 20, measured(np.eye(3), np.zeros(3), TRUE_BIAS))
        assert given is not None
        each.observe(DT * 20, Prediction(np.eye(4), 1e-6 * np.eye(6)), measured=True)
    assert_same_bits(state_of(motion), state_of(other))


def test_a_frame_taken_back_leaves_no_step_to_learn_from() -> None:
    """What follows it has no turn: the camera went on, by no step of the gyroscope's."""
    motion, other = driven(20, 1)[0], driven(20, 1)[0]
    before = state_of(motion)
    motion.between(DT * 20, measured(g.so3_exp(np.full(3, 0.05)), np.zeros(3), TRUE_BIAS))
    restore(motion, before)
    for each in (motion, other):
        each.between(DT * 20, None)
        each.observe(DT * 20, Prediction(np.eye(4), 1e-6 * np.eye(6)), measured=True)
    assert_same_bits(state_of(motion), state_of(other))


# --------------------------------------------------------------------------------------------
# Log and replay


def turning_log(frames: int = 10) -> tuple[MeasurementLog, list[FloatArray]]:
    """A simulated drive of whose steps the turn alone was measured."""
    simulation = simulate(Drive(frames=frames), np.random.default_rng(4))
    log = MeasurementLog(RIG, ConstantVelocityMotion().description())
    for increment in simulation.increments:
        step = increment.odometry
        turn = None if step is None else Odometry.turn(step.motion[:3, :3], 1e-8 * np.eye(3))
        log.append(dataclasses.replace(increment, odometry=turn))
    return log, simulation.poses


def test_a_log_keeps_the_turn_and_no_stand_in(tmp_path: Path) -> None:
    log, _ = turning_log()
    filled = MeasurementLog(RIG, log.motion_model)
    for increment in log:
        step = increment.odometry
        if step is not None:
            moved = step.motion.copy()
            moved[:3, 3] = (1.0, 2.0, 3.0)
            step = Odometry(moved, step.covariance, measured=False, turned=True)
        filled.append(dataclasses.replace(increment, odometry=step))
    filled.save(tmp_path / "log.npz")
    back = MeasurementLog.load(tmp_path / "log.npz")
    for one, other in zip(back, log, strict=True):
        assert (one.odometry is None) == (other.odometry is None)
        if one.odometry is not None:
            assert one.odometry.turned
            assert_same_bits(one.odometry, other.odometry)
        assert one.rig_correction is None


@pytest.mark.parametrize("settings", [LandmarkKalmanSettings(), Isam2Settings()])
def test_estimators_replay_turns(settings: LandmarkKalmanSettings | Isam2Settings) -> None:
    log, poses = turning_log()
    found = replay(log, settings, EgoMotionSettings())
    assert found.failure == ""
    expected = g.inverse(poses[0]) @ np.array(poses)
    errors = np.linalg.norm(found.estimate.trajectory.poses[:, :3, 3] - expected[:, :3, 3], axis=1)
    assert errors.max() < 0.1
