"""Consider covariance: what is not estimated, in the covariances reported."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
from loops import CLOSED, Rounds, drive_rounds
from scipy import stats
from simulated import RIG, Simulation, assert_same_bits, play
from smoothing import FREE, drawn, run

from fgslam.backend import considered
from fgslam.backend.considered import (
    SAMPLES,
    ConsiderCovariance,
    ErrorColumns,
    SampledErrors,
    lacking,
    rates_of,
    read_late,
    shared_covariance,
)
from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.persistence import StatedNoise
from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import (
    BatchSettings,
    EkfSettings,
    EstimatorSettings,
    FixedLagSettings,
    InvariantEkfSettings,
    Isam2Settings,
    KernelSettings,
    LandmarkKalmanGraphSettings,
    LandmarkKalmanSettings,
)
from fgslam.backend.smoothers.elimination import Bordered
from fgslam.backend.smoothers.final import Refined, shifts, with_uncertain_rig
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.correction import (
    SHARED,
    RigCorrection,
    field_modes,
    prior_information,
    shared_displacements,
    shared_information,
    term_names,
)
from fgslam.core.sensors import CameraRig, Increment, SettledRig
from fgslam.core.store import restore, state_of
from fgslam.core.types import Floor, LandmarkMap, Prediction, UpdateStats
from fgslam.evaluation.statistics import nees, pose_errors, pose_nees, within
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem
from fgslam.slam.build import make_estimator

# ------------------------------------------------------------------------------------------
# Columns of errors: whatever comes and goes, each landmark has its own, and where it was


_COUNT = 4


def test_columns_are_their_landmarks_whatever_comes_and_goes() -> None:
    rng = np.random.default_rng(3)
    columns, expected = ErrorColumns(_COUNT), dict[int, np.ndarray]()
    for _ in range(60):
        gone = rng.permutation(sorted(expected))[: rng.integers(0, 9)]
        columns.forget(np.sort(gone).astype(np.int64))
        for identity in gone.tolist():
            del expected[identity]
        ids = np.setdiff1d(rng.integers(0, 200, rng.integers(0, 12)), sorted(expected))
        new = rng.standard_normal((len(ids), 3, _COUNT))
        columns.append({"ids": ids, "columns": new})
        expected |= dict(zip(ids.tolist(), new, strict=True))
        state = state_of(columns)
        assert state["order/ids"].tolist() == sorted(expected)
        kept = state["map/columns"][state["order/row"]]
        assert np.array_equal(kept, [expected[i] for i in sorted(expected)])
    again = ErrorColumns(_COUNT)
    again.append({"ids": np.array([7]), "columns": np.ones((1, 3, _COUNT))})
    restore(again, state)
    asked = np.array([*sorted(expected), 999])
    found = [*(expected[i] for i in sorted(expected)), np.zeros((3, _COUNT))]
    assert np.array_equal(again.kept("columns", asked), found)


@pytest.mark.parametrize("size_m", [1e-3, 1.0, 1e5])
def test_only_what_has_no_variance_in_a_direction_lacks_some_however_large(size_m: float) -> None:
    far, flat = size_m**2 * np.array([np.diag([1e-6, 1e-6, 1.0]), np.diag([0.0, 1.0, 1.0])])
    added = lacking(np.array([far, flat]))
    assert not added[0].any()
    assert 0.0 < np.linalg.eigvalsh(flat + added[1]).min() < 1e-6 * size_m**2


# ------------------------------------------------------------------------------------------
# Covariances that the per-landmark filter reports, against its errors


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
        landmarks.append(nees(truth - found.landmarks.positions, found.landmarks.covariances))
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
        exact = RIG.predict(g.transform_to_camera(wTc, drive.points_by_id[seen.ids]))
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
        seen_shifts = original(self, wTc, seen)
        seen_shifts.shift[:, :, -SAMPLES:] = pattern(seen.measurement)[:, :, None]
        return seen_shifts

    monkeypatch.setattr(SampledErrors, "linearised", known)
    monkeypatch.setattr(considered, "symmetric_root", lambda covariance: np.zeros((6, 6)))
    increments = drawn(2, noise=0.0).increments
    size = 1e-4
    plain = played(increments, update=update)
    moved = played([with_pattern(each, size) for each in increments], update=update)
    step = g.se3_log(g.inverse(plain.predict(None).wTc) @ moved.predict(None).wTc) / size
    state = state_of(plain)
    column = state["errors/pose_columns"][:, -1]
    np.testing.assert_allclose(column, step, rtol=0.0, atol=1e-2 * np.abs(step).max())
    before, after = plain.landmarks(), moved.landmarks()
    shift = (after.positions - before.positions) / size
    np.testing.assert_array_equal(state["errors/order/ids"], before.ids)
    columns = state["errors/map/columns"][state["errors/order/row"], :, -1]
    np.testing.assert_allclose(columns, shift, rtol=0.0, atol=1e-2 * np.abs(shift).max())


def test_covariances_of_few_samples_are_stated_larger_so_that_the_nees_is_right(
    rng: np.random.Generator,
) -> None:
    errors = SampledErrors(EgoMotionSolver(RIG, FREE))
    state = state_of(errors)
    found = []
    for _ in range(400):
        columns = np.zeros_like(state["pose_columns"])
        columns[:, -SAMPLES:] = rng.standard_normal((6, SAMPLES))
        error = rng.standard_normal((1, 6))
        restore(errors, state | {"pose_columns": columns})
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
    reported = estimator.estimate().covariances
    known = reported[7]
    for each, covariance in zip(blind, reported[8:], strict=True):
        assert each.odometry is not None
        known = g.compose_covariance(each.odometry.motion, known, each.odometry.covariance)
        ratio = np.diagonal(covariance) / np.diagonal(known)
        assert (ratio > 0.5).all()
        assert (ratio < 2.0).all()


def test_estimates_do_not_depend_on_what_is_reported() -> None:
    increments = drawn(4).increments
    sampled, own = played(increments), played(increments, None)
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


@pytest.mark.parametrize(("matches", "drives"), [(1000, 2), (3, 2)])
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
        errors = nees(truth - found.positions, found.covariances)
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


# ------------------------------------------------------------------------------------------
# What the uncertainty of a rig adds to a graph's covariances, against a graph that estimates it


EXACT = RigCorrection.none(dataclasses.replace(RIG, exact=True))
CALIBRATED = RigCorrection.none(dataclasses.replace(RIG, exact=False))
STATED = RigCorrection.none(dataclasses.replace(RIG, exact=False, stated=True))
"""Of a rig that no drive corrects."""

ONLINE: dict[str, EstimatorSettings] = {
    "landmark_kalman": LandmarkKalmanSettings(),
    "landmark_kalman_graph": LandmarkKalmanGraphSettings(),
    "ekf": EkfSettings(),
    "invariant_ekf": InvariantEkfSettings(),
    "isam2": Isam2Settings(noise_factor=1.0),
    "fixed_lag": FixedLagSettings(lag_frames=5, noise_factor=1.0),
}
NO_FLOOR = Floor.under(RIG, 6)

ALL = (*term_names(RIG), *SHARED, *(f"mode {k}" for k in range(field_modes(RIG))))
OF_SHARED = slice(len(term_names(RIG)), len(term_names(RIG)) + len(SHARED))
UNEVEN = dataclasses.replace(CALIBRATED, field_px=0.3)


@cache
def solved(seed: int = 3, shift: tuple[float, ...] = (0.0,) * len(ALL)) -> Refined:
    """A drive's graph at its minimum, its measurements displaced by terms of the correction."""
    settings = BatchSettings(kernel=KernelSettings("none"), trim=False, noise_factor=1.0)
    increments = [displaced(each, np.array(shift)) for each in drawn(seed, frames=12).increments]
    estimator: Any = run(settings, increments)[0]
    found: Refined = estimator.solver.refined()
    return found


