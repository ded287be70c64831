"""Factors from measurements."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from simulated import RIG, Drive, Simulation, observations, play, simulate, tracked_at
from smoothing import (
    FREE,
    PIXELS,
    SMOOTHERS,
    admit_at_once,
    answer,
    assert_finite,
    ate,
    build,
    drawn,
    keep,
    moved,
    run,
    unseen,
)

from fgslam.backend.settings import BatchSettings, EstimatorSettings, GraphSettings
from fgslam.backend.smoothers import admission
from fgslam.backend.smoothers.graph import GraphBuilder, NewFactors, TrackedFrame
from fgslam.core import geometry as g
from fgslam.core.errors import EstimatorError
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.types import Estimate, Floor, LandmarkMap, Prediction
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.evaluation.judging import Truth, judge_replay
from fgslam.evaluation.statistics import judge, nees
from fgslam.factors.graphs import is_pose, landmark_key, pose_key
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.slam.replay import replay
from fgslam.worlds.settings import (
    MeasurementDriveSettings,
    SimulatedMeasurementsSettings,
)

# ------------------------------------------------------------------------------------------
# Admission of landmarks to the graph: which wait, enter, start again, and are reported


ORIGIN = Prediction(np.eye(4), np.zeros((6, 6)))
STEP = g.se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.1]))
EACH = ("batch", "isam2, keyframes", "fixed_lag", "sliding_window")
"""A smoother of each way to solve."""
GRAPHS = pytest.mark.parametrize("name", EACH)
OFTEN = 28
"""In the drive of seed 8, a landmark that is seen in nearly every frame from the first on."""


def builder(**settings: object) -> GraphBuilder:
    return GraphBuilder(RIG, GraphSettings(**settings), Floor.under(RIG, 6), ORIGIN)


def frame(k: int, points: dict[int, list[float]], is_new: bool = False) -> TrackedFrame:
    """Frame k of a drive straight ahead, its exact observations of world points."""
    wTc = np.linalg.matrix_power(STEP, k)
    places = np.array(list(points.values())).reshape(-1, 3)
    measured = RIG.predict(g.transform_to_camera(wTc, places))
    seen = observations(
        np.array(list(points), np.int64), measured, PIXELS, np.full(len(points), is_new)
    )
    motion = Odometry(STEP, 1e-4 * np.eye(6)) if k else None
    return TrackedFrame(k, wTc, motion, seen)


def known(points: dict[int, list[float]], sigma: float = 0.02) -> LandmarkMap:
    ids = np.array(sorted(points), np.int64)
    places = np.array([points[i] for i in ids.tolist()]).reshape(-1, 3)
    return LandmarkMap(ids, places, np.tile(sigma**2 * np.eye(3), (len(ids), 1, 1)))


def landmarks_of(made: GraphBuilder, new: NewFactors) -> list[tuple[int, ...]]:
    """Keys of a frame's factors that touch a landmark."""
    graphs = new.graph, made.observation_factors(new)
    factors = [graph.at(row) for graph in graphs for row in range(graph.size())]
    return [tuple(f.keys()) for f in factors if not is_pose(f.keys()[-1])]


# --------------------------------------------------------------------------------------------
# Waiting


def waiting_in(made: GraphBuilder) -> list[int]:
    """Identities of the landmarks outside the graph."""
    ids, variables, _ = made.admission.recent(0)
    return ids[variables < 0].tolist()


def test_a_landmark_waits_for_its_second_sighting_and_loses_none() -> None:
    points = {4: [0.2, 0.1, 3.0]}
    made = builder()
    first = made.add(frame(0, points, True), known(points))
    assert landmarks_of(made, first) == []
    assert waiting_in(made) == [4]
    second = made.add(frame(1, points), known(points))
    key = landmark_key(0)
    assert landmarks_of(made, second) == [(pose_key(0), key), (pose_key(1), key)]
    assert waiting_in(made) == []
    np.testing.assert_array_equal(second.values.atPoint3(key), points[4])


