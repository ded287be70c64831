"""Loop closures: the correction of the chain, and what estimators make of them."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from loops import CLOSED, ROUND, Returned, Rounds, drive_rounds
from simulated import (
    RIG,
    Drive,
    assert_same_bits,
    observations,
    play,
    play_directly,
    simulate,
    visible,
)
from smoothing import FREE, PIXELS, build

from fgslam.backend.considered import shares
from fgslam.backend.loops import (
    CLOSURE_FACTOR,
    FREE as UNMEASURED,
    Chain,
    Constraint,
    DriveRecord,
    changes,
    corrected,
    home_changes,
    nearest_positive,
    rigid_motions,
    rotated,
    transported,
)
from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import (
    BatchSettings,
    EkfSettings,
    EstimatorSettings,
    FixedLagSettings,
    InvariantEkfSettings,
    Isam2Settings,
    LandmarkKalmanSettings,
    SlidingWindowSettings,
)
from fgslam.backend.smoothers.graph import LONG_UNSEEN, found_again
from fgslam.backend.smoothers.lag import SlidingWindowSolver
from fgslam.backend.smoothers.smoother import MapSmoother
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import pose
from fgslam.core.sensors import Increment, LoopClosure, Observations, Odometry
from fgslam.core.store import restore, state_of
from fgslam.core.types import EgoMotion, EgoMotionStatus, Estimate
from fgslam.evaluation.statistics import pose_nees
from fgslam.factors.graphs import landmark_key, poses_of_frame
from fgslam.frontend.tracking.ego_motion import unmeasured

# ------------------------------------------------------------------------------------------
# Backward correction: the least weighted changes to a chain under which a loop closes


COUNT = 41
STEP = g.se3_exp(np.array([0.0, 2.0 * np.pi / 40, 0.0, 0.0, 0.0, 0.3]))
"""Forty of them are a round."""
SIGMA = np.array([1e-3, 4e-3, 1e-3, 5e-3, 5e-3, 1e-2])
TIGHT = 1e-8 * np.eye(6)
NO_IDS = observations(np.empty(0, np.int64), np.empty((0, 3)), np.ones(3), np.empty(0, np.bool_))


def chained(steps: list[FloatArray]) -> FloatArray:
    poses = [np.eye(4)]
    for step in steps:
        poses.append(g.reorthonormalise(poses[-1] @ step))
    return np.array(poses)


def drifted(rng: np.random.Generator, scale: float = 1.0) -> FloatArray:
    noise = [g.se3_exp(scale * SIGMA * rng.standard_normal(6)) for _ in range(COUNT - 1)]
    return chained([STEP @ xi for xi in noise])


def uncertain(count: int = COUNT) -> FloatArray:
    return np.tile(np.diag(SIGMA**2), (count, 1, 1))


def home(covariance: FloatArray = TIGHT, motion: FloatArray | None = None) -> Constraint:
    return Constraint(0, COUNT - 1, np.eye(4) if motion is None else motion, covariance)


def apart(a: FloatArray, b: FloatArray) -> float:
    return float(max(np.abs(g.se3_log(g.inverse(x) @ y)).max() for x, y in zip(a, b, strict=True)))


def test_the_loop_is_met_and_the_first_pose_stays(rng: np.random.Generator) -> None:
    poses, motion = drifted(rng), g.se3_exp(np.array([0.01, 0.2, 0.0, 0.1, 0.0, -0.2]))
    before = poses.copy()
    found, _ = corrected(poses, uncertain(), [home(motion=motion)])
    np.testing.assert_array_equal(poses, before)
    assert apart(found[:1], poses[:1]) < 1e-9
    assert apart(found[-1:], motion[None]) < 1e-4
    assert apart(found, poses) > 0.05


@pytest.mark.parametrize("every", [3, 10, 100])
def test_submaps_give_the_solution_of_single_frames(every: int, rng: np.random.Generator) -> None:
    """To first order the frames within a submap have their shares from the formula."""
    poses, steps = drifted(rng, 1e-3), uncertain()
    steps[1:] *= rng.uniform(0.2, 5.0, (COUNT - 1, 1, 1)) ** 2
    tight = 1e-6 * np.diag(SIGMA**2)
    across = Constraint(4, 23, g.inverse(poses[4]) @ poses[22] @ STEP, tight)
    loops = [home(tight), across]
    single, least = corrected(poses, steps, loops, every=1)
    found, cost = corrected(poses, steps, loops, every)
    moved = apart(single, poses)
    assert apart(found, single) < 1e-3 * moved
    np.testing.assert_allclose(cost, least, rtol=1e-3)


def test_the_cost_of_true_loops_is_chi_square(rng: np.random.Generator) -> None:
    """With six degrees of freedom: the drift's covariance is the steps' sum."""
    costs = [corrected(drifted(rng, 0.2), 0.04 * uncertain(), [home()])[1] for _ in range(60)]
    assert 6.0 - 4.0 * np.sqrt(12.0 / 60.0) < np.mean(costs) < 6.0 + 4.0 * np.sqrt(12.0 / 60.0)


def test_frames_take_the_share_of_a_closure_that_the_whole_solution_gives(
    rng: np.random.Generator,
) -> None:
    """As a motion of the world, to first order; what is before the loop's earlier end stays."""
    poses, steps = drifted(rng), uncertain()
    chain = Chain(list(poses), list(steps))
    covariance = np.diag(SIGMA**2)
    off = g.se3_exp(1e-4 * rng.standard_normal(6))
    motion = g.inverse(poses[7]) @ poses[-1] @ off
    loop = Constraint(7, COUNT - 1, motion, CLOSURE_FACTOR**2 * covariance)
    found, _ = corrected(poses, steps, [loop], every=1)
    moved = np.array([g.se3_log(each) for each in changes(poses, found)])
    whole = g.se3_log(poses[7] @ motion @ g.inverse(poses[-1]))
    closed = LoopClosure(7, motion, covariance, NO_IDS, np.empty((0, 2), np.int64))
    taken = shares(chain, closed)
    np.testing.assert_allclose(taken @ whole, moved, rtol=0.0, atol=1e-2 * np.abs(moved).max())
    assert np.abs(moved[:8]).max() < 1e-9 < np.abs(moved[8:]).max()


