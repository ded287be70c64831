"""The paper's extended Kalman filters for homing (IV-B, IV-C; eqs 3 to 9), printed or corrected.

The state is (x, y, psi, v; D, theta, psi_t; d_1, delta_1, d_2, ...): robot, target, features, in
the start frame. Derivation: docs/derivations/homing_filters.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.linalg import lapack

from fgslam.backend.homing.estimator import TrackedFeatures
from fgslam.backend.homing.settings import FilterMotionSettings, HomingEkfSettings
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.homing import HomingEstimate, HomingStart, TrackedBearings, among
from fgslam.core.planar import unit, wrapped_pose
from fgslam.factors.bearing_residuals import (
    bearing,
    bearing_jacobians,
    polar_jacobians,
    polar_points,
    target_jacobian,
    target_pose,
    triangulated,
)

_INITIAL_SPEED = 0.5  # deviation of the speed at the start, around 0, legs/s

ROBOT, TARGET, FEATURES = slice(0, 4), slice(4, 7), slice(7, None)
_FIRST = 7


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """Mean and covariance of the filters.

    Attributes:
        ids: (n,) features in the map, ascending.
        mean: (7 + 2n,).
        covariance: (7 + 2n, 7 + 2n); zero between target and the rest where they are separate.
    """

    ids: IntArray
    mean: FloatArray
    covariance: FloatArray

    @property
    def polar(self) -> FloatArray:
        """(n, 2) distance and bearing of the features from the start."""
        return self.mean[FEATURES].reshape(-1, 2)

    def keeping(self, which: BoolArray) -> FilterState:
        """The state without the features that are lost.

        Rows and columns are deleted, which *is* marginalisation: all that the lost features
        taught about the others stays.
        """
        if which.all():
            return self
        rows = np.concatenate([np.ones(_FIRST, np.bool_), np.repeat(which, 2)])
        return FilterState(
            self.ids[which], self.mean[rows], self.covariance[np.ix_(rows, rows)].copy()
        )


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A linearised measurement: innovation (m,), derivative by the whole state, variances (m,)."""

    innovation: FloatArray
    jacobian: FloatArray
    variance: FloatArray


# --------------------------------------------------------------------------------------------
# Start


def initial_state(start: HomingStart, settings: HomingEkfSettings) -> FilterState:
    """Mean and covariance after the initialisation step, in the gauge of the settings."""
    kept = _admitted(start, settings.max_relative_distance_sigma)
    chart = start.local_map
    polar = np.column_stack([chart.distance, chart.bearing])[kept]
    vector = np.array([1.0, start.vector.direction, start.vector.rotation])
    mean = np.concatenate([np.zeros(4), vector, polar.ravel()])
    covariance = np.zeros((len(mean), len(mean)))
    make = _joint_covariance if settings.target == "joint" else _independent_covariance
    covariance[4:, 4:] = make(start, kept, settings.exact_bearings)
    covariance[3, 3] = _INITIAL_SPEED**2
    state = FilterState(chart.ids[kept], mean, 0.5 * (covariance + covariance.T))
    return _with_one_distance(state, settings) if settings.gauge == "one_distance" else state


def _admitted(start: HomingStart, limit: float) -> BoolArray:
    distance = start.local_map.distance
    variance = start.local_map.covariance[:, 0, 0]
    sound = np.isfinite(distance) & np.isfinite(variance) & (distance > 0.0)
    return np.asarray(sound if limit == 0.0 else sound & (variance <= (limit * distance) ** 2))


