"""Calibrations written in the formats of fgslam, OpenCV, Kalibr and ROS."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from fgslam.cameras.calib_json import raw_values
from fgslam.cameras.lenses import Calibration, RawCamera, StatedView
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import clear_output_errors, replacing, write_text
from fgslam.core.geometry import inverse


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
    if name != "fgslam":
        calibration.require_uncorrected(f"{words} cannot hold them")
    write(calibration, path, view)
    return words


def _write_own(calibration: Calibration, path: Path, _: StatedView | None) -> None:
    write_text(path, json.dumps(raw_values(calibration), indent=2) + "\n")


def _write_kalibr(calibration: Calibration, path: Path, _: StatedView | None) -> None:
    chain: dict[str, dict[str, Any]] = {}
    for k, camera in enumerate(calibration.cameras):
        own, distortion, kind = camera.distortion[:0], camera.distortion, camera.model
        if camera.model in ("ds", "eucm"):
            own, distortion, kind = distortion, distortion[:0], "none"
        elif camera.model == "omni":
            own, distortion, kind = distortion[:1], distortion[1:], "radtan"
        elif camera.model == "radtan":
            distortion = _shortened(camera, 4, "Kalibr")
        elif camera.model not in ("equidistant", "fov"):
            raise _refused(camera, "Kalibr")
        if camera.matrix[0, 1] or camera.matrix[1, 0]:
            raise CalibrationError(
                f"{camera.name}: its pixels are skew, which Kalibr has no number for; write "
                "calib.json"
            )
        pinhole = camera.model in ("radtan", "equidistant", "fov")
        chain[f"cam{k}"] = {
            "camera_model": "pinhole" if pinhole else camera.model,
            "intrinsics": [*own.tolist(), *camera.intrinsics.tolist()],
            "distortion_model": kind,
            "distortion_coeffs": distortion.tolist(),
            "resolution": list(camera.size),
            **({"rostopic": camera.topic} if camera.topic else {}),
        }
        if k:
            step = inverse(camera.bTc) @ calibration.cameras[k - 1].bTc
            chain[f"cam{k}"]["T_cn_cnm1"] = step.tolist()
    write_text(path, yaml.safe_dump(chain, sort_keys=False))


_OPENCV = {"radtan": "M", "equidistant": "K", "omni": "K"}
"""Letter of the matrices: cv2.fisheye's and cv2.omnidir's are K."""


def _write_opencv(calibration: Calibration, path: Path, _: StatedView | None) -> None:
    first, second = _pair(calibration, "OpenCV's file")
    if first.size != second.size:
        sizes = " and ".join(f"{width}x{height}" for width, height in (first.size, second.size))
        raise CalibrationError(
            f"{calibration.source}: its cameras have images of {sizes}, but OpenCV's file has one "
            "size; write calib.json or Kalibr's .yaml"
        )
    values: dict[str, Any] = {"image_width": first.width, "image_height": first.height}
    for k, camera in enumerate((first, second), 1):
        if camera.model not in _OPENCV:
            raise _refused(camera, "OpenCV")
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


def _write_ros(calibration: Calibration, path: Path, view: StatedView | None) -> None:
    cameras = _pair(calibration, "ROS")
    if view is None:
        raise CalibrationError(f"{calibration.source}: is no stereo rig, of which ROS wants a pair")
    baseline = float(np.linalg.norm(calibration.offset(1, 0)[:3, 3]))
    with clear_output_errors(path):
        path.mkdir(exist_ok=True)
    for k, (camera, name) in enumerate(zip(cameras, ("left", "right"), strict=True)):
        if camera.model == "equidistant":
            kind, coefficients = "equidistant", camera.distortion
        elif camera.model == "radtan":
            most = 8 if camera.distortion[5:].any() else 5
            kind = "rational_polynomial" if most == 8 else "plumb_bob"
            coefficients = _shortened(camera, most, "ROS")
        else:
            raise _refused(camera, "ROS")
        projection = np.column_stack([view.matrix, np.zeros(3)])
        projection[0, 3] = -view.matrix[0, 0] * baseline * k
        values = {
            "camera_name": name,
            "image_width": camera.width,
            "image_height": camera.height,
            **_block("camera_matrix", camera.matrix),
            "distortion_model": kind,
            **_block("distortion_coefficients", coefficients[None]),
            **_block("rectification_matrix", view.rotations[k]),
            **_block("projection_matrix", projection),
        }
        write_text(path / f"{name}.yaml", yaml.safe_dump(values, sort_keys=False))


def _block(key: str, matrix: FloatArray) -> Mapping[str, Any]:
    rows, columns = matrix.shape
    return {key: {"rows": rows, "cols": columns, "data": matrix.ravel().tolist()}}


FORMATS: dict[
    str, tuple[str, tuple[str, ...], Callable[[Calibration, Path, StatedView | None], None]]
] = {
    "fgslam": ("calib.json of fgslam", (".json",), _write_own),
    "opencv": ("OpenCV", (".yml", ".yaml", ".xml", ".json"), _write_opencv),
    "kalibr": ("Kalibr", (".yaml", ".yml"), _write_kalibr),
    "ros": ("ROS camera_info, a folder", ("",), _write_ros),
}
"""Formats that are written: in words, the endings of their names, and how."""
_ENDINGS = {
    ".json": "fgslam",
    ".yml": "opencv",
    ".xml": "opencv",
    ".yaml": "kalibr",
    "": "ros",
}


# --------------------------------------------------------------------------------------------
# What a format cannot hold


def _pair(calibration: Calibration, what: str) -> tuple[RawCamera, RawCamera]:
    """Both cameras of a pair of one model. Raises CalibrationError: they are no such pair."""
    if len(calibration.cameras) != 2:
        raise CalibrationError(
            f"{calibration.source}: holds {len(calibration.cameras)} cameras, but {what} two; "
            "choose them (--cameras 0,1), or write calib.json or Kalibr's .yaml"
        )
    first, second = calibration.cameras
    if first.model != second.model:
        raise CalibrationError(
            f"{calibration.source}: {first.name} is {first.model} and {second.name} "
            f"{second.model}, but {what} has one model; write calib.json"
        )
    return first, second


def _shortened(camera: RawCamera, most: int, tool: str) -> FloatArray:
    """The first ``most`` coefficients. Raises CalibrationError: others are not zero."""
    if camera.distortion[most:].any():
        raise CalibrationError(
            f"{camera.name}: {tool} has no radial-tangential model of {len(camera.distortion)} "
            "coefficients; write calib.json, or OpenCV's .yml"
        )
    short = camera.distortion[:most]
    return np.concatenate([short, np.zeros(most - len(short))])


def _refused(camera: RawCamera, tool: str) -> CalibrationError:
    return CalibrationError(
        f"{camera.name}: {tool} has no model {camera.model}; write calib.json, which has all"
    )
