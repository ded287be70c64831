"""The paper's estimator: least-squares pose, one 3x3 Kalman filter per landmark.

Se, Lowe and Little (2001), Sections 4.1 (averaging) and 6.4 (Kalman filters). The pose is that of
the least squares against the landmarks (3.3). Correlations between landmarks, and between
landmarks and pose, are dropped: that is what makes the filter cheap, and its own covariances far
too small. It goes on with them, and reports those of its errors
(:mod:`fgslam.backend.filters.sampled_errors`).

Past poses are revised by loop closures alone (backward correction by submaps): the
drive and the landmarks, each with the frame that it was made in, move to where a pose graph has
them. The filter's own covariances stay: how well a pose is known beside the map around it, and how
well a landmark beside the poses that saw it.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fgslam.backend.filters.filtered import FilteredTrajectory, moved, placed
from fgslam.backend.filters.landmark_rows import LandmarkRows
from fgslam.backend.filters.loop_correction import (
    Chain,
    DriveRecord,
    changes,
    founds_anew,
    guessed,
    home_changes,
    rotated,
    transported,
)
from fgslam.backend.filters.rig_change import RigChange
from fgslam.backend.filters.sampled_errors import Moved, SampledErrors, Step, lacking, shares
from fgslam.backend.filters.self_calibration import SETTLING
from fgslam.backend.protocol import recalibrated
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import EgoMotion, Estimate, LandmarkMap, Prediction, UpdateStats
from fgslam.core.geometry import (
    congruence,
    inverse,
    inverse_spd3,
    point_pose_jacobian,
    project,
    projection_jacobian,
    transform_to_camera,
)
from fgslam.core.measurements import Increment, LoopClosure, MeasurementType, Observations, Odometry
from fgslam.core.sensors import CameraRig
from fgslam.core.store import Kept
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem

_CONTRADICTED = 2.0
"""Sigmas of a measured disparity by which landmarks are off, rms, where a change of the rig's
correction contradicts them: there the ego-motion's kernel bends."""
_MISS_GROWTH_M = 0.0001  # added to a landmark's deviation on a miss (6.4, which gives no number)


