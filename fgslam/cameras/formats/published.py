"""Calibrations as recordings are published with them: MRPT, DSO, COLMAP, Cityscapes, numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from dataclasses import replace
from pathlib import Path

import numpy as np

from fgslam.cameras.formats.trees import Tree, Values, intrinsic_matrix, motion_of
from fgslam.cameras.raw_cameras import Calibration, RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_text
from fgslam.core.geometry import inverse, pose

_FOCAL = ("fx", "fy", "cx", "cy")


def _motion_in(path: Path) -> FloatArray:
    """The motion (4, 4) whose numbers are all of a file. Raises CalibrationError."""
    name = "the step"
    return Values(path, {name: read_text(path, CalibrationError).split()}).motion(name)


# --------------------------------------------------------------------------------------------
# MRPT's stereo calibration, published with the Malaga urban dataset


_MRPT_POSE = "LEFT2RIGHT_POSE"


def is_mrpt(text: str) -> bool:
    """Whether a text is a stereo calibration of MRPT."""
    return f"{_MRPT_POSE}]" in text


def read_mrpt(path: Path, text: str) -> Calibration:
    """The pair, left first; the body is the left camera, the pose there is the right one's in it.

    Raises:
        CalibrationError: a value is missing, no number, or impossible.
    """
    parser = ConfigParser(interpolation=None, inline_comment_prefixes=("//",))
    try:
        parser.read_string(text)
    except ConfigParserError as error:
        raise CalibrationError(f"{path}: {' '.join(str(error).split())}") from None
    left, right, between = (_section(path, parser, end) for end in ("LEFT", "RIGHT", _MRPT_POSE))
    if "rotation_matrix_only" in between:
        turn = between.matrix("rotation_matrix_only", 3, 3)
        lTr = pose(turn, between.numbers("translation_only", 3))
    else:
        x, y, z, qw, *q = between.numbers("pose_quaternion", 7).tolist()
        lTr = motion_of(np.array([x, y, z]), np.array([*q, qw]))
    cameras = tuple(_mrpt_camera(part, bTc) for part, bTc in ((left, np.eye(4)), (right, lTr)))
    return Calibration(str(path), "MRPT stereo calibration", cameras, sided=True)


def _section(path: Path, parser: ConfigParser, end: str) -> Values:
    name = next((name for name in parser.sections() if name.endswith(end)), "")
    rows = parser.items(name) if name else []
    numbers = {key: re.split(r"[\s;,]+", value.strip("[]; ")) for key, value in rows}
    return Values(path, numbers, f"[{name or end}] ")


def _mrpt_camera(part: Values, bTc: FloatArray) -> RawCamera:
    size = part.size("resolution", "resolution")
    matrix = intrinsic_matrix(*part.named(_FOCAL))
    name = f"{part.path.name}: {part.where.strip()}"
    return checked_camera(RawCamera(*size, matrix, part.numbers("dist"), bTc, name))


# --------------------------------------------------------------------------------------------
# DSO's camera.txt, two of which and their step are published with 4Seasons


_DSO = {
    "pinhole": ("radtan", 0),
    "radtan": ("radtan", 4),
    "equidistant": ("equidistant", 4),
    "kannalabrandt": ("equidistant", 4),
    "fov": ("fov", 1),
}
"""Our model of each of DSO's, and how many of its parameters are the lens's."""

_DSO_LINE = re.compile(
    rf"\s*({'|'.join(_DSO)})((?:\s+[-+.\deE]+){{4,}})\s*\n\s*(\d+)\s+(\d+)", re.I
)
_STEP = "_stereo"


def is_dso(text: str) -> bool:
    """Whether a text is a camera of DSO: its model and numbers in one line, then the size."""
    return _DSO_LINE.match(text) is not None


def read_dso(path: Path) -> Calibration:
    """The pair ``*_0.txt``, ``*_1.txt`` with ``*_stereo.txt`` beside each other, or one camera.

    The step is the motion that takes points of camera 0 to the axes of camera 1; the body is camera
    0. Below 1 a principal point is a part of the size (camera.txt of DSO).

    Raises:
        CalibrationError: a value is missing, no number, or impossible.
    """
    stem = path.stem.rpartition("_")[0]
    first, second, step = (path.with_name(f"{stem}{end}.txt") for end in ("_0", "_1", _STEP))
    kind = "camera of DSO"
    if not (stem and all(file.is_file() for file in (first, second, step))):
        return Calibration(str(path), kind, (_dso_camera(path, np.eye(4)),))
    places = np.eye(4), inverse(_motion_in(step))
    cameras = tuple(_dso_camera(f, T) for f, T in zip((first, second), places, strict=True))
    return Calibration(str(first), f"{kind}, a pair", cameras)


def _dso_camera(path: Path, bTc: FloatArray) -> RawCamera:
    found = _DSO_LINE.match(read_text(path, CalibrationError))
    if found is None:
        raise CalibrationError(f"{path} is no camera of DSO: model and numbers, then width height")
    model, terms = _DSO[found[1].lower()]
    width, height = int(found[3]), int(found[4])
    values = Values(path, {"the first line": found[2].split()}).numbers("the first line")
    focal = values[:4]
    if (focal[2:] < 1.0).all():
        focal = focal * (width, height, width, height) - (0.0, 0.0, 0.5, 0.5)
    lens = values[4 : 4 + terms] if terms else np.zeros(4)
    matrix = intrinsic_matrix(*focal)
    return checked_camera(RawCamera(width, height, matrix, lens, bTc, path.name, model))


# --------------------------------------------------------------------------------------------
# Cityscapes


def is_cityscapes(tree: Tree) -> bool:
    """Whether it is the camera of a Cityscapes image."""
    inner, outer = tree.get("intrinsic"), tree.get("extrinsic")
    return isinstance(inner, Mapping) and isinstance(outer, Mapping) and "baseline" in outer


def read_cityscapes(path: Path, tree: Tree, size: tuple[int, int] | None) -> Calibration:
    """The rectified pair; the body is the left camera. Raises CalibrationError."""
    part = Values(path, tree)
    matrix = intrinsic_matrix(*part.inside("intrinsic").named(("fx", "fy", "u0", "v0")))
    baseline = part.inside("extrinsic").number("baseline")
    places = np.eye(4), pose(np.eye(3), np.array([baseline, 0.0, 0.0]))
    cameras = tuple(
        checked_camera(RawCamera(*(size or (0, 0)), matrix, np.zeros(4), bTc, path.name))
        for bTc in places
    )
    return Calibration(str(path), "Cityscapes camera", cameras, sided=True)


# --------------------------------------------------------------------------------------------
# One colour camera, beside its depth: OpenLORIS, Replica and what reads it


def is_openloris(tree: Tree) -> bool:
    """Whether it is OpenLORIS's sensors.yaml."""
    return _openloris_colour(tree) is not None


