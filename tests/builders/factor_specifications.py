"""What each factor measures, as pure functions of poses and points: no graph, no noise, no solver.

The specification that factors are tested against (docs/derivations/measurements.md). All
residuals are *predicted minus measured*. Poses are (4, 4), points (3,) in the world, metres; the
tangent space of a pose is [rotation, translation] on the right, ``T * Exp(xi)``.

A point that is not in front of a camera has no image. GTSAM then answers twice the focal length
for every coordinate and a Jacobian of zero, and so do these functions: such a factor adds to the
cost and pulls at nothing.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import between, inverse, rotation, se3_log, so3_log, transform_to_camera
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Floor
from fgslam.factors.noise import Whitening

_SMALL = 1e-5  # radians: below it the series of the logarithm is exact to rounding

# --------------------------------------------------------------------------------------------
# Cameras


def stereo(rig: CameraRig, wTc: FloatArray, point: FloatArray, measured: FloatArray) -> FloatArray:
    """Residual (3,) of (column, row, disparity), pixels (Se et al. 2.2).

    Args:
        rig: the cameras; ``wTc`` is the right one's pose.
        wTc: pose.
        point: world point.
        measured: (3,) column, row, disparity.
    """
    predicted = _image(rig, wTc, point)
    return _behind(rig, 3) if predicted is None else np.asarray(predicted - measured)


def stereo_coordinates(
    rig: CameraRig, wTc: FloatArray, point: FloatArray, measured: FloatArray
) -> FloatArray:
    """Residual (3,) of GTSAM's (u_left, u_right, v), pixels; linear in :func:`stereo`'s.

    Arguments as there: ``measured`` is (column, row, disparity), of the right camera.
    """
    predicted = _image(rig, wTc, point)
    if predicted is None:
        return _behind(rig, 3)
    column, row, disparity = predicted - measured
    return np.array([column + disparity, column, row])


def _image(rig: CameraRig, wTc: FloatArray, point: FloatArray) -> FloatArray | None:
    local = transform_to_camera(wTc, point[None, :])
    return rig.predict(local)[0] if local[0, 2] > 0.0 else None


def _behind(rig: CameraRig, coordinates: int) -> FloatArray:
    return np.full(coordinates, 2.0 * rig.fx)


# --------------------------------------------------------------------------------------------
# Poses


def pose_prior(wTc: FloatArray, prior: FloatArray) -> FloatArray:
    """Residual (6,) of a pose beside its prior, in the tangent space at the pose."""
    return se3_log(inverse(prior) @ wTc)


def odometry(wTp: FloatArray, wTn: FloatArray, pTn: FloatArray) -> FloatArray:
    """Residual (6,) of a measured motion ``pTn`` between two poses, in the tangent at the later."""
    return se3_log(inverse(pTn) @ inverse(wTp) @ wTn)


def height(floor: Floor, wTc: FloatArray) -> float:
    """How far the camera is below the floor's level (Se et al. 5), metres."""
    return float(floor.down @ wTc[:3, 3])


def tilt(floor: Floor, wTc: FloatArray, upright: FloatArray) -> FloatArray:
    """Tilt (2,) about the world's horizontal directions, from an upright rotation, radians.

    Args:
        floor: gives the directions.
        wTc: pose.
        upright: (3, 3) a rotation about the vertical; any near ``wTc``'s serves.
    """
    turn = upright @ so3_log(upright.T @ wTc[:3, :3])
    return np.asarray(floor.horizontal.T @ turn)


# --------------------------------------------------------------------------------------------
# Planar motion


def constant_velocity(
    before: FloatArray, speed: FloatArray, after: FloatArray, next_speed: FloatArray, step: float
) -> FloatArray:
    """Residual (6,) of white noise on acceleration between two poses (Barfoot 2017, 11.1).

    Args:
        before: (3,) pose.
        speed: (3,) velocity there, in the robot's own axes: forward, left, turning.
        after: (3,) pose.
        next_speed: (3,) velocity there.
        step: seconds between them.
    """
    moved = se2_log(between(before, after))
    carried = _log_derivative(moved) @ next_speed
    return np.concatenate([moved - step * speed, carried - speed])


def constant_velocity_covariance(density: FloatArray, step: float) -> FloatArray:
    """(6, 6) covariance of it, of densities (3,) of accelerations forward, left and turning."""
    powers = np.array([[step**3 / 3.0, step**2 / 2.0], [step**2 / 2.0, step]])
    return np.kron(powers, np.diag(density))


def se2_log(motion: FloatArray) -> FloatArray:
    """Tangent vector (3,), [translation, rotation], of a planar motion (x, y, psi)."""
    half = 0.5 * motion[2]
    cotangent = 1.0 - half**2 / 3.0 if abs(half) < _SMALL else half / np.tan(half)
    straight = np.array([[cotangent, half], [-half, cotangent]])
    return np.append(straight @ motion[:2], motion[2])


def _log_derivative(tangent: FloatArray) -> FloatArray:
    """(3, 3) derivative of the logarithm by a step on the right of the motion.

    The logarithm is (M(w) t, w) of a motion (t, w); a step (a, b) makes it (t + R(w) a, w + b).
    """
    w = tangent[2]
    half = 0.5 * w
    if abs(half) < _SMALL:
        cotangent, slope = 1.0 - half**2 / 3.0, -w / 6.0
    else:
        cotangent = half / np.tan(half)
        slope = 0.5 * (1.0 / np.tan(half) - half / np.sin(half) ** 2)
    straight = np.array([[cotangent, half], [-half, cotangent]])
    by_turn = np.array([[slope, 0.5], [-0.5, slope]])
    moved = np.linalg.solve(straight, tangent[:2])
    out = np.eye(3)
    out[:2, :2] = straight @ rotation(w)
    out[:2, 2] = by_turn @ moved
    return out


# --------------------------------------------------------------------------------------------
# Raw pixels


class RawPixelFactors:
    """Factors of single images, each coordinate with the same independent noise.

    The front-end's fused (column, row, disparity) is the least-squares summary of the six raw
    coordinates, and they are linear in it; so one stereo factor with its full covariance carries
    exactly the information of these two.
    """

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
