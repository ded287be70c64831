"""Bearing logs in the run folder: one a homing, which `fgslam compare` replays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fgslam.core.atomic_files import make_subfolder
from fgslam.core.bearing_log import BearingLog
from fgslam.core.errors import DatasetError

LOG_FOLDER = "logs"


def save_bearing_logs(run: Path, logs: Mapping[str, BearingLog]) -> None:
    """Writes logs by their names, each atomically. Raises OutputError."""
    if logs:
        folder = make_subfolder(run, LOG_FOLDER)
        for name, log in logs.items():
            log.save(folder / f"{name}.npz")


def load_bearing_logs(run: Path) -> dict[str, BearingLog]:
    """All logs of a run folder by their names, in order.

    Raises:
        DatasetError: there are none.
        MeasurementLogError: one is damaged.
    """
    files = sorted((run / LOG_FOLDER).glob("*.npz"))
    if not files:
        raise DatasetError(
            f"{run}: has no bearing logs ({LOG_FOLDER}/*.npz) to compare estimators on; run a "
            "homing, path_following or homing_trials experiment with output.logs above 0"
        )
    return {file.stem: BearingLog.load(file) for file in files}
