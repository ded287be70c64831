"""Particles of paths with the paper's filters in each."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG, Drive, Simulation, assert_same_bits, simulate, tracked_at

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import EkfSettings, FastSlamSettings, LandmarkKalmanSettings
from fgslam.core.errors import EstimatorError
from fgslam.core.sensors import Increment
from fgslam.core.types import Estimate, UpdateStats
from fgslam.factors.models import Position
from fgslam.slam.build import make_estimator

DRIVE = Drive(frames=12, points=25, odometry_sigma=(5e-3,) * 3 + (2e-2,) * 3)


def drawn(seed: int) -> Simulation:
    return simulate(DRIVE, np.random.default_rng(seed))


def matched(increment: Increment) -> int:
    return int((~increment.observations.is_new).sum())


def step(estimator: Estimator, increment: Increment) -> UpdateStats:
    tracking = tracked_at(estimator.predict(increment.odometry), matched(increment))
    return estimator.update(increment, tracking)


def found(simulation: Simulation, particles: int, seed: int = 0) -> Estimate:
    estimator = make_estimator(RIG, FastSlamSettings(particles=particles, seed=seed))
    for increment in simulation.increments:
        step(estimator, increment)
    return estimator.estimate()


def test_one_particle_has_the_papers_filters_of_landmarks() -> None:
    """At its poses the filter of Se et al. (6.4), poses taken as exact, has the same landmarks."""
    simulation = drawn(1)
    estimator = make_estimator(RIG, FastSlamSettings(particles=1))
    settings = LandmarkKalmanSettings(pose_covariance=False, miss_growth_m=0.0)
    papers = make_estimator(RIG, settings)
    for increment in simulation.increments:
        count = matched(increment)
        stats = step(estimator, increment)
        there = dataclasses.replace(
            tracked_at(papers.predict(increment.odometry), count), wTc=stats.wTc
        )
        papers.update(increment, there)
    ours, theirs = estimator.landmarks(), papers.landmarks()
    assert len(ours) > 15
    np.testing.assert_array_equal(ours.ids, theirs.ids)
    np.testing.assert_allclose(ours.positions, theirs.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours.covariances, theirs.covariances, rtol=1e-9, atol=1e-15)


def test_many_particles_state_an_uncertainty_nearer_to_the_joint_filters() -> None:
    simulation = drawn(2)
    joint = make_estimator(RIG, EkfSettings())
    for increment in simulation.increments:
        step(joint, increment)
    wanted = np.trace(joint.estimate().landmarks.covariances.mean(axis=0))
    one, many = (
        np.trace(found(simulation, n).landmarks.covariances.mean(axis=0)) for n in (1, 100)
    )
    assert one < many < 1.2 * wanted
    assert many - one > 0.3 * (wanted - one)


def test_draws_depend_on_the_seed_alone() -> None:
    simulation = drawn(3)
    first, again, other = (found(simulation, 10, seed) for seed in (0, 0, 1))
    assert_same_bits(first, again)
    assert np.abs(first.trajectory.poses - other.trajectory.poses).max() > 1e-6


def test_a_hard_floor_holds_every_particle() -> None:
    estimator = make_estimator(RIG, FastSlamSettings(particles=10, floor="hard"))
    flat = dataclasses.replace(DRIVE, twist=(0.0, 0.05, 0.0, 0.0, 0.0, 0.1))
    for increment in simulate(flat, np.random.default_rng(4)).increments:
        stats = step(estimator, increment)
        assert abs(stats.wTc[1, 3]) < 1e-12
        np.testing.assert_allclose(stats.wTc[:3, 1], [0.0, 1.0, 0.0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(stats.covariance[4], 0.0, rtol=0, atol=1e-15)


def test_measurements_of_other_sensors_are_refused_in_one_line() -> None:
    estimator = make_estimator(RIG, FastSlamSettings(particles=2))
    first = drawn(1).increments[0]
    other = dataclasses.replace(first, measured=(Position().measured(np.zeros(3), np.eye(3)),))
    with pytest.raises(EstimatorError, match=r"^frame 0: fast_slam takes cameras and odometry"):
        estimator.update(other, tracked_at(estimator.predict(None), 0))
    assert len(estimator.estimate().trajectory) == 0
