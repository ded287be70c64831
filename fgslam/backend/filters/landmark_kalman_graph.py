"""The paper's estimator expressed as factor graphs, GTSAM doing the algebra.

Equal to :class:`~fgslam.backend.filters.landmark_kalman.LandmarkKalman` up to rounding: the pose
is that of a graph on fixed landmarks (Se et al. 3.3), each landmark that of its own graph (6.4).
Which edges of the full graph are missing, and what that costs, is derived in
docs/derivations/landmark_filter_as_graph.md.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import gtsam
import numpy as np

from fgslam.backend.filters.fixed_map_pose import FixedMapPose
from fgslam.backend.filters.landmark_elimination import Eliminated, LandmarkElimination, fused
from fgslam.backend.filters.landmark_kalman import LandmarkKalman
from fgslam.backend.filters.settings import LandmarkKalmanGraphSettings, LandmarkKalmanSettings
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import EgoMotion, EgoMotionStatus, Prediction, UpdateStats
from fgslam.core.geometry import transform_to_world, triangulate
from fgslam.core.measurements import Increment, MeasurementType, Observations
from fgslam.core.sensors import CameraRig, Sensor
from fgslam.factors.keys import landmark_key, pose_key
from fgslam.factors.noise import Whitening
from fgslam.factors.stereo import StereoFactors
from fgslam.frontend.settings import EgoMotionSettings

_POSE, _LANDMARK = pose_key(0), landmark_key(0)


class LandmarkKalmanGraph(LandmarkKalman):
    """Estimator of kind ``landmark_kalman_graph``; all but the updates is the closed form's."""

    kind: ClassVar[str] = "landmark_kalman_graph"
    supports: ClassVar[frozenset[MeasurementType]] = frozenset(
        {MeasurementType.ODOMETRY, MeasurementType.STEREO, MeasurementType.LOOP}
    )

    def __init__(
        self,
        rig: Sensor,
        settings: LandmarkKalmanGraphSettings,
        prior: Prediction,
        ego_motion: EgoMotionSettings,
    ) -> None:
        """Starts at the prior pose with an empty map.

        Args:
            rig: the cameras. Raises EstimatorError for another sensor.
            settings: which update, and its noise.
            prior: pose of the first frame and its covariance.
            ego_motion: the front-end's, whose cost the pose's graph repeats.
        """
        if not isinstance(rig, CameraRig):
            raise EstimatorError(
                "landmark_kalman_graph is built on stereo factors; for a range-bearing sensor use "
                "landmark_kalman"
            )
        closed_form = LandmarkKalmanSettings(
            update=settings.update,
            pose_covariance=settings.pose_covariance,
            miss_growth_m=settings.miss_growth_m,
            loops=settings.loops,
        )
        super().__init__(rig, closed_form, prior)
        self._pose_graph = FixedMapPose(rig, ego_motion)
        self._cameras = rig

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """As the closed form, with the frame's pose from its graph.

        Where the tracking found no minimum (first frame, too few matches, capped, no image), the
        pose is the tracking's.
        """
        _require_depth(increment, tracking.inliers, self._settings.update == "world")
        if tracking.status is EgoMotionStatus.OK and tracking.weighted_at is not None:
            matched = increment.observations.select(~increment.observations.is_new)
            found = self._pose_graph.solve(
                self.predict(increment.odometry),
                tracking.weighted_at,
                self.landmarks(),
                matched.select(tracking.inliers),
            )
            tracking = dataclasses.replace(tracking, wTc=found.wTc, covariance=found.covariance)
        return super().update(increment, tracking)

    # -- the landmarks' algebra, by elimination ------------------------------------------------

    def _pixel_update(self, rows: IntArray, observed: Observations) -> float:
        """Stereo factor and prior of each landmark, linearised at the landmark."""
        known = self._rows
        found = self._eliminated(known.positions[rows], known.covariances[rows], observed)
        return self._apply(rows, found)

    def _world_update(self, rows: IntArray, observed: Observations) -> float:
        """Two priors on each landmark: what was known, and the position observed."""
        positions, noise = self._observed_positions(observed)
        offsets = positions - self._rows.positions[rows]
        return self._apply(rows, fused(self._rows.covariances[rows], offsets, noise))

    def _observed_positions(self, observed: Observations) -> tuple[FloatArray, FloatArray]:
        """A stereo factor alone, eliminated where it is met exactly."""
        points = triangulate(self._cameras, observed.measurement)
        positions = transform_to_world(self._current.wTc, points)
        return positions, self._eliminated(positions, None, observed).covariances

    def _eliminated(
        self, positions: FloatArray, priors: FloatArray | None, observed: Observations
    ) -> Eliminated:
        by_pose = self._current.covariance if self._settings.pose_covariance else None
        factors = StereoFactors(self._cameras, Whitening())
        values = gtsam.Values()
        values.insert(_POSE, gtsam.Pose3(self._current.wTc))
        values.insert(_LANDMARK, np.zeros(3))
        linear = []
        for position, measured, noise in zip(
            positions, observed.measurement, observed.covariance, strict=True
        ):
            values.update(_LANDMARK, position)
            linear.append(factors.factor(_POSE, _LANDMARK, measured, noise).linearize(values))
        return LandmarkElimination(by_pose).observed(linear, priors)

    def _apply(self, rows: IntArray, found: Eliminated) -> float:
        self._rows.positions[rows] += found.steps
        self._rows.covariances[rows] = found.covariances
        return found.misfit


def _require_depth(increment: Increment, inliers: BoolArray, world: bool) -> None:
    """A factor of a point at infinity or behind constrains nothing: there is nothing to invert.

    Where observed positions are fused (``world``), this goes for matches, too.
    """
    seen = increment.observations
    placed = seen.is_new.copy()
    if world:
        placed[~seen.is_new] = inliers
    without = seen.ids[placed & (seen.measurement[:, 2] <= 0.0)]
    if len(without):
        raise EstimatorError(
            f"frame {increment.index}: landmark {without[0]} has no positive disparity; leave "
            "such observations out of the log"
        )
