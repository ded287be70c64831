"""Full stochastic mapping: one Kalman filter over the pose and all landmarks.

The costly alternative that Se, Lowe and Little (2001, 6) name and set aside; Smith, Self and
Cheeseman (1990). In the graph's terms a smoother that marginalises every past pose and never
linearises a measurement anew. Derivation: docs/derivations/ekf.md.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fgslam.backend.filters.ekf_update import (
    Correction,
    DivergedError,
    FloorMeasurement,
    Matches,
    Sightings,
    correct,
    correct_anew,
)
from fgslam.backend.filters.filtered import FilteredTrajectory, FirstSights, require_finite
from fgslam.backend.filters.growing_covariance import BLOCK, FRONT, GrowingCovariance, rows_of
from fgslam.backend.filters.loop_correction import within_gate
from fgslam.backend.filters.online_doubt import OnlineDoubt
from fgslam.backend.settings import EkfSettings
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import EgoMotion, Estimate, LandmarkMap, Prediction, UpdateStats
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    adjoint,
    congruence,
    inverse,
    moved_apart,
    point_pose_jacobian,
    reorthonormalise,
    se3_exp,
    transform_to_world,
)
from fgslam.core.measurements import Increment, LoopClosure, MeasurementType, Observations, Odometry
from fgslam.core.quantiles import chi_square_quantile
from fgslam.core.sensors import CameraRig
from fgslam.core.store import Kept

_UNKNOWN = 100.0  # by which a pose found without a prior is less certain before its landmarks count
_ADMITTED = 0.999  # quantile of an innovation squared beyond which the covariance is contradicted


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
    _doubt: Kept[OnlineDoubt]

    def __init__(
        self, sensor: CameraRig, settings: EkfSettings, floor: Floor, prior: Prediction
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
        self._doubt = OnlineDoubt(sensor, floor)
        self._matched = self._gated = self._skipped = 0
        self._remarks = []
        self._map: LandmarkMap | None = None
        self._fixed = False

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
            self._doubt.hold_map()
        self._map = None

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose after the camera moved by ``odometry``, on the floor if that is hard."""
        wTc, front = self._moved(odometry)
        return Prediction(wTc, front[:FRONT])

    def landmarks(self) -> LandmarkMap:
        """Landmarks with their marginal covariances."""
        if self._map is None:
            order = np.argsort(self._ids, kind="stable")
            covariances = self._covariance.diagonal_blocks(order)
            self._map = LandmarkMap(self._ids[order], self._positions[order], covariances)
        return self._map

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Predicts, corrects by all matches at once, drops the pruned, adds the new.

        ``tracking`` is used only of a frame that was found without a prior: it says where to
        linearise, and which matches hold. A loop closure is a further correction, by the old
        landmarks that the frame sees; correlations take the map along, past poses stay. Raises
        EstimatorError where time does not increase, the map outgrows `max_landmarks`, a number is
        not finite, or the covariance loses its definiteness; the state is then as before.
        """
        if increment.relocalised:
            self._past.require_later(increment)
        else:
            self._past.require_step(increment)
        first = self._first_sights(increment)
        self._require_room(increment, len(first.points))
        require_finite(increment)
        seen = increment.observations
        if increment.relocalised:
            wTc, front = self._at_tracked_pose(tracking)
            seen = seen.select(np.flatnonzero(~seen.is_new)[tracking.inliers])
        else:
            wTc, front = self._moved(increment.odometry)
        found = self._correction(increment, seen, wTc, front)
        found = found.of_the_pose_alone() if self._fixed else found
        # Nothing below can fail.
        self._take_over(found, wTc, front)
        used = found.matched + len(first.points)
        every = increment.observations
        merged = every.is_new & np.isin(every.ids, increment.pruned_ids)
        self._skipped += len(every) - used - int(merged.sum())
        closed = tuple(self._close(increment, loop) for loop in increment.loops)
        self._drop(increment)
        self._add(first)
        self._doubt.observe(increment, self._wTc)
        current = self._doubt.pose(Prediction(self._wTc, self._covariance.front()[:FRONT]))
        self._past.append(increment.timestamp, current)
        return UpdateStats(
            current.wTc, current.covariance, len(self._ids), found.nis, found.nis_dof, closed
        )

    def estimate(self) -> Estimate:
        """Trajectory as filtered, and the map."""
        remarks = []
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
            self._doubt.landmarks(self.landmarks()),
            (*remarks, *self._remarks),
            noise_factor=1.0,
        )

    def landmark_covariances(self, ids: IntArray) -> FloatArray:
        """Marginal covariances (k, 3, 3) of the named landmarks."""
        held = self.landmarks()
        return self._doubt.landmarks(held.select(held.rows(ids))).covariances

    def joint_covariance(self, ids: IntArray) -> FloatArray:
        """Joint covariance of the last pose and the named landmarks, and the rig's doubt."""
        rows = rows_of(self._blocks(ids)).ravel()
        return self._doubt.joint(ids, self._covariance.square(np.r_[:FRONT, rows]))

    def remake(self) -> None:
        """The map is made anew of what was put back."""
        self._map = None

    # -- what may fail, before anything is changed ---------------------------------------------

    def _first_sights(self, increment: Increment) -> FirstSights:
        seen = increment.observations
        # What is begun and merged away in one frame, as in older logs, is not begun at all.
        known = np.concatenate([self._ids, increment.pruned_ids])
        new = seen.is_new & ~np.isin(seen.ids, known)
        return FirstSights.of(self._sensor, increment.observations.select(new))

    def _require_room(self, increment: Increment, new: int) -> None:
        leaving = int(np.isin(self._ids, increment.pruned_ids).sum())
        self._require_space(f"frame {increment.index}", len(self._ids) - leaving + new)

    def _require_space(self, where: str, count: int) -> None:
        if count > self._settings.max_landmarks:
            size = (FRONT + BLOCK * count) ** 2 * 8 / 1e9
            raise EstimatorError(
                f"{where}: {count} landmarks exceed max_landmarks "
                f"{self._settings.max_landmarks} of the ekf (their joint covariance takes "
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
        floor = FloorMeasurement.of(self._floor, wTc)
        try:
            return correct(self._covariance, front, matches, floor, self._settings.gate_sigmas)
        except DivergedError as cause:
            raise EstimatorError(
                f"frame {increment.index}: the ekf has diverged: {cause}; use isam2, which "
                "linearises anew, or state the odometry's and the measurements' noise larger"
            ) from None

    def _close(self, increment: Increment, loop: LoopClosure) -> bool:
        """Corrects by the old landmarks seen again; refused where the covariance rules it out."""
        what = f"frame {increment.index}: loop closure to frame {loop.frame} of the log"
        seen = loop.observations.select(np.isin(loop.observations.ids, self._ids))
        if not len(seen):
            self._remarks.append(f"{what} left out: none of its landmarks is held any more")
            return False
        blocks, at = self._blocks(seen.ids), self._positions
        again = Sightings(self._sensor, blocks, at[blocks], seen, self._retracted, self._fixed)
        try:
            found = correct_anew(self._covariance, self._wTc, again)
        except DivergedError as cause:
            self._remarks.append(f"{what} left out: {cause}")
            return False
        said = f"(innovation squared {found.nis:.0f}, {found.nis_dof} expected)"
        if not within_gate(found.nis - found.nis_dof):
            self._remarks.append(f"{what} refused: the covariance does not admit it {said}")
            return False
        admitted = found.nis <= chi_square_quantile(_ADMITTED, found.nis_dof)
        though = "" if admitted else ", though the covariance does not admit it"
        self._remarks.append(f"{what} taken{though} {said}")
        self._apply(found, self._wTc, self._covariance.front())
        return True

    # -- the change itself ---------------------------------------------------------------------

    def _take_over(self, found: Correction, wTc: FloatArray, front: FloatArray) -> None:
        self._apply(found, wTc, front)
        self._matched += found.matched
        self._gated += found.matched - found.nis_dof // BLOCK

    def _apply(self, found: Correction, wTc: FloatArray, front: FloatArray) -> None:
        self._covariance.set_front(front)
        if found.gain.shape[1]:
            self._covariance.subtract(found.gain, found.half)
            self._positions = self._positions + found.step[FRONT:].reshape(-1, 3)
            wTc = self._retract(wTc, found.step[:FRONT])
        self._wTc = reorthonormalise(wTc)
        self._map = None

    def _retract(self, wTc: FloatArray, step: FloatArray) -> FloatArray:
        """The corrected pose; on a hard floor its errors are carried into the new pose's axes."""
        moved = self._retracted(wTc, step)
        if self._floor.rigid_dof == 6:
            return moved
        carry = self._floor.basis(moved) @ self._floor.basis(wTc).T
        front = self._covariance.front()
        front[FRONT:] = front[FRONT:] @ carry.T
        front[:FRONT] = congruence(carry, front[:FRONT])
        self._covariance.set_front(front)
        return moved

    def _retracted(self, wTc: FloatArray, step: FloatArray) -> FloatArray:
        """The pose moved by a step (6,), on a hard floor."""
        if self._floor.rigid_dof == 6:
            return wTc @ se3_exp(step)
        return self._floor.constrain(moved_apart(wTc, step))

    def _drop(self, increment: Increment) -> None:
        gone = np.flatnonzero(np.isin(self._ids, increment.pruned_ids))
        if len(gone):
            remaining = self._covariance.drop(gone)
            self._ids, self._positions = self._ids[remaining], self._positions[remaining]

    def _add(self, first: FirstSights) -> None:
        """New landmarks, correlated with all there is through the pose they were seen from."""
        if not len(first.points):
            return
        by_pose = -self._wTc[:3, :3] @ point_pose_jacobian(first.points)
        flat = by_pose.reshape(-1, FRONT)
        front = self._covariance.front()
        square = congruence(flat, front[:FRONT])
        own = congruence(self._wTc[:3, :3], first.covariances)
        at = BLOCK * np.arange(len(own))[:, None] + np.arange(BLOCK)
        square[at[:, :, None], at[:, None, :]] += own
        self._covariance.append(front @ flat.T, square)
        self._ids = np.concatenate([self._ids, first.observed.ids])
        positions = transform_to_world(self._wTc, first.points)
        self._positions = np.concatenate([self._positions, positions])

    def _blocks(self, ids: IntArray) -> IntArray:
        """Block of each landmark. KeyError for an unknown one."""
        order = np.argsort(self._ids, kind="stable")
        known = LandmarkMap(self._ids[order], self._positions, np.empty(0))
        return order[known.rows(ids)]
