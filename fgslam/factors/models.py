"""Measurement models that come with the package, besides the camera rig."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.factors.measurement import LandmarkModel, MeasurementModel, PoseModel

_NEAREST_M = 1e-6


class RangeBearing(LandmarkModel):
    """Distance (m), azimuth to the left and elevation (rad) of a landmark; x ahead, z up."""

    kind, size, angles = "range_bearing", 3, (1, 2)

    def predict(self, x: FloatArray) -> FloatArray:
        """(k, 3)."""
        distance, across = np.linalg.norm(x, axis=1), np.hypot(x[:, 0], x[:, 1])
        return np.column_stack(
            [distance, np.arctan2(x[:, 1], x[:, 0]), np.arctan2(x[:, 2], across)]
        )

    def start(self, z: FloatArray, covariance: FloatArray) -> tuple[FloatArray, None]:
        """One measurement fixes the point."""
        distance, azimuth, elevation = z.T
        across = distance * np.cos(elevation)
        ahead, left = across * np.cos(azimuth), across * np.sin(azimuth)
        return np.column_stack([ahead, left, distance * np.sin(elevation)]), None


class Range(LandmarkModel):
    """Distance of a landmark, metres, as a radio beacon gives it: it begins when several meet."""

    kind, size = "range", 1

    def __init__(
        self, bTs: FloatArray | None = None, offset_sigma_m: float = 0.0, scale_sigma: float = 0.0
    ) -> None:
        """Of a sensor on the body; with an unknown offset and scale of so much, to be estimated."""
        super().__init__(bTs)
        sigmas = np.array([offset_sigma_m, scale_sigma])
        self._unknown = sigmas > 0.0
        self.nuisance = np.diag(sigmas[self._unknown] ** 2)

    def shifts(self, z: FloatArray) -> FloatArray:
        """(k, 1, q) by the offset, and by the scale."""
        return np.stack([np.ones_like(z), z], axis=2)[:, :, self._unknown]

    def predict(self, x: FloatArray) -> FloatArray:
        """(k, 1); at the sensor itself a distance has no direction."""
        distance = np.linalg.norm(x, axis=1, keepdims=True)
        return np.where(distance > _NEAREST_M, distance, np.nan)

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(k, 1, 3) unit vectors to the landmarks."""
        return np.asarray(x / np.linalg.norm(x, axis=1, keepdims=True))[:, None]

    def factor(self, keys: list[int], z: FloatArray, noise: Any, xTs: FloatArray) -> Any:
        """GTSAM's."""
        return gtsam.RangeFactorWithTransform3D(keys[0], keys[1], z[0], noise, gtsam.Pose3(xTs))


class Height(LandmarkModel):
    """Height of a landmark over the sensor, metres: 0 and stiff in a plane world."""

    kind, size = "height", 1

    def predict(self, x: FloatArray) -> FloatArray:
        """(k, 1)."""
        return x[:, 2:].copy()


class Position(PoseModel):
    """Where in the world an antenna is, metres; ``bTs`` has its lever arm."""

    kind, size = "position", 3

    def predict(self, x: FloatArray) -> FloatArray:
        """(k, 3)."""
        return x[:, :3, 3].copy()

    def factor(self, keys: list[int], z: FloatArray, noise: Any, xTs: FloatArray) -> Any:
        """GTSAM's, for GPS."""
        return gtsam.GPSFactorArm(keys[0], z, xTs[:3, 3], noise)


MODELS: dict[str, type[MeasurementModel]] = {
    one.kind: one for one in (RangeBearing, Range, Height, Position)
}
"""By kind."""