def displaced(increment: Any, by: FloatArray) -> Any:
    seen = increment.observations
    moved = seen.measurement + shifts(RIG, seen.measurement, field=True) @ by
    observations = dataclasses.replace(seen, measurement=moved)
    return dataclasses.replace(increment, observations=observations)


def test_covariances_are_those_of_a_graph_with_the_correction_as_a_variable() -> None:
    refined = solved()
    found = with_uncertain_rig(refined, EXACT)
    system = refined.graph.linear(refined.state)
    poses = 6 * len(system.pose_keys)
    every = np.r_[: system.columns, -poses:0]  # without what makes a last pair
    information = system.in_pairs.toarray()[np.ix_(every, every)]
    p = len(EXACT.values)
    measured = refined.graph.seen.measured
    pull, own = refined.graph.pulled(
        refined.state, lambda rows: shifts(RIG, measured[rows])[..., :p]
    )
    whole = np.block([[information, pull], [pull.T, own + prior_information(RIG)]])
    covariance = np.linalg.inv(whole)
    columns, k = system.columns, len(found.covariance)
    scale = np.abs(covariance).max()
    last = columns + 6 * 11 + np.arange(6)
    np.testing.assert_allclose(
        found.poses()[11], covariance[np.ix_(last, last)], rtol=1e-5, atol=1e-9 * scale
    )
    np.testing.assert_allclose(
        found.landmarks()[0], covariance[:3, :3], rtol=1e-5, atol=1e-9 * scale
    )
    np.testing.assert_allclose(found.covariance, covariance[-k:, -k:], rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("term", ["left.yaw", "focal", "all.radial", "baseline", "mode 25"])
def test_poses_move_with_a_wrong_rig_as_their_gains_say(term: str) -> None:
    """By some tenths of a pixel; to first order."""
    by = (0.3 if "mode" in term else 0.1 / RIG.fx) * (np.array(ALL) == term)
    refined, moved = solved(), solved(3, tuple(by))
    found = with_uncertain_rig(refined, UNEVEN)
    before, after = refined.state.poses, moved.state.poses
    steps = np.array([g.se3_log(step) for step in g.inverse(before) @ after])
    gain = (found.gain[found.held.system.columns :] @ by).reshape(-1, 6)
    size = np.abs(steps).max()
    assert size > 5e-5
    share = 0.1 if "mode" in term else 0.05  # small modes: noise leaves other derivatives
    np.testing.assert_allclose(gain, steps, rtol=0.0, atol=share * size)


def test_images_far_off_against_each_other_are_taken_to_be_off_as_far() -> None:
    refined, shared = solved(), OF_SHARED
    column = np.eye(len(EXACT.values))[0]

    def of(left_px: float) -> FloatArray:
        """Covariance of what is shared, the left image so far to the right."""
        moved = dataclasses.replace(CALIBRATED, values=left_px / RIG.fx * column)
        found = with_uncertain_rig(refined, moved)
        return found.covariance[shared, shared]

    np.testing.assert_allclose(of(0.3), of(0.0))
    # 2 pixels in each of three images
    np.testing.assert_allclose(of(4.0), 4.0 * of(0.0), rtol=1e-6)


def test_a_frame_without_observations_shares_nothing() -> None:
    none = shared_displacements(RIG, np.empty((0, RIG.cameras, 2)))
    assert none.shape == (0, 2 * RIG.cameras, len(SHARED))


def test_what_is_shared_is_as_large_as_stated() -> None:
    information = shared_information(RIG, 0.2)
    rng = np.random.default_rng(4)
    drawn_terms = rng.multivariate_normal(np.zeros(len(SHARED)), np.linalg.inv(information), 4000)
    grid = np.stack(
        np.meshgrid(np.linspace(0, RIG.width - 1, 9), np.linspace(0, RIG.height - 1, 9))
    )
    pixels = np.repeat(grid.reshape(2, -1).T[:, None], RIG.cameras, axis=1)
    moved = shared_displacements(RIG, pixels)[:, :2, :-1] @ drawn_terms[:, :-1].T
    assert np.sqrt((moved**2).sum(axis=1).mean()) == pytest.approx(0.2, rel=0.1)
    focal = drawn_terms[:, SHARED.index("focal")].std()
    assert drawn_terms[:, -1].std() == pytest.approx(focal, rel=0.05)


def pose_nees_per_dof(poses: FloatArray, covariances: FloatArray, truth: FloatArray) -> float:
    nees = pose_nees(poses, covariances, truth)
    return float(nees.values.sum() / nees.dof.sum())


@pytest.mark.parametrize(
    ("rig", "drives"),
    [(CALIBRATED, 12), (STATED, 12), pytest.param(UNEVEN, 48, marks=pytest.mark.slow)],
    ids=["terms", "as stated", "field"],
)
def test_rigs_that_are_off_as_assumed_leave_consistent_poses(
    rig: RigCorrection, drives: int
) -> None:
    """Calibrations, and fields, drawn as off as they are taken to be; NEES of the drives."""
    rng = np.random.default_rng(5)
    found, held = [], []
    for k in range(drives):
        seed = k % 12
        exact, truth = solved(seed), drawn(seed, frames=12).poses[1:]
        assumed = with_uncertain_rig(exact, rig).covariance
        by = rng.multivariate_normal(np.zeros(len(assumed)), assumed)
        refined = solved(seed, tuple(np.pad(by, (0, len(ALL) - len(by)))))
        poses = refined.poses()[1:]
        both = with_uncertain_rig(refined, rig)
        found.append(pose_nees_per_dof(poses, both.poses()[1:], truth))
        held.append(pose_nees_per_dof(poses, both.held.poses()[1:], truth))
    assert np.mean(held) > 2.0
    assert 0.75 < np.mean(found) < 1.25


UNCORRECTED = np.zeros(len(EXACT.values))
"""What a rig that calibrates itself applies before it has found anything."""


def increments_of(
    frames: int, applied: FloatArray | None = UNCORRECTED, field_px: float = 0.0
) -> list[Increment]:
    """The first frames of a drive, measured with a correction."""
    increments = drawn(3, frames=12).increments[:frames]
    settled = SettledRig(0, 0, field_px)
    return [
        dataclasses.replace(each, rig_correction=applied, settled_rig=settled)
        for each in increments
    ]


def driven(frames: int, floor: Floor = NO_FLOOR, field_px: float = 0.0) -> ConsiderCovariance:
    """After the first frames of a drive, at its true poses."""
    online = ConsiderCovariance(CALIBRATED.rig, floor)
    seen = increments_of(frames, field_px=field_px)
    for increment, wTc in zip(seen, drawn(3, frames=12).poses, strict=False):
        online.observe(increment, wTc)
    return online


@pytest.mark.parametrize("term", ["column", "focal", "radial", "baseline"])
def test_a_landmark_seen_once_lies_where_a_wrong_rig_has_it(term: str) -> None:
    by = 1e-3 / RIG.fx * (np.array(ALL) == term)
    first = drawn(3, frames=12).increments[0].observations
    moved = first.measurement + shifts(RIG, first.measurement, field=True) @ by
    before, after = RIG.triangulate(first.measurement), RIG.triangulate(moved)
    turned = (after - before) @ drawn(3, frames=12).poses[0][:3, :3].T
    gain = state_of(driven(1))["map/columns"][..., : len(SHARED)] @ by[OF_SHARED]
    np.testing.assert_allclose(gain, turned, rtol=1e-3, atol=1e-4 * np.abs(turned).max())


def whole(rig: RigCorrection = CALIBRATED) -> Bordered:
    refined = solved()
    return with_uncertain_rig(refined, rig)


@pytest.mark.parametrize("rig", [CALIBRATED, UNEVEN], ids=["terms", "field"])
def test_the_newest_pose_is_as_uncertain_as_the_whole_graph_has_it(rig: RigCorrection) -> None:
    """Within a factor of two: a filter does not go back to earlier poses."""
    shared = slice(len(EXACT.values), None)
    found = whole(rig)
    gain = found.gain[-6:, shared]
    known = np.diagonal(gain @ found.covariance[shared, shared] @ gain.T)
    ratio = np.sqrt(np.diagonal(driven(12, field_px=rig.field_px).of_pose()) / known)
    assert (ratio > 0.5).all()
    assert (ratio < 2.0).all(), ratio


def test_a_hard_floor_keeps_the_uncertainty_within_what_it_allows() -> None:
    floor = Floor.under(RIG, 3)
    last, added = drawn(3, frames=12).poses[-1], driven(12, floor).of_pose()
    assert np.linalg.matrix_rank(added, tol=1e-9 * np.trace(added)) == 3
    np.testing.assert_allclose(floor.allowed_part(last, added), added, atol=1e-12)


@pytest.mark.parametrize("kind", ["landmark_kalman", "landmark_kalman_graph", "ekf", "isam2"])
def test_online_covariances_of_a_calibrated_rig_hold_its_error_and_of_an_exact_one_none(
    kind: str,
) -> None:
    settings = ONLINE[kind]

    def last(rig: CameraRig, applied: FloatArray | None) -> UpdateStats:
        estimator = make_estimator(rig, settings, FREE)
        return play(estimator, increments_of(12, applied), FREE, rig)[-1]

    exact, calibrated = last(EXACT.rig, UNCORRECTED), last(CALIBRATED.rig, UNCORRECTED)
    as_stated = last(CALIBRATED.rig, None)
    # Another number of columns, all zero, is multiplied in another order.
    np.testing.assert_allclose(exact.covariance, as_stated.covariance, rtol=1e-12)
    np.testing.assert_array_equal(exact.wTc, calibrated.wTc)
    np.testing.assert_allclose(
        calibrated.covariance - exact.covariance, driven(12).of_pose(), rtol=0.5, atol=1e-4
    )
    assert np.trace(calibrated.covariance) > 1.2 * np.trace(exact.covariance)


@pytest.mark.parametrize("kind", ["landmark_kalman", "ekf", "fixed_lag"])
def test_filters_report_landmarks_as_uncertain_as_their_rig_leaves_them(kind: str) -> None:
    def after(rig: CameraRig) -> Estimator:
        estimator = make_estimator(rig, ONLINE[kind], FREE)
        play(estimator, increments_of(12), FREE, rig)
        return estimator

    exact, calibrated = after(EXACT.rig), after(CALIBRATED.rig)
    matched, reported = exact.estimate().landmarks, calibrated.estimate().landmarks
    more = reported.covariances - matched.covariances
    assert np.linalg.eigvalsh(more).min() > -1e-12
    assert np.median(np.trace(more, axis1=1, axis2=2)) > 1e-6
    # Matching needs a landmark's place relative to the camera, which shares the rig's error.
    np.testing.assert_array_equal(calibrated.landmarks().covariances, exact.landmarks().covariances)
    added = calibrated.estimate().covariances - exact.estimate().covariances
    assert np.trace(added[-1]) > 0.2 * np.trace(exact.estimate().covariances[-1])


@pytest.mark.parametrize("kind", ["landmark_kalman", "ekf"])
def test_a_restored_filter_of_an_uncertain_rig_continues_to_the_same_bits(kind: str) -> None:
    increments = increments_of(12, field_px=0.3)
    through, first, second = (make_estimator(CALIBRATED.rig, ONLINE[kind], FREE) for _ in range(3))
    play(through, increments, FREE)
    play(first, increments[:7], FREE)
    restore(second, dict(sorted(state_of(first).items())))  # as a saved map's session has it
    play(second, increments[7:], FREE)
    assert_same_bits(second.estimate(), through.estimate())


@pytest.mark.parametrize("kind", ["landmark_kalman", "isam2"])
def test_sigmas_hold_what_a_calibration_leaves_where_no_drive_corrects_it(kind: str) -> None:
    """Shares within two sigmas; all terms are off as calibrations are taken to be."""
    rng, p = np.random.default_rng(8), len(STATED.values)
    online, final = [], []
    for seed in range(6):
        terms = np.zeros(len(ALL))
        terms[:p] = rng.multivariate_normal(np.zeros(p), STATED.covariance)
        drive = drawn(seed, frames=12)
        estimator = make_estimator(STATED.rig, ONLINE[kind], FREE)
        seen = [displaced(each, terms) for each in drive.increments]
        stats, found = play(estimator, seen, FREE, STATED.rig)[1:], estimator.estimate()
        poses = (np.array([each.wTc for each in stats]), found.trajectory.poses[1:])
        covariances = (np.array([each.covariance for each in stats]), found.covariances[1:])
        for share, its, known in zip((online, final), poses, covariances, strict=True):
            share.append(within(pose_errors(its, drive.poses[1:]), known))
    assert min(np.mean(online), np.mean(final)) > 0.85, (online, final)
    exact = make_estimator(EXACT.rig, ONLINE[kind], FREE)
    known = play(exact, seen, FREE, EXACT.rig)[-1].covariance
    assert np.trace(stats[-1].covariance) > 10.0 * np.trace(known)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["landmark_kalman", "ekf"])
