"""The algebra of one correction of the full filter: computed and judged before it is applied.

Only the pose's columns and those of the observed landmarks enter; with n rows of state and m of
measurement the gain costs ``n m^2``, the covariance's update ``n^2 m``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from fgslam.backend.filters.growing_covariance import FRONT, GrowingCovariance, rows_of
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    in_front,
    point_pose_jacobian,
    project,
    projection_jacobian,
    se3_log_jacobian,
    so3_log,
    transform_to_camera,
)
from fgslam.core.measurements import Observations
from fgslam.core.sensors import CameraRig

_ITERATIONS = 30
_SETTLED = 1e-5  # radians and metres: far below what any measurement resolves
_NEGATIVE = 1e-10  # of the largest variance: rounding of a pose covariance that is singular


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Observations of known landmarks, linearised at a pose.

    Attributes:
        blocks: (k,) landmark blocks of the covariance.
        innovation: (k, 3) measured less expected.
        by_pose: (k, 3, 6) d(measurement)/d(tangent of the pose).
        by_landmark: (k, 3, 3) d(measurement)/d(position in the world).
        noise: (k, 3, 3) covariance of the measurement.
    """

    blocks: IntArray
    innovation: FloatArray
    by_pose: FloatArray
    by_landmark: FloatArray
    noise: FloatArray

    def __len__(self) -> int:
        return len(self.blocks)

    @staticmethod
    def of(
        sensor: CameraRig,
        wTc: FloatArray,
        blocks: IntArray,
        positions: FloatArray,
        observed: Observations,
    ) -> Matches:
        """Linearises at the landmarks' positions (k, 3); those not before the sensor drop out."""
        points = transform_to_camera(wTc, positions)
        usable = in_front(points)
        points, observed = points[usable], observed.select(usable)
        jacobian = projection_jacobian(sensor, points)
        return Matches(
            blocks[usable],
            observed.measurement - project(sensor, points),
            jacobian @ point_pose_jacobian(points),
            jacobian @ wTc[:3, :3].T,
            observed.covariance,
        )


