"""ROS camera_info: two files, each with its own rectification and projection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.cameras.calibration_yaml import numbers, read_calibration_yaml
from fgslam.cameras.rectification import RawCamera, Rectifier, rectified_by
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError

_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8}
"""Distortion models of OpenCV that are read, and how many numbers each has."""


def read_camera_info_pair(left: Path, right: Path) -> Rectifier:
    """The rectification that the two files state; the body is the rectified right camera.

    Raises:
        CalibrationError: a file is missing or malformed, its distortion model is another one, the
            files are not of one rectified pair, or left and right are swapped.
    """
    cameras = {path: read_calibration_yaml(path) for path in (right, left)}
    raw = [_camera(path, values) for path, values in cameras.items()]
    rotations = [_matrix(p, v, "rectification_matrix", 3, 3) for p, v in cameras.items()]
    of_right, of_left = (_matrix(p, v, "projection_matrix", 3, 4) for p, v in cameras.items())
    if not np.allclose(of_left[:, :3], of_right[:, :3]):
        raise CalibrationError(
            f"{left}: its projection_matrix differs from that of {right.name}, so the two are not "
            "of one rectified pair; calibrate them as a stereo pair"
        )
    if of_right[0, 0] <= 0.0 or not of_right[0, 3] < 0.0:
        raise CalibrationError(
            f"{right}: projection_matrix states no baseline (its fourth number is "
            f"{of_right[0, 3]:g}, must be negative); calibrate a stereo pair, or swap the files"
        )
    found = rectified_by(raw[0], raw[1], (rotations[0], rotations[1]), of_right)
    # The files say nothing of a robot: the body is the rectified camera.
    return Rectifier(replace(found.rig, bTc=np.eye(4)), found.maps)


def _camera(path: Path, values: Mapping[str, Any]) -> RawCamera:
    model = values.get("distortion_model")
    count = _COEFFICIENTS.get(str(model))
    if count is None:
        raise CalibrationError(
            f"{path}: distortion_model is {model}; only {' and '.join(_COEFFICIENTS)} are read, "
            "rectify the images with another tool"
        )
    size = [values.get("image_width"), values.get("image_height")]
    width, height = (int(v) for v in numbers(path, {"image_width, image_height": size},
                                             "image_width, image_height", 2))  # fmt: skip
    return RawCamera(
        width=width,
        height=height,
        matrix=_matrix(path, values, "camera_matrix", 3, 3),
        distortion=_matrix(path, values, "distortion_coefficients", 1, count)[0],
        bTc=np.eye(4),
        name=str(path),
    )


def _matrix(path: Path, values: Mapping[str, Any], key: str, rows: int, columns: int) -> FloatArray:
    block = values.get(key)
    data = block.get("data") if isinstance(block, dict) else None
    return numbers(path, {f"{key}.data": data}, f"{key}.data", rows * columns).reshape(
        rows, columns
    )
