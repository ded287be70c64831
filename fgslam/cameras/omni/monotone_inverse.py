"""Exact inverse of a smooth monotone function: started from a table, ended by Newton's method."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray

ValueAndSlope: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]

_KNOTS = 513
# From a table of 513 knots two steps reach rounding; the others guard uneven functions.
_STEPS = 5


class MonotoneInverse:
    """Solves ``function(x) = y`` for x in an interval over which the function is monotone."""

    def __init__(self, function: ValueAndSlope, lowest: float, highest: float) -> None:
        """Tabulates ``function``, which gives values and slopes, over [lowest, highest]."""
        self._function, self._limits = function, (lowest, highest)
        knots = np.linspace(lowest, highest, _KNOTS)
        values, slopes = function(knots)
        self.monotone = bool(np.all(slopes > 0.0) or np.all(slopes < 0.0))
        self.knots = knots
        self.slopes = slopes
        rising = values[-1] > values[0]
        self._values = values if rising else values[::-1]
        self._starts = knots if rising else knots[::-1]

    def __call__(self, wanted: FloatArray) -> FloatArray:
        """Arguments (n,) of values (n,); NaN where the function does not take them."""
        wanted = np.asarray(wanted, dtype=np.float64)
        slack = 1e-12 * (1.0 + np.abs(self._values[[0, -1]]).max())
        seen = (wanted >= self._values[0] - slack) & (wanted <= self._values[-1] + slack)
        x = np.interp(np.where(seen, wanted, self._values[0]), self._values, self._starts)
        for _ in range(_STEPS):
            value, slope = self._function(x)
            x = np.clip(x - (value - wanted) / slope, *self._limits)
        return np.where(seen, x, np.nan)
