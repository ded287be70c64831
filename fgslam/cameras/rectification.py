"""Rectification of raw stereo pairs: one image plane, equal rows (Bouguet's method, OpenCV)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import Brief, FloatArray, Image
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse
from fgslam.core.sensors import CameraRig

MapArray: TypeAlias = npt.NDArray[np.float32]

_LEAST_BASELINE_M = 1e-3  # below it two cameras are one, up to rounding
# Cosine of 45 degrees: beyond, a common image plane would stretch the views out of use.
_LEAST_COMMON_VIEW = 0.707


@dataclass(frozen=True, slots=True, eq=False)
class RawCamera:
    """A camera as calibrated, before rectification.

    Attributes:
        width, height: pixels.
        matrix: (3, 3) intrinsics in pixels.
        distortion: (4,), (5,), (8,), (12,) or (14,) radial-tangential, in OpenCV's order.
        bTc: (4, 4) pose of the camera in the body.
        name: in messages.
    """

    width: int
    height: int
    matrix: FloatArray
    distortion: FloatArray
    bTc: FloatArray
    name: str = "camera"


@dataclass(frozen=True, eq=False, repr=False)
class Rectifier(Brief):
    """Remaps raw images of a stereo pair to rectified ones; maps are computed once.

    Attributes:
        rig: the rectified rig, reference = right camera.
        maps: per camera (right, left) the columns and rows (h, w) to sample, float32.
    """

    rig: CameraRig
    maps: tuple[tuple[MapArray, MapArray], ...]

    def rectify(self, camera: int, image: Image) -> Image:
        """Rectified image (h, w) of camera 0 (right) or 1 (left), bilinear."""
        columns, rows = self.maps[camera]
        return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR), np.uint8)


def right_and_left(first: RawCamera, second: RawCamera) -> tuple[RawCamera, RawCamera]:
    """The two cameras, right first: the left one is that which sees the other at +x.

    Raises:
        CalibrationError: their images differ in size.
    """
    if (first.width, first.height) != (second.width, second.height):
        raise CalibrationError(
            f"{first.name} is {first.width}x{first.height} but {second.name} is "
            f"{second.width}x{second.height}; both must have one resolution"
        )
    if (inverse(first.bTc) @ second.bTc)[0, 3] > 0.0:
        return second, first
    return first, second


def rectifier(right: RawCamera, left: RawCamera, alpha: float = 0.0) -> Rectifier:
    """Rectify a pair (Bouguet's method as in OpenCV; ``alpha`` 0 crops to valid pixels).

    Raises:
        CalibrationError: the cameras lie above each other, or look in different directions.
    """
    _require_side_by_side(inverse(left.bTc) @ right.bTc)
    rTl = inverse(right.bTc) @ left.bTc
    size = (right.width, right.height)
    r_left, r_right, _, p_right, *_ = cv2.stereoRectify(
        left.matrix,
        left.distortion,
        right.matrix,
        right.distortion,
        size,
        rTl[:3, :3],
        rTl[:3, 3:],
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=alpha,
    )
    projection = np.asarray(p_right, np.float64)
    rotations = (np.asarray(r_right, np.float64), np.asarray(r_left, np.float64))
    return rectified_by(right, left, rotations, projection)


def rectified_by(
    right: RawCamera,
    left: RawCamera,
    rotations: tuple[FloatArray, FloatArray],
    projection: FloatArray,
) -> Rectifier:
    """The rectifier that a calibration states.

    Args:
        right: the reference camera.
        left: the other one.
        rotations: (3, 3) each, of right and left camera: from raw to rectified axes.
        projection: (3, 4) of the rectified right camera, whose last column holds the baseline,
            ``-fx * baseline``.
    """
    new_matrix = projection[:, :3]
    maps = tuple(
        _sampling_maps(camera, rotation, new_matrix)
        for camera, rotation in zip((right, left), rotations, strict=True)
    )
    fx, fy, cx, cy = (float(projection[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    raw_from_rectified = np.eye(4)
    raw_from_rectified[:3, :3] = rotations[0].T
    rig = CameraRig(
        width=right.width,
        height=right.height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        baseline=-float(projection[0, 3]) / fx,
        vertical_baseline=None,
        bTc=right.bTc @ raw_from_rectified,
    )
    return Rectifier(rig, maps)


def _sampling_maps(
    camera: RawCamera, rotation: FloatArray, new_matrix: FloatArray
) -> tuple[MapArray, MapArray]:
    """Columns and rows (h, w) of the raw image at which each rectified pixel looks."""
    columns, rows = cv2.initUndistortRectifyMap(
        camera.matrix,
        camera.distortion,
        rotation,
        new_matrix,
        (camera.width, camera.height),
        cv2.CV_32FC1,
    )
    return np.asarray(columns, np.float32), np.asarray(rows, np.float32)


def _require_side_by_side(lTr: FloatArray) -> None:
    """Raises CalibrationError unless the right camera, at ``lTr``, is to the left one's right."""
    offset = lTr[:3, 3]
    if np.abs(offset[0]) < max(2.0 * np.hypot(offset[1], offset[2]), _LEAST_BASELINE_M):
        x, y, z = offset
        raise CalibrationError(
            f"cam0 and cam1 are not side by side (offset {x:.3f}, {y:.3f}, {z:.3f} m along x, y, z)"
            "; a horizontal stereo pair is needed, check T_BS (or R and T) in the calibration"
        )
    if lTr[2, 2] < _LEAST_COMMON_VIEW:
        raise CalibrationError(
            "cam0 and cam1 look more than 45 degrees apart; check T_BS (or R and T) in the "
            "calibration"
        )