class LandmarkKalman:
    """Estimator of kind ``landmark_kalman``, on :class:`fgslam.backend.protocol.Estimator`."""

    kind: ClassVar[str] = "landmark_kalman"
    supports: ClassVar[frozenset[MeasurementType]] = frozenset(MeasurementType)
    _current: Kept[Prediction]
    _past: Kept[FilteredTrajectory]
    _rows: Kept[LandmarkRows]
    _drive: Kept[DriveRecord]
    _errors: Kept[SampledErrors]
    _applied: Kept[FloatArray]
    _disparity_sigma: Kept[float]

    def __init__(
        self,
        rig: CameraRig,
        settings: LandmarkKalmanSettings,
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
        self._rows = LandmarkRows()
        self._drive = DriveRecord()
        solver = EgoMotionSolver(rig, ego_motion or EgoMotionSettings())
        self._errors = SampledErrors(solver, off=ego_motion is None)
        self._fixed = False
        self._applied = np.empty(0)  # correction of the rig in the last frame
        self._disparity_sigma = np.inf  # of a measurement of the last frame that had any, pixels

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

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose after the camera moved by ``odometry``."""
        return moved(self._current, odometry)

    def landmarks(self) -> LandmarkMap:
        """Current landmarks, until the next update; the arrays are read only by agreement."""
        return self._rows.map()

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Pose from the tracking; matched landmarks filtered, missed ones grown, new ones added.

        Then loops are closed: the reported pose is the corrected one, with the covariance of the
        closure, which is its uncertainty relative to the place returned to.
        """
        self._past.require_later(increment)
        recalibrated(self, increment.rig_correction)
        step = self._step(increment, tracking)
        self._current = Prediction(tracking.wTc, tracking.covariance)
        shared = self._settings.pose_covariance and not guessed(increment, tracking)
        # With the stated noise, like all that landmarks are weighed by.
        self._by_pose = tracking.covariance / tracking.noise if shared else None
        matched = increment.observations.select(~increment.observations.is_new)
        used = matched.select(tracking.inliers)
        self._errors.track(step, used, self._rows.map())
        nis, dof = self._update_matched(used)
        self._grow(increment.missed_ids)
        self._add(increment.observations.select(increment.observations.is_new), len(self._past))
        self._record(increment, tracking, step.before, used.ids)
        self._rows.remove(increment.pruned_ids)
        self._errors.forget(increment.pruned_ids)
        self._past.append(increment.timestamp, self._current)
        if len(increment.observations):
            variances = increment.observations.covariance[:, 2, 2]
            self._disparity_sigma = float(np.sqrt(np.median(variances)))
        closed = tuple(self._close(increment, loop) for loop in increment.loops)
        current = self._errors.pose(self._current)
        self._past.covariances[-1] = current.covariance
        return UpdateStats(current.wTc, current.covariance, len(self._rows), nis, dof, closed)

    @property
    def homes(self) -> IntArray:
        """(n,) frame with which each landmark of the map moves; -1 for one that stays."""
        return self._rows.homes

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

    def restart(self, observed: Observations) -> None:
        """Starts known landmarks anew from one observation each in the last frame: they moved."""
        if len(observed):
            self._rows.remove(observed.ids)
            self._errors.forget(observed.ids)
            self._add(observed, len(self._past) - 1)

    def recalibrate(self, correction: FloatArray) -> RigChange | None:
        """Moves the landmarks of this drive where the change of the correction contradicts them.

        Returns:
            By what they moved, None where they stay: a change within the noise of a measurement is
            one more error among many, and after the first windows the rig itself may have moved.
        """
        before, self._applied = self._applied, correction
        known = np.flatnonzero(self._rows.homes >= 0)
        early = 0 < len(self._past) < SETTLING
        if not (early and before.size and len(known)):
            return None
        change = RigChange(self._rig, correction - before)
        poses = np.array([*self._past.poses[:-1], self._current.wTc])[self._rows.lasts[known]]
        moved, off_px = change.moved(poses, self._rows.positions[known])
        if not off_px > _CONTRADICTED * self._disparity_sigma:
            return None
        self._rows.positions[known] = moved
        return change

    def estimate(self) -> Estimate:
        """Trajectory as filtered, corrected by loops, and the map."""
        rows = self._rows
        held = LandmarkMap(rows.ids.copy(), rows.positions.copy(), rows.covariances.copy())
        return Estimate(
            self._past.trajectory(),
            self._past.pose_covariances(),
            self._errors.landmarks(held),
            tuple(self._drive.remarks),
            noise_factor=1.0,
        )

    def landmark_covariances(self, ids: IntArray) -> FloatArray:
        """Covariances (k, 3, 3) of the named landmarks."""
        return self._errors.landmarks(self._rows.map().select(self._rows.rows(ids))).covariances

    def joint_covariance(self, ids: IntArray) -> FloatArray:
        """Pose and landmarks, as reported; those that stay as they are are independent."""
        known = self._errors.landmarks(self._rows.map().select(self._rows.rows(ids)))
        return self._errors.joint(self._errors.pose(self._current).covariance, known)

    # ----------------------------------------------------------------------------------------

    def _step(self, increment: Increment, tracking: EgoMotion) -> Step:
        """The step to a frame, before it is taken."""
        frame, before = len(self._past), self._current
        if not frame:
            before = Prediction(before.wTc, np.zeros((6, 6)))
        return Step(frame, increment, tracking, before, self.predict(increment.odometry))

    def _record(
        self, increment: Increment, tracking: EgoMotion, before: Prediction, used: IntArray
    ) -> None:
        """Keeps the step to this frame, for later loops, and which old landmarks placed it."""
        step = inverse(before.wTc) @ tracking.wTc if len(self._past) else tracking.wTc
        free = increment.relocalised or founds_anew(increment, tracking)
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

    def _update_matched(self, observed: Observations) -> tuple[float, int]:
        """Updates matched landmarks (type III); innovation squared and its degrees of freedom."""
        if not len(observed):
            return float("nan"), 0
        rows = self._rows.rows(observed.ids)
        self._rows.lasts[rows] = len(self._past)
        before = self._rows.positions[rows], self._rows.covariances[rows]
        if self._settings.update == "pixel":
            nis = self._pixel_update(rows, observed)
        elif self._settings.update == "world":
            nis = self._world_update(rows, observed)
        else:
            nis = self._average(rows, observed)
        if self._fixed:
            self._rows.positions[rows], self._rows.covariances[rows] = before
        else:
            self._errors.filter(self._share(rows, before[1]))
            self._rows.counts[rows] += 1
        return nis, 3 * len(rows)

    def _pixel_update(self, rows: IntArray, observed: Observations) -> float:
        """Kalman update on (column, row, disparity), linearised at the landmark.

        With H the Jacobian by the landmark, S its covariance and R that of the measurement (plus
        the pose's, ``J P J^T``): K = S H^T (H S H^T + R)^-1, and S becomes
        (I - K H) S (I - K H)^T + K R K^T (Joseph's form). Se et al. 6.4 update in world axes.
        """
        wTc = self._current.wTc
        points = transform_to_camera(wTc, self._rows.positions[rows])
        jacobian = projection_jacobian(self._rig, points)
        noise = observed.covariance
        if self._by_pose is not None:
            by_pose = jacobian @ point_pose_jacobian(points)
            noise = noise + congruence(by_pose, self._by_pose)
        expected = project(self._rig, points)
        innovation = observed.measurement - expected
        return self._kalman(rows, jacobian @ wTc[:3, :3].T, innovation, noise)

    def _world_update(self, rows: IntArray, observed: Observations) -> float:
        """Kalman fusion of the observed 3-D position with the landmark's (6.4): H = I above."""
        positions, noise = self._observed_positions(observed)
        identity = np.broadcast_to(np.eye(3), noise.shape)
        return self._kalman(rows, identity, positions - self._rows.positions[rows], noise)

    def _kalman(
        self, rows: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
    ) -> float:
        before = self._rows.covariances[rows]
        precision = inverse_spd3(congruence(jacobian, before) + noise)
        gain = before @ np.swapaxes(jacobian, 1, 2) @ precision
        self._rows.positions[rows] += np.einsum("kij,kj->ki", gain, innovation)
        keep = np.eye(3) - gain @ jacobian
        self._rows.covariances[rows] = congruence(keep, before) + congruence(gain, noise)
        return float(np.einsum("ki,kij,kj->", innovation, precision, innovation))

    def _average(self, rows: IntArray, observed: Observations) -> float:
        """Averaging of Se et al. 4.1: a running mean of all sightings, or half old and half new.

        The position becomes (1 - w) s + w s', the covariance (1 - w)^2 S + w^2 S', with w one over
        the number of sightings, or one half.
        """
        positions, noise = self._observed_positions(observed)
        before = self._rows.positions[rows]
        innovation = positions - before
        precision = inverse_spd3(self._rows.covariances[rows] + noise)
        weight = self._weight(rows)
        self._rows.positions[rows] = before + weight * innovation
        squared = (weight**2)[:, :, None]
        kept = ((1.0 - weight) ** 2)[:, :, None]
        self._rows.covariances[rows] = kept * self._rows.covariances[rows] + squared * noise
        return float(np.einsum("ki,kij,kj->", innovation, precision, innovation))

    def _weight(self, rows: IntArray) -> FloatArray:
        """(k, 1) of a sighting in the averages of 4.1."""
        if self._settings.update == "half":
            return np.full((len(rows), 1), 0.5)
        return np.asarray(1.0 / (self._rows.counts[rows, None] + 1.0))

    def _share(self, rows: IntArray, before: FloatArray) -> FloatArray:
        """(k, 3, 3) of the way to where the frame has them that landmarks have moved.

        Of a Kalman filter's K H, from the covariances (k, 3, 3) before and after: (I - K H) S.
        """
        if self._settings.update in ("running_mean", "half"):
            return self._weight(rows)[:, :, None] * np.eye(3)
        extra = lacking(before)
        after = self._rows.covariances[rows] + extra
        return np.asarray(np.eye(3) - after @ inverse_spd3(before + extra))

    def _observed_positions(self, observed: Observations) -> tuple[FloatArray, FloatArray]:
        """World positions (k, 3) of single observations, and covariances (k, 3, 3)."""
        measurement, noise = observed.measurement, observed.covariance
        return placed(self._rig, self._current.wTc, measurement, noise, self._by_pose)

    def _grow(self, ids: IntArray) -> None:
        """Expands the ellipsoids of missed landmarks (type II, Se et al. 6.4)."""
        if len(ids):
            rows = self._rows.rows(ids)
            self._rows.covariances[rows] += _MISS_GROWTH_M**2 * np.eye(3)

    def _add(self, observed: Observations, frame: int) -> None:
        """Adds new landmarks (type IV) where this frame sees them."""
        if not len(observed):
            return
        positions, covariances = self._observed_positions(observed)
        self._rows.add(observed.ids, positions, covariances, frame)
        placed = PoseProblem(positions, covariances, observed.measurement, observed.covariance)
        self._errors.add(observed.ids, placed, self._current.wTc)