def test_unknown_step_takes_the_whole_correction(rng: np.random.Generator) -> None:
    poses, steps = drifted(rng), uncertain()
    steps[17] = UNMEASURED
    found, _ = corrected(poses, steps, [home()])
    assert apart(found[:17], poses[:17]) < 1e-4
    moved = changes(poses, found)
    for k in range(18, COUNT):
        np.testing.assert_allclose(moved[k], moved[17], rtol=0, atol=1e-3)
    assert apart(found[-1:], np.eye(4)[None]) < 1e-4


def test_a_floor_is_kept(rng: np.random.Generator) -> None:
    """Steps without variance upwards and in tilt: the correction stays level."""
    level = np.diag([0.0, 1.0, 0.0, 1.0, 0.0, 1.0])
    noise = [g.se3_exp(level @ SIGMA * rng.standard_normal(6)) for _ in range(COUNT - 1)]
    poses = chained([STEP @ xi for xi in noise])
    loop = home(np.diag([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2]) ** 2)
    found, _ = corrected(poses, uncertain() * level, [loop])
    assert apart(found, poses) > 0.005
    assert np.abs(found[:, 1, 3]).max() < 1e-4
    assert np.abs(found[:, 1, [0, 2]]).max() < 1e-4


def test_steps_between_some_frames_add_up(rng: np.random.Generator) -> None:
    chain = Chain()
    for k in range(COUNT):
        chain.append(np.eye(4) if k == 0 else STEP, (1.0 + k) * np.diag(SIGMA**2))
    frames = np.array([0, 3, 4, 20])
    found = chain.steps_between(frames)
    for i, (a, b) in enumerate(itertools.pairwise(frames), start=1):
        covariance = np.zeros((6, 6))
        for k in range(a + 1, b + 1):
            covariance = g.compose_covariance(STEP, covariance, chain.steps[k])
        np.testing.assert_allclose(found[i], covariance, rtol=1e-6, atol=1e-10)


