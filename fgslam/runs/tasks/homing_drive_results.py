"""What follows from drives: arrivals, distances to targets, whether errors build up; files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.bearing_log import BearingLog
from fgslam.core.homing import HomingTruth
from fgslam.core.planar import between, wrap
from fgslam.evaluation.statistics import JsonValue, UpdateTime
from fgslam.homing.closed_loop import (
    ARRIVED_M,
    STAGES,
    DriveRecord,
    HomingLog,
    Slope,
    corners,
    cross_track,
    end_distance,
    pass_distances,
    slope_by_leg,
    truly_arrived,
)
from fgslam.homing.steering import HomingState
from fgslam.report.content import Cell, Column, TextTable, write_csv
from fgslam.report.homing_figures import PASS_RADIUS_M, Drive
from fgslam.runs.homing_comparison import save_bearing_logs

_UNKNOWN = "-"


def drive_numbers(records: Sequence[DriveRecord], failed: int = 0) -> dict[str, JsonValue]:
    """Metrics over drives; null where nothing is known.

    Args:
        records: of the drives that left one.
        failed: drives that broke down; they did not arrive, and passed no target.
    """
    passed = [pass_distances(record) for record in records]
    across = [cross_track(record) for record in records]
    reached = _finite(passed)
    results = [leg.result for record in records for leg in record.legs]
    arrived = sum(truly_arrived(record) for record in records)
    claimed = sum(record.arrived for record in records)
    ends = _finite([np.array([end_distance(r)]) for r in records if r.arrived])
    targets = _known(passed) + failed * max((len(p) for p in passed), default=0)
    return {
        "drives": len(records) + failed,
        "failed": failed,
        "arrived": arrived,
        "arrival_rate": arrived / (len(records) + failed) if records or failed else None,
        "false_arrivals": claimed - arrived,
        "end_distance_median_m": _median(ends),
        "end_distance_max_m": float(ends.max()) if len(ends) else None,
        "legs": {name: results.count(name) for name in dict.fromkeys(results)},
        "initialisations_median": _median([leg.initialisations for r in records for leg in r.legs]),
        "pass_distance_median_m": _median(reached),
        "pass_distance_max_m": float(reached.max()) if len(reached) else None,
        "passed_within_0_2_m": float(np.count_nonzero(reached <= PASS_RADIUS_M)) / targets
        if targets
        else None,
        "targets": targets,
        "targets_aimed_at": len(reached),
        # At the last target the robot stops where the switch fraction is left, by design.
        "pass_distance_slope": _slope([distances[:-1] for distances in passed]),
        "cross_track_median_m": _median(_finite(across)),
        "cross_track_slope": _slope(across),
        "cross_track_slope_beside_corners": _slope(across, [corners(r) for r in records]),
        "duration_median_s": _median([float(r.time[-1] - r.time[0]) for r in records if len(r)]),
        "overridden": float(np.mean(np.concatenate([r.overridden for r in records])))
        if records
        else None,
        "stage_ms": _stages(records),
    }


def _finite(values: Sequence[FloatArray]) -> FloatArray:
    every: FloatArray = np.concatenate([np.empty(0), *values])
    return np.asarray(every[np.isfinite(every)])


def _known(passed: Sequence[FloatArray]) -> int:
    """Targets whose place is known, aimed at or not."""
    return sum(int(np.count_nonzero(~np.isnan(distances))) for distances in passed)


def _slope(
    values: Sequence[FloatArray], known: Sequence[FloatArray] | None = None
) -> dict[str, JsonValue]:
    """Growth of values, one array a drive and one value a leg, with the leg's number."""
    legs = np.concatenate([np.empty(0, np.int64), *(np.arange(len(v)) + 1 for v in values)])
    beside = None if known is None else np.concatenate([np.empty(0), *known])
    slope = slope_by_leg(legs, np.concatenate([np.empty(0), *values]), beside)
    return {**asdict(slope), "flat": _flat(slope)}


def _median(values: Sequence[float] | FloatArray) -> float | None:
    return float(np.median(values)) if len(values) else None


def _flat(slope: Slope) -> bool | None:
    return slope.flat if np.isfinite(slope.value) else None


def _stages(records: Sequence[DriveRecord]) -> dict[str, JsonValue]:
    return {
        name: asdict(UpdateTime.of(1e3 * np.concatenate([r.seconds[name] for r in records])))
        if records
        else None
        for name in STAGES
    }


def drive_sentences(numbers: dict[str, JsonValue]) -> tuple[str, ...]:
    """What the numbers of :func:`drive_numbers` say, in sentences."""
    lines = [
        f"{numbers['arrived']} of {numbers['drives']} drives arrive at the last target (within "
        f"{ARRIVED_M:g} m)."
    ]
    if numbers["false_arrivals"]:
        lines.append(f"{numbers['false_arrivals']} more claim an arrival and stand farther away.")
    median, largest = numbers["pass_distance_median_m"], numbers["pass_distance_max_m"]
    if isinstance(median, float) and isinstance(largest, float):
        lines.append(
            f"Targets are passed at {100.0 * median:.0f} cm (median), at most "
            f"{100.0 * largest:.0f} cm."
        )
    slope = numbers["cross_track_slope"]
    if isinstance(slope, dict) and slope["flat"] is not None:
        # An interval that holds zero may be wide, too: no proof that nothing grows.
        within = "within" if slope["flat"] else "outside"
        lines.append(
            f"The error across the way changes by {100.0 * slope['value']:.2f} cm a leg; zero lies "
            f"{within} its 95 % interval [{100.0 * slope['low']:.2f}, {100.0 * slope['high']:.2f}]."
        )
    return tuple(lines)


_COLUMNS = (
    Column(
        "arrived",
        "drives that counted this target as reached, by what they saw, of those that aimed at it",
    ),
    Column("pass distance cm median", "nearest to the place of the target's image"),
    Column("max", "the worst drive"),
    Column("across the way cm", "root mean square distance from the leg's straight line, median"),
    Column("initialisations", "mean number of times that the target was matched"),
)


def leg_tables(records: Sequence[DriveRecord]) -> tuple[TextTable, ...]:
    """A table with a row for each leg of the path; none without drives."""
    count = max((len(record.targets) for record in records), default=0)
    rows = tuple((f"leg {k + 1}", _row(records, k)) for k in range(count))
    return (TextTable("legs", "The legs", "leg", _COLUMNS, rows),) if rows else ()


def _row(records: Sequence[DriveRecord], k: int) -> tuple[str, ...]:
    legs = [leg for record in records for leg in record.legs if leg.target == k]
    passed = _finite([pass_distances(record)[k : k + 1] for record in records])
    across = _finite([cross_track(record)[k : k + 1] for record in records])
    arrived = sum(leg.result == "arrived" for leg in legs)
    times = [leg.initialisations for leg in legs]
    return (
        f"{arrived} of {len(legs)}",
        f"{100.0 * np.median(passed):.1f}" if len(passed) else _UNKNOWN,
        f"{100.0 * passed.max():.1f}" if len(passed) else _UNKNOWN,
        f"{100.0 * np.median(across):.1f}" if len(across) else _UNKNOWN,
        f"{np.mean(times):.1f}" if times else _UNKNOWN,
    )


# --------------------------------------------------------------------------------------------
# Files


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
