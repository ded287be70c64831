"""Calibrations of other tools: Kalibr, EuRoC (ASL), ROS camera_info, OpenCV, KITTI."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fgslam.cameras.calibration import numbers, read_calibration_yaml
from fgslam.cameras.rectification import RawCamera, Rectifier, rectified_by
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_lines
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, inverse, is_rigid
from fgslam.core.sensors import CameraRig

_KALIBR_MODELS = {"pinhole": ("radtan",)}
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
        _kalibr_camera(path, "cam0", values["cam0"], np.eye(4)),
        _kalibr_camera(path, "cam1", values["cam1"], inverse(pose)),
    )


def _kalibr_camera(path: Path, name: str, values: Mapping[str, Any], bTc: FloatArray) -> RawCamera:
    model, distortion = values.get("camera_model"), values.get("distortion_model")
    if distortion not in _KALIBR_MODELS.get(str(model), ()):
        raise CalibrationError(
            f"{path}: {name} is {model} with {distortion} distortion; only pinhole with radtan is "
            "read, rectify the images with another tool"
        )
    keys = {f"{name}.{key}": value for key, value in values.items()}
    names = tuple(f"{name}.{key}" for key in ("resolution", "intrinsics", "distortion_coeffs"))
    return _pinhole(path, keys, names, bTc, f"{path.name}: {name}")


def _pinhole(
    path: Path, values: Mapping[str, Any], keys: tuple[str, ...], bTc: FloatArray, name: str
) -> RawCamera:
    """A pinhole camera by the ``keys`` of its resolution, its intrinsics and its distortion."""
    resolution, intrinsics, distortion = keys
    width, height = (int(v) for v in numbers(path, values, resolution, 2))
    fx, fy, cx, cy = numbers(path, values, intrinsics, 4)
    if min(width, height) <= 0 or min(fx, fy) <= 0.0:
        raise CalibrationError(
            f"{path}: {resolution} {width}x{height} and focal lengths {fx:g}, {fy:g} must be "
            "positive; correct the file"
        )
    return RawCamera(
        width=width,
        height=height,
        matrix=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        distortion=numbers(path, values, distortion, 4),
        bTc=bTc,
        name=name,
    )


# --------------------------------------------------------------------------------------------
# The ASL layout (EuRoC): sensor.yaml


_ASL_MODELS = ("radial-tangential", "radtan", "plumb_bob")


def read_asl_camera(path: Path) -> RawCamera:
    """Read a camera's sensor.yaml.

    Raises:
        CalibrationError: a value is missing, not finite or impossible, or the distortion model is
            another than radial-tangential.
    """
    values = read_calibration_yaml(path)
    model = values.get("distortion_model")
    if model not in _ASL_MODELS:
        raise CalibrationError(
            f"{path}: distortion_model is {model!r}, only radial-tangential is read; rectify the "
            "images with another tool and use the image_folder layout"
        )
    keys = ("resolution", "intrinsics", "distortion_coefficients")
    return _pinhole(path, values, keys, _asl_mounting(path, values), str(path.parent))


def read_asl_mounting(path: Path) -> FloatArray:
    """``T_BS`` (4, 4) of a sensor.yaml: the pose of the sensor in the body."""
    return _asl_mounting(path, read_calibration_yaml(path))


def _asl_mounting(path: Path, values: Mapping[str, Any]) -> FloatArray:
    block = values.get("T_BS")
    data = numbers(path, block if isinstance(block, dict) else {}, "data", 16)
    bTc = data.reshape(4, 4)
    if not is_rigid(bTc):
        raise CalibrationError(f"{path}: T_BS is not a rigid motion; correct the file")
    return bTc


# --------------------------------------------------------------------------------------------
# ROS camera_info: two files, each with its own rectification and projection


_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8}
"""Distortion models of OpenCV that are read, and how many numbers each has."""


def read_camera_info_pair(left: Path, right: Path) -> Rectifier:
    """The rectification that the two files state; the body is the rectified right camera.

    Raises:
        CalibrationError: a file is missing or malformed, its distortion model is another one, the
            files are not of one rectified pair, or left and right are swapped.
    """
    of_right, of_left = (read_calibration_yaml(path) for path in (right, left))
    return camera_info_pair((left, of_left), (right, of_right))


def camera_info_pair(
    left: tuple[Path, Mapping[str, Any]], right: tuple[Path, Mapping[str, Any]]
) -> Rectifier:
    """As :func:`read_camera_info_pair`, of camera_info that is read already.

    Args:
        left: what messages call it, and its keys and values as in a camera_info file.
        right: the same of the right camera.
    """
    raw = [_camera_info(path, values) for path, values in (right, left)]
    rotations = [_info_matrix(p, v, "rectification_matrix", 3, 3) for p, v in (right, left)]
    of_right, of_left = (_info_matrix(p, v, "projection_matrix", 3, 4) for p, v in (right, left))
    if not np.allclose(of_left[:, :3], of_right[:, :3]):
        raise CalibrationError(
            f"{left[0]}: its projection_matrix differs from that of {right[0].name}, so the two "
            "are not of one rectified pair; calibrate them as a stereo pair"
        )
    if of_right[0, 0] <= 0.0 or not of_right[0, 3] < 0.0:
        raise CalibrationError(
            f"{right[0]}: projection_matrix states no baseline (its fourth number is "
            f"{of_right[0, 3]:g}, must be negative); calibrate a stereo pair, or swap the files"
        )
    found = rectified_by(raw[0], raw[1], (rotations[0], rotations[1]), of_right)
    # The files say nothing of a robot: the body is the rectified camera.
    return Rectifier(replace(found.rig, bTc=np.eye(4)), found.maps)


def _camera_info(path: Path, values: Mapping[str, Any]) -> RawCamera:
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
        matrix=_info_matrix(path, values, "camera_matrix", 3, 3),
        distortion=_info_matrix(path, values, "distortion_coefficients", 1, count)[0],
        bTc=np.eye(4),
        name=str(path),
    )


def _info_matrix(
    path: Path, values: Mapping[str, Any], key: str, rows: int, columns: int
) -> FloatArray:
    block = values.get(key)
    data = block.get("data") if isinstance(block, dict) else None
    return numbers(path, {f"{key}.data": data}, f"{key}.data", rows * columns).reshape(
        rows, columns
    )


# --------------------------------------------------------------------------------------------
# OpenCV's stereo calibration: M1, D1, M2, D2, R, T, in one file or in two beside each other


_BESIDE = ("intrinsics.yml", "extrinsics.yml")
"""Files that OpenCV's sample program stereo_calib writes."""

