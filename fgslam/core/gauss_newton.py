"""Gauss-Newton over many small problems at once, from any number of first guesses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray

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
