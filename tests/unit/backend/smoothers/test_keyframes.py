"""Keyframes and the frames between them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG, Drive, Simulation, play, simulate
from smoothing import (
    FREE,
    answer,
    assert_consistent,
    assert_finite,
    ate,
    blackout,
    build,
    drawn,
    moved,
)

from fgslam.backend.settings import Isam2Settings
from fgslam.backend.smoothers.graph import Solution, TrackedFrame
from fgslam.backend.smoothers.keyframes import Segments, fill_between, summarise
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import Observations, Odometry
from fgslam.core.types import Floor, LandmarkMap

# ------------------------------------------------------------------------------------------
# Poses between keyframes: held by what they saw and by the odometry, as uncertain as they are


SIX_DOF = Floor.under(RIG, 6)
KNOWN = [0, 4, 8]
"""Frames whose poses are in the graph."""

LITTLE = np.diag([1e-9] * 3 + [1e-8] * 3)


def solved(simulation: Simulation, total: int) -> Solution:
    """The graph's answer: the truth, with small covariances."""
    poses, covariances = np.full((total, 4, 4), np.nan), np.full((total, 6, 6), np.nan)
    for k in KNOWN:
        if k < total:
            poses[k], covariances[k] = simulation.poses[k], LITTLE
    points = dict(enumerate(simulation.points_by_id))
    return Solution(poses, covariances, points, {v: 1e-6 * np.eye(3) for v in points})


def tracked(simulation: Simulation, total: int, sees: bool = True) -> list[TrackedFrame]:
    frames = []
    for k in range(total):
        if k not in KNOWN:
            seen = simulation.increments[k].observations
            seen = seen if sees else seen.select(np.empty(0, np.int64))
            motion = simulation.increments[k].odometry
            frames.append(TrackedFrame(k, simulation.poses[k], motion, seen))
    return frames


def filled(
    simulation: Simulation, total: int = 11, sees: bool = True, floor: Floor = SIX_DOF
) -> Solution:
    motions = [x.odometry for x in simulation.increments[:total]]
    variables = {i: i for i in range(len(simulation.points_by_id))}
    frames = tracked(simulation, total, sees)
    return fill_between(RIG, floor, solved(simulation, total), frames, motions, variables)


def offsets(found: Solution, simulation: Simulation) -> FloatArray:
    pairs = zip(found.poses, simulation.poses, strict=False)
    return np.array([g.se3_log(g.inverse(a) @ b) for a, b in pairs])


def test_without_noise_poses_between_are_the_truth() -> None:
    simulation = drawn(1, noise=0.0)
    for sees in (True, False):
        found = filled(simulation, sees=sees)
        np.testing.assert_allclose(found.poses, simulation.poses[:11], rtol=0, atol=1e-7)
        assert np.isfinite(found.pose_covariances).all()


@pytest.mark.parametrize("sees", [True, False])
def test_covariances_of_frames_between_are_consistent(sees: bool) -> None:
    """The graph's poses are exact here, and claim nearly that."""
    values = []
    for seed in range(12):
        simulation = drawn(seed)
        found = filled(simulation, sees=sees)
        error = offsets(found, simulation)
        for k in (1, 2, 3, 5, 6, 7, 9, 10):
            values.append(error[k] @ np.linalg.solve(found.pose_covariances[k], error[k]) / 6)
    assert 0.75 < np.mean(values) < 1.25


def test_blind_frames_are_most_uncertain_in_the_middle_and_beyond_the_end() -> None:
    found = filled(drawn(2), sees=False)
    size = np.trace(found.pose_covariances, axis1=1, axis2=2)
    assert size[2] > max(size[1], size[3]) > min(size[1], size[3]) > size[0]
    assert size[10] > size[9] > size[8]
    held = filled(drawn(2), total=9, sees=False)
    np.testing.assert_allclose(held.poses, found.poses[:9], rtol=0, atol=1e-6)


def test_wrong_matches_are_gated_and_the_odometry_bridges_too_few() -> None:
    simulation = drawn(3)
    increments = list(simulation.increments)
    seen = increments[2].observations
    measured = seen.measurement.copy()
    measured[::5] += [40.0, -30.0, 3.0]
    increments[2] = dataclasses.replace(
        increments[2], observations=dataclasses.replace(seen, measurement=measured)
    )
    increments[6] = dataclasses.replace(
        increments[6], observations=increments[6].observations.select(np.arange(3))
    )
    found = filled(dataclasses.replace(simulation, increments=increments))
    plain = filled(simulation)
    assert np.abs(offsets(found, simulation)[2]).max() < 0.02
    ratio = np.trace(found.pose_covariances[6]) / np.trace(plain.pose_covariances[6])
    assert ratio > 3.0