def _openloris_colour(tree: Tree) -> str | None:
    cameras = (key for key, value in tree.items() if isinstance(value, dict) and "model" in value)
    return next((key for key in cameras if "color" in key and "intrinsics" in tree[key]), None)


def read_openloris(path: Path, tree: Tree) -> Calibration:
    """The colour camera, whose numbers are there fx, cx, fy, cy. Raises CalibrationError."""
    name = _openloris_colour(tree) or ""
    part = Values(path, tree[name], f"{name}.")
    if part.text("distortion_model", "radial-tangential") != "radial-tangential":
        raise part.refuse("distortion_model is not known; known: radial-tangential")
    fx, cx, fy, cy = part.numbers("intrinsics", 4)
    lens = part.numbers("distortion_coefficients")
    matrix, size = intrinsic_matrix(fx, fy, cx, cy), part.size("width", "height")
    camera = RawCamera(*size, matrix, lens, np.eye(4), f"{path.name}: {name}")
    return Calibration(str(path), "OpenLORIS sensors", (checked_camera(camera),))


_PARTS = ("camera", "cam", "camera_params")
_SIZES = (("w", "h"), ("W", "H"), ("image_width", "image_height"))


def rgbd_part(tree: Tree) -> Tree:
    """The part of a configuration that holds fx, fy, cx, cy and the size; empty without one.

    So have Replica's cam_params.json, and the configurations of NICE-SLAM and SplaTAM.
    """
    parts = (tree.get(key) for key in _PARTS)
    needed = ({*_FOCAL, *size} for size in _SIZES)
    found = [part for part in parts if isinstance(part, Mapping)]
    return next((part for keys in needed for part in found if keys <= part.keys()), {})


def is_rgbd(tree: Tree) -> bool:
    """Whether it has such a part."""
    return bool(rgbd_part(tree))


def read_rgbd(path: Path, tree: Tree) -> Calibration:
    """The camera of such a part, without distortion. Raises CalibrationError."""
    part = Values(path, rgbd_part(tree), "camera: ")
    size = part.size(*next(keys for keys in _SIZES if keys[0] in part))
    camera = RawCamera(*size, intrinsic_matrix(*part.named(_FOCAL)), np.zeros(4), np.eye(4))
    return Calibration(str(path), "camera of colour and depth", (checked_camera(camera),))


# --------------------------------------------------------------------------------------------
# COLMAP's cameras.txt and nerfstudio's transforms.json: pixels begin at the corner of the first


_COLMAP = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": _FOCAL,
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": (*_FOCAL, "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": (*_FOCAL, "k1", "k2", "k3", "k4"),
}
"""Parameters of its models, in their order."""

_COLMAP_LINE = re.compile(rf"^\d+\s+({'|'.join(_COLMAP)})\s+(\d+)\s+(\d+)\s+(.*)$", re.M)


def is_colmap(text: str) -> bool:
    """Whether a text is a cameras.txt of COLMAP with one camera of a known model."""
    return len(_COLMAP_LINE.findall(text)) == 1


