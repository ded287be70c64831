"""The noise of matches that the frames of a drive tell, where it is not what was stated."""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.backend.persistence import Persistence, learn_from
from fgslam.backend.settings import BatchSettings, LandmarkKalmanSettings
from fgslam.core.log import MeasurementLog
from fgslam.core.store import restore, state_of
from fgslam.core.types import EgoMotion, EgoMotionStatus, Prediction
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, MatchNoise, unmeasured
from fgslam.slam.build import make_estimator
from fgslam.slam.replay import replay, replay_frame, replay_motion
from fgslam.worlds.settings import (
    DetectionSettings,
    MeasurementDriveSettings,
    SimulatedMeasurementsSettings,
)

PLANAR = EgoMotionSettings(dof=3)


def noisy_drive(frames: int) -> MeasurementLog:
    """Without odometry, noise of four times the stated deviation."""
    world = SimulatedMeasurementsSettings(
        stop=frames,
        drive=MeasurementDriveSettings(frames=249),
        detection=DetectionSettings(noise_scale=4.0),
    )
    return open_measurements(world, 1, ConstantVelocitySettings()).log


def told(noise: MatchNoise, *misfits: float) -> float:
    nothing = np.empty(0)
    for misfit in misfits:
        status = EgoMotionStatus.OK
        frame = EgoMotion(np.eye(4), np.eye(6), nothing.astype(bool), nothing, status, 1)
        noise.learn(dataclasses.replace(frame, misfit=misfit))
    return noise.variance


def test_three_frames_contradict_the_stated_noise_and_a_stretch_of_wrong_matches_does_not() -> None:
    assert told(MatchNoise(), 16.0, 17.0) == 1.0
    assert told(MatchNoise(), 16.0, 17.0, 18.0) == 16.0
    assert told(MatchNoise(), *[0.1] * 9) == 1.0
    assert told(MatchNoise(), *[1.9] * 9) == 1.0  # the stated noise may well be true
    assert told(MatchNoise(), *[1.0] * 20, *[50.0] * 14) == 1.0
    assert told(MatchNoise(), *[9.0] * 40, *[50.0] * 14) == 9.0
    assert told(MatchNoise(), np.nan, np.nan, np.nan, np.nan) == 1.0


def test_a_drive_four_times_as_noisy_as_stated_is_tracked_by_its_matches() -> None:
    """By the stated noise a third of the frames find too few, and 7 % of the matches count."""
    played = replay(noisy_drive(40), LandmarkKalmanSettings(), PLANAR)
    assert (played.column("status")[1:] == "ok").all()
    assert played.column("inliers")[10:].sum() > 0.9 * played.column("matched")[10:].sum()


def test_a_drive_goes_on_from_a_state_as_it_would_have() -> None:
    log = noisy_drive(18)
    whole, motion = make_estimator(log.rig, BatchSettings(), PLANAR), replay_motion(log)
    again, solver = (
        make_estimator(log.rig, BatchSettings(), PLANAR),
        EgoMotionSolver(log.rig, PLANAR),
    )
    for k, increment in enumerate(log):
        if k == 12:
            restore(again, state_of(whole))
            other, other_motion = EgoMotionSolver(log.rig, PLANAR), replay_motion(log)
            restore(other.noise, state_of(solver.noise))
            restore(other_motion, state_of(motion))
        found = replay_frame(increment, whole, solver, motion, k)
        if k >= 12:
            same = replay_frame(increment, again, other, other_motion, k)
            assert found.tracking.noise == same.tracking.noise > 8.0
            assert np.array_equal(found.stats.covariance, same.stats.covariance)
    assert np.array_equal(whole.estimate().covariances, again.estimate().covariances)


def test_a_frame_whose_pose_is_only_predicted_says_nothing_of_the_noise() -> None:
    """Nor does it have a graph weigh its matches by the stated noise again."""
    log = noisy_drive(7)
    noise = Persistence(log.rig)
    for k, increment in enumerate(log):
        tracking = unmeasured(Prediction(np.eye(4), np.eye(6)), EgoMotionStatus.TOO_FEW_MATCHES)
        fresh = increment.observations.select(increment.observations.is_new)
        if k == 3:
            status = EgoMotionStatus.OK
            tracking = dataclasses.replace(tracking, status=status, noise=16.0)
        seen = dataclasses.replace(increment, observations=fresh)
        learn_from(noise, k, seen, tracking, np.eye(4))
        assert noise.power == (1.0 if k < 3 else 16.0)
