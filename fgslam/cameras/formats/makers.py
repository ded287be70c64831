"""Files of other programs and of cameras' makers: Basalt, OAK, ZED, RealSense, OCamCalib."""

from __future__ import annotations

import re
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras.formats.kalibr import ocam_matrix
from fgslam.cameras.formats.trees import Tree, Values, intrinsic_matrix, motion_of
from fgslam.cameras.omni.ocamcalib import read_ocamcalib
from fgslam.cameras.raw_cameras import Calibration, RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, pose

_FOCAL = ("fx", "fy", "cx", "cy")


# --------------------------------------------------------------------------------------------
# Basalt


_BASALT = {
    "pinhole": ("radtan", ()),
    "ds": ("ds", ("xi", "alpha")),
    "eucm": ("eucm", ("alpha", "beta")),
    "kb4": ("equidistant", ("k1", "k2", "k3", "k4")),
    "pinhole-radtan8": ("radtan", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "pinhole-equi": ("equidistant", ("k1", "k2", "k3", "k4")),
}


def is_basalt(tree: Tree) -> bool:
    """Whether it is a calibration of Basalt."""
    inner = tree.get("value0")
    return isinstance(inner, dict) and "T_imu_cam" in inner


def read_basalt(path: Path, tree: Tree) -> Calibration:
    """The cameras; the body is the IMU.

    Raises:
        CalibrationError: a value is missing or impossible, or a model is not known.
    """
    part = Values(path, tree["value0"], "value0.")
    places, lenses, sizes = (part.listed(key) for key in ("T_imu_cam", "intrinsics", "resolution"))
    if not len(places) == len(lenses) == len(sizes):
        raise part.refuse("T_imu_cam, intrinsics and resolution must be lists of one length")
    cameras = []
    for k, (place, inner, size) in enumerate(zip(places, lenses, sizes, strict=True)):
        at = Values(path, place, f"T_imu_cam {k}: ")
        bTc = motion_of(at.named(("px", "py", "pz")), at.named(("qx", "qy", "qz", "qw")))
        cameras.append(_basalt_camera(Values(path, inner, f"intrinsics {k}: "), size, bTc, k))
    return Calibration(str(path), "Basalt calibration", tuple(cameras))


def _basalt_camera(part: Values, size: object, bTc: FloatArray, k: int) -> RawCamera:
    kind = part.text("camera_type")
    if kind not in _BASALT:
        raise part.refuse(f"camera_type {kind} is not known; known: {', '.join(_BASALT)}")
    model, names = _BASALT[kind]
    inner = part.inside("intrinsics")
    parameters = inner.named(names) if names else np.zeros(4)
    width, height = Values(part.path, {"resolution": size}).numbers("resolution", 2)
    matrix = intrinsic_matrix(*inner.named(_FOCAL))
    name = f"{part.path.name}: camera {k}"
    camera = RawCamera(round(width), round(height), matrix, parameters, bTc, name, model)
    return checked_camera(camera)


# --------------------------------------------------------------------------------------------
# OAK (DepthAI)


_OAK_MODELS = {0: "radtan", 1: "equidistant"}  # CameraModel of DepthAI


def is_oak(tree: Tree) -> bool:
    """Whether it is the memory of an OAK camera."""
    return "cameraData" in tree and "boardName" in tree


def read_oak(path: Path, tree: Tree) -> Calibration:
    """The stereo pair, left first; the body is the left camera. Lengths there are centimetres.

    Raises:
        CalibrationError: there is no stereo pair, or a value is missing or impossible.
    """
    data = tree["cameraData"] if isinstance(tree["cameraData"], list) else []
    boards = {
        int(one[0]): Values(path, one[1], f"camera {one[0]}: ")
        for one in data
        if isinstance(one, list) and len(one) == 2 and isinstance(one[0], int)
    }
    stereo = Values(path, tree.get("stereoRectificationData"), "stereoRectificationData.")
    left = round(stereo.number("leftCameraSocket", 1.0))
    right = round(stereo.number("rightCameraSocket", 2.0))
    if not {left, right} <= boards.keys():
        raise CalibrationError(f"{path}: holds no stereo pair, of sockets {left} and {right}")
    poses = np.eye(4), _oak_step(boards, left, right)
    cameras = tuple(
        _oak_camera(boards[k], bTc) for k, bTc in zip((left, right), poses, strict=True)
    )
    return Calibration(str(path), "OAK calibration", cameras, sided=True)


def _oak_step(boards: dict[int, Values], left: int, right: int) -> FloatArray:
    """Pose of the right camera in the left one; either names the other."""
    for a, b in ((left, right), (right, left)):
        part = boards[a].inside("extrinsics")
        if round(part.number("toCameraSocket", -1.0)) == b:
            moved = 0.01 * part.inside("translation").named(("x", "y", "z"))
            bTa = pose(part.matrix("rotationMatrix", 3, 3), moved)
            return inverse(bTa) if a == left else bTa
    raise boards[left].refuse("extrinsics do not lead to the other camera of the pair")


def _oak_camera(part: Values, bTc: FloatArray) -> RawCamera:
    model = _OAK_MODELS.get(round(part.number("cameraType", 0.0)))
    if model is None:
        raise part.refuse("cameraType is not known; known: 0 (perspective), 1 (fisheye)")
    size = part.size("width", "height")
    coefficients = part.numbers("distortionCoeff")
    if model == "equidistant":
        coefficients = coefficients[:4]
    matrix = part.matrix("intrinsicMatrix", 3, 3)
    name = f"{part.path.name}: {part.where[:-2]}"
    return checked_camera(RawCamera(*size, matrix, coefficients, bTc, name, model))


# --------------------------------------------------------------------------------------------
# ZED


_ZED_SIZES = {
    "2K": (2208, 1242),
    "FHD1200": (1920, 1200),
    "FHD": (1920, 1080),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}


def is_zed(text: str) -> bool:
    """Whether it is a factory file of a ZED camera."""
    return "[LEFT_CAM_" in text and "[STEREO]" in text


def read_zed(path: Path, text: str, size: tuple[int, int] | None) -> Calibration:
    """The pair at one of its resolutions; the body is the left camera.

    ``RX``, ``CV`` and ``RZ`` are the rotation vector that takes points from the left to the right
    camera. Lengths there are millimetres.

    Raises:
        CalibrationError: a value is missing or impossible, or there is no such resolution.
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
    stereo = Values(path, _section(parser, "STEREO"), "STEREO: ")
    step = pose(
        np.asarray(cv2.Rodrigues(stereo.named([f"{axis}_{name}" for axis in _TURNS]))[0]),
        -1e-3 * stereo.named(("baseline", "ty", "tz"), 0.0),
    )
    cameras = tuple(
        _zed_camera(Values(path, _zed_values(parser, side, name), f"{side}: "), name, bTc)
        for side, bTc in (("LEFT", np.eye(4)), ("RIGHT", inverse(step)))
    )
    notes = () if len(chosen) == 1 else (f"taken at {name}; give the size for another",)
    return Calibration(str(path), "ZED factory file", cameras, True, None, notes)


_TURNS = ("rx", "cv", "rz")


def _zed_values(parser: ConfigParser, side: str, name: str) -> dict[str, str]:
    """Of one camera; the lens has a part of its own in files of ZED X."""
    return {**_section(parser, f"{side}_DISTO"), **_section(parser, f"{side}_CAM_{name}")}


def _section(parser: ConfigParser, name: str) -> dict[str, str]:
    found = dict(parser.items(name)) if parser.has_section(name) else {}
    # Keys are without case there, and the suffix of a resolution is not.
    return {_key(key): value for key, value in found.items()}


def _key(key: str) -> str:
    head, _, tail = key.partition("_")
    return f"{head}_{tail.upper()}" if tail else head


def _zed_camera(part: Values, name: str, bTc: FloatArray) -> RawCamera:
    matrix = intrinsic_matrix(*part.named(_FOCAL))
    parameters = part.named(_SINGLE, 0.0)
    parameters = parameters if parameters[5:].any() else parameters[:5]
    label = f"{part.path.name}: {part.where[:-2]}"
    return checked_camera(RawCamera(*_ZED_SIZES[name], matrix, parameters, bTc, label))


# --------------------------------------------------------------------------------------------
# RealSense, and what Open3D writes of it


_PRINCIPAL = ("fx", "fy", "ppx", "ppy")  # rs2_intrinsics


def is_realsense(tree: Tree) -> bool:
    """Whether it is the intrinsics of one camera as librealsense, Open3D or people name them."""
    plain = tree.keys() >= {*_FOCAL, "width", "height"}
    alone = plain and not {"baseline_m", "baseline", "rectified"} & tree.keys()
    return alone or "intrinsic_matrix" in tree or tree.keys() >= set(_PRINCIPAL)


def read_realsense(path: Path, tree: Tree) -> Calibration:
    """One camera; Open3D's matrix goes column by column, other people's row by row.

    Raises:
        CalibrationError: a value is missing or impossible, or the lens is of a model that is not
            known.
    """
    part = Values(path, tree)
    model, coefficients = _realsense_lens(part)
    size, matrix = part.size("width", "height"), _realsense_matrix(part)
    camera = RawCamera(*size, matrix, coefficients, np.eye(4), path.name, model)
    return Calibration(str(path), "RealSense intrinsics", (checked_camera(camera),))


def _realsense_matrix(part: Values) -> FloatArray:
    if "intrinsic_matrix" not in part:
        return intrinsic_matrix(*part.named(_PRINCIPAL if "ppx" in part else _FOCAL))
    given = part.matrix("intrinsic_matrix", 3, 3)
    matrix = given.T if given[2, :2].any() else given
    if not np.array_equal(matrix[2], (0.0, 0.0, 1.0)):
        raise part.refuse("intrinsic_matrix must end with the row 0 0 1; correct the file")
    return matrix


_BROWN = ("", "brownconrady", "modifiedbrownconrady", "plumbbob", "radtan", "pinhole", "opencv")
_KANNALA = ("kannalabrandt4", "kannalabrandt", "equidistant", "fisheye", "opencvfisheye")
_RS2_MODELS = {"1": "modifiedbrownconrady", "4": "brownconrady", "5": "kannalabrandt4"}
_LISTS = ("coeffs", "distortion", "distortion_coefficients", "dist_coeffs", "dist", "D")
_SINGLE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def _realsense_lens(part: Values) -> tuple[str, FloatArray]:
    """Model and parameters, by rs2_distortion where that is stated, else OpenCV's."""
    key = next((k for k in ("model", "distortion_model", "camera_model") if k in part), "model")
    stated = re.sub(r"[^a-z0-9]|^(rs2_)?distortion[._]", "", part.text(key))
    name = _RS2_MODELS.get(stated, stated)
    fisheye = name in _KANNALA
    listed = next((k for k in _LISTS if k in part), None)
    if listed is not None:
        found = part.numbers(listed)
    elif fisheye:
        found = part.named(("k1", "k2", "k3", "k4"), 0.0)
    else:
        found = part.named(_SINGLE if "k4" in part else _SINGLE[:5], 0.0)
        if found[5:].any() and "p1" not in part:
            raise part.refuse('k1 to k4 without p1, p2 need "model": fisheye or brown_conrady')
    if fisheye:
        return "equidistant", found[:4]
    if found.any() and name not in _BROWN:
        raise part.refuse(
            f"{key} {part.text(key)} is not known with coefficients other than 0; known: "
            "brown_conrady, kannala_brandt4"
        )
    return "radtan", found if found.any() else np.zeros(4)


# --------------------------------------------------------------------------------------------
# OCamCalib


def is_ocamcalib(text: str) -> bool:
    """Whether it is a calib_results.txt of OCamCalib."""
    lines = (line.split() for line in text.splitlines() if not line.startswith("#"))
    first = next((words for words in lines if words), [""])
    return first[0].isdecimal() and first[0].lstrip("0") == str(len(first) - 1)


def read_ocam(path: Path) -> Calibration:
    """One camera, forward along its axis.

    Raises:
        CalibrationError: with file and line, for anything missing, malformed or contradictory.
    """
    found = read_ocamcalib(path)
    row, column = found.centre
    camera = RawCamera(
        found.width,
        found.height,
        ocam_matrix(found.affine, (column, row)),
        np.array(found.direct),
        np.eye(4),
        path.name,
        "ocam",
    )
    return Calibration(str(path), "OCamCalib", (checked_camera(camera),))
