"""Robust linear least squares: Cauchy's M-estimator with a Gaussian prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.linalg import LinAlgError

from fgslam.core.arrays import FloatArray, middle
from fgslam.core.errors import EstimatorError

# ------------------------------------------------------------------------------------------
# Gauss-Newton over many small problems at once, from any number of first guesses

Linearised: TypeAlias = tuple[FloatArray, FloatArray]
"""Of c problems with k unknowns: half the Hessian (c, k, k) and the gradient (c, k) of the cost."""


@dataclass(frozen=True, slots=True)
class GaussNewton:
    """How far to go.

    Attributes:
        iterations: at most.
        converged: a problem is done once no unknown moves by this much.
        settling: first iterations after which no problem is done: while the caller still widens
            its gates, a short step means nothing.
        longest: no unknown moves by more in one step.
        damping: added to the Hessian's diagonal, so that unknowns left open stay where they are.
    """

    iterations: int
    converged: float
    settling: int = 0
    longest: float = np.inf
    damping: float = 0.0

    def minimise(
        self, start: FloatArray, linearise: Callable[[FloatArray, int], Linearised]
    ) -> FloatArray:
        """(c, k) unknowns at the minimum of each problem, or where the iterations ended.

        Args:
            start: (c, k) first guesses.
            linearise: gives Hessians and gradients at unknowns (g, k) of the problems that go on,
                and is given the iteration, from 0. Robust weights are its own affair: reweighting
                with every call makes this iteratively reweighted least squares.

        Raises:
            numpy.linalg.LinAlgError: a Hessian is singular.
        """
        unknowns = np.array(start, dtype=np.float64)
        going = np.arange(len(unknowns))
        damping, bounded = self.damping * np.eye(unknowns.shape[1]), np.isfinite(self.longest)
        for k in range(self.iterations):
            hessian, gradient = linearise(unknowns[going], k)
            step = np.linalg.solve(hessian + damping, -gradient[:, :, None])[:, :, 0]
            unknowns[going] += np.clip(step, -self.longest, self.longest) if bounded else step
            if k >= self.settling:
                going = going[np.abs(step).max(axis=1) >= self.converged]
            if not len(going):
                break
        return unknowns


# ------------------------------------------------------------------------------------------
# Levenberg and Marquardt's damping: as little as lets a step lower the cost

T = TypeVar("T")

_FIRST, _TIMES, _MOST = 1e-3, 10.0, 1e6
_ROUNDING = 1e-9


class Damping:
    """How much the last step was damped: none at first, as Gauss and Newton do it."""

    def __init__(self, least: float = 1e-9) -> None:
        """None yet; it ends below ``least``.

        Where an undamped step does not lower the cost, damping must fall from one step to the next:
        steps that are tried undamped in vain each time, and then damped as before, creep.
        """
        self.last = 0.0
        self._least = least

    def step(
        self, cost: float, attempt: Callable[[float], tuple[float, T]]
    ) -> tuple[float, T] | None:
        """Cost and state after one step that does not raise the cost; None where none does.

        Args:
            cost: before.
            attempt: cost and state after a step with so many times the diagonal added to itself;
                may raise LinAlgError or EstimatorError where that leaves variables open.
        """
        damping = self.last / _TIMES if self.last > self._least else 0.0
        while damping < _MOST:
            try:
                found = attempt(damping)
            except (LinAlgError, EstimatorError):
                pass
            else:
                if found[0] <= cost * (1.0 + _ROUNDING):
                    self.last = damping
                    return found
            damping = _TIMES * damping if damping > 0.0 else _FIRST
        return None


KERNEL = 2.0
"""Spreads of the residuals at which Cauchy's kernel turns from square to logarithm."""

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
