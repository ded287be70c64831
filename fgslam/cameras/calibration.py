"""Calibration files: texts, keys and numbers, checked; and fgslam's own ``calib.json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.checks import is_finite_number
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_text
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, is_rigid, pose, so3_exp
from fgslam.core.sensors import CameraRig

# 'baseline' is close to 'baseline_m' (0.89); 'fy' to 'fx' (0.5) and 'baseline_m' to
# 'vertical_baseline_m' (0.69), which are keys of their own, are not.
_CLOSE_NAMES = 0.8


def read_calibration(path: Path, three_cameras: bool) -> CameraRig:
    """The rig of a ``calib.json``; ``three_cameras`` asks for its vertical baseline as well.

    Raises:
        CalibrationError: a value is missing, not finite or impossible.
    """
    values = read_json_object(path)
    if values.get("rectified") is False:
        raise CalibrationError(
            f"{path} says that the images are not rectified; rectify them first (rows of the left "
            "and right image must agree), or give the raw cameras' calibration by --camera FILE"
        )
    if values.get("view", "perspective") != "perspective":
        raise CalibrationError(
            f"{path}: view is {values['view']!r}, but rectified images are perspective ones; "
            "rectify the raw images anew"
        )
    return CameraRig(
        width=pixels(path, values, "width"),
        height=pixels(path, values, "height"),
        fx=positive(path, values, "fx"),
        fy=positive(path, values, "fy"),
        cx=number(path, values, "cx"),
        cy=number(path, values, "cy"),
        baseline=positive(path, values, "baseline_m"),
        vertical_baseline=positive(path, values, "vertical_baseline_m") if three_cameras else None,
        bTc=_body_from_camera(path, values),
    )


def read_json_object(path: Path) -> Mapping[str, Any]:
    """A JSON file's outermost object. Raises CalibrationError when there is none."""
    remedy = "give a calibration: this file (docs/datasets/image_folder.md has its keys), or "
    remedy += "another one by --camera FILE"
    text = read_text(path, CalibrationError, remedy)
    try:
        values = json.loads(text)
    except RecursionError:
        raise CalibrationError(f"{path} is nested too deeply; correct the file") from None
    except ValueError as cause:
        raise CalibrationError(f"{path} is not JSON: {cause}; correct the file") from cause
    if not isinstance(values, dict):
        raise CalibrationError(f"{path} must hold one JSON object with the calibration's keys")
    return values


def number(path: Path, values: Mapping[str, Any], key: str) -> float:
    """A finite number of the calibration. Raises CalibrationError otherwise."""
    if key not in values:
        raise CalibrationError(f"{path} has no {key!r}; {_remedy(values, key)}")
    value = values[key]
    if not is_finite_number(value):
        raise CalibrationError(f"{path}: {key} is {value!r}, not a finite number; correct it")
    return float(value)


def _remedy(values: Mapping[str, Any], missing: str) -> str:
    """What to do about a missing key: to rename one that is spelled nearly alike, or to add it."""
    close = get_close_matches(missing, values, n=1, cutoff=_CLOSE_NAMES)
    if not close:
        return "add it to the calibration"
    unit = " in metres" if missing.endswith("_m") else ""
    return f"if {close[0]!r} means it, rename it to {missing!r} (a number{unit})"


def positive(path: Path, values: Mapping[str, Any], key: str) -> float:
    """A positive number of the calibration. Raises CalibrationError otherwise."""
    value = number(path, values, key)
    if value <= 0.0:
        hint = (
            "it is the distance between the cameras in metres; if left and right are swapped, swap "
            "the folders"
            if "baseline" in key
            else "correct it"
        )
        raise CalibrationError(f"{path}: {key} is {value:g}, must be positive: {hint}")
    return value


def pixels(path: Path, values: Mapping[str, Any], key: str) -> int:
    """A positive whole number of the calibration. Raises CalibrationError otherwise."""
    value = positive(path, values, key)
    if value != int(value):
        raise CalibrationError(f"{path}: {key} is {value:g}, not a whole number of pixels")
    return int(value)


def _body_from_camera(path: Path, values: Mapping[str, Any]) -> FloatArray:
    if "bTc" not in values:
        return BODY_FORWARD_LEFT_UP_FROM_CAMERA
    try:
        bTc = np.array(values["bTc"], np.float64)
    except (TypeError, ValueError):
        bTc = np.empty(0)
    if not is_rigid(bTc):
        raise CalibrationError(
            f"{path}: bTc must be a rigid 4x4 matrix (the pose of the right camera in the body); "
            "correct or remove it"
        )
    return bTc


def level_mounting(camera_yaw_deg: float, lever_arm_m: tuple[float, float, float]) -> FloatArray:
    """``bTc`` (4, 4) of a level camera: heading in degrees to the left, position in the body."""
    heading = so3_exp(np.array([0.0, 0.0, np.radians(camera_yaw_deg)]))
    ahead = BODY_FORWARD_LEFT_UP_FROM_CAMERA[:3, :3]
    return pose(heading @ ahead, np.array(lever_arm_m, np.float64))