def test_the_less_certain_neighbour_counts() -> None:
    simulation = drawn(4)
    variables = {i: i for i in range(len(simulation.points_by_id))}
    motions: list[Odometry | None] = [x.odometry for x in simulation.increments[:9]]
    frames = tracked(simulation, 9)
    before = solved(simulation, 9)
    plain = fill_between(RIG, SIX_DOF, before, frames, motions, variables).pose_covariances
    unsure = before.pose_covariances.copy()
    unsure[4] += 1e-3 * np.eye(6)
    other = dataclasses.replace(before, pose_covariances=unsure)
    found = fill_between(RIG, SIX_DOF, other, frames, motions, variables).pose_covariances
    for k in (1, 2, 3, 5, 6, 7):
        assert np.linalg.eigvalsh(found[k] - plain[k])[0] > 1e-4


def test_a_hard_floor_is_kept() -> None:
    simulation = drawn(5, twist=(0.0, 0.03, 0.0, 0.0, 0.0, 0.08))
    found = filled(simulation, floor=Floor.under(RIG, 3))
    assert np.abs(found.poses[:, 1, 3]).max() < 1e-4
    for k in (1, 5, 10):
        covariance = found.pose_covariances[k]
        top = np.abs(covariance).max()
        assert np.linalg.matrix_rank(covariance, hermitian=True, tol=1e-9 * top) == 3


def test_a_frame_whose_landmarks_all_came_out_behind_it_is_left_to_the_odometry() -> None:
    simulation = drawn(3)
    before = solved(simulation, 3)
    pose = simulation.poses[1]
    backwards = pose[:3, 3] - 5.0 * pose[:3, 2]
    points = {v: backwards + 0.1 * before.points[v] for v in before.points}
    behind = dataclasses.replace(before, points=points)
    motions = [x.odometry for x in simulation.increments[:3]]
    frames = tracked(simulation, 3)
    found = fill_between(RIG, SIX_DOF, behind, frames, motions, {v: v for v in points})
    blind = filled(simulation, total=3, sees=False)
    np.testing.assert_allclose(found.poses, blind.poses, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.pose_covariances, blind.pose_covariances, rtol=1e-6)


# ------------------------------------------------------------------------------------------
# Keyframes: a block's summary holds the information of its frames, each pose counted once


KEYFRAMES = Isam2Settings(keyframe_every=5)


def frames_of(noise: float, count: int = 5) -> tuple[list[TrackedFrame], LandmarkMap]:
    """Frames at their true poses, and the true map."""
    simulation = simulate(Drive(frames=count, points=40, noise=noise), np.random.default_rng(4))
    frames = [
        TrackedFrame(k, simulation.poses[k], x.odometry, x.observations)
        for k, x in enumerate(simulation.increments)
    ]
    points = simulation.points_by_id
    ids = np.arange(len(points))
    return frames, LandmarkMap(ids, points, np.tile(1e-4 * np.eye(3), (len(ids), 1, 1)))


# --------------------------------------------------------------------------------------------
# The summary


def test_a_block_of_one_frame_is_that_frame() -> None:
    frames, landmarks = frames_of(1.0)
    fused = summarise(RIG, [frames[1]], frames[1], landmarks)
    own = frames[1].accepted
    order = np.argsort(own.ids)
    np.testing.assert_array_equal(fused.ids, own.ids[order])
    np.testing.assert_allclose(fused.measurement, own.measurement[order], rtol=0, atol=1e-9)
    np.testing.assert_allclose(fused.covariance, own.covariance[order], rtol=1e-9, atol=1e-12)


