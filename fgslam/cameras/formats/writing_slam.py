"""Calibrations in words of KITTI (rectified), EuRoC and ORB-SLAM3."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import yaml

from fgslam.cameras.formats.writing_parts import (
    refused,
    require_no_skew,
    shortened,
    two_of_one_size,
)
from fgslam.cameras.raw_cameras import Calibration, RawCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError

_SAME = 1e-9  # of matrices of one rectified pair
_LEVEL = 1e-6  # of the baseline: what a right camera may be above or before the left one


def kitti_text(calibration: Calibration) -> str:
    """Lines P0 and P1 of a rectified pair, left camera first.

    Raises:
        CalibrationError: the cameras are no rectified pair.
    """
    left, right = two_of_one_size(calibration, "KITTI's calib.txt")
    step = calibration.offset(1, 0)
    baseline = float(step[0, 3])
    rectified = (
        not (left.distortion.any() or right.distortion.any() or left.model != "radtan")
        and np.allclose(left.matrix, right.matrix, rtol=_SAME, atol=0.0)
        and np.allclose(step[:3, :3], np.eye(3), rtol=0.0, atol=_SAME)
        and np.abs(step[1:3, 3]).max() <= _LEVEL * abs(baseline)
    )
    if not rectified:
        raise CalibrationError(
            f"{calibration.source}: is of images that are not rectified, and KITTI's calib.txt of "
            "such alone; write calib.json, or the calibration of rectified images"
        )
    _require_left_first(calibration, "KITTI")
    lines = []
    for number, shift in ((0, 0.0), (1, -baseline * float(left.matrix[0, 0]))):
        projection = np.column_stack([left.matrix, [shift, 0.0, 0.0]])
        lines.append(f"P{number}: " + " ".join(repr(v) for v in projection.ravel().tolist()))
    return "\n".join(lines) + "\n"


def _require_left_first(calibration: Calibration, tool: str) -> None:
    if calibration.offset(1, 0)[0, 3] <= 0.0:
        raise CalibrationError(
            f"{calibration.source}: its first camera is the right one, and {tool} wants the left "
            "one first; choose them in that order: --cameras 1,0"
        )


# --------------------------------------------------------------------------------------------
# EuRoC


def euroc_files(calibration: Calibration) -> Mapping[str, str]:
    """Text of each camera's sensor.yaml by its place: cam0/sensor.yaml, cam1/sensor.yaml, ...

    Raises:
        CalibrationError: a camera's model has no place in them.
    """
    return {
        f"cam{k}/sensor.yaml": yaml.safe_dump(_sensor(camera), sort_keys=False)
        for k, camera in enumerate(calibration.cameras)
    }


def _sensor(camera: RawCamera) -> Mapping[str, object]:
    if camera.model == "radtan":
        model, coefficients = "radial-tangential", shortened(camera, 4, "EuRoC")
    elif camera.model == "equidistant":
        model, coefficients = "equidistant", camera.distortion
    else:
        raise refused(camera, "EuRoC")
    require_no_skew(camera, "EuRoC")
    return {
        "sensor_type": "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": camera.bTc.ravel().tolist()},
        "resolution": list(camera.size),
        "camera_model": "pinhole",
        "intrinsics": camera.intrinsics.tolist(),
        "distortion_model": model,
        "distortion_coefficients": coefficients.tolist(),
    }


# --------------------------------------------------------------------------------------------
# ORB-SLAM3


_ORB_TYPES = {"radtan": "PinHole", "equidistant": "KannalaBrandt8"}
_ORB_TERMS = {"radtan": ("k1", "k2", "p1", "p2", "k3"), "equidistant": ("k1", "k2", "k3", "k4")}


def orb_slam_text(calibration: Calibration) -> str:
    """The part of ORB-SLAM3's settings that is about the cameras, left camera first.

    Raises:
        CalibrationError: they are no pair of one of its models.
    """
    cameras = two_of_one_size(calibration, "ORB-SLAM3")
    model = cameras[0].model
    if model not in _ORB_TYPES:
        raise refused(cameras[0], "ORB-SLAM3")
    _require_left_first(calibration, "ORB-SLAM3")
    lines = [
        "%YAML:1.0",
        "---",
        'File.version: "1.0"',
        f'Camera.type: "{_ORB_TYPES[model]}"',
        *(line for k, camera in enumerate(cameras, 1) for line in _orb_camera(k, camera)),
        f"Camera.width: {cameras[0].width}",
        f"Camera.height: {cameras[0].height}",
        "Stereo.T_c1_c2: !!opencv-matrix",
        "   rows: 4",
        "   cols: 4",
        "   dt: f",  # it reads the matrix as of floats, whatever is written here
        f"   data: [{', '.join(_as_float32(calibration.offset(1, 0)))}]",
    ]
    return "\n".join(lines) + "\n"


def _as_float32(matrix: FloatArray) -> Iterator[str]:
    """The shortest numbers that give the same floats of 32 bits."""
    return (str(number) for number in matrix.astype(np.float32).ravel())


def _orb_camera(number: int, camera: RawCamera) -> Iterator[str]:
    require_no_skew(camera, "ORB-SLAM3")
    terms, values = _ORB_TERMS[camera.model], camera.distortion
    if camera.model == "radtan":
        values = shortened(camera, 5, "ORB-SLAM3")
        terms = terms if len(camera.distortion) > 4 else terms[:4]
    named = zip(("fx", "fy", "cx", "cy"), camera.intrinsics.tolist(), strict=True)
    for name, value in (*named, *zip(terms, values.tolist(), strict=False)):
        yield f"Camera{number}.{name}: {value!r}"
    if camera.model == "equidistant":  # columns that the other camera may see: all
        yield f"Camera{number}.overlappingBegin: 0"
        yield f"Camera{number}.overlappingEnd: {camera.width - 1}"
