"""Factors of one landmark observation, by stereo or trinocular cameras, or by range and bearing.

Derivation: docs/derivations/factors.md.
"""

from __future__ import annotations

from typing import Any, Protocol

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import CameraRig, Sensor
from fgslam.factors.noise import Whitening

FROM_MEASUREMENT: FloatArray = np.array([[1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""(u_left, u_right, v) of (column, row, disparity)."""
_REACH_SIGMAS = 10.0  # how far from the measured direction the predicted one is expected
_ISOTROPIC = 1e-9  # relative difference of bearing variances that makes no difference
_UNIT_CAMERA = gtsam.Cal3_S2Stereo(1.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class StereoFactors:
    """Makes C++ stereo factors of one rig, of observations (column, row, disparity).

    The paper's reference is the right camera, GTSAM's stereo camera the left one. The pose variable
    stays the right camera's; the left one sits ``baseline`` along its -x axis and is given to the
    factor as the sensor's place on the body. GTSAM measures (u_left, u_right, v), which is linear
    in ours: ``u_left = c + d, u_right = c, v = r``; its covariance follows exactly.

    A landmark behind the camera has a constant residual and no Jacobian, as GTSAM does it; who
    builds graphs keeps such landmarks out.
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


class RangeBearingFactors:
    """Makes C++ range-bearing factors in three dimensions.

    GTSAM measures a bearing along two tangent directions of its own choice *at the predicted
    bearing*; the choice jumps by about a right angle where the two smallest coordinates of the
    direction change their order. Away from such places the covariance is turned into the
    directions that the measured bearing has, which are then the predicted one's, too. Close to
    them a covariance that differs by direction would be mixed up, and a stereo camera turned
    towards the bearing takes over, whose directions are fixed: the same measurement to first
    order. Derivation: docs/derivations/factors.md.
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
        axes = bearing_axes(measurement)
        spread = _on_sphere(measurement, covariance)
        distance = float(measurement[2])
        if _may_be_mixed_up(axes[:, 2], spread):
            return self._turned_camera(pose, landmark, axes, distance, spread)
        bearing = gtsam.Unit3(axes[:, 2])
        turn = np.eye(3)
        turn[:2, :2] = bearing.basis().T @ axes[:, :2]
        model = self._whitening.model(turn @ spread @ turn.T)
        return gtsam.BearingRangeFactor3D(pose, landmark, bearing, distance, model)

    def _turned_camera(
        self, pose: int, landmark: int, axes: FloatArray, distance: float, spread: FloatArray
    ) -> Any:
        """A stereo camera of focal length and baseline 1 that looks along the bearing.

        The left one is the sensor: ``u_left`` is the tangent to the right, ``v`` that downwards,
        ``u_left - u_right`` the inverse of the distance along the bearing.
        """
        nearer = 1.0 / distance**2
        jacobian = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, nearer], [0.0, -1.0, 0.0]])
        model = self._whitening.model(jacobian @ spread @ jacobian.T)
        right_down_ahead = axes * [1.0, -1.0, 1.0]
        turned = gtsam.Pose3(gtsam.Rot3(right_down_ahead), np.zeros(3))
        measured = gtsam.StereoPoint2(0.0, -1.0 / distance, 0.0)
        return gtsam.GenericStereoFactor3D(
            measured, model, pose, landmark, _UNIT_CAMERA, False, False, turned
        )


def bearing_axes(measurement: FloatArray) -> FloatArray:
    """Columns (3, 3), in the sensor's axes: growing azimuth, growing elevation, the bearing.

    Args:
        measurement: (3,) azimuth, elevation, range; at the poles the azimuth still gives axes.
    """
    azimuth, elevation = measurement[:2].tolist()
    sin_a, cos_a = np.sin(azimuth), np.cos(azimuth)
    sin_e, cos_e = np.sin(elevation), np.cos(elevation)
    return np.array(
        [
            [cos_a, -sin_a * sin_e, sin_a * cos_e],
            [0.0, -cos_e, -sin_e],
            [-sin_a, -cos_a * sin_e, cos_a * cos_e],
        ]
    )


def _on_sphere(measurement: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (3, 3) of (azimuth, elevation, range) along :func:`bearing_axes` and in range.

    A circle of elevation has radius cos(e), and its mean square over the elevation's noise is
    ``cos(e)^2 + sin(e)^2 var(e)`` to second order: without that, a landmark at the pole would be
    known exactly sideways.
    """
    elevation, variance = float(measurement[1]), float(covariance[1, 1])
    radius = np.sqrt(np.cos(elevation) ** 2 + np.sin(elevation) ** 2 * variance)
    scale = np.array([radius, 1.0, 1.0])
    return np.asarray(covariance * np.outer(scale, scale))


def _may_be_mixed_up(bearing: FloatArray, spread: FloatArray) -> bool:
    """True if GTSAM's directions may jump and the covariance depends on the direction."""
    a, b, c = spread[0, 0], spread[1, 1], spread[0, 1]
    largest = max(a, b)
    linked = float(np.abs(spread[:2, 2]).max())  # with the range, by a direction
    if max(abs(a - b), 2.0 * abs(c)) <= _ISOTROPIC * largest and linked == 0.0:
        return False
    smallest, second, _ = np.sort(np.abs(bearing))
    return bool(second - smallest < np.sqrt(2.0 * largest) * _REACH_SIGMAS)


class LandmarkFactors(Protocol):
    """Makes the factor of one landmark observation."""

    def factor(
        self, pose: int, landmark: int, measurement: FloatArray, covariance: FloatArray
    ) -> Any:
        """Factor between a pose and a landmark, by key."""
        ...


def landmark_factors(sensor: Sensor, whitening: Whitening) -> LandmarkFactors:
    """The factors of a sensor."""
    if isinstance(sensor, CameraRig):
        return StereoFactors(sensor, whitening)
    return RangeBearingFactors(whitening)
