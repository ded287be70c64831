"""Calibration files of a stereo pair that say how it is rectified: OpenCV's, ROS's and KITTI's."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras.lenses import (
    Calibration,
    RawCamera,
    StatedView,
    checked_camera,
    checked_view,
)
from fgslam.cameras.trees import Row, Size, Tree, Values, camera_of, flat_numbers
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_lines
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, inverse, pose, reorthonormalise

# --------------------------------------------------------------------------------------------
# OpenCV's FileStorage: stereo_calib's intrinsics and extrinsics, cv2.fisheye, cv2.omnidir


_SIDES = (("1", "2"), ("left", "right"), ("l", "r"), ("0", "1"))
_MATRICES = ("m", "k", "kk", "mtx", "cameramatrix", "cammatrix", "intrinsicmatrix", "intrinsics")
_DISTORTIONS = (
    *("d", "kc", "dist", "distcoeffs", "distcoefs", "distortion", "distortions"),
    *("distortioncoefficients", "distortioncoeffs"),
)
"""What people call them, in small letters without marks; next to that a side, on either end."""
_STEPS = (
    *(("R", "T"), ("rot", "trans"), ("Rot", "Trans")),
    *(("rotation_matrix", "translation_vector"), ("rotationMatrix", "translationVector")),
)
_PARTS_OF_SIDES = {
    *("left", "right", "cameraleft", "cameraright", "l", "r", "cameral", "camerar"),
    *(f"{word}{number}" for word in ("cam", "camera") for number in "012"),
}
_ONE = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M")
_OF_ONE = (
    *("distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "D", "dist_coeffs"),
)
_FISHEYE = ("fisheye", "equidistant", "kannala_brandt")


def is_opencv_pair(tree: Tree) -> bool:
    """Whether it holds intrinsics or extrinsics of two cameras by OpenCV's usual names."""
    return has_intrinsics(tree) or (has_step(tree) and "distortion_model" not in tree)


def has_intrinsics(tree: Tree) -> bool:
    """Whether it holds the intrinsics of two cameras."""
    return _pair(_flat(tree), _MATRICES) is not None


def has_step(tree: Tree) -> bool:
    """Whether it holds the pose of one camera to another."""
    return _step(_flat(tree)) is not None


def is_opencv_one(tree: Tree) -> bool:
    """Whether it holds one camera."""
    return any(isinstance(tree.get(key), np.ndarray) for key in _ONE)


def _flat(tree: Tree) -> Tree:
    """The same with what two parts ``left`` and ``right`` hold under names with these words."""
    inner = [
        k for k, v in tree.items() if isinstance(v, Mapping) and _letters(k) in _PARTS_OF_SIDES
    ]
    deeper = {f"{key} {name}": value for key in inner for name, value in tree[key].items()}
    return {**tree, **deeper} if len(inner) == 2 else tree


def _letters(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _pair(tree: Tree, stems: Sequence[str]) -> tuple[str, str] | None:
    """The keys of two cameras' rows or matrices whose names are a stem next to the side."""
    known = {
        _letters(key): key
        for key, value in tree.items()
        if isinstance(value, np.ndarray | list) and np.size(np.asarray(value, object)) > 0
    }
    for a, b in _SIDES:
        for stem in stems:
            for word in ("",) if stem.startswith("cam") else ("", "cam", "camera"):
                for form in (f"{stem}{word}{{}}", f"{word}{{}}{stem}"):
                    if form.format(a) in known and form.format(b) in known:
                        return known[form.format(a)], known[form.format(b)]
    return None


def _step(tree: Tree) -> tuple[str, str] | None:
    """The keys of rotation and translation from the first camera's axes to the second's."""
    return next((names for names in _STEPS if set(names) <= tree.keys()), None)


def read_opencv_one(path: Path, tree: Tree, size: Size | None) -> Calibration:
    """One camera, as OpenCV's sample program calibration or cv2.omnidir writes it."""
    part = Values(path, tree)
    matrix = part.matrix(next(key for key in _ONE if key in part), 3, 3)
    name = next((key for key in _OF_ONE if key in part), "")
    coefficients = part.numbers(name) if name else np.zeros(4)
    model = "radtan"
    if "xi" in part:
        model, coefficients = "omni", np.append(part.number("xi"), coefficients)
    elif part.number("fisheye_model", 0.0) or part.text("model") in _FISHEYE:
        model = "equidistant"
    size = size or _opencv_size(part)
    camera = checked_camera(RawCamera(*size, matrix, coefficients, np.eye(4), path.name, model))
    return Calibration(str(path), "OpenCV calibration", (camera,))


def read_opencv_pair(path: Path, tree: Tree, size: Size | None) -> Calibration:
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
            "(intrinsics.yml and extrinsics.yml next to each other will do)"
        )
    size = size or _opencv_size(part)
    turned, moved = step
    turn = part.numbers(turned)
    rotation = cv2.Rodrigues(turn)[0] if len(turn) == 3 else part.matrix(turned, 3, 3)
    motion = pose(np.asarray(rotation, np.float64), part.numbers(moved, 3))
    sTf = Values(path, {f"{turned} and {moved}": motion}).motion(f"{turned} and {moved}")
    cameras = []
    for k, bTc in enumerate((np.eye(4), inverse(sTf))):
        model, parameters = _opencv_lens(part, distortions[k], matrices[k], k)
        matrix, name = part.matrix(matrices[k], 3, 3), f"{path.name}: {matrices[k]}"
        cameras.append(checked_camera(RawCamera(*size, matrix, parameters, bTc, name, model)))
    notes: tuple[str, ...] = ()
    if cameras[0].model == "equidistant" and "distortion_model" not in part:
        notes = (f"four coefficients beside {matrices[0]}: taken as those of cv2.fisheye",)
    return Calibration(str(path), "OpenCV stereo calibration", tuple(cameras), True, None, notes)


