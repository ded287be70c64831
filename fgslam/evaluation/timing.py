"""Growth of an estimator's time a frame along a drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray

_LEAST_FRAMES = 25  # five a fifth: the median of fewer is noise


@dataclass(frozen=True, slots=True)
class TimeGrowth:
    """Growth of the time a frame.

    Attributes:
        ratio: median of the last fifth of the frames over that of the second fifth (the first
            holds what is slow only once); 1 is flat, 4 is proportional to the frames so far.
        slope_ms_per_1000: least-squares slope, milliseconds a thousand frames.
    """

    ratio: float
    slope_ms_per_1000: float


def time_growth(milliseconds: FloatArray) -> TimeGrowth | None:
    """Growth of times (n,) of consecutive frames; None for fewer than 25 of them."""
    n = len(milliseconds)
    if n < _LEAST_FRAMES:
        return None
    fifth = n // 5
    early, late = np.median(milliseconds[fifth : 2 * fifth]), np.median(milliseconds[-fifth:])
    if not early > 0.0:
        return None
    slope = np.polyfit(np.arange(n, dtype=np.float64), milliseconds, 1)[0]
    return TimeGrowth(float(late / early), float(1000.0 * slope))
