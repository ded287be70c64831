"""Levenberg and Marquardt's damping: as little as lets a step lower the cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from numpy.linalg import LinAlgError

from fgslam.core.errors import EstimatorError

T = TypeVar("T")

_FIRST, _TIMES, _MOST = 1e-3, 10.0, 1e6
_ROUNDING = 1e-9


class Damping:
    """How much the last step was damped: none at first, as Gauss and Newton do it."""

    def __init__(self, least: float = 1e-9) -> None:
        """None yet; it ends below ``least``.

        Where an undamped step leads astray, damping must fall from one step to the next: steps
        that are tried undamped in vain each time, and then damped as before, creep.
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
