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
from fgslam.backend.homing.settings import HomingEkfSettings
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.homing import HomingEstimate, HomingStart, TrackedBearings, among
from fgslam.core.planar import wrap
from fgslam.factors.bearing_residuals import (
    polar_jacobians,
    polar_points,
    target_jacobian,
    target_pose,
)


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
        state = self._state.keeping(among(self._state.ids, self._features.alive))
        state = predicted(state, step, self._settings.motion)
        rows = taken & among(tracked.ids, state.ids)
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
        """The target's own filter, given the same bearings once more."""
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
        return HomingEstimate(
            time=self._features.time,
            robot=_wrapped(state.mean[:3]),
            target=_wrapped(target_pose(target)),
            covariance=jacobian @ state.covariance[np.ix_(rows, rows)] @ jacobian.T,
            ids=state.ids,
            landmarks=polar_points(state.polar),
            landmark_covariances=_landmark_covariances(state, landmarks),
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
    noise = np.diag(seen.variance) if extra is None else np.diag(seen.variance) + extra
    jacobian, innovation = seen.jacobian, seen.innovation
    finite = np.asarray(np.isfinite(jacobian).all(axis=1))
    if not finite.all():
        jacobian, innovation, noise = _rows(finite, jacobian, innovation, noise)
    crossed = state.covariance @ jacobian.T
    expected = jacobian @ crossed + noise
    near = np.asarray(innovation**2 <= gate_sigmas**2 * np.diagonal(expected))
    if gate_sigmas > 0.0 and not near.all():
        jacobian, innovation, noise = _rows(near, jacobian, innovation, noise)
        crossed, expected = crossed[:, near], expected[np.ix_(near, near)]
    gain = np.linalg.solve(expected, crossed.T).T
    # Joseph's (1 - K H) P (1 - K H)^T + K R K^T without products of two matrices of P's size.
    left = state.covariance - gain @ crossed.T
    covariance = left - (left @ jacobian.T - gain @ noise) @ gain.T
    mean = state.mean + gain @ innovation
    return FilterState(state.ids, mean, 0.5 * (covariance + covariance.T))


def _rows(
    which: BoolArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The measurement without the others."""
    return jacobian[which], innovation[which], noise[np.ix_(which, which)]


def _landmark_covariances(state: FilterState, wanted: bool) -> FloatArray:
    """(n, 2, 2) of the points; NaN unless wanted."""
    n = len(state.ids)
    if not wanted:
        return np.full((n, 2, 2), np.nan)
    by_polar, every = polar_jacobians(state.polar), np.arange(n)
    blocks = state.covariance[7:, 7:].reshape(n, 2, n, 2)[every, :, every, :]
    return np.asarray(by_polar @ blocks @ np.swapaxes(by_polar, 1, 2))


def _wrapped(pose: FloatArray) -> FloatArray:
    return np.append(pose[:2], wrap(pose[2]))
