"""fgslam's own ``calib.json``: cameras as calibrated, or a rectified rig in a few numbers.

Both may state corrections: what a drive found wrong, as displacements of the rectified images'
pixels (:mod:`fgslam.core.correction`), which are undone where an image is read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.cameras.lenses import LENSES, Calibration, RawCamera, View, checked_view
from fgslam.cameras.rectify import Rectifier
from fgslam.cameras.trees import (
    Row,
    Size,
    Tree,
    Values,
    camera_of,
    flat_numbers,
    intrinsic_matrix,
    listed_lenses,
    read_json,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.checks import is_finite_number
from fgslam.core.correction import RigCorrection, image_terms, term_names
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_text, write_text
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, inverse, is_rigid, pose
from fgslam.core.sensors import CameraRig

OWN_FORMAT = "calib.json of fgslam"
CORRECTIONS = "corrections"
OF_RECTIFIED = {"baseline_m", "baseline", "rectified", "fx"}
_OWN = Row(
    size=("width", "height"),
    matrix="matrix",
    kind=("model",),
    lenses=listed_lenses("parameters", *LENSES),
)

# --------------------------------------------------------------------------------------------
# Of cameras as calibrated


def is_own(tree: Tree) -> bool:
    """Whether it is a ``calib.json`` of cameras as calibrated."""
    cameras = tree.get("cameras")
    first = cameras[0] if isinstance(cameras, list) and cameras else None
    return isinstance(first, dict) and {"model", "matrix"} <= first.keys()


def read_own(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """The cameras, and the view that is stated. Raises CalibrationError."""
    corrections = stated_corrections(path, tree)
    if corrections is not None and "rectified_view" not in tree:
        raise CalibrationError(
            f"{path}: {CORRECTIONS} are of rectified images, but rectified_view is missing; "
            f"restore it, or remove {CORRECTIONS}"
        )
    cameras = []
    for k, values in enumerate(tree["cameras"]):
        part = Values(path, values, f"cameras[{k}].")
        name = str(part.tree.get("name", part.where[:-1]))
        cameras.append(camera_of(part, _OWN, part.motion("bTc"), name))
    view, stated = None, Values(path, tree).inside("rectified_view")
    if stated.tree:
        _require_perspective(path, stated.tree.get("kind", "perspective"))
        rotations = stated.numbers("rotations", 9 * len(cameras)).reshape(-1, 3, 3)
        if not all(is_rigid(pose(rotation, np.zeros(3))) for rotation in rotations):
            raise stated.refuse("rotations has one that is no rotation; correct the file")
        size = stated.size("width", "height")
        if min(size) <= 0:
            raise stated.refuse(f"width and height are {size[0]} and {size[1]}; correct the file")
        view = View(stated.matrix("matrix", 3, 3), size, tuple(rotations))
        view = checked_view(view, str(path))
    sided = tree.get("sided") is True
    return Calibration(str(path), OWN_FORMAT, tuple(cameras), sided, view, corrections=corrections)


def raw_values(calibration: Calibration) -> dict[str, Any]:
    """Keys and values of fgslam's own ``calib.json``."""
    cameras = [
        {
            **{name: getattr(camera, name) for name in ("name", "width", "height", "model")},
            "matrix": camera.matrix.tolist(),
            "parameters": camera.distortion.tolist(),
            "bTc": camera.bTc.tolist(),
        }
        for camera in calibration.cameras
    ]
    values: dict[str, Any] = {"sided": calibration.sided, "cameras": cameras}
    view = calibration.view
    if view is not None:
        values["rectified_view"] = {
            "width": view.size[0],
            "height": view.size[1],
            "matrix": view.matrix.tolist(),
            "rotations": [rotation.tolist() for rotation in view.rotations],
        }
    if calibration.corrections is not None:
        values[CORRECTIONS] = dict(calibration.corrections)
    return values


# --------------------------------------------------------------------------------------------
# Of rectified cameras