def test_a_variable_is_described_by_its_own_sightings_while_it_is_in_use() -> None:
    points = {4: [0.2, 0.1, 3.0]}
    made = builder()
    for k in range(2):
        made.add(frame(k, points, k == 0), known(points))
    assert made.describe(0) == "landmark 4 (seen 2 times, last from frame 1)"
    made.admission.pruned(np.array([4]))
    assert made.describe(0) == "landmark 4 (no longer in use)"
    for k in range(2, 5):
        made.add(frame(k, points, k == 2), known(points))
    assert made.describe(0) == "landmark 4 (no longer in use)"
    assert made.describe(1) == "landmark 4 (seen 3 times, last from frame 4)"


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [(1.01 / 3, "waits"), (0.99 / 3, "weak"), (1.01 / 8, "weak"), (0.99 / 8, "plain")],
)
def test_parallax_decides_between_waiting_a_weak_prior_and_none(
    sigma: float, expected: str
) -> None:
    """Range over its standard deviation, 3 and 8 by default; here 10 m in the direction of view."""
    points = {7: [0.0, 0.0, 10.0]}
    made = builder()
    made.add(frame(0, points, True), known(points, 10 * sigma))
    # One step nearer the range is 9.9 m.
    new = made.add(frame(1, points), known(points, 9.9 * sigma))
    keys = landmarks_of(made, new)
    prior = (landmark_key(0),)
    assert {"waits": keys == [], "weak": prior in keys, "plain": len(keys) == 2}[expected]
    assert (prior in keys) == (expected == "weak")


def test_the_weak_prior_holds_two_ranges_about_the_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "LEAST_SIGHTINGS", 1)
    points = {7: [3.0, 0.0, 4.0]}
    made = builder()
    new = made.add(frame(0, points, True), known(points, 5.0 / 4))
    rows = [new.graph.at(row) for row in range(new.graph.size())]
    prior = next(f for f in rows if tuple(f.keys()) == (landmark_key(0),))
    new.values.update(landmark_key(0), np.array([3.0, 10.0, 4.0]))
    assert prior.error(new.values) == pytest.approx(0.5)  # one standard deviation: 2 x 5 m


def test_waiting_landmarks_hold_no_information_about_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those seen once enter or wait: the rest of the answer is the same."""
    simulation = drawn(8, frames=9, miss_rate=0.4)
    increments = simulation.increments
    counts = np.bincount(np.concatenate([x.observations.ids for x in increments]))
    once = np.flatnonzero(counts == 1)
    assert len(once)
    settings = BatchSettings(trim=False)
    admit_at_once(monkeypatch)
    inside = answer(settings, increments)
    monkeypatch.setattr(admission, "LEAST_SIGHTINGS", 2)
    waiting = answer(settings, increments)
    without = answer(settings, keep(increments, lambda k, x: ~np.isin(x.observations.ids, once)))
    for other in (without, inside):
        np.testing.assert_allclose(
            other.trajectory.poses, waiting.trajectory.poses, rtol=0, atol=1e-6
        )
        np.testing.assert_allclose(other.covariances, waiting.covariances, rtol=1e-3, atol=1e-12)
    row = waiting.landmarks.rows(once)
    np.testing.assert_allclose(
        inside.landmarks.positions[row], waiting.landmarks.positions[row], rtol=0, atol=1e-4
    )
    np.testing.assert_allclose(
        inside.landmarks.covariances[row], waiting.landmarks.covariances[row], rtol=0.05, atol=1e-6
    )


def test_waiting_landmarks_are_reported_with_a_consistent_covariance() -> None:
    """Landmarks seen once, over many drives: the pose's uncertainty is in their covariance."""
    errors = []
    for seed in range(20):
        simulation = simulate(
            Drive(frames=9, points=60, miss_rate=0.4, odometry_sigma=(0.02,) * 3 + (0.05,) * 3),
            np.random.default_rng(seed),
        )
        found = answer(SMOOTHERS["fixed_lag"], simulation.increments).landmarks
        counts = np.bincount(
            np.concatenate([x.observations.ids for x in simulation.increments]),
            minlength=len(simulation.points_by_id),
        )
        once = np.flatnonzero(counts[found.ids] == 1)
        truth = simulation.points_by_id[found.ids[once]]
        errors.append(nees(truth - found.positions[once], found.covariances[once]))
    verdict = judge(errors)
    assert verdict is not None
    assert verdict.items > 40
    # A single sighting of a far point is no normal error; the band is widened by a fifth.
    assert 0.8 * verdict.lower < verdict.per_dof < 1.2 * verdict.upper, verdict


