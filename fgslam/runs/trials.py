"""`fgslam compare --trials`: the same comparison over many worlds of noise, and what they say."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.backend.settings import EstimatorSettings, family_of
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, OutputError
from fgslam.datasets.settings import RenderedLabSettings, SimulatedMeasurementsSettings
from fgslam.evaluation.judging import MeanInterval, PairedTest, mean_interval, paired_test
from fgslam.evaluation.statistics import Consistency, EstimatorMetrics, JsonValue, judge, value_at
from fgslam.report.content import write_metrics
from fgslam.runs.compare import EVERY, Choice, choose, require_room
from fgslam.runs.config import Experiment, ExperimentConfig, HomingTrialsConfig, load_experiment
from fgslam.runs.engine import Context, Opener, Opening, RunResult, Status, Task, run_task
from fgslam.runs.folder import (
    METRICS_FILE,
    RUN_MARKER,
    TIMING_FILE,
    TRIALS_FILE,
    ExistingFolder,
    is_run_folder,
)
from fgslam.runs.opening import open_sequence
from fgslam.runs.slam_comparison import named, with_odometry
from fgslam.runs.tables import RESULT_COLUMNS, TIME_COLUMNS, trials_table, write_comparison_csv
from fgslam.runs.tasks.homing_replay import open_trials
from fgslam.runs.trial import Trial, TrialTask, perform_trial
from fgslam.runs.units import Progress, Stopped, each_apart

DEFAULT_FOLDER = "trials"
_SIGNIFICANT = 0.05
_AVERAGED = (
    "ate_rmse_m",
    "rpe_trans_m",
    "rpe_rot_deg",
    "drift_percent",
    "end_error_m",
    "end_error_deg",
    "landmark_rmse_m",
    "landmark_median_m",
    "online.ate_rmse_m",
    "online.rpe_trans_m",
    "online.rpe_rot_deg",
    "online.end_error_m",
    "online.end_error_deg",
    "nis_per_dof",
)


@dataclass(frozen=True, slots=True)
class Seeds:
    """How many worlds of noise, and the seed of the first; None: the configuration's."""

    count: int
    first: int | None = None


def run_trials(
    source: Path,
    seeds: Seeds,
    choice: Choice = EVERY,
    out: Path | None = None,
    existing: ExistingFolder = "refuse",
    jobs: int = 1,
    progress: Progress = lambda what, done, total: None,
    stopped: Stopped = lambda: False,
) -> RunResult:
    """Runs the experiment with several seeds in a row and compares the estimators on each.

    Args:
        source: an experiment's .yaml, or the run folder of one.
        seeds: how many trials, from which seed on.
        choice: which estimators, and overrides of theirs and of the experiment.
        out: folder of the results; None: `trials` in the run folder, or `runs/NAME_trials`.
        existing: what to do where results are already; `resume` goes on with the trials left.
        jobs: workers at a time, each with linear algebra on one thread.
        progress: called after each trial that is done.
        stopped: True ends the trials; those finished are kept.

    Raises:
        FgslamError: the experiment has one world of noise only, or cannot be run.
    """
    config = _experiment(source, choice.of_experiment)
    estimators = choose(config, choice.of_estimators)
    folder = out or _default_folder(source, config)
    require_room(folder, source, existing)
    first = config.seed if seeds.first is None else seeds.first
    opener: Opener[RunResult]
    if isinstance(config, ExperimentConfig):
        opener = functools.partial(_open, config, seeds.count, first, estimators)
        chosen: Experiment = config.model_copy(update={"compare": estimators})
    else:
        opener = open_trials
        changes: dict[str, Any] = {"trials": seeds.count, "seed": first}
        changes |= {"estimator": estimators[0], "compare": estimators[1:]}
        chosen = config.model_copy(update=changes)
    return run_task(opener, chosen, folder, existing, progress, stopped, jobs)


