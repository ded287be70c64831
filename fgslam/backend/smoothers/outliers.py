"""Solving with wrong matches: a kernel and then a trim, or graduated non-convexity.

Either way the last solution is plain least squares over the observations that fit, so that its
covariances mean what they say.
"""

from __future__ import annotations

from typing import Any

import gtsam

from fgslam.backend.graphs import solver_parameters
from fgslam.core.quantiles import chi_square_quantile
from fgslam.factors.kernels import plain, robust
from fgslam.factors.keys import is_pose, number

_GATE = float(chi_square_quantile(0.999, 3))  # 16.3, of a landmark observation's three numbers
_KEPT = 0.5  # weights end at 0 or 1
_ROUNDS = 10  # trims until the observations that fit do not change any more
_QUICK_WIDTH = 3.0  # deviations, as the kernels' default
_ROUGH = 1e-4  # of the cost: the minimum with the kernel only chooses what fits


def graduated(graph: Any, values: Any, inner: Any, noise_factor: float = 1.0) -> tuple[Any, Any]:
    """Graduated non-convexity (Yang et al. 2020) with truncated least squares, by GTSAM.

    Landmark observations are the possible outliers.

    Args:
        graph: factors without kernels.
        values: initial values.
        inner: parameters of the Levenberg-Marquardt steps.
        noise_factor: by which the factors' deviations exceed the stated ones.

    Returns:
        Values at the minimum, and the graph without the observations that were rejected.
    """
    factors = [graph.at(row) for row in range(graph.size())]
    observed = [_landmark(factor) is not None for factor in factors]
    params = gtsam.GncLMParams(inner)
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([row for row, is_one in enumerate(observed) if not is_one])
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    # GTSAM's threshold is on the cost, half of the squared residual.
    optimizer.setInlierCostThresholds(0.5 * _GATE / noise_factor**2)
    found = optimizer.optimize()
    weights = optimizer.getWeights()
    kept = gtsam.NonlinearFactorGraph()
    for factor, weight, is_one in zip(factors, weights, observed, strict=True):
        if weight > _KEPT or not is_one:
            kept.add(factor)
    return found, kept


def trimmed(graph: Any, values: Any, params: Any, noise_factor: float = 1.0) -> tuple[Any, Any]:
    """Minimises with the factors' own kernels, then without them over what fits.

    Args:
        graph: factors, landmark observations with a kernel.
        values: initial values.
        params: of Levenberg-Marquardt.
        noise_factor: by which the factors' deviations exceed the stated ones, which judge.

    Returns:
        Values at the minimum, and the plain factors that were kept.
    """
    rough = solver_parameters(params.getMaxIterations(), _ROUGH)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values, rough).optimize()
    factors = [graph.at(row) for row in range(graph.size())]
    observed = [_landmark(factor) is not None for factor in factors]
    # A robust factor whitens with its kernel's weight, after which everything would seem to fit.
    # Loops keep their kernels: they are too few to be separated by a trim.
    factors = [plain(f) if is_one else f for f, is_one in zip(factors, observed, strict=True)]
    gate = _GATE / noise_factor**2
    fits: list[bool] = []
    for _ in range(_ROUNDS):
        before = fits
        pairs = zip(factors, observed, strict=True)
        fits = [not is_one or _squared(factor, values) <= gate for factor, is_one in pairs]
        if fits == before:
            break
        kept = gtsam.NonlinearFactorGraph()
        for factor, fit in zip(factors, fits, strict=True):
            if fit:
                kept.add(factor)
        values = gtsam.LevenbergMarquardtOptimizer(kept, values, rough).optimize()
    return gtsam.LevenbergMarquardtOptimizer(kept, values, params).optimize(), kept


def with_kernel(graph: Any) -> Any:
    """The graph with Cauchy's kernel around its landmark observations, for a quick solution."""
    out = gtsam.NonlinearFactorGraph()
    for row in range(graph.size()):
        factor = graph.at(row)
        observed = _landmark(factor) is not None
        out.add(robust(factor, "cauchy", _QUICK_WIDTH) if observed else factor)
    return out


def _squared(factor: Any, values: Any) -> float:
    """Whitened residual squared of a plain factor."""
    residual = factor.whitenedError(values)
    return float(residual @ residual)


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
