"""The answer at the end: outliers trimmed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from smoothing import SMOOTHERS, answer, ate, counting, drawn, run, wrong_matches

from benchmarks.gtsam_graphs import in_arrays
from fgslam.backend.settings import BatchSettings, EstimatorSettings, KernelSettings
from fgslam.backend.smoothers.final import graduated, trimmed
from fgslam.core.arrays import FloatArray

CAUCHY = KernelSettings("cauchy", 3.0)
ROBUST: dict[str, EstimatorSettings] = {
    **{name: SMOOTHERS[name] for name in ("batch", "isam2", "fixed_lag", "sliding_window")},
    "fixed_lag, cauchy": dataclasses.replace(SMOOTHERS["fixed_lag"], kernel=CAUCHY),
}
PLAIN = BatchSettings(kernel=KernelSettings("none"), trim=False)


@pytest.mark.parametrize("name", ROBUST)
def test_30_percent_gross_errors_less_than_double_the_error(name: str) -> None:
    for seed in range(2):
        simulation = drawn(seed)
        spoilt = wrong_matches(simulation.increments, 0.3, np.random.default_rng(100 + seed))
        clean = ate(answer(ROBUST[name], simulation.increments), simulation)
        assert ate(answer(ROBUST[name], spoilt), simulation) < 2.0 * clean, seed


def problem(kernel: KernelSettings, share: float) -> tuple[gtsam.NonlinearFactorGraph, object, int]:
    """A graph, its initial values, and how many of its matches are wrong."""
    simulation = drawn(0)
    spoilt = wrong_matches(simulation.increments, share, np.random.default_rng(100))
    pairs = zip(simulation.increments, spoilt, strict=True)
    wrong = sum(
        int((a.observations.measurement != b.observations.measurement).any(axis=1).sum())
        for a, b in pairs
    )
    settings = dataclasses.replace(PLAIN, kernel=kernel)
    estimator, _ = run(settings, spoilt)
    return estimator.builder.kept_factors(), estimator.solver.values, wrong


def solved(
    method: Callable[..., Any], graph: Any, values: Any, kernel: KernelSettings
) -> tuple[Any, Any]:
    """GTSAM's values and factors that a treatment of outliers ends with."""
    state, kept = method(*in_arrays(graph, values, kernel))
    return kept.values(state), counting(graph, kept)


def residuals(graph: gtsam.NonlinearFactorGraph, values: object) -> FloatArray:
    """Squared whitened residuals of the landmark observations, without kernels."""
    out = []
    for row in range(graph.size()):
        factor = graph.at(row)
        model = factor.noiseModel()
        if isinstance(factor, gtsam.GenericStereoFactor3D):
            plain = model.noise() if isinstance(model, gtsam.noiseModel.Robust) else model
            out.append(plain.whiten(factor.unwhitenedError(values)))
    return np.array([r @ r for r in out])


@pytest.mark.parametrize("name", ["huber", "geman_mcclure"])
def test_the_trim_keeps_what_is_within_the_quantile_and_nothing_else(name: str) -> None:
    graph, values, wrong = problem(KernelSettings(name, 3.0), 0.3)
    found, kept = solved(trimmed, graph, values, KernelSettings(name, 3.0))
    everything, inside = residuals(graph, found), residuals(kept, found)
    assert len(inside) == (everything <= 16.2662).sum()
    assert inside.max() <= 16.2663
    left_out = len(everything) - len(inside)
    assert 0.9 * wrong < left_out < 1.1 * wrong
    # What it keeps carries no kernel any more.
    models = [kept.at(row).noiseModel() for row in range(kept.size())]
    assert not any(isinstance(model, gtsam.noiseModel.Robust) for model in models)


def test_the_trim_leaves_a_clean_problem_nearly_whole() -> None:
    graph, values, wrong = problem(CAUCHY, 0.0)
    assert wrong == 0
    _, kept = solved(trimmed, graph, values, CAUCHY)
    assert graph.size() - 5 <= kept.size() <= graph.size()


def test_graduated_non_convexity_finds_the_wrong_ones() -> None:
    graph, values, wrong = problem(KernelSettings("none"), 0.3)
    found, kept = solved(graduated, graph, values, KernelSettings("none"))
    left_out = graph.size() - kept.size()
    assert 0.9 * wrong < left_out < 1.1 * wrong
    assert residuals(kept, found).max() < 20.0
    others = graph.size() - len(residuals(graph, values))
    assert kept.size() - len(residuals(kept, values)) == others


def test_unseen_landmarks_are_those_of_which_no_observation_counts() -> None:
    estimator, _ = run(PLAIN, drawn(0).increments)
    graph, _ = in_arrays(estimator.builder.kept_factors(), estimator.solver.values)
    assert graph.unseen().tolist() == []
    assert graph.weighed(np.zeros(len(graph.weights))).unseen().tolist() == list(
        range(estimator.builder.variables)
    )