def test_reported_sigmas_of_rigs_a_pixel_off_hold_errors_of_poses_and_landmarks(kind: str) -> None:
    """Shares within two sigmas over 50 drives, each with a calibration of its own."""
    covariance, rng = shared_covariance(CALIBRATED), np.random.default_rng(6)
    online, final, landmarks = [], [], []
    for seed in range(50):
        terms = np.zeros(len(ALL))
        terms[OF_SHARED] = rng.multivariate_normal(np.zeros(len(SHARED)), covariance)
        drive = drawn(seed)
        increments = [
            dataclasses.replace(displaced(each, terms), rig_correction=UNCORRECTED)
            for each in drive.increments
        ]
        estimator = make_estimator(CALIBRATED.rig, ONLINE[kind], FREE)
        stats = play(estimator, increments, FREE, CALIBRATED.rig)[1:]
        found = estimator.estimate()
        truth, places = drive.poses[1:], drive.points_by_id[found.landmarks.ids]
        poses = (
            np.array([each.wTc for each in stats]),
            np.array([each.covariance for each in stats]),
        )
        online.append(within(pose_errors(poses[0], truth), poses[1]))
        last = found.trajectory.poses[1:], found.covariances[1:]
        final.append(within(pose_errors(last[0], truth), last[1]))
        landmarks.append(within(places - found.landmarks.positions, found.landmarks.covariances))
    shares = [float(np.mean(each)) for each in (online, final, landmarks)]
    assert min(shares) > 0.88, shares
    assert max(shares) < 0.99, shares


