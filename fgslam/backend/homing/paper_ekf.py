"""The homing filters as Goedemé et al. (2005) print them (IV-B, IV-C), the model corrected.

Robot and features are one filter, the target another, which gets the *same* target bearings with
every image. One feature's distance is the unit of length, and bearings from the start have no
variance. What this does to the covariances: docs/derivations/homing_estimators.md.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fgslam.backend.homing.ekf import (
    FIRST,
    TARGET,
    FilterState,
    HomingEkf,
    Measured,
    seen_from,
    state_of,
    updated,
)
from fgslam.backend.settings import PaperEkfSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import HomingStart
from fgslam.factors.bearing import target_jacobian, target_pose


class PaperEkf(HomingEkf):
    """Homing estimator of kind ``paper_ekf``."""

    kind: ClassVar[str] = "paper_ekf"

    def __init__(self, start: HomingStart, settings: PaperEkfSettings) -> None:
        """As :class:`HomingEkf`."""
        super().__init__(start, settings)
        self._target_ids = start.local_map.ids
        self._target_bearing = start.matches.bearing_b
        self._target_sigma = start.matches.sigma[:, 2]

    def _initial_state(self, start: HomingStart) -> FilterState:
        return separate_initial_state(start)

    def _update_target(self, state: FilterState) -> FilterState:
        """The target's own filter, given the same bearings once more (IV-C)."""
        rows = np.searchsorted(self._target_ids, state.ids)
        seen = seen_from_target(state, self._target_bearing[rows], self._target_sigma[rows])
        own = FilterState(state.ids[:0], state.mean[TARGET], state.covariance[TARGET, TARGET])
        measured = Measured(seen.innovation, seen.jacobian[:, TARGET], seen.variance)
        own = updated(own, measured, self._gate_sigmas)
        mean, covariance = state.mean.copy(), state.covariance.copy()
        mean[TARGET], covariance[TARGET, TARGET] = own.mean, own.covariance
        return FilterState(state.ids, mean, covariance)


def separate_initial_state(start: HomingStart) -> FilterState:
    """Mean and covariance after the initialisation step: each feature and the target for itself.

    The unit becomes one feature's distance, as triangulated: the one best known (IV-B).
    """
    distance, variance = start.local_map.distance, start.local_map.covariance[:, 0, 0]
    kept = np.isfinite(distance) & np.isfinite(variance) & (distance > 0.0)
    n = int(kept.sum())
    covariance = np.zeros((3 + 2 * n, 3 + 2 * n))
    covariance[1:3, 1:3] = start.vector.covariance
    distances = 3 + 2 * np.arange(n)
    covariance[distances, distances] = variance[kept]
    state = state_of(start, kept, covariance)
    if n:
        distances = FIRST + 2 * np.arange(n)
        relative = state.covariance[distances, distances] / state.mean[distances] ** 2
        gauge = distances[np.argmin(relative)]
        state.covariance[gauge, :] = state.covariance[:, gauge] = 0.0
        state.covariance[4, 4] = relative.min()
    return state


def seen_from_target(state: FilterState, measured: FloatArray, sigma: FloatArray) -> Measured:
    """Bearings (n,) of all features from the target (eq. 9, corrected)."""
    target = state.mean[TARGET]
    innovation, by_pose, jacobian = seen_from(state, target_pose(target), measured)
    jacobian[:, TARGET] = by_pose @ target_jacobian(target)
    return Measured(innovation, jacobian, sigma**2)
