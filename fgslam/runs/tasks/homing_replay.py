"""Homing estimators on the same bearings: task `homing_trials`, and `fgslam compare` of any run.

Trials simulate many homings, each with its own noise; a comparison replays the logs of a run.
Units: trials, or estimators. Files: trials.csv and trials_timing.csv, or estimates.csv and
comparison.csv.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.backend.settings import HomingEstimatorSettings
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.bearings import (
    BearingLog,
    BearingMatches,
    HomingEstimate,
    HomingStart,
    HomingTruth,
    Refusal,
    TrackedBearings,
)
from fgslam.core.errors import DatasetError, EstimatorError
from fgslam.core.files import make_subfolder
from fgslam.datasets.opening import open_simulated_homing
from fgslam.evaluation.homing import NEES_NAMES, HomingErrors, homing_errors, summarise_homings
from fgslam.evaluation.statistics import JsonValue, spread
from fgslam.frontend.homing.two_view import make_local_map
from fgslam.frontend.homing.vector import estimate_homing_vector
from fgslam.frontend.settings import HomingVectorSettings
from fgslam.report.content import Cell, Figure, TextTable, write_csv
from fgslam.report.homing_figures import Line, curve_figure, local_map_figure, sorted_errors
from fgslam.runs.config import HomingExperiment, HomingTrialsConfig
from fgslam.runs.engine import Context, Opening, RunResult, Task
from fgslam.runs.folder import COMPARISON_FILE, TIMING_FILE, TRIALS_FILE, digest_of
from fgslam.runs.results import finish, metrics_table

LOG_FOLDER = "logs"
ESTIMATES_FILE = "estimates.csv"
TRIALS_A_BLOCK = 20  # trials a process: starting one takes as long as some trials
# Judged where a fifth of the leg is left, as simulated homings end there: nearer to the target its
# direction means less and less.
_LEFT = 0.199

# --------------------------------------------------------------------------------------------
# One estimator on one homing


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
        truth = dataclasses.replace(truth, robots=robots[:count])
        errors = homing_errors(self.estimates[:count], truth)
        return JudgedHoming(errors, self.update_ms, self.failure)


def replay_homing(
    start: HomingStart,
    tracks: Sequence[TrackedBearings],
    settings: HomingEstimatorSettings,
    landmarks: bool = False,
) -> ReplayedHoming:
    """Runs one estimator over all images; an error ends it, with what it had until then.

    ``landmarks``: their covariances are kept, too; computed apart from what is timed.
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
# One estimator on many homings: numbers of metrics.json, a row of a table

# Heading, key of the number, its format, meaning.
_COLUMNS = (
    ("direction deg median", "direction_median_deg", ".2f",
     "error of the home direction at the last image, absolute"),
    ("p95", "direction_p95_deg", ".2f", "95 % of the trials are better"),
    ("rotation deg median", "rotation_median_deg", ".2f",
     "error of the target's heading against the robot's"),
    ("distance legs median", "distance_median", ".3f",
     "error of the distance left, 1 being the leg"),
    ("diverged", "diverged", "", "trials whose home direction is off by more than 30 degrees, or "
     "failed"),
    ("NEES robot", "nees_robot", "", "normalised error squared of the pose per degree of "
     "freedom: 1 is right; ok, high (overconfident) or low (conservative) by the 95 % chi-square "
     "band, which is in metrics.json"),
    ("NEES target", "nees_target", "", "the same of the target"),
    ("NEES home", "nees_home", "", "the same of the home vector"),
    ("update ms", "update_ms", ".2f",
     "median time of an update, with the estimate that a robot drives by"),
)  # fmt: skip
_IN_A_WORD = {"consistent": "ok", "overconfident": "high", "conservative": "low"}


def _finished(homings: Iterable[JudgedHoming]) -> list[HomingErrors]:
    return [one.errors for one in homings if one.errors is not None and not one.failure]


def _update_times(homings: Iterable[JudgedHoming]) -> dict[str, float | None]:
    return spread(np.concatenate([np.empty(0), *(one.update_ms for one in homings)]))


def _summary_numbers(homings: Iterable[JudgedHoming]) -> dict[str, Any]:
    """Numbers of metrics.json: of the homings that the estimator finished."""
    errors = _finished(homings)
    return summarise_homings(errors) if errors else {"trials": 0}


def _estimator_numbers(
    settings: HomingEstimatorSettings,
    summary: Mapping[str, JsonValue],
    homings: Mapping[str, JudgedHoming],
) -> JsonValue:
    """What metrics.json knows of an estimator, given its homings by name."""
    return {
        "kind": settings.kind,
        **summary,
        "update_ms": _update_times(homings.values()),
        "failures": [f"{name}: {one.failure}" for name, one in homings.items() if one.failure],
    }


