"""The whole graph in arrays."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from factor_checks import random_covariance
from simulated import RIG, Drive, Simulation, assert_same_bits, simulate
from smoothing import drawn, run, wrong_matches

from benchmarks.gtsam_graphs import in_arrays
from fgslam.backend.loops import Constraint, constraint_factor
from fgslam.backend.settings import (
    BatchSettings,
    EstimatorSettings,
    Isam2Settings,
    KernelSettings,
    LandmarkKalmanSettings,
    SlidingWindowSettings,
)
from fgslam.backend.smoothers import final as loop_closing
from fgslam.backend.smoothers.bundle import State, Turn, TurnedStep, Turns, WholeGraph
from fgslam.backend.smoothers.elimination import (
    Bordered,
    GraphMarginals,
    reduced,
    with_border,
)
from fgslam.backend.smoothers.final import ITERATIONS, TOLERANCE, Refined
from fgslam.backend.smoothers.graph import GraphBuilder, solved
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import inverse, se3_exp
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import BiasEffect, Increment, LoopClosure, Odometry, compose_odometry
from fgslam.core.store import restore, state_of
from fgslam.factors.graphs import poses_of_frame, solver_parameters
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.slam.build import made_or_given
from fgslam.slam.motion import ConstantVelocityMotion, OdometryMotion
from fgslam.slam.replay import Replay, replay, replay_frame

# ------------------------------------------------------------------------------------------
# The whole graph in arrays against GTSAM: cost, linear system, and the minimum


KERNELS = pytest.mark.parametrize("name", ["none", "huber", "cauchy", "geman_mcclure"])
LOOPS = [(0, 14), (3, 17), (1, 19)]


def problem(name: Any, seed: int = 0, wrong: float = 0.05) -> tuple[Any, Any, GraphBuilder]:
    """A drive's graph with loops, initial values and the builder; some matches are wrong."""
    rng = np.random.default_rng(seed)
    increments = wrong_matches(drawn(seed, frames=20).increments, wrong, rng)
    kernel = KernelSettings(name, 3.0)
    estimator, _ = run(BatchSettings(kernel=kernel, trim=False, noise_factor=1.0), increments)
    builder, values = estimator.builder, estimator.solver.values
    for before, after in LOOPS:
        motion = inverse(poses_of_frame(values, before)) @ poses_of_frame(values, after)
        motion = motion @ se3_exp(0.01 * rng.standard_normal(6))
        known = Constraint(before, after, motion, random_covariance(rng, 6, 0.01))
        builder.graph.add(constraint_factor(dataclasses.replace(known, uncertain=True)))
    return builder.kept_factors(), values, builder


def by_gtsam(graph: Any, values: Any) -> Any:
    """Levenberg-Marquardt to the last digits."""
    return gtsam.LevenbergMarquardtOptimizer(
        graph, values, solver_parameters(200, 1e-13)
    ).optimize()


@KERNELS
def test_cost_and_gradient_are_those_of_the_factors(name: str) -> None:
    graph, values, builder = problem(name)
    whole, state = builder.whole_graph(values)
    assert whole.cost(state) == pytest.approx(graph.error(values), rel=1e-12)
    system = whole.linear(state)
    expected: FloatArray = graph.linearize(values).gradientAtZero().vector()
    found = np.concatenate([system.landmark_gradient, system.pose_gradient])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_without_any_landmark_the_other_factors_are_left() -> None:
    _, values, builder = problem("none")
    whole, state = builder.whole_graph(values)
    both = dataclasses.replace(whole.rest, measured=(whole.seen,))
    every = np.arange(len(whole.landmark_keys))
    left, there = dataclasses.replace(whole, rest=both).without(every, state)
    alone = dataclasses.replace(left.rest, measured=())
    parts = there.poses, there.points, there.bias
    assert left.cost(there) == alone.cost(*parts) > 0.0
    system, expected = left.linear(there), alone.linear(*parts)
    np.testing.assert_array_equal(system.pose_gradient, expected.pose_gradient)
    np.testing.assert_array_equal(system.poses.toarray(), expected.poses.toarray())


