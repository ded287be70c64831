"""OpenCV's FileStorage: stereo_calib's intrinsics and extrinsics, cv2.fisheye, cv2.omnidir."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras.formats.trees import Tree, Values
from fgslam.cameras.raw_cameras import Calibration, RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, pose

_MATRICES = (
    ("M1", "M2"),
    ("K1", "K2"),
    ("cameraMatrix1", "cameraMatrix2"),
    ("camera_matrix_1", "camera_matrix_2"),
    ("camera_matrix1", "camera_matrix2"),
    ("cameraMatrixL", "cameraMatrixR"),
    ("K_left", "K_right"),
    ("K_l", "K_r"),
    ("left_camera_matrix", "right_camera_matrix"),
)
_DISTORTIONS = (
    ("D1", "D2"),
    ("distCoeffs1", "distCoeffs2"),
    ("dist_coeffs_1", "dist_coeffs_2"),
    ("distCoeffsL", "distCoeffsR"),
    ("D_left", "D_right"),
    ("distCoeffs_l", "distCoeffs_r"),
    ("D_l", "D_r"),
    ("left_distortion_coefficients", "right_distortion_coefficients"),
)
_SINGLE = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M")
_SINGLE_DISTORTION = (
    "distortion_coefficients",
    "distCoeffs",
    "Distortion_Coefficients",
    "D",
    "dist_coeffs",
)
_FISHEYE_NAMES = ("fisheye", "equidistant", "kannala_brandt")
_FORMAT = "OpenCV stereo calibration"


def is_opencv_pair(tree: Tree) -> bool:
    """Whether it holds intrinsics or extrinsics of two cameras by OpenCV's usual names."""
    intrinsic = any(pair[0] in tree and pair[1] in tree for pair in _MATRICES)
    return intrinsic or ({"R", "T"} <= tree.keys() and "distortion_model" not in tree)


def is_half(tree: Tree) -> bool:
    """Whether it holds either intrinsics or extrinsics of a pair, and the rest is elsewhere."""
    intrinsic = any(pair[0] in tree for pair in _MATRICES)
    return intrinsic != ({"R", "T"} <= tree.keys())


def is_opencv_single(tree: Tree) -> bool:
    """Whether it holds one camera."""
    return any(isinstance(tree.get(key), np.ndarray) for key in _SINGLE)


def read_opencv_single(path: Path, tree: Tree, size: tuple[int, int] | None) -> Calibration:
    """One camera, as OpenCV's sample program calibration or cv2.omnidir writes it."""
    part = Values(path, tree)
    matrix = part.matrix(next(key for key in _SINGLE if key in part), 3, 3)
    name = next((key for key in _SINGLE_DISTORTION if key in part), "")
    coefficients = part.numbers(name) if name else np.zeros(4)
    model = "radtan"
    if "xi" in part:
        model, coefficients = "omni", np.append(part.number("xi"), coefficients)
    elif part.number("fisheye_model", 0.0) or part.text("model") in _FISHEYE_NAMES:
        model = "equidistant"
    width, height = size or _stated_size(part) or (0, 0)
    camera = RawCamera(width, height, matrix, coefficients, np.eye(4), path.name, model)
    return Calibration(str(path), "OpenCV calibration", (checked_camera(camera),))


def read_opencv_pair(path: Path, tree: Tree, size: tuple[int, int] | None) -> Calibration:
    """The two cameras, left first; the body is the first one.

    ``R`` and ``T`` take points from the first camera's axes to the second's, in the unit of the
    calibration target: metres, if its squares were given in metres.

    Args:
        path: a file of OpenCV's FileStorage.
        tree: its keys, with those of a second file that holds the rest.
        size: width and height of the images, where the file does not state them.

    Raises:
        CalibrationError: a matrix or the size is missing, or not what it should be.
    """
    part = Values(path, tree)
    matrices, distortions = _pair(part, _MATRICES), _pair(part, _DISTORTIONS)
    if matrices is None or distortions is None or not {"R", "T"} <= tree.keys():
        lacking = "R and T" if matrices and distortions else "matrices of two cameras"
        raise CalibrationError(
            f"{path} has no {lacking}; a stereo pair needs M1, D1, M2, D2, R and T "
            "(intrinsics.yml and extrinsics.yml beside each other will do)"
        )
    width, height = size or _stated_size(part) or (0, 0)
    poses = np.eye(4), inverse(_second_from_first(part))
    models = [_model(part, distortions[k], matrices[k], k) for k in (0, 1)]
    first, second = (
        checked_camera(
            RawCamera(
                width,
                height,
                part.matrix(matrices[k], 3, 3),
                models[k][1],
                poses[k],
                f"{path.name}: {matrices[k]}",
                models[k][0],
            )
        )
        for k in (0, 1)
    )
    notes: tuple[str, ...] = ()
    if first.model == "equidistant" and "distortion_model" not in part:
        notes = (f"four coefficients beside {matrices[0]}: taken as those of cv2.fisheye",)
    return Calibration(str(path), _FORMAT, (first, second), True, None, notes)


def _pair(part: Values, names: tuple[tuple[str, str], ...]) -> tuple[str, str] | None:
    return next((pair for pair in names if pair[0] in part and pair[1] in part), None)


def _second_from_first(part: Values) -> FloatArray:
    turn = part.numbers("R")
    rotation = cv2.Rodrigues(turn)[0] if len(turn) == 3 else part.matrix("R", 3, 3)
    moved = pose(np.asarray(rotation, np.float64), part.numbers("T", 3))
    made = Values(part.path, {"R and T": moved})
    return made.motion("R and T")


def _model(part: Values, distortion: str, matrix: str, k: int) -> tuple[str, FloatArray]:
    """Model and parameters. cv2.fisheye's files name matrices K and have four coefficients."""
    coefficients = part.numbers(distortion)
    xi = f"xi{k + 1}"
    if xi in part:
        return "omni", np.append(part.number(xi), coefficients)
    stated = part.text("distortion_model")
    if stated in _FISHEYE_NAMES or (not stated and matrix[0] == "K" and len(coefficients) == 4):
        return "equidistant", coefficients
    return "radtan", coefficients


def _stated_size(part: Values) -> tuple[int, int] | None:
    for pair in (("image_width", "image_height"), ("width", "height")):
        if pair[0] in part and pair[1] in part:
            return part.size(*pair)
    for key in ("image_size", "imageSize", "size", "img_size"):
        if key not in part:
            continue
        text = part.tree[key]
        words = text.split() if isinstance(text, str) else text
        width, height = Values(part.path, {key: words}).numbers(key, 2)
        return round(width), round(height)
    return None
