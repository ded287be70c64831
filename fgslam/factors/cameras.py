"""Raw pixels of three cameras: a stereo factor of right and left, and the top camera's own factor.

The front-end's fused (column, row, disparity) is the least-squares summary of the six raw
coordinates, and they are linear in it; so one stereo factor with its full covariance carries
exactly the information of these two. This module is the same measurement taken apart: for raw
pixels whose noise is not the front-end's, and as a check on the fusion.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import CameraRig
from fgslam.factors.noise import Whitening


class RawPixelFactors:
    """Makes the factors of single images, each coordinate with the same independent noise."""

    def __init__(self, rig: CameraRig, pixel_sigma: float, whitening: Whitening) -> None:
        """``pixel_sigma``: standard deviation of every coordinate, pixels."""
        self._stereo = gtsam.Cal3_S2Stereo(rig.fx, rig.fy, 0.0, rig.cx, rig.cy, rig.baseline)
        self._pinhole = gtsam.Cal3_S2(rig.fx, rig.fy, 0.0, rig.cx, rig.cy)
        self._rTl = gtsam.Pose3(gtsam.Rot3(), np.array([-rig.baseline, 0.0, 0.0]))
        height = rig.vertical_baseline or 0.0
        self._rTt = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, -height, 0.0]))
        variance = pixel_sigma**2
        # Both rows measure the same v: their mean has half the variance.
        self._pair_model = whitening.model(variance * np.diag([1.0, 1.0, 0.5]))
        self._top_model = whitening.model(variance * np.eye(2))

    def pair(self, pose: int, landmark: int, right: FloatArray, left: FloatArray) -> Any:
        """Stereo factor of the right and left pixel (2,) each; the mean row is the measured one."""
        row = 0.5 * float(right[1] + left[1])
        measured = gtsam.StereoPoint2(float(left[0]), float(right[0]), row)
        return gtsam.GenericStereoFactor3D(
            measured, self._pair_model, pose, landmark, self._stereo, False, False, self._rTl
        )

    def top(self, pose: int, landmark: int, pixel: FloatArray) -> Any:
        """Projection factor of the top camera's pixel (2,); the pose is the right camera's."""
        return gtsam.GenericProjectionFactorCal3_S2(
            pixel, self._top_model, pose, landmark, self._pinhole, False, False, self._rTt
        )