def test_points_move_with_the_frame_that_they_belong_to(rng: np.random.Generator) -> None:
    before, after = drifted(rng), drifted(rng)
    homes = np.array([3, -1, 40, 3])
    points = rng.standard_normal((4, 3))
    covariances = np.tile(np.diag([1.0, 4.0, 9.0]), (4, 1, 1))
    by = home_changes(homes, changes(before, after))
    moved, turned = transported(by, points), rotated(by, covariances)
    for i, frame in enumerate(homes):
        if frame < 0:
            np.testing.assert_array_equal(moved[i], points[i])
            np.testing.assert_array_equal(turned[i], covariances[i])
            continue
        local = g.transform_to_camera(before[frame], points[[i]])
        np.testing.assert_allclose(
            moved[[i]], g.transform_to_world(after[frame], local), atol=1e-12
        )
        rotation = after[frame][:3, :3] @ before[frame][:3, :3].T
        np.testing.assert_allclose(turned[i], rotation @ covariances[i] @ rotation.T, atol=1e-12)


def test_the_nearest_positive_matrix() -> None:
    turn = g.so3_exp(np.array([0.3, -0.2, 0.9]))
    mixed = turn @ np.diag([2.0, -1.0, 0.5]) @ turn.T
    np.testing.assert_allclose(
        nearest_positive(mixed), turn @ np.diag([2.0, 0.0, 0.5]) @ turn.T, atol=1e-14
    )


def test_many_motions_are_those_of_single_ones(rng: np.random.Generator) -> None:
    sizes = np.array([0.0, 1e-9, 5e-4, 2e-3, 0.1, 1.0, 3.0])
    twists = sizes[:, None] * rng.standard_normal((7, 6))
    expected = np.array([g.se3_exp(twist) for twist in twists])
    np.testing.assert_allclose(rigid_motions(twists), expected, rtol=0, atol=1e-13)


def test_an_uncertain_loop_is_overruled_by_loops_that_agree(rng: np.random.Generator) -> None:
    poses, steps = chained([STEP] * (COUNT - 1)), uncertain()
    wrong = g.inverse(poses[2]) @ poses[30] @ g.se3_exp(np.array([0, 0.3, 0, 0.5, 0, 0.5]))
    sure = 1e-6 * np.eye(6)
    others = [Constraint(a, b, g.inverse(poses[a]) @ poses[b], sure) for a, b in ((0, 28), (3, 33))]
    believed, _ = corrected(poses, steps, [*others, Constraint(2, 30, wrong, sure)])
    weighed, _ = corrected(poses, steps, [*others, Constraint(2, 30, wrong, sure, uncertain=True)])
    assert apart(weighed, poses) < 0.05 * apart(believed, poses)


# ------------------------------------------------------------------------------------------
# What a filter keeps of its drive: which steps were measured, and what ties a frame to a place


_TRACKED = np.diag([1e-6] * 6)
_WHEELS = np.diag([1e-4] * 6)


def _forward(metres: float) -> FloatArray:
    return pose(np.eye(3), np.array([0.0, 0.0, metres]))


def _tracking(wTc: FloatArray, used: int, matched: int) -> EgoMotion:
    return EgoMotion(
        wTc=wTc,
        covariance=_TRACKED,
        inliers=np.arange(matched) < used,
        residuals=np.zeros(matched),
        status=EgoMotionStatus.OK,
        iterations=3,
    )


def _add_frame(record: DriveRecord, metres: float, used: int = 80, matched: int = 100) -> None:
    """A frame tracked so far on from the last one, where the wheels say 0.1 m."""
    here = _forward(metres) if not len(record.chain) else record.chain.poses[-1] @ _forward(metres)
    odometry = Odometry(_forward(0.1), _WHEELS)
    record.step(_forward(metres), _tracking(here, used, matched), odometry, free=False)


def _closure(frame: int, oTc: FloatArray) -> LoopClosure:
    nothing = Observations(
        np.empty(0, np.int64),
        np.empty((0, 3)),
        np.empty((0, 3, 3)),
        np.empty((0, 3, 2)),
        np.empty(0, np.bool_),
    )
    return LoopClosure(frame, oTc, _TRACKED, nothing, np.empty((0, 2), np.int64))


