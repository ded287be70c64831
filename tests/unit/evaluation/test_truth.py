"""True poses that contradict a path far more than the rest are found, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import se3_exp
from fgslam.core.types import Trajectory
from fgslam.evaluation.truth import sound_truth

STEP = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.5])
COUNT = 60


def path(errors: FloatArray) -> Trajectory:
    """A drive whose steps (n, 6) are off by errors."""
    poses = [np.eye(4)]
    for error in errors:
        poses.append(poses[-1] @ se3_exp(STEP + error))
    return Trajectory(0.1 * np.arange(len(poses)), np.array(poses))


def drifting(seed: int) -> Trajectory:
    sigmas = np.repeat([1e-4, 5e-3], 3)
    return path(sigmas * np.random.default_rng(seed).normal(size=(COUNT - 1, 6)))


TRUTH = path(np.zeros((COUNT - 1, 6)))


def spoilt(rows: slice | list[int], by: FloatArray) -> Trajectory:
    poses = TRUTH.poses.copy()
    poses[rows] = poses[rows] @ se3_exp(by)
    return Trajectory(TRUTH.timestamps, poses)


@pytest.mark.parametrize("seed", range(20))
def test_a_sound_truth_is_left_alone(seed: int) -> None:
    found = sound_truth(drifting(seed), TRUTH)
    assert found.trajectory is TRUTH
    assert (len(found.left_out), found.why) == (0, "")


@pytest.mark.parametrize("seed", range(3))
def test_a_truth_that_settles_is_named(seed: int) -> None:
    """As KITTI 06's, whose heading comes right over the first frames."""
    poses = TRUTH.poses.copy()
    for k in range(11):
        poses[k] = poses[k] @ se3_exp(np.array([0.0, np.radians(0.8) * (11 - k) / 11, 0, 0, 0, 0]))
    found = sound_truth(drifting(seed), Trajectory(TRUTH.timestamps, poses))
    assert found.left_out.tolist() == list(range(11))
    assert found.why.startswith("truth of frames 0 to 10 is off by 0.8 degrees")
    assert found.trajectory is not None
    np.testing.assert_array_equal(found.trajectory.timestamps, TRUTH.timestamps[11:])


def test_single_true_poses_that_jump_are_named() -> None:
    jump = np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
    found = sound_truth(drifting(1), spoilt([20, 41], jump))
    assert found.left_out.tolist() == [20, 41]
    assert "truth of single frames (20, 41) is off by up to" in found.why


def test_an_estimate_that_jumps_is_not_excused() -> None:
    """In a single pose, where the path is the jerky one, or for good, from the middle on."""
    jump = np.array([0.0, 0.05, 0.0, 0.3, 0.0, 0.0])
    once = spoilt([30], jump)
    assert not len(sound_truth(once, drifting(1)).left_out)
    errors = np.zeros((COUNT - 1, 6))
    errors[30] = jump
    assert not len(sound_truth(path(errors), drifting(2)).left_out)


@pytest.mark.parametrize("seed", range(20))
def test_an_estimate_that_jumps_where_the_drive_is_rough_is_not_excused(seed: int) -> None:
    """There the path's own jerk is as often the smaller one."""
    rng = np.random.default_rng(seed)
    rough = path(np.repeat([0.02, 0.1], 3) * rng.normal(size=(COUNT - 1, 6)))
    poses = rough.poses.copy()
    small = 1e-3 * rng.normal(size=(COUNT, 6))
    small[[20, 30, 40]] *= 30.0
    for k in range(COUNT):
        poses[k] = poses[k] @ se3_exp(small[k])
    found = sound_truth(Trajectory(rough.timestamps, poses), rough)
    assert not len(found.left_out)


def test_a_start_that_errs_no_more_than_elsewhere_is_kept() -> None:
    errors = np.zeros((COUNT - 1, 6))
    errors[[0, 1, 40, 41], 1] = 0.01
    assert not len(sound_truth(path(errors), drifting(3)).left_out)


def test_few_poses_are_no_measure() -> None:
    found = sound_truth(drifting(1), Trajectory(TRUTH.timestamps[:9], TRUTH.poses[:9]))
    assert not len(found.left_out)
    assert sound_truth(drifting(1), None).trajectory is None
