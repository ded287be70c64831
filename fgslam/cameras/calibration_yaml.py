"""YAML files of camera calibrations: keys with lists of finite numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError


def read_calibration_yaml(path: Path) -> Mapping[str, Any]:
    """Keys and values of a YAML file. Raises CalibrationError where there are none."""
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


def numbers(path: Path, values: Mapping[str, Any], key: str, count: int) -> FloatArray:
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