# 'baseline' is close to 'baseline_m' (0.89); 'fy' to 'fx' (0.5) and 'baseline_m' to
# 'vertical_baseline_m' (0.69), which are keys of their own, are not.
_CLOSE_NAMES = 0.8


def is_rectified(tree: Tree) -> bool:
    """Whether it is a ``calib.json`` of rectified cameras."""
    return not is_own(tree) and bool(OF_RECTIFIED & tree.keys())


def read_rectified(path: Path, three_cameras: bool) -> CameraRig:
    """The rig of a ``calib.json``; ``three_cameras`` asks for its vertical baseline as well.

    Raises:
        CalibrationError: a value is missing, not finite or impossible.
    """
    values = read_json_object(path)
    if values.get("rectified") is False:
        raise CalibrationError(
            f"{path} states that the images are not rectified; rectify them first, or "
            "give the raw cameras' calibration by --camera FILE"
        )
    _require_perspective(path, values.get("view", "perspective"))
    bTc = BODY_FORWARD_LEFT_UP_FROM_CAMERA
    if "bTc" in values:
        found = flat_numbers(values["bTc"])
        if found is None or len(found) != 16 or not is_rigid(found.reshape(4, 4)):
            raise CalibrationError(
                f"{path}: bTc must be a rigid 4x4 matrix (right camera in body); correct it"
            )
        bTc = found.reshape(4, 4)
    width, height = (pixels(path, values, key) for key in ("width", "height"))
    fx, fy = (number(path, values, key, positive=True) for key in ("fx", "fy"))
    cx, cy = (number(path, values, key) for key in ("cx", "cy"))
    baseline, above = number(path, values, "baseline_m", positive=True), None
    if three_cameras:
        above = number(path, values, "vertical_baseline_m", positive=True)
    return CameraRig(width, height, fx, fy, cx, cy, baseline, above, bTc)


def _require_perspective(path: Path, view: Any) -> None:
    """Refuses the cylindrical views of earlier versions: read as planes they would be wrong."""
    if view != "perspective":
        raise CalibrationError(
            f"{path}: its view is {view!r}, and only perspective views are read; rectify the raw "
            "images again, with the raw cameras' calibration"
        )


def as_calibrated(
    rig: CameraRig, path: Path, corrections: Mapping[str, float] | None = None
) -> Calibration:
    """A rectified rig as cameras without distortion: left, right[, top]."""
    offsets = [("left", [-rig.baseline, 0.0, 0.0]), ("right", [0.0, 0.0, 0.0])]
    if rig.vertical_baseline is not None:
        offsets.append(("top", [0.0, -rig.vertical_baseline, 0.0]))
    size, matrix = (rig.width, rig.height), intrinsic_matrix(rig.fx, rig.fy, rig.cx, rig.cy)
    cameras = tuple(
        RawCamera(*size, matrix, np.zeros(4), rig.bTc @ pose(np.eye(3), np.array(at)), name)
        for name, at in offsets
    )
    view = None if corrections is None else View(matrix, size, (np.eye(3),) * len(cameras))
    return Calibration(str(path), OWN_FORMAT, cameras, True, view, corrections=corrections)


def read_json_object(path: Path) -> Mapping[str, Any]:
    """A JSON file's outermost object. Raises CalibrationError when there is none."""
    remedy = "give a calibration: this file (docs/datasets/images.md has its keys), or another one"
    values = read_json(path, read_text(path, CalibrationError, f"{remedy} by --camera FILE"))
    if not isinstance(values, dict):
        raise CalibrationError(f"{path} must hold one JSON object with the calibration's keys")
    return values


