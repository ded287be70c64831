"""Calibration files of other tools: which key holds which number, in what unit.

A format is a :class:`Row` of keys, or a few lines around one. Which format a file has is found at
the end (:func:`calibration_of_tree`, :func:`calibration_of_text`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from configparser import ConfigParser, Error as ConfigParserError
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fgslam.cameras.calib_json import OF_RECTIFIED, is_own, is_rectified, read_own
from fgslam.cameras.lenses import Calibration, RawCamera, View, checked_camera, checked_view
from fgslam.cameras.omni import read_ocamcalib
from fgslam.cameras.trees import (
    BROWN,
    FOCAL,
    KANNALA,
    ORIGIN,
    Row,
    Size,
    Tree,
    Values,
    camera_of,
    intrinsic_matrix,
    kind_of,
    lens_named,
    listed_lenses,
    read_tree,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_lines
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    inverse,
    pose,
    reorthonormalise,
    rotation_from_quaternion,
)

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


def is_opencv_pair(tree: Tree) -> bool:
    """Whether it holds intrinsics or extrinsics of two cameras by OpenCV's usual names."""
    return has_intrinsics(tree) or (has_step(tree) and "distortion_model" not in tree)


def has_intrinsics(tree: Tree) -> bool:
    """Whether it holds the intrinsics of two cameras."""
    return _pair(_flat(tree), _MATRICES) is not None


def has_step(tree: Tree) -> bool:
    """Whether it holds the pose of one camera to another."""
    return _step(_flat(tree)) is not None


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


def _read_opencv_one(path: Path, tree: Tree, size: Size | None) -> Calibration:
    """One camera, as OpenCV's sample program calibration or cv2.omnidir writes it."""
    part = Values(path, tree)
    matrix = part.matrix(next(key for key in _ONE if key in part), 3, 3)
    name = next((key for key in _OF_ONE if key in part), "")
    coefficients = part.numbers(name) if name else np.zeros(4)
    model = "radtan"
    if "xi" in part:
        model, coefficients = "omni", np.append(part.number("xi"), coefficients)
    elif part.number("fisheye_model", 0.0):
        model = "equidistant"
    else:
        model = lens_named(_stated_lens(part)) or model
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
    known = _stated_lens(part) or any(len(c.distortion) != 4 for c in cameras)
    found = Calibration(str(path), "OpenCV stereo calibration", tuple(cameras), True)
    return replace(found, guessed_lens="" if known else cameras[0].model)


def _stated_lens(part: Values) -> str:
    return part.text("distortion_model") or part.text("model")