def read_colmap(path: Path, text: str) -> Calibration:
    """Its camera. Raises CalibrationError."""
    ((model, *size, numbers),) = _COLMAP_LINE.findall(text)
    names, words = _COLMAP[model], numbers.split()
    if len(words) != len(names):
        raise CalibrationError(f"{path}: {model} takes {' '.join(names)}; correct the file")
    part = Values(path, dict(zip(names, words, strict=True)), f"{model}: ")
    width, height = map(int, size)
    camera = _from_corner(part, (width, height), model)
    return Calibration(str(path), "COLMAP cameras", (camera,))


def is_nerfstudio(tree: Tree) -> bool:
    """Whether it is a transforms.json of one camera."""
    return tree.keys() >= {"fl_x", "cx", "cy", "w", "h"}


def read_nerfstudio(path: Path, tree: Tree) -> Calibration:
    """Its camera. Raises CalibrationError."""
    part = Values(path, {"fx": tree["fl_x"], "fy": tree.get("fl_y", tree["fl_x"]), **tree})
    camera = _from_corner(part, part.size("w", "h"), str(tree.get("camera_model", "OPENCV")))
    return Calibration(str(path), "nerfstudio transforms", (camera,))


def _from_corner(part: Values, size: tuple[int, int], model: str) -> RawCamera:
    if model not in _COLMAP:
        raise part.refuse(f"camera_model {model} is not known; known: {', '.join(_COLMAP)}")
    fx, fy = part.named(("f", "f") if "f" in part else ("fx", "fy"))
    cx, cy = part.named(("cx", "cy")) - 0.5
    fisheye = model == "OPENCV_FISHEYE"
    terms = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    if not fisheye and part.named(("k4",), 0.0).any():
        raise part.refuse(f"k4 of {model} is not known; calibrate without it")
    lens = part.named(terms, 0.0)
    matrix, kind = intrinsic_matrix(fx, fy, cx, cy), "equidistant" if fisheye else "radtan"
    return checked_camera(RawCamera(*size, matrix, lens, np.eye(4), part.path.name, kind))


# --------------------------------------------------------------------------------------------
# Numbers alone: ETH3D's calibration.txt, ScanNet's intrinsic_color.txt, cam_K.txt


_SMALLEST_FOCAL = 10.0  # pixels; a pose has at most 1 in its place
_LINES = (4, 8, 9)


def is_numbers(text: str) -> bool:
    """Whether a text is ``fx fy cx cy``, perhaps with a lens, or an intrinsic matrix, alone."""
    rows = _rows(text)
    return rows is not None and (_is_line(rows) or _is_matrix(rows))


def _rows(text: str) -> list[FloatArray] | None:
    lines = [re.split(r"[\s,;]+", line.strip(" \t,;[]")) for line in text.split("\n")]
    try:
        return [np.array(line, np.float64) for line in lines if line != [""]][:5]
    except ValueError:
        return None


def _is_line(rows: list[FloatArray]) -> bool:
    return len(rows) == 1 and len(rows[0]) in _LINES and min(rows[0][:2]) > _SMALLEST_FOCAL


def _is_matrix(rows: list[FloatArray]) -> bool:
    shape = (len(rows), {len(row) for row in rows})
    if shape not in ((3, {3}), (3, {4}), (4, {4})):
        return False
    matrix = np.array(rows)
    plane = np.array_equal(matrix[2, :3], (0.0, 0.0, 1.0)) and not matrix[:3, 3:].any()
    return bool(plane and min(matrix[0, 0], matrix[1, 1]) > _SMALLEST_FOCAL)


def read_numbers(path: Path, text: str, size: tuple[int, int] | None) -> Calibration:
    """One camera, or ETH3D's pair; a lens is k1, k2, p1, p2 and perhaps k3."""
    camera = _camera_of_numbers(path, text, size)
    files = tuple(path.with_name(name) for name in _ETH3D)
    if path not in files or not all(file.is_file() for file in files):
        return Calibration(str(path), "numbers of one camera", (camera,))
    texts = [read_text(file, CalibrationError) for file in files[:2]]
    first, second = (_camera_of_numbers(*each, size) for each in zip(files, texts, strict=False))
    cameras = (first, replace(second, bTc=_motion_in(files[2])))
    return Calibration(str(files[0]), "cameras of ETH3D, a pair", cameras)


_ETH3D = ("calibration.txt", "calibration2.txt", "extrinsics_1_2.txt")
"""Both cameras of ETH3D's SLAM recordings, and the pose of the second one in the first one."""


def _camera_of_numbers(path: Path, text: str, size: tuple[int, int] | None) -> RawCamera:
    rows = _rows(text) or []
    if not (_is_line(rows) or _is_matrix(rows)):
        raise CalibrationError(f"{path} is no camera: expected fx fy cx cy; restore the file")
    if _is_line(rows):
        matrix, lens = intrinsic_matrix(*rows[0][:4]), rows[0][4:]
    else:
        matrix, lens = np.array(rows)[:3, :3], np.zeros(0)
    lens = lens if len(lens) else np.zeros(4)
    return checked_camera(RawCamera(*(size or (0, 0)), matrix, lens, np.eye(4), path.name))
