"""Calibrations written in the formats of fgslam, OpenCV, Kalibr and ROS."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from fgslam.cameras.calib_json import raw_values
from fgslam.cameras.formats import KALIBR
from fgslam.cameras.lenses import Calibration, RawCamera, View
from fgslam.cameras.rig import rig_of
from fgslam.cameras.trees import intrinsic_matrix
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import clear_output_errors, replacing, write_text
from fgslam.core.geometry import inverse


def write_calibration(
    calibration: Calibration, path: Path, form: str | None = None, fov_deg: float | None = None
) -> str:
    """Writes a calibration; the name states the format, unless it is given.

    ``.json`` is fgslam's own, ``.yml`` and ``.xml`` OpenCV's, ``.yaml`` Kalibr's, and a name
    without an ending a folder with ``left.yaml`` and ``right.yaml`` of ROS.

    Args:
        calibration: what is written.
        path: the file or folder.
        form: one of :data:`FORMATS`; None: by the name.
        fov_deg: horizontal angle of the rectified view, for ROS, whose files must state one; None:
            as the calibration has it.

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
            f"{path}: no format ends like that; known: {known}, and no ending (a folder for ROS)"
        )
    if name not in FORMATS:
        raise CalibrationError(f"format {name!r} is not known; use {', '.join(FORMATS)}")
    words, endings, write = FORMATS[name]
    if path.suffix.lower() not in endings:
        wanted = " or ".join(ending or "no ending, a folder" for ending in endings)
        raise CalibrationError(f"{path}: {words} is written as {wanted}; give such a name")
    if name != "fgslam":
        calibration.require_uncorrected(f"{words} cannot hold them")
    write(calibration, path, fov_deg)
    return words


_ENDINGS = {".json": "fgslam", ".yml": "opencv", ".xml": "opencv", ".yaml": "kalibr", "": "ros"}


def _write_own(calibration: Calibration, path: Path, _: float | None) -> None:
    write_text(path, json.dumps(raw_values(calibration), indent=2) + "\n")


_KALIBR = {model: (*names.split("-"), own) for names, (model, own) in reversed(KALIBR.items())}
"""Its camera and distortion model, and how many of our parameters are among its intrinsics."""


def _write_kalibr(calibration: Calibration, path: Path, _: float | None) -> None:
    chain: dict[str, dict[str, Any]] = {}
    for k, camera in enumerate(calibration.cameras):
        if camera.model not in _KALIBR:
            raise _refused(camera, "Kalibr")
        model, distortion, own = _KALIBR[camera.model]
        numbers = _shortened(camera, 4, "Kalibr") if camera.model == "radtan" else camera.distortion
        if camera.matrix[0, 1] or camera.matrix[1, 0]:
            raise CalibrationError(
                f"{camera.name}: its pixels are skew, which Kalibr cannot hold; write calib.json"
            )
        chain[f"cam{k}"] = {
            "camera_model": model,
            "intrinsics": [*numbers[:own].tolist(), *camera.intrinsics.tolist()],
            "distortion_model": distortion,
            "distortion_coeffs": numbers[own:].tolist(),
            "resolution": list(camera.size),
            **({"rostopic": camera.topic} if camera.topic else {}),
        }
        if k:
            step = inverse(camera.bTc) @ calibration.cameras[k - 1].bTc
            chain[f"cam{k}"]["T_cn_cnm1"] = step.tolist()
    write_text(path, yaml.safe_dump(chain, sort_keys=False))


_OPENCV = {"radtan": "M", "equidistant": "K", "omni": "K"}
"""Letter of the matrices: cv2.fisheye's and cv2.omnidir's are K."""


def _write_opencv(calibration: Calibration, path: Path, _: float | None) -> None:
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


def _write_ros(calibration: Calibration, path: Path, fov_deg: float | None) -> None:
    cameras = _pair(calibration, "ROS")
    view = calibration.view if fov_deg is None else None
    if view is None:
        rig = rig_of(calibration, fov_deg)
        if rig.sources != (1, 0):
            raise CalibrationError(
                f"{calibration.source}: its first camera is the right one, and ROS wants the left "
                "one first; choose them in that order: --cameras 1,0"
            )
        first, second = (rig.bTc[:3, :3].T @ camera.bTc[:3, :3] for camera in cameras)
        matrix = intrinsic_matrix(rig.fx, rig.fy, rig.cx, rig.cy)
        view = View(matrix, (rig.width, rig.height), (first, second))
    baseline = float(np.linalg.norm(calibration.offset(1, 0)[:3, 3]))
    files = {}
    for k, (camera, name) in enumerate(zip(cameras, ("left", "right"), strict=True)):
        if camera.model not in ("equidistant", "radtan"):
            raise _refused(camera, "ROS")
        kind, coefficients = camera.model, camera.distortion
        if kind == "radtan":
            most = 8 if coefficients[5:].any() else 5
            kind = "rational_polynomial" if most == 8 else "plumb_bob"
            coefficients = _shortened(camera, most, "ROS")
        projection = np.column_stack([view.matrix, np.zeros(3)])
        projection[0, 3] = -view.matrix[0, 0] * baseline * k
        files[f"{name}.yaml"] = {
            "camera_name": name,
            "image_width": camera.width,
            "image_height": camera.height,
            **_block("camera_matrix", camera.matrix),
            "distortion_model": kind,
            **_block("distortion_coefficients", coefficients[None]),
            **_block("rectification_matrix", view.rotations[k]),
            **_block("projection_matrix", projection),
        }
    with clear_output_errors(path):
        path.mkdir(exist_ok=True)
    for name, values in files.items():
        write_text(path / name, yaml.safe_dump(values, sort_keys=False))


def _block(key: str, matrix: FloatArray) -> Mapping[str, Any]:
    rows, columns = matrix.shape
    return {key: {"rows": rows, "cols": columns, "data": matrix.ravel().tolist()}}


FORMATS = {
    "fgslam": ("calib.json of fgslam", (".json",), _write_own),
    "opencv": ("OpenCV", (".yml", ".yaml", ".xml", ".json"), _write_opencv),
    "kalibr": ("Kalibr", (".yaml", ".yml"), _write_kalibr),
    "ros": ("ROS camera_info, a folder", ("",), _write_ros),
}
"""Formats that are written: in words, the endings of their names, and what writes them."""


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