# ------------------------------------------------------------------------------------------
# Rows that are not read at one moment


ROLLING = dataclasses.replace(CALIBRATED.rig, readout_s=0.02)


def test_a_moving_camera_sees_points_of_a_row_from_where_it_is_then() -> None:
    """To first order: a hundredth of the read-out is taken, and as much of the displacement."""
    rng, seconds = np.random.default_rng(8), 2e-4
    points = rng.uniform([-1.0, -0.8, 1.5], [1.0, 0.8, 4.0], (40, 3))
    rate = np.array([0.4, -1.2, 0.7, 0.2, -0.1, 0.3])
    stamps, path = np.array([0.0, 0.1]), np.array([np.eye(4), g.se3_exp(0.1 * rate)])
    np.testing.assert_allclose(rates_of(stamps, path), [rate, rate], atol=1e-12)
    middle = RIG.predict(points)
    then = np.array([g.se3_exp(rate * seconds * (r / RIG.height - 0.5)) for r in middle[:, 1]])
    late = RIG.predict(g.transform_to_camera(then[0], points))
    for k, wTc in enumerate(then):
        late[k] = RIG.predict(g.transform_to_camera(wTc, points[k : k + 1]))[0]
    by_pose = RIG.jacobian(points) @ g.point_pose_jacobian(points)
    moved = seconds * read_late(RIG, middle, by_pose, rate[None])[:, :, 0]
    np.testing.assert_allclose(late - middle, moved, atol=2e-3 * np.abs(moved).max())


def test_the_first_frame_s_landmarks_wait_for_how_the_camera_moves() -> None:
    """They lean by its motion, which one pose does not tell; then the read-out is considered.

    Of a camera that turns evenly it moves little: all its images are skewed alike.
    """
    drive, none = drawn(3, frames=12, twist=(0.0, 0.3, 0.0, 0.01, 0.0, 0.08)), NO_FLOOR
    seen = [dataclasses.replace(each, rig_correction=UNCORRECTED) for each in drive.increments]
    rolling, known = ConsiderCovariance(ROLLING, none), ConsiderCovariance(CALIBRATED.rig, none)
    for online in (rolling, known):
        online.observe(seen[0], drive.poses[0])
    assert not len(state_of(rolling)["order/ids"])
    assert len(state_of(known)["order/ids"])
    for online in (rolling, known):
        for increment, wTc in zip(seen[1:], drive.poses[1:], strict=True):
            online.observe(increment, wTc)
    more = rolling.of_pose() - known.of_pose()
    lowest, *_, highest = np.linalg.eigvalsh(more)
    assert highest > np.deg2rad(0.01) ** 2
    assert lowest > -1e-9 * highest
    assert state_of(rolling)["order/ids"].tolist() == state_of(known)["order/ids"].tolist()
