"""The paper's filter, one 3x3 Kalman filter a landmark (Se et al. 6.4)."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
from scipy import stats
from simulated import (
    RIG,
    Drive,
    Simulation,
    arrays_of,
    assert_same_bits,
    observations,
    play,
    points_in_view,
    simulate,
    tracked_at,
)

from fgslam.backend.filters.kalman import LandmarkKalman, LandmarkRows
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.types import EgoMotionStatus, LandmarkMap, Prediction
from fgslam.frontend.tracking.ego_motion import unmeasured

# ------------------------------------------------------------------------------------------
# Rows of landmarks against a plain dictionary of them


def fill(rows: LandmarkRows, ids: IntArray, rng: np.random.Generator, home: int) -> None:
    rows.add(ids, rng.standard_normal((len(ids), 3)), rng.standard_normal((len(ids), 3, 3)), home)


def test_rows_hold_the_landmarks_added_and_not_removed(rng: np.random.Generator) -> None:
    rows, known = LandmarkRows(), {}
    for step in range(60):
        some = rng.choice(5000, size=rng.integers(0, 90), replace=False)
        new = np.sort(some[~np.isin(some, list(known))]) if step % 3 else some
        new = new[~np.isin(new, list(known))]
        fill(rows, new, rng, step)
        for i in new.tolist():
            row = rows.rows(np.array([i]))[0]
            known[i] = (rows.positions[row].copy(), rows.covariances[row].copy(), step)
        gone = rng.permutation(list(known))[: rng.integers(0, 40)].astype(np.int64)
        rows.remove(gone)
        for i in gone.tolist():
            del known[i]
        ids = sorted(known)
        assert rows.ids.tolist() == ids
        assert len(rows) == len(ids)
        for array, at in ((rows.positions, 0), (rows.covariances, 1), (rows.homes, 2)):
            expected = np.array([known[i][at] for i in ids])
            np.testing.assert_array_equal(array, expected.reshape(array.shape))
    assert len(rows) > 1024  # it has grown
    assert (rows.counts == 1).all()


def test_loading_copies(rng: np.random.Generator) -> None:
    given = LandmarkMap(
        np.array([2, 5]), rng.standard_normal((2, 3)), rng.standard_normal((2, 3, 3))
    )
    before = given.positions.copy()
    rows = LandmarkRows()
    fill(rows, np.array([1, 2, 3]), rng, 0)
    rows.load(given, np.array([4, 6]), np.array([-1, 9]), np.array([3, 9]))
    rows.positions[:] = 0.0
    np.testing.assert_array_equal(given.positions, before)
    assert rows.ids.tolist() == [2, 5]
    assert rows.counts.tolist() == [4, 6]
    assert rows.homes.tolist() == [-1, 9]


# ------------------------------------------------------------------------------------------
# The per-landmark Kalman filter (Se et al. 4.1, 6.4)


SIGMA = np.array([0.3, 0.4, 0.2])
NO_IDS = np.empty(0, np.int64)
EXACT = np.zeros((6, 6))
UNCERTAIN = np.diag([0.002, 0.003, 0.001, 0.01, 0.02, 0.015]) ** 2
UPDATES = ("pixel", "world", "running_mean", "half")


def make(prior: FloatArray | None = None, **settings: object) -> LandmarkKalman:
    wTc = np.eye(4) if prior is None else prior
    return LandmarkKalman(RIG, LandmarkKalmanSettings(**settings), Prediction(wTc, EXACT))


def frame(
    k: int,
    ids: IntArray,
    measured: FloatArray,
    new: bool,
    missed: IntArray = NO_IDS,
    pruned: IntArray = NO_IDS,
) -> Increment:
    seen = observations(ids, measured, SIGMA, np.full(len(ids), new))
    rejected = np.zeros(len(ids), np.bool_)
    return Increment(k, 0.5 * k, None, seen, rejected, missed, pruned)


def at(wTc: FloatArray, matches: int, covariance: FloatArray = EXACT):
    return tracked_at(Prediction(wTc, covariance), matches)


def started(count: int, rng: np.random.Generator, **settings: object):
    """A filter with landmarks seen once from the origin, and the true points."""
    points = points_in_view(RIG, count, (1.5, 6.0), rng)
    estimator = make(**settings)
    estimator.update(
        frame(0, np.arange(count), noisy(points, np.eye(4), rng), True), at(np.eye(4), 0)
    )
    return estimator, points


def noisy(points: FloatArray, wTc: FloatArray, rng: np.random.Generator) -> FloatArray:
    exact = RIG.predict(g.transform_to_camera(wTc, points))
    return exact + SIGMA * rng.standard_normal(exact.shape)


def nearby_pose(rng: np.random.Generator) -> FloatArray:
    return g.se3_exp(np.array([0.03, 0.05, 0.02, 0.1, 0.1, 0.2]) * rng.standard_normal(6))


# --------------------------------------------------------------------------------------------
# The updates against independent implementations


def scalar_ekf(
    x: FloatArray, p: FloatArray, z: FloatArray, wTc: FloatArray, pose_covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Textbook EKF update of one landmark, written out and with a numerical Jacobian."""

    def h(point: FloatArray, moved: FloatArray) -> FloatArray:
        local = np.linalg.inv(moved) @ np.append(point, 1.0)
        u = RIG.fx * local[0] / local[2] + RIG.cx
        v = RIG.fy * local[1] / local[2] + RIG.cy
        return np.array([u, v, RIG.fx * RIG.baseline / local[2]])

    eps = 1e-6
    by_point = np.column_stack(
        [(h(x + eps * e, wTc) - h(x - eps * e, wTc)) / (2 * eps) for e in np.eye(3)]
    )
    by_pose = np.column_stack(
        [
            (h(x, wTc @ g.se3_exp(eps * e)) - h(x, wTc @ g.se3_exp(-eps * e))) / (2 * eps)
            for e in np.eye(6)
        ]
    )
    r = np.diag(SIGMA**2) + by_pose @ pose_covariance @ by_pose.T
    s = by_point @ p @ by_point.T + r
    k = p @ by_point.T @ np.linalg.inv(s)
    return x + k @ (z - h(x, wTc)), p - k @ s @ k.T


