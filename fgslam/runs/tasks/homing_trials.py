"""Task `homing_trials`: simulated homings of bearings, many estimators on the same ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import IntArray
from fgslam.core.bearing_log import BearingLog
from fgslam.core.homing import BearingMatches, HomingStart, Refusal
from fgslam.datasets.opening import open_simulated_homing
from fgslam.evaluation.homing import HomingErrors
from fgslam.evaluation.statistics import JsonValue, Nees, UpdateTime
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.homing.two_view import make_local_map
from fgslam.frontend.homing.vector import estimate_homing_vector
from fgslam.report.content import Cell, Figure, TextTable, write_csv
from fgslam.report.homing_figures import sorted_errors
from fgslam.runs.config_models import HomingTrialsConfig
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task, write_document, write_page
from fgslam.runs.folder import TIMING_FILE, TRIALS_FILE
from fgslam.runs.homing_comparison import (
    ESTIMATOR_COLUMNS,
    NEES_NAMES,
    JudgedHoming,
    finished_errors,
    replay_homing,
    save_bearing_logs,
    summary_numbers,
    summary_of,
    table_row,
    update_time_of,
)
from fgslam.runs.units import each_apart

Unit: TypeAlias = tuple[HomingTrialsConfig, int, int]
"""Configuration, number of the share of outliers, and of the trial."""

TRIALS_A_BLOCK = 20  # trials a process: starting one takes as long as some trials
_COLUMNS = (
    "outliers",
    "trial",
    "estimator",
    "refused",
    "failure",
    "inliers",
    "wrong_inliers",
    "images",
    "direction_error_deg",
    "rotation_error_deg",
    "distance_error_legs",
    *(f"{what}_{name}" for name in NEES_NAMES for what in ("nees", "dof")),
)


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
    provenance = {"dataset": {"name": "simulated bearings"}}
    return Task(provenance, lambda context: _run(config, context))


def _run(config: HomingTrialsConfig, context: Context) -> RunResult:
    """Runs all trials; stopped early, those finished count."""
    units = _units(config)
    done = context.perform(
        each_apart(("trials", "trials"), perform_trial, units, HomingTrial, TRIALS_A_BLOCK)
    )
    trials = sorted(done.results.values(), key=lambda trial: (trial.share, trial.trial))
    failures = sorted(_failure([units[k] for k in block], why) for block, why in done.ended)
    logs = {trial_name(trial): trial.log for trial in trials if trial.log is not None}
    save_bearing_logs(context.folder, logs)
    status: Status = "finished" if len(trials) == len(units) else "interrupted"
    return finish_trials(config, context.folder, status, trials, failures)


def _failure(units: Sequence[Unit], why: str) -> str:
    _, share, first = units[0]
    return f"{len(units)} trials, from trial {first} of share {share} on: {why}"


def trial_name(trial: HomingTrial) -> str:
    """Of a trial's log: share of outliers in percent, and number."""
    return f"outliers_{100.0 * trial.share:02.0f}_trial_{trial.trial:04d}"


def perform_trial(unit: Unit) -> HomingTrial:
    """One trial; its noise depends on the seed, the share's number and its own number alone."""
    config, share, trial = unit
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


def _units(config: HomingTrialsConfig) -> list[Unit]:
    """All trials; those of one block are of one share, and the shares take turns."""
    return [
        (config, share, trial)
        for first in range(0, config.trials, TRIALS_A_BLOCK)
        for share in range(len(config.outliers))
        for trial in range(first, min(first + TRIALS_A_BLOCK, config.trials))
    ]


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


# --------------------------------------------------------------------------------------------
# Files


def finish_trials(
    config: HomingTrialsConfig,
    folder: Path,
    status: Status,
    trials: Sequence[HomingTrial],
    failures: Sequence[str],
) -> RunResult:
    """trials.csv, metrics.json and the page. Raises OutputError."""
    titles = [settings.title for settings in config.estimators]
    write_csv(folder / TRIALS_FILE, _COLUMNS, _rows(trials, titles))
    timing = ("outliers", "trial", "estimator", "median_ms", "p95_ms", "max_ms")
    write_csv(folder / TIMING_FILE, timing, _times(trials, titles))
    groups = {share: [t for t in trials if t.share == share] for share in config.outliers}
    found = {title: _of_estimator(groups, title) for title in titles}
    tables = tuple(_table(share, group, titles) for share, group in groups.items() if group)
    result = RunResult(config, folder, status, _best(groups, titles), tables, tuple(failures))
    refused = {f"{share:g}": sum(bool(t.refused) for t in group) for share, group in groups.items()}
    numbers: dict[str, JsonValue] = {
        "trials": config.trials,
        "outliers": list(config.outliers),
        "trials_done": {f"{share:g}": len(group) for share, group in groups.items()},
        "refused": refused,
    }
    kinds = {settings.title: settings.kind for settings in config.estimators}
    estimators = {title: {"kind": kinds[title], **values} for title, values in found.items()}
    write_document(result, numbers, estimators)
    subtitle = f"{len(trials)} simulated homings of bearings alone, seed {config.seed}"
    write_page(result, subtitle, figures=tuple(_figures(groups, titles)))
    return result


