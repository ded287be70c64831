"""Calibrations with a correction: fgslam's own ``calib.json``, and what a drive found wrong in it.

The correction is that of :mod:`fgslam.core.rig_correction`: displacements of each image's pixels,
which are undone where an image is read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.cameras.calibration import number, read_calibration, read_json_object
from fgslam.cameras.formats.own import CORRECTIONS, raw_values, stated_corrections
from fgslam.cameras.raw_cameras import Calibration
from fgslam.cameras.rectification import Rectifier, displaced_grid
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.files import write_text
from fgslam.core.geometry import inverse
from fgslam.core.rig_correction import RigCorrection, term_names
from fgslam.core.sensors import CameraRig

_NUMBERS = ("width", "height", "fx", "fy", "cx", "cy")


def write_corrected(
    path: Path, correction: RigCorrection, rectifier: Rectifier | None = None
) -> None:
    """Writes a ``calib.json`` with what was found wrong in it, and standard deviations.

    Args:
        path: the file.
        correction: found in the rectified images.
        rectifier: what rectified them. The file then is of the raw cameras, and states the view;
            what was corrected before is added.

    Raises:
        OutputError: the file cannot be written.
    """
    rig, found = correction.rig, correction.values
    if rectifier is not None and rectifier.correction is not None:
        found = found + rectifier.correction
    raw = None if rectifier is None else rectifier.calibration
    if rectifier is None or raw is None:
        values = _rectified_values(rig)
    else:
        raw = _moved(raw, rig.bTc @ inverse(rectifier.rig.bTc))
        values = {**raw_values(raw)}
    if found.any():
        names = term_names(rig)
        values[CORRECTIONS] = dict(zip(names, found.tolist(), strict=True))
        values["correction_sigmas"] = dict(zip(names, correction.sigmas.tolist(), strict=True))
    write_text(path, json.dumps(values, indent=2) + "\n")


def _rectified_values(rig: CameraRig) -> dict[str, Any]:
    values: dict[str, Any] = {name: getattr(rig, name) for name in _NUMBERS}
    values["baseline_m"] = rig.baseline
    if rig.vertical_baseline is not None:
        values["vertical_baseline_m"] = rig.vertical_baseline
    values["bTc"] = rig.bTc.tolist()
    return values


def _moved(calibration: Calibration, motion: FloatArray) -> Calibration:
    """The same where it was mounted otherwise on the robot."""
    if np.allclose(motion, np.eye(4), rtol=0.0, atol=1e-12):
        return calibration
    cameras = tuple(replace(c, bTc=motion @ c.bTc) for c in calibration.cameras)
    return replace(calibration, cameras=cameras)


def read_own_format(path: Path, three_cameras: bool) -> CameraRig | Rectifier:
    """The rig of a ``calib.json``; with what corrects its images where it has corrections.

    Raises:
        CalibrationError: a value is missing, not finite or impossible.
    """
    rig = read_calibration(path, three_cameras)
    values = stated_corrections(path, read_json_object(path))
    if values is None:
        return rig
    return rectifier_of(rig, correction_values(str(path), values, rig))


def correction_values(source: str, values: Mapping[str, float], rig: CameraRig) -> FloatArray:
    """(p,) values of a rig's terms by their names.

    Raises:
        CalibrationError: one is no term of the rig, or is missing; ``source`` names the file.
    """
    names = term_names(rig)
    known = {*names, *(name.replace("left.", "top.") for name in names)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise CalibrationError(
            f"{source}: {CORRECTIONS} has {unknown[0]!r}, which is no term; known: "
            f"{', '.join(names)}"
        )
    later = [name for name in names if name.startswith("all.") or name.endswith("_outer")]
    every = {**dict.fromkeys(later, 0.0), **values}  # older files have none of these
    return np.array([number(Path(source), every, name) for name in names])


def rectifier_of(rig: CameraRig, correction: FloatArray) -> Rectifier:
    """What undoes displacements (p,) of the rig's images."""
    maps = []
    for camera in range(rig.cameras):
        seen = displaced_grid(rig, camera, correction)
        columns, rows = seen.T.reshape(2, rig.height, rig.width).astype(np.float32)
        maps.append((columns, rows))
    return Rectifier(rig, tuple(maps), correction=correction)