def _opencv_lens(part: Values, distortion: str, matrix: str, k: int) -> tuple[str, FloatArray]:
    """Model and parameters. cv2.fisheye's files name matrices K and have four coefficients."""
    coefficients = part.numbers(distortion)
    if f"xi{k + 1}" in part:
        return "omni", np.append(part.number(f"xi{k + 1}"), coefficients)
    stated = part.text("distortion_model")
    fisheye = matrix.rpartition(" ")[2][0] == "K" and len(coefficients) == 4
    if stated in _FISHEYE or (not stated and fisheye):
        return "equidistant", coefficients
    return "radtan", coefficients


def _opencv_size(part: Values) -> Size:
    """Width and height; (0, 0) where none are stated."""
    for pair in (("image_width", "image_height"), ("width", "height")):
        if pair[0] in part and pair[1] in part:
            return part.size(*pair)
    for key in ("image_size", "imageSize", "size", "img_size"):
        if key in part:
            text = part.tree[key]
            words = text.split() if isinstance(text, str) else text
            return Values(part.path, {key: words}).size(key)
    return 0, 0


# --------------------------------------------------------------------------------------------
# ROS camera_info: one file a camera, each with its own rectification and projection


_COEFFICIENTS = "distortion_coefficients"
_ROS_NAMES = (
    *(_COEFFICIENTS, "camera_matrix"),
    *("rectification_matrix", "projection_matrix"),
)
_ROS = Row(
    size=("image_width", "image_height"),
    matrix="camera_matrix",
    kind=("distortion_model",),
    lenses={
        "plumb_bob": ("radtan", (_COEFFICIENTS,)),
        "rational_polynomial": ("radtan", (_COEFFICIENTS,)),
        "thin_prism": ("radtan", (_COEFFICIENTS,)),
        "equidistant": ("equidistant", (_COEFFICIENTS,)),
        "fisheye": ("equidistant", (_COEFFICIENTS,)),
        "kannala_brandt": ("equidistant", (_COEFFICIENTS,)),
        "none": ("radtan", (_COEFFICIENTS,)),
    },
)


def is_camera_info(tree: Tree) -> bool:
    """Whether it is a camera_info, as camera_calibration or an echo of the topic writes it."""
    return {"camera_matrix", "distortion_model", "image_width"} <= _as_ros_file(tree).keys()


def _as_ros_file(tree: Tree) -> Tree:
    """The message as ``rostopic echo`` and ``ros2 topic echo`` write it, with a file's keys."""
    for letters in ("DKRP", "dkrp"):
        if tree.keys() >= {*letters, "distortion_model", "width", "height"}:
            named = {name: tree[letter] for name, letter in zip(_ROS_NAMES, letters, strict=True)}
            return {**tree, **named, "image_width": tree["width"], "image_height": tree["height"]}
    return tree


def read_camera_info(path: Path, tree: Tree) -> Calibration:
    """The calibration of one camera alone."""
    camera, _, _ = _ros_camera(path, tree)
    return Calibration(str(path), "ROS camera_info", (camera,))


