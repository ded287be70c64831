"""OpenCV's FileStorage: stereo_calib's intrinsics and extrinsics, cv2.fisheye, cv2.omnidir."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fgslam.cameras.formats.trees import Tree, Values
from fgslam.cameras.raw_cameras import Calibration, RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, pose

_SIDES = (("1", "2"), ("left", "right"), ("l", "r"), ("0", "1"))
_MATRICES = ("m", "k", "kk", "mtx", "cameramatrix", "cammatrix", "intrinsicmatrix", "intrinsics")
_DISTORTIONS = (
    *("d", "kc", "dist", "distcoeffs", "distcoefs", "distortion", "distortions"),
    *("distortioncoefficients", "distortioncoeffs"),
)
"""What people call them, in small letters without marks; beside that a side, on either end."""

_STEPS = (
    *(("R", "T"), ("rot", "trans"), ("Rot", "Trans")),
    *(("rotation_matrix", "translation_vector"), ("rotationMatrix", "translationVector")),
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
    flat = _flat(tree)
    inner, step = _pair(flat, _MATRICES), _step(flat)
    return inner is not None or (step is not None and "distortion_model" not in tree)


def is_half(tree: Tree) -> bool:
    """Whether it holds either intrinsics or extrinsics of a pair, and the rest is elsewhere."""
    flat = _flat(tree)
    return (_pair(flat, _MATRICES) is not None) != (_step(flat) is not None)


def has_intrinsics(tree: Tree) -> bool:
    """Whether it holds the intrinsics of two cameras."""
    return _pair(_flat(tree), _MATRICES) is not None


def _flat(tree: Tree) -> Tree:
    """The same with what two parts ``left`` and ``right`` hold under names with these words."""
    inner = [k for k, v in tree.items() if isinstance(v, Mapping) and _plain(k) in _WORDS]
    deeper = {f"{key} {name}": value for key in inner for name, value in tree[key].items()}
    return {**tree, **deeper} if len(inner) == 2 else tree


_WORDS = {f"{before}{side}" for pair in _SIDES[1:3] for side in pair for before in ("", "camera")}
_WORDS |= {f"{before}{side}" for side in "012" for before in ("cam", "camera")}


def _plain(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _pair(tree: Tree, stems: Sequence[str]) -> tuple[str, str] | None:
    """The keys of two cameras' values whose names are one of the stems beside the side."""
    known = {_plain(key): key for key, value in tree.items() if _is_row(value)}
    for a, b in _SIDES:
        for stem in stems:
            for names in _forms(stem, a, b):
                if names[0] in known and names[1] in known:
                    return known[names[0]], known[names[1]]
    return None


def _forms(stem: str, a: str, b: str) -> tuple[tuple[str, str], ...]:
    inside = (("cam", "camera"), ("",))[stem.startswith("cam")]
    behind = [(f"{stem}{word}{a}", f"{stem}{word}{b}") for word in ("", *inside)]
    before = [(f"{word}{a}{stem}", f"{word}{b}{stem}") for word in ("", *inside)]
    return (*behind, *before)


def _is_row(value: Any) -> bool:
    """Whether a value is a row or matrix of numbers, as lens and matrix are, and no single one."""
    return isinstance(value, np.ndarray | list) and np.size(np.asarray(value, object)) > 0


def _step(tree: Tree) -> tuple[str, str] | None:
    """The keys of rotation and translation from the first camera's axes to the second's."""
    return next((names for names in _STEPS if set(names) <= tree.keys()), None)


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
    flat = _flat(tree)
    part, step = Values(path, flat), _step(flat)
    matrices, distortions = _pair(flat, _MATRICES), _pair(flat, _DISTORTIONS)
    if matrices is None or distortions is None or step is None:
        lacking = "R and T" if matrices and distortions else "matrices of two cameras"
        raise CalibrationError(
            f"{path} has no {lacking}; a stereo pair needs M1, D1, M2, D2, R and T "
            "(intrinsics.yml and extrinsics.yml beside each other will do)"
        )
    width, height = size or _stated_size(part) or (0, 0)
    poses = np.eye(4), inverse(_second_from_first(part, *step))
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


def _second_from_first(part: Values, turned: str, moved: str) -> FloatArray:
    turn = part.numbers(turned)
    rotation = cv2.Rodrigues(turn)[0] if len(turn) == 3 else part.matrix(turned, 3, 3)
    step = pose(np.asarray(rotation, np.float64), part.numbers(moved, 3))
    name = f"{turned} and {moved}"
    return Values(part.path, {name: step}).motion(name)


def _model(part: Values, distortion: str, matrix: str, k: int) -> tuple[str, FloatArray]:
    """Model and parameters. cv2.fisheye's files name matrices K and have four coefficients."""
    coefficients = part.numbers(distortion)
    xi = f"xi{k + 1}"
    if xi in part:
        return "omni", np.append(part.number(xi), coefficients)
    stated = part.text("distortion_model")
    fisheye = matrix.rpartition(" ")[2][0] == "K" and len(coefficients) == 4
    if stated in _FISHEYE_NAMES or (not stated and fisheye):
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