@GRAPHS
def test_points_without_parallax_wait_and_are_in_the_map(name: str) -> None:
    simulation = simulate(
        Drive(frames=12, points=60, depth_m=(60.0, 200.0), sigma_px=(0.3, 0.3, 0.3)),
        np.random.default_rng(3),
    )
    near = drawn(3, frames=12)
    increments = [joined(a, b) for a, b in zip(near.increments, simulation.increments, strict=True)]
    estimator, _ = run(SMOOTHERS[name], increments)
    found = estimator.estimate()
    assert_finite(found)
    far = found.landmarks.ids[found.landmarks.ids >= SHIFT]
    assert len(far) > 20
    assert ate(found, near) < 0.02
    waiting = [identity for identity in waiting_in(estimator.builder) if identity >= SHIFT]
    assert len(waiting) > 5
    reported = found.landmarks.covariances[found.landmarks.rows(np.array(waiting[:1]))]
    assert np.linalg.eigvalsh(reported[0])[0] > 0.0


SHIFT = 1000


def joined(a: Increment, b: Increment) -> Increment:
    """The landmarks of both, the second's with shifted identities."""
    shifted = dataclasses.replace(b.observations, ids=b.observations.ids + SHIFT)
    keep_front = shifted.measurement[:, 2] > 0.0
    both = a.observations.join(shifted.select(keep_front))
    return dataclasses.replace(a, observations=both, rejected=np.zeros(len(both), np.bool_))


# --------------------------------------------------------------------------------------------
# Moved, pruned, seen again


@pytest.fixture(scope="module")
def drive() -> Simulation:
    return _drive()


@cache
def _drive() -> Simulation:
    return drawn(8, frames=24)


@cache
def undisturbed(name: str) -> Estimate:
    """What an estimator makes of the drive as it is."""
    return answer(SMOOTHERS[name], _drive().increments)


def row_of(estimate, identity: int) -> int:
    return int(estimate.landmarks.rows(np.array([identity]))[0])


@GRAPHS
def test_a_landmark_that_moved_starts_again(name: str, drive: Simulation) -> None:
    place = drive.points_by_id[OFTEN] + [0.3, 0.1, 0.3]
    increments = moved(drive, OFTEN, 8, place, np.random.default_rng(1))
    estimator, _ = run(SMOOTHERS[name], increments)
    found = estimator.estimate()
    reported = [r for r in found.remarks if r.startswith(f"landmark {OFTEN} (seen ")]
    assert len(reported) == 1
    assert "moved, started again" in reported[0]
    offset = found.landmarks.positions[row_of(found, OFTEN)] - place
    covariance = found.landmarks.covariances[row_of(found, OFTEN)]
    assert offset @ np.linalg.solve(covariance, offset) < 16.3
    assert np.sqrt(np.trace(covariance)) < 0.03
    assert ate(found, drive) < 1.3 * ate(undisturbed(name), drive)
    # Its first observations stay with the variable that they were made of.
    variables = estimator.builder.identities
    assert variables.count(OFTEN) == 2


def test_wrong_matches_do_not_start_a_landmark_again(drive: Simulation) -> None:
    """Rejected frame after frame, each time elsewhere."""
    rng = np.random.default_rng(2)
    increments = list(drive.increments)
    for k in range(8, 14):
        aside = drive.points_by_id[OFTEN] + rng.uniform(-0.6, 0.6, 3)
        only = dataclasses.replace(drive, increments=increments)
        increments[k] = moved(only, OFTEN, k, aside, rng)[k]
    for name in EACH:
        found = answer(SMOOTHERS[name], increments)
        assert all(remark.startswith("covariances of motions") for remark in found.remarks)
        offset = found.landmarks.positions[row_of(found, OFTEN)] - drive.points_by_id[OFTEN]
        assert np.linalg.norm(offset) < 0.05


