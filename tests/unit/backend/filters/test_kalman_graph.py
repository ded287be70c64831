"""The same filter as factor graphs."""

from __future__ import annotations

import dataclasses
from functools import cache

import gtsam
import numpy as np
import pytest
from hypothesis import given, strategies as st
from simulated import (
    RIG,
    Drive,
    observations,
    play,
    points_in_view,
    simulate,
    tracked_at,
)

from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.filters.kalman_graph import LandmarkKalmanGraph
from fgslam.backend.settings import LandmarkKalmanGraphSettings, LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.sensors import Increment
from fgslam.core.types import EgoMotionStatus, LandmarkMap, Prediction, UpdateStats
from fgslam.factors.graphs import landmark_key, pose_key
from fgslam.factors.landmark import StereoFactors
from fgslam.factors.motion import pose_prior
from fgslam.factors.noise import Whitening
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem

SIGMA = np.array([0.3, 0.4, 0.2])
NO_IDS = np.empty(0, np.int64)
EXACT = np.zeros((6, 6))
EPSILON = float(np.finfo(float).eps)
UNCERTAIN = np.diag([0.002, 0.003, 0.001, 0.01, 0.02, 0.015]) ** 2
PLANAR = np.diag([0.0, 0.003, 0.0, 0.01, 0.0, 0.015]) ** 2
DRIVE = Drive(frames=16, points=80, prune_after=3)

Pair = tuple[LandmarkKalman, LandmarkKalmanGraph]


def both(ego_motion: EgoMotionSettings | None = None, **settings: object) -> Pair:
    prior = Prediction(np.eye(4), EXACT)
    ego_motion = ego_motion or EgoMotionSettings()
    return (
        LandmarkKalman(RIG, LandmarkKalmanSettings(**settings), prior, ego_motion),
        LandmarkKalmanGraph(RIG, LandmarkKalmanGraphSettings(**settings), prior, ego_motion),
    )


def frame(k: int, measured: FloatArray, new: bool) -> Increment:
    ids = np.arange(len(measured))
    seen = observations(ids, measured, SIGMA, np.full(len(ids), new))
    return Increment(k, 0.5 * k, None, seen, np.zeros(len(ids), np.bool_), NO_IDS, NO_IDS)


def assert_equal(found: LandmarkMap, expected: LandmarkMap, tolerance: float) -> None:
    """Positions relative to the landmark's distance, covariances relative to their size."""
    np.testing.assert_array_equal(found.ids, expected.ids)
    size = 1.0 + np.linalg.norm(expected.positions, axis=1)
    offset = np.linalg.norm(found.positions - expected.positions, axis=1)
    assert (offset <= tolerance * size).all(), (offset / size).max()
    scale = np.abs(expected.covariances).max(axis=(1, 2))
    change = np.abs(found.covariances - expected.covariances).max(axis=(1, 2))
    assert (change <= tolerance * scale).all(), (change / scale).max()


# --------------------------------------------------------------------------------------------
# One update


def updated(pair: Pair, depths: FloatArray, covariance: FloatArray, seed: int) -> float:
    """Gives both the same first observation and the same second one from a pose nearby.

    Returns the worst condition number of a landmark's covariance in between.
    """
    rng = np.random.default_rng(seed)
    points = points_in_view(RIG, len(depths), (1.0, 2.0), rng)
    points *= (depths / points[:, 2])[:, None]
    wTc = g.se3_exp(np.array([0.02, 0.03, 0.02, 0.03, 0.03, 0.05]) * rng.standard_normal(6))
    noise = SIGMA * np.clip(rng.standard_normal((2, len(depths), 3)), -2.0, 2.0)
    first = RIG.predict(points) + noise[0]
    first[:, 2] = np.maximum(first[:, 2], 0.05)  # the front-end knows no disparity of zero
    second = RIG.predict(g.transform_to_camera(wTc, points)) + noise[1]
    second[:, 2] = np.maximum(second[:, 2], 0.05)
    for estimator in pair:
        start = tracked_at(Prediction(np.eye(4), covariance), 0)
        estimator.update(frame(0, first, True), start)
        condition = np.linalg.cond(estimator.landmarks().covariances).max()
        there = tracked_at(Prediction(wTc, covariance), len(depths))
        estimator.update(frame(1, second, False), there)
    return float(condition)