def read_camera_info_pair(files: tuple[Path, Path], trees: tuple[Tree, Tree]) -> Calibration:
    """Left and right camera; the body is the rectified right one.

    The baseline is in the projection matrix of one of the two: its fourth number over fx.

    Raises:
        CalibrationError: a value is missing or malformed, a distortion model is not known, or the
            files are not of one rectified pair.
    """
    (left, r_left, p_left), (right, r_right, p_right) = map(_ros_camera, files, trees)
    if left.size != right.size:
        raise CalibrationError(
            f"{files[0]} is {left.width}x{left.height} but {files[1].name} is "
            f"{right.width}x{right.height}; both must have one resolution"
        )
    # The principal columns may differ: then far points have a disparity. One is taken for both.
    if not np.allclose(np.delete(p_left, 2, 1)[:, :2], np.delete(p_right, 2, 1)[:, :2]) or (
        not np.isclose(p_left[1, 2], p_right[1, 2])
    ):
        raise CalibrationError(
            f"{files[0]}: its projection_matrix differs from that of {files[1].name}, so the two "
            "are not of one rectified pair; calibrate them as a stereo pair"
        )
    offset = -(p_right[0, 3] - p_left[0, 3]) / (p_right[0, 0] or np.inf)
    if p_right[0, 0] <= 0.0 or offset == 0.0:
        raise CalibrationError(
            f"{files[1]}: projection_matrix states no baseline (its fourth number is "
            f"{p_right[0, 3]:g}, must be negative); calibrate a stereo pair, or swap the files"
        )
    cameras = (
        replace(left, bTc=pose(r_left, np.array([-offset, 0.0, 0.0]))),
        replace(right, bTc=pose(r_right, np.zeros(3))),
    )
    source = f"{files[0]} and {files[1].name}"
    view = checked_view(StatedView((r_left, r_right), p_right[:, :3], left.size), source)
    return Calibration(source, "ROS camera_info, a pair", cameras, True, view)


def _ros_camera(path: Path, tree: Tree) -> tuple[RawCamera, FloatArray, FloatArray]:
    """The camera, its rectifying rotation (3, 3) and its projection (3, 4)."""
    tree = _as_ros_file(tree)
    kind = Values(path, tree).text("distortion_model") or "none"
    given = tree.get(_COEFFICIENTS)
    data = given.get("data") if isinstance(given, dict) else given
    if isinstance(data, np.ndarray | list) and not np.size(data):  # CameraInfo.msg: none
        fisheye = _ROS.lenses.get(kind, ("", ()))[0] == "equidistant"
        given = [0.0] * (4 if fisheye else 5)
    part = Values(path, {**tree, "distortion_model": kind, _COEFFICIENTS: given})
    raw = camera_of(part, _ROS)
    rotation, projection = np.eye(3), np.column_stack([raw.matrix, np.zeros(3)])
    if "rectification_matrix" in part:
        turn = pose(part.matrix("rectification_matrix", 3, 3), np.zeros(3))
        rotation = reorthonormalise(turn)[:3, :3]
        if not np.allclose(rotation, turn[:3, :3], atol=1e-3):
            raise part.refuse("rectification_matrix is not a rotation; calibrate again")
    if "projection_matrix" in part:
        projection = part.matrix("projection_matrix", 3, 4)
    return raw, rotation, projection


# --------------------------------------------------------------------------------------------
# KITTI: projections of a rectified pair, grey (cameras 0 and 1) or colour (2 and 3)


_KITTI_PAIRS = ((0, 1), (2, 3))  # of the odometry data: left and right camera, grey, else colour
_P_RECT = "P_rect_"
KITTI_RAW = ("P_rect_00", "P_rect_01")
KITTI_RAW_COLOUR = ("P_rect_02", "P_rect_03")