def _joint_covariance(start: HomingStart, kept: BoolArray, exact: bool) -> FloatArray:
    """(3 + 2n,) square, of target and features as what they are: functions of the two views.

    All distances hang on the same direction and rotation of the target, and each on its own pair
    of bearings; the target's are thereby used, once.
    """
    vector, matches = start.vector, start.matches.select(kept)
    n = len(matches)
    _, by = triangulated((vector.direction, vector.rotation), matches.bearing_a, matches.bearing_b)
    root = np.zeros((3 + 2 * n, 2 + 2 * n))  # by (theta, psi; delta_i; delta'_i)
    root[1:3, :2] = np.eye(2)
    rows, columns = 3 + 2 * np.arange(n), 2 + np.arange(n)
    root[rows, :2] = by[:, :2]
    root[rows, columns], root[rows, columns + n] = by[:, 2], by[:, 3]
    root[rows + 1, columns] = 1.0
    sigma = np.concatenate([np.zeros(n) if exact else matches.sigma[:, 0], matches.sigma[:, 2]])
    spread = np.zeros((2 + 2 * n, 2 + 2 * n))
    spread[:2, :2] = vector.covariance
    spread[2:, 2:] = np.diag(sigma**2)
    return np.asarray(root @ spread @ root.T)


def _independent_covariance(start: HomingStart, kept: BoolArray, exact: bool) -> FloatArray:
    """The same as the paper has it: each feature and the target for itself."""
    blocks = start.local_map.covariance[kept].copy()
    if exact:
        blocks[:, 1, :] = blocks[:, :, 1] = 0.0
    out = np.zeros((3 + 2 * len(blocks), 3 + 2 * len(blocks)))
    out[1:3, 1:3] = start.vector.covariance
    rows = 3 + 2 * np.arange(len(blocks))[:, None] + np.arange(2)
    out[rows[:, :, None], rows[:, None, :]] = blocks
    return out


def _with_one_distance(state: FilterState, settings: HomingEkfSettings) -> FilterState:
    """The unit becomes one feature's distance, as triangulated: the one best known (IV-B)."""
    if len(state.ids) == 0:
        return state
    distances = _FIRST + 2 * np.arange(len(state.ids))
    covariance = state.covariance.copy()
    relative = covariance[distances, distances] / state.mean[distances] ** 2
    gauge = distances[np.argmin(relative)]
    if settings.target == "joint":
        lengths = np.concatenate([[0, 1, 3, 4], distances])
        change = np.eye(len(state.mean))
        change[lengths, gauge] -= state.mean[lengths] / state.mean[gauge]
        covariance = change @ covariance @ change.T
    covariance[gauge, :] = covariance[:, gauge] = 0.0
    if settings.target == "separate":
        covariance[4, 4] = relative.min()
    return FilterState(state.ids, state.mean, covariance)


# --------------------------------------------------------------------------------------------
# Motion