@given(
    depths=st.lists(st.floats(0.3, 100.0), min_size=1, max_size=8),
    covariance=st.sampled_from([EXACT, UNCERTAIN, PLANAR]),
    update=st.sampled_from(["pixel", "world", "running_mean", "half"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_an_update_is_the_closed_form(
    depths: list[float], covariance: FloatArray, update: str, seed: int
) -> None:
    """Beyond 20 m as far as the condition allows: disparities drown in their noise, ellipsoids
    have conditions of 1e7 and more, and leave many digits fewer of sixteen in either form."""
    closed, graph = both(update=update)
    condition = updated((closed, graph), np.array(depths), covariance, seed)
    rounding = EPSILON * condition if max(depths) > 20.0 else 0.0
    assert_equal(graph.landmarks(), closed.landmarks(), 1e-12 + rounding)


# --------------------------------------------------------------------------------------------
# A whole run

CASES = {
    "default": (EgoMotionSettings(), {}),
    "exact pose": (EgoMotionSettings(), {"pose_covariance": False}),
    "planar": (EgoMotionSettings(dof=3), {}),
    "uniform": (EgoMotionSettings(weighting="uniform", kernel="none"), {}),
    "image alone": (EgoMotionSettings(residuals="image"), {}),
    "capped": (EgoMotionSettings(prior=False, max_correction_m=0.008), {}),
}


@cache
def increments() -> list[Increment]:
    drive = dataclasses.replace(DRIVE, twist=(0.0, 0.03, 0.0, 0.0, 0.0, 0.08))
    return simulate(drive, np.random.default_rng(11)).increments


def run(estimator: LandmarkKalman, ego_motion: EgoMotionSettings) -> list[UpdateStats]:
    return play(estimator, increments(), ego_motion)


@pytest.mark.parametrize("case", CASES)
def test_a_run_is_the_closed_form(case: str) -> None:
    ego_motion, settings = CASES[case]
    closed, graph = both(ego_motion, **settings)
    expected, found = run(closed, ego_motion), run(graph, ego_motion)
    a, b = closed.estimate(), graph.estimate()
    np.testing.assert_allclose(b.trajectory.poses, a.trajectory.poses, rtol=0, atol=1e-9)
    np.testing.assert_allclose(b.covariances, a.covariances, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(b.landmarks.ids, a.landmarks.ids)
    np.testing.assert_allclose(b.landmarks.positions, a.landmarks.positions, rtol=0, atol=1e-9)
    own, others = closed.landmarks().covariances, graph.landmarks().covariances
    scale = np.abs(own).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(others / scale, own / scale, rtol=0, atol=1e-9)
    reported, others = a.landmarks.covariances, b.landmarks.covariances
    scale = np.abs(reported).max(axis=(1, 2), keepdims=True)
    # Samples are kept in single precision.
    np.testing.assert_allclose(others / scale, reported / scale, rtol=0, atol=1e-5)
    assert [s.nis_dof for s in found] == [s.nis_dof for s in expected]
    assert sum(s.nis_dof for s in found) > 300


def test_the_pose_comes_from_the_graph_and_not_from_the_tracking() -> None:
    """A tracking that names its weights but lies about its minimum is found out."""
    increments = simulate(DRIVE, np.random.default_rng(12)).increments[:6]
    _, graph = both()
    play(graph, increments[:5])
    increment = increments[5]
    matched = increment.observations.select(~increment.observations.is_new)
    prediction = graph.predict(increment.odometry)
    solved = EgoMotionSolver(RIG, EgoMotionSettings()).solve(
        prediction, PoseProblem.of(graph.landmarks(), matched)
    )
    assert solved.status is EgoMotionStatus.OK
    lying = dataclasses.replace(solved, wTc=prediction.wTc, covariance=np.eye(6))
    stats = graph.update(increment, lying)
    np.testing.assert_allclose(stats.wTc, solved.wTc, rtol=0, atol=1e-9)
    own = graph.predict(None).covariance
    np.testing.assert_allclose(own, solved.covariance, rtol=0, atol=1e-9)
    assert np.abs(solved.wTc - prediction.wTc).max() > 1e-3


def test_a_new_landmark_at_infinity_is_refused() -> None:
    measured = np.array([[100.0, 100.0, 3.0], [120.0, 80.0, -0.2]])
    _, graph = both()
    with pytest.raises(EstimatorError, match="frame 0: landmark 1 has no positive disp"):
        graph.update(frame(0, measured, True), tracked_at(Prediction(np.eye(4), EXACT), 0))


# --------------------------------------------------------------------------------------------
# What the missing edges cost: the numbers of docs/derivations/filters.md


def standing_still(frames: int) -> tuple[float, float]:
    """Depth deviations (metres) of a landmark seen ``frames`` times from one uncertain pose.

    Returns the filter's, which gives every frame a pose of its own, and the full graph's, in which
    it is one and the same pose.
    """
    point = np.array([0.2, 0.1, 3.0])
    measured = RIG.predict(point[None])
    _, estimator = both()
    for k in range(frames):
        there = tracked_at(Prediction(np.eye(4), UNCERTAIN), min(k, 1))
        estimator.update(frame(k, measured, k == 0), there)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(pose_key(0), gtsam.Pose3())
    values.insert(landmark_key(0), point)
    graph.add(pose_prior(pose_key(0), Prediction(np.eye(4), UNCERTAIN)))
    factors = StereoFactors(RIG, Whitening())
    for _ in range(frames):
        graph.add(factors.factor(pose_key(0), landmark_key(0), measured[0], np.diag(SIGMA**2)))
    marginal = gtsam.Marginals(graph, values).marginalCovariance(landmark_key(0))
    claimed = estimator.landmarks().covariances[0]
    return float(np.sqrt(claimed[2, 2])), float(np.sqrt(marginal[2, 2]))


def test_the_same_pose_error_is_counted_again_in_every_frame() -> None:
    claimed_once, true_once = standing_still(1)
    assert claimed_once == pytest.approx(true_once, rel=1e-9)
    claimed, honest = standing_still(100)
    assert claimed == pytest.approx(0.1 * claimed_once, rel=1e-9)
    # Looking longer does not tell where one stands: the pose's own deviation remains.
    assert honest > np.sqrt(UNCERTAIN[5, 5])
    assert (honest / claimed) ** 2 > 3.0
