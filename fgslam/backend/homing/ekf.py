"""Homing by one extended Kalman filter (Goedemé et al. 2005, IV-B and IV-C), its errors corrected.

The state is (x, y, psi, v; D, theta, psi_t; d_1, delta_1, d_2, ...): robot, target, features, in
the start frame. Unlike the printed filters (:mod:`fgslam.backend.homing.paper_ekf`) the target is
part of the state, correlated with the features as they all come from the same two views, and its
bearings are used once; the unit of length is the leg. docs/derivations/homing_estimators.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.linalg import lapack

from fgslam.backend.homing.parts import TrackedFeatures
from fgslam.backend.settings import HomingEkfSettings, PaperEkfSettings
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.bearings import HomingEstimate, HomingStart, TrackedBearings, among
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import unit, wrapped_pose
from fgslam.factors.bearing import (
    bearing,
    bearing_jacobians,
    polar_jacobians,
    polar_points,
    target_jacobian,
    target_pose,
    triangulated,
)

ROBOT, TARGET, FEATURES = slice(0, 4), slice(4, 7), slice(7, None)
FIRST = 7  # number of the state before the features
INITIAL_SPEED = 0.5  # deviation of the speed at the start, around 0, legs/s
# Deviations after a second of the random walks of heading, which must cover the robot's turns, of
# speed (legs/s) and of place (legs: wheels slip); the paper states none.
_HEADING, _SPEED, _SLIP = math.radians(20.0), 0.1, 0.02
# A feature whose distance is known no better than this, relatively, is left out of the map.
_MOST_RELATIVE_SIGMA = 0.3


class HomingEkf:
    """Homing estimator of kind ``homing_ekf``."""

    kind: ClassVar[str] = "homing_ekf"

    def __init__(self, start: HomingStart, settings: HomingEkfSettings | PaperEkfSettings) -> None:
        """Starts at the origin with the map and target of the initialisation step."""
        self._gate_sigmas = settings.gate_sigmas
        self._features = TrackedFeatures(start)
        self.state = self._initial_state(start)

    def update(self, tracked: TrackedBearings) -> None:
        """Takes in one image; see the protocol.

        Raises:
            EstimatorError: as in the protocol, or the filter ran to infinity; it stays as it
                was before then.
        """
        step, taken = self._features.take(tracked)
        state = self.state.keeping(among(self.state.ids, self._features.alive))
        state = predicted(state, step)
        rows = taken & among(tracked.ids, state.ids)
        seen = seen_from_robot(state, tracked.bearing[rows], tracked.sigma_bearing[rows])
        try:
            state = self._update_target(updated(state, seen, self._gate_sigmas))
        except np.linalg.LinAlgError as error:
            raise EstimatorError(f"the filter failed at {tracked.time:.3f} s: {error}") from None
        if not (np.isfinite(state.mean).all() and np.isfinite(state.covariance).all()):
            raise EstimatorError(f"the filter's state ran to infinity at {tracked.time:.3f} s")
        self.state = state

    def _initial_state(self, start: HomingStart) -> FilterState:
        return initial_state(start)

    def _update_target(self, state: FilterState) -> FilterState:
        """Nothing: the target's bearings are in the initial state."""
        return state

    def estimate(self, landmarks: bool = True) -> HomingEstimate:
        """The present state; see the protocol."""
        state, n = self.state, len(self.state.ids)
        target = state.mean[TARGET]
        jacobian = np.zeros((6, FIRST))
        jacobian[:3, :3], jacobian[3:, TARGET] = np.eye(3), target_jacobian(target)
        spread = np.full((n, 2, 2), np.nan)
        if landmarks:
            by_polar, every = polar_jacobians(state.polar), np.arange(n)
            blocks = state.covariance[FEATURES, FEATURES].reshape(n, 2, n, 2)
            spread = by_polar @ blocks[every, :, every, :] @ np.swapaxes(by_polar, 1, 2)
        return HomingEstimate(
            time=self._features.time,
            robot=wrapped_pose(state.mean[:3]),
            target=wrapped_pose(target_pose(target)),
            covariance=jacobian @ state.covariance[:FIRST, :FIRST] @ jacobian.T,
            ids=state.ids,
            landmarks=polar_points(state.polar),
            landmark_covariances=spread,
        )


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
        rows = np.concatenate([np.ones(FIRST, np.bool_), np.repeat(which, 2)])
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


