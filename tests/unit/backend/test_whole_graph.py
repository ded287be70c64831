"""The whole graph in arrays against GTSAM: cost, linear system, and the minimum."""

from __future__ import annotations

import dataclasses
from typing import Any

import gtsam
import numpy as np
import pytest
from factor_checks import random_covariance
from smoothing import drawn, run, wrong_matches

from fgslam.backend.loops import Constraint, constraint_factor
from fgslam.backend.settings import BatchSettings, KernelSettings
from fgslam.backend.smoothers.bundle import State, WholeGraph
from fgslam.backend.smoothers.elimination import ChainMarginals, GraphMarginals, reduced
from fgslam.backend.smoothers.final import MINIMUM
from fgslam.backend.smoothers.graph import GraphBuilder
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse, se3_exp
from fgslam.factors.graphs import poses_of_frame, solver_parameters

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
        builder.add_factor(constraint_factor(dataclasses.replace(known, doubted=True)))
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


@KERNELS
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_minimum_is_that_of_gtsam_on_drives_with_loops(name: str, seed: int) -> None:
    graph, values, builder = problem(name, seed)
    expected = by_gtsam(graph, values)
    whole, state = builder.whole_graph(values)
    found = whole.minimum(state, MINIMUM.iterations, MINIMUM.tolerance)
    assert whole.cost(found) <= graph.error(expected) * (1.0 + 1e-6)
    if name in ("huber", "cauchy"):  # the others have minima beside each other
        np.testing.assert_allclose(found.poses, State.of(expected).poses, rtol=0, atol=1e-4)


def test_both_eliminations_step_alike() -> None:
    graph, values, builder = problem("none")
    whole, state = builder.whole_graph(values)
    system = whole.linear(state)
    expected = graph.linearize(values).optimize().vector()
    for kind in (GraphMarginals, ChainMarginals):
        step = kind.of(system).step()
        np.testing.assert_allclose(step, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    assert reduced(system).step().shape == expected.shape


def test_graphs_of_arrays_and_of_factors_are_one_also_without_some_landmarks() -> None:
    graph, values, builder = problem("cauchy")
    kernel = builder.kernel
    pairs = [builder.whole_graph(values), WholeGraph.of(graph, values, kernel)]
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
