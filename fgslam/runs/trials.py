"""`fgslam compare --trials`: the same comparison over many worlds of noise, with paired tests."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fgslam.backend.settings import EstimatorSettings, family_of
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, OutputError
from fgslam.core.log import MeasurementLog
from fgslam.core.threads import one_blas_thread
from fgslam.datasets.settings import RenderedLabSettings, SimulatedMeasurementsSettings
from fgslam.evaluation.judging import PairedTest, judge_replay, mean_interval, paired_test
from fgslam.evaluation.statistics import EstimatorMetrics, JsonValue, Nees, judge, value_at
from fgslam.report.content import write_metrics
from fgslam.runs.compare import EVERY, Choice, choose, require_room, with_estimators
from fgslam.runs.config import (
    Experiment,
    ExperimentConfig,
    HomingTrialsConfig,
    OutputSettings,
    load_experiment,
)
from fgslam.runs.engine import Context, Opener, Opening, RunResult, Status, Task, run_task
from fgslam.runs.folder import (
    LOG_FILE,
    METRICS_FILE,
    RUN_MARKER,
    TIMING_FILE,
    TRIALS_FILE,
    ExistingFolder,
    is_run_folder,
)
from fgslam.runs.opening import open_sequence
from fgslam.runs.slam_comparison import load_truth, named, with_odometry
from fgslam.runs.tables import RESULT_COLUMNS, TIME_COLUMNS, trials_table, write_comparison_csv
from fgslam.runs.tasks.homing_replay import open_trials
from fgslam.runs.tasks.slam import open_slam
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.runs.tasks.slam_measurements import open_measured, write_log_and_truth
from fgslam.runs.units import Progress, Stopped
from fgslam.slam.replay import replay

DEFAULT_FOLDER = "trials"

# --------------------------------------------------------------------------------------------
# One trial: an experiment in one world of noise, through estimators

_OUTPUT = OutputSettings(pictures=False, report=False, checkpoint_seconds=1e9)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What one world gave: metrics and normalised errors by title of the estimator."""

    seed: int
    metrics: dict[str, EstimatorMetrics]
    nees: dict[str, dict[str, Nees]]


@one_blas_thread()
def perform_trial(
    experiment: ExperimentConfig, estimators: Sequence[EstimatorSettings], seed: int
) -> Trial:
    """One world of noise, start to end, in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="fgslam-trial-") as scratch:
        run = Path(scratch) / "run"
        maps = dataclasses.replace(experiment.map, save=None)
        config = experiment.model_copy(
            update={"seed": seed, "compare": (), "map": maps, "output": _OUTPUT}
        )
        if config.on_measurements:
            run.mkdir()
            write_log_and_truth(run, open_measured(config))
        else:
            run_task(open_slam, config, run)
        log = MeasurementLog.load(run / LOG_FILE)
        truth = load_truth(run, log)
        arrival = None if config.on_measurements else arrival_of(run)  # these begin in no map
    metrics, nees = {}, {}
    for settings in estimators:
        answer = replay(log, settings, config.frontend.ego_motion, arrival=arrival)
        judged = judge_replay(answer, truth)
        # A process of several estimators has no memory of each.
        metrics[settings.title] = dataclasses.replace(judged.metrics, peak_memory_mb=None)
        nees[settings.title] = judged.nees
    return Trial(seed, metrics, nees)


# --------------------------------------------------------------------------------------------
# All trials


def run_trials(
    source: Path,
    seeds: int | range,
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
        seeds: of the trials; or how many, the first one being the configuration's.
        choice: which estimators, and overrides of theirs and of the experiment.
        out: folder of the results; None: `trials` in the run folder, or `runs/NAME_trials`.
        existing: what to do where results are already; `resume` goes on with the trials left.
        jobs: workers at a time, each with linear algebra on one thread.
        progress: called after each trial that is done.
        stopped: True ends the trials; those finished are kept.

    Raises:
        FgslamError: the experiment has one world of noise only, or cannot be run.
    """
    file = source / RUN_MARKER if is_run_folder(source) else source
    config = load_experiment(file, choice.of_experiment)
    if not isinstance(config, ExperimentConfig | HomingTrialsConfig):
        raise ConfigError(
            f"{source}: task {config.task_name} has no trials of estimators side by side; "
            "--trials needs an experiment of SLAM or of the task homing_trials"
        )
    worlds = RenderedLabSettings | SimulatedMeasurementsSettings
    if isinstance(config, ExperimentConfig) and not isinstance(config.dataset, worlds):
        raise ConfigError(
            f"{source}: dataset.kind {config.dataset.kind} is a recording with one world of noise; "
            "--trials needs a rendered_lab or simulated_measurements data set"
        )
    estimators = choose(config, choice.of_estimators)
    alone = Path("runs") / f"{config.name}_{DEFAULT_FOLDER}"
    folder = out or (source / DEFAULT_FOLDER if is_run_folder(source) else alone)
    require_room(folder, source, existing)
    if isinstance(seeds, int):
        seeds = range(config.seed, config.seed + seeds)
    chosen = with_estimators(config, estimators)
    opener: Opener[RunResult] = open_trials
    if isinstance(config, ExperimentConfig):
        opener = partial(_open, config, seeds, estimators)
    else:
        chosen = chosen.model_copy(update={"trials": len(seeds), "seed": seeds.start})
    return run_task(opener, chosen, folder, existing, progress, stopped, jobs)


