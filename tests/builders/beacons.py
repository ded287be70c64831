"""A robot without cameras that measures beacons and its own position, by any models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import fgslam as fg
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse, pose, reorthonormalise, se3_exp, se3_log
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.types import Estimate
from fgslam.factors.measurement import LandmarkModel, MeasurementModel, PoseModel
from fgslam.factors.models import Height, Position, Range, RangeBearing

SENSOR = pose(np.eye(3), np.array([0.2, -0.1, 0.5]))
"""Where all sensors are on the body."""
ODOMETRY_SIGMA = np.array([0.005, 0.005, 0.005, 0.02, 0.02, 0.02])


class Direction(LandmarkModel):
    """A user's own, without derivatives and start: azimuth and elevation of a beacon."""

    kind, size, angles = "direction", 2, (0, 1)

    def predict(self, x: FloatArray) -> FloatArray:
        """(k, 2)."""
        elevation = np.arctan2(x[:, 2], np.hypot(x[:, 0], x[:, 1]))
        return np.column_stack([np.arctan2(x[:, 1], x[:, 0]), elevation])


class GuessedDirection(Direction):
    """The same with a start: some metres away."""

    kind = "guessed_direction"

    def start(self, z: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Four metres along the ray, give or take four."""
        flat = np.cos(z[:, 1])
        rays = np.stack([flat * np.cos(z[:, 0]), flat * np.sin(z[:, 0]), np.sin(z[:, 1])], axis=1)
        return 4.0 * rays, np.tile(16.0 * np.eye(3), (len(z), 1, 1))


class OffsetRange(Range):
    """Ranges that are all too long by an unknown offset."""

    kind = "offset_range"

    def __init__(self, bTs: FloatArray | None = None) -> None:
        """By a metre or so."""
        super().__init__(bTs, offset_sigma_m=1.0)


OFFSET_M = 0.7
SIGMA = {
    "range_bearing": (0.05, 0.02, 0.02),
    "range": (0.05,),
    "offset_range": (0.05,),
    "height": (0.05,),
    "position": (0.05, 0.05, 0.05),
    "direction": (0.02, 0.02),
    "guessed_direction": (0.02, 0.02),
}
"""Deviations of the measurements, metres and radians."""
MODELS: dict[str, MeasurementModel] = {
    one.kind: one(SENSOR)
    for one in (RangeBearing, Range, OffsetRange, Height, Position, Direction, GuessedDirection)
}


@dataclass(frozen=True)
class Beacons:
    """A log, true poses of the body (n, 4, 4), true places of the beacons (m, 3) by identity."""

    log: fg.MeasurementLog
    poses: FloatArray
    points: FloatArray

    def errors(self, estimate: Estimate) -> FloatArray:
        """(n, 6) of the poses, [rotation, translation]."""
        pairs = zip(estimate.trajectory.poses, self.poses, strict=True)
        return np.array([se3_log(inverse(found) @ true) for found, true in pairs])

    def ate(self, estimate: Estimate) -> float:
        """Root mean square of the positions' errors, metres; both begin in the origin."""
        return float(np.sqrt((self.errors(estimate)[:, 3:] ** 2).sum(axis=1).mean()))

    def nees(self, estimate: Estimate) -> float:
        """Of the poses, a degree of freedom; the first one is given."""
        pairs = zip(self.errors(estimate)[1:], estimate.covariances[1:], strict=True)
        return float(np.mean([e @ np.linalg.solve(c, e) for e, c in pairs])) / 6.0


def drive(kinds: Sequence[str], seed: int = 0, frames: int = 30, beacons: int = 8) -> Beacons:
    """Once around, up and down, among beacons; noise is as the covariances state."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3.0, -3.0, -1.5], [3.0, 5.0, 1.5], (beacons, 3))
    poses, log = [np.eye(4)], fg.MeasurementLog()
    for k in range(frames):
        odometry = None
        if k:
            turn = [0.08 * np.cos(k / 3), 0.1 * np.sin(k / 4), 2.0 * np.pi / frames]
            step = se3_exp(np.array([*turn, 0.3, 0.0, 0.1 * np.sin(k / 5)]))
            poses.append(reorthonormalise(poses[-1] @ step))
            noisy = step @ se3_exp(ODOMETRY_SIGMA * rng.standard_normal(6))
            odometry = Odometry(noisy, np.diag(ODOMETRY_SIGMA**2))
        wTs, measured = poses[-1] @ SENSOR, []
        for kind in kinds:
            model, sigma = MODELS[kind], np.array(SIGMA[kind])
            of_pose = isinstance(model, PoseModel)
            exact = model.predict(wTs[None] if of_pose else (points - wTs[:3, 3]) @ wTs[:3, :3])
            values = exact + sigma * rng.standard_normal(exact.shape)
            values += OFFSET_M * (kind == "offset_range")
            ids = () if of_pose else np.arange(beacons)
            measured.append(model.measured(values, np.diag(sigma**2), ids))
        log.append(Increment.of(k, 0.1 * k, odometry, measured))
    return Beacons(log, np.array(poses), points)
