"""The EKF of pose and landmarks."""

from __future__ import annotations

import copy
import dataclasses

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag
from simulated import RIG, Drive, Simulation, assert_same_bits, simulate, tracked_at

from fgslam.backend.filters.ekf import (
    DivergedError,
    FullEkf,
    GrowingCovariance,
    Matches,
    PoseMeasurement,
    correct,
)
from fgslam.backend.settings import EkfSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.store import state_of
from fgslam.core.types import Floor, Prediction, UpdateStats
from fgslam.evaluation.statistics import judge, nees, pose_nees
from fgslam.factors.graphs import landmark_key, pose_key
from fgslam.factors.landmark import StereoFactors
from fgslam.factors.motion import floor_factors, odometry_factor, pose_prior
from fgslam.factors.noise import Whitening

FREE = Floor.under(RIG, 6)
PRIOR = np.diag([1e-3, 2e-3, 1e-3, 3e-3, 2e-3, 4e-3]) ** 2
EXACT = np.zeros((6, 6))
SMALL = Drive(
    frames=16,
    points=25,
    miss_rate=0.1,
    odometry_sigma=(2e-3,) * 3 + (5e-3,) * 3,
    sigma_px=(0.2, 0.2, 0.1),
)


def make(floor: Floor = FREE, prior: FloatArray = EXACT, **settings: object) -> FullEkf:
    return FullEkf(RIG, EkfSettings(**settings), floor, Prediction(np.eye(4), prior))


def drawn(drive: Drive, seed: int) -> Simulation:
    return simulate(drive, np.random.default_rng(seed))


def step(estimator: FullEkf, increment: Increment) -> UpdateStats:
    """One frame, without the front-end's least squares, which the filter does not need."""
    tracking = tracked_at(estimator.predict(increment.odometry), 0)
    return estimator.update(increment, tracking)


# --------------------------------------------------------------------------------------------
# Against the graph


class LinearGraph:
    """The whole run's factors, each linearised by GTSAM where the filter linearised it.

    A pose's variable is its tangent at the prediction, a landmark's its offset as first observed;
    a factor linearised elsewhere has that offset moved to its right-hand side.
    """

    def __init__(self) -> None:
        self.graph = gtsam.GaussianFactorGraph()
        self._factors = StereoFactors(RIG, Whitening())
        self._origin: dict[int, FloatArray] = {}
        self.step = np.zeros(6)
        self.frame = -1

    def add(self, factor, values, offsets: list[FloatArray]) -> None:
        linear = factor.linearize(values)
        a, b = linear.jacobian()
        blocks, start = [], 0
        for key, offset in zip(factor.keys(), offsets, strict=True):
            block = a[:, start : start + len(offset)]
            blocks += [key, block]
            b, start = b + block @ offset, start + len(offset)
        unit = gtsam.noiseModel.Unit.Create(len(b))
        self.graph.add(gtsam.JacobianFactor(*blocks, b, unit))

    def predict(self, before: FloatArray | None, wTc: FloatArray, odometry: Odometry | None):
        self.frame += 1
        values = gtsam.Values()
        values.insert(pose_key(self.frame), gtsam.Pose3(wTc))
        if odometry is None:
            prior = Prediction(wTc, PRIOR)
            self.add(pose_prior(pose_key(self.frame), prior), values, [np.zeros(6)])
        else:
            values.insert(pose_key(self.frame - 1), gtsam.Pose3(before))
            factor = odometry_factor(pose_key(self.frame - 1), pose_key(self.frame), odometry)
            self.add(factor, values, [self.step, np.zeros(6)])

    def observe(self, wTc, offset, identity: int, position, measured, covariance) -> None:
        values = gtsam.Values()
        values.insert(pose_key(self.frame), gtsam.Pose3(wTc))
        values.insert(landmark_key(identity), position)
        keys = pose_key(self.frame), landmark_key(identity)
        factor = self._factors.factor(*keys, measured, covariance)
        origin = self._origin.setdefault(identity, position)
        self.add(factor, values, [offset, position - origin])

    def last(self, ids: list[int]) -> tuple[FloatArray, FloatArray]:
        """Mean and joint covariance of the last pose and the landmarks; the rest is eliminated."""
        past = gtsam.Ordering()
        for k in range(self.frame):
            past.push_back(pose_key(k))
        _, rest = self.graph.eliminatePartialSequential(past)
        order = gtsam.Ordering()
        for key in [pose_key(self.frame), *map(landmark_key, ids)]:
            order.push_back(key)
        information, vector = rest.hessian(order)
        covariance = np.linalg.inv(information)
        origins = [np.zeros(6), *(self._origin[i] for i in ids)]
        return np.concatenate(origins) + covariance @ vector, covariance