_OPENCV_SHAPES = {"M1": (3, 3), "M2": (3, 3), "R": (3, 3), "T": (3, 1)}
_OPENCV_DISTORTIONS = (4, 5, 8, 12, 14)


def read_opencv_pair(path: Path, size: tuple[int, int] | None) -> tuple[RawCamera, RawCamera]:
    """The two cameras; the body is the first one.

    ``R`` and ``T`` take points from the first camera's axes to the second's, in the unit of the
    calibration target: metres, if its squares were given in metres.

    Args:
        path: a file of OpenCV's FileStorage.
        size: width and height of the images, where the file has no image_width and image_height.

    Raises:
        CalibrationError: a matrix or the size is missing, or not what it should be.
    """
    files = [path, *(path.with_name(name) for name in _BESIDE if path.name in _BESIDE)]
    found = {name: _stored_matrix(files, name) for name in (*_OPENCV_SHAPES, "D1", "D2")}
    width, height = size or _stored_size(path, files)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = found["R"], found["T"][:, 0]
    if not is_rigid(pose):
        raise CalibrationError(f"{path}: R is not a rotation; calibrate again")
    first, second = (
        RawCamera(width, height, found[m], np.ravel(found[d]), bTc, f"{path.name}: {m}")
        for m, d, bTc in (("M1", "D1", np.eye(4)), ("M2", "D2", inverse(pose)))
    )
    return first, second