def _open(
    config: ExperimentConfig,
    seeds: range,
    estimators: Sequence[EstimatorSettings],
    chosen: Experiment,
    opening: Opening,
) -> Task[RunResult]:
    """Trials of SLAM; what they share is rendered once, before several processes would do so."""
    if not config.on_measurements:
        open_sequence(config, opening.progress)

    def run(context: Context) -> RunResult:
        work = partial(perform_trial, config, estimators)
        done = context.perform(("trials", "trials"), work, seeds, Trial)
        failures = sorted(f"trial with seed {seeds[k]}: {why}" for (k,), why in done.ended)
        status: Status = "interrupted" if context.stopped() else "finished"
        kinds = {settings.title: settings.kind for settings in estimators}
        trials = list(done.results.values())
        return write_trials(config, context.folder, status, trials, kinds, failures)

    return Task({"trials": len(seeds), "first_seed": seeds.start}, run)


def write_trials(
    config: ExperimentConfig,
    folder: Path,
    status: Status,
    trials: Sequence[Trial],
    kinds: Mapping[str, str],
    failures: Sequence[str] = (),
) -> RunResult:
    """trials.csv (the same bytes for the same seeds), trials_timing.csv and metrics.json.

    Args:
        config: of the experiment.
        folder: of the results.
        status: of the run.
        trials: those that were finished.
        kinds: of the estimators, by title.
        failures: a line for each trial that ended without a result.

    Raises:
        OutputError: every trial failed, or a file cannot be written.
    """
    about: dict[str, JsonValue] = {"name": config.name, "status": status, "trials": len(trials)}
    if not trials:
        if status == "finished":
            raise OutputError(f"no trial was finished; {failures[0]}")
        write_metrics(folder / METRICS_FILE, 0, {}, about)
        return RunResult(config, folder, status, ("No trial was finished.",))
    found = {one.seed: {t: m.as_json() for t, m in one.metrics.items()} for one in trials}
    rows = [(str(seed), with_odometry(config, values)) for seed, values in found.items()]
    write_comparison_csv(folder / TRIALS_FILE, rows, RESULT_COLUMNS, "seed")
    write_comparison_csv(folder / TIMING_FILE, rows, TIME_COLUMNS, "seed")
    estimators = {title: pool_trials(trials, title, kind) for title, kind in kinds.items()}
    pairs = compare_families(trials, kinds)
    about = {
        "name": config.name,
        "status": status,
        "odometry": config.odometry.kind,
        "remark": config.remark or None,
        "trials": len(rows),
        "seeds": list(found),
        "failures": list(failures),
        "comparisons": [
            {
                "smoother": pair.smoother,
                "filter": pair.filter,
                "best_filter": pair.best_filter,
                **asdict(pair.test),
                "sentence": pair.sentence,
            }
            for pair in pairs
        ],
    }
    frames = max(int(value_at(m, "frames") or 0) for one in found.values() for m in one.values())
    write_metrics(folder / METRICS_FILE, frames, estimators, about)
    heading = (
        f"{named(config)}: {len(trials)} trials, mean [95 % interval]; NEES pooled, 1 is right"
    )
    ended = [
        f"seed {seed}, {title}: {why}"
        for seed, values in found.items()
        for title, metrics in values.items()
        if (why := metrics.get("failure"))
    ]
    return RunResult(
        config,
        folder,
        status,
        lines=tuple(pair.sentence for pair in pairs),
        tables=(trials_table(heading, {t: one.as_json() for t, one in estimators.items()}),),
        particulars=(*(("failed", line) for line in (*failures, *ended)), ("results", str(folder))),
        failed=bool(failures),
    )


# --------------------------------------------------------------------------------------------
# What all trials show: means, pooled consistency, paired tests

_AVERAGED_ONLINE = ("ate_rmse_m", "rpe_trans_m", "rpe_rot_deg", "end_error_m", "end_error_deg")
_OF_CONTRACT = (*_AVERAGED_ONLINE[:3], "drift_percent", *_AVERAGED_ONLINE[3:])
_AVERAGED = (*_OF_CONTRACT, "landmark_rmse_m", "landmark_median_m", "nis_per_dof")
_SIGNIFICANT = 0.05