def initial_state(start: HomingStart) -> FilterState:
    """Mean and covariance after the initialisation step."""
    distance, variance = start.local_map.distance, start.local_map.covariance[:, 0, 0]
    kept = np.isfinite(distance) & np.isfinite(variance) & (distance > 0.0)
    kept &= variance <= (_MOST_RELATIVE_SIGMA * distance) ** 2
    return state_of(start, kept, _joint_covariance(start, kept))


def state_of(start: HomingStart, kept: BoolArray, covariance: FloatArray) -> FilterState:
    """The state of some features, given the covariance (3 + 2n) of target and features."""
    chart = start.local_map
    polar = np.column_stack([chart.distance, chart.bearing])[kept]
    vector = np.array([1.0, start.vector.direction, start.vector.rotation])
    mean = np.concatenate([np.zeros(4), vector, polar.ravel()])
    whole = np.zeros((len(mean), len(mean)))
    whole[4:, 4:] = covariance
    whole[3, 3] = INITIAL_SPEED**2
    return FilterState(chart.ids[kept], mean, 0.5 * (whole + whole.T))


def _joint_covariance(start: HomingStart, kept: BoolArray) -> FloatArray:
    """(3 + 2n,) square, of target and features as what they are: functions of the two views.

    All distances depend on the same direction and rotation of the target, and each on its own pair
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
    sigma = np.concatenate([matches.sigma[:, 0], matches.sigma[:, 2]])
    spread = np.zeros((2 + 2 * n, 2 + 2 * n))
    spread[:2, :2] = vector.covariance
    spread[2:, 2:] = np.diag(sigma**2)
    return np.asarray(root @ spread @ root.T)


# --------------------------------------------------------------------------------------------
# Motion


def motion(robot: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Next (x, y, psi, v), its derivative by the last and the noise's covariance (eqs 4, 5).

    ``robot`` is (4,), ``step`` in seconds.
    """
    x, y, psi, speed = robot.tolist()
    ahead, left = step * math.cos(psi), step * math.sin(psi)
    moved = np.array([x + speed * ahead, y + speed * left, psi, speed])
    jacobian = np.eye(4)
    jacobian[:2, 2] = -speed * left, speed * ahead
    jacobian[:2, 3] = ahead, left
    return moved, jacobian, np.diag(step * np.array([_SLIP, _SLIP, _HEADING, _SPEED]) ** 2)


def predicted(state: FilterState, step: float) -> FilterState:
    """The state ``step`` seconds later; target and features stand still."""
    moved, jacobian, spread = motion(state.mean[ROBOT], step)
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
    innovation, by_pose, jacobian = seen_from(state, state.mean[:3], measured)
    jacobian[:, :3] = by_pose
    return Measured(innovation, jacobian, sigma**2)


def seen_from(
    state: FilterState, pose: FloatArray, measured: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Innovations (n,) of bearings of all features from a pose (3,), derivatives by it (n, 3).

    And by the whole state (n, 7 + 2n), in which those by the features are filled in.
    """
    distance, along = state.polar[:, 0], unit(state.polar[:, 1])
    points = distance[:, None] * along
    by_pose, by_point = bearing_jacobians(pose, points)
    jacobian = np.zeros((len(measured), len(state.mean)))
    # Each row's derivative by its own feature, two columns farther right from row to row.
    flat, step = jacobian.reshape(-1), jacobian.shape[1] + 2
    flat[FIRST::step] = np.einsum("ni,ni->n", by_point, along)
    flat[FIRST + 1 :: step] = distance * (
        by_point[:, 1] * along[:, 0] - by_point[:, 0] * along[:, 1]
    )
    return -bearing(pose, points, measured), by_pose, jacobian


def updated(state: FilterState, seen: Measured, gate_sigmas: float) -> FilterState:
    """The extended Kalman filter's update, in Joseph's form.

    Args:
        state: mean and covariance before; the measurement's derivative is by its mean.
        seen: the measurement.
        gate_sigmas: innovations beyond so many of their own deviations are left out; 0: none.
    """
    jacobian, innovation, variance = seen.jacobian, seen.innovation, seen.variance
    finite = np.isfinite(jacobian).all(axis=1)
    if not finite.all():
        jacobian, innovation, variance = jacobian[finite], innovation[finite], variance[finite]
    crossed = state.covariance @ jacobian.T
    expected = jacobian @ crossed + np.diag(variance)
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
