"""Frames that nothing measured lie between the located ones, as uncertain as the drive shows."""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.types import Estimate, LandmarkMap, Trajectory
from fgslam.frontend.tracking.landmarks import MapParts
from fgslam.slam.bridging import bridged, bridged_frames

SIGMA = np.repeat([0.05, 0.1], 3)  # of each step: radians, metres
KNOWN, FREE = 1e-6 * np.eye(6), np.diag([9.0] * 3 + [900.0] * 3)


class Parts(MapParts):
    """Parts of frames as given; landmark k began in part k."""

    def __init__(self, of_frames: list[int]) -> None:
        super().__init__()
        self._frames = of_frames

    def of(self, ids: IntArray) -> IntArray:
        return ids


def estimated(poses: FloatArray, parts: Parts, guess: FloatArray | None = None) -> Estimate:
    """Poses as they truly are, but for those next to the first part: a guess, or 5 m off it."""
    lost = np.flatnonzero(~parts.connected)
    found, covariances = poses.copy(), np.tile(KNOWN, (len(poses), 1, 1))
    found[lost] = g.se3_exp(np.array([0.3, 0.0, 0.0, 5.0, 0.0, 0.0])) @ found[lost]
    covariances[lost] = FREE if guess is None else guess
    landmarks = LandmarkMap(np.arange(2), found[[0, lost[0]], :3, 3], np.tile(np.eye(3), (2, 1, 1)))
    return Estimate(Trajectory(np.arange(len(poses)) ** 1.1, found), covariances, landmarks)


def walk(rng: np.random.Generator, frames: int) -> FloatArray:
    poses = [np.eye(4)]
    for xi in rng.normal(0.0, SIGMA, (frames - 1, 6)):
        poses.append(poses[-1] @ g.se3_exp(xi))
    return np.array(poses)


def test_a_steady_drive_goes_on_through_its_gap() -> None:
    """At unequal times; landmarks that began there lie where the frame saw them."""
    parts, times = Parts([0, 0, 0, 1, 2, 0, 0]), np.arange(7) ** 1.1
    velocity = np.array([0.0, 0.1, 0.02, 0.0, 0.0, 0.4])
    poses = np.array([g.se3_exp(t * velocity) for t in times])
    found = bridged(estimated(poses, parts), parts)
    np.testing.assert_allclose(found.trajectory.poses, poses, atol=1e-12)
    np.testing.assert_allclose(found.landmarks.positions, poses[[0, 3], :3, 3], atol=1e-12)
    assert bridged_frames(parts).tolist() == [3, 4]


def test_the_deviations_are_those_of_the_errors() -> None:
    squared = []
    for seed in range(30):
        poses, parts = walk(np.random.default_rng(seed), 30), Parts([0] * 12 + [1, 2] + [0] * 16)
        found = bridged(estimated(poses, parts), parts)
        error = g.se3_log(g.inverse(found.trajectory.poses[12]) @ poses[12])
        squared.append(error**2 / np.diagonal(found.covariances[12]))
    by_block = np.mean(squared, axis=0).reshape(2, 3).mean(axis=1)
    assert ((by_block > 0.6) & (by_block < 1.3)).all()


def test_a_long_blind_frame_is_as_uncertain_as_long_segments_of_the_drive() -> None:
    """To and fro in 16 s: in between lies one frame, at the far end, and both ends are as one."""
    times = np.delete(np.arange(97.0), np.r_[33:40, 41:48])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = 1.0 - np.cos(2.0 * np.pi * times / 16.0)
    lost = int(np.flatnonzero(times == 40.0)[0])
    parts = Parts([int(k == lost) for k in range(len(times))])
    before = estimated(poses, parts)
    timed = dataclasses.replace(before, trajectory=Trajectory(times, before.trajectory.poses))
    found = bridged(timed, parts)
    off = found.trajectory.poses[lost, 0, 3] - poses[lost, 0, 3]
    assert 0.5 < abs(off) < 3.0 * np.sqrt(found.covariances[lost, 3, 3])


def test_a_turn_that_was_measured_stays() -> None:
    poses, parts = walk(np.random.default_rng(3), 12), Parts([0] * 5 + [1] + [0] * 6)
    turned = np.diag([1e-6] * 3 + [900.0] * 3)
    before = estimated(poses, parts, turned)
    found = bridged(before, parts)
    turn, place = found.trajectory.poses[5, :3, :3], found.trajectory.poses[5, :3, 3]
    np.testing.assert_allclose(turn, before.trajectory.poses[5, :3, :3], atol=1e-12)
    assert np.linalg.norm(place - poses[5, :3, 3]) < 0.5
    np.testing.assert_allclose(found.covariances[5, :3, :3], turned[:3, :3], atol=1e-12)


def test_frames_of_one_part_stay_as_they_lie_to_each_other() -> None:
    poses, parts = walk(np.random.default_rng(4), 12), Parts([0] * 5 + [1, 1, 1] + [0] * 4)
    found = bridged(estimated(poses, parts), parts).trajectory.poses
    np.testing.assert_allclose(
        g.inverse(found[5]) @ found[7], g.inverse(poses[5]) @ poses[7], atol=1e-12
    )
    assert np.linalg.norm(found[6, :3, 3] - poses[6, :3, 3]) < 1.0


def test_what_is_known_better_and_what_nothing_follows_stay() -> None:
    poses = walk(np.random.default_rng(5), 12)
    within, after = Parts([0] * 5 + [1] + [0] * 6), Parts([0] * 10 + [1, 1])
    for estimate, parts in (
        (estimated(poses, within, KNOWN), within),
        (estimated(poses, after), after),
    ):
        found = bridged(estimate, parts)
        np.testing.assert_array_equal(found.trajectory.poses, estimate.trajectory.poses)
        np.testing.assert_array_equal(found.covariances, estimate.covariances)