@pytest.mark.parametrize("with_pose", [False, True])
def test_pixel_update_is_the_textbook_filter(with_pose: bool, rng: np.random.Generator) -> None:
    estimator, points = started(5, rng, update="pixel", pose_covariance=with_pose)
    for k in range(1, 20):
        wTc = nearby_pose(rng)
        before = estimator.estimate().landmarks
        z = noisy(points, wTc, rng)
        estimator.update(frame(k, np.arange(5), z, False), at(wTc, 5, UNCERTAIN))
        after = estimator.landmarks()
        used = UNCERTAIN if with_pose else EXACT
        for i in range(5):
            x, p = scalar_ekf(before.positions[i], before.covariances[i], z[i], wTc, used)
            np.testing.assert_allclose(after.positions[i], x, rtol=0, atol=1e-8)
            # Relative to the size of the matrix: the numerical Jacobian is good to 1e-8.
            scale = np.abs(p).max()
            np.testing.assert_allclose(after.covariances[i], p, rtol=0, atol=1e-6 * scale)


def single_observation(z: FloatArray, wTc: FloatArray) -> tuple[FloatArray, FloatArray]:
    """World position and covariance of one measurement, by the stereo formulas."""
    column, row, d = z
    u, v = column - RIG.cx, row - RIG.cy
    local = np.array([u, v * RIG.fx / RIG.fy, RIG.fx]) * RIG.baseline / d
    j = RIG.baseline * np.array(
        [
            [1 / d, 0, -u / d**2],
            [0, RIG.fx / RIG.fy / d, -v * RIG.fx / RIG.fy / d**2],
            [0, 0, -RIG.fx / d**2],
        ]
    )
    rotation = wTc[:3, :3]
    return rotation @ local + wTc[:3, 3], rotation @ j @ np.diag(SIGMA**2) @ j.T @ rotation.T


def test_world_update_is_information_fusion(rng: np.random.Generator) -> None:
    estimator, points = started(4, rng, update="world", pose_covariance=False)
    for k in range(1, 6):
        wTc = nearby_pose(rng)
        before = estimator.estimate().landmarks
        z = noisy(points, wTc, rng)
        estimator.update(frame(k, np.arange(4), z, False), at(wTc, 4))
        after = estimator.landmarks()
        for i in range(4):
            x2, s2 = single_observation(z[i], wTc)
            i1, i2 = np.linalg.inv(before.covariances[i]), np.linalg.inv(s2)
            s = np.linalg.inv(i1 + i2)
            x = s @ (i1 @ before.positions[i] + i2 @ x2)
            np.testing.assert_allclose(after.positions[i], x, rtol=0, atol=1e-10)
            np.testing.assert_allclose(after.covariances[i], s, rtol=1e-8, atol=1e-14)