def test_a_frame_most_of_whose_matches_contradict_it_measured_no_step() -> None:
    """Nor is the step back from it one: both are the odometry's."""
    record = DriveRecord()
    for metres, used in ((0.0, 80), (0.1, 80), (0.9, 49), (-0.7, 80), (0.1, 50)):
        _add_frame(record, metres, used)
    chain = record.chain
    assert [p[2, 3] for p in chain.poses] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    for step, expected in zip(
        chain.steps, (_TRACKED, _TRACKED, _WHEELS, _WHEELS, _TRACKED), strict=True
    ):
        np.testing.assert_array_equal(step, expected)


def test_without_odometry_the_tracked_step_is_all_there_is() -> None:
    """A chain needs its steps."""
    record = DriveRecord()
    record.step(np.eye(4), _tracking(np.eye(4), 80, 100), None, free=False)
    record.step(_forward(0.9), _tracking(_forward(0.9), 10, 100), None, free=False)
    assert record.chain.poses[-1][2, 3] == 0.9


def test_a_jump_of_the_tracking_does_not_make_a_true_closure_impossible() -> None:
    """0.8 m in one frame are 800 deviations of a tracked step; the closure knows better."""
    for used, taken in ((80, False), (30, True)):
        record = DriveRecord()
        _add_frame(record, 0.0)
        for k in range(1, 40):
            _add_frame(record, 0.9 if k == 20 else 0.1, used if k == 20 else 80)
        found = record.close(_closure(0, _forward(3.9)), record.chain.poses[-1], "frame 39")
        assert (found is not None) is taken, record.remarks
    (closure,) = record.chain.constraints
    np.testing.assert_allclose(closure.covariance, CLOSURE_FACTOR**2 * _TRACKED)


def test_a_few_old_landmarks_among_many_new_ones_tie_a_frame_to_nothing() -> None:
    """They are far away as a rule, and do not say where the frame is."""
    record = DriveRecord()
    poses = []
    for k in range(120):
        _add_frame(record, 0.1 if k else 0.0)
        poses.append(record.chain.poses[-1])
    tracking = _tracking(poses[-1], 80, 100)
    new = np.full(30, 110)
    record.tie(np.concatenate([np.full(20, 3), new]), poses, tracking, free=False)
    assert not record.chain.constraints
    record.tie(np.concatenate([np.full(31, 3), new]), poses, tracking, free=False)
    (tie,) = record.chain.constraints
    assert (tie.before, tie.after) == (3, 119)


def test_incoherent_frame_is_not_tied_to_old_landmarks() -> None:
    """Wherever its landmarks come from."""
    record = DriveRecord()
    poses = []
    for k in range(120):
        _add_frame(record, 0.1 if k else 0.0, 80 if k < 119 else 40)
        poses.append(record.chain.poses[-1])
    record.tie(np.full(40, 3), poses, _tracking(poses[-1], 40, 100), free=False)
    assert not record.chain.constraints


def test_restored_record_continues_after_an_incoherent_frame() -> None:
    """The step back is the odometry's, also after a restart."""
    one, other = (DriveRecord() for _ in range(2))
    for metres, used in ((0.0, 80), (0.1, 80), (0.9, 20)):
        _add_frame(one, metres, used)
    restore(other, state_of(one))
    for record in (one, other):
        _add_frame(record, -0.7)
    np.testing.assert_array_equal(one.chain.poses, other.chain.poses)
    np.testing.assert_array_equal(one.chain.steps, other.chain.steps)


@pytest.mark.parametrize("matched", [0, 1, 5])
def test_the_step_from_a_frame_without_a_pose_of_its_own_was_measured(matched: int) -> None:
    """It began the landmarks that the next one was tracked by; stray matches change nothing."""
    record = DriveRecord()
    _add_frame(record, 0.0)
    odometry, here = Odometry(_forward(0.1), _WHEELS), _forward(0.1)
    failed = replace(_tracking(here, 0, matched), status=EgoMotionStatus.TOO_FEW_MATCHES)
    record.step(_forward(0.1), failed, odometry, free=False)
    _add_frame(record, 0.13)
    assert record.chain.poses[-1][2, 3] == pytest.approx(0.23)
    np.testing.assert_array_equal(record.chain.steps[-1], _TRACKED)


