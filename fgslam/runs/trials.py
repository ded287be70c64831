"""`fgslam compare --trials`: the same comparison over many worlds of noise."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError, OutputError
from fgslam.core.measurement_log import MeasurementLog
from fgslam.datasets.settings import RenderedLabSettings, SimulatedMeasurementsSettings
from fgslam.evaluation.consistency import Nees
from fgslam.evaluation.judging import judge_replay
from fgslam.evaluation.metrics import EstimatorMetrics
from fgslam.runs.choosing import EVERY, Choice, choose
from fgslam.runs.comparison import load_truth
from fgslam.runs.comparison_tables import TRIAL_COLUMNS, metrics_table
from fgslam.runs.config import load_experiment
from fgslam.runs.config_models import (
    Experiment,
    ExperimentConfig,
    HomingTrialsConfig,
)
from fgslam.runs.engine import Context, Opener, Opening, RunResult, Status, Task, run_task
from fgslam.runs.folder import LOG_FILE, RUN_MARKER, ExistingFolder, is_run_folder
from fgslam.runs.opening import open_sequence
from fgslam.runs.settings import OutputSettings
from fgslam.runs.tasks.slam import open_slam
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.runs.tasks.slam_measurements import open_measured, write_recording
from fgslam.runs.trial_results import (
    TrialSummary,
    failures_of,
    summarise,
    together,
    write_trials,
)
from fgslam.runs.units import Progress, Stage, Stopped, one_by_one
from fgslam.slam.replay import replay

DEFAULT_FOLDER = "trials"
_OUTPUT = OutputSettings(pictures=False, report=False, checkpoint_seconds=1e9)


@dataclass(frozen=True, slots=True)
class Seeds:
    """How many worlds of noise, and the seed of the first; None: the configuration's."""

    count: int
    first: int | None = None


@dataclass(frozen=True, slots=True)
class TrialTask:
    """One world of noise for one process."""

    config: ExperimentConfig
    seed: int
    estimators: tuple[EstimatorSettings, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What one world gave: metrics and normalised errors by title of the estimator."""

    seed: int
    metrics: dict[str, EstimatorMetrics]
    nees: dict[str, dict[str, Nees]]


@dataclass(frozen=True, slots=True, eq=False)
class TrialsResult(RunResult):
    """How trials of SLAM ended; ``summary`` is what follows from all of them."""

    summary: TrialSummary = field(kw_only=True)


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
        existing: what to do where results are already.
        jobs: processes at a time, each with linear algebra on one thread.
        progress: called after each trial that is done.
        stopped: True ends the trials; those finished are kept.

    Raises:
        FgslamError: the experiment has one world of noise only, or cannot be run.
    """
    config = _experiment(source, choice.of_experiment)
    estimators = choose(config, choice.of_estimators)
    folder = out or _default_folder(source, config)
    _require_room(folder, source, existing)
    first = config.seed if seeds.first is None else seeds.first
    opener: Opener[RunResult]
    if isinstance(config, ExperimentConfig):
        opener = functools.partial(_open, config, seeds.count, first, estimators)
        chosen: Experiment = config.model_copy(update={"compare": estimators})
    else:
        from fgslam.runs.tasks.homing_trials import open_trials

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
) -> Task[TrialsResult]:
    """Trials of SLAM; what they share is rendered once, before several processes would do so."""
    if not config.on_measurements:
        open_sequence(config, lambda done, total: opening.progress("rendering", done, total))
    tasks = [TrialTask(config, first + k, estimators) for k in range(count)]
    provenance = {"trials": count, "first_seed": first}
    return Task(provenance, lambda context: _run(config, tasks, context))


def _run(config: ExperimentConfig, tasks: Sequence[TrialTask], context: Context) -> TrialsResult:
    """Finished trials by seed, and a line for each that ended without a result."""
    stage = Stage(
        name="trials",
        label="trials",
        count=len(tasks),
        work=_perform_all,
        argument=lambda units: [tasks[k] for k in units],
        kind=Trial,
        blocks=one_by_one,
    )
    done = context.perform(stage)
    failures = sorted(f"trial with seed {tasks[k].seed}: {why}" for (k,), why in done.ended)
    if not done.results:
        raise OutputError(f"no trial was finished; {failures[0] if failures else 'interrupted'}")
    rows = [(trial.seed, trial.metrics, trial.nees) for trial in done.results.values()]
    kinds = {settings.title: settings.kind for settings in tasks[0].estimators}
    summary = summarise(rows, kinds)
    write_trials(context.folder, config.name, summary, failures)
    status: Status = "interrupted" if context.stopped() else "finished"
    return _result(config, context.folder, status, summary, failures)


def _result(
    config: ExperimentConfig,
    folder: Path,
    status: Status,
    summary: TrialSummary,
    failures: Sequence[str],
) -> TrialsResult:
    """Means over the trials, the verdict on each estimator, and who beats whom."""
    values = {title: together(summary, title).as_json() for title in summary.means}
    count = len(summary.rows)
    heading = f"{config.name}: {count} trials, mean [95 % interval]; NEES pooled, 1 is right"
    failed = [("failed", line) for line in (*failures, *failures_of(summary))]
    return TrialsResult(
        config,
        folder,
        status,
        lines=tuple(pair.sentence for pair in summary.pairs),
        tables=(metrics_table(heading, TRIAL_COLUMNS, values),),
        particulars=(*failed, ("results", str(folder))),
        failed=bool(failures),
        summary=summary,
    )


def _perform_all(tasks: Sequence[TrialTask]) -> list[Trial]:
    return [perform_trial(task) for task in tasks]


def perform_trial(task: TrialTask) -> Trial:
    """One trial, start to end, in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="fgslam-trial-") as scratch:
        run = Path(scratch) / "run"
        maps = dataclasses.replace(task.config.map, save=None)
        config = task.config.model_copy(
            update={"seed": task.seed, "compare": (), "map": maps, "output": _OUTPUT}
        )
        if config.on_measurements:
            run.mkdir()
            write_recording(run, config, open_measured(config))
        else:
            run_task(open_slam, config, run)
        log = MeasurementLog.load(run / LOG_FILE)
        truth, arrival = load_truth(run, log), arrival_of(run)
    metrics, nees = {}, {}
    for settings in task.estimators:
        answer = replay(log, settings, config.frontend.ego_motion, arrival=arrival)
        judged = judge_replay(answer, truth)
        # A process of several estimators has no memory of each.
        metrics[settings.title] = dataclasses.replace(judged.metrics, peak_memory_mb=None)
        nees[settings.title] = judged.nees
    return Trial(task.seed, metrics, nees)


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


def _require_room(folder: Path, source: Path, existing: ExistingFolder) -> None:
    if folder.resolve() in (source.resolve(), *source.resolve().parents):
        raise ConfigError(f"--out {folder}: holds the run itself; choose another folder")
    if existing == "refuse" and is_run_folder(folder):
        raise OutputError(f"{folder} holds results already; choose another --out, or --overwrite")