def _estimator_table(
    key: str, heading: str, homings: Mapping[str, Sequence[JudgedHoming]]
) -> TextTable:
    """A row for each estimator, given what it made of each homing."""
    rows = {}
    for title, judged in homings.items():
        numbers = rows[title] = _summary_numbers(judged)
        failed = sum(bool(one.failure) for one in judged)
        numbers["diverged"] = numbers.get("diverged", 0) + failed
        numbers["update_ms"] = _update_times(judged)["median"]
        for name in NEES_NAMES:
            if (nees := numbers.get(f"nees_{name}")) is not None:
                verdict = _IN_A_WORD[nees["verdict"]]
                numbers[f"nees_{name}"] = f"{nees['per_dof']:.3g} {verdict}"
    return metrics_table(key, heading, "estimator", _COLUMNS, rows)


# ------------------------------------------------------------------------------------------
# Task `homing_trials`: simulated homings of bearings, many estimators on the same ones


@dataclass(frozen=True, slots=True, eq=False)
class HomingTrial:
    """One simulated homing.

    Attributes:
        share: part of outliers.
        trial: its number.
        refused: why there was no homing vector; empty where there was one.
        inliers, wrong_inliers: matches that support the vector; wrong ones among them.
        tried: by title of the estimator.
        log: of the bearings, where it is to be kept.
    """

    share: float
    trial: int
    refused: str
    inliers: int
    wrong_inliers: int
    tried: dict[str, JudgedHoming]
    log: BearingLog | None = None


def open_trials(config: HomingTrialsConfig, opening: Opening) -> Task[RunResult]:
    """Simulated homings need no data."""
    return Task({"dataset": {"name": "simulated bearings"}}, partial(_run_trials, config))


def _run_trials(config: HomingTrialsConfig, context: Context) -> RunResult:
    """Runs all trials; stopped early, those finished count."""
    folder, titles = context.folder, [settings.title for settings in config.estimators]
    units = [  # those of one block are of one share, and the shares take turns
        (share, trial)
        for first in range(0, config.trials, TRIALS_A_BLOCK)
        for share in range(len(config.outliers))
        for trial in range(first, min(first + TRIALS_A_BLOCK, config.trials))
    ]
    work = partial(perform_trial, config)
    done = context.perform(("trials", "trials"), work, units, HomingTrial, TRIALS_A_BLOCK)
    trials = sorted(done.results.values(), key=lambda trial: (trial.share, trial.trial))
    failures = sorted(
        f"{len(block)} trials, from trial {units[block[0]][1]} of share {units[block[0]][0]} on: "
        f"{why}"
        for block, why in done.ended
    )
    logs = {
        f"outliers_{100.0 * trial.share:02.0f}_trial_{trial.trial:04d}": trial.log
        for trial in trials
        if trial.log is not None
    }
    save_bearing_logs(folder, logs)
    write_csv(folder / TRIALS_FILE, _TRIAL_COLUMNS, _trial_rows(trials))
    times = (
        (one.share, one.trial, title, *spread(judged.update_ms).values())
        for one in trials
        for title, judged in one.tried.items()
    )
    names = ("outliers", "trial", "estimator", "median_ms", "p95_ms", "max_ms")
    write_csv(folder / TIMING_FILE, names, times)
    groups = {share: [one for one in trials if one.share == share] for share in config.outliers}
    homings = {  # of each estimator, by share
        title: {s: [t.tried[title] for t in g if t.tried] for s, g in groups.items()}
        for title in titles
    }
    tables = tuple(
        _estimator_table(
            f"share-{100.0 * share:.0f}",
            f"{100.0 * share:.0f} % outliers, {len(group)} trials"
            + (f", {refused} of them refused" if (refused := _refused(group)) else ""),
            {title: homings[title][share] for title in titles},
        )
        for share, group in groups.items()
        if group
    )
    numbers: dict[str, JsonValue] = {
        "trials": config.trials,
        "outliers": list(config.outliers),
        "trials_done": {f"{share:g}": len(group) for share, group in groups.items()},
        "refused": {f"{share:g}": _refused(group) for share, group in groups.items()},
    }
    estimators: dict[str, JsonValue] = {}
    for settings in config.estimators:
        title = settings.title
        judged = {
            f"outliers {one.share:g}, trial {one.trial}": one.tried[title]
            for one in trials
            if one.tried
        }
        shares = {f"{share:g}": _summary_numbers(of) for share, of in homings[title].items()}
        estimators[title] = _estimator_numbers(settings, {"outliers": shares}, judged)
    return finish(
        config,
        folder,
        len(trials) == len(units),
        numbers,
        f"{len(trials)} simulated homings of bearings alone, seed {config.seed}",
        tuple(_trial_figures(homings, config.outliers)),
        estimators=estimators,
        lines=tuple(_best(homings, config.outliers)) or ("No trial gave a result.",),
        tables=tables,
        notes=tuple(failures),
    )


