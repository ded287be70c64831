"""Intrinsics and poses of a board to start a least squares fit from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from fgslam.cameras.board_projection import PARAMETERS
from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.trees import intrinsic_matrix
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import pose, so3_exp

_HALF_VIEWS = np.radians([20.0, 30.0, 40.0, 50.0, 60.0, 75.0, 90.0, 105.0, 120.0])
"""Angles from the axis that the nearest border of the image may show."""
_XIS = (0.7, 1.0, 1.5)  # of lenses, parabolic mirrors, and spheres seen from farther away
_AHEAD = 0.1  # least depth over distance, seen along the board's middle, to take a pose from
_LEAST = 4  # points from which a pose follows


def first_guess(
    model: str,
    points: Sequence[FloatArray],
    pixels: Sequence[FloatArray],
    size: tuple[int, int],
) -> FloatArray:
    """Intrinsics (p,) of one camera: fx, fy, cx, cy and the model's parameters.

    Of a perspective camera by OpenCV from its own images; of others, of several angles of view
    without distortion, those with which the boards lie nearest to what was seen.

    Args:
        model: one of :data:`fgslam.cameras.board_projection.PARAMETERS`.
        points: of each image (n, 3), in the board's axes.
        pixels: of each image (n, 2), where they were found.
        size: width and height of the images.

    Raises:
        CalibrationError: the images do not determine a camera.
    """
    if model == "radtan":
        return _perspective(points, pixels, size)
    candidates = list(_undistorted(model, size))
    off = [_misfit(camera_of(model, size, guess), points, pixels) for guess in candidates]
    return candidates[int(np.argmin(off))]


def _perspective(
    points: Sequence[FloatArray], pixels: Sequence[FloatArray], size: tuple[int, int]
) -> FloatArray:
    flat = [p.astype(np.float32)[:, None] for p in points]
    seen = [p.astype(np.float32)[:, None] for p in pixels]
    try:
        _, matrix, distortion, *_ = cv2.calibrateCamera(flat, seen, size, np.eye(3), np.zeros(5))
    except cv2.error as error:
        raise CalibrationError(
            f"the board's images do not determine a camera ({error.err}); take more of them, "
            "tilted and filling the image"
        ) from error
    numbers = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    return np.array([*numbers, *np.ravel(distortion)[: len(PARAMETERS["radtan"])]])


def _undistorted(model: str, size: tuple[int, int]) -> Iterator[FloatArray]:
    centre = (size[0] - 1) / 2.0, (size[1] - 1) / 2.0
    for angle in _HALF_VIEWS:
        if model == "equidistant":
            focal = 0.5 * min(size) / angle
            yield np.array([focal, focal, *centre, 0.0, 0.0, 0.0, 0.0])
            continue
        for xi in _XIS:
            below = np.cos(angle) + xi
            if below > _AHEAD:
                focal = 0.5 * min(size) * below / np.sin(angle)
                yield np.array([focal, focal, *centre, xi, 0.0, 0.0, 0.0, 0.0])


def _misfit(camera: RawCamera, points: Sequence[FloatArray], pixels: Sequence[FloatArray]) -> float:
    """Median over all images of how far off their corners are, pixels, with the boards placed."""
    off = []
    for flat, seen in zip(points, pixels, strict=True):
        cTb = board_pose(camera, flat, seen)
        if cTb is None:
            off.append(np.inf)
            continue
        shown = camera.project(flat @ cTb[:3, :3].T + cTb[:3, 3])
        distance = np.linalg.norm(shown - seen, axis=1)
        off.append(float(np.median(np.where(np.isfinite(distance), distance, np.inf))))
    return float(np.mean(np.minimum(off, max(camera.size))))


def camera_of(
    model: str, size: tuple[int, int], intrinsics: FloatArray, name: str = "camera"
) -> RawCamera:
    """The camera of fx, fy, cx, cy and the model's parameters, at the body's origin."""
    matrix = intrinsic_matrix(*intrinsics[:4])
    return RawCamera(*size, matrix, intrinsics[4:], np.eye(4), name, model)


def board_pose(camera: RawCamera, points: FloatArray, pixels: FloatArray) -> FloatArray | None:
    """Pose (4, 4) of a board in the camera; None where too few of its corners have rays.

    The rays are turned to look along their mean first: a board may lie beside the camera.
    """
    rays = camera.unproject(pixels)
    known = np.isfinite(rays).all(axis=1)
    if not known.any():
        return None
    turn = _turned_ahead(rays[known].mean(axis=0))
    rays = rays @ turn.T
    usable = known & (np.nan_to_num(rays[:, 2]) > _AHEAD)
    if usable.sum() < _LEAST:
        return None
    flat = rays[usable, :2] / rays[usable, 2:]
    found, vector, shift = cv2.solvePnP(
        points[usable], flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not found or not (np.isfinite(vector).all() and np.isfinite(shift).all()):
        return None
    rotation = so3_exp(np.asarray(vector, np.float64).ravel())
    return pose(turn.T @ rotation, turn.T @ np.asarray(shift, np.float64).ravel())


def _turned_ahead(direction: FloatArray) -> FloatArray:
    """Rotation (3, 3) that takes a direction to the axis z."""
    forward = direction / np.linalg.norm(direction)
    side = np.cross(np.eye(3)[int(np.argmin(np.abs(forward)))], forward)
    side /= np.linalg.norm(side)
    return np.array([side, np.cross(forward, side), forward])