def test_running_mean_is_the_mean(rng: np.random.Generator) -> None:
    estimator, points = started(3, rng, update="running_mean", pose_covariance=False)
    seen = [estimator.landmarks().positions.copy()]
    spread = [estimator.landmarks().covariances.copy()]
    for k in range(1, 12):
        wTc = nearby_pose(rng)
        z = noisy(points, wTc, rng)
        estimator.update(frame(k, np.arange(3), z, False), at(wTc, 3))
        singles = [single_observation(zi, wTc) for zi in z]
        seen.append(np.array([x for x, _ in singles]))
        spread.append(np.array([s for _, s in singles]))
        landmarks = estimator.landmarks()
        np.testing.assert_allclose(landmarks.positions, np.mean(seen, axis=0), rtol=0, atol=1e-12)
        of_mean = np.sum(spread, axis=0) / len(spread) ** 2
        np.testing.assert_allclose(landmarks.covariances, of_mean, rtol=1e-9, atol=1e-15)


def test_running_mean_counts_only_hits(rng: np.random.Generator) -> None:
    estimator, points = started(1, rng, update="running_mean", pose_covariance=False)
    first = estimator.landmarks().positions[0].copy()
    missed = frame(1, NO_IDS, np.empty((0, 3)), False, missed=np.array([0]))
    estimator.update(missed, at(np.eye(4), 0))
    z = noisy(points, np.eye(4), rng)
    estimator.update(frame(2, np.arange(1), z, False), at(np.eye(4), 1))
    second = single_observation(z[0], np.eye(4))[0]
    mean = 0.5 * (first + second)
    np.testing.assert_allclose(estimator.landmarks().positions[0], mean, rtol=0, atol=1e-12)


