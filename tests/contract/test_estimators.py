"""What every estimator must do, whatever its kind: the contract of ``backend.protocol.Estimator``.

Every kind of the union of settings is held to it with its defaults, and some with others.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
from simulated import (
    RIG,
    Drive,
    Simulation,
    assert_same_bits,
    play,
    simulate,
    tracked_at,
)
from smoothing import keep

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import (
    EstimatorSettings,
    Isam2Settings,
    LandmarkKalmanSettings,
    family_of,
)
from fgslam.backend.smoothers.smoother import Smoother
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.sensors import Increment, LoopClosure, MeasurementType
from fgslam.core.store import has_state, restore, state_of
from fgslam.core.types import EgoMotion, EgoMotionStatus, Prediction
from fgslam.slam.build import make_estimator

DEFAULTS: dict[str, EstimatorSettings] = {
    settings.kind: settings() for settings in get_args(get_args(EstimatorSettings)[0])
}
SETTINGS: dict[str, EstimatorSettings] = DEFAULTS | {
    "isam2, keyframes": Isam2Settings(keyframe_every=4),
    "landmark_kalman, world update": LandmarkKalmanSettings(update="world"),
    "landmark_kalman, running mean": LandmarkKalmanSettings(update="running_mean"),
}
CORRECTING = [name for name, settings in SETTINGS.items() if family_of(settings.kind) != "other"]
"""Filters and smoothers learn from landmarks seen again; dead reckoning is neither."""
FRAMES = 12
PRUNED = 3
PERIOD_S = 0.5


@pytest.fixture(scope="module")
def world() -> Simulation:
    """A drive past known points; landmark ``PRUNED`` is dropped after frame 8 for good."""
    drive = simulate(Drive(FRAMES, points=70, period_s=PERIOD_S), np.random.default_rng(2))
    increments = list(drive.increments)
    increments[8] = dataclasses.replace(increments[8], pruned_ids=np.array([PRUNED]))
    increments = keep(increments, lambda k, x: (x.observations.ids != PRUNED) | (k <= 8))
    return dataclasses.replace(drive, increments=increments)


@pytest.fixture(scope="module", params=SETTINGS)
def make(request: pytest.FixtureRequest) -> Callable[[], Estimator]:
    return lambda: make_estimator(RIG, SETTINGS[request.param])


@pytest.fixture(scope="module")
def driven(make: Callable[[], Estimator], world: Simulation) -> Estimator:
    """After the whole drive; read only."""
    estimator = make()
    play(estimator, world.increments)
    return estimator


def test_estimator_reports_kind_family_and_supported_sensors(
    request: pytest.FixtureRequest, make: Callable[[], Estimator]
) -> None:
    estimator = make()
    settings = SETTINGS[request.node.callspec.params["make"]]
    assert estimator.kind == settings.kind
    assert (family_of(settings.kind) == "smoother") == isinstance(estimator, Smoother)
    assert has_state(estimator)
    assert estimator.supports
    assert all(isinstance(kind, MeasurementType) for kind in estimator.supports)


def test_new_estimator_is_at_the_origin_with_an_empty_map(make: Callable[[], Estimator]) -> None:
    estimator = make()
    np.testing.assert_array_equal(estimator.predict(None).wTc, np.eye(4))
    assert len(estimator.landmarks()) == 0
    assert len(estimator.estimate().trajectory) == 0


def test_predicting_changes_nothing(
    make: Callable[[], Estimator], driven: Estimator, world: Simulation
) -> None:
    estimator = make()
    odometry = world.increments[5].odometry
    play(estimator, world.increments[:5])
    first, second = estimator.predict(odometry), estimator.predict(odometry)
    np.testing.assert_array_equal(first.wTc, second.wTc)
    np.testing.assert_array_equal(first.covariance, second.covariance)
    play(estimator, world.increments[5:])
    assert_same_bits(estimator.estimate(), driven.estimate())


def test_a_prediction_is_the_pose_moved_and_less_certain(
    make: Callable[[], Estimator], world: Simulation
) -> None:
    estimator = make()
    play(estimator, world.increments[:5])
    odometry = world.increments[5].odometry
    assert odometry is not None
    before, after = estimator.predict(None), estimator.predict(odometry)
    np.testing.assert_allclose(after.wTc, before.wTc @ odometry.motion, rtol=0, atol=1e-12)
    moved = g.compose_covariance(odometry.motion, before.covariance, np.zeros((6, 6)))
    assert np.linalg.eigvalsh(after.covariance - moved).min() > -1e-12
    assert np.trace(after.covariance) > np.trace(moved)


def test_time_must_increase(make: Callable[[], Estimator], world: Simulation) -> None:
    estimator = make()
    play(estimator, world.increments[:4])
    before = copy.deepcopy(estimator.estimate())
    for timestamp in (1.5, 1.0, -1.0, float("nan")):
        late = dataclasses.replace(world.increments[4], timestamp=timestamp)
        with pytest.raises(EstimatorError, match="time stamp"):
            estimator.update(late, tracking_at(late, world.poses[4]))
        assert_same_bits(estimator.estimate(), before)
    play(estimator, world.increments[4:5])
    assert len(estimator.estimate().trajectory) == 5


def tracking_at(increment: Increment, wTc: FloatArray) -> EgoMotion:
    matched = int((~increment.observations.is_new).sum())
    return tracked_at(Prediction(wTc, 1e-6 * np.eye(6)), matched)


def test_arguments_stay_as_they_were(make: Callable[[], Estimator], world: Simulation) -> None:
    estimator = make()
    for increment, wTc in zip(world.increments, world.poses, strict=True):
        tracking = tracking_at(increment, wTc)
        given = (increment, tracking)
        kept = copy.deepcopy(given)
        estimator.predict(increment.odometry)
        estimator.update(*given)
        assert_same_bits(given, kept)


def test_the_map_holds_what_was_seen_and_not_pruned(
    make: Callable[[], Estimator], world: Simulation
) -> None:
    estimator = make()
    expected: set[int] = set()
    for increment in world.increments:
        play(estimator, [increment])
        expected |= set(increment.observations.ids.tolist())
        expected -= set(increment.pruned_ids.tolist())
        landmarks = estimator.landmarks()
        assert landmarks.ids.tolist() == sorted(expected)
        assert landmarks.positions.shape == (len(expected), 3)
        assert landmarks.covariances.shape == (len(expected), 3, 3)


def test_covariances_are_symmetric_and_positive(driven: Estimator) -> None:
    estimate = driven.estimate()
    for covariances in (estimate.covariances, estimate.landmarks.covariances):
        scale = np.abs(covariances).max()
        swapped = np.swapaxes(covariances, 1, 2)
        np.testing.assert_allclose(covariances, swapped, rtol=0, atol=1e-12 * scale)
        assert np.linalg.eigvalsh(covariances).min() > -1e-12 * scale
    assert np.linalg.eigvalsh(estimate.landmarks.covariances).min() > 0


@pytest.mark.parametrize("make", CORRECTING, indirect=True)
def test_the_map_grows_more_certain_with_observations(
    make: Callable[[], Estimator], world: Simulation
) -> None:
    estimator = make()
    play(estimator, world.increments[:1])
    # Those seen in each of the first six frames, so that nothing but observations acts on them.
    ids = estimator.landmarks().ids
    for increment in world.increments[1:6]:
        ids = np.intersect1d(ids, increment.observations.ids)
    assert len(ids) > 10

    def uncertainty() -> FloatArray:
        known = estimator.estimate().landmarks
        return np.asarray(np.trace(known.covariances[known.rows(ids)], axis1=1, axis2=2))

    first = uncertainty()
    play(estimator, world.increments[1:6])
    assert np.median(uncertainty() / first) < 0.6


@pytest.mark.parametrize("make", CORRECTING, indirect=True)
def test_trajectory_is_near_the_truth(driven: Estimator, world: Simulation) -> None:
    estimate = driven.estimate()
    errors = np.linalg.norm(estimate.trajectory.poses[:, :3, 3] - world.poses[:, :3, 3], axis=1)
    dead_reckoning = np.eye(4)
    for increment in world.increments[1:]:
        assert increment.odometry is not None
        dead_reckoning = dead_reckoning @ increment.odometry.motion
    assert errors.max() < 0.03
    assert errors[-1] < np.linalg.norm(dead_reckoning[:3, 3] - world.poses[-1, :3, 3])
    offsets = estimate.landmarks.positions - world.points_by_id[estimate.landmarks.ids]
    assert np.median(np.linalg.norm(offsets, axis=1)) < 0.1


def test_a_restored_state_continues_to_the_same_bits(
    make: Callable[[], Estimator], driven: Estimator, world: Simulation
) -> None:
    first, second = make(), make()
    play(first, world.increments[:6])
    # As a file does: plain arrays; what the first does later does not reach into them.
    state = state_of(first)
    kept = copy.deepcopy(state)
    assert all(array.dtype != np.object_ for array in state.values())
    play(first, world.increments[6:])
    assert_same_bits(state, kept)
    restore(second, state)
    play(second, world.increments[6:])
    assert_same_bits(second.estimate(), driven.estimate())


def looped(world: Simulation, ends_at_once: bool = False) -> list[Increment]:
    """The last frame but one closes a true loop, and one of its landmarks ends after it.

    With the next frame; or, as older logs have it, with the closing frame itself.
    """
    k, old = FRAMES - 2, 3
    last = world.increments[k]
    kept = last.observations.ids[~last.observations.is_new]
    seen = last.observations.select(np.isin(last.observations.ids, kept[1:]))
    loop = LoopClosure(
        frame=old,
        oTc=g.inverse(world.poses[old]) @ world.poses[k],
        covariance=np.diag([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3]) ** 2,
        observations=seen,
        merged=np.array([[kept[0], kept[1]]]),
    )
    out = list(world.increments)
    out[k] = dataclasses.replace(last, loops=(loop,))
    # The landmark's later sightings come under the identity that stays, of which there is one.
    after = out[k + 1]
    gone = ~np.isin(after.observations.ids, kept[:1])
    out[k + 1] = dataclasses.replace(
        after,
        observations=after.observations.select(gone),
        rejected=after.rejected[gone],
        missed_ids=np.setdiff1d(after.missed_ids, kept[:1]),
    )
    ends = k if ends_at_once else k + 1
    pruned = np.union1d(out[ends].pruned_ids, kept[:1])
    out[ends] = dataclasses.replace(out[ends], pruned_ids=pruned)
    return out


def absurd(loop: LoopClosure) -> LoopClosure:
    """Ten metres off, by the pose as by the landmarks, each of which is taken for another."""
    seen = loop.observations
    return dataclasses.replace(
        loop,
        oTc=g.pose(np.eye(3), np.array([10.0, 0.0, 0.0])) @ loop.oTc,
        observations=dataclasses.replace(seen, ids=np.roll(seen.ids, 1)),
    )


def test_each_loop_closure_is_reported_as_closed_or_refused(
    make: Callable[[], Estimator], world: Simulation
) -> None:
    """A true one is taken, an absurd one is not; an estimator that corrects nothing takes none."""
    estimator, increments = make(), looped(world)
    true = increments[FRAMES - 2].loops
    stats = play(estimator, increments)
    takes = family_of(estimator.kind) != "other" and MeasurementType.LOOP in estimator.supports
    assert [s.closed for s in stats[:-2]] == [()] * (FRAMES - 2)
    assert stats[FRAMES - 2].closed == (takes,)
    doubtful, both = make(), list(increments)
    both[FRAMES - 2] = dataclasses.replace(both[FRAMES - 2], loops=(absurd(true[0]), *true))
    assert play(doubtful, both)[FRAMES - 2].closed == (False, takes)


@pytest.mark.parametrize("ends_at_once", [False, True])
@pytest.mark.parametrize("make", CORRECTING, indirect=True)
def test_a_true_loop_does_no_harm(
    make: Callable[[], Estimator], world: Simulation, ends_at_once: bool
) -> None:
    estimator, increments = make(), looped(world, ends_at_once)
    if MeasurementType.LOOP not in estimator.supports:
        pytest.skip(f"{estimator.kind} takes no loop closures")
    play(estimator, increments)
    estimate = estimator.estimate()
    errors = np.linalg.norm(estimate.trajectory.poses[:, :3, 3] - world.poses[:, :3, 3], axis=1)
    assert errors.max() < 0.03
    reported = [words for words in estimate.remarks if "loop closure to frame 3" in words]
    assert len(reported) == 1
    assert "refused" not in reported[0]
    ended = increments[FRAMES - 2].loops[0].merged[0, 0]
    assert ended not in estimate.landmarks.ids
    assert ended not in estimator.landmarks().ids


def test_a_frame_without_measurements_keeps_the_map(
    make: Callable[[], Estimator], world: Simulation
) -> None:
    estimator = make()
    play(estimator, world.increments[:5])
    before = estimator.landmarks().positions.copy()
    nothing = np.empty(0, np.int64)
    blind = Increment(
        index=10,
        timestamp=2.5,
        odometry=world.increments[5].odometry,
        observations=world.increments[5].observations.select(nothing),
        rejected=np.empty(0, np.bool_),
        missed_ids=nothing,
        pruned_ids=nothing,
    )
    prediction = estimator.predict(blind.odometry)
    stats = estimator.update(blind, unmeasured(prediction))
    # A smoother's next iteration moves what came before, by a part of its uncertainty.
    tolerance = 1e-3 if isinstance(estimator, Smoother) else 1e-12
    np.testing.assert_allclose(stats.wTc, prediction.wTc, rtol=0, atol=tolerance)
    assert stats.nis_dof == 0
    after = estimator.landmarks()
    if isinstance(estimator, Smoother):
        sigmas = np.sqrt(np.diagonal(after.covariances, axis1=1, axis2=2))
        assert (np.abs(after.positions - before) < sigmas).all()
    else:
        np.testing.assert_array_equal(after.positions, before)
    assert len(estimator.estimate().trajectory) == 6


def unmeasured(prediction: Prediction) -> EgoMotion:
    none = np.empty(0)
    return EgoMotion(
        prediction.wTc,
        prediction.covariance,
        none.astype(np.bool_),
        none,
        EgoMotionStatus.NO_IMAGE,
        0,
    )
