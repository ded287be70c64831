"""Homing runs through other estimators: the bearings that they logged, replayed and judged."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.backend.homing.settings import HomingEstimatorSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import (
    BearingLog,
    HomingEstimate,
    HomingStart,
    HomingTruth,
    TrackedBearings,
)
from fgslam.core.errors import DatasetError, EstimatorError
from fgslam.core.files import make_subfolder
from fgslam.evaluation.homing import (
    HomingErrors,
    HomingSummary,
    homing_errors,
    summarise_homings,
)
from fgslam.evaluation.statistics import Consistency, JsonValue, UpdateTime
from fgslam.report.content import Cell, Column, Figure, TextTable, write_csv
from fgslam.report.homing_figures import Line, curve_figure, local_map_figure
from fgslam.runs.config import HomingExperiment
from fgslam.runs.engine import Context, RunResult, Status, Task, write_document, write_page
from fgslam.runs.folder import COMPARISON_FILE, digest_of
from fgslam.runs.units import each_apart

ESTIMATES_FILE = "estimates.csv"
LOG_FOLDER = "logs"
NEES_NAMES = ("robot", "target", "joint", "home")
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
    files = _log_files(run)
    if not files:
        raise DatasetError(
            f"{run}: has no bearing logs ({LOG_FOLDER}/*.npz) to compare estimators on; run a "
            "homing, path_following or homing_trials experiment with output.logs above 0"
        )
    return {file.stem: BearingLog.load(file) for file in files}


def _log_files(run: Path) -> list[Path]:
    return sorted((run / LOG_FOLDER).glob("*.npz"))


# --------------------------------------------------------------------------------------------
# One estimator on one log


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedHoming:
    """What one estimator made of one homing.

    Attributes:
        estimates: one after each image.
        update_ms: (k,) processor time of each update, and of the estimate that a robot drives by:
            without covariances of landmarks; milliseconds.
        failure: why it ended early; empty where it did not.
    """

    estimates: tuple[HomingEstimate, ...]
    update_ms: FloatArray
    failure: str = ""

    def judged(self, truth: HomingTruth | None, left: float = 0.0) -> JudgedHoming:
        """Its errors up to the last image with so much of the leg (0 to 1) left."""
        if truth is None or not self.estimates:
            return JudgedHoming(None, self.update_ms, self.failure)
        robots = truth.robots[: len(self.estimates)]
        away = np.hypot(*(truth.target[:2] - robots[:, :2]).T) / truth.leg_m
        far = np.flatnonzero(away >= left)
        count = int(far[-1]) + 1 if len(far) else 1
        seen = dataclasses.replace(truth, robots=robots[:count])
        errors = homing_errors(self.estimates[:count], seen)
        return JudgedHoming(errors, self.update_ms, self.failure)


@dataclass(frozen=True, slots=True, eq=False)
class JudgedHoming:
    """How well one estimator did on one homing.

    Attributes:
        errors: image by image; None where it gave no estimate, or the truth is not known.
        update_ms: (k,) time of each update.
        failure: why it ended early, else empty.
    """

    errors: HomingErrors | None
    update_ms: FloatArray
    failure: str


def replay_homing(
    start: HomingStart,
    tracks: Sequence[TrackedBearings],
    settings: HomingEstimatorSettings,
    landmarks: bool = False,
) -> ReplayedHoming:
    """Runs one estimator over all images; an error ends it, with what it had until then.

    ``landmarks``: their covariances are kept, too; asked for apart from what is timed.
    """
    estimates: list[HomingEstimate] = []
    times: list[float] = []
    failure = ""
    try:
        estimator = make_homing_estimator(start, settings)
        for tracked in tracks:
            began = time.process_time()
            estimator.update(tracked)
            estimate = estimator.estimate(landmarks=False)
            times.append(1e3 * (time.process_time() - began))
            estimates.append(estimator.estimate() if landmarks else estimate)
    except EstimatorError as error:
        failure = f"image {len(estimates)}: {error}"
    return ReplayedHoming(tuple(estimates), np.array(times), failure)


# --------------------------------------------------------------------------------------------
# One estimator on many homings: a row of a table, numbers of metrics.json

ESTIMATOR_COLUMNS = (
    Column("direction deg median", "error of the home direction at the last image, absolute"),
    Column("p95", "95 % of the trials are better"),
    Column("rotation deg median", "error of the target's heading against the robot's"),
    Column("distance legs median", "error of the distance left, 1 being the leg"),
    Column("diverged", "trials whose home direction is off by more than 30 degrees, or failed"),
    Column(
        "NEES robot",
        "normalised error squared of the pose per degree of freedom: 1 is right; ok, high "
        "(overconfident) or low (conservative) by the 95 % chi-square band, which is in "
        "metrics.json",
    ),
    Column("NEES target", "the same of the target"),
    Column("NEES home", "the same of the home vector"),
    Column("update ms", "median time of an update, with the estimate that a robot drives by"),
)
_UNKNOWN = "-"
_IN_A_WORD = {"consistent": "ok", "overconfident": "high", "conservative": "low"}


def finished_errors(homings: Sequence[JudgedHoming]) -> list[HomingErrors]:
    """Of the homings that the estimator finished."""
    return [one.errors for one in homings if one.errors is not None and not one.failure]


def summary_of(homings: Sequence[JudgedHoming]) -> HomingSummary | None:
    """Of the homings that the estimator finished; None where there is none."""
    errors = finished_errors(homings)
    return summarise_homings(errors) if errors else None


def update_time_of(homings: Sequence[JudgedHoming]) -> UpdateTime:
    """Of all updates."""
    times = [one.update_ms for one in homings]
    return UpdateTime.of(np.concatenate(times)) if times else UpdateTime()


def table_row(homings: Sequence[JudgedHoming]) -> tuple[str, ...]:
    """A row under :data:`ESTIMATOR_COLUMNS`."""
    summary, failed = summary_of(homings), sum(bool(one.failure) for one in homings)
    update = _number(update_time_of(homings).median, ".2f")
    if summary is None:
        return (*[_UNKNOWN] * 4, str(failed), *[_UNKNOWN] * 3, update)
    return (
        _number(summary.direction_median_deg, ".2f"),
        _number(summary.direction_p95_deg, ".2f"),
        _number(summary.rotation_median_deg, ".2f"),
        _number(summary.distance_median, ".3f"),
        str(summary.diverged + failed),
        _judged(summary.robot),
        _judged(summary.target),
        _judged(summary.home),
        update,
    )


def summary_numbers(homings: Sequence[JudgedHoming]) -> dict[str, JsonValue]:
    """The names of a summary in metrics.json."""
    summary = summary_of(homings)
    if summary is None:
        return {"trials": 0}
    values: dict[str, JsonValue] = {
        name: getattr(summary, name) for name in HomingSummary.__slots__ if name not in NEES_NAMES
    }
    for name in NEES_NAMES:
        judged = getattr(summary, name)
        values[f"nees_{name}_per_dof"] = None if judged is None else judged.per_dof
        values[f"nees_{name}"] = None if judged is None else asdict(judged)
    return values


def _number(value: float | None, spec: str) -> str:
    return _UNKNOWN if value is None or not np.isfinite(value) else format(value, spec)


def _judged(found: Consistency | None) -> str:
    return _UNKNOWN if found is None else f"{found.per_dof:.3g} {_IN_A_WORD[found.verdict]}".strip()


# --------------------------------------------------------------------------------------------
# fgslam compare

Replays = dict[str, dict[str, ReplayedHoming]]
"""By title of the estimator, then by name of the log."""


@dataclass(frozen=True, slots=True, eq=False)
class ReplayTask:
    """What one process is to do: all logs through one estimator."""

    logs: dict[str, BearingLog]
    settings: HomingEstimatorSettings


def open_homing_comparison(
    config: HomingExperiment, run: Path, estimators: Sequence[HomingEstimatorSettings]
) -> Task[RunResult]:
    """The bearings that a run logged, through estimators.

    Raises:
        FgslamError: the run has no bearing logs, or one is damaged.
    """
    logs = load_bearing_logs(run)

    def compared(context: Context) -> RunResult:
        replays = _replay_apart(logs, estimators, context)
        status: Status = "interrupted" if context.stopped() else "finished"
        kinds = {settings.title: settings.kind for settings in estimators}
        return _finish(config, context.folder, status, logs, replays, kinds)

    log = digest_of(_log_files(run))
    return Task({"run": str(run), "log": log}, compared)


def _replay_apart(
    logs: dict[str, BearingLog], estimators: Sequence[HomingEstimatorSettings], context: Context
) -> Replays:
    """Every estimator in a process of its own."""
    tasks = [ReplayTask(logs, settings) for settings in estimators]
    stage = each_apart(("replays", "replaying"), perform, tasks, dict[str, ReplayedHoming])
    found = context.perform(stage).all(
        lambda k, why: dict.fromkeys(logs, ReplayedHoming((), np.empty(0), why))
    )
    return {settings.title: one for settings, one in zip(estimators, found, strict=True)}


def perform(task: ReplayTask) -> dict[str, ReplayedHoming]:
    """One estimator on each log, by the log's name."""
    shown = next(iter(task.logs), None)  # the local map that is drawn is the first log's
    return {
        name: replay_homing(log.start, log.images, task.settings, landmarks=name == shown)
        for name, log in task.logs.items()
    }