def test_update_half_weighs_each_older_measurement_by_half(rng: np.random.Generator) -> None:
    """Without a count, averaging can only be half old, half new."""
    estimator, points = started(2, rng, update="half", pose_covariance=False)
    expected = estimator.landmarks().positions.copy()
    for k in range(1, 8):
        wTc = nearby_pose(rng)
        z = noisy(points, wTc, rng)
        estimator.update(frame(k, np.arange(2), z, False), at(wTc, 2))
        expected = 0.5 * expected + 0.5 * np.array([single_observation(zi, wTc)[0] for zi in z])
        positions = estimator.landmarks().positions
        np.testing.assert_allclose(positions, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("update", UPDATES)
def test_pose_covariance_makes_observations_less_certain(
    update: str, rng: np.random.Generator
) -> None:
    points = points_in_view(RIG, 6, (1.5, 6.0), rng)
    z = noisy(points, np.eye(4), rng)
    covariances = []
    for with_pose in (False, True):
        estimator = make(update=update, pose_covariance=with_pose)
        estimator.update(frame(0, np.arange(6), z, True), at(np.eye(4), 0, UNCERTAIN))
        covariances.append(estimator.landmarks().covariances)
    extra = covariances[1] - covariances[0]
    # By the point's motion with the pose: rotation moves it by w x p, translation by itself.
    for p, e in zip(estimator.landmarks().positions, extra, strict=True):
        j = np.hstack([-g.skew(p), np.eye(3)])
        np.testing.assert_allclose(e, j @ UNCERTAIN @ j.T, rtol=1e-8, atol=1e-12)


# --------------------------------------------------------------------------------------------
# Laws of the covariance


@pytest.mark.parametrize("growth", [1e-4, 0.01])
def test_a_miss_grows_the_missed_ones_by_the_stated_amount(
    growth: float, rng: np.random.Generator
) -> None:
    estimator, _ = started(6, rng, miss_growth_m=growth)
    before = estimator.estimate().landmarks
    missed = frame(1, NO_IDS, np.empty((0, 3)), False, missed=np.array([1, 4]))
    estimator.update(missed, at(np.eye(4), 0))
    after = estimator.landmarks()
    np.testing.assert_array_equal(after.positions, before.positions)
    grown = after.covariances - before.covariances
    for i in (1, 4):
        np.testing.assert_allclose(grown[i], growth**2 * np.eye(3), rtol=0, atol=1e-15)
    for i in (0, 2, 3, 5):
        np.testing.assert_array_equal(grown[i], 0.0)


def test_landmarks_out_of_view_are_bit_identical(rng: np.random.Generator) -> None:
    """Type I: neither matched nor missed, nothing may move them."""
    estimator, points = started(10, rng)
    before = estimator.estimate().landmarks
    seen = np.array([2, 5, 7])
    z = noisy(points[seen], np.eye(4), rng)
    estimator.update(frame(1, seen, z, False, missed=np.array([8])), at(np.eye(4), 3, UNCERTAIN))
    after = estimator.landmarks()
    untouched = np.array([0, 1, 3, 4, 6, 9])
    np.testing.assert_array_equal(after.positions[untouched], before.positions[untouched])
    np.testing.assert_array_equal(after.covariances[untouched], before.covariances[untouched])
    assert (after.positions[seen] != before.positions[seen]).any(axis=1).all()


def test_outliers_of_the_tracking_do_not_move_landmarks(rng: np.random.Generator) -> None:
    estimator, points = started(4, rng)
    before = estimator.estimate().landmarks
    tracking = at(np.eye(4), 4)
    tracking = dataclasses.replace(tracking, inliers=np.array([True, False, True, False]))
    z = noisy(points, np.eye(4), rng)
    result = estimator.update(frame(1, np.arange(4), z, False), tracking)
    after = estimator.landmarks()
    np.testing.assert_array_equal(after.positions[[1, 3]], before.positions[[1, 3]])
    assert (after.positions[[0, 2]] != before.positions[[0, 2]]).any(axis=1).all()
    assert result.nis_dof == 6


def test_covariances_stay_positive_over_many_updates(rng: np.random.Generator) -> None:
    """A far landmark's ellipsoid is a needle; Joseph's form keeps it lawful."""
    far = np.array([[1.0, 0.5, 25.0], [-2.0, 1.0, 30.0]])
    estimator = make(update="pixel", pose_covariance=False)
    z = RIG.predict(far)
    estimator.update(frame(0, np.arange(2), z, True), at(np.eye(4), 0))
    for k in range(1, 500):
        estimator.update(frame(k, np.arange(2), z, False), at(np.eye(4), 2))
    covariances = estimator.landmarks().covariances
    assert np.linalg.eigvalsh(covariances).min() > 0
    np.testing.assert_array_equal(covariances, np.swapaxes(covariances, 1, 2))


def test_innovations_match_their_covariance() -> None:
    rng = np.random.default_rng(6)
    estimator, points = started(300, rng, update="pixel", pose_covariance=False)
    for k in range(1, 6):
        wTc = nearby_pose(rng)
        z = noisy(points, wTc, rng)
        result = estimator.update(frame(k, np.arange(300), z, False), at(wTc, 300))
        assert result.nis_dof == 900
        if k > 1:  # the first depth is too uncertain for a linear model
            low, high = stats.chi2.ppf([0.0005, 0.9995], 900)
            assert low < result.nis < high


# --------------------------------------------------------------------------------------------
# The estimator around the filters


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(Drive(frames=14, miss_rate=0.3, prune_after=2), np.random.default_rng(3))


def test_estimate_is_the_history_of_updates(simulation: Simulation) -> None:
    estimator = make()
    results = play(estimator, simulation.increments[:-1])
    estimate = estimator.estimate()
    np.testing.assert_array_equal(estimate.trajectory.poses, [r.wTc for r in results])
    np.testing.assert_array_equal(estimate.covariances, [r.covariance for r in results])
    np.testing.assert_array_equal(
        estimate.trajectory.timestamps, [i.timestamp for i in simulation.increments[:-1]]
    )
    assert results[-1].landmarks == len(estimate.landmarks)
    kept = copy.deepcopy(arrays_of(estimate))
    play(estimator, simulation.increments[-1:])
    assert_same_bits(arrays_of(estimate), kept)


# --------------------------------------------------------------------------------------------
# What a frame starts that nothing placed


@pytest.mark.parametrize("measured", [False, True], ids=["guessed", "odometry"])
def test_landmarks_take_no_guess_over(measured: bool, rng: np.random.Generator) -> None:
    """A guessed pose is no knowledge of single landmarks; odometry's uncertainty is."""
    points = points_in_view(RIG, 5, (1.5, 6.0), rng)
    estimator, z = make(), noisy(points, np.eye(4), rng)
    vague = Prediction(np.eye(4), np.diag([0.5] * 3 + [20.0] * 3) ** 2)
    step = Odometry(np.eye(4), vague.covariance, measured=measured)
    estimator.update(frame(0, NO_IDS, np.empty((0, 3)), True), at(np.eye(4), 0))
    lost = unmeasured(vague, EgoMotionStatus.TOO_FEW_MATCHES)
    new = dataclasses.replace(frame(1, np.arange(5), z, True), odometry=step)
    estimator.update(new, lost)
    found = estimator.landmarks().covariances
    alone = RIG.triangulation_covariance(z, np.tile(np.diag(SIGMA**2), (5, 1, 1)))
    if measured:
        assert (np.trace(found - alone, axis1=1, axis2=2) > 3 * 20.0**2).all()
    else:
        np.testing.assert_allclose(found, alone, rtol=1e-9)