# --------------------------------------------------------------------------------------------
# Numbers, tables, figures


def _of(trials: Sequence[HomingTrial], title: str) -> list[JudgedHoming]:
    """What one estimator made of the trials that had a homing vector."""
    return [t.tried[title] for t in trials if title in t.tried]


def _of_estimator(groups: dict[float, list[HomingTrial]], title: str) -> dict[str, JsonValue]:
    every = [trial for group in groups.values() for trial in group]
    failures = [
        f"outliers {t.share:g}, trial {t.trial}: {t.tried[title].failure}"
        for t in every
        if title in t.tried and t.tried[title].failure
    ]
    shares: dict[str, JsonValue] = {
        f"{share:g}": summary_numbers(_of(group, title)) for share, group in groups.items()
    }
    return {
        "outliers": shares,
        "update_ms": asdict(update_time_of(_of(every, title))),
        "failures": list(failures),
    }


def _rows(trials: Sequence[HomingTrial], titles: Sequence[str]) -> Iterator[list[Cell]]:
    for trial in trials:
        start: list[Cell] = [trial.share, trial.trial]
        if trial.refused:
            yield [*start, "", trial.refused, *[None] * (len(_COLUMNS) - 4)]
        for title in titles if trial.tried else ():
            tried = trial.tried[title]
            about: list[Cell] = [title, "", tried.failure, trial.inliers, trial.wrong_inliers]
            yield [*start, *about, len(tried.update_ms), *_last(tried.errors)]


def _last(errors: HomingErrors | None) -> list[Cell]:
    if errors is None:
        return [None] * (3 + 2 * len(NEES_NAMES))
    last = errors.last()
    degrees = np.rad2deg([last.direction[0], last.rotation[0]]).tolist()
    judged: list[Nees] = [getattr(last, name) for name in NEES_NAMES]
    cells = [value for one in judged for value in (_value(one), int(one.dof[0]))]
    return [*degrees, float(last.distance[0]), *cells]


def _value(one: Nees) -> float | None:
    return float(one.values[0]) if one.dof[0] else None


def _times(trials: Sequence[HomingTrial], titles: Sequence[str]) -> Iterator[list[Cell]]:
    for trial in trials:
        for title in titles if trial.tried else ():
            time = UpdateTime.of(trial.tried[title].update_ms)
            yield [trial.share, trial.trial, title, time.median, time.p95, time.max]


def _table(share: float, group: Sequence[HomingTrial], titles: Sequence[str]) -> TextTable:
    refused = sum(bool(t.refused) for t in group)
    rows = tuple((title, table_row(_of(group, title))) for title in titles)
    heading = f"{100.0 * share:.0f} % outliers, {len(group)} trials"
    heading += f", {refused} of them refused" if refused else ""
    return TextTable(f"share-{100.0 * share:.0f}", heading, "estimator", ESTIMATOR_COLUMNS, rows)


def _best(groups: dict[float, list[HomingTrial]], titles: Sequence[str]) -> tuple[str, ...]:
    lines = []
    for share, group in groups.items():
        summaries = [(summary_of(_of(group, title)), title) for title in titles]
        ranked = sorted((s.direction_median_deg, title) for s, title in summaries if s is not None)
        if ranked:
            error, title = ranked[0]
            lines.append(
                f"At {100.0 * share:.0f} % outliers {title} has the smallest median error of the "
                f"home direction: {error:.2f} degrees."
            )
    return tuple(lines) or ("No trial gave a result.",)


def _figures(groups: dict[float, list[HomingTrial]], titles: Sequence[str]) -> Iterator[Figure]:
    for share, group in groups.items():
        errors = {title: _directions(group, title) for title in titles}
        if any(map(len, errors.values())):
            heading = f"Error of the home direction at {100.0 * share:.0f} % outliers"
            figure = sorted_errors(errors, "degrees", (f"direction-{100.0 * share:.0f}", heading))
            figure.drawing.update_xaxes(type="log")
            yield figure


def _directions(group: Sequence[HomingTrial], title: str) -> np.ndarray:
    last = [errors.last().direction for errors in finished_errors(_of(group, title))]
    return np.rad2deg(np.concatenate(last)) if last else np.empty(0)
