"""Landmark observations by stereo or trinocular cameras: GTSAM's factor of one, and many in arrays.

Derivation: docs/derivations/measurements.md.
"""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.sensors import CameraRig
from fgslam.factors.measurement import LinearRows
from fgslam.factors.noise import Whitening

FROM_MEASUREMENT: FloatArray = np.array([[1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""(u_left, u_right, v) of (column, row, disparity)."""


class StereoFactors:
    """Makes C++ stereo factors of one rig, of observations (column, row, disparity).

    The paper's reference is the right camera, GTSAM's stereo camera the left one. The pose variable
    stays the right camera's; the left one sits ``baseline`` along its -x axis and is given to the
    factor as the sensor's place on the body. GTSAM measures (u_left, u_right, v), which is linear
    in ours: ``u_left = c + d, u_right = c, v = r``; its covariance follows exactly.

    A landmark behind the camera has a constant residual and no Jacobian, as GTSAM has it:
    graph builders keep such landmarks out.
    """

    def __init__(self, rig: CameraRig, whitening: Whitening) -> None:
        """The rig and the noise models, robust or not."""
        self._whitening = whitening
        self._calibration = gtsam.Cal3_S2Stereo(rig.fx, rig.fy, 0.0, rig.cx, rig.cy, rig.baseline)
        self._rTl = gtsam.Pose3(gtsam.Rot3(), np.array([-rig.baseline, 0.0, 0.0]))

    def factor(
        self, pose: int, landmark: int, measurement: FloatArray, covariance: FloatArray
    ) -> Any:
        """Factor between a pose ``wTc`` of the reference camera and a world point.

        Args:
            pose: its key.
            landmark: its key.
            measurement: (3,) column, row, disparity, pixels.
            covariance: (3, 3) of it, pixels squared.
        """
        model = self._whitening.model(covariance, FROM_MEASUREMENT)
        return self.with_model(pose, landmark, measurement, model)

    def graph(
        self, poses: IntArray, landmarks: IntArray, measured: FloatArray, covariances: FloatArray
    ) -> Any:
        """Factors of k observations, in their order; arguments as those of :meth:`factor`."""
        out = gtsam.NonlinearFactorGraph()
        models = map(self._whitening.model, FROM_MEASUREMENT @ covariances @ FROM_MEASUREMENT.T)
        keys = poses.tolist(), landmarks.tolist()
        for pose, landmark, measurement, model in zip(*keys, measured, models, strict=True):
            out.add(self.with_model(pose, landmark, measurement, model))
        return out

    def with_model(self, pose: int, landmark: int, measurement: FloatArray, model: Any) -> Any:
        """The same with a noise model of (u_left, u_right, v)."""
        column, row, disparity = measurement.tolist()
        measured = gtsam.StereoPoint2(column + disparity, column, row)
        return gtsam.GenericStereoFactor3D(
            measured, model, pose, landmark, self._calibration, False, False, self._rTl
        )


# --------------------------------------------------------------------------------------------
# Many observations at once, for solvers that eliminate landmarks themselves


def weighed(rows: LinearRows, weight: FloatArray) -> LinearRows:
    """The rows with weights (k,) of their squares."""
    root = np.sqrt(weight)[:, None]
    by_pose, by_point = (root[:, :, None] * by for by in (rows.by_pose, rows.by_point))
    return LinearRows(root * rows.residual, by_pose, by_point, rows.usable)


def summed(index: IntArray, values: FloatArray, size: int) -> FloatArray:
    """(size, ...) sums of values (k, ...) by their index (k,)."""
    shape = values.shape[1:]
    flat = values.reshape(len(values), math.prod(shape))
    out = np.empty((size, flat.shape[1]))
    for column in range(flat.shape[1]):
        out[:, column] = np.bincount(index, flat[:, column], size)
    return out.reshape(size, *shape)