def _open(
    config: ExperimentConfig,
    count: int,
    first: int,
    estimators: tuple[EstimatorSettings, ...],
    chosen: Experiment,
    opening: Opening,
) -> Task[RunResult]:
    """Trials of SLAM; what they share is rendered once, before several processes would do so."""
    if not config.on_measurements:
        open_sequence(config, lambda done, total: opening.progress("rendering", done, total))
    tasks = [TrialTask(config, first + k, estimators) for k in range(count)]
    provenance = {"trials": count, "first_seed": first}
    return Task(provenance, lambda context: _run(config, tasks, context))


def _run(config: ExperimentConfig, tasks: Sequence[TrialTask], context: Context) -> RunResult:
    """Finished trials by seed, and a line for each that ended without a result."""
    done = context.perform(each_apart(("trials", "trials"), perform_trial, tasks, Trial))
    failures = sorted(f"trial with seed {tasks[k].seed}: {why}" for (k,), why in done.ended)
    if not done.results:
        return _none(config, context, failures)
    kinds = {settings.title: settings.kind for settings in tasks[0].estimators}
    summary = summarise(list(done.results.values()), kinds)
    status: Status = "interrupted" if context.stopped() else "finished"
    write_trials(context.folder, config, summary, failures, status)
    return _result(config, context.folder, status, summary, failures)


def _none(config: ExperimentConfig, context: Context, failures: Sequence[str]) -> RunResult:
    """Stopped before the first trial was finished. Raises OutputError where each one failed."""
    if not context.stopped():
        raise OutputError(f"no trial was finished; {failures[0]}")
    about: dict[str, JsonValue] = {"name": config.name, "status": "interrupted", "trials": 0}
    write_metrics(context.folder / METRICS_FILE, 0, {}, about)
    return RunResult(config, context.folder, "interrupted", ("No trial was finished.",))


def _result(
    config: ExperimentConfig,
    folder: Path,
    status: Status,
    summary: TrialSummary,
    failures: Sequence[str],
) -> RunResult:
    """Means over the trials, the verdict on each estimator, and who beats whom."""
    values = {title: together(summary, title).as_json() for title in summary.means}
    count = len(summary.trials)
    heading = f"{named(config)}: {count} trials, mean [95 % interval]; NEES pooled, 1 is right"
    failed = [("failed", line) for line in (*failures, *failures_of(summary))]
    return RunResult(
        config,
        folder,
        status,
        lines=tuple(pair.sentence for pair in summary.pairs),
        tables=(trials_table(heading, values),),
        particulars=(*failed, ("results", str(folder))),
        failed=bool(failures),
    )


def _experiment(source: Path, overrides: tuple[str, ...]) -> ExperimentConfig | HomingTrialsConfig:
    """The configuration, if other seeds make other worlds of it."""
    config = load_experiment(source / RUN_MARKER if is_run_folder(source) else source, overrides)
    if isinstance(config, HomingTrialsConfig):
        return config
    if not isinstance(config, ExperimentConfig):
        raise ConfigError(
            f"{source}: task {config.task_name} has no trials of estimators side by side; "
            "--trials needs an experiment of SLAM or of the task homing_trials"
        )
    if not isinstance(config.dataset, RenderedLabSettings | SimulatedMeasurementsSettings):
        raise ConfigError(
            f"{source}: dataset.kind {config.dataset.kind} is a recording with one world of noise; "
            "--trials needs a rendered_lab or simulated_measurements data set"
        )
    return config


def _default_folder(source: Path, config: Experiment) -> Path:
    if is_run_folder(source):
        return source / DEFAULT_FOLDER
    return Path("runs") / f"{config.name}_{DEFAULT_FOLDER}"


