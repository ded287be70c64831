"""Robust linear least squares: Cauchy's M-estimator with a Gaussian prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.quantiles import middle

KERNEL = 2.0
"""Spreads of the residuals at which Cauchy's kernel bends."""

_ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class RobustFit:
    """The unknowns (p,), the spread of the residuals, and the weighted normal equations.

    ``normal`` (p, p) and ``moment`` (p,) are those of the last iteration, without the prior;
    divided by ``spread**2`` they are information and score.
    """

    found: FloatArray
    spread: float
    normal: FloatArray
    moment: FloatArray


def cauchy_fit(
    design: FloatArray, values: FloatArray, prior: FloatArray, least_spread: float
) -> RobustFit:
    """Iteratively reweighted least squares with Cauchy's kernel (Huber 1981, ch. 7).

    Args:
        design: (n, p), of a linear model ``values = design @ unknowns + noise``.
        values: (n,).
        prior: (p, p) information of the unknowns, whose prior mean is zero.
        least_spread: of the residuals: that of exact data.
    """
    found: FloatArray = np.zeros(design.shape[1])
    for _ in range(_ROUNDS):
        residual = values - design @ found
        spread = max(least_spread, 1.4826 * middle(np.abs(residual)))
        weighted = design.T * (1.0 / (1.0 + (residual / (KERNEL * spread)) ** 2))
        normal, moment = weighted @ design, weighted @ values
        found = np.asarray(np.linalg.solve(normal + spread**2 * prior, moment), np.float64)
    return RobustFit(found, spread, normal, moment)