@dataclass(frozen=True, slots=True, eq=False)
class FloorMeasurement:
    """A soft floor as a measurement of the pose, which is zero up to the floor's deviations.

    Height along the vertical, and for 3 degrees of freedom the tilt about the nearest upright
    rotation, as the graphs' floor factors have it.

    Attributes:
        innovation: (m,) metres, radians; m is 0 without a soft floor, else 1 or 3.
        jacobian: (m, 6) by the tangent of the pose.
        variance: (m,) of it.
    """

    innovation: FloatArray
    jacobian: FloatArray
    variance: FloatArray

    @staticmethod
    def of(floor: Floor, wTc: FloatArray) -> FloorMeasurement:
        """At a predicted pose."""
        if floor.hard or floor.dof == 6:
            return FloorMeasurement(np.empty(0), np.empty((0, 6)), np.empty(0))
        height, by_height = floor.down @ wTc[:3, 3], np.zeros((1, 6))
        by_height[0, 3:] = floor.down @ wTc[:3, :3]
        variance = np.array([floor.height_sigma_m**2])
        if floor.dof == 5:
            return FloorMeasurement(np.array([-height]), by_height, variance)
        upright = floor.constrain(wTc)[:3, :3]
        turned = np.zeros(6)
        turned[:3] = so3_log(upright.T @ wTc[:3, :3])
        axes = floor.horizontal.T @ upright
        by_tilt = np.zeros((2, 6))
        by_tilt[:, :3] = axes @ se3_log_jacobian(turned)[:3, :3]
        return FloorMeasurement(
            np.array([-height, *(-axes @ turned[:3])]),
            np.concatenate([by_height, by_tilt]),
            np.array([*variance, *[floor.tilt_sigma_rad**2] * 2]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What a frame's measurements do to the state.

    Attributes:
        step: (n,) change of the state, the pose's in its tangent space.
        gain: (n, m) Kalman gain K.
        half: (n, m) ``P H^T - K S / 2``: the covariance loses ``K half^T + half K^T``, which is
            Joseph's form for any K.
        nis, nis_dof: innovation squared of the matches that passed the gate.
        matched: matches before the gate.
    """

    step: FloatArray
    gain: FloatArray
    half: FloatArray
    nis: float
    nis_dof: int
    matched: int

    def of_the_pose_alone(self) -> Correction:
        """The same for landmarks that are not to change (Schmidt's filter).

        With the landmarks' rows of K zero, ``K S`` keeps the pose's rows alone. Since K is that of
        the least variance, ``K S = P H^T`` and ``half = P H^T / 2``: the landmarks' rows of the new
        half are the whole ``P H^T``. Their uncertainty still counts, and so does what the pose has
        in common with it.
        """
        step, gain, half = self.step.copy(), self.gain.copy(), self.half.copy()
        step[FRONT:], gain[FRONT:] = 0.0, 0.0
        half[FRONT:] *= 2.0
        return replace(self, step=step, gain=gain, half=half)


class DivergedError(Exception):
    """A matrix that is no covariance any more, named; the filter makes an EstimatorError of it."""


def correct(
    covariance: GrowingCovariance,
    front: FloatArray,
    matches: Matches,
    floor: FloorMeasurement,
    gate_sigmas: float,
) -> Correction:
    """One Kalman correction by all matches within the gate, and the floor, at once.

    S = H P H^T + R, K = P H^T S^-1, step K v, and P loses K S K^T (docs/derivations/ekf.md).

    Args:
        covariance: of the state before the frame.
        front: (n, 6) the predicted pose's columns, which replace those in ``covariance``.
        matches: linearised at the predicted state.
        floor: linearised there, too.
        gate_sigmas: largest Mahalanobis distance of a match's own innovation; 0: any.

    Raises:
        DivergedError: the state's covariance is, or would become, not finite or not definite.
    """
    cross, innovation_covariance = _with_landmarks(covariance, front, matches)
    kept = _within_gate(matches, innovation_covariance, gate_sigmas)
    rows = np.flatnonzero(np.repeat(kept, 3))
    cross, s = cross[:, rows], innovation_covariance[np.ix_(rows, rows)]
    innovation = np.concatenate([matches.innovation[kept].ravel(), floor.innovation])
    cross, s = _with_floor(cross, s, front, floor)
    root = _root(s, "an innovation's covariance")
    gain = cho_solve((root, True), cross.T, check_finite=False).T
    step = gain @ innovation
    half = cross - 0.5 * (gain @ s)
    _require_definite(covariance, front, gain, half)
    count = len(rows)
    whitened = solve_triangular(
        root[:count, :count], innovation[:count], lower=True, check_finite=False
    )
    nis = float(whitened @ whitened) if count else float("nan")
    return Correction(step, gain, half, nis, count, len(matches))


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Known landmarks as one frame measures them, and how a step moves the pose.

    Attributes:
        sensor: that measured.
        blocks: (k,) landmark blocks of the covariance.
        positions: (k, 3) of the landmarks, before the correction.
        observed: their measurements.
        retract: from a pose and a step (6,) to the pose moved by it.
        fixed: landmarks are not to change.
    """

    sensor: CameraRig
    blocks: IntArray
    positions: FloatArray
    observed: Observations
    retract: Callable[[FloatArray, FloatArray], FloatArray]
    fixed: bool

    def matches(self, wTc: FloatArray, step: FloatArray) -> Matches:
        """Linearised where ``step`` (n,) leads, the innovation as of the state before it."""
        moved = step[FRONT:].reshape(-1, 3)[self.blocks]
        there = self.retract(wTc, step[:FRONT])
        found = Matches.of(
            self.sensor, there, np.arange(len(moved)), self.positions + moved, self.observed
        )
        since = found.by_pose @ step[:FRONT]
        since += np.einsum("kij,kj->ki", found.by_landmark, moved[found.blocks])
        blocks = self.blocks[found.blocks]
        return replace(found, blocks=blocks, innovation=found.innovation + since)


def correct_anew(
    covariance: GrowingCovariance, wTc: FloatArray, sightings: Sightings
) -> Correction:
    """One correction by all sightings, linearised at its own result, for large innovations.

    The iterated Kalman filter (Bell and Cathey 1993), Gauss-Newton on state and measurement at
    once; without gate and floor.

    Raises:
        DivergedError: as :func:`correct`, or it does not settle.
    """
    front = covariance.front()
    step = np.zeros(len(front))
    nowhere = FloorMeasurement(np.empty(0), np.empty((0, FRONT)), np.empty(0))
    for _ in range(_ITERATIONS):
        found = correct(covariance, front, sightings.matches(wTc, step), nowhere, gate_sigmas=0.0)
        if sightings.fixed:
            found = found.of_the_pose_alone()
        change = float(np.abs(found.step - step).max())
        if change < _SETTLED:
            return found
        step = found.step
    raise DivergedError(f"the correction does not settle ({change:.2g} after {_ITERATIONS} steps)")


def _with_landmarks(
    covariance: GrowingCovariance, front: FloatArray, matches: Matches
) -> tuple[FloatArray, FloatArray]:
    """``P H^T`` (n, 3k) and ``H P H^T + R`` (3k, 3k) of the matches."""
    n, k = len(front), len(matches)
    rows = rows_of(matches.blocks)
    columns = covariance.columns(rows.ravel())
    columns[:FRONT] = front[rows.ravel()].T
    by_block = columns.reshape(n, k, 3).swapaxes(0, 1) @ matches.by_landmark.swapaxes(1, 2)
    by_pose = matches.by_pose.reshape(-1, FRONT)
    cross = by_block.swapaxes(0, 1).reshape(n, 3 * k) + front @ by_pose.T
    s = by_pose @ cross[:FRONT] + (matches.by_landmark @ cross[rows]).reshape(3 * k, 3 * k)
    s = 0.5 * (s + s.T)
    s.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k)] += matches.noise
    return cross, s


def _within_gate(matches: Matches, s: FloatArray, gate_sigmas: float) -> BoolArray:
    """Mask (k,) of matches whose own innovation is within the gate of its own covariance."""
    k = len(matches)
    if gate_sigmas == 0.0 or not k:
        return np.ones(k, np.bool_)
    own = s.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k)]
    roots = _root(own, "an innovation's covariance")
    whitened = np.linalg.solve(roots, matches.innovation[:, :, None])[:, :, 0]
    return np.asarray((whitened**2).sum(axis=1) <= gate_sigmas**2)