def perform_trial(config: HomingTrialsConfig, unit: tuple[int, int]) -> HomingTrial:
    """One trial; its noise depends on the seed, the share's number and its own number alone."""
    share, trial = unit
    rng = np.random.default_rng((config.seed, share, trial))
    part = config.outliers[share]
    simulated = open_simulated_homing(config.dataset, part, rng)
    begun = start_from_matches(simulated.time, simulated.matches, config.homing_vector, rng)
    if isinstance(begun, Refusal):
        return HomingTrial(part, trial, begun.reason.value, 0, 0, {})
    start, rows = begun
    tracks, truth = simulated.followed(rows)
    tried = {
        settings.title: replay_homing(start, tracks, settings).judged(truth)
        for settings in config.estimators
    }
    wrong = int(np.count_nonzero(~simulated.correct[rows]))
    log = BearingLog(start, list(tracks), truth) if trial < config.output.logs else None
    return HomingTrial(part, trial, "", len(rows), wrong, tried, log)


def start_from_matches(
    time: float,
    matches: BearingMatches,
    settings: HomingVectorSettings,
    rng: np.random.Generator,
) -> tuple[HomingStart, IntArray] | Refusal:
    """Homing vector and local map of the matches that support it.

    Returns:
        The start, whose features are numbered from 0, and the rows (n,) of ``matches`` that they
        were; or why there is none.
    """
    vector = estimate_homing_vector(matches, settings, rng)
    if isinstance(vector, Refusal):
        return vector
    rows = np.flatnonzero(vector.inliers)
    kept = matches.select(rows)
    of_kept = dataclasses.replace(vector, inliers=np.ones(len(rows), np.bool_))
    return HomingStart(time, of_kept, make_local_map(of_kept, kept), kept), rows


def _refused(trials: Sequence[HomingTrial]) -> int:
    return sum(bool(trial.refused) for trial in trials)


_TRIAL_COLUMNS = (
    "outliers", "trial", "estimator", "refused", "failure", "inliers", "wrong_inliers", "images",
    "direction_error_deg", "rotation_error_deg", "distance_error_legs",
    *(f"{what}_{name}" for name in NEES_NAMES for what in ("nees", "dof")),
)  # fmt: skip


def _trial_rows(trials: Sequence[HomingTrial]) -> Iterator[list[Cell]]:
    for one in trials:
        if one.refused:
            blank = [None] * (len(_TRIAL_COLUMNS) - 4)
            yield [one.share, one.trial, "", one.refused, *blank]
        for title, tried in one.tried.items():
            cells: list[Cell] = [None] * (3 + 2 * len(NEES_NAMES))
            if tried.errors is not None:
                last = tried.errors.last()
                degrees = np.rad2deg([last.direction[0], last.rotation[0]]).tolist()
                cells = [*degrees, float(last.distance[0])]
                for name in NEES_NAMES:
                    judged = getattr(last, name)
                    cells += [judged.values[0] if judged.dof[0] else None, int(judged.dof[0])]
            support = (one.inliers, one.wrong_inliers, len(tried.update_ms))
            yield [one.share, one.trial, title, "", tried.failure, *support, *cells]


_Homings: TypeAlias = Mapping[str, Mapping[float, Sequence[JudgedHoming]]]


def _best(homings: _Homings, shares: Sequence[float]) -> Iterator[str]:
    for share in shares:
        known = {title: _summary_numbers(of[share]) for title, of in homings.items()}
        errors = [(n["direction_median_deg"], title) for title, n in known.items() if n["trials"]]
        if errors:
            error, title = min(errors)
            yield (
                f"At {100.0 * share:.0f} % outliers {title} has the smallest median error of the "
                f"home direction: {error:.2f} degrees."
            )


def _trial_figures(homings: _Homings, shares: Sequence[float]) -> Iterator[Figure]:
    for share in shares:
        errors = {}
        for title, of in homings.items():
            last = [one.last().direction for one in _finished(of[share])]
            errors[title] = np.rad2deg(np.concatenate([np.empty(0), *last]))
        if any(map(len, errors.values())):
            heading = f"Error of the home direction at {100.0 * share:.0f} % outliers"
            figure = sorted_errors(errors, "degrees", (f"direction-{100.0 * share:.0f}", heading))
            figure.drawing.update_xaxes(type="log")
            yield figure


# --------------------------------------------------------------------------------------------
# `fgslam compare`: the bearings that a run logged, through other estimators

_Replays: TypeAlias = dict[str, dict[str, ReplayedHoming]]
"""By title of the estimator, then by name of the log."""


