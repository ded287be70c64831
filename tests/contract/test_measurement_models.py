"""What holds for every measurement model in every estimator."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from beacons import MODELS, OFFSET_M, SENSOR, Beacons, Direction, drive
from test_estimators import SETTINGS

import fgslam as fg
from fgslam.backend.measured import RelativePoint
from fgslam.backend.settings import BatchSettings, FixedLagSettings, Isam2Settings
from fgslam.backend.smoothers.bundle import PLAIN, Sightings, WholeGraph
from fgslam.backend.smoothers.smoother import Smoother
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, MeasurementLogError
from fgslam.core.geometry import pose, se3_exp
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import CameraRig, Increment, Odometry
from fgslam.core.store import restore, state_of
from fgslam.core.types import Prediction
from fgslam.factors.graphs import landmark_key, nuisance_key, pose_key, solver_parameters
from fgslam.factors.measurement import MeasurementModel, PoseModel, gtsam_factor, linearise
from fgslam.factors.models import Position, Range
from fgslam.slam.build import make_estimator

ESTIMATORS = (
    "landmark_kalman", "ekf", "invariant_ekf", "fixed_lag", "sliding_window", "isam2", "batch",
)  # fmt: skip
EVERY = [*MODELS.values(), RelativePoint(SENSOR)]
KIND = pytest.mark.parametrize("model", EVERY, ids=lambda model: model.kind)


def scene(model: MeasurementModel, rng: np.random.Generator) -> tuple[FloatArray, Any, FloatArray]:
    """A pose, a point in front where there is one, and a measurement off by some noise."""
    wTx = se3_exp(rng.normal(size=6))
    points = (
        None
        if isinstance(model, PoseModel)
        else rng.normal(size=(1, 3)) + np.array([4.0, 1.0, 0.5])
    )
    return wTx, points, 0.1 * rng.normal(size=(1, model.size))


@KIND
def test_derivatives_are_those_of_the_residual(
    model: MeasurementModel, rng: np.random.Generator
) -> None:
    wTx, points, z = scene(model, rng)

    def residual(by: FloatArray) -> FloatArray:
        at = None if points is None else points + by[6:]
        moved = (wTx @ se3_exp(by[:6]))[None]
        return linearise(model, moved, at, z, xTs=model.bTs).residual[0]

    rows = linearise(model, wTx[None], points, z, xTs=model.bTs)
    given = np.hstack([rows.by_pose[0], rows.by_point[0]])
    size = 6 if points is None else 9
    steps = 1e-6 * np.eye(9)[:size]
    numeric = np.array([(residual(s) - residual(-s)) / 2e-6 for s in steps]).T
    np.testing.assert_allclose(given, numeric, rtol=0, atol=1e-8)


@KIND
def test_factor_of_gtsam_is_the_same_residual(
    model: MeasurementModel, rng: np.random.Generator
) -> None:
    wTx, points, z = scene(model, rng)
    keys, values = [pose_key(3)], gtsam.Values()
    values.insert(keys[0], gtsam.Pose3(wTx))
    if points is not None:
        keys.append(landmark_key(5))
        values.insert(keys[1], points[0])
    noise = gtsam.noiseModel.Unit.Create(model.size)
    factor = gtsam_factor(model, keys, z[0], noise, model.bTs)
    matrix, right = factor.linearize(values).jacobian()
    rows = linearise(model, wTx[None], points, z, xTs=model.bTs)
    given = np.hstack([rows.by_pose[0], rows.by_point[0]])
    np.testing.assert_allclose(matrix, given, rtol=0, atol=1e-9)
    np.testing.assert_allclose(-right, rows.residual[0], rtol=0, atol=1e-9)


# --------------------------------------------------------------------------------------------
# Through every estimator


@pytest.fixture(scope="module")
def by_odometry() -> float:
    """Error of a drive by odometry alone, metres."""
    world = drive(())
    return world.ate(fg.replay(world.log, "odometry").estimate)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize(
    "kinds",
    [("range_bearing",), ("direction",), ("position",), ("position", "range")],
    ids=lambda kinds: "+".join(kinds),
)
def test_every_estimator_takes_every_model(
    estimator: str, kinds: tuple[str, ...], by_odometry: float
) -> None:
    world = drive(kinds)
    found = fg.replay(world.log, estimator)
    assert not found.failure
    assert world.ate(found.estimate) < 0.6 * by_odometry
    if kinds != ("position",):
        landmarks = found.estimate.landmarks
        np.testing.assert_array_equal(landmarks.ids, np.arange(8))
        off = np.linalg.norm(landmarks.positions - world.points, axis=1)
        assert np.median(off) < 0.2


def smoothed(world: Beacons, kind: str = "batch") -> Smoother:
    estimator = make_estimator(world.log.rig, SETTINGS[kind])
    assert isinstance(estimator, Smoother)
    fg.replay(world.log, estimator)
    return estimator


@pytest.mark.parametrize(
    "kinds",
    [("range_bearing",), ("guessed_direction", "position"), ("range",), ("range", "offset_range")],
)
def test_batch_ends_at_the_optimum_of_gtsam(kinds: tuple[str, ...]) -> None:
    estimator = smoothed(drive(kinds, frames=24, beacons=4))
    graph, values = estimator.builder.kept_factors(), estimator.solver.values
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values, solver_parameters(100, 1e-12))
    theirs = optimum.optimize()
    found = estimator.estimate().trajectory.poses
    expected = np.array([theirs.atPose3(pose_key(k)).matrix() for k in range(len(found))])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
    assert graph.error(theirs) > 1.0


def test_isam2_takes_linear_factors_for_those_that_call_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ranges with GTSAM's factor, and without: the same tree, up to where it is relinearised."""
    world, online = drive(("range_bearing", "range"), frames=24, beacons=4), []
    for factor in (Range.factor, MeasurementModel.factor):
        monkeypatch.setattr(Range, "factor", factor)
        online.append(fg.replay(world.log, Isam2Settings(update_every=1)).online.poses)
    assert not np.array_equal(*online)
    np.testing.assert_allclose(*online, rtol=0, atol=2e-3)


