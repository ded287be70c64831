"""Landmark observations by stereo or trinocular cameras: GTSAM's factor of one, and many in arrays.

Derivation: docs/derivations/measurements.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows
from fgslam.core.geometry import in_front, skew
from fgslam.core.sensors import CameraRig
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

    def with_model(self, pose: int, landmark: int, measurement: FloatArray, model: Any) -> Any:
        """The same with a noise model of (u_left, u_right, v)."""
        column, row, disparity = measurement.tolist()
        measured = gtsam.StereoPoint2(column + disparity, column, row)
        return gtsam.GenericStereoFactor3D(
            measured, model, pose, landmark, self._calibration, False, False, self._rTl
        )


# --------------------------------------------------------------------------------------------
# Many observations at once, for solvers that eliminate landmarks themselves.
#
# One of a point behind the camera pulls nothing and costs as much as GTSAM's factor then does.


@dataclass(frozen=True, slots=True, eq=False)
class LinearRows(Rows):
    """Linearised observations, whitened and weighed: ``residual + by_pose dx + by_point dl``.

    Attributes:
        residual: (k, 3).
        by_pose: (k, 3, 6) by the tangent of ``wTc``.
        by_point: (k, 3, 3) by the world point.
    """

    residual: FloatArray
    by_pose: FloatArray
    by_point: FloatArray


def whitening(covariances: FloatArray) -> FloatArray:
    """(k, 3, 3) that turn residuals of covariances (k, 3, 3) into ones of unit covariance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))


def in_cameras(poses: FloatArray, points: FloatArray) -> FloatArray:
    """World points (k, 3) in the frames of poses ``wTc`` (k, 4, 4), one each."""
    offset = points - poses[:, :3, 3]
    return np.asarray(np.einsum("kji,kj->ki", poses[:, :3, :3], offset))


def residuals(
    rig: CameraRig,
    poses: FloatArray,
    points: FloatArray,
    measurement: FloatArray,
    roots: FloatArray,
) -> FloatArray:
    """Whitened residuals (k, 3), predicted minus measured; arguments of :func:`linearised`."""
    return products(roots, _off(rig, in_cameras(poses, points), measurement)[0])


def linearised(
    rig: CameraRig,
    poses: FloatArray,
    points: FloatArray,
    measurement: FloatArray,
    roots: FloatArray,
) -> LinearRows:
    """Whitened observations, predicted minus measured.

    Args:
        rig: the cameras.
        poses: (k, 4, 4) ``wTc`` of each observation.
        points: (k, 3) of its landmark, world.
        measurement: (k, 3).
        roots: (k, 3, 3) of :func:`whitening`.
    """
    local = in_cameras(poses, points)
    off, seen = _off(rig, local, measurement)
    jacobian = roots @ rig.jacobian(np.where(seen[:, None], local, 1.0))
    jacobian[~seen] = 0.0
    by_pose = np.empty((len(local), 3, 6))
    by_pose[:, :, :3], by_pose[:, :, 3:] = jacobian @ skew(local), -jacobian
    by_point = jacobian @ np.swapaxes(poses[:, :3, :3], 1, 2)
    return LinearRows(products(roots, off), by_pose, by_point)


def _off(
    rig: CameraRig, local: FloatArray, measurement: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Residuals (k, 3) of points in the camera's frame, and which are in front (k,)."""
    seen = in_front(local)
    predicted = rig.predict(np.where(seen[:, None], local, 1.0))
    off = predicted - measurement
    # As GTSAM's factor has it: both columns and the row are two focal lengths off.
    off[~seen] = [2.0 * rig.fx, 2.0 * rig.fx, 0.0]
    return off, seen


def weighed(rows: LinearRows, weight: FloatArray) -> LinearRows:
    """The rows with weights (k,) of their squares."""
    root = np.sqrt(weight)[:, None]
    return LinearRows(
        root * rows.residual, root[:, :, None] * rows.by_pose, root[:, :, None] * rows.by_point
    )


def products(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """(k, i) products of matrices (k, i, j) and vectors (k, j)."""
    return np.asarray(np.einsum("kij,kj->ki", matrices, vectors))


def summed(index: IntArray, values: FloatArray, size: int) -> FloatArray:
    """(size, ...) sums of values (k, ...) by their index (k,)."""
    shape = values.shape[1:]
    flat = values.reshape(len(values), math.prod(shape))
    out = np.empty((size, flat.shape[1]))
    for column in range(flat.shape[1]):
        out[:, column] = np.bincount(index, flat[:, column], size)
    return out.reshape(size, *shape)