def test_contradictions_count_in_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    points = {1: [0.2, 0.1, 3.0]}
    elsewhere = {1: [0.6, 0.1, 3.0]}
    for after, expected in ((7, [False] * 6), (2, [False, True, False, False, False, True])):
        monkeypatch.setattr(admission, "CONTRADICTED_AFTER", after)
        made = builder()
        made.add(frame(0, points, True), known(points))
        found = []
        for k in range(1, 7):
            here = frame(k, elsewhere)
            if k == 4:
                made.admission.confirmed(np.array([1]))
            gone = made.admission.contradicted(here.accepted, here.wTc)
            found.append(len(gone) == 1)
            if len(gone):
                made.admission.restart([1], "moved")
                made.add(frame(k, points, True), known(points))
            elif k == 4:
                made.admission.confirmed(np.array([1]))
        assert found == expected, after
        assert len(made.admission.remarks) == sum(expected)


@GRAPHS
def test_pruned_landmarks_leave_the_map_and_their_information_stays(
    name: str, drive: Simulation
) -> None:
    increments = list(drive.increments)
    last = increments[-1]
    gone = last.observations.ids[:5]
    increments[-1] = dataclasses.replace(last, pruned_ids=np.union1d(last.pruned_ids, gone))
    kept, pruned = undisturbed(name), answer(SMOOTHERS[name], increments)
    assert not np.isin(gone, pruned.landmarks.ids).any()
    assert np.isin(gone, kept.landmarks.ids).all()
    rows = kept.landmarks.rows(pruned.landmarks.ids)
    # Pruned in the very frame that saw them, they lose that frame's sighting, and no other.
    np.testing.assert_allclose(pruned.trajectory.poses, kept.trajectory.poses, rtol=0, atol=3e-3)
    np.testing.assert_allclose(pruned.covariances[-2], kept.covariances[-2], rtol=0.1, atol=1e-7)
    np.testing.assert_allclose(
        pruned.landmarks.positions, kept.landmarks.positions[rows], rtol=0, atol=2e-2
    )


@GRAPHS
def test_a_landmark_seen_again_after_a_gap_under_its_identity(name: str, drive: Simulation) -> None:
    """The lag of five frames has forgotten it by then, and shows where it last was."""
    increments = unseen(drive.increments, OFTEN, range(5, 14))
    truth = drive.points_by_id[OFTEN]
    half, _ = run(SMOOTHERS[name], increments[:13])
    estimator, _ = run(SMOOTHERS[name], increments)
    for found in (half.estimate(), estimator.estimate()):
        offset = found.landmarks.positions[row_of(found, OFTEN)] - truth
        covariance = found.landmarks.covariances[row_of(found, OFTEN)]
        assert offset @ np.linalg.solve(covariance, offset) < 16.3
        assert np.sqrt(np.trace(covariance)) < 0.05
        assert all(remark.startswith("covariances of motions") for remark in found.remarks)
    variables = estimator.builder.identities.count(OFTEN)
    assert variables == (2 if name == "fixed_lag" else 1)


def test_a_pruned_identity_that_comes_back_is_another_landmark(drive: Simulation) -> None:
    """As databases never do, and damaged logs may: it must not join the old variable."""
    increments = list(drive.increments)
    increments[7] = dataclasses.replace(increments[7], pruned_ids=np.array([OFTEN]))
    increments = keep(increments, lambda k, x: np.ones(len(x.observations), np.bool_))
    assert any(OFTEN in x.observations.ids[x.observations.is_new] for x in increments[8:])
    for name in EACH:
        estimator, _ = run(SMOOTHERS[name], increments)
        found = estimator.estimate()
        assert estimator.builder.identities.count(OFTEN) == 2
        offset = found.landmarks.positions[row_of(found, OFTEN)] - drive.points_by_id[OFTEN]
        assert np.linalg.norm(offset) < 0.05


# --------------------------------------------------------------------------------------------
# Numbers that are none


@cache
def undamaged(name: str) -> tuple[list[Increment], Estimate]:
    """A drive and what an estimator makes of it whole."""
    increments = drawn(7, frames=10).increments
    return increments, answer(SMOOTHERS[name], increments)


@pytest.mark.parametrize("name", ["isam2, keyframes", "fixed_lag"])
@pytest.mark.parametrize("what", ["measurement", "covariance", "motion", "motion's covariance"])
def test_what_is_not_finite_is_refused_and_changes_nothing(what: str, name: str) -> None:
    increments, clean = undamaged(name)
    estimator = build(SMOOTHERS[name])
    play(estimator, increments[:6], FREE)
    increment = increments[6]
    tracking = tracked_at(
        estimator.predict(increment.odometry), int((~increment.observations.is_new).sum())
    )
    with pytest.raises(EstimatorError, match=f"frame {increment.index}: .* not finite") as caught:
        estimator.update(damaged(increment, what), tracking)
    assert "\n" not in str(caught.value)
    play(estimator, increments[6:], FREE)
    found = estimator.estimate()
    assert_finite(found)
    np.testing.assert_array_equal(found.trajectory.poses, clean.trajectory.poses)
    np.testing.assert_array_equal(found.landmarks.covariances, clean.landmarks.covariances)


