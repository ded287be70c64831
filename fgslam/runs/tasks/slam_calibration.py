"""What a run says of its rig's calibration: calibration.csv, numbers, one sentence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fgslam.backend.self_calibration import SelfCalibration
from fgslam.cameras.rectify import Rectifier
from fgslam.cameras.rig import write_corrected
from fgslam.core.errors import ConfigError, OutputError
from fgslam.core.files import read_text, write_text
from fgslam.core.rig_correction import IMPLAUSIBLE_PX, RigCorrection, term_names
from fgslam.datasets.settings import MeasurementDatasetSettings
from fgslam.evaluation.statistics import JsonValue
from fgslam.report.content import write_csv
from fgslam.runs.config_models import Experiment, ExperimentConfig
from fgslam.runs.folder import CALIBRATION_FILE, CAMERA_FILE
from fgslam.slam.factory import calibrates_itself

_TOLD_SIGMAS = 3.0  # what is less than this many of its own is not told as a finding
_TOLD_FIELD_PX = 0.1  # of a field that is told: recordings of good rigs show up to so much
_DOUBT = (
    ", more than calibrations leave: calibrate it anew, unless something large that moved was "
    "taken for the scene"
)
_UNITS = {"deg": "degrees", "percent": "%"}
_WORDS = {
    "yaw_deg": "turned by {} in yaw",
    "pitch_deg": "turned by {} in pitch",
    "roll_deg": "turned by {} in roll",
    "focal_percent": "longer by {} in focal length",
}


def write_calibration(
    folder: Path, calibration: SelfCalibration, rectifier: Rectifier | None
) -> None:
    """camera.json and calibration.csv: the cameras, corrected, and what each window knew.

    ``rectifier`` is what rectified the images; the file then is of the raw cameras. Raises
    OutputError.
    """
    write_corrected(folder / CAMERA_FILE, calibration.found.best, rectifier)
    known = calibration.found.estimated
    terms = term_names(known.rig)
    changes = list(known.changes())
    columns = ["timestamp", "knocks"]
    columns += [f"{name}{part}" for name in changes for part in ("", "_sigma")]
    columns += [f"{name}{part}" for name in terms for part in ("", "_sigma", "_applied")]
    rows: list[list[str | int | float]] = []
    for step in calibration.steps:
        then = replace(known, values=step.values, covariance=step.covariance)
        of_terms = np.column_stack([step.values, then.sigmas, step.applied])
        pairs = [number for pair in then.changes().values() for number in pair]
        stamp = f"{step.timestamp:.9f}"  # of an epoch has more digits than a table's numbers
        rows.append([stamp, step.knocks, *pairs, *of_terms.ravel().tolist()])
    write_csv(folder / CALIBRATION_FILE, columns, rows)


def calibration_numbers(calibration: SelfCalibration) -> dict[str, JsonValue]:
    """The rig's part of metrics.json."""
    found = calibration.found
    known = found.estimated
    changes: dict[str, JsonValue] = {
        name: {"value": value, "sigma": sigma} for name, (value, sigma) in known.changes().items()
    }
    terms: dict[str, JsonValue] = {
        name: {"value": float(value), "sigma": float(sigma), "applied": float(applied)}
        for name, value, sigma, applied in zip(
            term_names(known.rig), known.values, known.sigmas, found.applied.values, strict=True
        )
    }
    return {
        "windows": calibration.windows,
        "knocks": calibration.knocks,
        "probability_exact": found.probabilities["exact"],
        "chi_square": known.significance(),
        "degrees_of_freedom": len(known.values),
        "displacement_rms_px": found.applied.rms_px(),
        "field_px": calibration.field_px,
        "changes": changes,
        "terms": terms,
    }


def calibration_note(calibration: SelfCalibration | None, knocked: bool = False) -> str:
    """What the drive showed of the calibration, in a sentence; empty where it showed nothing.

    ``knocked``: a turned camera is reported; then no calibration holds for the whole drive.
    """
    if calibration is None or not calibration.windows:
        return ""
    found = calibration.found
    knocks = f"; the rig moved {calibration.knocks} times on the way" * bool(calibration.knocks)
    if found.probabilities["exact"] > 0.5:
        if knocked:
            return ""
        return f"the drive agrees with the rig's calibration{knocks}{_field(calibration)}"
    parts = [text for camera in ("left", "top") if (text := _told(found.estimated, camera))]
    rms = found.applied.rms_px()
    what = "; ".join(parts) or "the cameras' lenses or axes differ"
    return (
        f"{what} against the rig's calibration, corrected during the drive by {rms:.2f} px "
        f"(rms over the images){_DOUBT * (rms > IMPLAUSIBLE_PX)}{knocks}{_field(calibration)}"
    )


def _field(calibration: SelfCalibration) -> str:
    """What no term of a correction follows, where that is more than usual."""
    px = calibration.field_px
    left = f"; {px:.2f} px (rms) of distortion in each image that no correction describes are left"
    return left * (px >= _TOLD_FIELD_PX)


def _told(known: RigCorrection, camera: str) -> str:
    """One camera's changes that stand out of their uncertainty, the surest first."""
    changes = {
        name.removeprefix(f"{camera}_"): pair
        for name, pair in known.changes().items()
        if name.startswith(camera)
    }
    sure = sorted(changes, key=lambda name: -abs(changes[name][0]) / changes[name][1])
    told = []
    for name in sure:
        value, sigma = changes[name]
        if abs(value) >= _TOLD_SIGMAS * sigma:
            unit = _UNITS[name.rsplit("_", 1)[1]]
            size = f"{value:.3f} {unit}"
            told.append(f"{_WORDS[name].format(size)} ({abs(value) / sigma:.0f} sigma)")
    return f"the {camera} camera is {', '.join(told)}" if told else ""


def require_self_calibration(config: Experiment) -> None:
    """Refuses, before a run, to write the calibration that it will not find. Raises ConfigError."""
    slam = config if isinstance(config, ExperimentConfig) else None
    measured = slam is not None and isinstance(slam.dataset, MeasurementDatasetSettings)
    if slam is None or measured or not calibrates_itself(slam.frontend):
        raise ConfigError(
            "--camera-out: this run takes its cameras as calibrated; it needs SLAM on images with "
            "frontend.self_calibration true and stereo.measurement fused"
        )


def corrected_camera(run: Path, path: Path) -> str:
    """Copies the run's corrected calibration to ``path``; a line about it. Raises OutputError."""
    text = read_text(run / CAMERA_FILE, OutputError)
    write_text(path, text)
    return f"camera      {path}: the calibration, corrected; use it by --camera {path}"
