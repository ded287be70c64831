"""Kalibr's camchain: two pinhole cameras with their transformation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.cameras.calibration_yaml import numbers, read_calibration_yaml
from fgslam.cameras.rectification import RawCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, is_rigid

_MODELS = {"pinhole": ("radtan",)}
"""Camera models that are read, and their distortion models."""


def read_camchain(path: Path) -> tuple[RawCamera, RawCamera]:
    """Cameras ``cam0`` and ``cam1``; the body is the first camera.

    ``T_cn_cnm1`` of cam1 takes points from cam0's axes to its own.

    Raises:
        CalibrationError: there are not two cameras, a value is missing or impossible, or a model
            is another than pinhole with radial-tangential distortion.
    """
    values = read_calibration_yaml(path)
    if not all(isinstance(values.get(name), dict) for name in ("cam0", "cam1")):
        raise CalibrationError(
            f"{path}: a stereo rig needs cam0 and cam1; give the camchain of both cameras"
        )
    step = values["cam1"].get("T_cn_cnm1")
    rows = step if isinstance(step, list) else []
    flat = [value for row in rows for value in (row if isinstance(row, list) else [row])]
    pose = numbers(path, {"cam1.T_cn_cnm1": flat}, "cam1.T_cn_cnm1", 16).reshape(4, 4)
    if not is_rigid(pose):
        raise CalibrationError(f"{path}: cam1.T_cn_cnm1 is not a rigid motion; correct the file")
    return (
        _camera(path, "cam0", values["cam0"], np.eye(4)),
        _camera(path, "cam1", values["cam1"], inverse(pose)),
    )


def _camera(path: Path, name: str, values: Mapping[str, Any], bTc: FloatArray) -> RawCamera:
    model, distortion = values.get("camera_model"), values.get("distortion_model")
    if distortion not in _MODELS.get(str(model), ()):
        raise CalibrationError(
            f"{path}: {name} is {model} with {distortion} distortion; only pinhole with radtan is "
            "read, rectify the images with another tool"
        )
    keys = {f"{name}.{key}": value for key, value in values.items()}
    width, height = (int(v) for v in numbers(path, keys, f"{name}.resolution", 2))
    fx, fy, cx, cy = numbers(path, keys, f"{name}.intrinsics", 4)
    if min(width, height) <= 0 or min(fx, fy) <= 0.0:
        raise CalibrationError(f"{path}: {name}: sizes and focal lengths must be positive")
    return RawCamera(
        width=width,
        height=height,
        matrix=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        distortion=numbers(path, keys, f"{name}.distortion_coeffs", 4),
        bTc=bTc,
        name=f"{path.name}: {name}",
    )
