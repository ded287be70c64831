"""What follows from drives: arrivals, distances to targets, whether errors build up; figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import between
from fgslam.evaluation.metrics import JsonValue, UpdateTime
from fgslam.homing.drive_record import (
    ARRIVED_M,
    STAGES,
    DriveRecord,
    Slope,
    corners,
    cross_track,
    end_distance,
    pass_distances,
    slope_by_leg,
    truly_arrived,
)
from fgslam.report.content import Column, TextTable
from fgslam.report.figures.homing import Line, curve_figure, local_map_figure
from fgslam.report.figures.plan import PASS_RADIUS_M, catchment_figure, drive_figure
from fgslam.report.figures.traces import Figure
from fgslam.runs.config_models import DrivingConfig
from fgslam.runs.documents import write_document, write_page
from fgslam.runs.engine import RunResult, Status
from fgslam.runs.homing_comparison import replay_homing
from fgslam.runs.tasks.homing_drive_files import (
    DrivenSeed,
    bearing_log,
    drive_of,
    write_drive,
    write_legs,
    write_logs,
)
from fgslam.runs.tasks.homing_drive_pictures import draw_leg_views

MEMORY_FILE = "path_memory.npz"
_UNKNOWN = "-"


def finish_drives(
    config: DrivingConfig,
    folder: Path,
    status: Status,
    driven: Sequence[DrivenSeed],
    failures: Sequence[str],
) -> RunResult:
    """All files, numbers and the page of drives. Raises OutputError."""
    records = [(one.seed, one.record) for one in driven]
    write_legs(folder, records)
    write_drive(folder, records)
    for one in driven[: config.output.logs]:
        write_logs(folder, one.seed, one.record)
    numbers = drive_numbers([record for _, record in records], len(failures))
    if driven:
        numbers["kilobytes_per_image"] = driven[0].memory.save(folder / MEMORY_FILE)
    numbers["seeds"] = [one.seed for one in driven]
    result = RunResult(config, folder, status, _verdict(numbers), _tables(driven), tuple(failures))
    write_document(result, numbers)
    subtitle = f"seeds {config.seed} to {config.seed + config.trials - 1}, {len(driven)} driven"
    if config.trials == 1:
        subtitle = f"one drive, seed {config.seed}"
    pictures = draw_leg_views(folder, driven[0].seed, driven[0].views) if driven else ()
    write_page(result, subtitle, figures=tuple(_figures(config, driven)), pictures=pictures)
    return result


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


def _verdict(numbers: dict[str, JsonValue]) -> tuple[str, ...]:
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


def _tables(driven: Sequence[DrivenSeed]) -> tuple[TextTable, ...]:
    count = max((len(one.record.targets) for one in driven), default=0)
    rows = tuple((f"leg {k + 1}", _row([one.record for one in driven], k)) for k in range(count))
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
# Figures


def _figures(config: DrivingConfig, driven: Sequence[DrivenSeed]) -> Iterator[Figure]:
    if not driven:
        return
    first = driven[0]
    words = f"The drive of seed {first.seed}, from above"
    yield drive_figure(drive_of(first.record, first.outlines), heading=words)
    homing = next((h for h in first.record.homings if h.tracks), None)
    if homing is not None:
        log = bearing_log(first.record, homing)
        replayed = replay_homing(log.start, log.images, config.estimator, landmarks=True)
        heading = f"The local map on the way to target {homing.target + 1}"
        # Averages of bearings have no map to show.
        if replayed.estimates and np.isfinite(replayed.estimates[-1].landmarks).all():
            yield local_map_figure(replayed.estimates, log.truth, heading=heading)
    yield _remaining(driven[: config.output.logs] or driven[:1])
    if config.start_offset_m > 0.0 and len(driven) > 1:
        yield _catchment(driven)


def _remaining(driven: Sequence[DrivenSeed]) -> Figure:
    lines = [
        Line(f"seed {one.seed}", k, one.record.time, one.record.remaining)
        for k, one in enumerate(driven)
    ]
    words = (
        "remaining",
        "Part of the leg that is left",
        "As the robot believes it; each leg begins at 1.",
    )
    return curve_figure(words, lines, ("time (s)", "left (legs)"), y={"rangemode": "tozero"})


def _catchment(driven: Sequence[DrivenSeed]) -> Figure:
    known = [one for one in driven if len(one.record)]
    offsets = [between(one.record.targets[0], one.record.truth[0])[:2] for one in known]
    arrived = np.array([_reached_first(record) for record in _records(known)])
    reasons = [f"seed {one.seed}: {one.record.legs[0].reason}" for one in known if one.record.legs]
    return catchment_figure(np.array(offsets), arrived, reasons)


def _reached_first(record: DriveRecord) -> bool:
    """Whether the first target was reached: by what the robot says, and in truth."""
    said = bool(record.legs) and record.legs[0].result == "arrived"
    return said and bool(pass_distances(record)[0] <= ARRIVED_M)


def _records(driven: Sequence[DrivenSeed]) -> list[DriveRecord]:
    return [one.record for one in driven]