@pytest.mark.parametrize("name", ["none", "cauchy", "geman_mcclure"])
def test_minimum_is_that_of_gtsam_on_drives_with_loops(name: str) -> None:
    graph, values, builder = problem(name)
    expected = by_gtsam(graph, values)
    whole, state = builder.whole_graph(values)
    found = whole.minimum(state, ITERATIONS, TOLERANCE)
    assert whole.cost(found) <= graph.error(expected) * (1.0 + 1e-6)
    if name == "cauchy":  # the others have minima next to each other
        np.testing.assert_allclose(found.poses, State.of(expected).poses, rtol=0, atol=1e-4)


def test_both_eliminations_step_alike() -> None:
    graph, values, builder = problem("none")
    whole, state = builder.whole_graph(values)
    system = whole.linear(state)
    expected = graph.linearize(values).optimize().vector()
    for landmarks_first in (True, False):
        step = GraphMarginals.of(system, landmarks_first).step()
        np.testing.assert_allclose(step, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    assert reduced(system).step().shape == expected.shape


def test_graphs_of_arrays_and_of_factors_are_one_also_without_some_landmarks() -> None:
    graph, values, builder = problem("cauchy")
    kernel = builder.kernel
    pairs = [builder.whole_graph(values), in_arrays(graph, values, kernel)]
    gone = np.array([0, 3, 7])
    for (ours, state), (theirs, other) in (pairs, [w.without(gone, s) for w, s in pairs]):
        assert ours.landmark_keys == theirs.landmark_keys
        assert len(state.points) == len(ours.landmark_keys)
        assert ours.cost(state) == pytest.approx(theirs.cost(other), rel=1e-12)
        one, two = (w.linear(s) for w, s in ((ours, state), (theirs, other)))
        size = np.abs(two.landmarks).max()
        np.testing.assert_allclose(one.landmarks, two.landmarks, rtol=0, atol=1e-10 * size)
        np.testing.assert_allclose(one.pose_gradient, two.pose_gradient, rtol=0, atol=1e-6)
    assert len(pairs[0][0].landmark_keys) - len(gone) == len(
        pairs[0][0].without(gone, pairs[0][1])[1].points
    )


# ------------------------------------------------------------------------------------------
# The bias of a gyroscope as a variable of whole graphs


DT = 0.1  # seconds
START = float(np.radians(3.0))
DENSITY, WALK = 1.75e-4, 1.94e-5  # rad/s/sqrt(Hz), rad/s^2/sqrt(Hz)
AMPLITUDE = np.array([0.5, 0.8, 0.3, 0.3, 0.15, 0.5])  # rad/s and m/s, of a camera in a hand
PIXELS = (0.5, 0.5, 0.4)
BATCH = BatchSettings(noise_factor=1.0)


@dataclasses.dataclass(frozen=True)
class Driven:
    """A hand-held camera with a gyroscope: the truth, the log, and the bias (3,) at the end."""

    simulation: Simulation
    log: MeasurementLog
    bias: FloatArray


def in_a_hand(frames: int, rng: np.random.Generator) -> FloatArray:
    """Twists (frames - 1, 6) of three swings an axis, which constant velocity cannot foresee."""
    times, out = DT * np.arange(frames - 1), np.zeros((frames - 1, 6))
    for _ in range(3):
        frequency, phase = rng.uniform(0.2, 0.9, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
        out += AMPLITUDE / np.sqrt(3.0) * np.sin(2.0 * np.pi * np.outer(times, frequency) + phase)
    return DT * out


@cache
def driven(seed: int, frames: int = 16, points: int = 40, bias_dps: float = 1.0) -> Driven:
    """With a bias of so many degrees/s an axis; the log of a live run of the paper's filter."""
    rng = np.random.default_rng(seed)
    drive = Drive(frames=frames, points=points, period_s=DT, sigma_px=PIXELS)
    simulation = simulate(drive, rng, in_a_hand(frames, rng))
    bias, bRc, measured = np.radians(bias_dps) * rng.standard_normal(3), RIG.bTc[:3, :3], []
    for before, after in zip(simulation.poses, simulation.poses[1:], strict=False):
        bias = bias + WALK * np.sqrt(DT) * rng.standard_normal(3)
        noise = DENSITY * np.sqrt(DT) * rng.standard_normal(3)
        turned = bRc @ before[:3, :3].T @ after[:3, :3] @ bRc.T @ g.so3_exp(DT * bias + noise)
        effect = BiasEffect(-DT * np.eye(3), START**2, WALK**2 * DT)
        measured.append(Odometry.turn(turned, DENSITY**2 * DT * np.eye(3), effect))
    return Driven(simulation, live(simulation.increments, [None, *measured]), bias)


class _Given(OdometryMotion):
    """What a replay asks for in the middle of a live run: the step as it is."""

    def live(self, timestamp: float, body: Odometry | None) -> Odometry | None:
        return super().between(timestamp, body)

    def between(self, timestamp: float, body: Odometry | None) -> Odometry | None:
        return body


def live(increments: list[Increment], measured: list[Odometry | None]) -> MeasurementLog:
    settings, solver = EgoMotionSettings(), EgoMotionSolver(RIG, EgoMotionSettings())
    motion = _Given(RIG.bTc, "recorded", ConstantVelocityMotion())
    estimator = made_or_given(RIG, LandmarkKalmanSettings(), settings, None)
    log = MeasurementLog(RIG, motion.description())
    for k, (increment, body) in enumerate(zip(increments, measured, strict=True)):
        step = None if body is None else motion.live(increment.timestamp, body)
        frame = dataclasses.replace(increment, odometry=step)
        log.append(frame)
        replay_frame(frame, estimator, solver, motion, k)
    return log


def blind(log: MeasurementLog) -> MeasurementLog:
    """The same drive without images."""
    out = MeasurementLog(log.rig, log.motion_model)
    for increment in log:
        none = increment.observations.select(np.zeros(len(increment.observations), np.bool_))
        out.append(
            dataclasses.replace(
                increment,
                observations=none,
                rejected=np.zeros(0, np.bool_),
                missed_ids=np.empty(0, np.int64),
                pruned_ids=np.empty(0, np.int64),
            )
        )
    return out


def replayed(log: MeasurementLog, settings: EstimatorSettings = BATCH) -> Replay:
    found = replay(log, settings, EgoMotionSettings())
    assert found.failure == ""
    return found


def errors(found: Replay, simulation: Simulation) -> FloatArray:
    """(n - 1, 6) tangent vectors from the estimate to the truth."""
    truth = g.inverse(simulation.poses[0]) @ simulation.poses
    off = g.inverse(found.estimate.trajectory.poses) @ truth
    return np.array([g.se3_log(each) for each in off[1:]])


def rms(off: FloatArray) -> float:
    return float(np.sqrt((off**2).sum(axis=1).mean()))


@cache
def refined(seed: int = 0) -> Refined:
    """A drive's graph at its minimum."""
    estimator = made_or_given(RIG, BATCH, EgoMotionSettings(), None)
    replayed(driven(seed).log, estimator)
    found: Refined = estimator.solver.refined()  # type: ignore[attr-defined]
    return found


# --------------------------------------------------------------------------------------------
# One step, and several as one


def step_of(rng: np.random.Generator, bias: FloatArray) -> Odometry:
    """A step with this bias applied."""
    jacobian, left = -DT * np.eye(3) + 0.01 * rng.standard_normal((3, 3)), 1e-4 * np.eye(3)
    effect = BiasEffect(jacobian, START**2, 1e-11, bias, left)
    covariance = np.diag(np.repeat([1e-8, 1e-4], 3))
    covariance[:3, :3] += jacobian @ left @ jacobian.T
    motion = g.se3_exp(0.3 * rng.standard_normal(6))
    return Odometry(motion, covariance, measured=False, turned=True, bias=effect)


def with_other_bias(step: Odometry, bias: FloatArray) -> FloatArray:
    """The step's motion (4, 4), its turn corrected for another bias."""
    assert step.bias is not None
    turned = step.motion.copy()
    turned[:3, :3] @= g.so3_exp(step.bias.jacobian @ (bias - step.bias.applied))
    return turned


def test_steps_of_different_bias_join_to_one() -> None:
    rng = np.random.default_rng(1)
    steps = [step_of(rng, 0.001 * rng.standard_normal(3)) for _ in range(3)]
    turn, bias = Turn.of(steps), 0.001 * rng.standard_normal(3)
    assert turn is not None
    whole = compose_odometry(steps)
    expected = np.linalg.multi_dot([with_other_bias(step, bias) for step in steps])
    found = g.se3_log(g.inverse(whole.motion) @ expected)
    np.testing.assert_allclose(turn.jacobian @ bias - turn.applied, found, rtol=0.0, atol=1e-6)
    assert np.abs(found).max() > 1e-4
    noise = [dataclasses.replace(s, covariance=np.diag(np.repeat([1e-8, 1e-4], 3))) for s in steps]
    np.testing.assert_allclose(
        whole.covariance - turn.unknown, compose_odometry(noise).covariance, rtol=0.0, atol=1e-12
    )
    assert turn.walk == pytest.approx(3e-11)


def test_steps_without_a_gyroscope_have_no_turn() -> None:
    plain = Odometry(np.eye(4), np.eye(6))
    assert Turn.of([plain, None]) is None
    joined = Turn.of([plain, step_of(np.random.default_rng(1), np.zeros(3)), None])
    assert joined is not None


def turns_of(
    walk: float, steps: int = 40, density: float = DENSITY, persistence: float = 1.0
) -> Turns:
    rng = np.random.default_rng(2)
    effect = BiasEffect(-DT * np.eye(3), START**2, walk**2 * DT, np.zeros(3), np.zeros((3, 3)))
    out = []
    for k in range(steps):
        motion = g.se3_exp(0.2 * rng.standard_normal(6))
        covariance = np.diag(np.repeat([density**2 * DT, 0.01], 3))
        step = Odometry(motion, covariance, measured=False, turned=True, bias=effect)
        turn = Turn.of((step,))
        assert turn is not None
        out.append(TurnedStep(k, k + 1, step, turn))
    found = Turns.of(out, range(steps + 1), persistence)
    assert found is not None
    return found


def test_a_bias_has_nodes_where_its_walk_comes_out_of_the_noise() -> None:
    """Their Allan deviations cross at sqrt(3) DENSITY / WALK, 15.6 s; the drive takes 4 s."""
    assert turns_of(0.0).nodes.shape == (40, 1)
    assert turns_of(WALK).nodes.shape == (40, 2)
    assert turns_of(10.0 * WALK).nodes.shape == (40, 7)
    assert turns_of(1000.0 * WALK).nodes.shape == (40, 17)
    turns = turns_of(10.0 * WALK)
    np.testing.assert_allclose(turns.nodes.sum(axis=1), 1.0, rtol=0.0, atol=1e-12)
    before = np.linalg.inv(turns.known)
    np.testing.assert_allclose(before[:3, :3], START**2 * np.eye(3), rtol=1e-9, atol=1e-15)
    grown = START**2 + (10.0 * WALK) ** 2 * 40 * DT
    np.testing.assert_allclose(before[-3:, -3:], grown * np.eye(3), rtol=1e-9, atol=1e-15)


def noise_of(turns: Turns) -> FloatArray:
    """(k, 6, 6) of the steps, next to the bias."""
    return np.asarray(np.linalg.inv(np.swapaxes(turns.roots, 1, 2) @ turns.roots))


@pytest.mark.parametrize(
    ("walk", "density", "nodes"), [(1e-14, DENSITY, 1), (1e-9, DENSITY, 1), (WALK, 0.0, 17)]
)
def test_extremes_of_the_stated_noise_leave_a_bias(walk: float, density: float, nodes: int) -> None:
    turns = turns_of(walk, density=density)
    assert turns.nodes.shape == (40, nodes)
    bias = turns.start(np.tile(np.eye(4), (41, 1, 1)))
    assert np.isfinite(bias).all()


def test_a_bias_that_nothing_determines_is_reported() -> None:
    turns = turns_of(0.0)
    open_to_all = dataclasses.replace(
        turns, jacobians=0.0 * turns.jacobians, known=np.zeros((3, 3))
    )
    with pytest.raises(EstimatorError, match="correct gyroscope_noise_density"):
        open_to_all.start(np.tile(np.eye(4), (41, 1, 1)))


def test_persistence_is_of_the_translation_alone() -> None:
    once, twice = (noise_of(turns_of(10.0 * WALK, persistence=by)) for by in (1.0, 2.0))
    by = np.sqrt(np.repeat([1.0, 2.0], 3))
    np.testing.assert_allclose(twice, by[:, None] * once * by, rtol=1e-6, atol=1e-12)


def test_a_long_drive_is_no_surer_of_its_bias_than_that_walks() -> None:
    """Its variance at the end over the stated one, of 115 times in which the walk comes out.

    Images tell the heading 33 times, to 0.02 degrees; the solution is linear, so the variance is
    exact. Where the walk between the 17 nodes is left out it is 2.9 times the stated one.
    """
    walk, k, sigma = 20.0 * WALK, 900, np.radians(0.02) * np.sqrt(2.0)
    turns = turns_of(walk, k)
    assert turns.nodes.shape == (k, 17)
    white = noise_of(turns)[:, 0, 0]
    at = np.linspace(0, k, 33).astype(int)
    inside = (np.arange(k) >= at[:-1, None]) & (np.arange(k) < at[1:, None])
    by_node, known = DT * inside @ turns.nodes, turns.known[::3, ::3]
    weights = by_node.T / (inside @ white + sigma**2)
    covariance = np.linalg.inv(weights @ by_node + known)
    gain = (covariance @ weights)[-1]
    by_step = gain @ inside
    by_walk = DT * by_step
    by_walk[-1] -= 1.0
    variance = (
        walk**2 * DT * (np.cumsum(by_walk[::-1]) ** 2).sum()
        + DENSITY**2 * DT * (by_step**2).sum()
        + sigma**2 * (gain**2).sum()
    )
    assert 0.7 < variance / covariance[-1, -1] < 1.1


# --------------------------------------------------------------------------------------------
# The graph


def test_the_gradient_is_that_of_the_cost() -> None:
    whole = refined()
    graph, state = whole.graph, whole.state
    rng = np.random.default_rng(3)
    count = [state.points.size, 6 * len(state.poses), state.bias.size]
    scale = np.repeat([1e-3, 1e-5, 1e-5], count)
    near = state.moved(scale * rng.standard_normal(sum(count)))
    system = graph.linear(near)
    assert system.border is not None
    gradient = np.concatenate([system.gradient, system.border.gradient])
    for direction in (0, 1, 2):
        by = scale * rng.standard_normal(len(scale)) * (np.repeat([0, 1, 2], count) == direction)
        ahead, behind = (graph.cost(near.moved(sign * 0.01 * by)) for sign in (1.0, -1.0))
        slope = (ahead - behind) / 0.02
        assert gradient @ by == pytest.approx(slope, rel=2e-3, abs=1e-5 * abs(ahead))


@pytest.mark.parametrize("landmarks_first", [True, False])
def test_step_and_covariances_are_those_of_the_whole_system(landmarks_first: bool) -> None:
    whole = refined()
    state = State(whole.state.poses, whole.state.points, whole.state.bias + 0.001)
    system = whole.graph.linear(state)
    border, columns = system.border, system.columns
    assert border is not None
    coupling = border.coupling
    every = np.r_[:columns, columns - len(coupling) : 0]  # without what makes a last pair
    information = system.in_pairs.toarray()[np.ix_(every, every)]
    dense = np.block([[information, coupling], [coupling.T, border.own]])
    size = 1.0 / np.sqrt(np.diagonal(dense))
    covariance = size[:, None] * np.linalg.inv(size[:, None] * dense * size) * size
    found = with_border(GraphMarginals.of(system, landmarks_first))
    assert isinstance(found, Bordered)
    expected = -covariance @ np.concatenate([system.gradient, border.gradient])
    np.testing.assert_allclose(found.step(), expected, rtol=0.0, atol=1e-6 * abs(expected).max())
    last = columns + 6 * (len(state.poses) - 1) + np.arange(6)
    for one, rows in (
        (found.poses()[-1], last),
        (found.landmarks()[2], np.arange(6, 9)),
        (found.estimated, np.arange(len(dense) - len(border.own), len(dense))),
    ):
        scale = np.abs(covariance[np.ix_(rows, rows)]).max()
        np.testing.assert_allclose(one, covariance[np.ix_(rows, rows)], rtol=0.0, atol=1e-6 * scale)


def test_the_initial_bias_is_the_likeliest_for_the_poses() -> None:
    whole = refined()
    turns, state = whole.graph.rest.turns, whole.state
    assert turns is not None
    start = turns.start(state.poses)
    least = turns.cost(state.poses, start)
    rng = np.random.default_rng(5)
    for _ in range(5):
        other = start + 1e-4 * rng.standard_normal(len(start))
        assert turns.cost(state.poses, other) > least


# --------------------------------------------------------------------------------------------
# Estimates


def test_a_frame_found_without_a_prior_keeps_its_turn_and_the_bias_of_it() -> None:
    frames = list(driven(0).log)[:6]
    frames[3] = dataclasses.replace(frames[3], relocalised=True)
    log = MeasurementLog(RIG, driven(0).log.motion_model)
    for increment in frames:
        log.append(increment)
    estimator = made_or_given(RIG, BATCH, EgoMotionSettings(), None)
    replayed(log, estimator)
    turns = estimator.solver.refined().graph.rest.turns  # type: ignore[attr-defined]
    np.testing.assert_array_equal(turns.after, [1, 2, 3, 4, 5])
    assert noise_of(turns)[:, 3, 3].argmax() == 2


SMOOTHERS = [BATCH, Isam2Settings(noise_factor=1.0), SlidingWindowSettings(noise_factor=1.0)]


@pytest.mark.parametrize("settings", SMOOTHERS)
def test_smoothers_find_the_bias(settings: EstimatorSettings) -> None:
    one = driven(0)
    found = replayed(one.log, settings).estimate
    assert found.gyroscope is not None
    off = found.gyroscope.rates - one.bias
    sigmas = np.sqrt(np.diagonal(found.gyroscope.covariance))
    assert np.degrees(sigmas).max() < 0.1, "of 3 beforehand"
    assert (np.abs(off) < 4.0 * sigmas).all()
    assert any(line.startswith("bias of the gyroscope") for line in found.remarks)


def test_without_images_the_bias_is_known_as_before() -> None:
    found = replayed(blind(driven(0).log)).estimate.gyroscope
    assert found is not None
    expected = START**2 + WALK**2 * DT * 15
    np.testing.assert_allclose(found.rates, 0.0, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(found.covariance, expected * np.eye(3), rtol=1e-6, atol=1e-10)


def test_a_log_on_disk_and_a_restored_smoother_find_the_same(tmp_path: Path) -> None:
    log = driven(0).log
    estimator = made_or_given(RIG, Isam2Settings(), EgoMotionSettings(), None)
    first = replayed(log, estimator).estimate
    again = made_or_given(RIG, Isam2Settings(), EgoMotionSettings(), None)
    restore(again, state_of(estimator))  # type: ignore[attr-defined]
    assert_same_bits(first, again.estimate())
    log.save(tmp_path / "log.npz")
    back = MeasurementLog.load(tmp_path / "log.npz")
    assert_same_bits(first, replayed(back, Isam2Settings()).estimate)


# --------------------------------------------------------------------------------------------
# Loops


def with_loop(one: Driven, off_m: float) -> MeasurementLog:
    """The last frame recognises frame 5, so far from where it is (to 1 cm and 0.06 degrees)."""
    frames, poses = list(one.log), one.simulation.poses
    true = g.inverse(poses[5]) @ poses[len(frames) - 1]
    oTc = true @ g.pose(np.eye(3), np.array([off_m, 0.0, 0.0]))
    seen = frames[-1].observations
    loop = LoopClosure(
        frame=5,
        oTc=oTc,
        covariance=np.diag(np.repeat([1e-3, 1e-2], 3) ** 2),
        observations=seen.select(np.zeros(len(seen), np.bool_)),
        merged=np.empty((0, 2), np.int64),
    )
    out = MeasurementLog(one.log.rig, one.log.motion_model)
    for increment in [*frames[:-1], dataclasses.replace(frames[-1], loops=(loop,))]:
        out.append(increment)
    return out


@pytest.mark.parametrize("settings", SMOOTHERS)
def test_a_bias_lets_no_wrong_loop_in(settings: EstimatorSettings) -> None:
    """What the tree or the window has without the bias as a variable is no minimum to judge by."""
    one = driven(0)
    right, wrong = (replayed(with_loop(one, off), settings) for off in (0.15, 1.0))
    assert any("the camera moved by" in line for line in right.estimate.remarks)
    assert any("standard deviations off" in line for line in wrong.estimate.remarks)
    assert rms(errors(right, one.simulation)[:, 3:]) < 0.03


def test_a_loop_is_solved_from_the_bias_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    starts: list[State] = []

    def watched(graph: WholeGraph, state: State) -> State:
        starts.append(state)
        return solved(graph, state)

    monkeypatch.setattr(loop_closing, "solved", watched)
    one = driven(0)
    replayed(with_loop(one, 1.0), Isam2Settings(noise_factor=1.0))
    nodes = starts[0].bias.reshape(-1, 3)
    assert np.degrees(np.abs(nodes - one.bias)).max() < 0.2, "the bias is of 1 degree/s"