def by_points(
    frames: list[TrackedFrame], middle: FloatArray, identity: int
) -> tuple[FloatArray, FloatArray]:
    """Least squares of one landmark from known poses, in metric space, as seen from the middle."""
    seen = [
        (g.inverse(f.wTc) @ middle, f.accepted.select(f.accepted.ids == identity)) for f in frames
    ]
    seen = [(fTm, one) for fTm, one in seen if len(one)]
    fTm, one = seen[0]
    point = g.transform_to_camera(fTm, RIG.triangulate(one.measurement))[0]
    for _ in range(10):
        information, gradient = np.zeros((3, 3)), np.zeros(3)
        for fTm, one in seen:
            local = (fTm[:3, :3] @ point + fTm[:3, 3])[None]
            jacobian = RIG.jacobian(local)[0] @ fTm[:3, :3]
            weight = np.linalg.inv(one.covariance[0])
            information += jacobian.T @ weight @ jacobian
            gradient += jacobian.T @ weight @ (one.measurement[0] - RIG.predict(local)[0])
        point = point + np.linalg.solve(information, gradient)
    by_point = RIG.jacobian(point[None])[0]
    return RIG.predict(point[None])[0], by_point @ np.linalg.inv(information) @ by_point.T


def test_it_is_the_batch_of_its_frames_where_their_poses_are_exact() -> None:
    frames, landmarks = frames_of(1.0)
    fused = summarise(RIG, frames, frames[2], landmarks)
    assert len(fused) > 20
    for i, identity in enumerate(fused.ids.tolist()):
        measured, covariance = by_points(frames, frames[2].wTc, identity)
        sigma = np.sqrt(np.diagonal(covariance))
        assert np.abs((fused.measurement[i] - measured) / sigma).max() < 1e-2
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(fused.covariance[i] / scale, covariance / scale, atol=2e-2)


def test_what_is_behind_or_without_disparity_stays_out() -> None:
    frames, landmarks = frames_of(1.0)
    seen = int(frames[1].accepted.ids[0])
    positions = landmarks.positions.copy()
    positions[seen] = g.transform_to_world(frames[1].wTc, np.array([[0.1, 0.1, -2.0]]))[0]
    wrong = LandmarkMap(landmarks.ids, positions, landmarks.covariances)
    fused = summarise(RIG, frames[1:3], frames[1], wrong)
    whole = summarise(RIG, frames[1:3], frames[1], landmarks)
    assert sorted({*whole.ids.tolist()} - {*fused.ids.tolist()}) == [seen]
    assert np.isfinite(fused.measurement).all()
    assert (fused.measurement[:, 2] > 0.0).all()


# --------------------------------------------------------------------------------------------
# What enters when


def test_two_frames_of_a_segment_enter_and_the_motions_add_up() -> None:
    frames, landmarks = frames_of(1.0, 12)
    segments = Segments(RIG, 5)
    entered = [f for frame in frames for f in segments.take(frame, landmarks)]
    assert [f.frame for f in entered] == [0, 3, 5, 8, 10]
    assert [f.frame for f in segments.between] == [1, 2, 4, 6, 7, 9, 11]
    assert entered[0].motion is None
    along = np.eye(4)
    for before, after in zip([0, 3, 5, 8], entered[1:], strict=True):
        step, covariance = np.eye(4), np.zeros((6, 6))
        for frame in frames[before + 1 : after.frame + 1]:
            assert frame.motion is not None
            motion = frame.motion
            covariance = g.compose_covariance(motion.motion, covariance, motion.covariance)
            step = step @ motion.motion
        assert after.motion is not None
        np.testing.assert_allclose(after.motion.motion, step, rtol=0, atol=1e-12)
        np.testing.assert_allclose(after.motion.covariance, covariance, rtol=1e-9, atol=1e-15)
        along = along @ step
    own = entered[2].accepted
    np.testing.assert_array_equal(own.measurement, frames[5].accepted.measurement)


def test_every_frame_enters_as_it_is_where_every_frame_is_a_keyframe() -> None:
    frames, landmarks = frames_of(1.0)
    segments = Segments(RIG, 1)
    for frame in frames:
        (entered,) = segments.take(frame, landmarks)
        assert entered.accepted is frame.accepted
    assert segments.between == []


def nothing(frame: TrackedFrame) -> TrackedFrame:
    none: Observations = frame.accepted.select(np.empty(0, np.int64))
    return dataclasses.replace(frame, accepted=none)


@pytest.mark.parametrize(
    ("blind", "middle"), [([], 3), ([3], 2), ([2, 3], 4), ([1, 2], 3), ([1, 2, 3, 4], 3)]
)
def test_blind_frame_is_never_the_middle_of_a_block(blind: list[int], middle: int) -> None:
    frames, landmarks = frames_of(1.0)
    segments = Segments(RIG, 5)
    for frame in frames:
        frame = nothing(frame) if frame.frame in blind else frame
        last = segments.take(frame, landmarks)
    (entered,) = last
    assert entered.frame == middle
    assert (len(entered.accepted) > 0) == (len(blind) < 4)