def _values_of(trials: Sequence[Trial], title: str, path: str) -> FloatArray:
    """A metric in all trials; NaN where it is not known, or the estimator ended early."""
    found = [trial.metrics[title] for trial in trials]
    values = [None if m.more.get("failure") else value_at(m.as_json(), path) for m in found]
    return np.array([np.nan if value is None else value for value in values], np.float64)


def pool_trials(trials: Sequence[Trial], title: str, kind: str) -> EstimatorMetrics:
    """One estimator in all trials: names of the contract hold means; NEES is pooled."""
    found = [one.metrics[title].more for one in trials]
    predicted = [more.get("predicted_frames") for more in found]
    pooled = {
        name: judge(
            [t.nees[title][name] for t in trials if not t.metrics[title].more.get("failure")]
        )
        for name in ("pose", "online_pose", "landmark")
    }

    def intervals(names: Sequence[str], before: str = "") -> dict[str, Any]:
        means = {name: mean_interval(_values_of(trials, title, before + name)) for name in names}
        return {name: None if mean is None else asdict(mean) for name, mean in means.items()}

    final, online = intervals(_AVERAGED), intervals(_AVERAGED_ONLINE, "online.")
    mean: dict[str, Any] = {k: None if one is None else one["mean"] for k, one in final.items()}
    pose, landmark = pooled["pose"], pooled["landmark"]
    return EstimatorMetrics(
        **dict[str, Any]((name, mean[name]) for name in _OF_CONTRACT),
        nees_pose_per_dof=None if pose is None else pose.per_dof,
        nees_landmark_per_dof=None if landmark is None else landmark.per_dof,
        more={
            "kind": kind,
            "predicted_frames": sum(count for count in predicted if isinstance(count, int)),
            "landmark_rmse_m": mean["landmark_rmse_m"],
            "landmark_median_m": mean["landmark_median_m"],
            "online": {"ate_rmse_m": value_at(online, "ate_rmse_m.mean")},
            "nis_per_dof": mean["nis_per_dof"],
            **{f"nees_{k}": None if one is None else asdict(one) for k, one in pooled.items()},
            "intervals": final,
            "intervals_online": online,
        },
    )


class Pair(NamedTuple):
    """Smoother against filter by final ATE."""

    smoother: str
    filter: str
    best_filter: bool
    test: PairedTest

    @property
    def sentence(self) -> str:
        """The outcome in plain words."""
        test, mean = self.test, self.test.difference
        best = " (the best filter)" if self.best_filter else ""
        lower = mean.mean <= 0.0
        if test.p_value is None or test.p_value >= _SIGNIFICANT:
            outcome = (
                f"no difference shown between {self.smoother} and {self.filter}{best}: better in "
                f"{test.wins}, worse in {test.losses} of {mean.count} trials"
            )
        elif lower:
            outcome = (
                f"{self.smoother} beats {self.filter}{best} in {test.wins} of {mean.count} trials"
            )
        else:
            outcome = (
                f"{self.filter}{best} beats {self.smoother} in {test.losses} of {mean.count} trials"
            )
        interval = "one trial has no interval"
        if mean.lower is not None and mean.upper is not None:
            sign = -1.0 if lower else 1.0
            low, high = sorted((100.0 * sign * mean.lower, 100.0 * sign * mean.upper))
            interval = f"95 % [{low:.3f}, {high:.3f}]"
        ratio = "" if test.ratio is None else f", {test.ratio:.2f} times"
        p_value = "all equal" if test.p_value is None else f"p = {test.p_value:.2g}"
        return (
            f"{outcome}; {self.smoother}'s final ATE is {'lower' if lower else 'higher'} by "
            f"{100.0 * abs(mean.mean):.3f} cm, {interval}{ratio}; {p_value}"
        )


def compare_families(trials: Sequence[Trial], kinds: Mapping[str, str]) -> list[Pair]:
    """Each smoother against each filter; ``kinds`` of the estimators by title."""
    ate = {title: _values_of(trials, title, "ate_rmse_m") for title in kinds}
    families = {title: family_of(kind) for title, kind in kinds.items()}
    filters = [t for t, f in families.items() if f == "filter" and np.isfinite(ate[t]).any()]
    smoothers = [t for t, family in families.items() if family == "smoother"]
    if not filters:
        return []
    best = min(filters, key=lambda title: float(np.nanmean(ate[title])))
    tests = [(s, f, paired_test(ate[s], ate[f])) for s, f in product(smoothers, filters)]
    return [Pair(s, f, f == best, test) for s, f, test in tests if test is not None]