def _finish(
    config: HomingExperiment,
    folder: Path,
    status: Status,
    logs: dict[str, BearingLog],
    replays: Replays,
    kinds: Mapping[str, str],
) -> RunResult:
    rows, numbers = [], {}
    for title, by_log in replays.items():
        judged = [one.judged(logs[name].truth, _LEFT) for name, one in by_log.items()]
        rows.append((title, table_row(judged)))
        numbers[title] = {
            "kind": kinds[title],
            **summary_numbers(judged),
            "update_ms": asdict(update_time_of(judged)),
            "failures": [f"{name}: {one.failure}" for name, one in by_log.items() if one.failure],
        }
    with_truth = sum(log.truth is not None for log in logs.values())
    heading = f"{len(logs)} homings replayed, {with_truth} with ground truth"
    tables = (TextTable("compared", heading, "estimator", ESTIMATOR_COLUMNS, tuple(rows)),)
    answers = [one for by_log in replays.values() for one in by_log.values()]
    result = RunResult(
        config,
        folder,
        status,
        (f"{heading}.",),
        tables,
        tuple(_failures(replays)),
        failed=all(one.failure for one in answers),
    )
    errors = {
        title: {name: one.judged(logs[name].truth).errors for name, one in by_log.items()}
        for title, by_log in replays.items()
    }
    write_csv(folder / ESTIMATES_FILE, _ESTIMATE_COLUMNS, _estimate_rows(replays, errors))
    columns = ("estimator", *(column.name for column in ESTIMATOR_COLUMNS))
    write_csv(folder / COMPARISON_FILE, columns, [[title, *row] for title, row in rows])
    write_document(result, {"logs": sorted(logs)}, numbers)
    figures = tuple(_figures(logs, replays, errors))
    write_page(result, "bearing logs replayed", figures=figures)
    return result


def _failures(replays: Replays) -> Iterator[str]:
    for title, by_log in replays.items():
        for name, one in by_log.items():
            if one.failure:
                yield f"{title} failed on {name}: {one.failure}"


def _estimate_rows(
    replays: Replays, errors: dict[str, dict[str, HomingErrors | None]]
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
    replays: Replays,
    errors: dict[str, dict[str, HomingErrors | None]],
) -> Iterator[Figure]:
    """Of the first log: each estimator's error over time, and the first one's local map."""
    first = next(iter(logs))
    lines = []
    for i, (title, by_log) in enumerate(replays.items()):
        known, estimates = errors[title][first], by_log[first].estimates
        if known is not None:
            seconds = np.array([e.time for e in estimates]) - logs[first].start.time
            lines.append(Line(title, i, seconds, np.abs(np.rad2deg(known.direction))))
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
