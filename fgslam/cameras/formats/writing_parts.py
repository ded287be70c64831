"""What formats of calibrations can hold: the parts of a calibration, or why they have no place."""

from __future__ import annotations

import numpy as np

from fgslam.cameras.raw_cameras import Calibration, RawCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError


def shortened(camera: RawCamera, most: int, tool: str) -> FloatArray:
    """The first ``most`` coefficients. Raises CalibrationError: others are not zero."""
    if camera.distortion[most:].any():
        raise CalibrationError(
            f"{camera.name}: {tool} has no radial-tangential model of {len(camera.distortion)} "
            "coefficients; write calib.json, or OpenCV's .yml"
        )
    short = camera.distortion[:most]
    return np.concatenate([short, np.zeros(most - len(short))])


def refused(camera: RawCamera, tool: str) -> CalibrationError:
    """The error of a model that a tool does not have."""
    return CalibrationError(
        f"{camera.name}: {tool} has no model {camera.model}; write calib.json, which has all"
    )


def require_no_skew(camera: RawCamera, tool: str) -> None:
    """Raises CalibrationError where pixels are skew."""
    if camera.matrix[0, 1] or camera.matrix[1, 0]:
        raise CalibrationError(
            f"{camera.name}: its pixels are skew, which {tool} has no number for; write calib.json"
        )


def two_of_one_size(calibration: Calibration, what: str) -> tuple[RawCamera, RawCamera]:
    """As :func:`two`. Raises CalibrationError: also where their images differ in size."""
    first, second = two(calibration, what)
    if first.size != second.size:
        sizes = " and ".join(f"{width}x{height}" for width, height in (first.size, second.size))
        raise CalibrationError(
            f"{calibration.source}: its cameras have images of {sizes}, but {what} has one size; "
            "write calib.json or Kalibr's .yaml"
        )
    return first, second


def two(calibration: Calibration, what: str) -> tuple[RawCamera, RawCamera]:
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
