"""How large the errors of matches are, from how a drive's frames fit the map.

Each frame says it by the median of its squared residuals, which up to half of its matches may
spoil (Rousseeuw and Leroy 1987, 4.4); the drive by the median of its latest frames, so that a
stretch in which the map contradicts itself does not speak for the sensor.
docs/derivations/measurement_noise.md.
"""

from __future__ import annotations

import math
from collections import deque

from fgslam.core.estimates import EgoMotion
from fgslam.core.store import Kept

_FRAMES = 30  # latest ones that count: as many sightings as the longest track that is judged
_STATED = 2  # frames that the stated noise counts for: three must contradict it
_DOUBTED = 2.0
"""Variance over the stated one from which on that is not believed: a gate of four deviations loses
one right match in twenty."""


class MatchNoise:
    """Variance of a drive's measurements over the stated one."""

    _latest: Kept[deque[float]]

    def __init__(self) -> None:
        """As stated, until frames contradict it."""
        self._latest = deque(maxlen=_FRAMES)

    @property
    def variance(self) -> float:
        """Over the stated one; one where that may well be true, and never less."""
        told = sorted([*(1.0,) * _STATED, *self._latest])
        found = told[(len(told) - 1) // 2]  # of two in the middle the lower
        return found if found > _DOUBTED else 1.0

    def learn(self, tracking: EgoMotion) -> None:
        """Takes in a frame; one that was not measured says nothing."""
        if not math.isnan(tracking.misfit):
            self._latest.append(tracking.misfit)