def _opencv_lens(part: Values, distortion: str, matrix: str, k: int) -> tuple[str, FloatArray]:
    """Model and parameters. cv2.fisheye's files name matrices K and have four coefficients."""
    coefficients = part.numbers(distortion)
    if f"xi{k + 1}" in part:
        return "omni", np.append(part.number(f"xi{k + 1}"), coefficients)
    fisheye = matrix.rpartition(" ")[2][0] == "K" and len(coefficients) == 4
    if stated := _stated_lens(part):
        return lens_named(stated) or "radtan", coefficients
    return "equidistant" if fisheye else "radtan", coefficients


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
_ROS_NAMES = (*(_COEFFICIENTS, "camera_matrix"), *("rectification_matrix", "projection_matrix"))
_ROS = Row(
    size=("image_width", "image_height"),
    matrix="camera_matrix",
    kind=("distortion_model",),
    lenses=listed_lenses(_COEFFICIENTS, "radtan", "equidistant", "fov", none="radtan"),
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
    view = checked_view(View(p_right[:, :3], left.size, (r_left, r_right)), source)
    return Calibration(source, "ROS camera_info, a pair", cameras, True, view)


def _ros_camera(path: Path, tree: Tree) -> tuple[RawCamera, FloatArray, FloatArray]:
    """The camera, its rectifying rotation (3, 3) and its projection (3, 4)."""
    tree = _as_ros_file(tree)
    part = Values(path, tree)
    rotation, projection = np.eye(3), np.zeros((3, 4))
    if "projection_matrix" in part:
        projection = part.matrix("projection_matrix", 3, 4)
    uncalibrated = not part.numbers("camera_matrix").any()
    if uncalibrated and not part.numbers(_COEFFICIENTS).any():
        # Of images that are rectified already some drivers state P alone.
        part = Values(path, {**tree, "camera_matrix": projection[:, :3]})
    raw = camera_of(part, _ROS, name=path.name if path.suffix else str(path))
    if not projection.any():
        projection = np.column_stack([raw.matrix, np.zeros(3)])
    if "rectification_matrix" in part:
        turn = pose(part.matrix("rectification_matrix", 3, 3), np.zeros(3))
        rotation = reorthonormalise(turn)[:3, :3]
        if not np.allclose(rotation, turn[:3, :3], atol=1e-3):
            raise part.refuse("rectification_matrix is not a rotation; calibrate again")
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
    where only that has images next to the file.

    Raises:
        CalibrationError: a line is missing or malformed, or the pair is not rectified.
    """
    lines = _lines(path)
    raw = sorted(name for name in lines.tree if name.startswith(_P_RECT))
    stated = (raw[0], raw[1]) if len(raw) == 2 else KITTI_RAW  # DrivingStereo: 101, 103
    keys = keys or (stated if raw else _kitti_keys(path))
    left, right = (lines.matrix(key, 3, 4) for key in keys)
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
    if raw and sized in lines:
        size = lines.size(sized)
    cameras = []
    for key, x in zip(keys, (-baseline, 0.0), strict=True):
        bTc = BODY_FORWARD_LEFT_UP_FROM_CAMERA @ pose(np.eye(3), np.array([x, 0.0, 0.0]))
        name, shown = f"{path.name}: {key}", size or (0, 0)
        cameras.append(checked_camera(RawCamera(*shown, left[:, :3], np.zeros(4), bTc, name)))
    return Calibration(str(path), "KITTI", tuple(cameras), sided=True)


def pair_beside(path: Path) -> tuple[int, int] | None:
    """Left and right camera whose folders of images lie next to a calib.txt; None: of no pair."""
    for pair in _KITTI_PAIRS:
        if all((path.parent / f"image_{number}").is_dir() for number in pair):
            return pair
    return None


def _kitti_keys(path: Path) -> tuple[str, str]:
    """Lines of the pair whose images lie next to a calib.txt; of the grey one where none does."""
    left, right = pair_beside(path) or _KITTI_PAIRS[0]
    return f"P{left}", f"P{right}"


def right_of_camera_0(path: Path) -> float:
    """How far the pair's right camera is to the right of camera 0, whose poses KITTI gives, metres.

    Raises:
        CalibrationError: a line is missing or malformed.
    """
    right = _lines(path).matrix(_kitti_keys(path)[1], 3, 4)
    return -float(right[0, 3] / right[0, 0])


def left_on_inertial_unit(path: Path, keys: tuple[str, str]) -> FloatArray | None:
    """Pose (4, 4) of a raw drive's rectified left camera on the inertial unit.

    By calib_cam_to_cam.txt and the two files next to it that lead over the laser scanner; None
    where those are absent.

    Raises:
        CalibrationError: a line is missing or malformed.
    """
    chain = [path.parent / f"calib_{name}.txt" for name in ("imu_to_velo", "velo_to_cam")]
    if not all(file.is_file() for file in chain):
        return None
    steps = [(lines.matrix("R", 3, 3), lines.numbers("T", 3)) for lines in map(_lines, chain)]
    to_scanner, to_camera = (pose(*step) for step in steps)
    lines = _lines(path)
    upright = pose(lines.matrix("R_rect_00", 3, 3), np.zeros(3))
    left = lines.matrix(keys[0], 3, 4)
    sideways = pose(np.eye(3), np.array([-left[0, 3] / left[0, 0], 0.0, 0.0]))
    return np.asarray(inverse(reorthonormalise(upright @ to_camera @ to_scanner)) @ sideways)


def _lines(path: Path) -> Values:
    """Words of each line ``name: words`` of a file."""
    parted = [text.partition(":") for _, text in read_lines(path, CalibrationError)]
    return Values(path, {name.strip(): words.split() for name, _, words in reversed(parted)})


# --------------------------------------------------------------------------------------------
# Kalibr's camchain, and the files of tools that write it: OpenVINS, MSCKF-VIO, Kimera-VIO


KALIBR = {
    "pinhole-radtan": ("radtan", 0),
    "pinhole-none": ("radtan", 0),
    "pinhole-equidistant": ("equidistant", 0),
    "pinhole-fov": ("fov", 0),
    "omni-radtan": ("omni", 1),
    "omni-none": ("omni", 1),
    "mei-radtan": ("omni", 1),
    "ds-none": ("ds", 2),
    "eucm-none": ("eucm", 2),
}
"""Our model, and how many of the intrinsics are the model's own; fx, fy, cx and cy follow."""
_CONTRADICTION_M, _CONTRADICTION_DEG = 0.005, 1.0  # what two calibrations of one rig agree to


def is_camchain(tree: Tree) -> bool:
    """Whether it holds a camera ``cam0`` with a model, as Kalibr writes it."""
    first = tree.get("cam0", tree.get("input_camera"))
    return isinstance(first, dict) and "camera_model" in first


def _read_camchain(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """Cameras ``cam0``, ``cam1``, ...; the body is the IMU where it is stated, else the first.

    ``T_cn_cnm1`` of a camera takes points from the axes of the one before it to its own,
    ``T_cam_imu`` those of the IMU, and ``T_imu_cam`` is a camera's pose in the IMU.
    """
    names = [name for name in (f"cam{k}" for k in range(16)) if name in tree] or ["input_camera"]
    parts = [Values(path, tree[name], f"{name}.") for name in names]
    by_imu = all("T_cam_imu" in part or "T_imu_cam" in part for part in parts)
    cameras: list[RawCamera] = []
    for part in parts:
        if cameras and ("T_cn_cnm1" in part or not by_imu):  # what Kalibr measured directly
            bTc = cameras[-1].bTc @ inverse(part.motion("T_cn_cnm1"))
        elif not by_imu:
            bTc = np.eye(4)
        elif "T_imu_cam" in part:
            bTc = part.motion("T_imu_cam")
        else:
            bTc = inverse(part.motion("T_cam_imu"))
        cameras.append(_kalibr_camera(part, bTc))
    notes = (_contradiction(part, k, parts, cameras) for k, part in enumerate(parts) if k)
    return Calibration(
        str(path), "Kalibr camchain", tuple(cameras), notes=tuple(filter(None, notes))
    )


def _kalibr_camera(part: Values, bTc: FloatArray) -> RawCamera:
    model, own = KALIBR[kind_of(part, ("camera_model", "distortion_model"), KALIBR)]
    intrinsics = part.numbers("intrinsics", own + 4)
    none = part.text("distortion_model", "none") == "none"
    coefficients = np.zeros(0) if none else part.numbers("distortion_coeffs")
    if model == "omni" and not len(coefficients):
        coefficients = np.zeros(4)
    matrix, lens = intrinsic_matrix(*intrinsics[own:]), np.append(intrinsics[:own], coefficients)
    named = part.name, model, str(part.tree.get("rostopic") or "")
    return checked_camera(RawCamera(*part.size("resolution"), matrix, lens, bTc, *named))


def _contradiction(part: Values, k: int, parts: list[Values], cameras: list[RawCamera]) -> str:
    """A note where the step to a camera and the places on the IMU contradict each other."""
    if not all("T_cam_imu" in p for p in (part, parts[k - 1])) or "T_cn_cnm1" not in part:
        return ""
    by_imu = parts[k - 1].motion("T_cam_imu") @ inverse(part.motion("T_cam_imu"))
    away, turn = pose_difference(by_imu, inverse(cameras[k - 1].bTc) @ cameras[k].bTc)
    if away < _CONTRADICTION_M and turn < _CONTRADICTION_DEG:
        return ""
    return (
        f"{part.path.name}: {part.where}T_cn_cnm1 and T_cam_imu contradict each other by "
        f"{away:.3f} m and {turn:.1f} degrees; T_cn_cnm1 is taken"
    )


def pose_difference(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance, and angle in degrees, between two poses (4, 4)."""
    cosine = 0.5 * (float(np.trace(a[:3, :3].T @ b[:3, :3])) - 1.0)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(angle)


# --------------------------------------------------------------------------------------------
# The ASL layout (EuRoC): one sensor.yaml a camera


_ASL = Row(
    size=("resolution",),
    focal=("intrinsics",),
    kind=("distortion_model",),
    lenses=listed_lenses(_COEFFICIENTS, "radtan", "equidistant", "fov") | {"none": ("radtan", ())},
)


def is_asl(tree: Tree) -> bool:
    """Whether it is a camera's sensor.yaml."""
    return "T_BS" in tree and "intrinsics" in tree


def read_asl_camera(path: Path, tree: Tree) -> RawCamera:
    """The camera of a sensor.yaml; ``T_BS`` is its pose in the body.

    Raises:
        CalibrationError: a value is missing, not finite or impossible, or the distortion model is
            not known.
    """
    part = Values(path, tree)
    name = str(path.parent) if path.name == "sensor.yaml" else path.name
    bTc = part.motion("T_BS") if "T_BS" in part else np.eye(4)
    return camera_of(part, _ASL, bTc, name)


def read_asl_mounting(path: Path) -> FloatArray:
    """``T_BS`` (4, 4) of a sensor.yaml: the pose of the sensor in the body."""
    return Values(path, read_tree(path)).motion("T_BS")


# --------------------------------------------------------------------------------------------
# Settings of SLAM programs: ORB-SLAM 2 and 3, camodocal, VINS-Fusion


_ORB = {
    **dict.fromkeys(("pinhole", "perspective", "rectified"), "radtan"),
    **dict.fromkeys(("kannalabrandt8", "fisheye"), "equidistant"),
}


_STELLA = {"cols": "width", "rows": "height", "model": "type", "focal_x_baseline": "bf"}
_STELLA_SIDES = {
    f"{side}.{letter}": f"{letter}_{side.lower()}" for side in ("LEFT", "RIGHT") for letter in "KDR"
}


def is_orb_slam(tree: Tree) -> bool:
    """Whether it holds settings of ORB-SLAM or of stella_vslam (OpenVSLAM)."""
    return any(f"{name}.fx" in Values(Path(), tree) for name in ("Camera", "Camera1"))


def _of_stella(path: Path, tree: Tree) -> tuple[Tree, tuple[str, ...]]:
    """Settings of stella_vslam by the keys of ORB-SLAM's, and what was noticed; others as is."""
    part = Values(path, tree)
    if "Camera.cols" not in part:
        return tree, ()
    given = {k.partition(".")[2]: v for k, v in tree.items() if k.startswith("Camera.")}
    camera = {**given, **part.inside("Camera").tree}
    known = {f"Camera.{_STELLA.get(key, key)}": value for key, value in camera.items()}
    notes: tuple[str, ...] = ()
    if "StereoRectifier.K_left" in part:
        for ours, theirs in _STELLA_SIDES.items():
            known[ours] = part.numbers(f"StereoRectifier.{theirs}")
        fx, fy, cx, cy, shift = Values(path, camera).values((*FOCAL, "focal_x_baseline"))
        known["RIGHT.P"] = [fx, 0.0, cx, -shift, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        width, middle = part.number("Camera.cols"), known["LEFT.K"][2]
        if abs(middle / width - 0.25) < _SIDE_BY_SIDE:
            known["Camera.width"] = round(0.5 * width)
            notes = (f"{path.name}: {width:g} columns are both views side by side, and halved",)
    return known, notes


_SIDE_BY_SIDE = 0.1  # of both views' width, that the principal point lies off the middle of one


def _read_orb_slam(path: Path, tree: Tree, size: Size | None) -> Calibration:
    """The pair of a stereo file, or the one camera of another; the body is the left one."""
    tree, notes = _of_stella(path, tree)
    part, view = Values(path, {"Camera.type": "pinhole", **tree}), None
    model = _ORB[kind_of(part, ("Camera.type",), _ORB)]
    if "Camera.width" in part or size is None:
        size = part.size("Camera.width", "Camera.height")
    part = Values(path, {**part.tree, "size": list(size)})
    if "LEFT.K" in part and "RIGHT.K" in part:  # with the rectification of both
        projection = part.matrix("RIGHT.P", 3, 4)
        turns = part.matrix("LEFT.R", 3, 3), part.matrix("RIGHT.R", 3, 3)
        view = checked_view(View(projection[:, :3], size, turns), str(path))
        places = projection[0, 3] / projection[0, 0], 0.0
        pair = []
        for side, turn, x in zip(("LEFT", "RIGHT"), turns, places, strict=True):
            row = Row(("size",), {"": ("radtan", (f"{side}.D",))}, matrix=f"{side}.K")
            place = pose(turn, np.array([x, 0.0, 0.0]))
            pair.append(camera_of(part, row, place, f"{path.name}: {side}.K"))
        return Calibration(str(path), "ORB-SLAM settings", tuple(pair), True, view, notes)

    def camera(prefix: str, bTc: FloatArray) -> RawCamera:
        terms = KANNALA if model == "equidistant" else BROWN
        keys = tuple(f"{prefix}{name}?" for name in terms)
        if model == "radtan" and prefix + "k3" in part:
            keys = (*keys, prefix + "k3")
        focal = tuple(prefix + name for name in FOCAL)
        row = Row(("size",), {"": (model, keys)}, focal=focal)
        return camera_of(part, row, bTc, f"{path.name}: {prefix[:-1]}")

    first = "Camera1." if "Camera1.fx" in part else "Camera."
    cameras = [camera(first, np.eye(4))]
    lTr = next((part.motion(key) for key in ("Stereo.T_c1_c2", "Tlr") if key in part), None)
    if lTr is None and ("Stereo.b" in part or "Camera.bf" in part):
        focal = float(cameras[0].matrix[0, 0])
        given = "Stereo.b" in part
        baseline = part.number("Stereo.b") if given else part.number("Camera.bf") / focal
        lTr = pose(np.eye(3), np.array([baseline, 0.0, 0.0]))
    if lTr is not None:
        cameras.append(camera("Camera2." if "Camera2.fx" in part else first, lTr))
    return Calibration(str(path), "ORB-SLAM settings", tuple(cameras), sided=True)


_PROJECTION, _DISTORTION = "projection_parameters.{}", "distortion_parameters.{}"
_BROWN = tuple(map(_DISTORTION.format, BROWN))
_CAMODOCAL = {
    kind: Row(
        size=("image_width", "image_height"),
        focal=tuple(map(_PROJECTION.format, focal)),
        lenses={"": lens},
    )
    for kind, focal, lens in (
        ("pinhole", FOCAL, ("radtan", _BROWN)),
        ("mei", ("gamma1", "gamma2", "u0", "v0"), ("omni", ("mirror_parameters.xi", *_BROWN))),
        (
            "kannala_brandt",
            ("mu", "mv", "u0", "v0"),
            ("equidistant", tuple(map(_PROJECTION.format, ("k2", "k3", "k4", "k5")))),
        ),
    )
}


def is_camodocal(tree: Tree) -> bool:
    """Whether it is one camera of camodocal."""
    return "model_type" in tree


def _camodocal(path: Path, tree: Tree, bTc: FloatArray = ORIGIN) -> RawCamera:
    part = Values(path, tree)
    return camera_of(part, _CAMODOCAL[kind_of(part, ("model_type",), _CAMODOCAL)], bTc)


def _read_vins(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """Its cameras, each in a file of camodocal next to it; the body is the IMU."""
    part = Values(path, tree)
    cameras = []
    for k in (0, 1):
        if f"cam{k}_calib" not in part:
            continue
        file = path.parent / str(part.tree[f"cam{k}_calib"])
        if not file.is_file():  # a path of another machine
            file = path.with_name(file.name)
        own = read_tree(file)
        if own is None or not is_camodocal(own):
            raise part.refuse(f"cam{k}_calib names {file}, which is no camera of camodocal")
        cameras.append(_camodocal(file, own, part.motion(f"body_T_cam{k}")))
    return Calibration(str(path), "VINS-Fusion configuration", tuple(cameras))


# --------------------------------------------------------------------------------------------
# Basalt


def _inner(*names: str) -> tuple[str, ...]:
    return tuple(f"intrinsics.{name}" for name in names)


_BASALT = Row(
    size=("resolution",),
    focal=_inner(*FOCAL),
    kind=("camera_type",),
    lenses={
        "pinhole": ("radtan", ()),
        "ds": ("ds", _inner("xi", "alpha")),
        "eucm": ("eucm", _inner("alpha", "beta")),
        "kb4": ("equidistant", _inner(*KANNALA)),
        "pinhole-radtan8": ("radtan", _inner(*BROWN, "k3", "k4", "k5", "k6")),
        "pinhole-equi": ("equidistant", _inner(*KANNALA)),
    },
)


def _read_basalt(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """The cameras; the body is the IMU."""
    part = Values(path, tree["value0"], "value0.")
    lists = [part.tree.get(key) for key in ("T_imu_cam", "intrinsics", "resolution")]
    if not all(isinstance(one, list) for one in lists) or len({len(one) for one in lists}) > 1:  # type: ignore[arg-type]
        raise part.refuse("T_imu_cam, intrinsics and resolution must be lists of one length")
    cameras = []
    for k, (place, inner, size) in enumerate(zip(*lists, strict=True)):
        at = Values(path, place, f"T_imu_cam {k}: ")
        quaternion = at.values(("qx", "qy", "qz", "qw"))
        turn = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))
        bTc = pose(turn, at.values(("px", "py", "pz")))
        known = inner if isinstance(inner, dict) else {}
        one = Values(path, {**known, "resolution": size}, f"intrinsics {k}: ")
        cameras.append(camera_of(one, _BASALT, bTc, f"{path.name}: camera {k}"))
    return Calibration(str(path), "Basalt calibration", tuple(cameras))


# --------------------------------------------------------------------------------------------
# OAK (DepthAI): lengths are centimetres


def _read_oak(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """The stereo pair, left first; the body is the left camera."""
    data = tree["cameraData"] if isinstance(tree["cameraData"], list) else []
    boards = {
        int(one[0]): Values(path, one[1], f"camera {one[0]}: ")
        for one in data
        if isinstance(one, list) and len(one) == 2 and isinstance(one[0], int)
    }
    stereo = Values(path, tree.get("stereoRectificationData"), "stereoRectificationData.")
    sockets = ("leftCameraSocket", 1.0), ("rightCameraSocket", 2.0)
    left, right = (round(stereo.number(key, k)) for key, k in sockets)
    if not {left, right} <= boards.keys():
        raise CalibrationError(f"{path}: holds no stereo pair, of sockets {left} and {right}")
    for a, b in ((left, right), (right, left)):  # either names the other
        part = boards[a].inside("extrinsics")
        if round(part.number("toCameraSocket", -1.0)) == b:
            moved = 0.01 * part.inside("translation").values(("x", "y", "z"))
            bTa = pose(part.matrix("rotationMatrix", 3, 3), moved)
            lTr = inverse(bTa) if a == left else bTa
            break
    else:
        raise boards[left].refuse("extrinsics do not lead to the other camera of the pair")
    cameras = (_oak_camera(boards[left], np.eye(4)), _oak_camera(boards[right], lTr))
    return Calibration(str(path), "OAK calibration", cameras, sided=True)


_OAK = Row(
    size=("width", "height"),
    matrix="intrinsicMatrix",
    kind=("cameraType",),  # CameraModel of DepthAI
    lenses=listed_lenses("distortionCoeff", **{"0": "radtan", "1": "equidistant"}),
)


def _oak_camera(part: Values, bTc: FloatArray) -> RawCamera:
    values = {**part.tree, "cameraType": round(part.number("cameraType", 0.0))}
    return camera_of(Values(part.path, values, part.where), _OAK, bTc)


# --------------------------------------------------------------------------------------------
# ZED: lengths are millimetres


_ZED_SIZES = {
    "2K": (2208, 1242),
    "FHD1200": (1920, 1200),
    "FHD": (1920, 1080),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}
_LONG_BROWN = (*BROWN, "k3", "k4", "k5", "k6")


def _read_zed(path: Path, text: str, size: Size | None) -> Calibration:
    """The pair at one of its resolutions; the body is the left camera.

    ``RX``, ``CV`` and ``RZ`` are the rotation vector that takes points from the left to the right
    camera.
    """
    parser = ConfigParser(interpolation=None)
    try:
        parser.read_string(text)
    except ConfigParserError as error:
        raise CalibrationError(f"{path}: {' '.join(str(error).split())}") from None
    sizes = {name: s for name, s in _ZED_SIZES.items() if f"LEFT_CAM_{name}" in parser}
    chosen = [name for name, s in sizes.items() if size in (None, s)]
    if not chosen:
        known = ", ".join(f"{w}x{h}" for w, h in sizes.values())
        raise CalibrationError(f"{path}: no calibration for {size}; there are {known}")
    name = "HD" if "HD" in chosen else chosen[0]

    def section(title: str) -> dict[str, str]:
        return dict(parser.items(title)) if parser.has_section(title) else {}

    stereo = Values(path, section("STEREO"), "STEREO: ")
    turn = stereo.values([f"{axis}_{name.lower()}" for axis in ("rx", "cv", "rz")])
    shift = -1e-3 * stereo.values(("baseline?", "ty?", "tz?"))
    lTr = inverse(pose(np.asarray(cv2.Rodrigues(turn)[0]), shift))
    cameras = []
    for side, bTc in (("LEFT", np.eye(4)), ("RIGHT", lTr)):
        # The lens has a part of its own in files of ZED X.
        part = Values(path, section(f"{side}_DISTO") | section(f"{side}_CAM_{name}"), f"{side}: ")
        lens = part.values([f"{term}?" for term in _LONG_BROWN])
        lens = lens if lens[5:].any() else lens[:5]
        matrix = part.intrinsics(FOCAL)
        cameras.append(checked_camera(RawCamera(*_ZED_SIZES[name], matrix, lens, bTc, part.name)))
    notes = () if len(chosen) == 1 else (f"taken at {name}; give the size for another",)
    return Calibration(str(path), "ZED factory file", tuple(cameras), True, None, notes)


# --------------------------------------------------------------------------------------------
# RealSense, and what Open3D writes of it


_PRINCIPAL = ("fx", "fy", "ppx", "ppy")  # rs2_intrinsics
_LISTS = ("coeffs", "distortion", "distortion_coefficients", "dist_coeffs", "dist", "D")


def is_realsense(tree: Tree) -> bool:
    """Whether it is the intrinsics of one camera as librealsense, Open3D or people name them."""
    plain = tree.keys() >= {*FOCAL, "width", "height"}
    alone = plain and not (OF_RECTIFIED - {"fx"}) & tree.keys()
    return alone or "intrinsic_matrix" in tree or tree.keys() >= set(_PRINCIPAL)


def _realsense(path: Path, tree: Tree) -> RawCamera:
    """One camera; Open3D's matrix goes column by column, other people's row by row."""
    part = Values(path, tree)
    if "intrinsic_matrix" in part:
        given = part.matrix("intrinsic_matrix", 3, 3)
        matrix = given.T if given[2, :2].any() else given
        if not np.array_equal(matrix[2], (0.0, 0.0, 1.0)):
            raise part.refuse("intrinsic_matrix must end with the row 0 0 1; correct the file")
    else:
        matrix = part.intrinsics(_PRINCIPAL if "ppx" in part else FOCAL)
    model, lens = _realsense_lens(part)
    size = part.size("width", "height")
    return checked_camera(RawCamera(*size, matrix, lens, np.eye(4), path.name, model))


def _realsense_lens(part: Values) -> tuple[str, FloatArray]:
    """Model and parameters, by rs2_distortion where that is stated, else OpenCV's."""
    key = next((k for k in ("model", "distortion_model", "camera_model") if k in part), "model")
    model = lens_named(part.text(key))
    model = model if model in ("radtan", "equidistant") else ""
    listed = next((k for k in _LISTS if k in part), None)
    if listed is not None:
        found = part.numbers(listed)
    else:
        terms: tuple[str, ...] = _LONG_BROWN if "k4" in part else _LONG_BROWN[:5]
        terms = KANNALA if model == "equidistant" else terms
        found = part.values([f"{term}?" for term in terms])
        if found[5:].any() and "p1" not in part:
            raise part.refuse('k1 to k4 without p1, p2 need "model": fisheye or brown_conrady')
    if model == "equidistant":
        return model, found[:4]  # librealsense has five, the last without a meaning
    if found.any() and not model:
        raise part.refuse(
            f"{key} {part.text(key)} is not known with coefficients other than 0; known: "
            "brown_conrady, kannala_brandt4"
        )
    return "radtan", found if found.any() else np.zeros(4)


# --------------------------------------------------------------------------------------------
# One colour camera, next to its depth: Replica's cam_params.json, NICE-SLAM's and SplaTAM's
# configurations


_PARTS = ("camera", "cam", "camera_params")
_SIZES = (("w", "h"), ("W", "H"), ("image_width", "image_height"))


def rgbd_part(tree: Tree) -> Tree:
    """The part of a configuration that holds fx, fy, cx, cy and the size; empty without one."""
    found = [part for key in _PARTS if isinstance(part := tree.get(key), Mapping)]
    needed = ({*FOCAL, *size} for size in _SIZES)
    return next((part for keys in needed for part in found if keys <= part.keys()), {})


def _rgbd(path: Path, tree: Tree) -> RawCamera:
    part = Values(path, rgbd_part(tree), "camera: ")
    size = next(keys for keys in _SIZES if keys[0] in part)
    return camera_of(part, Row(size, {"": ("radtan", ())}), name="camera")


# --------------------------------------------------------------------------------------------
# OCamCalib


def _is_ocamcalib(text: str) -> bool:
    lines = (line.split() for line in text.splitlines() if not line.startswith("#"))
    first = next((words for words in lines if words), [""])
    return first[0].isdecimal() and first[0].lstrip("0") == str(len(first) - 1)


# --------------------------------------------------------------------------------------------
# COLMAP: cameras.txt, and rigs.txt next to it


_COLMAP = {  # how many focal lengths, our model, and how many of its terms
    "SIMPLE_PINHOLE": (1, "radtan", 0),
    "PINHOLE": (2, "radtan", 0),
    "SIMPLE_RADIAL": (1, "radtan", 1),
    "RADIAL": (1, "radtan", 2),
    "OPENCV": (2, "radtan", 4),
    "FULL_OPENCV": (2, "radtan", 8),
    "OPENCV_FISHEYE": (2, "equidistant", 4),
    "SIMPLE_RADIAL_FISHEYE": (1, "equidistant", 1),
    "RADIAL_FISHEYE": (1, "equidistant", 2),
    "FOV": (2, "fov", 1),
}
_COLMAP_LINE = re.compile(r"^\d+ [A-Z_0-9]+ \d+ \d+( [-+.\deE]+)+\s*$", re.MULTILINE)


def _read_colmap(path: Path, text: str, _: Size | None) -> Calibration:
    """The cameras; the body is the rig, else the only camera."""
    found = (match[0].split() for match in _COLMAP_LINE.finditer(text))
    lines = {int(words[0]): words[1:] for words in found}
    places = _colmap_rig(path.with_name("rigs.txt"))
    if len(lines) > 1 and not places.keys() >= lines.keys():
        raise CalibrationError(
            f"{path} of COLMAP holds {len(lines)} cameras, but not how they stand to each other; "
            "put the rigs.txt of COLMAP 3.12 or later next to it, which "
            "`colmap model_converter --output_type TXT` writes"
        )
    cameras = []
    for key, (name, *words) in lines.items():
        part = Values(path, {"all": words}, f"camera {key}: ")
        if name not in _COLMAP:
            raise part.refuse(f"model {name} is not known; known: {', '.join(_COLMAP)}")
        (focals, model, terms), numbers = _COLMAP[name], part.numbers("all")
        if len(numbers) != 4 + focals + terms:
            raise part.refuse(f"{name} has {2 + focals + terms} parameters; correct the line")
        inner = numbers[2:]
        matrix = intrinsic_matrix(inner[0], inner[focals - 1], *inner[focals : focals + 2])
        lens = np.append(inner[focals + 2 :], np.zeros(max(0, 4 - terms) if model != "fov" else 0))
        size = int(words[0]), int(words[1])
        bTc = places.get(key, ORIGIN)
        cameras.append(checked_camera(RawCamera(*size, matrix, lens, bTc, part.name, model)))
    return Calibration(str(path), "COLMAP cameras", tuple(cameras))


def _colmap_rig(path: Path) -> dict[int, FloatArray]:
    """Pose (4, 4) of each camera in the first rig's reference sensor, by number; or none."""
    places: dict[int, FloatArray] = {}
    if not path.is_file():
        return places
    words = read_lines(path, CalibrationError)[0][1].split()
    kind, number, rest = words[2], words[3], words[4:]
    places = {int(number): ORIGIN} if kind == "CAMERA" else {}
    while len(rest) >= 3:
        posed = rest[2] == "1"
        if rest[0] == "CAMERA" and posed:
            w, x, y, z, *moved = Values(path, {"pose": rest[3:10]}).numbers("pose", 7)
            turn = np.array([x, y, z, w]) / np.linalg.norm((w, x, y, z))
            places[int(rest[1])] = inverse(pose(rotation_from_quaternion(turn), np.array(moved)))
        rest = rest[10:] if posed else rest[3:]
    return places


# --------------------------------------------------------------------------------------------
# Which format a file has


KNOWN = (
    "known: calib.json of fgslam, Kalibr's camchain, OpenCV's stereo files (M1, D1, M2, D2, R, T), "
    "left.yaml and right.yaml of ROS camera_info, KITTI's calib.txt, EuRoC's sensor.yaml, settings "
    "of ORB-SLAM, stella_vslam and VINS, files of COLMAP, Basalt, OAK, ZED, RealSense and OCamCalib"
)
Reader = Callable[[Path, Tree, Size | None], Calibration]


def _one(form: str, camera: Callable[[Path, Any], RawCamera]) -> Callable[..., Calibration]:
    """The reader of a format of one camera."""
    return lambda path, tree, _: Calibration(str(path), form, (camera(path, tree),))


_READERS: tuple[tuple[Callable[[Tree], bool], Reader], ...] = (
    (is_realsense, _one("RealSense intrinsics", _realsense)),
    (is_own, read_own),
    (lambda tree: "T_imu_cam" in Values(Path(), tree).inside("value0"), _read_basalt),
    (lambda tree: {"cameraData", "boardName"} <= tree.keys(), _read_oak),
    (is_camchain, _read_camchain),
    (is_asl, _one("ASL sensor.yaml", read_asl_camera)),
    (is_camera_info, lambda path, tree, _: read_camera_info(path, tree)),
    (lambda tree: "cam0_calib" in tree, _read_vins),
    (is_camodocal, _one("camodocal camera", _camodocal)),
    (is_orb_slam, _read_orb_slam),
    (lambda tree: bool(rgbd_part(tree)), _one("camera of colour and depth", _rgbd)),
    (is_opencv_pair, read_opencv_pair),
    (lambda tree: any(isinstance(tree.get(key), np.ndarray) for key in _ONE), _read_opencv_one),
)
"""What recognises a format by its keys, and reads it; the first that fits counts."""

_TEXTS: tuple[
    tuple[Callable[[str], bool], Callable[[Path, str, Size | None], Calibration]], ...
] = (
    (
        lambda text: re.search(r"^(P0|P_rect_\d+):", text, re.M) is not None,
        lambda path, _, size: read_kitti(path, size),
    ),
    (lambda text: "[LEFT_CAM_" in text and "[STEREO]" in text, _read_zed),
    (
        _is_ocamcalib,  # forward along its axis
        _one("OCamCalib", lambda path, _: replace(read_ocamcalib(path)[0], name=path.name)),
    ),
    (lambda text: _COLMAP_LINE.search(text) is not None, _read_colmap),
)
"""The same of files that are no keys and values."""


def is_opencv_half(tree: Tree) -> bool:
    """Whether it holds either intrinsics or extrinsics of a pair, and the rest is elsewhere."""
    if has_intrinsics(tree) == has_step(tree) or is_rectified(tree):
        return False
    known = next((read for recognises, read in _READERS if recognises(tree)), None)
    return known is read_opencv_pair


def calibration_of_text(path: Path, text: str, size: Size | None) -> Calibration | None:
    """What a file of other texts than keys and values states; None: it is of no such format."""
    found = (read(path, text, size) for recognises, read in _TEXTS if recognises(text))
    return next(found, None)


def calibration_of_tree(path: Path, tree: Tree, size: Size | None) -> Calibration | None:
    """What keys and values say; None: they are of no format that is known."""
    for recognises, read in _READERS:
        if recognises(tree):
            return read(path, tree, size)
    return None