# --------------------------------------------------------------------------------------------
# What all trials say: means, pooled consistency, paired tests


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Smoother against filter by final ATE."""

    smoother: str
    filter: str
    best_filter: bool
    test: PairedTest

    @property
    def sentence(self) -> str:
        """The outcome in plain words."""
        test, n = self.test, self.test.difference.count
        found = test.p_value is not None and test.p_value < _SIGNIFICANT
        best = " (the best filter)" if self.best_filter else ""
        if found and test.difference.mean < 0.0:
            start = f"{self.smoother} beats {self.filter}{best} in {test.wins} of {n} trials"
        elif found:
            start = f"{self.filter}{best} beats {self.smoother} in {test.losses} of {n} trials"
        else:
            start = (
                f"no difference shown between {self.smoother} and {self.filter}{best}: better in "
                f"{test.wins}, worse in {test.losses} of {n} trials"
            )
        return f"{start}; {self._size()}"

    def _size(self) -> str:
        test, mean = self.test, self.test.difference
        ratio = "" if test.ratio is None else f", {test.ratio:.2f} times"
        p_value = "all equal" if test.p_value is None else f"p = {test.p_value:.2g}"
        sign = -1.0 if mean.mean <= 0.0 else 1.0
        ends = "one trial has no interval"
        if mean.lower is not None and mean.upper is not None:
            low, high = sorted((100.0 * sign * mean.lower, 100.0 * sign * mean.upper))
            ends = f"95 % [{low:.3f}, {high:.3f}]"
        word = "lower" if sign < 0.0 else "higher"
        return (
            f"{self.smoother}'s final ATE is {word} by {100.0 * abs(mean.mean):.3f} cm, "
            f"{ends}{ratio}; {p_value}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class TrialSummary:
    """All trials together.

    Attributes:
        trials: those that were finished.
        means: mean and interval over the trials, by title and path in the metrics.
        pooled: verdict on all trials, by title and `pose`, `online_pose` or `landmark`.
        pairs: each smoother against each filter.
        kinds: of the estimators, by title.
    """

    trials: tuple[Trial, ...]
    means: dict[str, dict[str, MeanInterval | None]]
    pooled: dict[str, dict[str, Consistency | None]]
    pairs: tuple[Pair, ...]
    kinds: dict[str, str]


def summarise(trials: Sequence[Trial], kinds: Mapping[str, str]) -> TrialSummary:
    """Means, pooled NEES and paired tests; ``kinds`` of the estimators by title."""
    values = {t: {p: _column(trials, t, p) for p in _AVERAGED} for t in kinds}
    means = {t: {p: mean_interval(v) for p, v in paths.items()} for t, paths in values.items()}
    pooled = {
        title: {
            name: judge(
                [one.nees[title][name] for one in trials if _ended_well(one.metrics[title])]
            )
            for name in ("pose", "online_pose", "landmark")
        }
        for title in kinds
    }
    ate = {title: paths["ate_rmse_m"] for title, paths in values.items()}
    return TrialSummary(tuple(trials), means, pooled, tuple(_pairs(ate, kinds)), dict(kinds))


def write_trials(
    folder: Path,
    config: ExperimentConfig,
    summary: TrialSummary,
    failures: Sequence[str],
    status: Status,
) -> None:
    """trials.csv (the same bytes for the same seeds), trials_timing.csv and metrics.json."""
    rows = [
        (
            str(one.seed),
            with_odometry(config, {title: m.as_json() for title, m in one.metrics.items()}),
        )
        for one in summary.trials
    ]
    write_comparison_csv(folder / TRIALS_FILE, rows, RESULT_COLUMNS, "seed")
    write_comparison_csv(folder / TIMING_FILE, rows, TIME_COLUMNS, "seed")
    about: dict[str, JsonValue] = {
        "name": config.name,
        "status": status,
        "odometry": config.odometry.kind,
        "remark": config.remark or None,
        "trials": len(rows),
        "seeds": [one.seed for one in summary.trials],
        "failures": list(failures),
        "comparisons": [_pair_json(pair) for pair in summary.pairs],
    }
    frames = max(int(value_at(m, "frames") or 0) for _, values in rows for m in values.values())
    estimators = {title: together(summary, title) for title in summary.means}
    write_metrics(folder / METRICS_FILE, frames, estimators, about)


def _pair_json(pair: Pair) -> dict[str, JsonValue]:
    names = {"smoother": pair.smoother, "filter": pair.filter, "best_filter": pair.best_filter}
    return {**names, **asdict(pair.test), "sentence": pair.sentence}


def failures_of(summary: TrialSummary) -> list[str]:
    """A line for each estimator that ended early in a trial."""
    return [
        f"seed {trial.seed}, {title}: {why}"
        for trial in summary.trials
        for title, one in trial.metrics.items()
        if (why := one.more.get("failure"))
    ]


def together(summary: TrialSummary, title: str) -> EstimatorMetrics:
    """Names of the contract hold means over the trials; NEES is pooled."""
    means, pooled = summary.means[title], summary.pooled[title]
    intervals: dict[str, JsonValue] = {
        path: None if found is None else asdict(found) for path, found in means.items()
    }
    online = {
        path.removeprefix("online."): intervals.pop(path)
        for path in _AVERAGED
        if path.startswith("online.")
    }
    return EstimatorMetrics(
        ate_rmse_m=_mean(means["ate_rmse_m"]),
        rpe_trans_m=_mean(means["rpe_trans_m"]),
        rpe_rot_deg=_mean(means["rpe_rot_deg"]),
        drift_percent=_mean(means["drift_percent"]),
        end_error_m=_mean(means["end_error_m"]),
        end_error_deg=_mean(means["end_error_deg"]),
        nees_pose_per_dof=_per_dof(pooled["pose"]),
        nees_landmark_per_dof=_per_dof(pooled["landmark"]),
        more={
            "kind": summary.kinds[title],
            "predicted_frames": _predicted(summary, title),
            "landmark_rmse_m": _mean(means["landmark_rmse_m"]),
            "landmark_median_m": _mean(means["landmark_median_m"]),
            "online": {"ate_rmse_m": _mean(means["online.ate_rmse_m"])},
            "nis_per_dof": _mean(means["nis_per_dof"]),
            "nees_pose": _json(pooled["pose"]),
            "nees_online_pose": _json(pooled["online_pose"]),
            "nees_landmark": _json(pooled["landmark"]),
            "intervals": intervals,
            "intervals_online": online,
        },
    )


def _pairs(ate: Mapping[str, FloatArray], kinds: Mapping[str, str]) -> list[Pair]:
    families = {title: family_of(kind) for title, kind in kinds.items()}
    filters = [t for t, f in families.items() if f == "filter" and np.isfinite(ate[t]).any()]
    smoothers = [t for t, family in families.items() if family == "smoother"]
    if not filters:
        return []
    best = min(filters, key=lambda title: float(np.nanmean(ate[title])))
    tests = [(s, f, paired_test(ate[s], ate[f])) for s, f in product(smoothers, filters)]
    return [Pair(s, f, f == best, test) for s, f, test in tests if test is not None]


def _column(trials: Sequence[Trial], title: str, path: str) -> FloatArray:
    """One number of all trials; NaN where it is not known, or the estimator ended early."""
    found = [trial.metrics[title] for trial in trials]
    values = [value_at(m.as_json(), path) if _ended_well(m) else None for m in found]
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _ended_well(metrics: EstimatorMetrics) -> bool:
    return not metrics.more.get("failure")


def _predicted(summary: TrialSummary, title: str) -> int:
    """Poses of all its trials that no landmark measured."""
    found = (one.metrics[title].more.get("predicted_frames") for one in summary.trials)
    return sum(count for count in found if isinstance(count, int))


def _mean(found: MeanInterval | None) -> float | None:
    return None if found is None else found.mean


def _per_dof(found: Consistency | None) -> float | None:
    return None if found is None else found.per_dof


def _json(found: Consistency | None) -> JsonValue:
    return None if found is None else asdict(found)
