"""Dead reckoning: the odometry as it is, the baseline of every comparison.

No measurement of a landmark ever moves a pose. Landmarks stand where they were first seen from,
with the uncertainty of that pose and of that one observation.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from fgslam.backend.filters.filtered import FilteredTrajectory, moved, placed, triangulated
from fgslam.core.arrays import IntArray
from fgslam.core.geometry import (
    adjoint,
    inverse,
    motion_covariance,
    reorthonormalise,
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

    def __init__(self, sensor: CameraRig, prior: Prediction) -> None:
        """Starts at the prior: pose of the first frame and its covariance."""
        self._sensor = sensor
        self._current = prior
        self._past = FilteredTrajectory()
        self._map = NO_LANDMARKS

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
        order = np.argsort(ids, kind="stable")
        self._map = LandmarkMap(ids[order], positions[order], covariances[order])

    def _remove(self, ids: IntArray) -> None:
        keep = ~np.isin(self._map.ids, ids)
        self._map = self._map.select(keep)