def test_filter_is_the_graph_marginalised_at_the_same_linearisation_points() -> None:
    simulation = drawn(SMALL, 1)
    estimator, linear = make(prior=PRIOR, gate_sigmas=0.0), LinearGraph()
    before = None
    for increment in simulation.increments:
        wTc = estimator.predict(increment.odometry).wTc
        linear.predict(before, wTc, increment.odometry)
        known = estimator.landmarks()
        seen = increment.observations
        for i in np.flatnonzero(~seen.is_new).tolist():
            position = known.positions[known.rows(seen.ids[[i]])[0]]
            pick = seen.ids[i].item(), position, seen.measurement[i], seen.covariance[i]
            linear.observe(wTc, np.zeros(6), *pick)
        before = step(estimator, increment).wTc
        linear.step = g.se3_log(g.inverse(wTc) @ before)
        known = estimator.landmarks()
        for i in np.flatnonzero(seen.is_new).tolist():
            position = known.positions[known.rows(seen.ids[[i]])[0]]
            pick = seen.ids[i].item(), position, seen.measurement[i], seen.covariance[i]
            linear.observe(before, linear.step, *pick)
        mean, covariance = linear.last(known.ids.tolist())
        found = np.concatenate([linear.step, known.positions.ravel()])
        np.testing.assert_allclose(found, mean, rtol=0, atol=1e-9)
        # What they share shows in those of the frames that follow.
        estimate = estimator.estimate()
        blocks = block_diag(estimate.covariances[-1], *estimate.landmarks.covariances)
        joint = np.where(
            block_diag(np.ones((6, 6)), *len(known) * [np.ones((3, 3))]), covariance, 0
        )
        sigma = np.sqrt(np.diagonal(covariance))
        np.testing.assert_allclose((blocks - joint) / np.outer(sigma, sigma), 0, rtol=0, atol=1e-7)
    assert len(known) > 15


def random_matches(rng: np.random.Generator, blocks: list[int]) -> Matches:
    k = len(blocks)
    root = rng.standard_normal((k, 3, 3))
    return Matches(
        np.array(blocks, np.int64),
        rng.standard_normal((k, 3)),
        rng.standard_normal((k, 3, 6)),
        rng.standard_normal((k, 3, 3)),
        root @ root.swapaxes(1, 2) + np.eye(3),
    )


def grown(p: FloatArray) -> GrowingCovariance:
    out = GrowingCovariance(p[:6, :6])
    for start in range(6, len(p), 6):
        stop = min(start + 6, len(p))
        out.append(p[:start, start:stop], p[start:stop, start:stop])
    return out


def whole(covariance: GrowingCovariance) -> FloatArray:
    return covariance.columns(np.arange(6 + 3 * covariance.blocks))


