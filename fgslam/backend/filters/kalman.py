"""The paper's estimator: least-squares pose, one 3x3 Kalman filter per landmark.

Se, Lowe and Little (2001), Sections 4.1 (averaging) and 6.4 (Kalman filters). The pose is that of
the least squares against the landmarks (3.3). Correlations between landmarks, and between
landmarks and pose, are dropped: that is what makes the filter cheap, and its own covariances far
too small. It goes on with them, and reports those of its errors (:mod:`fgslam.backend.considered`).

Past poses are revised by loop closures alone (backward correction by submaps): the drive and the
landmarks, each with the frame that it was made in, move to where a pose graph has them. The
filter's own covariances stay: of a pose relative to the map around it, and of a landmark relative
to the poses that saw it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from fgslam.backend.considered import Moved, SampledErrors, TrackedStep, lacking, shares
from fgslam.backend.filters.filtered import FilteredTrajectory, moved
from fgslam.backend.filters.landmark_update import (
    FrameUpdate,
    Landmarks,
    UpdateKind,
    average_weight,
    kalman_update,
)
from fgslam.backend.loops import (
    Chain,
    DriveRecord,
    changes,
    guessed,
    home_changes,
    rotated,
    starts_new_part,
    transported,
    with_unknown_step,
)
from fgslam.backend.measured import Waiting, linearised, nuisance_words, require_model
from fgslam.backend.protocol import recalibrated
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import PerLandmarkSettings
from fgslam.core.arrays import FloatArray, GrowingColumns, IntArray
from fgslam.core.geometry import (
    block_diagonal,
    congruence,
    inverse,
    inverse_spd3,
    moved_apart,
    point_pose_jacobian,
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
from fgslam.core.types import LAGS, EgoMotion, Estimate, LandmarkMap, Prediction, UpdateStats
from fgslam.factors.measurement import nuisance_covariance
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem


class LandmarkKalman:
    """Estimator of kind ``landmark_kalman``, on :class:`fgslam.backend.protocol.Estimator`."""

    kind: ClassVar[str] = "landmark_kalman"
    supports: ClassVar[frozenset[MeasurementType]] = frozenset(MeasurementType)
    updates: ClassVar[type[FrameUpdate]] = FrameUpdate
    _current: Kept[Prediction]
    _past: Kept[FilteredTrajectory]
    _motions: Kept[list[FloatArray]]
    _rows: Kept[LandmarkRows]
    _drive: Kept[DriveRecord]
    _errors: Kept[SampledErrors]
    _applied: Kept[FloatArray]
    _waiting: Kept[Waiting]
    _nuisances: Kept[list[str]]

    def __init__(
        self,
        rig: CameraRig,
        settings: PerLandmarkSettings,
        prior: Prediction,
        ego_motion: EgoMotionSettings | None = None,
    ) -> None:
        """Starts at the prior pose with an empty map.

        Args:
            rig: the cameras.
            settings: which update, and its noise.
            prior: pose of the first frame and its covariance.
            ego_motion: of the least squares that finds the poses, for the covariances reported;
                None reports the filter's own, as a smoother's tracker may.
        """
        self._rig = rig
        self._settings = settings
        self._current = prior
        self._by_pose: FloatArray | None = None  # what landmarks take over of the pose's covariance
        self._past = FilteredTrajectory()
        self._motions = []  # of each frame, covariances of the motions to it over LAGS frames
        self._rows = LandmarkRows()
        self._drive = DriveRecord()
        solver = EgoMotionSolver(rig, ego_motion or EgoMotionSettings())
        self._errors = SampledErrors(solver, off=ego_motion is None)
        self._floor, self._waiting = solver.floor, Waiting()
        self._nuisances = []  # kinds: their parameters are rows of the identities -1, -2, ...
        self._fixed = False
        self._applied = np.empty(0)  # correction of the rig in the last frame

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose after the camera moved by ``odometry``."""
        return moved(self._current, odometry)

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Pose from the tracking; matched landmarks filtered, missed ones grown, new ones added.

        By their types in the frame (4.1): II was expected and missed, III matched, IV is new; all
        others, type I, stay as they are.

        Then loops are closed: the reported pose is the corrected one, with the covariance of the
        closure, which is its uncertainty relative to the place returned to.
        """
        self._past.require_later(increment)
        times = self._past.timestamps
        increment = with_unknown_step(increment, tracking, self._current.wTc, times)
        recalibrated(self, increment.rig_correction, increment.rig_since)
        step = self._step(increment, tracking)
        self._current = Prediction(tracking.wTc, tracking.covariance)
        shared = self._settings.pose_covariance and not guessed(increment, tracking)
        new = increment.observations.is_new
        used = increment.observations.select(~new).select(tracking.inliers)
        self._errors.track(step, used, self._rows.map())
        for one in increment.measured:
            require_model(one, increment.index)
            self._measure(one)
        tracking = replace(tracking, wTc=self._current.wTc, covariance=self._current.covariance)
        # With the stated noise, like all that landmarks are weighed by.
        self._by_pose = tracking.covariance / tracking.noise if shared else None
        nis = self._update_matched(used)  # type III
        missed = self._rows.rows(increment.missed_ids)  # type II
        self._rows.covariances[missed] += self._settings.miss_growth_m**2 * np.eye(3)
        self._add(increment.observations.select(new), len(self._past))  # type IV
        for one in increment.measured:
            self._begin(one)
        self._record(increment, tracking, step.before, used.ids)
        self._rows.remove(increment.pruned_ids)
        self._errors.forget(increment.pruned_ids)
        self._past.append(increment.timestamp, self._current)
        closed = tuple(self._close(increment, loop) for loop in increment.loops)
        current = self._errors.pose(self._current)
        self._past.covariances[-1] = current.covariance
        self._motions.append(self._errors.motions(current.wTc))
        return UpdateStats(
            current.wTc, current.covariance, len(self.landmarks()), nis, 3 * len(used), closed
        )

    def _step(self, increment: Increment, tracking: EgoMotion) -> TrackedStep:
        """The step to a frame, before it is taken."""
        frame, before = len(self._past), self._current
        if not frame:
            before = Prediction(before.wTc, np.zeros((6, 6)))
        return TrackedStep(frame, increment, tracking, before, self.predict(increment.odometry))

    def _update_matched(self, observed: Observations) -> float:
        """Updates matched landmarks; their innovation squared."""
        if not len(observed):
            return float("nan")
        held, kind = self._rows, self._settings.update
        rows = held.rows(observed.ids)
        held.lasts[rows] = len(self._past)
        known = Landmarks(held.positions[rows], held.covariances[rows])
        counts = held.counts[rows].astype(np.float64)
        found = self._frame.update(kind, known, counts, observed)
        if not self._fixed:
            held.positions[rows], held.covariances[rows] = found.positions, found.covariances
            share = moved_share(kind, known.covariances, found.covariances, counts)
            self._errors.filter(share)
            held.counts[rows] += 1
        return found.nis

    @property
    def _frame(self) -> FrameUpdate:
        """The updates by the last frame."""
        return self.updates(self._rig, self._current.wTc, self._by_pose)

    def _add(self, observed: Observations, frame: int) -> None:
        """Adds new landmarks (type IV) where this frame sees them."""
        if not len(observed):
            return
        positions, covariances = self._frame.place(observed)
        self._rows.add(observed.ids, positions, covariances, frame)
        placed = PoseProblem(positions, covariances, observed.measurement, observed.covariance)
        self._errors.add(observed.ids, placed, self._current.wTc)

    def _measure(self, one: Measured) -> None:
        """The pose, then known landmarks, by what another sensor measured of them."""
        own, held, before = self._nuisance(one), self._rows, self._current
        one = one if one.of_pose else one.select(np.isin(one.ids, held.ids))
        if len(own) and len(one) > 1:  # each knows what the one before made of the parameters
            for row in range(len(one)):
                self._measure(one.select(np.array([row])))
            return
        if not len(one):
            return
        ids = np.concatenate([one.ids, own])
        at = held.rows(ids)
        known = Landmarks(held.positions[at], held.covariances[at])
        known = _joined(known) if len(own) else known
        points = None if one.of_pose else known.positions[:, :3]
        parameters = known.positions[0, 3:] if len(own) else None
        rows = linearised(self._rig, one, before.wTc, points, parameters)
        noise = one.covariance
        if not one.of_pose:
            noise = noise + congruence(rows.by_point, known.covariances)
        by_pose = rows.by_pose.reshape(-1, 6)
        noise = block_diagonal(np.empty((0, 0)), noise)
        cross = before.covariance @ by_pose.T
        gain = np.asarray(np.linalg.solve(by_pose @ cross + noise, cross.T).T, np.float64)
        wTc = self._floor.constrain(moved_apart(before.wTc, -gain @ rows.residual.ravel()))
        kept = congruence(np.eye(6) - gain @ by_pose, before.covariance)
        self._current = Prediction(wTc, kept + congruence(gain, noise))
        drawn = self._errors.correct(gain, rows, ids, one.covariance)
        if not one.of_pose and not self._fixed:
            rows = linearised(self._rig, one, wTc, points, parameters)
            noise = one.covariance + congruence(rows.by_pose, self._current.covariance)
            found = kalman_update(known, rows.by_point, -rows.residual, noise)
            held.positions[at] = found.positions.reshape(-1, 3)
            spread = found.covariances
            held.covariances[at] = np.concatenate(
                [spread[:, k : k + 3, k : k + 3] for k in range(0, spread.shape[1], 3)]
            )
            held.lasts[at] = len(self._past)
            held.counts[at] += 1
            self._errors.pull(np.asarray(found.gain), rows, ids, drawn)

    def _nuisance(self, one: Measured) -> IntArray:
        """(1,) identity of the sensor's nuisance parameters, (0,) of a sensor without."""
        if not one.model.nuisance.size:
            return np.empty(0, np.int64)
        if one.kind not in self._nuisances:
            self._nuisances.append(one.kind)
            new, spread = np.array([-len(self._nuisances)]), nuisance_covariance(one.model)[None]
            self._rows.add(new, np.zeros((1, 3)), spread, -1)
            self._errors.begin(new, np.zeros((1, 3, 6)), spread)
        return np.array([-1 - self._nuisances.index(one.kind)])

    def nuisance(self, kind: str) -> tuple[FloatArray, FloatArray] | None:
        """Parameters (3,) of a kind of measurement and their covariance; None without any."""
        if kind not in self._nuisances:
            return None
        at = self._rows.rows(np.array([-1 - self._nuisances.index(kind)]))[0]
        return self._rows.positions[at], self._rows.covariances[at]

    def know_nuisance(self, kind: str, values: FloatArray, covariance: FloatArray) -> None:
        """Takes over parameters (3,) that a smoother has found, and their covariance (3, 3)."""
        at = self._rows.rows(np.array([-1 - self._nuisances.index(kind)]))
        self._rows.positions[at], self._rows.covariances[at] = values, covariance

    def _begin(self, one: Measured) -> None:
        """Landmarks that another sensor's measurements give a place now."""
        if one.of_pose:
            return
        pose, held = self._current, self._rows
        self._nuisance(one)
        known = self.nuisance(one.kind)
        begun = self._waiting.begin(self._rig, one, pose, held.ids, known)
        turned = congruence(pose.wTc[:3, :3], begun.covariances)
        by_pose = -pose.wTc[:3, :3] @ point_pose_jacobian(begun.points)
        own = turned + congruence(by_pose, pose.covariance)
        positions = transform_to_world(pose.wTc, begun.points)
        self._rows.add(begun.ids, positions, own, len(self._past))
        self._errors.begin(begun.ids, by_pose, turned)
        self._measure(begun.later)

    def _record(
        self, increment: Increment, tracking: EgoMotion, before: Prediction, used: IntArray
    ) -> None:
        """Keeps the step to this frame, for later loops, and which old landmarks placed it."""
        step = inverse(before.wTc) @ tracking.wTc if len(self._past) else tracking.wTc
        free = increment.relocalised or starts_new_part(increment, tracking)
        self._drive.step(step, tracking, increment.odometry, free)
        homes = self._rows.homes[self._rows.rows(used)]
        self._drive.tie(homes, self._past.poses, tracking, increment.relocalised)

    def _close(self, increment: Increment, loop: LoopClosure) -> bool:
        """Moves the drive and the map to where the loop has them; False if it is refused."""
        poses = self._drive.close(loop, self._current.wTc, f"frame {increment.index}")
        if poses is None:
            return False
        moved_by = changes(np.array(self._past.poses), poses)
        self._past.poses[:] = list(poses)
        self._current = Prediction(poses[-1], loop.covariance)
        self._past.covariances[-1] = loop.covariance
        by_landmark = home_changes(self._rows.homes, moved_by)
        self._rows.positions[:] = transported(by_landmark, self._rows.positions)
        self._rows.covariances[:] = rotated(by_landmark, self._rows.covariances)
        taken = shares(self._drive.chain, loop)
        moved = Moved(by_landmark[:, :3, :3], self._rows.homes, taken)
        self._errors.close(loop, self._rows.map(), poses[-1], moved)
        return True

    def landmarks(self) -> LandmarkMap:
        """Current landmarks, until the next update; the arrays are read only by agreement."""
        return self._rows.map(len(self._nuisances))

    def estimate(self) -> Estimate:
        """Trajectory as filtered, corrected by loops, and the map."""
        rows = self.landmarks()
        held = LandmarkMap(rows.ids.copy(), rows.positions.copy(), rows.covariances.copy())
        remarks, whole = list(self._drive.remarks), self._errors.landmarks(self._rows.map())
        for number, kind in enumerate(self._nuisances, 1):
            at = whole.rows(np.array([-number]))[0]
            spread = np.diagonal(whole.covariances[at])
            remarks.append(nuisance_words(kind, whole.positions[at], spread))
        relative = motions_by_lag(self._motions)
        return Estimate(
            self._past.trajectory(),
            self._past.pose_covariances(),
            self._errors.landmarks(held),
            tuple(remarks),
            noise_factor=1.0,
            relative=relative,
            online_relative=relative,
        )

    # -- for loops, saved maps and smoothers ---------------------------------------------------

    @property
    def keeps_maps(self) -> bool:
        """True: the pose is that of the least squares, whether landmarks are updated or not."""
        return True

    def begin_in(self, landmarks: LandmarkMap, hits: IntArray, fixed: bool) -> None:
        """Takes a saved map over; no loop of this drive moves its landmarks."""
        unseen = np.full(len(landmarks), -1)
        self._rows.load(landmarks, hits, unseen, unseen)
        self._fixed = fixed
        if fixed:
            self._errors.hold_map()

    @property
    def homes(self) -> IntArray:
        """(n,) frame with which each landmark of the map moves; -1 for one that stays."""
        return self._rows.homes[len(self._nuisances) :]

    @property
    def chain(self) -> Chain:
        """The drive as tracked, with the uncertainty of its steps."""
        return self._drive.chain

    def correct(self, current: Prediction, ids: IntArray, positions: FloatArray) -> None:
        """Takes over a smoother's last pose and landmark positions (k, 3), between two frames.

        For a filter that tracks on a smoothed map; covariances of the landmarks stay, as they
        stand for what is known of them given the poses.
        """
        self._current = current
        self._rows.positions[self._rows.rows(ids)] = positions
        self._errors.mark(current.wTc)

    @property
    def since_correction(self) -> FloatArray | None:
        """(6, 6) covariance of the motion since :meth:`correct`; None where none is sampled."""
        return self._errors.since_marked(self._current.wTc)

    @property
    def motions(self) -> FloatArray:
        """(l, 6, 6) covariances of the motions over LAGS frames to the last pose; or NaN."""
        return self._motions[-1]

    def restart(self, observed: Observations) -> None:
        """Restarts known landmarks from one observation each in the last frame: they moved."""
        if len(observed):
            self._rows.remove(observed.ids)
            self._errors.forget(observed.ids)
            self._add(observed, len(self._past) - 1)

    def recalibrate(self, correction: FloatArray, since: int = 0) -> RigChange | None:
        """Moves the landmarks of this drive that the rig has measured as it is since that frame.

        Returns:
            By what they moved; None where the correction is what it was.
        """
        before, self._applied = self._applied, correction
        if not before.size or not len(self._past) or (before == correction).all():
            return None
        change = RigChange(self._rig, correction - before, since)
        known = np.flatnonzero((self._rows.homes >= 0) & (self._rows.lasts >= since))
        poses = np.array([*self._past.poses[:-1], self._current.wTc])[self._rows.lasts[known]]
        self._rows.positions[known] = change.moved(poses, self._rows.positions[known])
        return change


