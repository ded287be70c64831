"""The range-bearing sensor: its equations, and filter and ego-motion upon it."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import RIG, noisy_odometry_of, play

from fgslam.backend.filters.landmark_kalman import LandmarkKalman
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import EgoMotionStatus, LandmarkMap, Prediction
from fgslam.core.measurements import Increment, Observations
from fgslam.core.planar import wrap
from fgslam.core.sensors import RangeBearingSensor
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem

SENSOR = RangeBearingSensor(8.0, g.BODY_FORWARD_LEFT_UP_FROM_CAMERA)
SIGMA = np.array([0.02, 0.02, 0.03])


@pytest.fixture
def points(rng: np.random.Generator) -> FloatArray:
    """All around the sensor, behind it, too."""
    return rng.uniform(-4.0, 4.0, (300, 3))


def numerical(function: object, at: FloatArray) -> FloatArray:
    """Central differences (n, 3, 3) of a function of (n, 3) rows."""
    step = 1e-6
    columns = [
        (function(at + step * axis) - function(at - step * axis)) / (2 * step)  # type: ignore[operator]
        for axis in np.eye(3)
    ]
    return np.stack(columns, axis=2)


# --------------------------------------------------------------------------------------------
# Equations


@pytest.mark.parametrize(
    ("point", "measured"),
    [
        ([0, 0, 2], [0, 0, 2]),
        ([2, 0, 0], [np.pi / 2, 0, 2]),
        ([-3, 0, 0], [-np.pi / 2, 0, 3]),
        ([0, -1, 1], [0, np.pi / 4, np.sqrt(2)]),
        ([0, 0, -5], [np.pi, 0, 5]),
    ],
)
def test_the_axes_are_as_stated(point: list[float], measured: list[float]) -> None:
    """Azimuth is positive to the right, elevation up; behind is half a turn."""
    found = g.project(SENSOR, np.array([point], np.float64))
    np.testing.assert_allclose(found[0], measured, atol=1e-15)


def test_triangulation_inverts_projection(points: FloatArray) -> None:
    np.testing.assert_allclose(
        g.triangulate(SENSOR, g.project(SENSOR, points)), points, rtol=1e-13, atol=1e-13
    )


def test_jacobians_are_those_of_finite_differences(points: FloatArray) -> None:
    points = points[np.hypot(points[:, 0], points[:, 2]) > 0.3]
    points = points[(points[:, 2] > 0) | (np.abs(points[:, 0]) > 0.1)]  # off the azimuth's jump
    jacobian = g.projection_jacobian(SENSOR, points)
    expected = numerical(lambda p: g.project(SENSOR, p), points)
    np.testing.assert_allclose(jacobian, expected, rtol=1e-6, atol=1e-7)
    measured = g.project(SENSOR, points)
    identity = g.triangulation_covariance(
        SENSOR, measured, np.broadcast_to(np.eye(3), (len(points), 3, 3))
    )
    back = numerical(lambda m: g.triangulate(SENSOR, m), measured)
    np.testing.assert_allclose(identity, back @ np.swapaxes(back, 1, 2), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(
        jacobian @ back, np.broadcast_to(np.eye(3), jacobian.shape), atol=1e-6
    )


def test_only_the_vertical_axis_cannot_be_measured() -> None:
    points = np.array([[0.0, 3.0, 0.0], [0.0, 3.0, 5e-4], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    assert g.in_front(SENSOR, points).tolist() == [False, False, True, True]


def test_differences_of_azimuths_are_wrapped_and_of_columns_are_not() -> None:
    a, b = np.array([[3.1, 0.1, 2.0]]), np.array([[-3.1, 0.2, 1.0]])
    np.testing.assert_allclose(
        g.measurement_difference(SENSOR, a, b), [[6.2 - 2 * np.pi, -0.1, 1.0]]
    )
    np.testing.assert_array_equal(g.measurement_difference(RIG, a, b), a - b)


# --------------------------------------------------------------------------------------------
# A drive among posts


def drive(rng: np.random.Generator, noise: float) -> tuple[FloatArray, FloatArray, list[Increment]]:
    """True poses (n, 4, 4), posts (m, 3) all around, and what is measured of them."""
    posts = np.column_stack([rng.uniform(-5, 5, 12), np.zeros(12), rng.uniform(-5, 5, 12)])
    step = g.se3_exp(np.array([0.0, 0.15, 0.0, 0.0, 0.0, 0.2]))
    poses, increments = [np.eye(4)], []
    for _ in range(39):
        poses.append(poses[-1] @ step)
    known: set[int] = set()
    for k, wTc in enumerate(poses):
        local = g.transform_to_camera(wTc, posts)
        ids = np.flatnonzero(np.linalg.norm(local, axis=1) < 5.0)
        measured = g.project(SENSOR, local[ids]) + noise * SIGMA * rng.standard_normal(
            (len(ids), 3)
        )
        measured[:, 0] = wrap(measured[:, 0])
        is_new = np.array([i not in known for i in ids.tolist()], np.bool_)
        known.update(ids.tolist())
        seen = Observations(
            ids,
            measured,
            np.tile(np.diag(SIGMA**2), (len(ids), 1, 1)),
            np.full((len(ids), 3, 2), np.nan),
            is_new,
        )
        odometry = noisy_odometry_of(step, np.repeat([0.01, 0.02], 3), noise, rng) if k else None
        none = np.empty(0, np.int64)
        rejected = np.zeros(len(ids), np.bool_)
        increments.append(Increment(2 * k, 0.5 * k, odometry, seen, rejected, none, none))
    return np.array(poses), posts, increments


def filtered(increments: list[Increment]) -> LandmarkKalman:
    prior = Prediction(np.eye(4), np.zeros((6, 6)))
    estimator = LandmarkKalman(SENSOR, LandmarkKalmanSettings(), prior)
    play(estimator, increments, EgoMotionSettings(dof=3, min_matches=1), SENSOR)
    return estimator


def test_without_noise_the_filter_finds_the_truth(rng: np.random.Generator) -> None:
    poses, posts, increments = drive(rng, noise=0.0)
    assert any((np.abs(i.observations.measurement[:, 0]) > 3.0).any() for i in increments)
    estimate = filtered(increments).estimate()
    np.testing.assert_allclose(estimate.trajectory.poses, poses, atol=1e-7)
    np.testing.assert_allclose(
        estimate.landmarks.positions, posts[estimate.landmarks.ids], atol=1e-6
    )


def test_the_filter_beats_its_odometry_severalfold(rng: np.random.Generator) -> None:
    poses, _, increments = drive(rng, noise=1.0)
    dead = [np.eye(4)]
    for increment in increments[1:]:
        assert increment.odometry is not None
        dead.append(dead[-1] @ increment.odometry.motion)
    found = filtered(increments).estimate().trajectory.poses
    error = np.linalg.norm(found[:, :3, 3] - poses[:, :3, 3], axis=1)
    alone = np.linalg.norm(np.array(dead)[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert error.max() < 0.12
    assert error.mean() < 0.4 * alone.mean()


def test_wrong_matches_are_rejected_by_their_deviations_alone(rng: np.random.Generator) -> None:
    """An error of 0.9 radians is far below outlier_px; a landmark dead astern is no outlier."""
    _, posts, _ = drive(rng, noise=0.0)
    posts[0] = (0.0, 0.0, -3.0)
    truth = g.se3_exp(np.array([0.0, 0.1, 0.0, 0.1, 0.0, 0.1]))
    measured = g.project(SENSOR, g.transform_to_camera(truth, posts))
    measured[3, 0] += 0.9
    measured[5, 2] += 0.5
    covariance = np.tile(np.diag(SIGMA**2), (12, 1, 1))
    landmarks = LandmarkMap(np.arange(12), posts, np.tile(1e-6 * np.eye(3), (12, 1, 1)))
    seen = Observations(
        np.arange(12), measured, covariance, np.full((12, 3, 2), np.nan), np.zeros(12, np.bool_)
    )
    solver = EgoMotionSolver(SENSOR, EgoMotionSettings(dof=3, outlier_px=0.01))
    prediction = Prediction(np.eye(4), np.diag(np.repeat([0.2, 0.3], 3) ** 2))
    found = solver.solve(prediction, PoseProblem.of(landmarks, seen))
    assert found.status is EgoMotionStatus.OK
    assert np.flatnonzero(~found.inliers).tolist() == [3, 5]
    np.testing.assert_allclose(found.wTc, truth, atol=1e-3)
    assert found.residuals[3] == pytest.approx(0.9, abs=0.01)