def motion(
    robot: FloatArray, step: float, noise: FilterMotionSettings
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Next (x, y, psi, v), its derivative by the last and the noise's covariance (eqs 4, 5).

    Args:
        robot: (4,).
        step: seconds.
        noise: densities of the random walks of place, heading and speed.
    """
    x, y, psi, speed = robot.tolist()
    ahead, left = step * math.cos(psi), step * math.sin(psi)
    moved = np.array([x + speed * ahead, y + speed * left, psi, speed])
    jacobian = np.eye(4)
    jacobian[:2, 2] = -speed * left, speed * ahead
    jacobian[:2, 3] = ahead, left
    deviations = np.array([noise.slip, noise.slip, math.radians(noise.heading_deg), noise.speed])
    return moved, jacobian, np.diag(step * deviations**2)


def predicted(state: FilterState, step: float, noise: FilterMotionSettings) -> FilterState:
    """The state ``step`` seconds later; target and features stand still."""
    moved, jacobian, spread = motion(state.mean[ROBOT], step, noise)
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[ROBOT] = moved
    covariance[ROBOT, :] = jacobian @ covariance[ROBOT, :]
    covariance[:, ROBOT] = covariance[:, ROBOT] @ jacobian.T
    covariance[ROBOT, ROBOT] += spread
    return FilterState(state.ids, mean, covariance)


# --------------------------------------------------------------------------------------------
# Measurements


def seen_from_robot(state: FilterState, measured: FloatArray, sigma: FloatArray) -> Measured:
    """Bearings (n,) of all features from the present pose (eqs 6 to 8, corrected)."""
    by_pose, by_polar, innovation = _seen(state, state.mean[:3], measured)
    jacobian = np.zeros((len(measured), len(state.mean)))
    jacobian[:, :3] = by_pose
    _put(jacobian, by_polar)
    return Measured(innovation, jacobian, sigma**2)


def seen_from_target(state: FilterState, measured: FloatArray, sigma: FloatArray) -> Measured:
    """Bearings (n,) of all features from the target (eq. 9, corrected)."""
    target = state.mean[TARGET]
    by_pose, by_polar, innovation = _seen(state, target_pose(target), measured)
    jacobian = np.zeros((len(measured), len(state.mean)))
    jacobian[:, TARGET] = by_pose @ target_jacobian(target)
    _put(jacobian, by_polar)
    return Measured(innovation, jacobian, sigma**2)


def _seen(
    state: FilterState, pose: FloatArray, measured: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives by the pose (n, 3) and by each feature's own (d, delta) (n, 2); innovation."""
    distance, along = state.polar[:, 0], unit(state.polar[:, 1])
    points = distance[:, None] * along
    by_pose, by_point = bearing_jacobians(pose, points)
    by_polar = np.empty_like(by_point)
    np.einsum("ni,ni->n", by_point, along, out=by_polar[:, 0])
    by_polar[:, 1] = distance * (by_point[:, 1] * along[:, 0] - by_point[:, 0] * along[:, 1])
    return by_pose, by_polar, -bearing(pose, points, measured)


def _put(jacobian: FloatArray, by_polar: FloatArray) -> None:
    """Each row's derivative by its own feature, two columns farther right from row to row."""
    flat, step = jacobian.reshape(-1), jacobian.shape[1] + 2
    flat[_FIRST::step], flat[_FIRST + 1 :: step] = by_polar.T


# --------------------------------------------------------------------------------------------
# Estimator


class HomingEkf:
    """Estimator of kind ``homing_ekf``.

    On :class:`fgslam.backend.homing.estimator.HomingEstimator`. One state holds robot, target and
    features. Where the target has a filter of its own, nothing links it to the rest, and both are
    updated one after the other.
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
        jacobian = np.zeros((6, _FIRST))
        jacobian[:3, :3], jacobian[3:, TARGET] = np.eye(3), target_jacobian(target)
        return HomingEstimate(
            time=self._features.time,
            robot=wrapped_pose(state.mean[:3]),
            target=wrapped_pose(target_pose(target)),
            covariance=jacobian @ state.covariance[:_FIRST, :_FIRST] @ jacobian.T,
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
    jacobian, innovation = seen.jacobian, seen.innovation
    noise = np.diag(seen.variance) if extra is None else np.diag(seen.variance) + extra
    if not np.isfinite(jacobian).all():
        finite = np.asarray(np.isfinite(jacobian).all(axis=1))
        jacobian, innovation, noise = _rows(finite, jacobian, innovation, noise)
    crossed = state.covariance @ jacobian.T
    expected = jacobian @ crossed + noise
    near = np.asarray(innovation**2 <= gate_sigmas**2 * np.diagonal(expected))
    if gate_sigmas > 0.0 and not near.all():
        innovation = innovation[near]
        crossed, expected = crossed[:, near], expected[np.ix_(near, near)]
    gain = _solved(expected, crossed.T).T
    # Joseph's (1 - K H) P (1 - K H)^T + K R K^T, multiplied out, as a symmetric matrix's half:
    # P - K C^T - C K^T + K S K^T with C = P H^T and S = H C + R.
    covariance = state.covariance - (2.0 * crossed - gain @ expected) @ gain.T
    mean = state.mean + gain @ innovation
    return FilterState(state.ids, mean, 0.5 * (covariance + covariance.T))


def _solved(expected: FloatArray, right: FloatArray) -> FloatArray:
    """(m, k) of a covariance (m, m); by elimination where rounding has left it indefinite.

    Raises:
        numpy.linalg.LinAlgError: it is singular.
    """
    if not len(expected):
        return right
    _, solved, info = lapack.dposv(expected, right, lower=1)
    return np.asarray(np.linalg.solve(expected, right) if info else solved)


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
