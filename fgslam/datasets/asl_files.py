"""Files of the ASL layout (EuRoC): sensor.yaml, data.csv of a camera, data.csv of the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import inverse, is_rigid
from fgslam.core.text_files import read_lines
from fgslam.datasets.tables import Table, read_table, require_increasing
from fgslam.datasets.trajectories import (
    nearest_rows,
    poses_from_quaternions,
    require_unit_quaternions,
)

NANOSECONDS = 1e-9
_DISTORTION_MODELS = ("radial-tangential", "radtan", "plumb_bob")
_TRUTH_COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True, slots=True, eq=False)
class AslCamera:
    """A raw camera of a sensor.yaml.

    Attributes:
        width, height: pixels.
        matrix: (3, 3) intrinsics in pixels.
        distortion: (4,) k1, k2, p1, p2, radial-tangential as in OpenCV.
        bTc: (4, 4) pose of the camera in the body (T_BS).
    """

    width: int
    height: int
    matrix: FloatArray
    distortion: FloatArray
    bTc: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrames:
    """Images listed in a camera's data.csv: stamps (n,) in nanoseconds, increasing, and files."""

    stamps: IntArray
    paths: tuple[Path, ...]


def read_camera(path: Path) -> AslCamera:
    """Read a camera's sensor.yaml.

    Raises:
        CalibrationError: a value is missing, not finite or impossible, or the distortion model is
            another than radial-tangential.
    """
    values = _read_yaml(path)
    model = values.get("distortion_model")
    if model not in _DISTORTION_MODELS:
        raise CalibrationError(
            f"{path}: distortion_model is {model!r}, only radial-tangential is read; rectify the "
            "images with another tool and use the image_folder layout"
        )
    width, height = (int(v) for v in _numbers(path, values, "resolution", 2))
    fx, fy, cx, cy = _numbers(path, values, "intrinsics", 4)
    if min(width, height) <= 0 or min(fx, fy) <= 0.0:
        raise CalibrationError(
            f"{path}: resolution {width}x{height} and focal lengths {fx:g}, {fy:g} must be positive"
        )
    return AslCamera(
        width=width,
        height=height,
        matrix=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        distortion=_numbers(path, values, "distortion_coefficients", 4),
        bTc=_mounting(path, values),
    )


def _read_yaml(path: Path) -> Mapping[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as cause:
        raise CalibrationError(
            f"calibration {path} cannot be read: {cause.strerror}; restore the file"
        ) from cause
    # OpenCV writes a directive that is no YAML: "%YAML:1.0".
    lines = [line for line in text.splitlines() if not line.startswith("%YAML:")]
    try:
        values = yaml.safe_load("\n".join(lines))
    except yaml.YAMLError as cause:
        reason = " ".join(str(cause).split())
        raise CalibrationError(f"{path} is not YAML: {reason}; correct the file") from cause
    if not isinstance(values, dict):
        raise CalibrationError(f"{path} must hold keys and values; restore the file")
    return values


def _numbers(path: Path, values: Mapping[str, Any], key: str, count: int) -> FloatArray:
    """A list of ``count`` finite numbers of the file. Raises CalibrationError otherwise."""
    given = values.get(key)
    good = isinstance(given, list) and len(given) == count and all(map(_is_finite, given))
    if not good:
        raise CalibrationError(
            f"{path}: {key} is {given!r}, expected {count} finite numbers; correct the file"
        )
    return np.array(given, np.float64)


def _is_finite(value: object) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(float(value))  # type: ignore[arg-type]


def _mounting(path: Path, values: Mapping[str, Any]) -> FloatArray:
    block = values.get("T_BS")
    data = _numbers(path, block if isinstance(block, dict) else {}, "data", 16)
    bTc = data.reshape(4, 4)
    if not is_rigid(bTc):
        raise CalibrationError(f"{path}: T_BS is not a rigid motion; correct the file")
    return bTc


def read_camera_frames(folder: Path) -> CameraFrames:
    """Images that a camera's data.csv lists (``stamp in ns, file name``), under data/.

    Raises:
        DatasetError: the file is missing, empty or malformed, or stamps do not increase.
    """
    path = folder / "data.csv"
    stamps: list[int] = []
    paths: list[Path] = []
    for line, text in read_lines(path):
        words = [word.strip() for word in text.split(",")]
        if len(words) < 2 or not words[0].isdecimal() or not words[1]:
            raise DatasetError(
                f"{path}, line {line}: expected a stamp in nanoseconds and a file name; correct "
                "the line"
            )
        if stamps and int(words[0]) <= stamps[-1]:
            raise DatasetError(
                f"{path}, line {line}: stamp {words[0]} does not come after {stamps[-1]}; put the "
                "lines in time order and remove duplicates"
            )
        stamps.append(int(words[0]))
        paths.append(folder / "data" / words[1])
    if not stamps:
        raise DatasetError(f"{path} lists no image; restore the file")
    return CameraFrames(np.array(stamps, np.int64), tuple(paths))


def pair_frames(
    right: CameraFrames, left: CameraFrames, tolerance: float
) -> tuple[tuple[IntArray, IntArray], tuple[str, ...]]:
    """Rows of the right and the left images that are each other's nearest in time.

    Args:
        right: images of the right camera.
        left: images of the left camera.
        tolerance: largest difference in seconds.

    Returns:
        The paired rows, and notes on images left without a partner.

    Raises:
        DatasetError: no pair is left.
    """
    partner = nearest_rows(left.stamps, right.stamps)
    rows = np.arange(len(right.stamps))
    mutual = nearest_rows(right.stamps, left.stamps)[partner] == rows
    close = np.abs(left.stamps[partner] - right.stamps) <= round(tolerance / NANOSECONDS)
    kept = rows[mutual & close]
    if len(kept) == 0:
        raise DatasetError(
            f"no image of {right.paths[0].parent} has a partner in {left.paths[0].parent} within "
            f"{1e3 * tolerance:g} ms; raise dataset.pairing_tolerance_ms or restore the stamps"
        )
    alone = (("right", len(rows) - len(kept)), ("left", len(left.stamps) - len(kept)))
    notes = tuple(
        f"{n} {camera} images have no partner within {1e3 * tolerance:g} ms and are left out"
        for camera, n in alone
        if n
    )
    return (kept, partner[kept]), notes


def read_body_truth(folder: Path) -> Trajectory | None:
    """Body poses of ``state_groundtruth_estimate0``, stamps in seconds; None where it is absent.

    The file gives the pose of its own sensor; sensor.yaml says where that sits on the body.

    Raises:
        DatasetError: the file is malformed, or its stamps do not increase.
        CalibrationError: its sensor.yaml is malformed.
    """
    path = folder / "data.csv"
    if not path.is_file():
        return None
    table = read_table(path, _TRUTH_COLUMNS, ",")
    require_increasing(table, table.column(0))
    stamps = table.column(0) * NANOSECONDS
    poses = _sensor_poses(table)
    if (folder / "sensor.yaml").is_file():
        mounting = folder / "sensor.yaml"
        poses = poses @ inverse(_mounting(mounting, _read_yaml(mounting)))
    return Trajectory(stamps, poses)


def _sensor_poses(table: Table) -> FloatArray:
    quaternions = table.values[:, [5, 6, 7, 4]]
    require_unit_quaternions(table, quaternions)
    return poses_from_quaternions(table.values[:, 1:4], quaternions)