def test_observations_of_a_frame_that_saw_too_little_to_be_placed_are_not_fused() -> None:
    frames, landmarks = frames_of(1.0)
    few = dataclasses.replace(frames[1], accepted=frames[1].accepted.select(np.arange(4)))
    segments = Segments(RIG, 5)
    for frame in (frames[0], few, *frames[2:]):
        last = segments.take(frame, landmarks)
    (entered,) = last
    expected = summarise(RIG, frames[2:], frames[3], landmarks)
    np.testing.assert_array_equal(entered.accepted.measurement, expected.measurement)


def test_forgotten_and_pruned_landmarks_leave_the_open_block() -> None:
    frames, landmarks = frames_of(1.0)
    gone, pruned = (int(i) for i in frames[1].accepted.ids[:2])
    rest = np.setdiff1d(landmarks.ids, [pruned])
    smaller = LandmarkMap(rest, landmarks.positions[rest], landmarks.covariances[rest])
    segments = Segments(RIG, 3)
    segments.take(frames[0], landmarks)
    segments.take(frames[1], landmarks)
    segments.forget([gone])
    (entered,) = segments.take(frames[2], smaller)
    assert pruned not in entered.accepted.ids
    row = np.flatnonzero(entered.accepted.ids == gone)
    own = frames[2].accepted
    if gone in own.ids:
        np.testing.assert_allclose(
            entered.accepted.measurement[row], own.measurement[own.ids == gone], atol=1e-9
        )
    else:
        assert len(row) == 0


# --------------------------------------------------------------------------------------------
# In iSAM2


@pytest.mark.slow
@pytest.mark.parametrize("every", [2, 5])
def test_pose_and_landmarks_are_consistent_over_20_drives(every: int) -> None:
    assert_consistent(Isam2Settings(keyframe_every=every))


def test_keyframes_cost_little_accuracy() -> None:
    errors = {}
    for every in (1, 5):
        settings = Isam2Settings(keyframe_every=every)
        errors[every] = [
            ate(answer(settings, simulation.increments), simulation)
            for simulation in (drawn(20 + seed, frames=21) for seed in range(3))
        ]
    assert np.mean(errors[5]) < 1.15 * np.mean(errors[1])


@pytest.mark.parametrize("frames", [1, 4, 9, 13])
def test_every_frame_has_a_pose_wherever_the_run_ends(frames: int) -> None:
    simulation = drawn(9, frames=13)
    estimator = build(KEYFRAMES)
    play(estimator, simulation.increments[:frames], FREE)
    found = estimator.estimate()
    assert_finite(found)
    assert len(found.trajectory) == len(found.covariances) == frames
    offset = found.trajectory.poses[:, :3, 3] - simulation.poses[:frames, :3, 3]
    sigma = np.sqrt(np.trace(found.covariances[:, 3:, 3:], axis1=1, axis2=2))
    assert (np.linalg.norm(offset, axis=1)[1:] < 4 * sigma[1:]).all()


@pytest.mark.parametrize("since", [6, 8])
def test_a_landmark_that_moves_within_a_block(since: int) -> None:
    drive = drawn(8, frames=24)
    place = drive.points_by_id[28] + [0.3, 0.1, 0.3]
    found = answer(KEYFRAMES, moved(drive, 28, since, place, np.random.default_rng(1)))
    row = found.landmarks.rows(np.array([28]))[0]
    offset = found.landmarks.positions[row] - place
    assert offset @ np.linalg.solve(found.landmarks.covariances[row], offset) < 16.3
    assert sum("moved, started again" in remark for remark in found.remarks) == 1
    assert ate(found, drive) < 0.01


def test_a_blackout_leaves_every_frame_as_uncertain_as_it_is() -> None:
    simulation = drawn(3, frames=26)
    found = answer(Isam2Settings(keyframe_every=4), blackout(simulation.increments, range(10, 20)))
    sigma = np.sqrt(np.trace(found.covariances[:, 3:, 3:], axis1=1, axis2=2))
    error = np.linalg.norm(found.trajectory.poses[:, :3, 3] - simulation.poses[:, :3, 3], axis=1)
    assert (error[1:] < 4 * sigma[1:]).all()
    assert sigma[10:20].min() > 2 * max(sigma[9], sigma[20])