def number(path: Path, values: Mapping[str, Any], key: str, positive: bool = False) -> float:
    """A finite number of the calibration. Raises CalibrationError otherwise."""
    if key not in values:
        remedy = "add it to the calibration"
        for close in get_close_matches(key, values, n=1, cutoff=_CLOSE_NAMES):
            unit = " in metres" if key.endswith("_m") else ""
            remedy = f"if {close!r} means it, rename it to {key!r} (a number{unit})"
        raise CalibrationError(f"{path} has no {key!r}; {remedy}")
    value = values[key]
    if not is_finite_number(value):
        raise CalibrationError(f"{path}: {key} is {value!r}, not a finite number; correct it")
    if positive and value <= 0.0:
        hint = "correct it"
        if "baseline" in key:
            hint = "it is the distance between the cameras in metres; if left and right are "
            hint += "swapped, swap the folders"
        raise CalibrationError(f"{path}: {key} is {value:g}, must be positive: {hint}")
    return float(value)


def pixels(path: Path, values: Mapping[str, Any], key: str) -> int:
    """A positive whole number of the calibration. Raises CalibrationError otherwise."""
    value = number(path, values, key, positive=True)
    if value != int(value):
        raise CalibrationError(f"{path}: {key} is {value:g}, not a whole number of pixels")
    return int(value)


# --------------------------------------------------------------------------------------------
# Corrections


def stated_corrections(path: Path, tree: Tree) -> Mapping[str, float] | None:
    """Its corrections by name; None where it has none. Raises CalibrationError: no object."""
    values = tree.get(CORRECTIONS)
    if values is not None and not isinstance(values, dict):
        raise CalibrationError(
            f"{path}: {CORRECTIONS} must be an object with a number for each term; correct it"
        )
    return values


def correction_values(source: str, values: Mapping[str, float], rig: CameraRig) -> FloatArray:
    """(p,) values of a rig's terms by their names; zero for what no image can be corrected by.

    Raises:
        CalibrationError: one is no term of the rig, or is missing; ``source`` names the file.
    """
    own = image_terms(rig)
    names = np.array(term_names(rig))[own].tolist()
    known = {*names, *(name.replace("left.", "top.") for name in names)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise CalibrationError(
            f"{source}: {CORRECTIONS} has {unknown[0]!r}, no term; known: {', '.join(names)}"
        )
    out = np.zeros(len(own))
    out[own] = [number(Path(source), values, name) for name in names]
    return out


def rectified_values(rig: CameraRig) -> dict[str, Any]:
    """Keys and values of a ``calib.json`` of rectified cameras."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    values: dict[str, Any] = {name: getattr(rig, name) for name in names}
    values["baseline_m"] = rig.baseline
    if rig.vertical_baseline is not None:
        values["vertical_baseline_m"] = rig.vertical_baseline
    values["bTc"] = rig.bTc.tolist()
    return values


def write_corrected(
    path: Path, correction: RigCorrection, rectifier: Rectifier | None = None
) -> None:
    """Writes a ``calib.json`` with what was found wrong in it, and standard deviations.

    Args:
        path: the file.
        correction: found in the rectified images.
        rectifier: what rectified them. The file then is of the raw cameras, and states the view;
            what was corrected before is added.

    Raises:
        OutputError: the file cannot be written.
    """
    rig, found = correction.rig, correction.values
    if rectifier is not None and rectifier.correction is not None:
        found = found + rectifier.correction
    raw = None if rectifier is None else rectifier.calibration
    if rectifier is None or raw is None:
        values = rectified_values(rig)
    else:
        motion = rig.bTc @ inverse(rectifier.rig.bTc)  # mounted otherwise on the robot
        if not np.allclose(motion, np.eye(4), rtol=0.0, atol=1e-12):
            cameras = tuple(replace(c, bTc=motion @ c.bTc) for c in raw.cameras)
            raw = replace(raw, cameras=cameras)
        values = raw_values(raw)
    if found.any():
        own = image_terms(rig)
        terms = np.array(term_names(rig))[own].tolist()
        for key, numbers in ((CORRECTIONS, found), ("correction_sigmas", correction.sigmas)):
            values[key] = dict(zip(terms, numbers[own].tolist(), strict=True))
    write_text(path, json.dumps(values, indent=2) + "\n")
