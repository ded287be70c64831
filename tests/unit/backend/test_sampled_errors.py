"""Covariances that the per-landmark filter reports, against its errors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from loops import CLOSED, Rounds, drive_rounds
from scipy import stats
from simulated import RIG, Simulation, play
from smoothing import FREE, drawn

from fgslam.backend import considered
from fgslam.backend.considered import SAMPLES, SampledErrors
from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.persistence import StatedNoise
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import Increment
from fgslam.core.store import restore, state_of
from fgslam.core.types import LandmarkMap, Prediction
from fgslam.evaluation.statistics import landmark_nees, nees, pose_errors, pose_nees, within
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem

FIRST = Prediction(np.eye(4), np.zeros((6, 6)))
UPDATES = ("pixel", "world", "running_mean", "half")


def played(
    increments: list[Increment], ego_motion: EgoMotionSettings | None = FREE, **settings: object
) -> LandmarkKalman:
    """The filter after a drive; with ``ego_motion`` None it reports its own covariances."""
    estimator = LandmarkKalman(RIG, LandmarkKalmanSettings(**settings), FIRST, ego_motion)
    play(estimator, increments, FREE)
    return estimator


def per_dof(drives: list[Simulation], ego_motion: EgoMotionSettings | None) -> FloatArray:
    """NEES per degree of freedom of the last poses and of the landmarks, and 2 sigma coverage."""
    poses, landmarks, inside = [], [], []
    for drive in drives:
        found = played(drive.increments, ego_motion).estimate()
        at = found.trajectory.poses, found.covariances
        poses.append(pose_nees(at[0][-1:], at[1][-1:], drive.poses[-1:]))
        truth = drive.points_by_id[found.landmarks.ids]
        landmarks.append(
            landmark_nees(found.landmarks.positions, found.landmarks.covariances, truth)
        )
        inside.append(within(pose_errors(at[0][1:], drive.poses[1:]), at[1][1:]))
    means = [
        sum(n.values.sum() for n in of) / sum(n.dof.sum() for n in of) for of in (poses, landmarks)
    ]
    return np.array([*means, np.mean(inside)])


def test_reported_covariances_are_those_of_the_errors_and_the_filters_own_are_not() -> None:
    """Three drives; in the slow test fifty, with the band of chi-square."""
    drives = [drawn(seed, frames=30) for seed in range(3)]
    pose, landmark, inside = per_dof(drives, FREE)
    assert 0.4 < pose < 1.9
    assert 0.5 < landmark < 1.6
    assert inside > 0.9
    own = per_dof(drives, None)
    assert own[0] > 2.5
    assert own[1] > 2.0
    assert own[2] < inside


@pytest.mark.slow
def test_fifty_drives_are_within_the_band_of_chi_square() -> None:
    pose, landmark, inside = per_dof([drawn(seed) for seed in range(50)], FREE)
    low, high = stats.chi2.ppf([0.025, 0.975], 6 * 50) / (6 * 50)
    assert low < pose < high
    # Landmarks of one drive share its errors: 50 drives, not 50 times 60 landmarks.
    assert 0.85 < landmark < 1.15
    assert 0.93 < inside < 0.98


def with_persistent_errors(drive: Simulation, kept: float, seed: int) -> Simulation:
    """Errors as large as stated, of which each landmark keeps a part from sighting to sighting."""
    rng, last = np.random.default_rng(seed), dict[int, FloatArray]()
    increments = []
    for wTc, increment in zip(drive.poses, drive.increments, strict=True):
        seen = increment.observations
        errors = rng.standard_normal((len(seen), 3))
        for error, i in zip(errors, seen.ids.tolist(), strict=True):
            if i in last:
                error[:] = kept * last[i] + np.sqrt(1.0 - kept**2) * error
            last[i] = error
        exact = g.project(RIG, g.transform_to_camera(wTc, drive.points_by_id[seen.ids]))
        measured = exact + errors * np.sqrt(np.diagonal(seen.covariance, axis1=1, axis2=2))
        moved = dataclasses.replace(seen, measurement=measured)
        increments.append(dataclasses.replace(increment, observations=moved))
    return dataclasses.replace(drive, increments=increments)


def test_errors_that_persist_are_drawn_as_large_as_the_residuals_so_far_say(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drives = [
        with_persistent_errors(drawn(seed, frames=45, points=120), kept=0.8, seed=seed)
        for seed in range(2)
    ]
    learned = per_dof(drives, FREE)
    monkeypatch.setattr(considered, "Persistence", lambda sensor: StatedNoise(1.0))
    stated = per_dof(drives, FREE)
    assert (learned[:2] < 0.75 * stated[:2]).all()
    assert learned[2] > stated[2]


def pattern(measurement: FloatArray) -> FloatArray:
    """(k, 3) an error in pixels that differs from place to place of the image."""
    return np.stack(
        [
            np.sin(0.05 * measurement[:, 1]),
            np.cos(0.03 * measurement[:, 0]),
            np.sin(0.07 * measurement[:, 0] + 1.0),
        ],
        axis=1,
    )


def with_pattern(increment: Increment, size: float) -> Increment:
    seen = increment.observations
    moved = seen.measurement + size * pattern(seen.measurement)
    return dataclasses.replace(increment, observations=dataclasses.replace(seen, measurement=moved))


@pytest.mark.parametrize("update", UPDATES)
def test_a_column_is_what_the_filter_makes_of_an_error(
    update: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All samples are one known error of all measurements, none of the odometry."""
    original = SampledErrors.linearised

    def known(
        self: SampledErrors, wTc: FloatArray, seen: PoseProblem
    ) -> considered.ObservedColumns:
        sights = original(self, wTc, seen)
        sights.shift[:, :, -SAMPLES:] = pattern(seen.measurement)[:, :, None]
        return sights

    monkeypatch.setattr(SampledErrors, "linearised", known)
    monkeypatch.setattr(considered, "symmetric_root", lambda covariance: np.zeros((6, 6)))
    increments = drawn(2, noise=0.0).increments
    size = 1e-4
    plain = played(increments, update=update)
    moved = played([with_pattern(each, size) for each in increments], update=update)
    step = g.se3_log(g.inverse(plain.predict(None).wTc) @ moved.predict(None).wTc) / size
    state = state_of(plain)
    column = state["errors/gain"][:, -1]
    np.testing.assert_allclose(column, step, rtol=0.0, atol=1e-2 * np.abs(step).max())
    before, after = plain.landmarks(), moved.landmarks()
    shift = (after.positions - before.positions) / size
    np.testing.assert_array_equal(state["errors/order/ids"], before.ids)
    columns = state["errors/map/gain"][state["errors/order/row"], :, -1]
    np.testing.assert_allclose(columns, shift, rtol=0.0, atol=1e-2 * np.abs(shift).max())


