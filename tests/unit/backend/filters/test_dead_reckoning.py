"""Odometry alone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG, Drive, Simulation, play, play_directly, simulate, tracked_at

from fgslam.backend.filters.dead_reckoning import DeadReckoning
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.types import Prediction
from fgslam.evaluation.statistics import judge, nees, pose_nees

DRIVE = Drive(frames=10, points=60, odometry_sigma=(1e-3,) * 3 + (2e-3,) * 3)
PRIOR = np.diag([1e-3, 2e-3, 1e-3, 3e-3, 2e-3, 4e-3]) ** 2
NO_PRIOR = np.zeros((6, 6))


def at(covariance: FloatArray) -> DeadReckoning:
    return DeadReckoning(RIG, Prediction(np.eye(4), covariance))


def drawn(seed: int) -> Simulation:
    return simulate(DRIVE, np.random.default_rng(seed))


def test_the_covariance_is_that_of_many_drawn_drives() -> None:
    """200 drives: NEES of the last pose, which all of them share the truth of."""
    errors = []
    estimator = at(NO_PRIOR)
    for seed in range(200):
        simulation = simulate(
            dataclasses.replace(DRIVE, points=1, frames=8), np.random.default_rng(seed)
        )
        estimator = at(NO_PRIOR)
        play(estimator, simulation.increments)
        estimate = estimator.estimate()
        errors.append(
            pose_nees(
                estimate.trajectory.poses[-1:], estimate.covariances[-1:], simulation.poses[-1:]
            )
        )
    found = judge(errors)
    assert found is not None
    assert found.verdict == "consistent", found


@pytest.mark.slow
def test_covariances_of_landmarks_are_those_of_many_drawn_drives() -> None:
    """The newest of each drive: the errors of all poses before it must be in it."""
    drive = dataclasses.replace(DRIVE, points=12, miss_rate=0.0, sigma_px=(0.05, 0.05, 0.02))
    found = []
    for seed in range(120):
        rng = np.random.default_rng(1000)  # the points
        simulation = simulate(dataclasses.replace(drive, noise=0.0), rng)
        rng = np.random.default_rng(seed)
        noisy = [
            dataclasses.replace(
                increment,
                odometry=increment.odometry
                and dataclasses.replace(
                    increment.odometry,
                    motion=increment.odometry.motion
                    @ g.se3_exp(np.array(drive.odometry_sigma) * rng.standard_normal(6)),
                ),
                observations=dataclasses.replace(
                    increment.observations,
                    measurement=increment.observations.measurement
                    + np.array(drive.sigma_px)
                    * rng.standard_normal(increment.observations.measurement.shape),
                ),
            )
            for increment in simulation.increments
        ]
        estimator = at(NO_PRIOR)
        play_directly(estimator, noisy)
        known = estimator.estimate().landmarks
        off = simulation.points_by_id[known.ids[-1]] - known.positions[-1]
        found.append(nees(off[None], known.covariances[-1:]))
    verdict = judge(found)
    assert verdict is not None
    assert verdict.verdict == "consistent", verdict


def test_landmarks_stay_where_they_were_first_seen_until_pruned() -> None:
    simulation = simulate(
        dataclasses.replace(DRIVE, prune_after=1, miss_rate=0.3), np.random.default_rng(3)
    )
    estimator = at(NO_PRIOR)
    first: dict[int, FloatArray] = {}
    gone = 0
    for increment in simulation.increments:
        play(estimator, [increment])
        landmarks = estimator.landmarks()
        for identity, position in zip(landmarks.ids.tolist(), landmarks.positions, strict=True):
            np.testing.assert_array_equal(first.setdefault(identity, position), position)
        assert not np.isin(increment.pruned_ids, landmarks.ids).any()
        gone += len(increment.pruned_ids)
    assert gone > 5


def test_a_point_at_infinity_is_no_landmark() -> None:
    increment = drawn(5).increments[0]
    measurement = increment.observations.measurement.copy()
    measurement[0, 2], measurement[1, 2] = 0.0, -0.4
    seen = dataclasses.replace(increment.observations, measurement=measurement)
    estimator = at(NO_PRIOR)
    play(estimator, [dataclasses.replace(increment, observations=seen)])
    np.testing.assert_array_equal(estimator.landmarks().ids, seen.ids[2:])
    assert np.isfinite(estimator.landmarks().positions).all()


def test_a_frame_without_any_motion_is_refused_and_changes_nothing() -> None:
    increments = drawn(6).increments
    estimator = at(NO_PRIOR)
    play(estimator, increments[:3])
    blind = dataclasses.replace(increments[3], odometry=None)
    prediction = estimator.predict(None)
    with pytest.raises(EstimatorError, match="frame 6: neither odometry nor"):
        estimator.update(blind, tracked_at(prediction, 0))
    assert len(estimator.estimate().trajectory) == 3
