"""Cameras of the ASL layout (EuRoC): sensor.yaml."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.cameras.calibration_yaml import numbers, read_calibration_yaml
from fgslam.cameras.rectification import RawCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import is_rigid

_DISTORTION_MODELS = ("radial-tangential", "radtan", "plumb_bob")


def read_camera(path: Path) -> RawCamera:
    """Read a camera's sensor.yaml.

    Raises:
        CalibrationError: a value is missing, not finite or impossible, or the distortion model is
            another than radial-tangential.
    """
    values = read_calibration_yaml(path)
    model = values.get("distortion_model")
    if model not in _DISTORTION_MODELS:
        raise CalibrationError(
            f"{path}: distortion_model is {model!r}, only radial-tangential is read; rectify the "
            "images with another tool and use the image_folder layout"
        )
    width, height = (int(v) for v in numbers(path, values, "resolution", 2))
    fx, fy, cx, cy = numbers(path, values, "intrinsics", 4)
    if min(width, height) <= 0 or min(fx, fy) <= 0.0:
        raise CalibrationError(
            f"{path}: resolution {width}x{height} and focal lengths {fx:g}, {fy:g} must be positive"
        )
    return RawCamera(
        width=width,
        height=height,
        matrix=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        distortion=numbers(path, values, "distortion_coefficients", 4),
        bTc=_mounting(path, values),
        name=str(path.parent),
    )


def read_mounting(path: Path) -> FloatArray:
    """``T_BS`` (4, 4) of a sensor.yaml: the pose of the sensor in the body."""
    return _mounting(path, read_calibration_yaml(path))


def _mounting(path: Path, values: Mapping[str, Any]) -> FloatArray:
    block = values.get("T_BS")
    data = numbers(path, block if isinstance(block, dict) else {}, "data", 16)
    bTc = data.reshape(4, 4)
    if not is_rigid(bTc):
        raise CalibrationError(f"{path}: T_BS is not a rigid motion; correct the file")
    return bTc