# ------------------------------------------------------------------------------------------
# Loop closures and relocalised frames in every estimator, on a simulated drive that returns


CLOSING: dict[str, EstimatorSettings] = {
    "landmark_kalman": LandmarkKalmanSettings(),
    "ekf": EkfSettings(),
    "invariant_ekf": InvariantEkfSettings(),
    "fixed_lag": FixedLagSettings(),
    "sliding_window": SlidingWindowSettings(),
    "isam2": Isam2Settings(),
    "isam2, keyframes": Isam2Settings(keyframe_every=4),
    "batch": BatchSettings(),
}
REVISING = [name for name in CLOSING if name not in ("ekf", "invariant_ekf", "fixed_lag")]
"""Those that correct what lies behind."""
SEED = 4
LIE = (0.0, 0.5, 0.0, 1.0, 0.0, 0.5)
every = pytest.mark.parametrize("name", CLOSING)


@cache
def returned(lies: bool = False, seed: int = SEED) -> Returned:
    rounds = Rounds(lies=((CLOSED, LIE),) if lies else ())
    return drive_rounds(rounds, np.random.default_rng(seed))


@cache
def at_end(name: str, lies: bool, /) -> tuple[Estimator, Estimate]:
    """The estimator and its answer after the drive; the loop was closed, or a wrong one refused."""
    estimator = build(CLOSING[name])
    play(estimator, returned(lies).increments, FREE)
    return estimator, estimator.estimate()


def errors(estimate: Estimate, drive: Returned) -> FloatArray:
    poses = estimate.trajectory.poses
    return np.linalg.norm(poses[:, :3, 3] - drive.poses[: len(poses), :3, 3], axis=1)


