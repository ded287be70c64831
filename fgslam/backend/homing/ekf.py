"""The paper's extended Kalman filters for homing (IV-B, IV-C), printed or honest."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fgslam.backend.homing.ekf_model import (
    TARGET,
    FilterState,
    Measured,
    initial_state,
    predicted,
    seen_from_robot,
    seen_from_target,
)
from fgslam.backend.homing.inputs import TrackedFeatures
from fgslam.errors import EstimatorError
from fgslam.factors.bearing_residuals import (
    polar_jacobians,
    polar_points,
    target_jacobian,
    target_pose,
)
from fgslam.homing_types import HomingEstimate, HomingStart, TrackedBearings
from fgslam.planar import wrap
from fgslam.settings.homing_estimators import HomingEkfSettings
from fgslam.types import BoolArray, FloatArray


class HomingEkf:
    """Estimator of kind ``homing_ekf``, on :class:`fgslam.backend.homing.protocol.HomingEstimator`.

    One state holds robot, target and features. Where the target has a filter of its own, nothing
    links it to the rest, and both are updated one after the other.
    """

    kind: ClassVar[str] = "homing_ekf"

    def __init__(self, start: HomingStart, settings: HomingEkfSettings) -> None:
        """Starts at the origin with the map and target of the initialisation step."""
        self._settings = settings
        self._features = TrackedFeatures(start)
        self._state = initial_state(start, settings)
        self._target_ids = start.local_map.ids
        self._target_bearing = start.matches.bearing_b
        self._target_sigma = start.matches.sigma[:, 2]

    @property
    def state(self) -> FilterState:
        """Mean and covariance now."""
        return self._state

    def update(self, tracked: TrackedBearings) -> None:
        """Takes in one image; see the protocol.

        Raises:
            EstimatorError: as the protocol says, or the filter ran to infinity; it stays as it
                was before then.
        """
        step, taken = self._features.take(tracked)
        state = self._state.keeping(np.isin(self._state.ids, self._features.alive))
        state = predicted(state, step, self._settings.motion)
        rows = taken & np.isin(tracked.ids, state.ids)
        seen = seen_from_robot(state, tracked.bearing[rows], tracked.sigma_bearing[rows])
        try:
            state = updated(state, seen, self._settings.gate_sigmas)
            if self._settings.target == "separate":
                state = self._with_target(state)
        except np.linalg.LinAlgError as error:
            raise EstimatorError(f"the filter failed at {tracked.time:.3f} s: {error}") from None
        if not (np.isfinite(state.mean).all() and np.isfinite(state.covariance).all()):
            raise EstimatorError(f"the filter's state ran to infinity at {tracked.time:.3f} s")
        self._state = state

    def _with_target(self, state: FilterState) -> FilterState:
        """The target's own filter, told the same bearings once more (E-G7)."""
        rows = np.searchsorted(self._target_ids, state.ids)
        seen = seen_from_target(state, self._target_bearing[rows], self._target_sigma[rows])
        extra = np.zeros((len(rows), len(rows)))
        if self._settings.map_covariance:
            by_map = seen.jacobian[:, 7:]
            extra = by_map @ state.covariance[7:, 7:] @ by_map.T
        own = FilterState(state.ids[:0], state.mean[TARGET], state.covariance[TARGET, TARGET])
        measured = Measured(seen.innovation, seen.jacobian[:, TARGET], seen.variance)
        own = updated(own, measured, self._settings.gate_sigmas, extra)
        mean, covariance = state.mean.copy(), state.covariance.copy()
        mean[TARGET], covariance[TARGET, TARGET] = own.mean, own.covariance
        return FilterState(state.ids, mean, covariance)

    def estimate(self, landmarks: bool = True) -> HomingEstimate:
        """The present state; see the protocol."""
        state = self._state
        target = state.mean[TARGET]
        rows = np.array([0, 1, 2, 4, 5, 6])
        jacobian = np.eye(6)
        jacobian[3:, 3:] = target_jacobian(target)
        by_polar = polar_jacobians(state.polar)
        n = len(state.ids)
        every = np.arange(n)
        blocks = state.covariance[7:, 7:].reshape(n, 2, n, 2)[every, :, every, :]
        return HomingEstimate(
            time=self._features.time,
            robot=_wrapped(state.mean[:3]),
            target=_wrapped(target_pose(target)),
            covariance=jacobian @ state.covariance[np.ix_(rows, rows)] @ jacobian.T,
            ids=state.ids,
            landmarks=polar_points(state.polar),
            landmark_covariances=by_polar @ blocks @ np.swapaxes(by_polar, 1, 2),
        )


def updated(
    state: FilterState, seen: Measured, gate_sigmas: float, extra: FloatArray | None = None
) -> FilterState:
    """The extended Kalman filter's update, in Joseph's form.

    Args:
        state: mean and covariance before; the measurement's derivative is by its mean.
        seen: the measurement.
        gate_sigmas: innovations beyond so many of their own deviations are left out; 0: none.
        extra: (m, m) covariance of the measurement besides its own variances.
    """
    rows = _within_gate(state, seen, gate_sigmas, extra)
    jacobian, noise = seen.jacobian[rows], np.diag(seen.variance[rows])
    if extra is not None:
        noise = noise + extra[np.ix_(rows, rows)]
    crossed = state.covariance @ jacobian.T
    gain = np.linalg.solve(jacobian @ crossed + noise, crossed.T).T
    kept = np.eye(len(state.mean)) - gain @ jacobian
    covariance = kept @ state.covariance @ kept.T + gain @ noise @ gain.T
    mean = state.mean + gain @ seen.innovation[rows]
    return FilterState(state.ids, mean, 0.5 * (covariance + covariance.T))


def _within_gate(
    state: FilterState, seen: Measured, sigmas: float, extra: FloatArray | None
) -> BoolArray:
    finite = np.isfinite(seen.jacobian).all(axis=1)
    if sigmas == 0.0:
        return np.asarray(finite)
    variance = ((seen.jacobian @ state.covariance) * seen.jacobian).sum(axis=1)
    variance = variance + seen.variance + (0.0 if extra is None else np.diagonal(extra))
    return np.asarray(finite & (seen.innovation**2 <= sigmas**2 * variance))


def _wrapped(pose: FloatArray) -> FloatArray:
    return np.append(pose[:2], wrap(pose[2]))