def test_covariances_of_few_samples_are_stated_larger_so_that_the_nees_is_right(
    rng: np.random.Generator,
) -> None:
    errors = SampledErrors(EgoMotionSolver(RIG, FREE))
    state = state_of(errors)
    found = []
    for _ in range(400):
        columns = np.zeros_like(state["gain"])
        columns[:, -SAMPLES:] = rng.standard_normal((6, SAMPLES))
        error = rng.standard_normal((1, 6))
        restore(errors, state | {"gain": columns})
        found.append(nees(error, errors.pose(FIRST).covariance[None]).values[0])
    assert np.mean(found) / 6.0 == pytest.approx(1.0, abs=0.1)


def test_a_frame_that_nothing_places_is_as_uncertain_as_its_odometry() -> None:
    """Blind frames: the covariance grows by the noise of each step."""
    increments = drawn(1).increments
    blind = [
        dataclasses.replace(
            each,
            observations=each.observations.select(np.zeros(len(each.observations), np.bool_)),
            rejected=np.empty(0, np.bool_),
            missed_ids=np.empty(0, np.int64),
            pruned_ids=np.empty(0, np.int64),
        )
        for each in increments[8:]
    ]
    estimator = played(increments[:8] + blind)
    said = estimator.estimate().covariances
    known = said[7]
    for each, covariance in zip(blind, said[8:], strict=True):
        assert each.odometry is not None
        known = g.compose_covariance(each.odometry.motion, known, each.odometry.covariance)
        ratio = np.diagonal(covariance) / np.diagonal(known)
        assert (ratio > 0.5).all()
        assert (ratio < 2.0).all()


