"""Calibration files of KITTI: projections of the rectified grey pair, camera 0 on the left."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_lines
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA
from fgslam.core.sensors import CameraRig


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
    left, right = (_projection(path, key) for key in keys)
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


def _projection(path: Path, key: str) -> FloatArray:
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