def damaged(increment: Increment, what: str) -> Increment:
    """One number of it is no number."""
    seen, odometry = increment.observations, increment.odometry
    assert odometry is not None
    arrays = {
        "measurement": seen.measurement.copy(),
        "covariance": seen.covariance.copy(),
        "motion": odometry.motion.copy(),
        "motion's covariance": odometry.covariance.copy(),
    }
    arrays[what].flat[3] = np.inf
    seen = dataclasses.replace(
        seen, measurement=arrays["measurement"], covariance=arrays["covariance"]
    )
    odometry = Odometry(arrays["motion"], arrays["motion's covariance"])
    return dataclasses.replace(increment, observations=seen, odometry=odometry)


# --------------------------------------------------------------------------------------------
# Behind a camera


def test_behind_names_variables_that_any_of_their_cameras_has_behind_it() -> None:
    points = {1: [0.2, 0.1, 3.0], 2: [0.0, 0.1, 4.0], 3: [0.0, -0.1, 5.0]}
    made = builder()
    for k in range(3):
        seen = {i: at for i, at in points.items() if i != 3 or k < 2}
        made.add(frame(k, seen, k == 0), known(points))
    poses = np.array([np.linalg.matrix_power(STEP, k) for k in range(3)])
    places = dict(enumerate(np.array(list(points.values()))))
    assert made.behind(poses, places) == []
    # Between the second and the third camera: behind the third, which saw 1 and 2 only.
    between = np.array([0.0, 0.0, 0.15])
    assert made.behind(poses, places | {1: between, 2: between}) == [1]
    assert made.behind(poses, {0: places[0], 2: -places[2]}) == [2]
    words = made.take_out(2)
    assert words == "landmark 3 (seen 2 times, last from frame 1)"
    assert not made.in_graph(2)
    assert made.behind(poses, {0: places[0], 1: places[1]}) == []


@pytest.mark.parametrize("name", ["batch", "isam2, keyframes"])
def test_landmarks_behind_a_camera_are_removed(
    name: str, drive: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator, _ = run(SMOOTHERS[name], drive.increments)
    variable = estimator.builder.admission.tracks[OFTEN].variable
    answers = [[variable]]
    monkeypatch.setattr(
        estimator.builder, "behind", lambda poses, points: answers.pop() if answers else []
    )
    found = estimator.estimate()
    assert_finite(found)
    assert len(found.remarks) == 1
    assert found.remarks[0].startswith(f"landmark {OFTEN} (seen ")
    assert "came out behind a camera" in found.remarks[0]
    assert ate(found, drive) < 0.01
    # It is still in the map, from its last sighting.
    offset = found.landmarks.positions[row_of(found, OFTEN)] - drive.points_by_id[OFTEN]
    assert np.linalg.norm(offset) < 0.2


# ------------------------------------------------------------------------------------------
# Drives without odometry that start, stop and turn harder than a moment before


HARD = SimulatedMeasurementsSettings(
    stop=60, drive=MeasurementDriveSettings(frames=111, max_speed_m_s=5.0, max_turn_deg_s=90.0)
)
"""Up to 54 deviations squared a number, as the last ten frames have them, in a single step."""


def pose_nees(settings: EstimatorSettings, seed: int) -> float:
    drive = open_measurements(HARD, seed, ConstantVelocitySettings())
    played = replay(drive.log, settings, EgoMotionSettings(dof=3))
    found = judge_replay(played, Truth(drive.ground_truth, None)).metrics.nees_pose_per_dof
    assert found is not None
    return found


def test_a_step_that_was_not_foreseen_does_not_pull_the_path() -> None:
    """Without the kernel 2.4."""
    assert np.mean([pose_nees(BatchSettings(), seed) for seed in (2, 5)]) < 1.2
