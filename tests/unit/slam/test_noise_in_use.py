"""The noise that frames are estimated with, as it is shown."""

from __future__ import annotations

import math

import numpy as np
import pytest
from simulated import RIG, Drive, simulate

from fgslam.backend.settings import EstimatorSettings, Isam2Settings, LandmarkKalmanSettings
from fgslam.core.geometry import se3_exp
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Odometry
from fgslam.core.types import Prediction
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import MatchNoise
from fgslam.slam.build import make_estimator
from fgslam.slam.motion import ConstantVelocityMotion, OdometryMotion
from fgslam.slam.pipeline import FrameNoise, noise_in_use
from fgslam.slam.replay import Replay, replay

FILTER = make_estimator(RIG, LandmarkKalmanSettings())
TURN = Odometry.turn(np.eye(3), 1e-6 * np.eye(3))
MEASURED = Odometry(np.eye(4), 1e-6 * np.eye(6))


def moving() -> ConstantVelocityMotion:
    """After a step of two frames, whose noise is still that of the start."""
    motion = ConstantVelocityMotion()
    for k in range(2):
        pose = Prediction(se3_exp(k * np.full(6, 0.01)), 1e-8 * np.eye(6))
        motion.observe(float(k), pose, measured=True)
    return motion


def test_a_guessed_step_shows_the_acceleration_in_its_own_units() -> None:
    motion = moving()
    found = noise_in_use(motion, motion.between(2.0), MatchNoise(), FILTER)
    assert found.rotation_sigma_dps2 == pytest.approx(100.0)
    assert found.translation_sigma_mps2 == pytest.approx(3.0)
    assert found.match_factor == 1.0
    assert math.isnan(found.gyroscope_factor)
    assert math.isnan(found.single_factor)
    assert math.isnan(found.correlated_factor)


def test_noise_that_a_frame_did_not_use_is_unknown() -> None:
    motion = OdometryMotion(np.eye(4), "recorded", moving())
    nothing = noise_in_use(motion, None, MatchNoise(), FILTER)
    measured = noise_in_use(motion, MEASURED, MatchNoise(), FILTER)
    for first in (nothing, measured):
        assert np.isnan(first[:3]).all()
    turned = noise_in_use(motion, TURN, MatchNoise(), FILTER)
    assert math.isnan(turned.rotation_sigma_dps2)
    assert turned.translation_sigma_mps2 == pytest.approx(3.0)
    assert turned.gyroscope_factor == 1.0


def replayed(settings: EstimatorSettings, noise: float) -> Replay:
    """A drive without odometry, whose measurements are ``noise`` times as bad as stated."""
    simulation = simulate(Drive(frames=40, noise=noise), np.random.default_rng(1))
    log = MeasurementLog(RIG, {"kind": "constant_velocity"}, [])
    for increment in simulation.increments:
        log.append(increment)
    return replay(log, settings, EgoMotionSettings())


def test_matches_and_graph_show_that_measurements_are_worse_than_stated() -> None:
    found = replayed(Isam2Settings(), 3.0).noise
    assert len(found) == 40
    assert found[0] == pytest.approx(
        FrameNoise(match_factor=1, single_factor=1, correlated_factor=1), nan_ok=True
    )
    last = found[-1]
    assert 2.0 < last.match_factor < 4.0
    assert 2.0 < last.single_factor < 4.5
    assert last.correlated_factor > 2.0


def test_a_stated_factor_is_shown_as_it_is() -> None:
    found = replayed(Isam2Settings(noise_factor=2.5), 1.0).noise
    assert {(row.single_factor, row.correlated_factor) for row in found} == {(1.0, 2.5)}