def test_an_offset_is_found_and_stated_with_its_deviation() -> None:
    """The filter of single landmarks takes it for noise of each measurement."""
    world = drive(("position", "offset_range"), frames=40)
    by_odometry = world.ate(fg.replay(world.log, "odometry").estimate)
    for kind in (*ESTIMATORS, "invariant_ekf"):
        found = fg.replay(world.log, kind)
        assert not found.failure
        assert world.ate(found.estimate) < 0.6 * by_odometry
        (words,) = (one for one in found.estimate.remarks if "nuisance" in one)
        value, deviation = map(float, re.findall(r"\d\.\d+", words))
        assert abs(value - OFFSET_M) < 3.0 * deviation
        assert deviation < (0.5 if kind == "landmark_kalman" else 0.05)
    offset = fg.graph(world.log).values.atVector(nuisance_key("offset_range"))
    np.testing.assert_allclose(offset, [OFFSET_M, 0.0, 0.0], rtol=0.0, atol=0.06)


class ShiftedPoint(RelativePoint):
    """All points are off alike, by two numbers."""

    kind, nuisance = "shifted_point", np.diag([0.3, 0.1])

    def shifts(self, z: FloatArray) -> FloatArray:
        """Ahead, and to the left."""
        return np.tile(np.eye(3)[:, :2], (len(z), 1, 1))


@pytest.mark.parametrize("kind", ["ekf", "fixed_lag"])
def test_filter_and_lag_are_batch_on_a_linear_problem(kind: str, rng: np.random.Generator) -> None:
    """Without turns, of positions and of points that are shifted, in the axes of the world."""
    points, stiff = rng.normal(size=(4, 3)), 1.1e-6
    known, noise = np.diag([stiff**2] * 3 + [0.05**2] * 3), 0.04 * np.eye(3)
    log = MeasurementLog()
    for k in range(8):
        here = k * np.array([0.3, 0.1, 0.0])
        step = pose(np.eye(3), np.array([0.3, 0.1, 0.0]) + 0.002 * rng.normal(size=3))
        seen = points - here + 0.01 * rng.normal(size=(4, 3))
        measured = [
            (ShiftedPoint() if k else RelativePoint()).measured(seen, noise, range(4)),
            Position().measured(here + 0.01 * rng.normal(size=3), noise),
        ]
        odometry = Odometry(step, known) if k else None
        log.append(Increment.of(k, float(k), odometry, measured))
    own = {"ekf": SETTINGS["ekf"], "fixed_lag": FixedLagSettings(lag_frames=3)}[kind]
    settings = (own, BatchSettings(noise_factor=1.0))
    prior = Prediction(np.eye(4), known)
    both = [make_estimator(log.rig, each, prior=prior) for each in settings]
    found, batch = (fg.replay(log, estimator).estimate for estimator in both)
    for a, b in (
        (found.trajectory.poses[-1], batch.trajectory.poses[-1]),
        (found.covariances[-1], batch.covariances[-1]),
        (found.landmarks.positions, batch.landmarks.positions),
        (found.landmarks.covariances, batch.landmarks.covariances),
    ):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