@every
def test_the_camera_is_back_in_the_old_map(name: str) -> None:
    without, after = (errors(at_end(name, lies)[1], returned()) for lies in (True, False))
    assert without[CLOSED:].mean() > 0.08
    # Where it drove the first time it is right to a few centimetres.
    assert after[CLOSED:].mean() < 0.6 * without[CLOSED:].mean()
    if name in REVISING:
        late = slice(2 * ROUND // 3, CLOSED)
        assert after[late].mean() < 0.75 * without[late].mean()
        assert after.max() < without.max()


def test_a_loop_within_the_sliding_window_is_a_factor_more() -> None:
    """The window does not move along as one piece, nor the drive's start with it."""
    drive = returned()
    increments = drive.increments[: CLOSED + 1]
    estimator = build(SlidingWindowSettings(window=len(drive.increments), update_every=5))
    online = play(estimator, increments, FREE)
    before = errors(at_end("sliding_window", True)[1], drive)[CLOSED]
    off = np.linalg.norm(online[-1].wTc[:3, 3] - drive.poses[CLOSED, :3, 3])
    assert off < 0.6 * before
    assert isinstance(estimator, MapSmoother)
    solver = estimator.solver
    assert isinstance(solver, SlidingWindowSolver)
    np.testing.assert_allclose(solver.poses[0], drive.poses[0], rtol=0, atol=1e-6)


def test_a_loop_within_the_window_turns_a_part_that_only_a_guess_joined() -> None:
    """Ten frames that see nothing known, guessed to be turned by 100 degrees, then a loop."""
    drive = simulate(Drive(frames=20, points=120), np.random.default_rng(2))
    turned = g.pose(g.so3_exp(np.array([0.0, np.deg2rad(170.0), 0.0])), np.zeros(3))
    increments, seen, none = [], set[int](), np.empty(0, np.int64)
    for k, each in enumerate(drive.increments):
        observed, step = each.observations, each.odometry
        if k >= 10:
            new = np.array([i not in seen for i in observed.ids])
            seen |= set(observed.ids.tolist())
            observed = replace(observed, ids=observed.ids + 1000, is_new=new)
        if k == 10:
            assert step is not None
            step = Odometry(step.motion @ turned, 1e-4 * np.eye(6), measured=False)
        plain = replace(each, missed_ids=none, pruned_ids=none, observations=observed)
        rejected = np.zeros(len(observed), np.bool_)
        increments.append(replace(plain, odometry=step, rejected=rejected))
    back = g.inverse(drive.poses[5]) @ drive.poses[19]
    loop = LoopClosure(5, back, 1e-6 * np.eye(6), NO_IDS, np.empty((0, 2), np.int64))
    increments[-1] = replace(increments[-1], loops=(loop,))
    estimator = build(SlidingWindowSettings())
    stats = play_directly(estimator, increments, FREE)
    assert stats[-1].closed == (True,)
    off = np.linalg.norm(stats[-2].wTc[:3, 3] - drive.poses[18, :3, 3])
    assert off > 0.5, "before it is closed"
    assert np.linalg.norm(stats[-1].wTc[:3, 3] - drive.poses[19, :3, 3]) < 0.03
    found = estimator.estimate().trajectory.poses
    assert np.linalg.norm(found[:, :3, 3] - drive.poses[:, :3, 3], axis=1).max() < 0.05


def test_a_loop_within_a_lag_so_long_that_it_drifts_is_closed_and_a_wrong_one_refused() -> None:
    """The drift in between explains the one and not the other; nothing moves as one piece."""
    off, remarks = [], []
    for lies in (False, True):
        drive = returned(lies)
        estimator = build(FixedLagSettings(lag_frames=len(drive.increments)))
        online = play(estimator, drive.increments[: CLOSED + 1], FREE)
        off.append(np.linalg.norm(online[-1].wTc[:3, 3] - drive.poses[CLOSED, :3, 3]))
        found = estimator.estimate()
        remarks.append(next(r for r in found.remarks if "loop closure to frame" in r))
        first, meant = found.trajectory.poses[0], drive.poses[0]
        np.testing.assert_allclose(first, meant, rtol=0, atol=1e-6)
    assert off[0] < 0.6 * off[1]
    assert "the camera moved by" in remarks[0]
    assert "within the lag" in remarks[0]
    assert "refused" in remarks[1]


@every
def test_old_landmarks_stay_and_their_doubles_go(name: str) -> None:
    drive = returned()
    merged = drive.increments[CLOSED].loops[0].merged
    landmarks = at_end(name, False)[1].landmarks
    assert len(merged) > 10
    assert not np.isin(merged[:, 0], landmarks.ids).any()
    assert np.isin(merged[:, 1], landmarks.ids).all()
    off = np.linalg.norm(landmarks.positions - drive.points_by_id[landmarks.ids], axis=1)
    old = landmarks.rows(np.unique(merged[:, 1]))
    assert np.median(off[old]) < 0.15


@every
def test_a_wrong_loop_is_refused_and_changes_nothing(name: str) -> None:
    drive, (_, found) = returned(lies=True), at_end(name, True)
    reported = [words for words in found.remarks if "loop closure to frame" in words]
    assert len(reported) == 1
    assert "refused" in reported[0]
    if name not in ("landmark_kalman", "isam2", "batch"):
        return
    straight = build(CLOSING[name])
    play(straight, [dataclasses.replace(x, loops=()) for x in drive.increments], FREE)
    offset = found.trajectory.poses[:, :3, 3] - straight.estimate().trajectory.poses[:, :3, 3]
    # Frames that wait for an update of iSAM2 are hurried by a loop, refused or not; the lie is of
    # a metre at the end.
    assert np.abs(offset).max() < (0.01 if name == "isam2" else 1e-12)


@pytest.mark.parametrize("name", ["ekf", "invariant_ekf", "isam2, keyframes", "sliding_window"])
def test_state_and_replay_keep_every_bit_over_a_loop(name: str) -> None:
    increments = returned().increments
    straight = at_end(name, False)[0]
    first, second = build(CLOSING[name]), build(CLOSING[name])
    play_directly(first, increments[: CLOSED + 2], FREE)
    restore(second, {key: np.array(array) for key, array in state_of(first).items()})
    play_directly(second, increments[CLOSED + 2 :], FREE)
    assert_same_bits(state_of(second), state_of(straight))
    assert_same_bits(second.estimate(), straight.estimate())
    assert second.estimate().remarks == straight.estimate().remarks


@pytest.mark.parametrize("name", [name for name in CLOSING if "ekf" not in name])
def test_a_loop_that_leads_nowhere_is_an_error(name: str) -> None:
    """The full filter asks for the landmarks, not for the frame."""
    increments = returned().increments[:6]
    loop = dataclasses.replace(returned().increments[CLOSED].loops[0], frame=5)
    estimator = build(CLOSING[name])
    play(estimator, increments[:5], FREE)
    with pytest.raises(EstimatorError, match="does not come before it"):
        play(estimator, [dataclasses.replace(increments[5], loops=(loop,))], FREE)


def test_a_second_closure_that_agrees_moves_nothing() -> None:
    increments = list(returned().increments)
    k, loop = CLOSED + 3, increments[CLOSED].loops[0]
    oTc = g.inverse(returned().poses[loop.frame]) @ returned().poses[k]
    again = dataclasses.replace(loop, oTc=oTc, covariance=25.0 * loop.covariance)
    increments[k] = dataclasses.replace(increments[k], loops=(again,))
    estimator = build(BatchSettings())
    play(estimator, increments, FREE)
    reported = [words for words in estimator.estimate().remarks if "loop closure" in words]
    assert len(reported) == 2
    assert "nothing moved" in reported[1]


def test_a_landmark_counts_as_found_again_from_its_first_return_on() -> None:
    frames = np.array([70, 71, 71 + LONG_UNSEEN, 72 + LONG_UNSEEN, 5, 4 + LONG_UNSEEN])
    variables = np.array([1, 1, 1, 1, 3, 3])
    expected = np.array([False, False, True, True, False, False])
    for order in (np.arange(6), np.array([5, 2, 0, 4, 3, 1])):
        np.testing.assert_array_equal(found_again(frames[order], variables[order]), expected[order])


def found_again_where_expected(estimator: Any, count: int) -> None:
    """Old landmarks, found again at the drifted pose where the drifted map has them: all wrong."""
    builder, solver = estimator.builder, estimator.solver
    frame = builder.frames[-1]
    pose = poses_of_frame(solver.values, frame)
    seen, when = builder.observed["variable"], builder.observed["frame"]
    old = np.setdiff1d(seen, seen[when > frame - LONG_UNSEEN])
    points = {v: solver.values.atPoint3(landmark_key(v)) for v in old.tolist()}
    local = g.transform_to_camera(pose, np.array(list(points.values())))
    rows = np.flatnonzero(visible(RIG, local))[:count]
    assert len(rows) == count
    builder.observed.append(
        {
            "frame": np.full(count, frame),
            "variable": np.array(list(points))[rows],
            "measurement": RIG.predict(local[rows]),
            "covariance": np.tile(0.04 * np.eye(3), (count, 1, 1)),
            "gone": np.zeros(count, np.bool_),
        }
    )
    again = found_again(*builder.kept_observed()[:2])
    assert again[-count:].all()
    assert not again[:-count].any()


@pytest.mark.parametrize("more", [False, True])
def test_the_larger_number_of_matches_decides_between_two_returns(more: bool) -> None:
    """A few landmarks found again by chance do not keep a loop from closing; many do."""
    before, closing = returned().increments[:CLOSED], returned().increments[CLOSED]
    (loop,) = closing.loops
    estimator = build(BatchSettings())
    play(estimator, before, FREE)
    found_again_where_expected(estimator, 9)
    if more:
        loop = dataclasses.replace(loop, observations=loop.observations.select(np.arange(5)))
    play(estimator, [dataclasses.replace(closing, loops=(loop,))], FREE)
    (remark,) = (each for each in estimator.estimate().remarks if "loop closure" in each)
    assert ("refused" in remark) == more, remark


@pytest.mark.slow
@pytest.mark.parametrize("name", ["isam2", "batch"])
def test_covariances_are_consistent_after_a_loop(name: str) -> None:
    """NEES of the pose midway and of the last one, over 30 drives: within its chi-square band."""
    values = {ROUND // 2: [], -1: []}
    for seed in range(30):
        drive = returned(seed=seed)
        estimator = build(CLOSING[name])
        play(estimator, drive.increments, FREE)
        estimate = estimator.estimate()
        for k, found in values.items():
            one = slice(k, None) if k == -1 else slice(k, k + 1)
            nees = pose_nees(
                estimate.trajectory.poses[one], estimate.covariances[one], drive.poses[one]
            )
            found.append(nees.per_dof)
    for found in values.values():
        assert abs(np.mean(found) - 1.0) < 4.0 * np.sqrt(2.0 / (6.0 * 30.0)), found


# --------------------------------------------------------------------------------------------
# Carried off


def carried_off(relocalised: bool) -> tuple[FloatArray, list[Increment]]:
    """Twenty frames of a drive, then frames 8 to 13 again, while the wheels say that it went on."""
    rng = np.random.default_rng(11)
    simulation = simulate(Drive(frames=20, points=120, prune_after=1000), rng)
    poses, increments = list(simulation.poses), list(simulation.increments)
    for k in range(8, 14):
        earlier, last = increments[k], len(increments)
        noise = PIXELS * rng.standard_normal(earlier.observations.measurement.shape)
        seen = dataclasses.replace(
            earlier.observations,
            measurement=earlier.observations.measurement + noise,
            is_new=np.zeros(len(noise), np.bool_),
        )
        step = Odometry(g.se3_exp(np.array(Drive().twist)), 1e-4 * np.eye(6))
        increments.append(
            dataclasses.replace(
                earlier,
                index=2 * last,
                timestamp=0.5 * last,
                odometry=step,
                observations=seen,
                rejected=np.zeros(len(noise), np.bool_),
                relocalised=relocalised and k == 8,
            )
        )
        poses.append(simulation.poses[k])
    return np.array(poses), increments


@pytest.mark.parametrize("name", [name for name in CLOSING if name != "isam2, keyframes"])
def test_relocalised_robot_is_where_its_landmarks_are(name: str) -> None:
    poses, increments = carried_off(relocalised=True)
    estimator = build(CLOSING[name])
    stats = play(estimator, increments, FREE)
    online = np.array([s.wTc[:3, 3] for s in stats]) - poses[:, :3, 3]
    assert np.linalg.norm(online[20:], axis=1).max() < 0.05
    final = estimator.estimate().trajectory.poses[:, :3, 3] - poses[:, :3, 3]
    assert np.linalg.norm(final, axis=1).max() < 0.05


@pytest.mark.parametrize("settings", [LandmarkKalmanSettings(), SlidingWindowSettings()])
@pytest.mark.parametrize(("late", "found", "sigma_m"), [
    (0.5, False, 30.0), (5.0, False, 0.2), (5.0, True, 30.0)
])  # fmt: skip
def test_only_a_gap_in_time_leaves_the_guess_what_it_is(
    settings: EstimatorSettings, late: float, found: bool, sigma_m: float
) -> None:
    """Five seconds without frames at two a second; a frame in time was carried anywhere."""
    increments = simulate(Drive(frames=8, points=60), np.random.default_rng(2)).increments
    estimator = build(settings)
    play(estimator, increments, FREE)
    last, guess = increments[-1], Odometry(np.eye(4), 0.04 * np.eye(6), measured=False)
    seen = last.observations
    new = replace(seen, ids=seen.ids + 1000, is_new=np.ones(len(seen), np.bool_))
    after = replace(
        Increment.of(20, last.timestamp + late, guess),
        observations=new, rejected=~new.is_new, relocalised=found,
    )  # fmt: skip
    tracking = unmeasured(estimator.predict(guess), EgoMotionStatus.TOO_FEW_MATCHES)
    estimator.update(after, tracking)
    covariance = estimator.estimate().covariances[-1]
    np.testing.assert_allclose(np.sqrt(covariance[5, 5]), sigma_m, rtol=0.3, atol=0)
