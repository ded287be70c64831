"""Backward correction: the least weighted changes to a chain under which a loop closes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from simulated import assert_same_bits, observations

from fgslam.backend.considered import shares
from fgslam.backend.loops import (
    CLOSURE_FACTOR,
    FREE,
    Chain,
    Constraint,
    changes,
    corrected,
    home_changes,
    nearest_positive,
    rigid_motions,
    rotated,
    transported,
)
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import LoopClosure
from fgslam.core.store import pack, unpack

COUNT = 41
STEP = g.se3_exp(np.array([0.0, 2.0 * np.pi / 40, 0.0, 0.0, 0.0, 0.3]))
"""Forty of them are a round."""
SIGMA = np.array([1e-3, 4e-3, 1e-3, 5e-3, 5e-3, 1e-2])
TIGHT = 1e-8 * np.eye(6)
NOBODY = observations(np.empty(0, np.int64), np.empty((0, 3)), np.ones(3), np.empty(0, np.bool_))


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


def test_without_constraints_nothing_moves(rng: np.random.Generator) -> None:
    poses = drifted(rng)
    found, cost = corrected(poses, uncertain(), [], every=7)
    assert apart(found, poses) < 1e-12
    assert cost < 1e-12


def test_a_true_chain_meets_its_loop_at_no_cost() -> None:
    poses = chained([STEP] * (COUNT - 1))
    found, cost = corrected(poses, uncertain(), [home()])
    assert apart(found, poses) < 1e-9
    assert cost < 1e-9


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


def test_correcting_a_drift_brings_the_drive_nearer_to_the_truth(rng: np.random.Generator) -> None:
    truth = chained([STEP] * (COUNT - 1))
    before, after = [], []
    for _ in range(20):
        poses = drifted(rng)
        found, _ = corrected(poses, uncertain(), [home()], every=5)
        before.append(np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1))
        after.append(np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1))
    assert np.mean(after) < 0.6 * np.mean(before)


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
    closed = LoopClosure(7, motion, covariance, NOBODY, np.empty((0, 2), np.int64))
    taken = shares(chain, closed)
    np.testing.assert_allclose(taken @ whole, moved, rtol=0.0, atol=1e-2 * np.abs(moved).max())
    assert np.abs(moved[:8]).max() < 1e-9 < np.abs(moved[8:]).max()


def test_corrected_drive_has_no_jumps(rng: np.random.Generator) -> None:
    """No step changes by much more than its share of the whole."""
    poses = drifted(rng, 3.0)
    found, _ = corrected(poses, uncertain(), [home()])
    whole = np.abs(g.se3_log(poses[-1])).max()
    for k in range(COUNT - 1):
        step = g.inverse(poses[k]) @ poses[k + 1]
        change = g.se3_log(g.inverse(step) @ g.inverse(found[k]) @ found[k + 1])
        assert np.abs(change).max() < 0.15 * whole


def test_unknown_step_takes_the_whole_correction(rng: np.random.Generator) -> None:
    poses, steps = drifted(rng), uncertain()
    steps[17] = FREE
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


def test_a_chain_is_restored_to_the_bit(rng: np.random.Generator) -> None:
    chain = Chain()
    assert len(unpack(pack(chain), Chain)) == 0
    for k in range(5):
        chain.append(g.se3_exp(SIGMA * rng.standard_normal(6)), (k + 1.0) * np.diag(SIGMA))
    chain.constraints.append(Constraint(1, 4, STEP, TIGHT))
    back = unpack(pack(chain), Chain)
    assert_same_bits(pack(back), pack(chain))
    assert_same_bits(back.solve(back.constraints), chain.solve(chain.constraints))


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


def test_a_doubted_loop_is_overruled_by_loops_that_agree(rng: np.random.Generator) -> None:
    poses, steps = chained([STEP] * (COUNT - 1)), uncertain()
    wrong = g.inverse(poses[2]) @ poses[30] @ g.se3_exp(np.array([0, 0.3, 0, 0.5, 0, 0.5]))
    sure = 1e-6 * np.eye(6)
    others = [Constraint(a, b, g.inverse(poses[a]) @ poses[b], sure) for a, b in ((0, 28), (3, 33))]
    believed, _ = corrected(poses, steps, [*others, Constraint(2, 30, wrong, sure)])
    doubted, _ = corrected(poses, steps, [*others, Constraint(2, 30, wrong, sure, doubted=True)])
    assert apart(doubted, poses) < 0.05 * apart(believed, poses)