SEEDS = [pytest.param(6, 0.6, 1.5), pytest.param(50, 0.85, 1.2, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("seeds", "low", "high"), SEEDS)
@pytest.mark.parametrize("estimator", ["landmark_kalman", "ekf", "batch"])
def test_covariances_state_the_errors(estimator: str, seeds: int, low: float, high: float) -> None:
    """Poses of a drive err alike: a band of means over worlds, 95 % and more."""
    nees = [
        world.nees(fg.replay(world.log, estimator).estimate)
        for world in (drive(("range_bearing",), seed, frames=20) for seed in range(seeds))
    ]
    assert low < np.mean(nees) < high


@pytest.mark.slow
def test_fixed_lag_states_its_errors_by_range_alone() -> None:
    """Beacons are found over more frames than the lag has, and stay in it."""
    worlds = [drive(("range",), seed, frames=40) for seed in range(50)]
    nees = [world.nees(fg.replay(world.log, "fixed_lag").estimate) for world in worlds]
    assert 0.8 < np.mean(nees) < 1.3
    assert max(nees) < 4.0


def test_a_beacon_is_found_only_where_the_search_reached_a_minimum() -> None:
    """After 13 ranges of this one all 48 searches end on the way, 18 m off at best."""
    log = MeasurementLog()
    for one in drive(("range",), seed=10, frames=80).log.increments[:13]:
        (ranges,) = one.measured
        log.append(replace(one, measured=(ranges.select(ranges.ids == 0),)))
    found = fg.replay(log, "ekf")
    assert not found.failure
    assert not len(found.estimate.landmarks)


def test_a_robot_that_stands_finds_no_beacon_by_its_range() -> None:
    log, ranges = MeasurementLog(), Range().measured([3.0], [[0.01]], [0])
    for k in range(7):
        log.append(Increment.of(k, float(k), Odometry(np.eye(4), 1e-12 * np.eye(6)), [ranges]))
    found = fg.replay(log, "ekf")
    assert not found.failure
    assert not len(found.estimate.landmarks)


@pytest.mark.parametrize("measured", ["direction", "offset_range"])
@pytest.mark.parametrize("kind", ["ekf", "landmark_kalman"])
def test_resumed_with_landmarks_that_wait_continues_to_the_same_bits(
    kind: str, measured: str
) -> None:
    world = drive((measured,), frames=20, beacons=3)
    first, second = (make_estimator(world.log.rig, SETTINGS[kind]) for _ in range(2))
    fg.replay(MeasurementLog(increments=world.log.increments[:3]), first)
    restore(second, state_of(first))
    for estimator in (first, second):
        fg.replay(MeasurementLog(increments=world.log.increments[3:]), estimator)
    a, b = first.estimate(), second.estimate()
    assert len(a.landmarks)
    np.testing.assert_array_equal(a.trajectory.poses, b.trajectory.poses)
    np.testing.assert_array_equal(a.landmarks.positions, b.landmarks.positions)


# --------------------------------------------------------------------------------------------
# Logs, and input that is refused


def test_log_keeps_measurements_and_is_given_their_models(tmp_path: Path) -> None:
    world, path = drive(("direction", "position"), frames=10), tmp_path / "beacons.npz"
    world.log.save(path)
    again = MeasurementLog.load(path, models=MODELS.values())
    a, b = (fg.replay(log, "ekf").estimate for log in (world.log, again))
    np.testing.assert_array_equal(a.trajectory.poses, b.trajectory.poses)
    failure = fg.replay(MeasurementLog.load(path), "ekf").failure
    assert "'direction' without their model; read the log with MeasurementLog.load" in failure


@pytest.mark.parametrize(
    ("values", "covariance", "ids", "words"),
    [
        ([[0.1, 0.2]], np.eye(3), [4], r"values \(1, 2\) with covariance \(3, 3\); give \(k, 2\)"),
        ([[0.1, 0.2]], np.eye(2), [], "give 1 different ids for 1 values"),
        ([[0.1, 0.2]] * 2, np.eye(2), [4, 4], "give 2 different ids"),
        ([[np.nan, 0.2]], np.eye(2), [4], "not finite"),
        ([[0.1, 0.2]], np.diag([1.0, -1.0]), [4], "not positive definite"),
    ],
)
def test_measurements_that_cannot_be_are_refused(
    values: Any, covariance: FloatArray, ids: list[int], words: str
) -> None:
    with pytest.raises(MeasurementLogError, match=words):
        Direction().measured(values, covariance, ids)


def test_a_flat_array_is_that_of_single_numbers() -> None:
    flat = MODELS["range"].measured([1.0, 2.0], 0.01, ids=[3, 4])
    assert (flat.values.shape, flat.covariance.shape) == ((2, 1), (2, 1, 1))
    with pytest.raises(MeasurementLogError, match=r"values \(3,\) .* give \(k, 2\)"):
        Direction().measured([1.0, 2.0, 3.0], np.eye(2), ids=[3])


def test_a_prediction_of_the_wrong_shape_is_refused_where_it_is_measured() -> None:
    class Flat(Range):
        def predict(self, x: FloatArray) -> FloatArray:
            return np.asarray(super().predict(x)[:, 0])

    with pytest.raises(MeasurementLogError, match=r"returned an array \(1,\); return \(k, 1\)"):
        Flat().measured([[1.0]], [[0.01]], ids=[3])


def test_nuisance_parameters_are_few_and_of_landmarks() -> None:
    offset = Position()
    offset.nuisance = np.eye(1)
    with pytest.raises(MeasurementLogError, match="1 nuisance parameters; give at most 0"):
        offset.measured([[0.0, 0.0, 0.0]], np.eye(3))


def test_graph_of_a_log_is_at_the_optimum_and_takes_factors() -> None:
    world = drive(("range_bearing", "position"), frames=12, beacons=4)
    graph, values, poses, landmarks = fg.graph(world.log)
    assert list(poses) == list(range(12))
    assert sorted(landmarks) == list(range(4))
    better = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    assert graph.error(better) == pytest.approx(graph.error(values), rel=1e-6)
    expected = fg.replay(world.log, "batch").estimate.trajectory.poses[-1]
    np.testing.assert_allclose(values.atPose3(poses[11]).matrix(), expected, rtol=0, atol=1e-9)
    with pytest.raises(ConfigError, match="ekf keeps no whole graph; use batch"):
        fg.graph(world.log, "ekf")


def test_stereo_factor_of_a_users_keeps_its_place_on_the_body(rng: np.random.Generator) -> None:
    """Of the left camera here, next to the rig's own."""
    rig = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, None, np.eye(4))
    calibration = gtsam.Cal3_S2Stereo(277.0, 277.0, 0.0, 159.5, 119.5, 0.1)
    values, others = gtsam.Values(), gtsam.NonlinearFactorGraph()
    values.insert(pose_key(0), gtsam.Pose3())
    values.insert(landmark_key(0), np.array([0.1, 0.2, 3.0]))
    noise, seen = gtsam.noiseModel.Isotropic.Sigma(3, 0.3), gtsam.StereoPoint2(170.0, 160.0, 140.0)
    keys = pose_key(0), landmark_key(0)
    others.add(gtsam.GenericStereoFactor3D(seen, noise, *keys, calibration))
    measured, roots = rig.predict(np.array([[0.1, 0.2, 3.1]])), np.eye(3)[None]
    sightings = Sightings(np.array(keys[:1]), np.array(keys[1:]), measured, roots, rig)
    graph, state = WholeGraph.of(others, values, PLAIN, sightings)
    own = 0.5 * float(
        (sightings.at_rows([keys[0]], [keys[1]]).residuals(state.poses, state.points) ** 2).sum()
    )
    assert graph.cost(state) == pytest.approx(others.error(values) + own, rel=1e-12)
