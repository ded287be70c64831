"""Estimators on what a pair with a cylindrical view measures, up to 75 degrees to every side."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from simulated import noisy_odometry_of, observations, play

from fgslam.backend.settings import (
    BatchSettings,
    EkfSettings,
    EstimatorSettings,
    FixedLagSettings,
    Isam2Settings,
    LandmarkKalmanGraphSettings,
    LandmarkKalmanSettings,
    SlidingWindowSettings,
)
from fgslam.backend.smoothers.rig_doubt import shifts
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.cylindrical import as_perspective, view_rays
from fgslam.core.estimates import Estimate
from fgslam.core.measurements import Increment
from fgslam.core.sensors import CameraRig
from fgslam.evaluation.consistency import nees, pose_errors
from fgslam.factors.landmark import StereoFactors
from fgslam.factors.noise import Whitening
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.slam.factory import make_estimator

RIG = CameraRig(
    400, 400, 150.0, 150.0, 199.5, 199.5, 0.2, None, np.eye(4), exact=True, view="cylindrical"
)
SIGMA_PX = np.array([0.3, 0.2, 0.4])
STEP = g.se3_exp(np.array([0.01, 0.04, 0.0, 0.02, 0.0, 0.1]))

ESTIMATORS: dict[str, EstimatorSettings] = {
    "landmark_kalman": LandmarkKalmanSettings(),
    "landmark_kalman_graph": LandmarkKalmanGraphSettings(),
    "ekf": EkfSettings(),
    "isam2": Isam2Settings(noise_factor=1.0),
    "batch": BatchSettings(noise_factor=1.0),
    "fixed_lag": FixedLagSettings(noise_factor=1.0),
    "sliding_window": SlidingWindowSettings(),
}


FILTERS = ("landmark_kalman", "landmark_kalman_graph", "ekf")


def drive(
    seed: int, noise: float, frames: int = 15, count: int = 120
) -> tuple[FloatArray, list[Increment]]:
    """True poses (n, 4, 4), and what is measured of points on all sides, 1 to 5 m away."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(frames - 1):
        poses.append(poses[-1] @ STEP)
    angles = np.radians(rng.uniform(-75.0, 75.0, (2, count)))
    points = view_rays(*angles) * rng.uniform(1.0, 5.0, (count, 1))
    known: set[int] = set()
    increments = []
    for k, wTc in enumerate(poses):
        local = g.transform_to_camera(wTc, points)
        ahead = np.flatnonzero(local[:, 2] > 0.1)
        exact = g.project(RIG, local[ahead])
        inside = ((exact[:, :2] > 0) & (exact[:, :2] < 399)).all(axis=1) & (exact[:, 2] > 2.0)
        ids, exact = ahead[inside], exact[inside]
        measured = exact + noise * SIGMA_PX * rng.standard_normal(exact.shape)
        is_new = np.array([i not in known for i in ids.tolist()])
        known.update(ids.tolist())
        seen = observations(ids, measured, SIGMA_PX, is_new)
        odometry = noisy_odometry_of(STEP, np.repeat([0.02, 0.03], 3), noise, rng) if k else None
        none, kept = np.empty(0, np.int64), np.zeros(len(ids), np.bool_)
        increments.append(Increment(2 * k, 0.5 * k, odometry, seen, kept, none, none))
    return np.array(poses), increments


def estimated(kind: str, increments: list[Increment]) -> Estimate:
    settings = EgoMotionSettings()
    estimator = make_estimator(RIG, ESTIMATORS[kind], settings)
    play(estimator, increments, settings, RIG)
    return estimator.estimate()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ESTIMATORS)
def test_every_estimator_finds_the_truth_as_well_as_it_states(kind: str) -> None:
    """A centimetre or two, although the rim's pixels are thirty of a perspective camera's."""
    found = []
    for seed in range(4):
        poses, increments = drive(seed, noise=1.0)
        estimate = estimated(kind, increments)
        off = pose_errors(estimate.trajectory.poses, poses)
        assert np.abs(off[:, 3:]).max() < 0.02
        found.append(nees(off[5:], estimate.covariances[5:]).values.mean() / 6.0)
    if kind not in FILTERS:  # overconfident on a tenth of such depths in any view
        assert 0.3 < np.mean(found) < 2.5


@pytest.mark.parametrize("kind", ["landmark_kalman_graph", "isam2", "sliding_window"])
def test_without_noise_the_truth_is_found_exactly(kind: str) -> None:
    """A filter with factors, a smoother with factors, one without."""
    poses, increments = drive(seed=7, noise=0.0, frames=4, count=40)
    found = estimated(kind, increments).trajectory.poses
    np.testing.assert_allclose(found, poses, rtol=0, atol=1e-6)


def test_a_factor_weighs_the_cylinder_s_noise() -> None:
    """Of points a little off: the graph's cost is the cylinder's, to first order.

    In the middle and at the rim equal noise of the cylinder differs tenfold in a plane.
    """
    factors = StereoFactors(RIG, Whitening())
    for point in np.array([[[0.1, 0.2, 2.0]], [[2.0, 1.5, 0.6]]]):
        measured = g.project(RIG, point)[0] + [0.01, -0.02, 0.01]
        factor = factors.factor(0, 1, measured, np.diag(SIGMA_PX**2))
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3())
        values.insert(1, point[0])
        off = (g.project(RIG, point)[0] - measured) / SIGMA_PX
        assert 2.0 * factor.error(values) == pytest.approx(off @ off, rel=2e-3)


def test_shifts_are_those_of_the_graph_s_own_measurements() -> None:
    """What a term moves in the cylinder, measured by the perspective camera."""
    rng = np.random.default_rng(3)
    points = view_rays(*np.radians(rng.uniform(-70.0, 70.0, (2, 20)))) * 2.0
    exact = g.project(RIG, points)
    rig = dataclasses.replace(RIG, exact=False)
    planes = as_perspective(RIG, exact)[0]
    found = shifts(rig, planes)
    slopes = as_perspective(RIG, exact)[1]
    in_cylinder = np.linalg.solve(slopes, found)
    # The left camera's columns (the first term) are its principal point: of the disparity alone,
    # and in the middle by the focal length.
    near = np.linalg.norm(exact[:, :2] - 199.5, axis=1).argmin()
    assert in_cylinder[near, 2, 0] == pytest.approx(150.0, rel=0.15)
    assert np.abs(in_cylinder[:, 0, 0]).max() < 1e-9
