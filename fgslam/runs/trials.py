"""`fgslam compare --trials`: the same comparison over many worlds of noise."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError, OutputError
from fgslam.core.measurement_log import MeasurementLog
from fgslam.datasets.settings import RenderedLabSettings, SimulatedMeasurementsSettings
from fgslam.evaluation.consistency import Nees
from fgslam.evaluation.judging import judge_replay
from fgslam.evaluation.metrics import EstimatorMetrics
from fgslam.runs.choosing import EVERY, Choice, choose
from fgslam.runs.comparison import Progress, load_truth
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.folder import RUN_MARKER, ExistingFolder, create_run_folder, is_run_folder
from fgslam.runs.opening import open_sequence
from fgslam.runs.processes import WorkerEnded, run_apart
from fgslam.runs.settings import OutputSettings
from fgslam.runs.tasks.slam import run_experiment
from fgslam.runs.tasks.slam_checkpoint import LOG_FILE
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.runs.tasks.slam_measurements import open_measured, write_recording
from fgslam.runs.tasks.slam_outputs import write_config
from fgslam.runs.trial_results import TrialSummary, summarise, write_trials
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
class Trials:
    """All trials, and what follows from them."""

    name: str
    out: Path
    summary: TrialSummary
    failures: tuple[str, ...]


def run_trials(
    source: Path,
    seeds: Seeds,
    choice: Choice = EVERY,
    out: Path | None = None,
    existing: ExistingFolder = "refuse",
    jobs: int = 1,
    progress: Progress = lambda what, done, total: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Trials:
    """Runs the experiment with several seeds in a row and compares the estimators on each.

    Args:
        source: an experiment's .yaml, or the run folder of one.
        seeds: how many trials, from which seed on.
        choice: which estimators, and overrides of theirs and of the experiment.
        out: folder of the results; None: `trials` in the run folder, or `runs/NAME_trials`.
        existing: what to do where results are already.
        jobs: processes at a time, each with linear algebra on one thread.
        progress: told of each trial that is done.
        stopped: True ends the trials; those finished are kept.

    Raises:
        FgslamError: the experiment has one world of noise only, or cannot be run.
    """
    config = _experiment(source, choice.of_experiment)
    estimators = choose(config, choice.of_estimators)
    folder = out or _default_folder(source, config)
    _require_room(folder, source, existing)
    first = config.seed if seeds.first is None else seeds.first
    _prepare(config, progress)
    create_run_folder(folder, existing)
    chosen = config.model_copy(update={"compare": estimators})
    write_config(folder, chosen, {"trials": seeds.count, "first_seed": first})
    tasks = [TrialTask(config, first + k, estimators) for k in range(seeds.count)]
    trials, failures = _perform_all(tasks, jobs, progress, stopped)
    if not trials:
        raise OutputError(f"no trial was finished; {failures[0] if failures else 'interrupted'}")
    kinds = {settings.title: settings.kind for settings in estimators}
    summary = summarise([(t.seed, t.metrics, t.nees) for t in trials], kinds)
    write_trials(folder, config.name, summary, failures)
    return Trials(config.name, folder, summary, tuple(failures))


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
            run_experiment(config, run)
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


def _perform_all(
    tasks: Sequence[TrialTask], jobs: int, progress: Progress, stopped: Callable[[], bool]
) -> tuple[list[Trial], list[str]]:
    """Finished trials by seed, and a line for each that ended without a result."""
    trials, failures = [], []
    progress("trials", 0, len(tasks))
    for _, result in run_apart(perform_trial, tasks, jobs, stopped, single_threaded=True):
        if isinstance(result, WorkerEnded):
            failures.append(f"trial with seed {result.argument.seed}: {result.why}")
        else:
            trials.append(result)
        progress("trials", len(trials) + len(failures), len(tasks))
    return sorted(trials, key=lambda trial: trial.seed), sorted(failures)


def _experiment(source: Path, overrides: tuple[str, ...]) -> ExperimentConfig:
    """The configuration, if other seeds make other worlds of it."""
    config = load_config(source / RUN_MARKER if is_run_folder(source) else source, overrides)
    if not isinstance(config.dataset, RenderedLabSettings | SimulatedMeasurementsSettings):
        raise ConfigError(
            f"{source}: dataset.kind {config.dataset.kind} is a recording with one world of noise; "
            "--trials needs a rendered_lab or simulated_measurements data set"
        )
    return config


def _prepare(config: ExperimentConfig, progress: Progress) -> None:
    """Renders what is not in the cache once, before several processes would do so at a time."""
    if not config.on_measurements:
        open_sequence(config, lambda done, total: progress("rendering", done, total))


def _default_folder(source: Path, config: ExperimentConfig) -> Path:
    if is_run_folder(source):
        return source / DEFAULT_FOLDER
    return Path("runs") / f"{config.name}_{DEFAULT_FOLDER}"


def _require_room(folder: Path, source: Path, existing: ExistingFolder) -> None:
    if folder.resolve() in (source.resolve(), *source.resolve().parents):
        raise ConfigError(f"--out {folder}: holds the run itself; choose another folder")
    if existing == "refuse" and is_run_folder(folder):
        raise OutputError(f"{folder} holds results already; choose another --out, or --overwrite")
