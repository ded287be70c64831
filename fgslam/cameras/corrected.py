"""Calibrations with a correction: fgslam's own ``calib.json``, and what a drive found wrong in it.

The correction is that of :mod:`fgslam.core.rig_correction`: displacements of each image's pixels,
which are undone where an image is read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.cameras.calibration import number, read_calibration, read_json_object
from fgslam.cameras.rectification import Rectifier
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import write_text
from fgslam.core.rig_correction import RigCorrection, camera_displacements, term_names
from fgslam.core.sensors import CameraRig

_KEY = "corrections"
_NUMBERS = ("width", "height", "fx", "fy", "cx", "cy")


def write_corrected(path: Path, correction: RigCorrection) -> None:
    """Writes the rig's ``calib.json`` with its correction and standard deviations.

    Raises:
        OutputError: the file cannot be written.
    """
    rig = correction.rig
    values: dict[str, Any] = {name: getattr(rig, name) for name in _NUMBERS}
    values["baseline_m"] = rig.baseline
    if rig.vertical_baseline is not None:
        values["vertical_baseline_m"] = rig.vertical_baseline
    values["bTc"] = rig.bTc.tolist()
    if rig.cylindrical:
        values["view"] = rig.view
    if correction.values.any():
        names = term_names(rig)
        values[_KEY] = dict(zip(names, correction.values.tolist(), strict=True))
        values["correction_sigmas"] = dict(zip(names, correction.sigmas.tolist(), strict=True))
    write_text(path, json.dumps(values, indent=2) + "\n")


def read_own_format(path: Path, three_cameras: bool) -> CameraRig | Rectifier:
    """The rig of a ``calib.json``; with what corrects its images where it has corrections.

    Raises:
        CalibrationError: a value is missing, not finite or impossible.
    """
    rig = read_calibration(path, three_cameras)
    values = read_json_object(path).get(_KEY)
    if values is None:
        return rig
    if not isinstance(values, dict):
        raise CalibrationError(
            f"{path}: {_KEY} must be an object with a number for each term; correct or remove it"
        )
    return rectifier_of(rig, _corrections(path, values, rig))


def _corrections(path: Path, values: Mapping[str, Any], rig: CameraRig) -> FloatArray:
    names = term_names(rig)
    known = {*names, *(name.replace("left.", "top.") for name in names)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise CalibrationError(
            f"{path}: {_KEY} has {unknown[0]!r}, which is no term; known: {', '.join(names)}"
        )
    later = [name for name in names if name.startswith("all.") or name.endswith("_outer")]
    every = {**dict.fromkeys(later, 0.0), **values}  # older files have none of these
    return np.array([number(path, every, name) for name in names])


def rectifier_of(rig: CameraRig, correction: FloatArray) -> Rectifier:
    """What undoes displacements (p,) of the rig's images."""
    column, row = np.meshgrid(np.arange(rig.width, dtype=float), np.arange(rig.height, dtype=float))
    exact = np.stack([column.ravel(), row.ravel()], axis=1)
    maps = []
    for camera in range(rig.cameras):
        seen = exact + camera_displacements(rig, camera, exact) @ correction
        columns, rows = seen.T.reshape(2, rig.height, rig.width).astype(np.float32)
        maps.append((columns, rows))
    return Rectifier(rig, tuple(maps))
