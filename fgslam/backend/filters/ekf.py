"""Full stochastic mapping: one Kalman filter over the pose and all landmarks.

The costly alternative that Se, Lowe and Little (2001, 6) name and do not use; Smith, Self and
Cheeseman (1990). In the graph's terms a smoother that marginalises every past pose and never
relinearises a measurement. With F the motion's Jacobian and Q its noise, H the measurements' and R
theirs, a frame is

    x = f(x),    P = F P F^T + Q                                      (FullEkf.predict)
    S = H P H^T + R,    K = P H^T S^-1,    x + K v,    P - K S K^T    (correct)

and new landmarks are correlated with all there is through the pose. Derivation:
docs/derivations/filters.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from fgslam.backend.considered import ConsiderCovariance
from fgslam.backend.filters.filtered import FilteredTrajectory, require_finite, triangulated
from fgslam.backend.loops import within_gate
from fgslam.backend.measured import Waiting, linearised, nuisance_words, require_model
from fgslam.backend.settings import JointFilterSettings
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows, chi_square_quantile
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    adjoint,
    congruence,
    inverse,
    moved_apart,
    point_pose_jacobian,
    reorthonormalise,
    se3_exp,
    se3_log_jacobian,
    so3_log,
    transform_to_world,
)
from fgslam.core.sensors import (
    CameraRig,
    Increment,
    LoopClosure,
    Measured,
    MeasurementType,
    Observations,
    Odometry,
)
from fgslam.core.store import Kept
from fgslam.core.types import EgoMotion, Estimate, Floor, LandmarkMap, Prediction, UpdateStats
from fgslam.factors.measurement import (
    LinearRows,
    linearise,
    nuisance_covariance,
    products,
    whitening,
)

FRONT = 6
"""The pose's rows and columns come first."""
BLOCK = 3
"""Rows and columns of a landmark."""
_UNKNOWN = 100.0  # by which a pose found without a prior is less certain before its landmarks count
_ADMITTED = 0.999  # quantile of an innovation squared beyond which the covariance is contradicted
_ITERATIONS = 30
_SETTLED = 1e-5  # radians and metres: far below what any measurement resolves
_NEGATIVE = 1e-10  # of the largest variance: rounding of a pose covariance that is singular
_SLAB = 192  # rows updated at once: large enough for the product's speed, small enough for cache
_GROWTH = 1.2
_NO_MOTIONS = "covariances of motions are not known: the filter keeps the newest pose alone"


def correct(
    covariance: GrowingCovariance,
    front: FloatArray,
    matches: Matches,
    floor: PoseMeasurement,
    gate_sigmas: float,
) -> Correction:
    """One Kalman correction by all matches within the gate, and the floor, at once.

    S = H P H^T + R, K = P H^T S^-1, step K v, and P loses K S K^T (docs/derivations/filters.md).
    Only the pose's columns and those of the observed landmarks enter; with n rows of state and m
    of measurement the gain costs ``n m^2``, the covariance's update ``n^2 m``.

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
    rows = np.flatnonzero(np.repeat(kept, matches.innovation.shape[1]))
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


def _with_landmarks(
    covariance: GrowingCovariance, front: FloatArray, matches: Matches
) -> tuple[FloatArray, FloatArray]:
    """``P H^T`` (n, km) and ``H P H^T + R`` (km, km) of the matches."""
    n, (k, m) = len(front), matches.innovation.shape
    width = matches.by_landmark.shape[2]
    rows = rows_of(matches.blocks.ravel()).reshape(k, width)
    columns = covariance.columns(rows.ravel())
    columns[:FRONT] = front[rows.ravel()].T
    by_block = columns.reshape(n, k, width).swapaxes(0, 1) @ matches.by_landmark.swapaxes(1, 2)
    by_pose = matches.by_pose.reshape(-1, FRONT)
    cross = by_block.swapaxes(0, 1).reshape(n, m * k) + front @ by_pose.T
    s = by_pose @ cross[:FRONT] + (matches.by_landmark @ cross[rows]).reshape(m * k, m * k)
    s = 0.5 * (s + s.T)
    s.reshape(k, m, k, m)[np.arange(k), :, np.arange(k)] += matches.noise
    return cross, s


def _within_gate(matches: Matches, s: FloatArray, gate_sigmas: float) -> BoolArray:
    """Mask (k,) of matches whose own innovation is within the gate of its own covariance."""
    k, m = matches.innovation.shape
    if gate_sigmas == 0.0 or not k:
        return np.ones(k, np.bool_)
    own = s.reshape(k, m, k, m)[np.arange(k), :, np.arange(k)]
    roots = _root(own, "an innovation's covariance")
    whitened = np.linalg.solve(roots, matches.innovation[:, :, None])[:, :, 0]
    return np.asarray((whitened**2).sum(axis=1) <= gate_sigmas**2)


def _with_floor(
    cross: FloatArray, s: FloatArray, front: FloatArray, floor: PoseMeasurement
) -> tuple[FloatArray, FloatArray]:
    """The same with the floor's rows after the matches'."""
    if not len(floor.innovation):
        return cross, s
    joint = floor.jacobian @ cross[:FRONT]
    by_floor = front @ floor.jacobian.T
    own = floor.jacobian @ by_floor[:FRONT] + np.diag(floor.variance)
    return np.hstack([cross, by_floor]), np.block([[s, joint.T], [joint, own]])


def _root(matrices: FloatArray, what: str) -> FloatArray:
    """Cholesky's lower factors (..., n, n)."""
    try:
        root = np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        raise DivergedError(f"{what} is not positive definite") from None
    if not np.isfinite(root).all():
        raise DivergedError(f"{what} is not finite")
    return np.asarray(root)


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


