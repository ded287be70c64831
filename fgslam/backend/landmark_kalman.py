"""The paper's estimator: least-squares pose, one 3x3 Kalman filter per landmark.

Se, Lowe and Little (2001), Sections 4.1 (averaging) and 6.4 (Kalman filters). The pose is that of
the least squares against the landmarks (3.3); past poses are never revised, so the final
trajectory is the online one. Correlations between landmarks, and between landmarks and pose,
are dropped: that is what makes the filter cheap, and overconfident.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fgslam.backend.filtered import FilteredTrajectory, moved
from fgslam.geometry import (
    block_diagonal,
    congruence,
    inverse_spd3,
    measurement_difference,
    point_pose_jacobian,
    project,
    projection_jacobian,
    transform_to_camera,
    transform_to_world,
    triangulate,
    triangulation_covariance,
)
from fgslam.settings.backend import LandmarkKalmanSettings
from fgslam.types import (
    EgoMotion,
    Estimate,
    FloatArray,
    Increment,
    IntArray,
    LandmarkMap,
    MeasurementType,
    Observations,
    Odometry,
    Prediction,
    Sensor,
    StateArrays,
    UpdateStats,
)


class LandmarkKalman:
    """Estimator of kind ``landmark_kalman``, on :class:`fgslam.backend.protocol.Estimator`."""

    kind: ClassVar[str] = "landmark_kalman"
    supports: ClassVar[frozenset[MeasurementType]] = frozenset(
        {MeasurementType.ODOMETRY, MeasurementType.STEREO, MeasurementType.RANGE_BEARING}
    )

    def __init__(self, rig: Sensor, settings: LandmarkKalmanSettings, prior: Prediction) -> None:
        """Starts at the prior pose with an empty map.

        Args:
            rig: the cameras, or the range-bearing sensor.
            settings: which update, and its noise.
            prior: pose of the first frame and its covariance.
        """
        self._rig = rig
        self._settings = settings
        self._current = prior
        self._past = FilteredTrajectory()
        self._ids: IntArray = np.empty(0, np.int64)
        self._positions: FloatArray = np.empty((0, 3))
        self._covariances: FloatArray = np.empty((0, 3, 3))
        self._counts: IntArray = np.empty(0, np.int64)

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose after the camera moved by ``odometry``."""
        return moved(self._current, odometry)

    def landmarks(self) -> LandmarkMap:
        """Current landmarks; the arrays are read only by agreement."""
        return LandmarkMap(self._ids, self._positions, self._covariances)

    def update(
        self, increment: Increment, tracking: EgoMotion, motion: Odometry | None = None
    ) -> UpdateStats:
        """Pose from the tracking; matched landmarks filtered, missed ones grown, new ones added."""
        self._past.require_later(increment)
        self._current = Prediction(tracking.wTc, tracking.covariance)
        matched = increment.observations.select(~increment.observations.is_new)
        nis, dof = self._update_matched(matched.select(tracking.inliers))
        self._grow(increment.missed_ids)
        self._add(increment.observations.select(increment.observations.is_new))
        self._remove(increment.pruned_ids)
        self._past.append(increment.timestamp, self._current)
        return UpdateStats(tracking.wTc, tracking.covariance, len(self._ids), nis, dof)

    def correct(self, current: Prediction, ids: IntArray, positions: FloatArray) -> None:
        """Takes over a smoother's last pose and landmark positions (k, 3), between two frames.

        For a filter that tracks on a smoothed map; covariances of the landmarks stay, as they
        stand for what is known of them given the poses.
        """
        self._current = current
        self._positions[self.landmarks().rows(ids)] = positions

    def restart(self, observed: Observations) -> None:
        """Starts known landmarks anew from one observation each: they have moved."""
        if len(observed):
            self._remove(observed.ids)
            self._add(observed)

    def estimate(self) -> Estimate:
        """Trajectory as filtered, and the map."""
        return Estimate(
            self._past.trajectory(),
            self._past.pose_covariances(),
            LandmarkMap(self._ids, self._positions.copy(), self._covariances.copy()),
        )

    def landmark_covariances(self, ids: IntArray) -> FloatArray:
        """Covariances (k, 3, 3) of the named landmarks."""
        return self._covariances[self.landmarks().rows(ids)]

    def joint_covariance(self, ids: IntArray) -> FloatArray:
        """Pose and landmarks as the filter sees them: independent (6.4)."""
        return block_diagonal(self._current.covariance, self.landmark_covariances(ids))

    def state(self) -> StateArrays:
        """Everything needed to continue; a snapshot, which later updates leave alone."""
        return self._past.state() | {
            "current_pose": self._current.wTc,
            "current_covariance": self._current.covariance,
            "ids": self._ids,
            "positions": self._positions.copy(),
            "covariances": self._covariances.copy(),
            "counts": self._counts.copy(),
        }

    def restore(self, state: StateArrays) -> None:
        """Continues from :meth:`state`."""
        self._past = FilteredTrajectory.restored(state)
        self._current = Prediction(state["current_pose"], state["current_covariance"])
        self._ids = state["ids"]
        self._positions = state["positions"].copy()
        self._covariances = state["covariances"].copy()
        self._counts = state["counts"].copy()

    # ----------------------------------------------------------------------------------------

    def _update_matched(self, observed: Observations) -> tuple[float, int]:
        """Type III landmarks, all at once; returns the innovation squared and its freedom."""
        if not len(observed):
            return float("nan"), 0
        rows = self.landmarks().rows(observed.ids)
        if self._settings.update == "pixel":
            nis = self._pixel_update(rows, observed)
        elif self._settings.update == "world":
            nis = self._world_update(rows, observed)
        else:
            nis = self._average(rows, observed)
        self._counts[rows] += 1
        return nis, 3 * len(rows)

    def _pixel_update(self, rows: IntArray, observed: Observations) -> float:
        """Kalman update on the measurement itself, linearised at the landmark, Joseph form."""
        wTc = self._current.wTc
        points = transform_to_camera(wTc, self._positions[rows])
        jacobian = projection_jacobian(self._rig, points)
        noise = observed.covariance
        if self._settings.pose_covariance:
            by_pose = jacobian @ point_pose_jacobian(points)
            noise = noise + congruence(by_pose, self._current.covariance)
        expected = project(self._rig, points)
        innovation = measurement_difference(self._rig, observed.measurement, expected)
        return self._kalman(rows, jacobian @ wTc[:3, :3].T, innovation, noise)

    def _world_update(self, rows: IntArray, observed: Observations) -> float:
        """Kalman fusion of the observed 3-D position with the landmark's (6.4)."""
        positions, noise = self._observed_positions(observed)
        identity = np.broadcast_to(np.eye(3), noise.shape)
        return self._kalman(rows, identity, positions - self._positions[rows], noise)

    def _kalman(
        self, rows: IntArray, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
    ) -> float:
        before = self._covariances[rows]
        precision = inverse_spd3(congruence(jacobian, before) + noise)
        gain = before @ np.swapaxes(jacobian, 1, 2) @ precision
        self._positions[rows] += np.einsum("kij,kj->ki", gain, innovation)
        keep = np.eye(3) - gain @ jacobian
        self._covariances[rows] = congruence(keep, before) + congruence(gain, noise)
        return float(np.einsum("ki,kij,kj->", innovation, precision, innovation))

    def _average(self, rows: IntArray, observed: Observations) -> float:
        """Averaging of 4.1: a running mean, or half old and half new (design E-S4)."""
        positions, noise = self._observed_positions(observed)
        before = self._positions[rows]
        innovation = positions - before
        precision = inverse_spd3(self._covariances[rows] + noise)
        if self._settings.update == "half":
            weight = np.full((len(rows), 1), 0.5)
        else:
            weight = 1.0 / (self._counts[rows, None] + 1.0)
        self._positions[rows] = before + weight * innovation
        squared = (weight**2)[:, :, None]
        kept = ((1.0 - weight) ** 2)[:, :, None]
        self._covariances[rows] = kept * self._covariances[rows] + squared * noise
        return float(np.einsum("ki,kij,kj->", innovation, precision, innovation))

    def _observed_positions(self, observed: Observations) -> tuple[FloatArray, FloatArray]:
        """World positions (k, 3) of single observations, and covariances (k, 3, 3)."""
        wTc = self._current.wTc
        points = triangulate(self._rig, observed.measurement)
        local = triangulation_covariance(self._rig, observed.measurement, observed.covariance)
        if self._settings.pose_covariance:
            local = local + congruence(point_pose_jacobian(points), self._current.covariance)
        return transform_to_world(wTc, points), congruence(wTc[:3, :3], local)

    def _grow(self, ids: IntArray) -> None:
        """Type II landmarks: the ellipsoid expands (6.4)."""
        if len(ids):
            rows = self.landmarks().rows(ids)
            self._covariances[rows] += self._settings.miss_growth_m**2 * np.eye(3)

    def _add(self, observed: Observations) -> None:
        """Type IV landmarks."""
        if not len(observed):
            return
        positions, covariances = self._observed_positions(observed)
        self._ids = np.concatenate([self._ids, observed.ids])
        self._positions = np.concatenate([self._positions, positions])
        self._covariances = np.concatenate([self._covariances, covariances])
        self._counts = np.concatenate([self._counts, np.ones(len(observed), np.int64)])
        if not (np.diff(self._ids) > 0).all():
            self._select(np.argsort(self._ids, kind="stable"))

    def _remove(self, ids: IntArray) -> None:
        if not len(ids):
            return
        keep = np.ones(len(self._ids), np.bool_)
        keep[self.landmarks().rows(ids)] = False
        self._select(np.flatnonzero(keep))

    def _select(self, rows: IntArray) -> None:
        self._ids = self._ids[rows]
        self._positions = self._positions[rows]
        self._covariances = self._covariances[rows]
        self._counts = self._counts[rows]
