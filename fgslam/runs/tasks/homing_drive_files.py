"""Files of a drive in closed loop: every step, the legs, and the bearings of every homing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.bearing_log import BearingLog
from fgslam.core.homing import HomingTruth
from fgslam.core.planar import between, wrap
from fgslam.homing.command import HomingState
from fgslam.homing.drive_record import DriveRecord, HomingLog, cross_track, pass_distances
from fgslam.homing.path_memory import PathMemory
from fgslam.report.figures.plan import Drive
from fgslam.report.tables import Cell, write_csv
from fgslam.runs.homing_comparison import save_bearing_logs
from fgslam.runs.tasks.homing_drive_pictures import LegView

LEGS_FILE = "legs.csv"
COMMANDS_FILE = "commands.csv"
TRAJECTORY_FILE = "trajectory.csv"
LEG_COLUMNS = (
    "seed",
    "leg",
    "result",
    "began_s",
    "ended_s",
    "initialisations",
    "remaining",
    "pass_distance_m",
    "cross_track_m",
    "reason",
)
_COMMAND_COLUMNS = (
    "seed",
    "time",
    "target",
    "state",
    "heading_deg",
    "sigma_heading_deg",
    "remaining",
    "sigma_remaining",
    "rotation_deg",
    "speed_mps",
    "turn_deg_s",
    "overridden",
    "reason",
)
_TRAJECTORY_COLUMNS = ("seed", "time", "x_m", "y_m", "heading_deg", "target")


def write_legs(folder: Path, records: Sequence[tuple[int, DriveRecord]]) -> None:
    """legs.csv: a row for each leg of each seed. Raises OutputError."""
    rows = (row for seed, record in records for row in _legs(seed, record))
    write_csv(folder / LEGS_FILE, LEG_COLUMNS, rows)


def write_drive(folder: Path, records: Sequence[tuple[int, DriveRecord]]) -> None:
    """commands.csv and trajectory.csv: a row for each step of each seed. Raises OutputError."""
    commands = (row for seed, record in records for row in _commands(seed, record))
    write_csv(folder / COMMANDS_FILE, _COMMAND_COLUMNS, commands)
    poses = (row for seed, record in records for row in _poses(seed, record))
    write_csv(folder / TRAJECTORY_FILE, _TRAJECTORY_COLUMNS, poses)


def write_logs(folder: Path, seed: int, record: DriveRecord) -> None:
    """A bearing log for each homing of a drive, with its truth. Raises OutputError."""
    logs = {
        f"seed_{seed:04d}_leg_{homing.target + 1:02d}_homing_{k:03d}": bearing_log(record, homing)
        for k, homing in enumerate(record.homings)
        if homing.tracks
    }
    save_bearing_logs(folder, logs)


def bearing_log(record: DriveRecord, homing: HomingLog) -> BearingLog:
    """One homing as estimators were given it; true places of its features are not known."""
    start = record.truth[homing.first_step]
    truth = None
    if homing.target < len(record.targets) and np.isfinite(record.targets[homing.target]).all():
        truth = HomingTruth(
            target=between(start, record.targets[homing.target]),
            robots=between(start, record.truth[homing.steps]),
            landmarks=np.full((len(homing.start.local_map), 2), np.nan),
        )
    provenance = {"target": homing.target, "first_step": homing.first_step}
    return BearingLog(homing.start, list(homing.tracks), truth, provenance)


def drive_of(record: DriveRecord, outlines: Sequence[FloatArray] = ()) -> Drive:
    """What the figure of the drive shows; headings are those of the estimator, in the world.

    There is none while the robot stands or drives blind: its command's heading means nothing then.
    """
    known = np.array([state == HomingState.DRIVE.value for state in record.state], np.bool_)
    headings = np.where(known, wrap(record.truth[:, 2] + record.heading), np.nan)
    return Drive(
        record.time, record.truth, record.target, headings, record.targets, tuple(outlines)
    )


def _legs(seed: int, record: DriveRecord) -> Iterator[list[Cell]]:
    passed, across = pass_distances(record), cross_track(record)
    for leg in record.legs:
        known = leg.target < len(passed)
        yield [
            seed,
            leg.target + 1,
            leg.result,
            leg.began,
            leg.ended,
            leg.initialisations,
            leg.remaining,
            float(passed[leg.target]) if known else None,
            float(across[leg.target]) if known else None,
            leg.reason,
        ]


def _commands(seed: int, record: DriveRecord) -> Iterator[list[Cell]]:
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.diagonal(record.covariance, axis1=1, axis2=2))
    for k in range(len(record)):
        yield [
            seed,
            float(record.time[k]),
            int(record.target[k]) + 1,
            record.state[k],
            float(np.rad2deg(record.heading[k])),
            float(np.rad2deg(sigma[k, 1])),
            float(record.remaining[k]),
            float(sigma[k, 0]),
            float(np.rad2deg(record.rotation[k])),
            float(record.speed[k]),
            float(np.rad2deg(record.turn_rate[k])),
            bool(record.overridden[k]),
            record.reason[k],
        ]


def _poses(seed: int, record: DriveRecord) -> Iterator[list[Cell]]:
    for k, (x, y, heading) in enumerate(record.truth.tolist()):
        time, target = float(record.time[k]), int(record.target[k]) + 1
        yield [seed, time, x, y, float(np.rad2deg(heading)), target]


@dataclass(frozen=True, slots=True, eq=False)
class DrivenSeed:
    """One drive.

    Attributes:
        seed: of world and chance.
        record: of the drive.
        memory: the path as it is remembered.
        outlines: of the world.
        leg_m: true length of the first leg as driven: start to target.
        views: what the camera saw at the legs' ends; of the first seed alone.
    """

    seed: int
    record: DriveRecord
    memory: PathMemory
    outlines: tuple[FloatArray, ...]
    leg_m: float
    views: tuple[LegView, ...] = ()