def _joined(both: Landmarks) -> Landmarks:
    """A landmark and nuisance parameters, two rows, as one of six numbers."""
    covariance = block_diagonal(np.empty((0, 0)), both.covariances)
    return Landmarks(both.positions.reshape(1, 6), covariance[None])


def motions_by_lag(motions: list[FloatArray]) -> dict[int, FloatArray]:
    """By LAGS (n - lag, 6, 6) of what (l, 6, 6) each frame has of the motions to it."""
    found = np.array(motions).reshape(-1, len(LAGS), 6, 6)
    return {lag: found[lag:, k] for k, lag in enumerate(LAGS)}


def moved_share(
    kind: UpdateKind, before: FloatArray, after: FloatArray, counts: FloatArray
) -> FloatArray:
    """(k, 3, 3) of the way to where the frame has them that landmarks have moved.

    Of a Kalman filter's K H, from the covariances (k, 3, 3) before and after: (I - K H) S.
    """
    if kind in ("running_mean", "half"):
        return average_weight(kind, counts)[:, :, None] * np.eye(3)
    extra = lacking(before)
    return np.asarray(np.eye(3) - (after + extra) @ inverse_spd3(before + extra))


class LandmarkRows(GrowingColumns):
    """Identities ascending, with position, covariance, sightings, home frame and last frame.

    An update costs what it touches: new landmarks are appended in place, and those that go are
    mostly young, so that only what lies behind the first of them moves.

    Attributes:
        ids: (n,) ascending.
        positions: (n, 3) world, metres.
        covariances: (n, 3, 3) metres squared.
        counts: (n,) frames in which each was seen.
        homes: (n,) frame with which each moves when a loop is closed; -1 for one that stays.
        lasts: (n,) frame that saw each last; -1 for one that none saw yet.
    """

    ids: IntArray
    positions: FloatArray
    covariances: FloatArray
    counts: IntArray
    homes: IntArray
    lasts: IntArray

    def __init__(self) -> None:
        """No landmark."""
        number = np.empty(0, np.int64)
        positions, covariances = np.empty((0, 3)), np.empty((0, 3, 3))
        super().__init__(
            ids=number,
            positions=positions,
            covariances=covariances,
            counts=number,
            homes=number,
            lasts=number,
        )

    def map(self, first: int = 0) -> LandmarkMap:
        """As a map from a row on; only until the next landmark comes or goes."""
        return LandmarkMap(self.ids[first:], self.positions[first:], self.covariances[first:])

    def rows(self, ids: IntArray) -> IntArray:
        """Row of each id. Raises KeyError when one is absent."""
        return self.map().rows(ids)

    def add(self, ids: IntArray, positions: FloatArray, covariances: FloatArray, home: int) -> None:
        """Adds landmarks (k,), seen once; they must be new."""
        ones = np.ones(len(ids), np.int64)
        self.bring(LandmarkMap(ids, positions, covariances), ones, home * ones, home * ones)

    def bring(
        self, landmarks: LandmarkMap, counts: IntArray, homes: IntArray, lasts: IntArray
    ) -> None:
        """Adds landmarks (k,) that are known already; none of them may be there."""
        before = len(self)
        self.append(
            {
                "ids": landmarks.ids,
                "positions": landmarks.positions,
                "covariances": landmarks.covariances,
                "counts": counts,
                "homes": homes,
                "lasts": lasts,
            }
        )
        self.keep_ascending("ids", before)

    def remove(self, ids: IntArray) -> None:
        """Drops landmarks. Raises KeyError when one is absent."""
        if not len(ids):
            return
        gone = np.zeros(len(self), np.bool_)
        gone[self.rows(ids)] = True
        self.drop(gone)

    def load(
        self, landmarks: LandmarkMap, counts: IntArray, homes: IntArray, lasts: IntArray
    ) -> None:
        """Replaces everything; the arrays are copied."""
        self.take(0, np.empty(0, np.int64))
        self.bring(landmarks, counts, homes, lasts)
