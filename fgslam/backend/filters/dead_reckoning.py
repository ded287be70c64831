"""Dead reckoning: the odometry as it is, the baseline of every comparison.

No measurement of a landmark ever moves a pose. Landmarks stand where they were first seen from,
with the uncertainty of that pose and of that one observation.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fgslam.backend.filters.filtered import FilteredTrajectory, moved, placed, triangulated
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.geometry import (
    adjoint,
    inverse,
    motion_covariance,
    point_pose_jacobian,
    reorthonormalise,
    transform_to_camera,
)
from fgslam.core.sensors import CameraRig, Increment, MeasurementType, Observations, Odometry
from fgslam.core.store import Kept
from fgslam.core.types import (
    LAGS,
    NO_LANDMARKS,
    EgoMotion,
    Estimate,
    LandmarkMap,
    Prediction,
    UpdateStats,
)


class DeadReckoning:
    """Estimator of kind ``odometry``, on :class:`fgslam.backend.protocol.Estimator`."""

    kind: ClassVar[str] = "odometry"
    supports: ClassVar[frozenset[MeasurementType]] = frozenset(MeasurementType)
    _current: Kept[Prediction]
    _past: Kept[FilteredTrajectory]
    _map: Kept[LandmarkMap]
    _first_frame: Kept[IntArray]

    def __init__(self, sensor: CameraRig, prior: Prediction) -> None:
        """Starts at the prior: pose of the first frame and its covariance."""
        self._sensor = sensor
        self._current = prior
        self._past = FilteredTrajectory()
        self._map = NO_LANDMARKS
        self._first_frame = np.empty(0, np.int64)

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose after the camera moved by ``odometry``."""
        return moved(self._current, odometry)

    def landmarks(self) -> LandmarkMap:
        """Landmarks as first seen; the arrays are read only by agreement."""
        return self._map

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Moves on by the odometry, or the stand-in; tracking, matches and loops change nothing."""
        self._past.require_step(increment)
        predicted = self.predict(increment.odometry)
        self._current = Prediction(reorthonormalise(predicted.wTc), predicted.covariance)
        self._add(increment.observations.select(increment.observations.is_new))
        self._remove(increment.pruned_ids)
        self._past.append(increment.timestamp, self._current)
        wTc, covariance = self._current.wTc, self._current.covariance
        closed = (False,) * len(increment.loops)
        return UpdateStats(wTc, covariance, len(self._map), float("nan"), 0, closed)

    def estimate(self) -> Estimate:
        """Trajectory as predicted, and the map."""
        path, covariances = self._past.trajectory(), self._past.pose_covariances()
        relative = {}
        for lag in LAGS:
            motion = inverse(path.poses[:-lag]) @ path.poses[lag:]
            inherited = covariances[:-lag] @ np.swapaxes(adjoint(inverse(motion)), 1, 2)
            both = covariances[:-lag], covariances[lag:]
            relative[lag] = motion_covariance(motion, *both, inherited)
        return Estimate(path, covariances, self._map, relative=relative)

    def landmark_covariances(self, ids: IntArray) -> FloatArray:
        """Covariances (k, 3, 3) of the named landmarks."""
        return self._map.covariances[self._map.rows(ids)]

    def joint_covariance(self, ids: IntArray) -> FloatArray:
        """Joint covariance of the last pose and landmarks (6 + 3k, 6 + 3k), exact to first order.

        An early pose's error is part of all that came after it.
        """
        rows = self._map.rows(ids)
        frames = [*self._first_frame[rows].tolist(), len(self._past) - 1]
        jacobians = [*self._by_pose(rows), np.eye(6)]
        start = np.cumsum([6, *[3] * len(rows)])
        at = [slice(s, s + 3) for s in start[:-1]] + [slice(0, 6)]
        out = np.zeros((start[-1], start[-1]))
        for i, a in enumerate(at):
            for j, b in enumerate(at):
                early, late = sorted((i, j), key=lambda k: frames[k])
                cross = self._between_poses(frames[early], frames[late])
                block = jacobians[early] @ cross @ jacobians[late].T
                out[a, b] = block if i == early else block.T
        for a, row in zip(at, rows.tolist(), strict=False):
            out[a, a] = self._map.covariances[row]
        return np.asarray(0.5 * (out + out.T))

    # ----------------------------------------------------------------------------------------

    def _add(self, observed: Observations) -> None:
        """Adds new landmarks (type IV): their own noise and the pose's, at this frame."""
        observed = triangulated(self._sensor, observed)[0]
        wTc, covariance = self._current.wTc, self._current.covariance
        new, around = placed(
            self._sensor, wTc, observed.measurement, observed.covariance, covariance
        )
        ids = np.concatenate([self._map.ids, observed.ids])
        positions = np.concatenate([self._map.positions, new])
        covariances = np.concatenate([self._map.covariances, around])
        frames = np.concatenate([self._first_frame, np.full(len(new), len(self._past))])
        order = np.argsort(ids, kind="stable")
        self._map = LandmarkMap(ids[order], positions[order], covariances[order])
        self._first_frame = frames[order]

    def _remove(self, ids: IntArray) -> None:
        keep = ~np.isin(self._map.ids, ids)
        self._map = self._map.select(keep)
        self._first_frame = self._first_frame[keep]

    def _by_pose(self, rows: IntArray) -> list[FloatArray]:
        """d(landmark)/d(tangent of the pose that it was first seen from), each (3, 6)."""
        out = []
        for row in rows.tolist():
            wTc = self._past.poses[self._first_frame[row]]
            local = transform_to_camera(wTc, self._map.positions[[row]])
            out.append(-wTc[:3, :3] @ point_pose_jacobian(local)[0])
        return out

    def _between_poses(self, early: int, late: int) -> FloatArray:
        """Cross-covariance (6, 6) of two poses of the trajectory: what the later inherits."""
        if late < 0:
            return self._current.covariance
        onward = adjoint(inverse(self._past.poses[late]) @ self._past.poses[early])
        return np.asarray(self._past.covariances[early] @ onward.T)
