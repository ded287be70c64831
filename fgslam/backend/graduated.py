"""Graduated non-convexity (Yang et al. 2020) with truncated least squares, by GTSAM."""

from __future__ import annotations

from typing import Any

import gtsam

from fgslam.factors.keys import is_pose, number

_CONFIDENCE = 0.999  # of a right match's residual: chi-square 16.3 for three degrees of freedom
_KEPT = 0.5  # weights end at 0 or 1


def graduated(graph: Any, values: Any, inner: Any) -> tuple[Any, Any]:
    """Minimises with landmark observations as the possible outliers.

    Args:
        graph: factors without kernels.
        values: initial values.
        inner: parameters of the Levenberg-Marquardt steps.

    Returns:
        Values at the minimum, and the graph without the observations that were rejected.
    """
    factors = [graph.at(row) for row in range(graph.size())]
    observed = [_landmark(factor) is not None for factor in factors]
    params = gtsam.GncLMParams(inner)
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([row for row, is_one in enumerate(observed) if not is_one])
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    optimizer.setInlierCostThresholdsAtProbability(_CONFIDENCE)
    found = optimizer.optimize()
    weights = optimizer.getWeights()
    kept = gtsam.NonlinearFactorGraph()
    for factor, weight, is_one in zip(factors, weights, observed, strict=True):
        if weight > _KEPT or not is_one:
            kept.add(factor)
    return found, kept


def observed_variables(graph: Any) -> set[int]:
    """Landmark variables that some pose observes."""
    found = {_landmark(graph.at(row)) for row in range(graph.size())}
    return {variable for variable in found if variable is not None}


def _landmark(factor: Any) -> int | None:
    """The landmark variable of an observation; None for other factors."""
    keys = list(factor.keys())
    if len(keys) != 2 or not is_pose(keys[0]) or is_pose(keys[1]):
        return None
    return number(keys[1])
