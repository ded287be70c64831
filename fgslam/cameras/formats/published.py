"""One colour camera as published with its images: Replica, NICE-SLAM, COLMAP, nerfstudio."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fgslam.cameras.formats.trees import Tree, Values, intrinsic_matrix
from fgslam.cameras.raw_cameras import Calibration, RawCamera, checked_camera
from fgslam.core.errors import CalibrationError

_FOCAL = ("fx", "fy", "cx", "cy")


# --------------------------------------------------------------------------------------------
# Beside its depth: Replica and what reads it


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
