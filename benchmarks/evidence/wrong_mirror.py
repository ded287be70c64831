"""Homing in closed loop with a mirror that is not the calibrated one: whether robots still arrive.

One leg of 2 m in the rendered house; the errors are those of `dataset.calibration`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.runs import EXPERIMENTS, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import between, wrap
from fgslam.homing.closed_loop import DriveRecord, HomingLog, pass_distances, truly_arrived
from fgslam.runs.config import DrivingConfig, as_task, load_experiment
from fgslam.runs.tasks.homing_drives import perform_drive

ERRORS = (
    (0.0, 0.0),
    (0.01, 0.0),
    (0.02, 0.0),
    (0.05, 0.0),
    (0.0, 1.0),
    (0.0, 2.0),
    (0.0, 4.0),
    (0.05, 4.0),
    (0.08, 10.0),
)
"""Of the mirror's parameters, relative, and of its centre in pixels."""

_COLUMNS = (
    "mirror off by", "centre off by px", "arrive", "false arrivals",
    "passed at cm, median", "largest", "first homing vector deg, median", "within 2 sigma %",
    "heading while driving deg, median", "heading within 2 sigma %",
)  # fmt: skip


def tables(
    errors: Iterable[tuple[float, float]] = ERRORS, seeds: Sequence[int] = range(20)
) -> list[Table]:
    """One row an error, over drives that share seeds: the same legs, other calibrations."""
    rows = [_row(mirror, centre, seeds) for mirror, centre in errors]
    return [Table(f"Wrong mirror, {len(seeds)} drives of 2 m", _COLUMNS, rows)]


@dataclass(frozen=True)
class _Judged:
    """Errors of direction (n,) in radians, and those over their standard deviations."""

    errors: FloatArray
    scaled: FloatArray

    @property
    def cells(self) -> tuple[Cell, Cell]:
        """Median in degrees, share within two sigma in percent."""
        if not len(self.errors):
            return None, None
        within = 100.0 * float(np.mean(np.abs(self.scaled) <= 2.0))
        return float(np.rad2deg(np.median(np.abs(self.errors)))), within


def _row(mirror: float, centre: float, seeds: Sequence[int]) -> tuple[Cell, ...]:
    say(f"driving with a mirror {100 * mirror:g} % and its centre {centre:g} px off")
    drives = [_drive(mirror, centre, seed) for seed in seeds]
    arrived = sum(truly_arrived(drive) for drive in drives)
    passed = 100.0 * np.concatenate([pass_distances(drive) for drive in drives])
    return (
        f"{100 * mirror:g} %",
        centre,
        f"{arrived} of {len(drives)}",
        sum(drive.arrived for drive in drives) - arrived,
        float(np.median(passed)),
        float(passed.max()),
        *_starts(drives).cells,
        *_headings(drives).cells,
    )


def _drive(mirror: float, centre: float, seed: int) -> DriveRecord:
    off = (f"dataset.calibration.mirror={mirror}", f"dataset.calibration.centre_px={centre}")
    short = ("dataset.path.legs=1", "output.pictures=0")
    path = EXPERIMENTS / "homing_lab.yaml"
    config = as_task(DrivingConfig, load_experiment(path, (*off, *short)), str(path))
    return perform_drive(config, seed).record


def _starts(drives: Sequence[DriveRecord]) -> _Judged:
    """The homing vector that each drive began with."""
    begun = [(drive, drive.homings[0]) for drive in drives if drive.homings]
    errors = np.array([_start_error(drive, homing) for drive, homing in begun])
    sigmas = np.array([np.sqrt(homing.start.vector.covariance[0, 0]) for _, homing in begun])
    return _Judged(errors, errors / sigmas)


def _start_error(drive: DriveRecord, homing: HomingLog) -> float:
    home = between(drive.truth[homing.first_step], drive.targets[homing.target])
    truth = np.arctan2(home[1], home[0])
    return float(wrap(np.array(homing.start.vector.direction - truth)))


def _headings(drives: Sequence[DriveRecord]) -> _Judged:
    """The headings that were driven by, more than half a metre from the target."""
    found = [_driven(drive) for drive in drives]
    return _Judged(*np.concatenate([np.empty((2, 0)), *found], axis=1))


def _driven(drive: DriveRecord) -> FloatArray:
    """(2, n) errors, and errors over sigma."""
    away = drive.targets[drive.target, :2] - drive.truth[:, :2]
    truth = np.arctan2(away[:, 1], away[:, 0]) - drive.truth[:, 2]
    known = (np.hypot(*away.T) > 0.5) & np.isfinite(drive.covariance[:, 1, 1])
    error = wrap(drive.heading - truth)[known]
    return np.asarray([error, error / np.sqrt(drive.covariance[known, 1, 1])])
