"""`fgslam compare` on homing runs: the bearings they logged, through other estimators."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.backend.homing.settings import HomingEstimatorSettings
from fgslam.core.bearing_log import BearingLog
from fgslam.evaluation.homing import HomingErrors, homing_errors, summarise_homings
from fgslam.evaluation.metrics import JsonValue, UpdateTime
from fgslam.report.content import TextTable
from fgslam.report.figures.homing import Line, curve_figure, local_map_figure
from fgslam.report.figures.traces import Figure
from fgslam.report.tables import Cell, write_csv
from fgslam.runs.config_models import HomingExperiment
from fgslam.runs.documents import write_document, write_page
from fgslam.runs.engine import Context, RunResult, Status, Task
from fgslam.runs.folder import COMPARISON_FILE
from fgslam.runs.homing_replay import ReplayedHoming, replay_homing
from fgslam.runs.tasks.homing_trial_results import TRIAL_COLUMNS, summary_numbers, trial_row
from fgslam.runs.units import Stage, one_by_one

ESTIMATES_FILE = "estimates.csv"
_LEFT = 0.199
"""Judged where a fifth of the leg is left, as simulated homings end there: nearer to the target its
direction means less and less."""
_ESTIMATE_COLUMNS = (
    "log",
    "estimator",
    "time",
    "distance_legs",
    "direction_deg",
    "rotation_deg",
    "sigma_distance_legs",
    "sigma_direction_deg",
    "sigma_rotation_deg",
    "direction_error_deg",
)


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    logs: dict[str, BearingLog]
    settings: HomingEstimatorSettings


def open_homing_comparison(
    config: HomingExperiment,
    logs: dict[str, BearingLog],
    estimators: Sequence[HomingEstimatorSettings],
    run: Path,
) -> Task[RunResult]:
    """The bearings that a run logged, through estimators."""

    def compared(context: Context) -> RunResult:
        replays = _replay_all([_Task(logs, settings) for settings in estimators], context)
        status: Status = "interrupted" if context.stopped() else "finished"
        return _finish(config, context.folder, status, logs, replays)

    return Task({"run": str(run)}, compared)


def _replay_all(tasks: Sequence[_Task], context: Context) -> dict[str, dict[str, ReplayedHoming]]:
    """By title, then by log; every estimator in a process of its own."""
    stage = Stage(
        name="replays",
        label="replaying",
        count=len(tasks),
        work=_perform_all,
        argument=lambda units: [tasks[k] for k in units],
        kind=dict[str, ReplayedHoming],
        blocks=one_by_one,
    )
    done = context.perform(stage)
    found = dict(done.results)
    for (k,), why in done.ended:
        settings = tasks[k].settings
        ended = ReplayedHoming(settings.title, settings.kind, (), np.empty(0), why)
        found[k] = dict.fromkeys(tasks[k].logs, ended)
    return {task.settings.title: found[k] for k, task in enumerate(tasks)}


def _perform_all(tasks: Sequence[_Task]) -> list[dict[str, ReplayedHoming]]:
    return [_perform(task) for task in tasks]


def _perform(task: _Task) -> dict[str, ReplayedHoming]:
    shown = next(iter(task.logs), None)  # the local map that is drawn is the first log's
    return {
        name: replay_homing(log.start, log.images, task.settings, landmarks=name == shown)
        for name, log in task.logs.items()
    }


# --------------------------------------------------------------------------------------------
# Results


def _finish(
    config: HomingExperiment,
    folder: Path,
    status: Status,
    logs: dict[str, BearingLog],
    replays: dict[str, dict[str, ReplayedHoming]],
) -> RunResult:
    errors = {
        title: {name: _errors(one, logs[name]) for name, one in by_log.items()}
        for title, by_log in replays.items()
    }
    rows, numbers = [], {}
    for title, by_log in replays.items():
        judged = {name: _errors(one, logs[name], _LEFT) for name, one in by_log.items()}
        row, values = _judged(by_log, judged)
        rows.append((title, row))
        numbers[title] = values
    with_truth = sum(log.truth is not None for log in logs.values())
    heading = f"{len(logs)} homings replayed, {with_truth} with ground truth"
    tables = (TextTable("compared", heading, "estimator", TRIAL_COLUMNS, tuple(rows)),)
    result = RunResult(config, folder, status, (f"{heading}.",), tables, tuple(_failures(replays)))
    write_csv(folder / ESTIMATES_FILE, _ESTIMATE_COLUMNS, _estimate_rows(replays, errors))
    columns = ("estimator", *(column.name for column in TRIAL_COLUMNS))
    write_csv(folder / COMPARISON_FILE, columns, [[title, *row] for title, row in rows])
    write_document(result, {"logs": sorted(logs)}, numbers)
    figures = tuple(_figures(logs, replays, errors))
    write_page(result, "bearing logs replayed", figures=figures, series=tuple(replays))
    return result


def _errors(replayed: ReplayedHoming, log: BearingLog, left: float = 0.0) -> HomingErrors | None:
    """Errors of all images up to the last one with so much of the leg left; None without truth."""
    if log.truth is None or not replayed.estimates:
        return None
    robots = log.truth.robots[: len(replayed.estimates)]
    away = np.hypot(*(log.truth.target[:2] - robots[:, :2]).T) / log.truth.leg_m
    far = np.flatnonzero(away >= left)
    count = int(far[-1]) + 1 if len(far) else 1
    seen = dataclasses.replace(log.truth, robots=robots[:count])
    return homing_errors(replayed.estimates[:count], seen)


def _judged(
    by_log: dict[str, ReplayedHoming], errors: dict[str, HomingErrors | None]
) -> tuple[tuple[str, ...], dict[str, JsonValue]]:
    """The estimator's row, and its numbers for metrics.json."""
    failed = sum(bool(one.failure) for one in by_log.values())
    whole = [e for name, e in errors.items() if e is not None and not by_log[name].failure]
    summary = summarise_homings(whole) if whole else None
    times = [one.update_ms for one in by_log.values()]
    time = UpdateTime.of(np.concatenate(times)) if times else UpdateTime()
    kind = next(iter(by_log.values())).kind if by_log else ""
    values: dict[str, JsonValue] = {
        "kind": kind,
        **summary_numbers(summary),
        "update_ms": dataclasses.asdict(time),
        "failures": [f"{name}: {one.failure}" for name, one in by_log.items() if one.failure],
    }
    return trial_row(summary, failed, time), values