def _stored_matrix(files: list[Path], name: str) -> FloatArray:
    for file in files:
        matrix = _stored(file, name)
        if matrix is not None:
            break
    else:
        raise CalibrationError(
            f"{files[0]} has no matrix {name}; a stereo pair needs M1, D1, M2, D2, R and T "
            "(intrinsics.yml and extrinsics.yml beside each other will do)"
        )
    good = (
        matrix.size in _OPENCV_DISTORTIONS
        if name in ("D1", "D2")
        else matrix.shape == _OPENCV_SHAPES[name]
    )
    if not good or not np.isfinite(matrix).all():
        raise CalibrationError(f"{files[0]}: {name} has shape {matrix.shape}; calibrate again")
    return matrix


def _opened(file: Path) -> cv2.FileStorage:
    try:
        return cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:  # its constructor wraps the one in the other
        cause = " ".join(str(error.__cause__ or error).split())
        raise CalibrationError(f"{file} is malformed: {cause}; write the file again") from None


def _stored(file: Path, name: str) -> FloatArray | None:
    if not file.is_file():
        return None
    storage = _opened(file)
    try:
        matrix = storage.getNode(name).mat()
    except cv2.error:
        return None
    finally:
        storage.release()
    return None if matrix is None else np.asarray(matrix, np.float64)


def _stored_size(path: Path, files: list[Path]) -> tuple[int, int]:
    for file in files:
        if file.is_file():
            storage = _opened(file)
            width, height = (storage.getNode(n).real() for n in ("image_width", "image_height"))
            storage.release()
            if width > 0.0 and height > 0.0:
                return int(width), int(height)
    raise CalibrationError(f"{path} does not state the images' size; give size=(width, height)")


# --------------------------------------------------------------------------------------------
# KITTI: projections of the rectified grey pair, camera 0 on the left


@dataclass(frozen=True, slots=True)
class Projections:
    """Intrinsics in pixels and baseline in metres; the files do not state the images' size."""

    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float

    def rig(self, width: int, height: int) -> CameraRig:
        """The rig of images of this size, looking ahead."""
        return CameraRig(
            width,
            height,
            self.fx,
            self.fy,
            self.cx,
            self.cy,
            self.baseline,
            None,
            BODY_FORWARD_LEFT_UP_FROM_CAMERA,
        )


def read_projections(path: Path, keys: tuple[str, str] = ("P0", "P1")) -> Projections:
    """Of a calib.txt (P0, P1), or by other keys of a calib_cam_to_cam.txt; left camera first.

    Raises:
        CalibrationError: a line is missing or malformed, or the pair is not rectified.
    """
    left, right = (_kitti_projection(path, key) for key in keys)
    if not np.allclose(left[:, :3], right[:, :3]):
        raise CalibrationError(
            f"{path}: P0 and P1 differ in their intrinsics, so the pair is not rectified; use the "
            "calibration that came with the sequence"
        )
    fx, fy = float(right[0, 0]), float(right[1, 1])
    if fx <= 0.0 or fy <= 0.0:
        raise CalibrationError(f"{path}: focal lengths {fx:g}, {fy:g} must be positive")
    baseline = float(left[0, 3] - right[0, 3]) / fx
    if baseline <= 0.0:
        raise CalibrationError(
            f"{path}: the baseline is {baseline:g} m, must be positive; P0 belongs to the left "
            "camera (image_0), P1 to the right one (image_1): are they swapped?"
        )
    return Projections(fx, fy, float(right[0, 2]), float(right[1, 2]), baseline)


def _kitti_projection(path: Path, key: str) -> FloatArray:
    """Projection matrix (3, 4) of a line such as ``P1: 12 numbers``."""
    for line, text in read_lines(path, CalibrationError):
        name, _, rest = text.partition(":")
        if name.strip() != key:
            continue
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            values = np.empty(0)
        if len(values) != 12 or not np.isfinite(values).all():
            raise CalibrationError(
                f"{path}, line {line}: {key} must be 12 finite numbers; restore the file"
            )
        return values.reshape(3, 4)
    raise CalibrationError(f"{path} has no line {key!r}; restore the file of the odometry data set")
