"""The covariance that a filter of single landmarks has: samples of the noise through its own gains.

The filter drops the correlations of landmarks and pose, so what it calculates is not the covariance
of its errors. That follows the same gains with the true noise (sensitivity of suboptimal filters,
Gelb 1974, 7.2): exactly, it takes a joint matrix whose size and cost grow with the square of the
map. Here a fixed number of drawn samples stands for it, as in the ensemble of Evensen (1994): a
landmark costs as much whatever the map. The terms of the rig's calibration go the same way, one
column each (Schmidt 1966). The noise is drawn as large as the drive's residuals so far have it, as
a smoother weighs it. Estimates stay as they are. docs/derivations/landmark_filter.md.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from fgslam.backend.filters.error_columns import ErrorColumns
from fgslam.backend.filters.loop_correction import (
    CLOSURE_FACTOR,
    FREE,
    Chain,
    as_motions_of_the_world,
    starts_new_part,
)
from fgslam.backend.filters.online_doubt import RigTerms
from fgslam.backend.persistence import Persistence, learn_from
from fgslam.core.arrays import FloatArray, IntArray, Rows
from fgslam.core.estimates import EgoMotion, EgoMotionStatus, LandmarkMap, Prediction
from fgslam.core.geometry import (
    adjoint,
    block_diagonal,
    congruence,
    in_front,
    inverse,
    point_pose_jacobian,
    projection_jacobian,
    skew,
    transform_to_camera,
)
from fgslam.core.measurements import Increment, LoopClosure, Observations
from fgslam.core.store import Kept
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem

SAMPLES = 48
"""A variance from them is known to the root of 2 / SAMPLES, a deviation to 10 %."""
_NOISE = "noise_"  # of names in a state
_STREAM = 17  # of random numbers, beside those of the recording
_FARTHEST_M = 1e9  # beyond, a point has no derivative; and nothing to tell
_FLAT, _PADDING = 1e-20, 1e-9  # of the variances' sum: far below any landmark's, above rounding
_LEAST_MATCHES = 6  # that place a frame by an old part of the drive
_PLACE = 24  # landmarks of it that do so where fewer match: of some frames


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """What a closure has done to landmarks (n).

    Attributes:
        rotations: (n, 3, 3) by which it turned them.
        homes: (n,) frame with which each moves; -1 for one that stays.
        shares: (frames, 6, 6) of the whole correction, as a motion of the world, by frame.
    """

    rotations: FloatArray
    homes: IntArray
    shares: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """How a frame's pose was found.

    Attributes:
        frame: its number.
        increment: its measurements.
        tracking: its pose.
        before: the last frame's pose; of the first one the prior pose, exactly.
        prediction: from there.
    """

    frame: int
    increment: Increment
    tracking: EgoMotion
    before: Prediction
    prediction: Prediction

    @property
    def measured(self) -> bool:
        """Whether the pose is that of the least squares."""
        status = self.tracking.status
        return status.measured and status is not EgoMotionStatus.CAPPED

    @property
    def expected(self) -> Prediction:
        """What the least squares had beside the matches; nothing where it looked everywhere."""
        free = self.increment.relocalised
        return Prediction(self.prediction.wTc, FREE) if free else self.prediction

    def added(self) -> tuple[FloatArray, FloatArray]:
        """What takes an error of the last pose (6, 6) to this one or its prediction, and the noise.

        The latter is the covariance (6, 6) that the step adds.
        """
        carried = adjoint(inverse(inverse(self.before.wTc) @ self.tracking.wTc))
        if starts_new_part(self.increment, self.tracking):
            return carried, FREE
        pose = self.expected if self.measured else self.tracking
        return carried, pose.covariance - congruence(carried, self.before.covariance)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ObservedColumns(Rows):
    """Measurements (k) of landmarks in a frame, linearised at the landmarks: error columns."""

    by_pose: FloatArray
    by_point: FloatArray
    shift: FloatArray

    def off(self, points: FloatArray) -> FloatArray:
        """(k, 3, m) how far they are from where landmarks with errors (k, 3, m) have them."""
        return np.asarray(self.shift - self.by_point @ points)

    def placed(self, pose: FloatArray) -> FloatArray:
        """(k, 3, m) where a camera with errors (6, m) has the points."""
        off = self.shift - (self.by_pose.reshape(-1, 6) @ pose).reshape(self.shift.shape)
        return np.asarray(np.linalg.inv(self.by_point) @ off)

    def following(self, by_measurement: FloatArray, points: FloatArray) -> FloatArray:
        """(6, m) of a pose with this derivative (k, 6, 3) by the measurements."""
        off = self.off(points)
        gain = np.swapaxes(by_measurement, 0, 1).reshape(6, -1)
        return np.asarray(gain @ off.reshape(gain.shape[1], off.shape[2]))


class SampledErrors(ErrorColumns):
    """Columns by what is unknown of the rig, then by SAMPLES draws of all noise."""

    _terms: Kept[RigTerms]
    _noise: Kept[Persistence]

    def __init__(self, solver: EgoMotionSolver, off: bool = False) -> None:
        """The first pose is known, the map empty.

        Args:
            solver: that finds each frame's pose.
            off: nothing is sampled, and what is reported is what the filter has.
        """
        # Single precision: a sample stands for a deviation that is known to a tenth.
        self._terms = RigTerms(solver.sensor)
        self._count = self._terms.count  # of columns before the draws
        super().__init__(0 if off else self._count + SAMPLES, np.float32)
        self._off = off
        self._solver = solver
        self._sensor = solver.sensor
        self._noise = Persistence(solver.sensor)
        self._random = np.random.default_rng(_STREAM)
        self._taken = 1.0  # variance over the stated one that the newest pose took
        self._seen: tuple[IntArray, ObservedColumns, FloatArray] | None = None
        """Matches of the newest frame: rows of their landmarks, and the columns of these before."""

    # -- what the filter does, done to the columns ---------------------------------------------

    def track(self, step: Step, used: Observations, landmarks: LandmarkMap) -> None:
        """From the last pose to a frame's, by the matches (k) that it is of, before these move."""
        if self._off:
            return
        self._random = np.random.default_rng((_STREAM, step.frame))
        self._terms.update(step.increment)
        learn_from(self._noise, step.frame, step.increment, step.tracking, step.before.wTc)
        self._taken = step.tracking.noise
        wTc, problem = step.tracking.wTc, PoseProblem.of(landmarks, used)
        carried, noise = step.added()
        moved = carried @ self._gain
        moved[:, self._count :] += _root(noise) @ self._signs(1, 6)[0]
        columns = self._columns(wTc, problem)
        self._enter(used.ids, columns, problem.point_covariances, moved)
        rows, _ = self._rows(used.ids)
        self._seen = rows, columns, self._map["gain"][rows].astype(np.float64)
        self._gain = self._on_floor(wTc, moved)
        if step.measured:
            by_prediction, by_measurement = self._solver.gain(
                wTc, step.expected, problem, self._taken
            )
            self._gain = by_prediction @ moved + columns.following(by_measurement, self._seen[2])

    def filter(self, share: FloatArray) -> None:
        """Matched landmarks move to where the frame has them by the share (k, 3, 3) of the way."""
        if self._seen is not None:
            rows, columns, before = self._seen
            self._map["gain"][rows] = before + share @ (columns.placed(self._gain) - before)

    def add(self, ids: IntArray, placed: PoseProblem, wTc: FloatArray) -> None:
        """New landmarks, where the frame at ``wTc`` has them."""
        if not self._off:
            points = transform_to_camera(wTc, placed.points)
            near = in_front(points) & (np.abs(points).max(axis=1) < _FARTHEST_M)
            gain = np.zeros((len(ids), 3, self._count + SAMPLES))
            gain[near] = self._columns(wTc, placed.select(near)).placed(self._gain)
            self._append({"ids": ids, "gain": gain})

    def close(
        self, loop: LoopClosure, landmarks: LandmarkMap, wTc: FloatArray, moved: Moved
    ) -> None:
        """A closure has moved the drive.

        Args:
            loop: the closure.
            landmarks: the map, moved.
            wTc: the newest pose, moved.
            moved: the landmarks' share in it.
        """
        if self._off:
            return
        rows, known = self._rows(landmarks.ids)
        self._map["gain"][rows[known]] = moved.rotations[known] @ self._map["gain"][rows[known]]
        apart = adjoint(wTc) @ (self._gain - self._returned(loop, landmarks, wTc, moved.homes))
        self._gain = self._on_floor(
            wTc, self._gain - adjoint(inverse(wTc)) @ moved.shares[-1] @ apart
        )
        homes = np.where(known, moved.homes, -1)
        order = np.argsort(homes, kind="stable")[np.count_nonzero(homes < 0) :]
        ends = np.flatnonzero(np.diff(homes[order], append=-1)) + 1
        for of_home in np.split(order, ends[:-1]) if len(order) else ():
            motion = moved.shares[homes[of_home[0]]] @ apart
            points = skew(landmarks.positions[of_home])
            self._map["gain"][rows[of_home]] -= motion[3:] - points @ motion[:3]

    # -- what is reported ----------------------------------------------------------------------

    def pose(self, newest: Prediction) -> Prediction:
        """The newest pose with the covariance of its errors."""
        if self._off:
            return newest
        return Prediction(newest.wTc, self._covariances(self._gain, self._solver.floor.rigid_dof))

    def landmarks(self, known: LandmarkMap) -> LandmarkMap:
        """Landmarks with the covariances of their errors; those without keep what they have."""
        gain = self._of_map(known.ids)
        have = np.any(gain, axis=(1, 2))
        if self._held or not have.any():
            return known
        covariances = known.covariances.copy()
        covariances[have] = self._covariances(gain[have], 3)
        return dataclasses.replace(known, covariances=covariances)

    def joint(self, pose: FloatArray, known: LandmarkMap) -> FloatArray:
        """(6 + 3k, 6 + 3k) covariance of newest pose (6, 6) and landmarks, both as reported.

        Fewer samples than dimensions make it singular: it is shrunk towards independence.
        """
        blocks = block_diagonal(pose, known.covariances)
        if self._off:
            return blocks
        own = block_diagonal(np.ones((6, 6)), np.ones((len(known), 3, 3)))
        landmarks = self._weighed(self._of_map(known.ids), 3)
        columns = np.concatenate(
            [self._weighed(self._gain, self._solver.floor.rigid_dof), *landmarks]
        )
        kept = SAMPLES / (SAMPLES + len(blocks))
        return np.where(own > 0.0, blocks, kept * (columns @ columns.T))

    # ----------------------------------------------------------------------------------------

    def _columns(self, wTc: FloatArray, seen: PoseProblem) -> ObservedColumns:
        points = transform_to_camera(wTc, seen.points)
        projection = projection_jacobian(self._sensor, points)
        shift = np.zeros((len(seen), 3, self._count + SAMPLES))
        shift[:, :, : self._count] = self._terms.shifts(seen.measurement)
        shift[:, :, self._count :] = self._drawn(self._noise.power * seen.measurement_covariance)
        by_pose = projection @ point_pose_jacobian(points)
        return ObservedColumns(by_pose, projection @ wTc[:3, :3].T, shift)

    def _signs(self, k: int, d: int) -> FloatArray:
        """(k, d, SAMPLES) random signs.

        Of all that has variance one, they leave least error in a covariance (Hutchinson 1990).
        """
        bits = np.frombuffer(self._random.bytes(k * d * SAMPLES // 8), np.uint8)
        return np.asarray(2.0 * np.unpackbits(bits).reshape(k, d, SAMPLES) - 1.0)

    def _drawn(self, covariances: FloatArray) -> FloatArray:
        """Samples (k, 3, SAMPLES) of these covariances (k, 3, 3)."""
        definite = covariances + lacking(covariances)
        return np.asarray(np.linalg.cholesky(definite) @ self._signs(len(covariances), 3))

    def _enter(
        self, ids: IntArray, columns: ObservedColumns, covariances: FloatArray, pose: FloatArray
    ) -> None:
        """Landmarks of a saved map seen for the first time: independent, as the filter has them.

        Their map was made with the same rig: its terms have them where the pose does.
        """
        new = ~self._rows(ids)[1]
        if new.any():
            gain = columns.select(new).placed(pose)
            gain[:, :, self._count :] = self._drawn(covariances[new])
            self._append({"ids": ids[new], "gain": gain})

    def _returned(
        self, loop: LoopClosure, landmarks: LandmarkMap, wTc: FloatArray, homes: IntArray
    ) -> FloatArray:
        """Errors (6, m) of the newest pose, at ``wTc``, by the landmarks of an old place."""
        seen = loop.observations
        seen = seen.select(self._rows(seen.ids)[1] & np.isin(seen.ids, landmarks.ids))
        problem = PoseProblem.of(landmarks, seen)
        ahead = in_front(transform_to_camera(wTc, problem.points))
        if ahead.sum() < _LEAST_MATCHES:
            gain = adjoint(inverse(wTc)) @ self._of_place(loop.frame, landmarks, homes)
            gain[:, self._count :] += _root(loop.covariance) @ self._signs(1, 6)[0]
            return gain
        problem = problem.select(ahead)
        columns = self._columns(wTc, problem)
        by_measurement = self._solver.gain(wTc, Prediction(wTc, FREE), problem, self._taken)[1]
        return columns.following(by_measurement, self._of("gain", seen.ids[ahead]))

    def _of_place(self, frame: int, landmarks: LandmarkMap, homes: IntArray) -> FloatArray:
        """Errors (6, m) of a frame's place as a motion of the world, by landmarks first seen there.

        Weighted least squares over those whose first frames are nearest; zero where there are none.
        """
        have = np.flatnonzero(self._rows(landmarks.ids)[1] & (homes >= 0))
        nearest = have[np.argsort(np.abs(homes[have] - frame), kind="stable")][:_PLACE]
        near = landmarks.select(np.sort(nearest))
        by_motion = np.concatenate(
            [-skew(near.positions), np.tile(np.eye(3), (len(near), 1, 1))], axis=2
        )
        weights = np.asarray(np.linalg.inv(near.covariances + lacking(near.covariances)))
        turned = np.swapaxes(by_motion, 1, 2) @ weights
        information = (turned @ by_motion).sum(axis=0)
        pull = (turned @ self._of("gain", near.ids)).sum(axis=0)
        return np.asarray(np.linalg.pinv(information, hermitian=True) @ pull)

    def _on_floor(self, wTc: FloatArray, columns: FloatArray) -> FloatArray:
        basis = self._solver.floor.basis(wTc)
        return np.asarray(basis @ (basis.T @ columns))

    def _covariances(self, columns: FloatArray, freedom: int) -> FloatArray:
        """Covariances (..., d, d) of errors (..., d, m) with so many degrees of freedom."""
        weighed = self._weighed(columns, freedom)
        return np.asarray(weighed @ np.swapaxes(weighed, -1, -2))

    def _weighed(self, columns: FloatArray, freedom: int) -> FloatArray:
        """Roots (..., d, m) of those covariances.

        The inverse of a covariance of N samples is N / (N - d - 1) times too large in the mean
        (inverse Wishart): by so much the covariance is stated larger.
        """
        terms, drawn = columns[..., : self._count], columns[..., self._count :]
        drawn = np.asarray(drawn / np.sqrt(SAMPLES - freedom - 1.0))
        if self._terms.deviations is None:
            return drawn
        return np.concatenate([terms @ self._terms.deviations, drawn], axis=-1)


def lacking(covariances: FloatArray) -> FloatArray:
    """(k, 3, 3) what makes covariances definite: zero but where a direction has no variance.

    Saved maps may have such landmarks.
    """
    trace = np.trace(covariances, axis1=1, axis2=2)
    flat = np.linalg.det(covariances) <= _FLAT * trace**3
    return np.asarray(np.where(flat, _PADDING * trace, 0.0)[:, None, None] * np.eye(3))


def _root(covariance: FloatArray) -> FloatArray:
    """(6, 6) symmetric root of a covariance of any rank: it follows rounding as little."""
    variances, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((directions * np.sqrt(np.maximum(variances, 0.0))) @ directions.T)


def shares(chain: Chain, closed: LoopClosure) -> FloatArray:
    """(n, 6, 6) of a closure to the last frame that each pose takes, as motions of the world.

    Its earlier end and what is before stay; steps in between share as they are uncertain.
    """
    poses = np.array(chain.poses)
    since = np.cumsum(as_motions_of_the_world(poses, np.array(chain.steps)), axis=0)
    since = since - since[closed.frame]
    since[: closed.frame] = 0.0
    closure = congruence(adjoint(poses[-1]), CLOSURE_FACTOR**2 * closed.covariance)
    return np.asarray(since @ np.linalg.inv(since[-1] + closure))
