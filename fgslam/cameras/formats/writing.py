"""Calibrations written in the formats of fgslam, OpenCV, Kalibr and ROS."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from fgslam.cameras.formats.own import raw_values
from fgslam.cameras.formats.writing_parts import (
    refused,
    require_no_skew,
    shortened,
    two,
    two_of_one_size,
)
from fgslam.cameras.raw_cameras import Calibration, RawCamera, StatedView
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import clear_output_errors, replacing, write_text
from fgslam.core.geometry import inverse

_KALIBR = {"radtan": "pinhole", "equidistant": "pinhole", "fov": "pinhole", "omni": "omni"}
_SPHERES = ("ds", "eucm")


def write_calibration(
    calibration: Calibration,
    path: Path,
    view: StatedView | None = None,
    form: str | None = None,
) -> str:
    """Writes a calibration; the name says the format, unless it is given.

    ``.json`` is fgslam's own, ``.yml`` and ``.xml`` OpenCV's, ``.yaml`` Kalibr's, and a name
    without an ending a folder with ``left.yaml`` and ``right.yaml`` of ROS.

    Args:
        calibration: what is written.
        path: the file or folder.
        view: rectification of left and right camera for ROS, whose files must state one.
        form: one of :data:`FORMATS`; None: by the name.

    Returns:
        The format in words.

    Raises:
        CalibrationError: the format has no such cameras, or it or the ending is not known.
        OutputError: the file cannot be written.
    """
    name = form or _ENDINGS.get(path.suffix.lower())
    if name is None:
        known = ", ".join(f"{ending} ({form})" for ending, form in _ENDINGS.items() if ending)
        raise CalibrationError(
            f"{path}: no format ends like that; known: {known}, and no ending (a folder for ROS); "
            f"or give --format, one of {', '.join(FORMATS)}"
        )
    if name not in FORMATS:
        raise CalibrationError(f"format {name!r} is not known; use {', '.join(FORMATS)}")
    words, endings, write = FORMATS[name]
    if path.suffix.lower() not in endings:
        wanted = " or ".join(ending or "no ending, a folder" for ending in endings)
        raise CalibrationError(f"{path}: {words} is written as {wanted}; give such a name")
    if write is not _own:
        calibration.require_uncorrected(f"{words} cannot hold them")
    write(calibration, path, view)
    return words


def _own(calibration: Calibration, path: Path, _: StatedView | None) -> None:
    write_text(path, json.dumps(raw_values(calibration), indent=2) + "\n")


# --------------------------------------------------------------------------------------------
# Kalibr


def _kalibr(calibration: Calibration, path: Path, _: StatedView | None) -> None:
    chain = {}
    for k, camera in enumerate(calibration.cameras):
        values = _kalibr_camera(camera)
        if k:
            before = calibration.cameras[k - 1]
            values["T_cn_cnm1"] = (inverse(camera.bTc) @ before.bTc).tolist()
        chain[f"cam{k}"] = values
    write_text(path, yaml.safe_dump(chain, sort_keys=False))


def _kalibr_camera(camera: RawCamera) -> dict[str, Any]:
    own, distortion, kind = [], camera.distortion, camera.model
    if camera.model in _SPHERES:
        own, distortion, kind = list(camera.distortion), camera.distortion[:0], "none"
    elif camera.model == "omni":
        own, distortion, kind = [camera.distortion[0]], camera.distortion[1:], "radtan"
    elif camera.model == "radtan":
        distortion = shortened(camera, 4, "Kalibr")
    elif camera.model not in _KALIBR:
        raise refused(camera, "Kalibr")
    require_no_skew(camera, "Kalibr")
    return {
        "camera_model": _KALIBR.get(camera.model, camera.model),
        "intrinsics": [float(v) for v in (*own, *camera.intrinsics)],
        "distortion_model": kind,
        "distortion_coeffs": [float(v) for v in distortion],
        "resolution": list(camera.size),
        **({"rostopic": camera.topic} if camera.topic else {}),
    }


# --------------------------------------------------------------------------------------------
# OpenCV


_OPENCV = {"radtan": "M", "equidistant": "K", "omni": "K"}


def _opencv(calibration: Calibration, path: Path, _: StatedView | None) -> None:
    first, second = two_of_one_size(calibration, "OpenCV's file")
    values: dict[str, Any] = {"image_width": first.width, "image_height": first.height}
    for k, camera in enumerate((first, second), 1):
        if camera.model not in _OPENCV:
            raise refused(camera, "OpenCV")
        coefficients = camera.distortion
        if camera.model == "omni":
            values[f"xi{k}"], coefficients = float(coefficients[0]), coefficients[1:]
        values[f"{_OPENCV[camera.model]}{k}"] = camera.matrix
        values[f"D{k}"] = coefficients[None]
    if first.model == "equidistant":
        values["distortion_model"] = "equidistant"
    step = inverse(second.bTc) @ first.bTc
    values |= {"R": step[:3, :3], "T": step[:3, 3:]}
    with replacing(path) as partial:
        storage = cv2.FileStorage(str(partial), cv2.FILE_STORAGE_WRITE)
        for key, value in values.items():
            array = isinstance(value, np.ndarray)
            storage.write(key, np.ascontiguousarray(value) if array else value)
        storage.release()


# --------------------------------------------------------------------------------------------
# ROS


_ROS_SIZES = {5: "plumb_bob", 8: "rational_polynomial"}


def _ros(calibration: Calibration, path: Path, view: StatedView | None) -> None:
    cameras = two(calibration, "ROS")
    if view is None:
        raise CalibrationError(f"{calibration.source}: is no stereo rig, of which ROS wants a pair")
    offset = calibration.offset(1, 0)[:3, 3]
    shift = -view.matrix[0, 0] * float(np.linalg.norm(offset))
    with clear_output_errors(path):
        path.mkdir(exist_ok=True)
    for k, (camera, name) in enumerate(zip(cameras, ("left", "right"), strict=True)):
        projection = np.column_stack([view.matrix, np.zeros(3)])
        projection[0, 3] = shift * k
        values = {"camera_name": name, **_ros_camera(camera)}
        values |= _block("rectification_matrix", view.rotations[k])
        values |= _block("projection_matrix", projection)
        write_text(path / f"{name}.yaml", yaml.safe_dump(values, sort_keys=False))


def _ros_camera(camera: RawCamera) -> dict[str, Any]:
    if camera.model == "equidistant":
        kind, coefficients = "equidistant", camera.distortion
    elif camera.model == "radtan":
        most = 5 if not camera.distortion[5:].any() else 8
        kind, coefficients = _ROS_SIZES[most], shortened(camera, most, "ROS")
    else:
        raise refused(camera, "ROS")
    values = {"image_width": camera.width, "image_height": camera.height}
    return {
        **values,
        **_block("camera_matrix", camera.matrix),
        "distortion_model": kind,
        **_block("distortion_coefficients", coefficients[None]),
    }


def _block(key: str, matrix: FloatArray) -> Mapping[str, Any]:
    rows, columns = matrix.shape
    return {key: {"rows": rows, "cols": columns, "data": matrix.ravel().tolist()}}


FORMATS: dict[
    str, tuple[str, tuple[str, ...], Callable[[Calibration, Path, StatedView | None], None]]
] = {
    "fgslam": ("calib.json of fgslam", (".json",), _own),
    "opencv": ("OpenCV", (".yml", ".yaml", ".xml", ".json"), _opencv),
    "kalibr": ("Kalibr", (".yaml", ".yml"), _kalibr),
    "ros": ("ROS camera_info, a folder", ("",), _ros),
}
"""Formats that are written: in words, the endings of their names, and how."""
_ENDINGS = {
    ".json": "fgslam",
    ".yml": "opencv",
    ".xml": "opencv",
    ".yaml": "kalibr",
    "": "ros",
}
