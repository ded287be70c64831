"""Poses between keyframes: held by what they saw and by the odometry, as uncertain as they are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG, Simulation
from smoothing import drawn

from fgslam.backend.smoothers.graph import Solution, TrackedFrame
from fgslam.backend.smoothers.keyframes import fill_between
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import Odometry
from fgslam.core.types import Floor

FREE = Floor.under(RIG, 6)
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
    simulation: Simulation, total: int = 11, sees: bool = True, floor: Floor = FREE
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


def test_the_graph_s_own_poses_stay_and_nothing_between_is_nothing_done() -> None:
    simulation = drawn(1)
    found = filled(simulation)
    before = solved(simulation, 11)
    for k in KNOWN:
        np.testing.assert_array_equal(found.poses[k], simulation.poses[k])
        np.testing.assert_array_equal(found.pose_covariances[k], LITTLE)
    assert np.isnan(before.poses[1]).all()
    alone = fill_between(RIG, FREE, before, [], [None] * 11, {})
    assert alone is before


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


def test_visual_pose_replaces_wheel_odometry() -> None:
    seen, blind = filled(drawn(2)), filled(drawn(2), sees=False)
    for k in (1, 2, 3, 9, 10):
        assert np.trace(seen.pose_covariances[k]) < 0.2 * np.trace(blind.pose_covariances[k])


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
    plain = fill_between(RIG, FREE, before, frames, motions, variables).pose_covariances
    unsure = before.pose_covariances.copy()
    unsure[4] += 1e-3 * np.eye(6)
    other = dataclasses.replace(before, pose_covariances=unsure)
    found = fill_between(RIG, FREE, other, frames, motions, variables).pose_covariances
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
    found = fill_between(RIG, FREE, behind, frames, motions, {v: v for v in points})
    blind = filled(simulation, total=3, sees=False)
    np.testing.assert_allclose(found.poses, blind.poses, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.pose_covariances, blind.pose_covariances, rtol=1e-6)