def correct_iterated(
    covariance: GrowingCovariance, matches_at: Callable[[FloatArray], Matches], fixed: bool
) -> Correction:
    """One correction by all matches, linearised at its own result, for large innovations.

    The iterated Kalman filter (Bell and Cathey 1993), Gauss-Newton on state and measurement at
    once; without gate and floor.

    Args:
        covariance: of the state.
        matches_at: from a step (n,) to the matches linearised there, their innovation as of the
            state before it.
        fixed: landmarks are not to change.

    Raises:
        DivergedError: as :func:`correct`, or it does not settle.
    """
    front = covariance.front()
    step = np.zeros(len(front))
    for _ in range(_ITERATIONS):
        found = correct(covariance, front, matches_at(step), NOTHING, gate_sigmas=0.0)
        if fixed:
            found = found.of_the_pose_alone()
        change = float(np.abs(found.step - step).max())
        if change < _SETTLED:
            return found
        step = found.step
    raise DivergedError(f"the correction does not settle ({change:.2g} after {_ITERATIONS} steps)")


class FullEkf:
    """Estimator of kind ``ekf``, on :class:`fgslam.backend.protocol.Estimator`.

    The state is the current pose and the landmarks in world coordinates; the pose's error lives in
    the tangent space at the estimate, [rotation, translation].
    """

    kind: ClassVar[str] = "ekf"
    supports: ClassVar[frozenset[MeasurementType]] = frozenset(MeasurementType)
    _past: Kept[FilteredTrajectory]
    _wTc: Kept[FloatArray]
    _covariance: Kept[GrowingCovariance]
    _ids: Kept[IntArray]
    _positions: Kept[FloatArray]
    _matched: Kept[int]
    _gated: Kept[int]
    _skipped: Kept[int]
    _remarks: Kept[list[str]]
    _considered: Kept[ConsiderCovariance]
    _waiting: Kept[Waiting]
    _nuisances: Kept[list[str]]

    def __init__(
        self, sensor: CameraRig, settings: JointFilterSettings, floor: Floor, prior: Prediction
    ) -> None:
        """Starts at the prior pose, brought onto a hard floor, with an empty map."""
        self._sensor = sensor
        self._settings = settings
        self._floor = floor
        self._wTc = floor.constrain(prior.wTc) if floor.rigid_dof < 6 else prior.wTc
        self._covariance = GrowingCovariance(floor.allowed_part(self._wTc, prior.covariance))
        self._ids = np.empty(0, np.int64)
        self._positions = np.empty((0, 3))
        self._past = FilteredTrajectory()
        self._considered = ConsiderCovariance(sensor, floor)
        self._waiting = Waiting()
        self._nuisances = []  # kinds: their parameters are blocks of the identities -1, -2, ...
        self._matched = self._gated = self._skipped = 0
        self._remarks = []
        self._map: LandmarkMap | None = None
        self._fixed = False

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose after the camera moved by ``odometry``, on the floor if that is hard."""
        wTc, front = self._moved(odometry)
        return Prediction(wTc, front[:FRONT])

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Predicts, corrects by all matches at once, drops the pruned, adds the new.

        ``tracking`` is used only of a frame that was found without a prior: it is where to
        linearise, and which matches hold. A loop closure is a further correction, by the old
        landmarks that the frame sees; correlations take the map along, past poses stay. Raises
        EstimatorError where time does not increase, the map outgrows `max_landmarks`, a number is
        not finite, or the covariance loses its definiteness; the state is then as before.
        """
        if increment.relocalised:
            self._past.require_later(increment)
        else:
            self._past.require_step(increment)
        seen = increment.observations
        # What is begun and merged away in one frame is not begun at all.
        merged = seen.is_new & np.isin(seen.ids, increment.pruned_ids)
        new = seen.select(seen.is_new & ~merged & ~np.isin(seen.ids, self._ids))
        first = triangulated(self._sensor, new)
        leaving = int(np.isin(self._ids, increment.pruned_ids).sum())
        count = len(self._ids) - leaving + len(first[0])
        self._require_space(f"frame {increment.index}", count)
        require_finite(increment)
        if increment.relocalised:
            wTc, front = self._at_tracked_pose(tracking)
            seen = seen.select(np.flatnonzero(~seen.is_new)[tracking.inliers])
        else:
            wTc, front = self._moved(increment.odometry)
        found = self._correction(increment, seen, wTc, front)
        found = found.of_the_pose_alone() if self._fixed else found
        # Nothing below can fail.
        self._apply(found, wTc, front)
        self._matched += found.matched
        self._gated += found.matched - found.nis_dof // BLOCK
        left_out = len(increment.observations) - found.matched - len(first[0])
        self._skipped += left_out - int(merged.sum())
        for one in increment.measured:
            self._correct_by(one, increment.index)
        closed = tuple(self._close(increment, loop) for loop in increment.loops)
        self._drop(increment)
        self._add(first[0].ids, *first[1:])
        for one in increment.measured:
            self._begin(one, increment.index)
        self._considered.observe(increment, self._wTc)
        current = self._considered.pose(Prediction(self._wTc, self._covariance.front()[:FRONT]))
        self._past.append(increment.timestamp, current)
        return UpdateStats(
            current.wTc, current.covariance, len(self.landmarks()), found.nis, found.nis_dof, closed
        )

    # -- what may fail, before anything is changed ---------------------------------------------

    def _require_space(self, where: str, count: int) -> None:
        if count > self._settings.max_landmarks:
            size = (FRONT + BLOCK * count) ** 2 * 8 / 1e9
            raise EstimatorError(
                f"{where}: {count} landmarks exceed max_landmarks "
                f"{self._settings.max_landmarks} of the {self.kind} (their joint covariance takes "
                f"{size:.2g} GB and each update time in proportion); raise it, prune earlier, or "
                "use isam2"
            )
        try:
            self._covariance.reserve(count)
        except MemoryError:
            raise EstimatorError(
                f"{where}: no memory for the joint covariance of {count} "
                "landmarks; lower max_landmarks, prune earlier, or use isam2"
            ) from None

    def _moved(self, motion: Odometry | None) -> tuple[FloatArray, FloatArray]:
        """Predicted pose and the joint covariance's columns (n, 6) of it."""
        front = self._covariance.front()
        if motion is None:
            return self._wTc, front
        wTc, noise = self._wTc @ motion.motion, motion.covariance
        transition = adjoint(inverse(motion.motion))
        if self._floor.rigid_dof < 6:
            wTc = self._floor.constrain(wTc)
            noise = self._floor.allowed_part(wTc, noise)
            basis = self._floor.basis(wTc)
            transition = basis @ (basis.T @ transition)
        front[FRONT:] = front[FRONT:] @ transition.T
        front[:FRONT] = congruence(transition, front[:FRONT]) + 0.5 * (noise + noise.T)
        return wTc, front

    def _at_tracked_pose(self, tracking: EgoMotion) -> tuple[FloatArray, FloatArray]:
        """The pose where tracking found it, almost unknown: independent of odometry and past."""
        wTc = self._floor.constrain(tracking.wTc) if self._floor.rigid_dof < 6 else tracking.wTc
        front = np.zeros_like(self._covariance.front())
        unknown = _UNKNOWN**2 * tracking.covariance
        front[:FRONT] = self._floor.allowed_part(wTc, 0.5 * (unknown + unknown.T))
        return wTc, front

    def _correction(
        self, increment: Increment, seen: Observations, wTc: FloatArray, front: FloatArray
    ) -> Correction:
        seen = seen.select(np.isin(seen.ids, self._ids))
        blocks = self._blocks(seen.ids)
        matches = Matches.of(self._sensor, wTc, blocks, self._positions[blocks], seen)
        floor = PoseMeasurement.of_floor(self._floor, wTc)
        return self._corrected(increment.index, front, matches, floor)

    def _corrected(
        self, index: int, front: FloatArray, matches: Matches, of_pose: PoseMeasurement
    ) -> Correction:
        try:
            return correct(self._covariance, front, matches, of_pose, self._settings.gate_sigmas)
        except DivergedError as cause:
            raise EstimatorError(
                f"frame {index}: the {self.kind} has diverged: {cause}; use isam2, which "
                "relinearises, or state the odometry's and the measurements' noise larger"
            ) from None

    def _correct_by(self, one: Measured, index: int) -> None:
        """Corrects by what another sensor measured, of the pose or of known landmarks."""
        require_model(one, index)
        matches, of_pose = Matches.none(), NOTHING
        if one.of_pose:
            of_pose = PoseMeasurement.of(linearised(self._sensor, one, self._wTc), one.covariance)
        else:
            one = one.select(np.isin(one.ids, self._ids))
            blocks = self._blocks(one.ids)
            own = self._nuisance(one)
            parameters = self._positions[own[0]] if len(own) else None
            rows = linearised(self._sensor, one, self._wTc, self._positions[blocks], parameters)
            every = np.column_stack([blocks, np.broadcast_to(own, (len(one), len(own)))])
            matches = Matches.usable(rows, every, one.covariance)
        front = self._covariance.front()
        found = self._corrected(index, front, matches, of_pose)
        self._apply(found.of_the_pose_alone() if self._fixed else found, self._wTc, front)
        self._matched += found.matched
        self._gated += found.matched - found.nis_dof // one.values.shape[1]

    def _nuisance(self, one: Measured) -> IntArray:
        """(1,) block of the sensor's nuisance parameters, (0,) of a sensor without."""
        if not one.model.nuisance.size:
            return np.empty(0, np.int64)
        if one.kind not in self._nuisances:
            self._nuisances.append(one.kind)
            self._covariance.append_independent(nuisance_covariance(one.model)[None])
            self._ids = np.append(self._ids, -len(self._nuisances))
            self._positions = np.concatenate([self._positions, np.zeros((1, 3))])
        return np.flatnonzero(self._ids == -1 - self._nuisances.index(one.kind))

    def _begin(self, one: Measured, index: int) -> None:
        """Landmarks that another sensor's measurements give a place now."""
        if not one.of_pose:
            pose = Prediction(self._wTc, self._covariance.front()[:FRONT])
            own = self._nuisance(one)
            spread = self._covariance.diagonal_blocks(own)
            parameters = (self._positions[own[0]], spread[0]) if len(own) else None
            begun = self._waiting.begin(self._sensor, one, pose, self._ids, parameters)
            self._require_space(f"frame {index}", len(self._ids) + len(begun.ids))
            self._add(begun.ids, begun.points, begun.covariances)
            self._correct_by(begun.later, index)

    def _close(self, increment: Increment, loop: LoopClosure) -> bool:
        """Corrects by the old landmarks seen again; refused where the covariance rules it out."""
        what = f"frame {increment.index}: loop closure to frame {loop.frame} of the log"
        seen = loop.observations.select(np.isin(loop.observations.ids, self._ids))
        if not len(seen):
            self._remarks.append(f"{what} left out: none of its landmarks is held any more")
            return False
        blocks = self._blocks(seen.ids)

        def matches_at(step: FloatArray) -> Matches:
            there, positions = self._retracted(self._wTc, self._positions, step)
            found = Matches.of(self._sensor, there, blocks, positions[blocks], seen)
            found = self._by_errors_before(found, step, there, positions)
            moved = step[FRONT:].reshape(-1, 3)[found.blocks]
            since = found.by_pose @ step[:FRONT]
            since += np.einsum("kij,kj->ki", found.by_landmark, moved)
            return replace(found, innovation=found.innovation + since)

        try:
            found = correct_iterated(self._covariance, matches_at, self._fixed)
        except DivergedError as cause:
            self._remarks.append(f"{what} left out: {cause}")
            return False
        squared = f"(innovation squared {found.nis:.0f}, {found.nis_dof} expected)"
        if not within_gate(found.nis - found.nis_dof):
            self._remarks.append(f"{what} refused: the covariance does not admit it {squared}")
            return False
        admitted = found.nis <= chi_square_quantile(_ADMITTED, found.nis_dof)
        though = "" if admitted else ", though the covariance does not admit it"
        self._remarks.append(f"{what} taken{though} {squared}")
        self._apply(found, self._wTc, self._covariance.front())
        return True

    # -- the change itself ---------------------------------------------------------------------

    def _apply(self, found: Correction, wTc: FloatArray, front: FloatArray) -> None:
        self._covariance.set_front(front)
        if found.gain.shape[1]:
            self._covariance.subtract(found.gain, found.half)
            moved, positions = self._retracted(wTc, self._positions, found.step)
            self._carry_errors(wTc, moved, positions)
            wTc, self._positions = moved, positions
        self._wTc = reorthonormalise(wTc)
        self._map = None

    def _retracted(
        self, wTc: FloatArray, positions: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Pose and landmarks moved by a step (n,), the pose staying on a hard floor."""
        positions = positions + step[FRONT:].reshape(-1, 3)
        if self._floor.rigid_dof == 6:
            return wTc @ se3_exp(step[:FRONT]), positions
        return self._floor.constrain(moved_apart(wTc, step[:FRONT])), positions

    def _carry_errors(self, wTc: FloatArray, moved: FloatArray, positions: FloatArray) -> None:
        """The covariance in the errors of the state moved to; a hard floor turns the pose's."""
        if self._floor.rigid_dof < 6:
            carry = self._floor.basis(moved) @ self._floor.basis(wTc).T
            front = self._covariance.front()
            front[FRONT:] = front[FRONT:] @ carry.T
            front[:FRONT] = congruence(carry, front[:FRONT])
            self._covariance.set_front(front)

    def _by_errors_before(
        self, matches: Matches, step: FloatArray, moved: FloatArray, positions: FloatArray
    ) -> Matches:
        """Matches linearised where a step (n,) leads, by the step."""
        return matches

    def _drop(self, increment: Increment) -> None:
        gone = np.flatnonzero(np.isin(self._ids, increment.pruned_ids))
        if len(gone):
            remaining = self._covariance.drop(gone)
            self._ids, self._positions = self._ids[remaining], self._positions[remaining]

    def _add(self, ids: IntArray, points: FloatArray, covariances: FloatArray) -> None:
        """New landmarks, correlated with all there is through the pose they were seen from."""
        if not len(points):
            return
        by_pose = -self._wTc[:3, :3] @ point_pose_jacobian(points)
        flat = by_pose.reshape(-1, FRONT)
        front = self._covariance.front()
        square = congruence(flat, front[:FRONT])
        own = congruence(self._wTc[:3, :3], covariances)
        at = BLOCK * np.arange(len(own))[:, None] + np.arange(BLOCK)
        square[at[:, :, None], at[:, None, :]] += own
        self._covariance.append(front @ flat.T, square)
        self._ids = np.concatenate([self._ids, ids])
        positions = transform_to_world(self._wTc, points)
        self._positions = np.concatenate([self._positions, positions])

    def _blocks(self, ids: IntArray) -> IntArray:
        """Block of each landmark. KeyError for an unknown one."""
        order = np.argsort(self._ids, kind="stable")
        known = LandmarkMap(self._ids[order], self._positions, np.empty(0))
        return order[known.rows(ids)]

    # -- what is reported, and a saved map -----------------------------------------------------

    def landmarks(self) -> LandmarkMap:
        """Landmarks with their marginal covariances."""
        if self._map is None:
            order = np.argsort(self._ids, kind="stable")[len(self._nuisances) :]
            covariances = self._covariance.diagonal_blocks(order)
            self._map = LandmarkMap(self._ids[order], self._positions[order], covariances)
        return self._map

    def estimate(self) -> Estimate:
        """Trajectory as filtered, and the map."""
        remarks = [_NO_MOTIONS]
        for number, kind in enumerate(self._nuisances, 1):
            (block,) = at = np.flatnonzero(self._ids == -number)
            spread = np.diagonal(self._covariance.diagonal_blocks(at)[0])
            remarks.append(nuisance_words(kind, self._positions[block], spread))
        if self._gated:
            remarks.append(
                f"{self._gated} of {self._matched} matches left out: innovation beyond "
                f"{self._settings.gate_sigmas:g} standard deviations"
            )
        if self._skipped:
            remarks.append(
                f"{self._skipped} observations left out: landmark unknown, at infinity or behind"
            )
        return Estimate(
            self._past.trajectory(),
            self._past.pose_covariances(),
            self._considered.landmarks(self.landmarks()),
            (*remarks, *self._remarks),
            noise_factor=1.0,
        )

    @property
    def keeps_maps(self) -> bool:
        """True: as in Schmidt's filter, landmarks may be uncertain and yet not be changed."""
        return True

    def begin_in(self, landmarks: LandmarkMap, hits: IntArray, fixed: bool) -> None:
        """Takes a saved map over. Raises EstimatorError beyond `max_landmarks`."""
        self._require_space("the saved map", len(landmarks))
        self._covariance.append_independent(landmarks.covariances)
        self._ids, self._positions = landmarks.ids, landmarks.positions
        self._fixed = fixed
        if fixed:
            self._considered.hold_map()
        self._map = None

    def remake(self) -> None:
        """Rebuilds the map from what was put back."""
        self._map = None


# ------------------------------------------------------------------------------------------
# What a correction is made of


@dataclass(frozen=True, slots=True, eq=False)
class Matches(Rows):
    """Observations of known landmarks, linearised at a pose.

    Attributes:
        blocks: (k, b) landmark blocks of the covariance, or (k,); of nuisance parameters, too.
        innovation: (k, m) measured less expected.
        by_pose: (k, m, 6) d(measurement)/d(tangent of the pose).
        by_landmark: (k, m, 3b) d(measurement)/d(position in the world), parameters behind.
        noise: (k, m, m) covariance of the measurement.
    """

    blocks: IntArray
    innovation: FloatArray
    by_pose: FloatArray
    by_landmark: FloatArray
    noise: FloatArray

    @staticmethod
    def none() -> Matches:
        """No match."""
        none = np.empty(0, np.int64)
        return Matches(none, np.empty((0, 1)), *(np.empty((0, 1, n)) for n in (6, 3, 1)))

    @staticmethod
    def of(
        sensor: CameraRig,
        wTc: FloatArray,
        blocks: IntArray,
        positions: FloatArray,
        observed: Observations,
    ) -> Matches:
        """Linearises at the landmarks' positions (k, 3); those not before the sensor drop out."""
        rows = linearise(sensor, wTc, positions, observed.measurement)
        return Matches.usable(rows, blocks, observed.covariance)

    @staticmethod
    def usable(rows: LinearRows, blocks: IntArray, noise: FloatArray) -> Matches:
        """Of measurements linearised at a pose (k,), those that can be predicted."""
        matches = Matches(blocks, -rows.residual, rows.by_pose, rows.by_point, noise)
        return matches.select(rows.usable)


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """What is measured of the pose alone, linearised at it.

    Attributes:
        innovation: (m,) measured less expected.
        jacobian: (m, 6) by the tangent of the pose.
        variance: (m,) of it.
    """

    innovation: FloatArray
    jacobian: FloatArray
    variance: FloatArray

    @staticmethod
    def of(rows: LinearRows, noise: FloatArray) -> PoseMeasurement:
        """Of measurements of a pose with covariances (k, m, m)."""
        roots = whitening(noise)
        by_pose = (roots @ rows.by_pose).reshape(-1, FRONT)
        innovation = -products(roots, rows.residual).ravel()
        return PoseMeasurement(innovation, by_pose, np.ones(len(innovation)))

    @staticmethod
    def of_floor(floor: Floor, wTc: FloatArray) -> PoseMeasurement:
        """A soft floor at a predicted pose: zero up to the floor's deviations.

        Height along the vertical, and for 3 degrees of freedom the tilt about the nearest upright
        rotation, as the graphs' floor factors have it.
        """
        if floor.hard or floor.dof == 6:
            return NOTHING
        height, by_height = floor.down @ wTc[:3, 3], np.zeros((1, 6))
        by_height[0, 3:] = floor.down @ wTc[:3, :3]
        variance = np.array([floor.height_sigma_m**2])
        if floor.dof == 5:
            return PoseMeasurement(np.array([-height]), by_height, variance)
        upright = floor.constrain(wTc)[:3, :3]
        turned = np.zeros(6)
        turned[:3] = so3_log(upright.T @ wTc[:3, :3])
        axes = floor.horizontal.T @ upright
        by_tilt = np.zeros((2, 6))
        by_tilt[:, :3] = axes @ se3_log_jacobian(turned)[:3, :3]
        return PoseMeasurement(
            np.array([-height, *(-axes @ turned[:3])]),
            np.concatenate([by_height, by_tilt]),
            np.array([*variance, *[floor.tilt_sigma_rad**2] * 2]),
        )


NOTHING = PoseMeasurement(np.empty(0), np.empty((0, FRONT)), np.empty(0))


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


# ------------------------------------------------------------------------------------------
# The joint covariance


class GrowingCovariance:
    """Joint covariance (n, n), n = 6 + 3 landmarks, which are blocks numbered from 0.

    Only the lower triangle is kept, so the matrix is symmetric by construction, an update costs
    half of a full product, and a landmark comes or goes by touching its own rows and columns alone.
    """

    def __init__(self, front: FloatArray) -> None:
        """Starts with the pose's block (6, 6) alone."""
        self._buffer = np.zeros((FRONT, FRONT))
        self._size = 0
        self.reserve(20)
        self._size = FRONT
        self._buffer[:FRONT, :FRONT] = front

    @property
    def blocks(self) -> int:
        """Number of landmarks."""
        return (self._size - FRONT) // BLOCK

    def reserve(self, blocks: int) -> None:
        """Makes room for so many landmarks, and some more; may raise MemoryError."""
        needed = FRONT + BLOCK * blocks
        if needed <= len(self._buffer):
            return
        n, room = self._size, int(_GROWTH * needed)
        # Never read above the diagonal, yet a slab's update takes it along: memory as it comes may
        # hold signalling NaNs.
        larger = np.zeros((room, room))
        larger[:n, :n] = self._buffer[:n, :n]
        self._buffer = larger
        self._scratch = np.empty(_SLAB * room)

    def front(self) -> FloatArray:
        """(n, 6) the pose's columns."""
        out = self._buffer[: self._size, :FRONT].copy()
        out[:FRONT] = _mirrored(out[:FRONT])
        return out

    def columns(self, index: IntArray) -> FloatArray:
        """(n, k) the columns of these rows."""
        n = self._size
        below, above = self._buffer[:n].take(index, axis=1), self._buffer[index, :n].T
        return np.where(np.arange(n)[:, None] >= index, below, above)

    def diagonal_blocks(self, blocks: IntArray) -> FloatArray:
        """(k, 3, 3) the landmarks' own covariances."""
        at = rows_of(blocks)
        return _mirrored(self._buffer[at[:, :, None], at[:, None, :]])

    def set_front(self, front: FloatArray) -> None:
        """Replaces the pose's columns (n, 6), and so its rows."""
        self._buffer[: self._size, :FRONT] = front

    def subtract(self, a: FloatArray, b: FloatArray) -> None:
        """Takes ``a b^T + b a^T`` off, of (n, m) each: BLAS's syr2k, slab by slab."""
        left, right = np.hstack([a, b]), np.hstack([b, a])
        for start in range(0, self._size, _SLAB):
            stop = min(start + _SLAB, self._size)
            product = self._scratch[: (stop - start) * stop].reshape(stop - start, stop)
            np.matmul(left[start:stop], right[:stop].T, out=product)
            self._buffer[start:stop, :stop] -= product

    def append(self, cross: FloatArray, square: FloatArray) -> None:
        """Adds landmarks: covariances with all so far (n, k) and with each other (k, k)."""
        n, k = self._size, len(square)
        self.reserve((n + k - FRONT) // BLOCK)
        self._buffer[n : n + k, :n] = cross.T
        self._buffer[n : n + k, n : n + k] = square
        self._size = n + k

    def append_independent(self, blocks: FloatArray) -> None:
        """Adds landmarks (k, 3, 3) that are correlated with nothing."""
        n, k = self._size, BLOCK * len(blocks)
        self.reserve((n + k - FRONT) // BLOCK)
        self._buffer[n : n + k, : n + k] = 0.0
        at = n + BLOCK * np.arange(len(blocks))[:, None] + np.arange(BLOCK)
        self._buffer[at[:, :, None], at[:, None, :]] = blocks
        self._size = n + k

    def drop(self, blocks: IntArray) -> IntArray:
        """Removes landmarks; the last ones move into their places.

        Returns:
            (m,) for each remaining block, the number that it had before.
        """
        number = np.arange(self.blocks)
        for hole in sorted(blocks.tolist(), reverse=True):
            self._size -= BLOCK
            number[hole] = number[self.blocks]
            self._move(self._size, FRONT + BLOCK * hole)
        return number[: self.blocks]

    def _move(self, old: int, new: int) -> None:
        """Copies the last block, at row ``old``, over the one at row ``new``."""
        if old == new:
            return
        matrix, end = self._buffer, new + BLOCK
        source = matrix[old : old + BLOCK]
        matrix[new:end, :new] = source[:, :new]
        matrix[new:end, new:end] = source[:, old : old + BLOCK]
        matrix[end:old, new:end] = source[:, end:old].T

    def packed(self) -> FloatArray:
        """The lower triangle, row after row."""
        return np.concatenate([self._buffer[i, : i + 1] for i in range(self._size)])

    @staticmethod
    def unpacked(packed: FloatArray) -> GrowingCovariance:
        """Back from :meth:`packed`."""
        size = (int(np.sqrt(8 * len(packed) + 1)) - 1) // 2
        out = GrowingCovariance(np.zeros((FRONT, FRONT)))
        out.reserve((size - FRONT) // BLOCK)
        out._size = size
        ends = np.cumsum(np.arange(1, size + 1))
        for i, end in enumerate(ends.tolist()):
            out._buffer[i, : i + 1] = packed[end - i - 1 : end]
        return out


def rows_of(blocks: IntArray) -> IntArray:
    """(k, 3) rows of landmark blocks (k,)."""
    return np.asarray(FRONT + BLOCK * np.asarray(blocks)[:, None] + np.arange(BLOCK))


def _mirrored(lower: FloatArray) -> FloatArray:
    """Square matrices (..., k, k) of which the lower triangles count."""
    strict = np.tril(lower, -1)
    return np.asarray(np.tril(lower) + np.swapaxes(strict, -1, -2))