@pytest.mark.parametrize("update", ["pixel", "half"])
def test_estimates_do_not_depend_on_what_is_reported(update: str) -> None:
    increments = drawn(4).increments
    sampled, own = played(increments, update=update), played(increments, None, update=update)
    poses = [one.estimate().trajectory.poses for one in (sampled, own)]
    np.testing.assert_array_equal(*poses)
    np.testing.assert_array_equal(sampled.landmarks().positions, own.landmarks().positions)
    np.testing.assert_array_equal(sampled.landmarks().covariances, own.landmarks().covariances)


@pytest.mark.parametrize("variance", [0.0, -1e-18])
@pytest.mark.parametrize("fixed", [True, False], ids=["as it is", "going on"])
def test_landmarks_of_a_saved_map_may_be_known_exactly_in_a_direction(
    variance: float, fixed: bool
) -> None:
    drive = drawn(1, frames=6)
    covariances = np.tile(np.diag([1e-4, variance, 1e-4]), (len(drive.points_by_id), 1, 1))
    ids = np.arange(len(covariances))
    given = LandmarkMap(ids, drive.points_by_id.copy(), covariances)
    prior = Prediction(np.eye(4), 1e-6 * np.eye(6))
    estimator = LandmarkKalman(RIG, LandmarkKalmanSettings(), prior, FREE)
    estimator.begin_in(given, np.ones(len(ids), np.int64), fixed)
    seen = [each.observations for each in drive.increments]
    known = [dataclasses.replace(each, is_new=np.zeros(len(each), np.bool_)) for each in seen]
    increments = [
        dataclasses.replace(each, observations=now, pruned_ids=np.empty(0, np.int64))
        for each, now in zip(drive.increments, known, strict=True)
    ]
    play(estimator, increments, FREE)
    found = estimator.estimate()
    errors = pose_nees(found.trajectory.poses, found.covariances, drive.poses)
    assert errors.values.sum() < 2.0 * errors.dof.sum()


@pytest.mark.parametrize(("matches", "drives"), [(1000, 4), (3, 2)])
def test_a_loop_leaves_the_covariances_those_of_the_errors(matches: int, drives: int) -> None:
    """At the frame that closes it, at the end, and of the landmarks.

    With few landmarks in common it is the place's own that say how far it is off.
    """
    closing, last, landmarks = [], [], []
    for seed in range(drives):
        drive = drive_rounds(Rounds(), np.random.default_rng(seed))
        estimator = LandmarkKalman(RIG, LandmarkKalmanSettings(), FIRST, FREE)
        steps = play(estimator, [seeing(each, matches) for each in drive.increments], FREE)
        for k, values in ((CLOSED, closing), (len(steps) - 1, last)):
            at = steps[k].wTc[None], steps[k].covariance[None]
            values.append(pose_nees(*at, drive.poses[k][None]).values.sum() / 6.0)
        found = estimator.estimate().landmarks
        truth = drive.points_by_id[found.ids]
        errors = landmark_nees(found.positions, found.covariances, truth)
        landmarks.append(errors.values.sum() / errors.dof.sum())
    for values in (closing, last, landmarks):
        assert 0.4 < np.mean(values) < 2.0


def seeing(increment: Increment, matches: int) -> Increment:
    """With no more old landmarks than that in each of its loops."""
    some = np.arange(matches)
    loops = [
        dataclasses.replace(x, observations=x.observations.select(some[: len(x.observations)]))
        for x in increment.loops
    ]
    return dataclasses.replace(increment, loops=tuple(loops))
