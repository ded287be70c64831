"""Estimators that begin in a saved map: what they take over, and what they leave as it is."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.backend.filters.ekf import (
    FRONT,
    GrowingCovariance,
    Matches,
    PoseMeasurement,
    correct,
    rows_of,
)
from fgslam.backend.protocol import Estimator, MapUser
from fgslam.backend.settings import (
    BatchSettings,
    DeadReckoningSettings,
    EkfSettings,
    EstimatorSettings,
    FixedLagSettings,
    InvariantEkfSettings,
    Isam2Settings,
    LandmarkKalmanGraphSettings,
    LandmarkKalmanSettings,
)
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig, Increment, Observations
from fgslam.core.store import restore, state_of
from fgslam.core.types import (
    EgoMotion,
    EgoMotionStatus,
    LandmarkAppearances,
    LandmarkMap,
    Prediction,
    Trajectory,
)
from fgslam.slam.build import Arrival, make_estimator, require_map_user, take_over

RIG = CameraRig(320, 240, 277.1, 277.3, 159.5, 119.5, 0.1, 0.1, np.eye(4))
WTC = g.se3_exp(np.array([0.02, 0.3, -0.01, 0.4, 0.02, -0.2]))
PRIOR = Prediction(WTC, np.diag(np.repeat([0.05, 0.1], 3) ** 2))
USERS: list[EstimatorSettings] = [
    LandmarkKalmanSettings(),
    LandmarkKalmanGraphSettings(),
    EkfSettings(),
    InvariantEkfSettings(),
    Isam2Settings(update_every=1),
    BatchSettings(),
]
KEEPERS = USERS[:4]


def random_covariances(rng: np.random.Generator, n: int, sigma: float) -> FloatArray:
    root = sigma * rng.standard_normal((n, 3, 3))
    return root @ np.swapaxes(root, 1, 2) + 0.1 * sigma**2 * np.eye(3)


@pytest.fixture
def saved(rng: np.random.Generator) -> SavedMap:
    """Thirty landmarks before the camera at WTC."""
    n = 30
    points = rng.uniform([-1.5, -1.0, 2.0], [1.5, 1.0, 5.0], (n, 3))
    ids = 2 * np.arange(n) + 5
    return SavedMap(
        rig=RIG,
        landmarks=LandmarkMap(
            ids, g.transform_to_world(WTC, points), random_covariances(rng, n, 0.02)
        ),
        appearances=LandmarkAppearances(
            ids, np.zeros((n, 128), np.uint8), np.ones(n), np.zeros(n), np.zeros((n, 3))
        ),
        hits=rng.integers(3, 30, n),
        misses=np.zeros(n, np.int64),
        farthest=np.full(n, np.inf),
        permanent=np.zeros(n, np.bool_),
        colour=np.zeros(n, np.uint8),
        trajectory=Trajectory(np.empty(0), np.empty((0, 4, 4))),
        about={},
        evidence=np.empty(0, np.int64),
    )


def begun(settings: EstimatorSettings, saved: SavedMap, extends: bool = True) -> Estimator:
    estimator = make_estimator(RIG, settings, prior=PRIOR)
    take_over(estimator, Arrival(saved, PRIOR, relocalised=False, extends=extends))
    return estimator


def seen(saved: SavedMap, noise: FloatArray | float = 0.0, count: int = 20) -> Increment:
    """The first ``count`` landmarks measured from WTC."""
    points = g.transform_to_camera(WTC, saved.landmarks.positions[:count])
    measurement = RIG.predict(points) + noise
    observations = Observations(
        saved.landmarks.ids[:count],
        measurement,
        np.broadcast_to(np.diag([0.2, 0.2, 0.1]) ** 2, (count, 3, 3)),
        np.full((count, 3, 2), np.nan),
        np.zeros(count, np.bool_),
    )
    none = np.empty(0, np.int64)
    return Increment(0, 0.0, None, observations, np.zeros(count, np.bool_), none, none)


def tracked(increment: Increment) -> EgoMotion:
    k = len(increment.observations)
    covariance = np.diag(np.repeat([1e-3, 3e-3], 3) ** 2)
    return EgoMotion(WTC, covariance, np.ones(k, np.bool_), np.zeros(k), EgoMotionStatus.OK, 3)


@pytest.mark.parametrize("settings", USERS, ids=lambda s: s.kind)
def test_observed_landmarks_become_more_certain_and_others_stay(
    settings: EstimatorSettings, saved: SavedMap
) -> None:
    estimator = begun(settings, saved)
    increment = seen(saved)
    estimator.update(increment, tracked(increment))
    after = estimator.estimate()
    np.testing.assert_allclose(after.trajectory.poses[0], WTC, atol=1e-6)
    np.testing.assert_allclose(after.landmarks.positions, saved.landmarks.positions, atol=1e-6)
    before, now = saved.landmarks.covariances, after.landmarks.covariances
    assert (np.linalg.eigvalsh(before[:20] - now[:20]).max(axis=1) > 0.0).all()
    np.testing.assert_allclose(now[20:], before[20:], rtol=1e-12)


@pytest.mark.parametrize("settings", USERS[2:], ids=lambda s: s.kind)
def test_the_first_pose_is_as_uncertain_as_prior_map_and_measurement_say(
    settings: EstimatorSettings, saved: SavedMap
) -> None:
    """Against the information form, the landmarks eliminated by hand; nothing is off: exact."""
    estimator = begun(settings, saved)
    increment = seen(saved)
    stats = estimator.update(increment, tracked(increment))
    points = g.transform_to_camera(WTC, saved.landmarks.positions[:20])
    jacobian = RIG.jacobian(points)
    by_pose, by_landmark = jacobian @ g.point_pose_jacobian(points), jacobian @ WTC[:3, :3].T
    noise = increment.observations.covariance
    whole = g.congruence(by_landmark, saved.landmarks.covariances[:20]) + noise
    gained = np.swapaxes(by_pose, 1, 2) @ np.linalg.inv(whole) @ by_pose
    information = np.linalg.inv(PRIOR.covariance) + gained.sum(axis=0)
    np.testing.assert_allclose(
        estimator.estimate().covariances[0], np.linalg.inv(information), rtol=1e-5, atol=1e-12
    )
    assert stats.landmarks == 30


@pytest.mark.parametrize("settings", KEEPERS, ids=lambda s: s.kind)
def test_a_map_that_is_kept_does_not_change_by_a_bit(
    settings: EstimatorSettings, saved: SavedMap, rng: np.random.Generator
) -> None:
    estimator = begun(settings, saved, extends=False)
    before = estimator.landmarks()
    positions, covariances = before.positions.copy(), before.covariances.copy()
    increment = seen(saved, 0.2 * rng.standard_normal((20, 3)))
    stats = estimator.update(increment, tracked(increment))
    after = estimator.estimate().landmarks
    assert after.positions.tobytes() == positions.tobytes()
    assert after.covariances.tobytes() == covariances.tobytes()
    assert stats.nis > 0.0
    assert stats.nis_dof == 60


@pytest.mark.parametrize("settings", USERS, ids=lambda s: s.kind)
def test_state_and_restore_to_the_bit(
    settings: EstimatorSettings, saved: SavedMap, rng: np.random.Generator
) -> None:
    estimator = begun(settings, saved)
    increment = seen(saved, 0.2 * rng.standard_normal((20, 3)))
    estimator.update(increment, tracked(increment))
    again = begun(settings, saved)
    restore(again, state_of(estimator))
    one, other = estimator.estimate(), again.estimate()
    assert one.trajectory.poses.tobytes() == other.trajectory.poses.tobytes()
    assert one.landmarks.positions.tobytes() == other.landmarks.positions.tobytes()
    assert one.landmarks.covariances.tobytes() == other.landmarks.covariances.tobytes()


@pytest.mark.parametrize("settings", [DeadReckoningSettings(), FixedLagSettings()])
def test_estimators_that_cannot_use_a_map_are_refused(settings: EstimatorSettings) -> None:
    estimator = make_estimator(RIG, settings, prior=PRIOR)
    assert not isinstance(estimator, MapUser)
    with pytest.raises(ConfigError, match=f"{settings.kind} cannot begin in a saved map"):
        require_map_user(estimator, extends=True)


@pytest.mark.parametrize("settings", USERS[len(KEEPERS) :], ids=lambda s: s.kind)
def test_smoothers_do_not_keep_a_map(settings: EstimatorSettings) -> None:
    with pytest.raises(ConfigError, match="cannot leave a map as it is"):
        require_map_user(make_estimator(RIG, settings), extends=False)


def test_schmidt_s_correction_is_joseph_s_form_with_the_landmarks_gain_zero(
    saved: SavedMap, rng: np.random.Generator
) -> None:
    count = 8
    n = FRONT + 3 * count
    root = 0.02 * rng.standard_normal((n, n))
    before = root @ root.T
    covariance = GrowingCovariance.unpacked(np.concatenate([before[i, : i + 1] for i in range(n)]))
    observed = seen(saved, 0.3 * rng.standard_normal((count, 3)), count).observations
    positions = saved.landmarks.positions[:count]
    matches = Matches.of(RIG, WTC, np.arange(count), positions, observed)
    no_floor = PoseMeasurement(np.empty(0), np.empty((0, 6)), np.empty(0))
    full = correct(covariance, covariance.front(), matches, no_floor, 0.0)
    found = full.of_the_pose_alone()
    h = np.zeros((3 * count, n))
    for k, rows in enumerate(rows_of(np.arange(count))):
        h[3 * k : 3 * k + 3, :FRONT] = matches.by_pose[k]
        h[3 * k : 3 * k + 3, rows] = matches.by_landmark[k]
    gain = np.zeros((n, 3 * count))
    gain[:FRONT] = full.gain[:FRONT]
    noise = g.block_diagonal(np.empty((0, 0)), matches.noise)
    kept = np.eye(n) - gain @ h
    expected = kept @ before @ kept.T + gain @ noise @ gain.T
    after = before - found.gain @ found.half.T - found.half @ found.gain.T
    np.testing.assert_allclose(after, expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(found.step[FRONT:], 0.0)
    np.testing.assert_array_equal(found.step[:FRONT], full.step[:FRONT])
    np.testing.assert_array_equal(after[FRONT:, FRONT:], before[FRONT:, FRONT:])
    assert np.trace(after[:FRONT, :FRONT]) < np.trace(before[:FRONT, :FRONT])


def test_independent_landmarks_in_the_joint_covariance(rng: np.random.Generator) -> None:
    blocks = random_covariances(rng, 5, 0.1)
    covariance = GrowingCovariance(np.diag(np.arange(1.0, 7.0)))
    covariance.append(np.ones((FRONT, 3)), np.eye(3))
    covariance.append_independent(blocks)
    whole = covariance.columns(np.arange(FRONT + 18))
    np.testing.assert_array_equal(covariance.diagonal_blocks(np.arange(1, 6)), blocks)
    for k in range(1, 6):
        rows = rows_of(np.array([k]))[0]
        others = np.setdiff1d(np.arange(FRONT + 18), rows)
        np.testing.assert_array_equal(whole[np.ix_(rows, others)], 0.0)
