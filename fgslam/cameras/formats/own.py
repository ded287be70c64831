"""fgslam's own ``calib.json``, of rectified cameras and of cameras as calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.cameras.formats.trees import Tree, Values, intrinsic_matrix
from fgslam.cameras.lenses import LENSES
from fgslam.cameras.raw_cameras import Calibration, RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import pose
from fgslam.core.sensors import CameraRig

FORMAT = "calib.json of fgslam"


_OWN = {"baseline_m", "baseline", "rectified", "fx"}


def is_rectified(tree: Tree) -> bool:
    """Whether it is a ``calib.json`` of rectified cameras."""
    return not is_raw(tree) and bool(_OWN & tree.keys())


def is_raw(tree: Tree) -> bool:
    """Whether it is a ``calib.json`` of cameras that are not rectified."""
    cameras = tree.get("cameras")
    first = cameras[0] if isinstance(cameras, list) and cameras else None
    return isinstance(first, dict) and {"model", "matrix"} <= first.keys()


def read_raw(path: Path, tree: Tree) -> Calibration:
    """Its cameras in order, with their models.

    Raises:
        CalibrationError: a value is missing or impossible, or a model is not known.
    """
    cameras = tuple(
        _camera(Values(path, values, f"cameras[{k}].")) for k, values in enumerate(tree["cameras"])
    )
    return Calibration(str(path), FORMAT, cameras, sided=tree.get("sided") is True)


def _camera(part: Values) -> RawCamera:
    model = part.text("model")
    if model not in LENSES:
        raise part.refuse(f"model {model} is not known; known: {', '.join(LENSES)}")
    return checked_camera(
        RawCamera(
            *part.size("width", "height"),
            part.matrix("matrix", 3, 3),
            part.numbers("parameters"),
            part.motion("bTc"),
            str(part.tree.get("name", part.where[:-1])),
            model,
        )
    )


def raw_values(calibration: Calibration) -> Mapping[str, Any]:
    """What :func:`read_raw` reads."""
    cameras = [
        {
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "model": camera.model,
            "matrix": camera.matrix.tolist(),
            "parameters": camera.distortion.tolist(),
            "bTc": camera.bTc.tolist(),
        }
        for camera in calibration.cameras
    ]
    return {"sided": calibration.sided, "cameras": cameras}


def calibration_of(rig: CameraRig, path: Path) -> Calibration:
    """Rectified cameras as calibrated ones without distortion: left, right[, top].

    Raises:
        CalibrationError: their view is cylindrical, and no lens is like that.
    """
    if rig.cylindrical:
        raise CalibrationError(
            f"{path}: is of cylindrical images, which no camera model makes; give the calibration "
            "of the raw cameras"
        )
    offsets: list[tuple[str, FloatArray]] = [
        ("left", np.array([-rig.baseline, 0.0, 0.0])),
        ("right", np.zeros(3)),
    ]
    if rig.vertical_baseline is not None:
        offsets.append(("top", np.array([0.0, -rig.vertical_baseline, 0.0])))
    matrix = intrinsic_matrix(rig.fx, rig.fy, rig.cx, rig.cy)
    cameras = tuple(
        RawCamera(rig.width, rig.height, matrix, np.zeros(4), rig.bTc @ pose(np.eye(3), at), name)
        for name, at in offsets
    )
    return Calibration(str(path), FORMAT, cameras, sided=True)