def _failures(replays: dict[str, dict[str, ReplayedHoming]]) -> Iterator[str]:
    for title, by_log in replays.items():
        for name, one in by_log.items():
            if one.failure:
                yield f"{title} failed on {name}: {one.failure}"


def _estimate_rows(
    replays: dict[str, dict[str, ReplayedHoming]],
    errors: dict[str, dict[str, HomingErrors | None]],
) -> Iterator[list[Cell]]:
    for title, by_log in replays.items():
        for name, one in by_log.items():
            known = errors[title][name]
            for k, estimate in enumerate(one.estimates):
                home = estimate.home()
                sigma = np.sqrt(np.maximum(np.diagonal(home.covariance), 0.0))
                angles = np.rad2deg([home.direction, home.rotation]).tolist()
                error = None if known is None else float(np.rad2deg(known.direction[k]))
                spread = [float(sigma[0]), *np.rad2deg(sigma[1:]).tolist()]
                yield [name, title, estimate.time, home.distance, *angles, *spread, error]


def _figures(
    logs: dict[str, BearingLog],
    replays: dict[str, dict[str, ReplayedHoming]],
    errors: dict[str, dict[str, HomingErrors | None]],
) -> Iterator[Figure]:
    """Of the first log: each estimator's error over time, and the first one's local map."""
    first = next(iter(logs))
    lines = []
    for i, (title, by_log) in enumerate(replays.items()):
        known, estimates = errors[title][first], by_log[first].estimates
        if known is not None:
            time = np.array([e.time for e in estimates]) - logs[first].start.time
            lines.append(Line(title, i, time, np.abs(np.rad2deg(known.direction))))
    words = (
        "direction-error",
        f"Error of the home direction, {first}",
        "Angle between the estimated and the true direction of the target, image by image.",
    )
    yield curve_figure(words, lines, ("time (s)", "error (degrees)"), y={"rangemode": "tozero"})
    for i, (title, by_log) in enumerate(replays.items()):
        estimates = by_log[first].estimates
        if estimates and np.isfinite(estimates[-1].landmarks).any():
            heading = f"The local map of {title}, {first}"
            yield local_map_figure(estimates, logs[first].truth, f"local-map-{i}", heading)
            return
