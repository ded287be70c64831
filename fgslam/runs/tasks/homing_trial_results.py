"""What follows from simulated homings: a row for each, and one for each estimator and share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.bearing_log import BearingLog
from fgslam.evaluation.consistency import Consistency, Nees
from fgslam.evaluation.homing import HomingErrors, HomingSummary, summarise_homings
from fgslam.evaluation.metrics import JsonValue, UpdateTime
from fgslam.report.content import Column, TextTable
from fgslam.report.figures.homing import sorted_errors
from fgslam.report.figures.traces import Figure
from fgslam.report.tables import Cell, write_csv
from fgslam.runs.config_models import HomingTrialsConfig
from fgslam.runs.documents import write_document, write_page
from fgslam.runs.engine import RunResult, Status


@dataclass(frozen=True, slots=True, eq=False)
class TriedEstimator:
    """What one estimator made of one trial.

    Attributes:
        errors: image by image; None where it gave no estimate.
        update_ms: (k,) time of each update.
        failure: why it ended early, else empty.
    """

    errors: HomingErrors | None
    update_ms: FloatArray
    failure: str


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
    tried: dict[str, TriedEstimator]
    log: BearingLog | None = None


TRIALS_FILE = "trials.csv"
TIMING_FILE = "trials_timing.csv"
_NEES = ("robot", "target", "joint", "home")
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
    *(f"{what}_{name}" for name in _NEES for what in ("nees", "dof")),
)
_UNKNOWN = "-"
_IN_A_WORD = {"consistent": "ok", "overconfident": "high", "conservative": "low"}


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
    result = RunResult(config, folder, status, _verdict(groups, titles), tables, tuple(failures))
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
    write_page(result, subtitle, figures=tuple(_figures(groups, titles)), series=tuple(titles))
    return result


def consistency(found: Consistency | None) -> JsonValue:
    """As it stands in metrics.json."""
    return None if found is None else asdict(found)


def summary_numbers(summary: HomingSummary | None) -> dict[str, JsonValue]:
    """The names of a summary in metrics.json; all null where there is none."""
    if summary is None:
        return {"trials": 0}
    values: dict[str, JsonValue] = {
        name: getattr(summary, name) for name in HomingSummary.__slots__ if name not in _NEES
    }
    for name in _NEES:
        judged = getattr(summary, name)
        values[f"nees_{name}_per_dof"] = None if judged is None else judged.per_dof
        values[f"nees_{name}"] = consistency(judged)
    return values


# --------------------------------------------------------------------------------------------
# Numbers


def _errors(trials: Sequence[HomingTrial], title: str) -> list[HomingErrors]:
    """Of the trials that the estimator finished."""
    tried = [t.tried[title] for t in trials if title in t.tried]
    return [one.errors for one in tried if one.errors is not None and not one.failure]


def _summary(trials: Sequence[HomingTrial], title: str) -> HomingSummary | None:
    errors = _errors(trials, title)
    return summarise_homings(errors) if errors else None


def _update_times(trials: Sequence[HomingTrial], title: str) -> UpdateTime:
    times = [t.tried[title].update_ms for t in trials if title in t.tried]
    return UpdateTime.of(np.concatenate(times)) if times else UpdateTime()


def _of_estimator(groups: dict[float, list[HomingTrial]], title: str) -> dict[str, JsonValue]:
    every = [trial for group in groups.values() for trial in group]
    failures = [
        f"outliers {t.share:g}, trial {t.trial}: {t.tried[title].failure}"
        for t in every
        if title in t.tried and t.tried[title].failure
    ]
    shares: dict[str, JsonValue] = {
        f"{share:g}": summary_numbers(_summary(group, title)) for share, group in groups.items()
    }
    return {
        "outliers": shares,
        "update_ms": asdict(_update_times(every, title)),
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
        return [None] * (3 + 2 * len(_NEES))
    last = errors.last()
    degrees = np.rad2deg([last.direction[0], last.rotation[0]]).tolist()
    judged: list[Nees] = [getattr(last, name) for name in _NEES]
    cells = [value for one in judged for value in (_value(one), int(one.dof[0]))]
    return [*degrees, float(last.distance[0]), *cells]


def _value(one: Nees) -> float | None:
    return float(one.values[0]) if one.dof[0] else None


def _times(trials: Sequence[HomingTrial], titles: Sequence[str]) -> Iterator[list[Cell]]:
    for trial in trials:
        for title in titles if trial.tried else ():
            time = UpdateTime.of(trial.tried[title].update_ms)
            yield [trial.share, trial.trial, title, time.median, time.p95, time.max]


# --------------------------------------------------------------------------------------------
# Words, tables, figures

TRIAL_COLUMNS = (
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


def trial_row(summary: HomingSummary | None, failed: int, time: UpdateTime) -> tuple[str, ...]:
    """A row under :data:`TRIAL_COLUMNS`."""
    update = _number(time.median, ".2f")
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


def _table(share: float, group: Sequence[HomingTrial], titles: Sequence[str]) -> TextTable:
    refused = sum(bool(t.refused) for t in group)
    rows = tuple(
        (
            title,
            trial_row(_summary(group, title), _failed(group, title), _update_times(group, title)),
        )
        for title in titles
    )
    heading = f"{100.0 * share:.0f} % outliers, {len(group)} trials"
    heading += f", {refused} of them refused" if refused else ""
    return TextTable(f"share-{100.0 * share:.0f}", heading, "estimator", TRIAL_COLUMNS, rows)


def _failed(group: Sequence[HomingTrial], title: str) -> int:
    return sum(bool(t.tried[title].failure) for t in group if title in t.tried)


def _number(value: float | None, spec: str) -> str:
    return _UNKNOWN if value is None or not np.isfinite(value) else format(value, spec)


def _judged(found: Consistency | None) -> str:
    return _UNKNOWN if found is None else f"{found.per_dof:.3g} {_IN_A_WORD[found.verdict]}".strip()


def _verdict(groups: dict[float, list[HomingTrial]], titles: Sequence[str]) -> tuple[str, ...]:
    lines = []
    for share, group in groups.items():
        summaries = [(_summary(group, title), title) for title in titles]
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
            figure.layout["xaxis"]["type"] = "log"
            yield figure


def _directions(group: Sequence[HomingTrial], title: str) -> np.ndarray:
    last = [one.last().direction for one in _errors(group, title)]
    return np.rad2deg(np.concatenate(last)) if last else np.empty(0)