def save_bearing_logs(run: Path, logs: Mapping[str, BearingLog]) -> None:
    """Writes logs by their names, each atomically. Raises OutputError."""
    for name, log in logs.items():
        log.save(make_subfolder(run, LOG_FOLDER) / f"{name}.npz")


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


def open_homing_comparison(
    config: HomingExperiment, run: Path, estimators: Sequence[HomingEstimatorSettings]
) -> Task[RunResult]:
    """The bearings that a run logged, through estimators.

    Raises:
        FgslamError: the run has no bearing logs, or one is damaged.
    """
    logs = load_bearing_logs(run)
    provenance = {"run": str(run), "log": digest_of(_log_files(run))}
    return Task(provenance, lambda context: _compare(config, logs, estimators, context))


def _compare(
    config: HomingExperiment,
    logs: dict[str, BearingLog],
    estimators: Sequence[HomingEstimatorSettings],
    context: Context,
) -> RunResult:
    folder = context.folder
    names, kind = ("replays", "replaying"), dict[str, ReplayedHoming]
    found = context.perform(names, partial(perform_replay, logs), estimators, kind).all(
        lambda k, why: dict.fromkeys(logs, ReplayedHoming((), np.empty(0), why))
    )
    replays = {settings.title: one for settings, one in zip(estimators, found, strict=True)}
    judged = {
        title: {name: one.judged(logs[name].truth, _LEFT) for name, one in by_log.items()}
        for title, by_log in replays.items()
    }
    numbers: dict[str, JsonValue] = {
        settings.title: _estimator_numbers(
            settings, _summary_numbers(judged[settings.title].values()), judged[settings.title]
        )
        for settings in estimators
    }
    known = sum(log.truth is not None for log in logs.values())
    heading = f"{len(logs)} homings replayed, {known} with ground truth"
    homings = {title: list(by_log.values()) for title, by_log in judged.items()}
    table = _estimator_table("compared", heading, homings)
    columns = ("estimator", *(column.name for column in table.columns))
    write_csv(folder / COMPARISON_FILE, columns, [[title, *row] for title, row in table.rows])
    write_csv(folder / ESTIMATES_FILE, _ESTIMATE_COLUMNS, _estimate_rows(replays, logs))
    failures = [
        f"{title} failed on {name}: {one.failure}"
        for title, by_log in replays.items()
        for name, one in by_log.items()
        if one.failure
    ]
    return finish(
        config,
        folder,
        not context.stopped(),
        {"logs": sorted(logs)},
        "bearing logs replayed",
        tuple(_figures(logs, replays)),
        estimators=numbers,
        lines=(f"{heading}.",),
        tables=(table,),
        notes=tuple(failures),
        failed=len(failures) == len(logs) * len(replays),
    )


def perform_replay(
    logs: dict[str, BearingLog], settings: HomingEstimatorSettings
) -> dict[str, ReplayedHoming]:
    """One estimator on each log, by the log's name."""
    shown = next(iter(logs), None)  # the local map that is drawn is the first log's
    return {
        name: replay_homing(log.start, log.images, settings, landmarks=name == shown)
        for name, log in logs.items()
    }


_ESTIMATE_COLUMNS = (
    "log", "estimator", "time", "distance_legs", "direction_deg", "rotation_deg",
    "sigma_distance_legs", "sigma_direction_deg", "sigma_rotation_deg", "direction_error_deg",
)  # fmt: skip


def _estimate_rows(replays: _Replays, logs: Mapping[str, BearingLog]) -> Iterator[list[Cell]]:
    for title, by_log in replays.items():
        for name, one in by_log.items():
            errors = one.judged(logs[name].truth).errors
            for k, estimate in enumerate(one.estimates):
                home = estimate.home()
                sigma = np.sqrt(np.maximum(np.diagonal(home.covariance), 0.0))
                angles = np.rad2deg([home.direction, home.rotation, *sigma[1:]]).tolist()
                error = None if errors is None else float(np.rad2deg(errors.direction[k]))
                distances = estimate.time, home.distance, *angles[:2], float(sigma[0])
                yield [name, title, *distances, *angles[2:], error]


def _figures(logs: Mapping[str, BearingLog], replays: _Replays) -> Iterator[Figure]:
    """Of the first log: each estimator's error over time, and the first one's local map."""
    first = next(iter(logs))
    truth, began = logs[first].truth, logs[first].start.time
    lines = []
    for i, (title, by_log) in enumerate(replays.items()):
        errors = by_log[first].judged(truth).errors
        if errors is not None:
            seconds = np.array([e.time for e in by_log[first].estimates]) - began
            lines.append(Line(title, i, seconds, np.abs(np.rad2deg(errors.direction))))
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
            yield local_map_figure(estimates, truth, f"local-map-{i}", heading)
            return
