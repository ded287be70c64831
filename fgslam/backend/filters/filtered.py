"""What estimators share: checks of a frame, filtered trajectories, places of one observation."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    compose_covariance,
    congruence,
    in_front,
    point_pose_jacobian,
    transform_to_world,
)
from fgslam.core.sensors import CameraRig, Increment, Observations, Odometry
from fgslam.core.types import EgoMotion, Prediction, Trajectory


@dataclass(slots=True, eq=False)
class FilteredTrajectory:
    """Poses ``wTc`` and their covariances, one a frame, as they were when their frame came."""

    timestamps: list[float] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)
    covariances: list[FloatArray] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.timestamps)

    def append(self, timestamp: float, current: Prediction) -> None:
        """Adds the frame just processed."""
        self.timestamps.append(timestamp)
        self.poses.append(current.wTc)
        self.covariances.append(current.covariance)

    def require_later(self, increment: Increment) -> None:
        """Raises EstimatorError where time does not increase."""
        if self.timestamps and not increment.timestamp > self.timestamps[-1]:
            raise EstimatorError(
                f"frame {increment.index}: time stamp {increment.timestamp:.9f} s does not come "
                f"after {self.timestamps[-1]:.9f} s; sort the measurements by time"
            )

    def require_step(self, increment: Increment) -> None:
        """Raises EstimatorError where time does not increase, or a later frame has no odometry."""
        self.require_later(increment)
        if increment.odometry is None and self.timestamps:
            raise EstimatorError(
                f"frame {increment.index}: neither odometry nor a stand-in states how the camera "
                "moved; put the motion model's step into the increment"
            )

    def trajectory(self) -> Trajectory:
        """All poses."""
        poses = np.array(self.poses).reshape(-1, 4, 4)
        return Trajectory(np.array(self.timestamps, np.float64), poses)

    def pose_covariances(self) -> FloatArray:
        """(n, 6, 6) of all poses."""
        return np.array(self.covariances).reshape(-1, 6, 6)


def require_finite(increment: Increment, tracking: EgoMotion | None = None) -> None:
    """Refuses numbers that are not finite: in a solver one of them would spoil all others.

    Args:
        increment: of a frame.
        tracking: of the same frame, where the estimator uses it.

    Raises:
        EstimatorError: which kind of number, and in which frame.
    """
    observed, motion = increment.observations, increment.odometry
    given = {
        "measurement": [observed.measurement, observed.covariance],
        "motion": [] if motion is None else [motion.motion, motion.covariance],
        "tracked pose": [] if tracking is None else [tracking.wTc, tracking.covariance],
    }
    for what, arrays in given.items():
        if not all(np.isfinite(array).all() for array in arrays):
            raise EstimatorError(
                f"frame {increment.index}: the {what} or its covariance is not finite; "
                "look at that frame with fgslam inspect"
            )


def moved(current: Prediction, odometry: Odometry | None) -> Prediction:
    """The pose after the camera moved by ``odometry``; the same one for None."""
    if odometry is None:
        return current
    return Prediction(
        current.wTc @ odometry.motion,
        compose_covariance(odometry.motion, current.covariance, odometry.covariance),
    )


def placed(
    sensor: CameraRig,
    wTc: FloatArray,
    measurement: FloatArray,
    covariance: FloatArray,
    pose_covariance: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """World positions (k, 3) of single observations, and covariances (k, 3, 3).

    Args:
        sensor: that observed.
        wTc: (4, 4) its pose.
        measurement: (k, 3).
        covariance: (k, 3, 3) of the measurements.
        pose_covariance: (6, 6); None takes the pose as exact.
    """
    points = sensor.triangulate(measurement)
    local = sensor.triangulation_covariance(measurement, covariance)
    if pose_covariance is not None:
        local = local + congruence(point_pose_jacobian(points), pose_covariance)
    return transform_to_world(wTc, points), congruence(wTc[:3, :3], local)


def triangulated(
    rig: CameraRig, observed: Observations
) -> tuple[Observations, FloatArray, FloatArray]:
    """Those observations that fix a point before the camera, and the points with covariances.

    Points (k, 3) in the camera's frame and covariances (k, 3, 3), the camera's pose taken as exact.
    """
    finite = np.isfinite(observed.measurement).all(axis=1)
    disparity = np.where(finite, observed.measurement[:, 2], 0.0)
    # Far below any disparity that a camera can tell from zero, far above one that overflows.
    observed = observed.select(disparity > 1e-6)
    points = rig.triangulate(observed.measurement)
    kept = in_front(points)
    observed, points = observed.select(kept), points[kept]
    covariances = rig.triangulation_covariance(observed.measurement, observed.covariance)
    return observed, points, covariances
