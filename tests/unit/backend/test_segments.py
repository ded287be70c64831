"""Keyframes: a block's summary holds the information of its frames, each pose counted once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG, Drive, play, simulate
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
from fgslam.backend.smoothers.graph import TrackedFrame
from fgslam.backend.smoothers.keyframes import Segments, summarise
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import Observations
from fgslam.core.types import LandmarkMap

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


def test_without_noise_it_is_what_the_middle_would_have_seen() -> None:
    frames, landmarks = frames_of(0.0)
    fused = summarise(RIG, frames, frames[2], landmarks)
    local = g.transform_to_camera(frames[2].wTc, landmarks.positions[fused.ids])
    np.testing.assert_allclose(fused.measurement, g.project(RIG, local), rtol=0, atol=1e-6)


def by_points(
    frames: list[TrackedFrame], middle: FloatArray, identity: int
) -> tuple[FloatArray, FloatArray]:
    """Least squares of one landmark from known poses, in metric space, as seen from the middle."""
    seen = [
        (g.inverse(f.wTc) @ middle, f.accepted.select(f.accepted.ids == identity)) for f in frames
    ]
    seen = [(fTm, one) for fTm, one in seen if len(one)]
    fTm, one = seen[0]
    point = g.transform_to_camera(fTm, g.triangulate(RIG, one.measurement))[0]
    for _ in range(10):
        information, gradient = np.zeros((3, 3)), np.zeros(3)
        for fTm, one in seen:
            local = (fTm[:3, :3] @ point + fTm[:3, 3])[None]
            jacobian = g.projection_jacobian(RIG, local)[0] @ fTm[:3, :3]
            weight = np.linalg.inv(one.covariance[0])
            information += jacobian.T @ weight @ jacobian
            gradient += jacobian.T @ weight @ (one.measurement[0] - g.project(RIG, local)[0])
        point = point + np.linalg.solve(information, gradient)
    by_point = g.projection_jacobian(RIG, point[None])[0]
    return g.project(RIG, point[None])[0], by_point @ np.linalg.inv(information) @ by_point.T


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
            for simulation in (drawn(20 + seed, frames=21) for seed in range(6))
        ]
    assert np.mean(errors[5]) < 1.15 * np.mean(errors[1])


@pytest.mark.parametrize("frames", [1, 2, 4, 6, 9, 10, 13])
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


@pytest.mark.parametrize("since", [6, 7, 8, 9, 10])
def test_a_landmark_that_moves_within_a_block(since: int) -> None:
    drive = drawn(8, frames=24)
    place = drive.points_by_id[28] + [0.3, 0.1, 0.3]
    found = answer(KEYFRAMES, moved(drive, 28, since, place, np.random.default_rng(1)))
    row = found.landmarks.rows(np.array([28]))[0]
    offset = found.landmarks.positions[row] - place
    assert offset @ np.linalg.solve(found.landmarks.covariances[row], offset) < 16.3
    assert sum("moved, started anew" in remark for remark in found.remarks) == 1
    assert ate(found, drive) < 0.01


@pytest.mark.parametrize("k", [6, 7, 8, 9])
def test_pruned_in_the_open_block(k: int) -> None:
    cut = drawn(8, frames=24).increments[: k + 1]
    gone = cut[k].observations.ids[:3]
    cut[k] = dataclasses.replace(cut[k], pruned_ids=np.union1d(cut[k].pruned_ids, gone))
    found = answer(KEYFRAMES, cut)
    assert_finite(found)
    assert not np.isin(gone, found.landmarks.ids).any()


def test_a_blackout_leaves_every_frame_as_uncertain_as_it_is() -> None:
    simulation = drawn(3, frames=26)
    found = answer(Isam2Settings(keyframe_every=4), blackout(simulation.increments, range(10, 20)))
    sigma = np.sqrt(np.trace(found.covariances[:, 3:, 3:], axis1=1, axis2=2))
    error = np.linalg.norm(found.trajectory.poses[:, :3, 3] - simulation.poses[:, :3, 3], axis=1)
    assert (error[1:] < 4 * sigma[1:]).all()
    assert sigma[10:20].min() > 2 * max(sigma[9], sigma[20])