def test_uninitialised_memory_does_not_matter(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """Above the diagonal nothing is ever read, but a slab's update touches it (and may warn)."""

    def soiled(shape: int | tuple[int, ...]) -> FloatArray:
        return np.full(shape, 0x7FF0000000000001, np.uint64).view(np.float64)  # signalling NaNs

    root, a, b = rng.standard_normal((66, 66)), *rng.standard_normal((2, 66, 5))
    p = root @ root.T
    with monkeypatch.context() as patch:
        patch.setattr(np, "empty", soiled)
        covariance = grown(p)
    covariance.subtract(a, b)
    np.testing.assert_allclose(whole(covariance), p - a @ b.T - b @ a.T, rtol=0, atol=1e-11)


@pytest.mark.parametrize("landmarks", [0, 3, 150])
def test_a_correction_is_the_dense_kalman_filter(landmarks: int, rng: np.random.Generator) -> None:
    """Information form, dense, on random linear measurements of pose and landmarks."""
    n = 6 + 3 * landmarks
    root = rng.standard_normal((n, n))
    p = root @ root.T / n + np.eye(n)
    blocks = list(range(0, landmarks, 2))
    matches = random_matches(rng, blocks)
    floor = PoseMeasurement(rng.standard_normal(2), rng.standard_normal((2, 6)), np.array([1, 2]))
    covariance = grown(p)
    found = correct(covariance, covariance.front(), matches, floor, 0.0)
    h = np.zeros((3 * len(blocks) + 2, n))
    r = np.zeros((len(h), len(h)))
    for i, block in enumerate(blocks):
        at = slice(3 * i, 3 * i + 3)
        h[at, :6], h[at, 6 + 3 * block : 9 + 3 * block] = matches.by_pose[i], matches.by_landmark[i]
        r[at, at] = matches.noise[i]
    h[-2:, :6], r[-2:, -2:] = floor.jacobian, np.diag(floor.variance)
    innovation = np.concatenate([matches.innovation.ravel(), floor.innovation])
    after = np.linalg.inv(np.linalg.inv(p) + h.T @ np.linalg.solve(r, h))
    covariance.subtract(found.gain, found.half)
    np.testing.assert_allclose(whole(covariance), after, rtol=0, atol=1e-10)
    expected = after @ h.T @ np.linalg.solve(r, innovation)
    np.testing.assert_allclose(found.step, expected, rtol=0, atol=1e-9)
    if blocks:
        s = (h @ p @ h.T + r)[:-2, :-2]
        nis = innovation[:-2] @ np.linalg.solve(s, innovation[:-2])
        assert found.nis == pytest.approx(nis, rel=1e-9)
        assert found.nis_dof == 3 * len(blocks)


def test_the_triangle_behaves_as_the_whole_matrix(rng: np.random.Generator) -> None:
    root = rng.standard_normal((306, 306))
    p = root @ root.T
    covariance = grown(p)
    np.testing.assert_array_equal(whole(covariance), np.tril(p) + np.tril(p, -1).T)
    index = rng.permutation(306)[:40]
    np.testing.assert_array_equal(covariance.columns(index), whole(covariance)[:, index])
    gone = np.array([0, 7, 50, 98, 99])
    number = covariance.drop(gone)
    assert sorted(number.tolist()) == sorted(set(range(100)) - set(gone.tolist()))
    rows = np.concatenate([np.arange(6), (6 + 3 * number[:, None] + np.arange(3)).ravel()])
    kept = (np.tril(p) + np.tril(p, -1).T)[np.ix_(rows, rows)]
    np.testing.assert_array_equal(whole(covariance), kept)
    np.testing.assert_array_equal(covariance.diagonal_blocks(np.array([3]))[0], kept[15:18, 15:18])
    again = GrowingCovariance.unpacked(covariance.packed())
    np.testing.assert_array_equal(whole(again), kept)


# --------------------------------------------------------------------------------------------
# Does the covariance tell the truth, and does it stay a covariance


def test_pose_and_landmarks_are_consistent_over_20_drives() -> None:
    drive = dataclasses.replace(SMALL, points=40)
    poses, landmarks, innovations = [], [], []
    for seed in range(20):
        simulation = drawn(drive, 100 + seed)
        estimator = make()
        stats = [step(estimator, increment) for increment in simulation.increments]
        found = estimator.estimate()
        truth = simulation.points_by_id[found.landmarks.ids]
        poses.append(
            pose_nees(found.trajectory.poses[1:], found.covariances[1:], simulation.poses[1:])
        )
        landmarks.append(nees(truth - found.landmarks.positions, found.landmarks.covariances))
        innovations += [s.nis / s.nis_dof for s in stats if s.nis_dof]
    for runs in (poses, landmarks):
        verdict = judge(runs)
        assert verdict is not None
        assert verdict.verdict == "consistent", verdict
    assert np.mean(innovations) == pytest.approx(1.0, abs=0.05)


def test_covariance_stays_positive_over_300_frames() -> None:
    drive = dataclasses.replace(SMALL, frames=300, points=20, prune_after=3, depth_m=(1.0, 3.0))
    turning = dataclasses.replace(drive, twist=(0.0, 0.02, 0.0, 0.0, 0.0, 0.01))
    estimator = make()
    for increment in drawn(turning, 2).increments:
        step(estimator, increment)
    found = estimator.estimate()
    for covariances in (found.covariances[1:], found.landmarks.covariances):
        np.testing.assert_array_equal(covariances, np.swapaxes(covariances, 1, 2))
        sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
        correlation = covariances / (sigma[:, :, None] * sigma[:, None, :])
        assert np.linalg.eigvalsh(correlation).min() > 1e-9


# --------------------------------------------------------------------------------------------
# The map


def test_pruning_a_landmark_leaves_the_others_unchanged() -> None:
    simulation = drawn(SMALL, 3)
    kept, pruned = make(prior=PRIOR), make(prior=PRIOR)
    for increment in simulation.increments[:6]:
        step(kept, increment)
        step(pruned, increment)
    ids = kept.landmarks().ids
    gone = ids[[0, 3, 4, len(ids) - 1]]
    nothing = np.empty(0, np.int64)
    blind = dataclasses.replace(
        simulation.increments[6], observations=simulation.increments[6].observations.select(nothing)
    )
    step(kept, dataclasses.replace(blind, pruned_ids=nothing))
    step(pruned, dataclasses.replace(blind, pruned_ids=gone))
    rest = np.setdiff1d(ids, gone)
    np.testing.assert_array_equal(pruned.landmarks().ids, rest)
    rows = kept.landmarks().rows(rest)
    np.testing.assert_array_equal(pruned.landmarks().positions, kept.landmarks().positions[rows])
    found, expected = (one.landmarks().covariances for one in (pruned, kept))
    np.testing.assert_array_equal(found, expected[rows])
    seen = simulation.increments[7].observations
    after = dataclasses.replace(
        simulation.increments[7],
        observations=seen.select(np.isin(seen.ids, rest)),
        pruned_ids=nothing,
    )
    covariances = [step(one, after).covariance for one in (pruned, kept)]
    np.testing.assert_allclose(*covariances, rtol=0.0, atol=1e-15)


def test_too_many_landmarks_are_refused_and_change_nothing() -> None:
    simulation = drawn(SMALL, 4)
    counts = np.cumsum([int(i.observations.is_new.sum()) for i in simulation.increments])
    limit = int(counts[2])
    estimator = make(max_landmarks=limit)
    accepted = int(np.flatnonzero(counts <= limit).max()) + 1
    for increment in simulation.increments[:accepted]:
        step(estimator, increment)
    before = copy.deepcopy(state_of(estimator))
    with pytest.raises(EstimatorError, match=r"frame \d+: \d+ landmarks exceed max_landmarks") as e:
        step(estimator, simulation.increments[accepted])
    assert "GB" in str(e.value)
    assert "isam2" in str(e.value)
    assert "\n" not in str(e.value)
    assert_same_bits(state_of(estimator), before)


def test_wrong_matches_are_left_out_with_a_remark() -> None:
    simulation = drawn(SMALL, 5)
    clean, spoilt = make(), make()
    for increment in simulation.increments[:5]:
        step(clean, increment)
        step(spoilt, increment)
    increment = simulation.increments[5]
    old = np.flatnonzero(~increment.observations.is_new)[:3]
    measurement = increment.observations.measurement.copy()
    measurement[old] += [8.0, -7.0, 1.0]
    wrong = dataclasses.replace(increment.observations, measurement=measurement)
    others = np.setdiff1d(np.arange(len(wrong)), old)
    kept = dataclasses.replace(increment, observations=increment.observations.select(others))
    a = step(clean, kept)
    b = step(spoilt, dataclasses.replace(increment, observations=wrong))
    np.testing.assert_allclose(b.wTc, a.wTc, rtol=0, atol=1e-12)
    assert b.nis_dof == a.nis_dof
    assert any(r.startswith("3 of ") for r in spoilt.estimate().remarks)
    (unknown,) = clean.estimate().remarks
    assert unknown.startswith("covariances of motions are not known")


def test_unknown_landmarks_and_those_behind_are_skipped() -> None:
    simulation = drawn(SMALL, 6)
    first = simulation.increments[0]
    measurement = first.observations.measurement.copy()
    measurement[0, 2] = 0.0
    estimator = make()
    far = dataclasses.replace(first.observations, measurement=measurement)
    step(estimator, dataclasses.replace(first, observations=far))
    np.testing.assert_array_equal(estimator.landmarks().ids, far.ids[1:])
    step(estimator, simulation.increments[1])
    turned = Odometry(g.se3_exp(np.array([0, np.pi, 0, 0, 0, 0.0])), 1e-6 * np.eye(6))
    nothing_new = simulation.increments[2].observations
    nothing_new = nothing_new.select(~nothing_new.is_new)
    around = dataclasses.replace(
        simulation.increments[2], odometry=turned, observations=nothing_new
    )
    stats = step(estimator, around)
    assert stats.nis_dof == 0
    assert any("behind" in remark for remark in estimator.estimate().remarks)


# --------------------------------------------------------------------------------------------
# When it fails


@pytest.mark.parametrize("kind", ["odometry", "measurement", "negative", "noise"])
def test_failed_update_names_the_frame_and_changes_nothing(kind: str) -> None:
    simulation = drawn(SMALL, 7)
    estimator = make()
    for increment in simulation.increments[:4]:
        step(estimator, increment)
    increment = simulation.increments[4]
    odometry, seen = increment.odometry, increment.observations
    assert odometry is not None
    if kind == "odometry":
        odometry = Odometry(np.full((4, 4), np.nan), odometry.covariance)
    elif kind == "negative":
        odometry = Odometry(odometry.motion, -odometry.covariance)
    elif kind == "noise":
        seen = dataclasses.replace(seen, covariance=-10.0 * np.ones((len(seen), 3, 3)))
    else:
        measurement = seen.measurement.copy()
        measurement[1, 1] = np.inf
        seen = dataclasses.replace(seen, measurement=measurement)
    before = copy.deepcopy(state_of(estimator))
    tracking = tracked_at(estimator.predict(increment.odometry), 0)
    bad = dataclasses.replace(increment, odometry=odometry, observations=seen)
    with pytest.raises(EstimatorError, match=f"frame {increment.index}: ") as caught:
        estimator.update(bad, tracking)
    assert "\n" not in str(caught.value)
    assert_same_bits(state_of(estimator), before)
    step(estimator, increment)
    assert np.isfinite(estimator.estimate().trajectory.poses).all()


def test_a_covariance_that_would_lose_its_definiteness_is_refused(
    rng: np.random.Generator,
) -> None:
    p = np.eye(12)
    p[6:9, 6:9] = -np.eye(3)
    nothing = PoseMeasurement(np.empty(0), np.empty((0, 6)), np.empty(0))
    with pytest.raises(DivergedError, match="landmark's covariance is not positive"):
        correct(grown(p), grown(p).front(), random_matches(rng, [1]), nothing, 0.0)


# --------------------------------------------------------------------------------------------
# The floor


def floor(dof: int, hard: bool) -> Floor:
    under = Floor.under(RIG, dof)
    return dataclasses.replace(under, hard=hard, height_sigma_m=0.002, tilt_sigma_rad=0.002)


@pytest.mark.parametrize("dof", [3, 5])
def test_a_hard_floor_holds_exactly(dof: int) -> None:
    drive = dataclasses.replace(SMALL, twist=(0.0, 0.03, 0.0, 0.0, 0.0, 0.08))
    simulation = drawn(drive, 8)
    ground = floor(dof, hard=True)
    estimator = make(ground, PRIOR)
    for increment in simulation.increments:
        predicted = estimator.predict(increment.odometry)
        stats = step(estimator, increment)
        for wTc, covariance in [
            (predicted.wTc, predicted.covariance),
            (stats.wTc, stats.covariance),
        ]:
            np.testing.assert_allclose(ground.constrain(wTc), wTc, rtol=0, atol=1e-12)
            assert np.linalg.matrix_rank(covariance, hermitian=True, tol=1e-14) == dof
            allowed = ground.allowed_part(wTc, covariance)
            np.testing.assert_allclose(allowed, covariance, rtol=0, atol=1e-15)
    error = stats.wTc[:3, 3] - simulation.poses[-1][:3, 3]
    assert np.linalg.norm(error) < 0.02


@pytest.mark.parametrize("dof", [3, 5])
def test_a_soft_floor_is_what_the_graphs_factors_say(dof: int, rng: np.random.Generator) -> None:
    ground = floor(dof, hard=False)
    for _ in range(10):
        wTc = g.se3_exp(np.array([0.05, 0.8, 0.05, 0.3, 0.05, 0.5]) * rng.standard_normal(6))
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3(wTc))
        information, vector = np.zeros((6, 6)), np.zeros(6)
        for factor in floor_factors(0, ground, wTc):
            a, b = factor.linearize(values).jacobian()
            information, vector = information + a.T @ a, vector + a.T @ b
        found = PoseMeasurement.of_floor(ground, wTc)
        weighted = found.jacobian.T / found.variance
        scale = np.abs(information).max()
        np.testing.assert_allclose(
            weighted @ found.jacobian, information, rtol=0, atol=1e-7 * scale
        )
        np.testing.assert_allclose(weighted @ found.innovation, vector, rtol=0, atol=1e-7 * scale)
