"""Noise of the constant-velocity model, estimated from how far it was off.

Innovations with a fading memory (Mehra 1970; Mohamed and Schwarz 1999), axis by axis, as the
maximum-likelihood estimate of a variance whose samples are themselves uncertain: the correction
of a step, squared, plus the variance that is left in it (the expectation step of Dempster, Laird
and Rubin 1977; Shumway and Stoffer 1982). docs/derivations/motion_noise.md.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.store import Kept

_MEMORY = 10.0  # frames after which a sample has lost all but 1/e of its weight
_FADING = float(np.exp(-1.0 / _MEMORY))
_START_FADING = 1.0 / 3.0  # the start is wide on purpose: five innovations outweigh a tenfold one
_SHARED_WEIGHT = 1.0  # samples that the mean of a block's axes counts for in each of them
_LEAST_SIGMA = np.repeat([np.deg2rad(0.05), 0.001], 3)
"""rad/s^2 and m/s^2; below what any matching measures: the estimate never collapses."""


class MotionNoise:
    """Variances of the random acceleration about and along the camera's axes."""

    _sum: Kept[FloatArray]
    _weight: Kept[float]
    _start_weight: Kept[float]

    def __init__(self, start_sigma: FloatArray) -> None:
        """``start_sigma`` (6,): [rotation, translation], rad/s^2 and m/s^2, before any sample."""
        self._start = start_sigma**2
        self._start_weight = 1.0
        self._sum = np.zeros(6)
        self._weight = 0.0

    @property
    def variance(self) -> FloatArray:
        """(6,) of the acceleration, rad^2/s^4 and m^2/s^4."""
        weight = self._weight + self._start_weight
        total = self._sum + self._start_weight * self._start
        shared = np.repeat(total.reshape(2, 3).mean(axis=1), 3) / weight
        own = (total + _SHARED_WEIGHT * shared) / (weight + _SHARED_WEIGHT)
        return np.asarray(np.maximum(own, _LEAST_SIGMA**2))

    def learn(self, innovation: FloatArray, left: FloatArray, span: float) -> None:
        """Takes in one step.

        Args:
            innovation: (6,) tangent vector from the predicted step to the one found.
            left: (6,) variance that is left in it.
            span: seconds squared by which an acceleration becomes a change of the step.
        """
        self._sum = _FADING * self._sum + (innovation**2 + left) / span**2
        self._weight = _FADING * self._weight + 1.0
        self._start_weight *= _START_FADING
