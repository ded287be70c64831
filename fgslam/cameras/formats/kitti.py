"""KITTI: projections of a rectified pair, grey (cameras 0 and 1) or colour (2 and 3)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fgslam.cameras.raw_cameras import Calibration, RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_lines
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    inverse,
    pose,
    reorthonormalise,
)

_PAIRS = ((0, 1), (2, 3))  # of the odometry data: left and right camera, grey, else colour
_RECTIFIED = "P_rect_"
RAW = ("P_rect_00", "P_rect_01")
RAW_COLOUR = ("P_rect_02", "P_rect_03")
Size = tuple[int, int]


def is_kitti(text: str) -> bool:
    """Whether a text is a calib.txt or a calib_cam_to_cam.txt."""
    return re.search(r"^(P0|P_rect_\d+):", text, re.M) is not None


def read_kitti(path: Path, size: Size | None, keys: tuple[str, str] | None = None) -> Calibration:
    """A rectified pair; the body is the left camera, looking ahead.

    ``keys`` are the lines of left and right camera; None: of the grey pair, or of the colour one
    where only that has images beside the file.

    Raises:
        CalibrationError: a line is missing or malformed, or the pair is not rectified.
    """
    lines = _lines(path)
    rectified = sorted(name for name in lines if name.startswith(_RECTIFIED))
    raw = bool(rectified)
    stated = (rectified[0], rectified[1]) if len(rectified) == 2 else RAW  # DrivingStereo: 101, 103
    keys = keys or (stated if raw else _beside(path))
    left, right = (_projection(path, lines, key) for key in keys)
    if not np.allclose(left[:, :3], right[:, :3]):
        raise CalibrationError(
            f"{path}: {keys[0]} and {keys[1]} differ in their intrinsics, so the pair is not "
            "rectified; use the calibration that came with the sequence"
        )
    offset = _baseline(path, left, right, keys)
    width, height = (
        (_stated_size(path, lines, keys[0].removeprefix(_RECTIFIED)) if raw else None)
        or size
        or (0, 0)
    )
    ahead = BODY_FORWARD_LEFT_UP_FROM_CAMERA
    cameras = tuple(
        checked_camera(
            RawCamera(
                width,
                height,
                left[:, :3],
                np.zeros(4),
                ahead @ pose(np.eye(3), np.array([x, 0.0, 0.0])),
                f"{path.name}: {key}",
            )
        )
        for key, x in zip(keys, (-offset, 0.0), strict=True)
    )
    return Calibration(str(path), "KITTI", cameras, sided=True)


def pair_beside(path: Path) -> tuple[int, int] | None:
    """Left and right camera whose folders of images lie beside a calib.txt; None: of no pair."""
    for pair in _PAIRS:
        if all((path.parent / f"image_{number}").is_dir() for number in pair):
            return pair
    return None


def _beside(path: Path) -> tuple[str, str]:
    """Lines of the pair whose images lie beside a calib.txt; of the grey one where none does."""
    left, right = pair_beside(path) or _PAIRS[0]
    return f"P{left}", f"P{right}"


def right_of_camera_0(path: Path) -> float:
    """How far the pair's right camera is to the right of camera 0, whose poses KITTI gives, metres.

    Raises:
        CalibrationError: a line is missing or malformed.
    """
    right = _projection(path, _lines(path), _beside(path)[1])
    return -float(right[0, 3] / right[0, 0])


def left_on_inertial_unit(path: Path, keys: tuple[str, str]) -> FloatArray | None:
    """Pose (4, 4) of a raw drive's rectified left camera on the inertial unit.

    By calib_cam_to_cam.txt and the two files beside it that lead over the laser scanner; None
    where those are absent.

    Raises:
        CalibrationError: a line is missing or malformed.
    """
    chain = [path.parent / f"calib_{name}.txt" for name in ("imu_to_velo", "velo_to_cam")]
    if not all(file.is_file() for file in chain):
        return None
    to_scanner, to_camera = (_motion(file) for file in chain)
    lines = _lines(path)
    upright = pose(_numbers(path, lines, "R_rect_00", 9).reshape(3, 3), np.zeros(3))
    left = _projection(path, lines, keys[0])
    beside = pose(np.eye(3), np.array([-left[0, 3] / left[0, 0], 0.0, 0.0]))
    return np.asarray(inverse(reorthonormalise(upright @ to_camera @ to_scanner)) @ beside)


def _motion(path: Path) -> FloatArray:
    """(4, 4) of the lines R: and T:."""
    lines = _lines(path)
    rotation, place = (_numbers(path, lines, key, n) for key, n in (("R", 9), ("T", 3)))
    return pose(rotation.reshape(3, 3), place)


def _baseline(path: Path, left: FloatArray, right: FloatArray, keys: tuple[str, str]) -> float:
    fx, fy = float(right[0, 0]), float(right[1, 1])
    if fx <= 0.0 or fy <= 0.0:
        raise CalibrationError(f"{path}: focal lengths {fx:g}, {fy:g} must be positive")
    baseline = float(left[0, 3] - right[0, 3]) / fx
    if baseline <= 0.0:
        raise CalibrationError(
            f"{path}: the baseline is {baseline:g} m, must be positive; {keys[0]} belongs to the "
            f"left camera (image_0), {keys[1]} to the right one (image_1): are they swapped?"
        )
    return baseline


def _lines(path: Path) -> Mapping[str, tuple[int, list[str]]]:
    """Number and words of each line ``name: words``."""
    found: dict[str, tuple[int, list[str]]] = {}
    for number, text in read_lines(path, CalibrationError):
        name, _, rest = text.partition(":")
        found.setdefault(name.strip(), (number, rest.split()))
    return found


def _projection(path: Path, lines: Mapping[str, tuple[int, list[str]]], key: str) -> FloatArray:
    """Projection matrix (3, 4) of a line such as ``P1: 12 numbers``."""
    return _numbers(path, lines, key, 12).reshape(3, 4)


def _numbers(
    path: Path, lines: Mapping[str, tuple[int, list[str]]], key: str, count: int
) -> FloatArray:
    """(count,) of a line ``key: numbers``."""
    if key not in lines:
        raise CalibrationError(f"{path} has no line {key!r}; restore the file of the data set")
    number, words = lines[key]
    values = _floats(words)
    if len(values) != count or not np.isfinite(values).all():
        raise CalibrationError(
            f"{path}, line {number}: {key} must be {count} finite numbers; restore the file"
        )
    return values


def _stated_size(
    path: Path, lines: Mapping[str, tuple[int, list[str]]], camera: str
) -> Size | None:
    """Width and height by the line S_rect_00 of a camera, if there is one."""
    key = f"S_rect_{camera}"
    if key not in lines:
        return None
    number, words = lines[key]
    values = _floats(words)
    if len(values) != 2 or not np.isfinite(values).all():
        raise CalibrationError(
            f"{path}, line {number}: {key} must be width and height; restore the file"
        )
    return round(values[0]), round(values[1])


def _floats(words: list[str]) -> FloatArray:
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        return np.empty(0)
