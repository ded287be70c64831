"""Middlebury's and ETH3D's ``calib.txt``: a rectified pair, lengths in millimetres."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fgslam.cameras.formats.trees import Values
from fgslam.cameras.raw_cameras import Calibration, RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_lines
from fgslam.core.geometry import pose

_MILLIMETRE = 1e-3


def is_middlebury(text: str) -> bool:
    """Whether a text is a calib.txt with ``cam0=[...]`` and a baseline."""
    return re.search(r"^cam0\s*=\s*\[", text, re.M) is not None and "baseline" in text


def read_middlebury(path: Path) -> Calibration:
    """The pair cam0 (left) and cam1; the body is the left camera.

    The principal points may differ in their columns, by ``doffs``: cameras that look at one place.

    Raises:
        CalibrationError: a value is missing, no number, or impossible.
    """
    found = (text.partition("=") for _, text in read_lines(path, CalibrationError))
    part = Values(path, {key.strip(): re.split(r"[\s;,]+", v.strip(" []")) for key, _, v in found})
    size = round(part.number("width")), round(part.number("height"))
    offset = _MILLIMETRE * part.number("baseline")
    left, right = (_camera(part, name, size, x) for name, x in (("cam0", 0.0), ("cam1", offset)))
    return Calibration(str(path), "Middlebury calib.txt", (left, right), sided=True)


def _camera(part: Values, name: str, size: tuple[int, int], x: float) -> RawCamera:
    matrix: FloatArray = part.matrix(name, 3, 3)
    bTc = pose(np.eye(3), np.array([x, 0.0, 0.0]))
    return checked_camera(RawCamera(*size, matrix, np.zeros(4), bTc, f"{part.path.name}: {name}"))
