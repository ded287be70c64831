"""fgslam's own ``calib.json``, of rectified cameras and of cameras as calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.cameras.formats.trees import Tree, Values, intrinsic_matrix
from fgslam.cameras.lenses import LENSES
from fgslam.cameras.raw_cameras import (
    Calibration,
    RawCamera,
    StatedView,
    checked_camera,
    checked_view,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import is_rigid, pose
from fgslam.core.sensors import CameraRig

FORMAT = "calib.json of fgslam"
CORRECTIONS = "corrections"

OWN = {"baseline_m", "baseline", "rectified", "fx"}


def is_rectified(tree: Tree) -> bool:
    """Whether it is a ``calib.json`` of rectified cameras."""
    return not is_raw(tree) and bool(OWN & tree.keys())


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
    return Calibration(
        str(path),
        FORMAT,
        cameras,
        sided=tree.get("sided") is True,
        view=_stated_view(Values(path, tree).inside("rectified_view"), len(cameras)),
        corrections=_of_its_view(path, tree),
    )


def stated_corrections(path: Path, tree: Tree) -> Mapping[str, float] | None:
    """Its corrections by name; None where it has none. Raises CalibrationError: no object."""
    values = tree.get(CORRECTIONS)
    if values is not None and not isinstance(values, dict):
        raise CalibrationError(
            f"{path}: {CORRECTIONS} must be an object with a number for each term; correct or "
            "remove it"
        )
    return values


def _of_its_view(path: Path, tree: Tree) -> Mapping[str, float] | None:
    found = stated_corrections(path, tree)
    if found is not None and "rectified_view" not in tree:
        raise CalibrationError(
            f"{path}: {CORRECTIONS} are of rectified images, but rectified_view is missing; "
            f"restore it, or remove {CORRECTIONS}"
        )
    return found


def _stated_view(part: Values, cameras: int) -> StatedView | None:
    if not part.tree:
        return None
    kind = part.text("kind", "perspective")
    if kind != "perspective":
        raise part.refuse(f"kind is {kind!r}, but a view is perspective; rectify anew")
    rotations = part.numbers("rotations", 9 * cameras).reshape(cameras, 3, 3)
    if not all(is_rigid(pose(rotation, np.zeros(3))) for rotation in rotations):
        raise part.refuse("rotations has one that is no rotation; correct the file")
    size = part.size("width", "height")
    if min(size) <= 0:
        raise part.refuse(f"width and height are {size[0]} and {size[1]}; correct the file")
    matrix = part.matrix("matrix", 3, 3)
    view = StatedView(tuple(rotations), matrix, size)
    return checked_view(view, str(part.path))


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


def calibration_of(
    rig: CameraRig, path: Path, corrections: Mapping[str, float] | None = None
) -> Calibration:
    """Rectified cameras as calibrated ones without distortion: left, right[, top]."""
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
    view = None
    if corrections is not None:
        view = StatedView((np.eye(3),) * len(cameras), matrix, (rig.width, rig.height))
    return Calibration(str(path), FORMAT, cameras, True, view, corrections=corrections)
