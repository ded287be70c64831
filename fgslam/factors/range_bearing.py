"""Range-bearing factors: azimuth, elevation and range of a landmark from a pose of the sensor."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.factors.noise import Whitening
from fgslam.types import FloatArray


class RangeBearingFactors:
    """Makes C++ bearing-range factors in three dimensions.

    GTSAM's bearing is a unit vector whose two tangent directions are its own choice, so the
    covariance of (azimuth, elevation) is turned into them.
    """

    def __init__(self, whitening: Whitening) -> None:
        """The noise models, robust or not."""
        self._whitening = whitening

    def factor(
        self, pose: int, landmark: int, measurement: FloatArray, covariance: FloatArray
    ) -> Any:
        """Factor between a pose of the sensor (axes as a camera's) and a world point.

        Args:
            pose: its key.
            landmark: its key.
            measurement: (3,) azimuth and elevation in radians, range in metres.
            covariance: (3, 3) of it.
        """
        azimuth, elevation, distance = measurement.tolist()
        sin_a, cos_a = np.sin(azimuth), np.cos(azimuth)
        sin_e, cos_e = np.sin(elevation), np.cos(elevation)
        bearing = gtsam.Unit3(np.array([sin_a * cos_e, -sin_e, cos_a * cos_e]))
        by_azimuth = [cos_a * cos_e, 0.0, -sin_a * cos_e]
        by_elevation = [-sin_a * sin_e, -cos_e, -cos_a * sin_e]
        jacobian = np.eye(3)
        jacobian[:2, :2] = bearing.basis().T @ np.array([by_azimuth, by_elevation]).T
        model = self._whitening.model(jacobian @ covariance @ jacobian.T)
        return gtsam.BearingRangeFactor3D(pose, landmark, bearing, distance, model)