def read_kitti(path: Path, size: Size | None, keys: tuple[str, str] | None = None) -> Calibration:
    """A rectified pair; the body is the left camera, looking ahead.

    ``keys`` are the lines of left and right camera; None: of the grey pair, or of the colour one
    where only that has images beside the file.

    Raises:
        CalibrationError: a line is missing or malformed, or the pair is not rectified.
    """
    lines = _Lines(path)
    raw = sorted(name for name in lines.words if name.startswith(_P_RECT))
    stated = (raw[0], raw[1]) if len(raw) == 2 else KITTI_RAW  # DrivingStereo: 101, 103
    keys = keys or (stated if raw else _kitti_keys(path))
    left, right = (lines.numbers(key, 12).reshape(3, 4) for key in keys)
    if not np.allclose(left[:, :3], right[:, :3]):
        raise CalibrationError(
            f"{path}: {keys[0]} and {keys[1]} differ in their intrinsics, so the pair is not "
            "rectified; use the calibration that came with the sequence"
        )
    fx, fy = float(right[0, 0]), float(right[1, 1])
    if fx <= 0.0 or fy <= 0.0:
        raise CalibrationError(f"{path}: focal lengths {fx:g}, {fy:g} must be positive")
    baseline = float(left[0, 3] - right[0, 3]) / fx
    if baseline <= 0.0:
        raise CalibrationError(
            f"{path}: the baseline is {baseline:g} m, must be positive; {keys[0]} belongs to the "
            f"left camera (image_0), {keys[1]} to the right one (image_1): are they swapped?"
        )
    sized = f"S_rect_{keys[0].removeprefix(_P_RECT)}"
    if raw and sized in lines.words:
        width, height = lines.numbers(sized, 2, "width and height")
        size = round(width), round(height)
    cameras = tuple(
        checked_camera(
            RawCamera(
                *(size or (0, 0)),
                left[:, :3],
                np.zeros(4),
                BODY_FORWARD_LEFT_UP_FROM_CAMERA @ pose(np.eye(3), np.array([x, 0.0, 0.0])),
                f"{path.name}: {key}",
            )
        )
        for key, x in zip(keys, (-baseline, 0.0), strict=True)
    )
    return Calibration(str(path), "KITTI", cameras, sided=True)


def pair_beside(path: Path) -> tuple[int, int] | None:
    """Left and right camera whose folders of images lie beside a calib.txt; None: of no pair."""
    for pair in _KITTI_PAIRS:
        if all((path.parent / f"image_{number}").is_dir() for number in pair):
            return pair
    return None


def _kitti_keys(path: Path) -> tuple[str, str]:
    """Lines of the pair whose images lie beside a calib.txt; of the grey one where none does."""
    left, right = pair_beside(path) or _KITTI_PAIRS[0]
    return f"P{left}", f"P{right}"


def right_of_camera_0(path: Path) -> float:
    """How far the pair's right camera is to the right of camera 0, whose poses KITTI gives, metres.

    Raises:
        CalibrationError: a line is missing or malformed.
    """
    right = _Lines(path).numbers(_kitti_keys(path)[1], 12).reshape(3, 4)
    return -float(right[0, 3] / right[0, 0])


def left_on_inertial_unit(path: Path, keys: tuple[str, str]) -> FloatArray | None:
    """Pose (4, 4) of a raw drive's rectified left camera on the inertial unit.

    By calib_cam_to_cam.txt and the two files beside it that lead over the laser scanner; None
    where those are absent.

    Raises:
        CalibrationError: a line is missing or malformed.
    """
    chain = [path.parent / f"calib_{name}.txt" for name in ("imu_to_velo", "velo_to_cam")]
    if not all(file.is_file() for file in chain):
        return None
    to_scanner, to_camera = (
        pose(_Lines(file).numbers("R", 9).reshape(3, 3), _Lines(file).numbers("T", 3))
        for file in chain
    )
    lines = _Lines(path)
    upright = pose(lines.numbers("R_rect_00", 9).reshape(3, 3), np.zeros(3))
    left = lines.numbers(keys[0], 12).reshape(3, 4)
    beside = pose(np.eye(3), np.array([-left[0, 3] / left[0, 0], 0.0, 0.0]))
    return np.asarray(inverse(reorthonormalise(upright @ to_camera @ to_scanner)) @ beside)


class _Lines:
    """Number and words of each line ``name: words`` of a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.words: dict[str, tuple[int, list[str]]] = {}
        for line, text in read_lines(path, CalibrationError):
            name, _, rest = text.partition(":")
            self.words.setdefault(name.strip(), (line, rest.split()))

    def numbers(self, key: str, count: int, words: str = "") -> FloatArray:
        """(count,) of a line ``key: numbers``. Raises CalibrationError."""
        if key not in self.words:
            raise CalibrationError(
                f"{self.path} has no line {key!r}; restore the file of the data set"
            )
        line, given = self.words[key]
        found = flat_numbers(given)
        if found is None or len(found) != count:
            raise CalibrationError(
                f"{self.path}, line {line}: {key} must be {words or f'{count} finite numbers'}; "
                "restore the file"
            )
        return found