def _with_floor(
    cross: FloatArray, s: FloatArray, front: FloatArray, floor: FloorMeasurement
) -> tuple[FloatArray, FloatArray]:
    """The same with the floor's rows after the matches'."""
    if not len(floor.innovation):
        return cross, s
    joint = floor.jacobian @ cross[:FRONT]
    by_floor = front @ floor.jacobian.T
    own = floor.jacobian @ by_floor[:FRONT] + np.diag(floor.variance)
    return np.hstack([cross, by_floor]), np.block([[s, joint.T], [joint, own]])


def _require_definite(
    covariance: GrowingCovariance, front: FloatArray, gain: FloatArray, half: FloatArray
) -> None:
    """Raises DivergedError where the pose's block, or a landmark's, would not be a covariance."""
    pose = front[:FRONT] - gain[:FRONT] @ half[:FRONT].T - half[:FRONT] @ gain[:FRONT].T
    if not np.isfinite(pose).all():
        raise DivergedError("the pose's covariance is not finite")
    variances = np.linalg.eigvalsh(pose)
    if variances[0] < -_NEGATIVE * max(variances[-1], 1e-300):
        raise DivergedError("the pose's covariance is not positive")
    count, m = (len(gain) - FRONT) // 3, gain.shape[1]
    lost = gain[FRONT:].reshape(count, 3, m) @ half[FRONT:].reshape(count, 3, m).swapaxes(1, 2)
    before = covariance.diagonal_blocks(np.arange(count))
    _root(before - lost - lost.swapaxes(1, 2), "a landmark's covariance")


def _root(matrices: FloatArray, what: str) -> FloatArray:
    """Cholesky's lower factors (..., n, n)."""
    try:
        root = np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        raise DivergedError(f"{what} is not positive definite") from None
    if not np.isfinite(root).all():
        raise DivergedError(f"{what} is not finite")
    return np.asarray(root)
