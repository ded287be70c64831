"""`fgslam compare`: the logs of runs through other estimators, set side by side."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError, DatasetError, OutputError
from fgslam.evaluation.metrics import EstimatorMetrics, JsonValue
from fgslam.report.content import TextTable
from fgslam.report.tables import read_metrics, write_comparison_csv, write_metrics
from fgslam.runs.choosing import EVERY, Choice, choose
from fgslam.runs.comparison import (
    Compared,
    load_run,
    load_truth,
    remark_of,
    replay_apart,
    tasks_of,
)
from fgslam.runs.comparison_tables import ate_table, comparison_particulars, comparison_tables
from fgslam.runs.config import is_homing, load_homing
from fgslam.runs.config_models import Experiment, ExperimentConfig, HomingExperiment
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task, run_task
from fgslam.runs.folder import (
    COMPARISON_FILE,
    METRICS_FILE,
    RUN_MARKER,
    ExistingFolder,
    is_run_folder,
)
from fgslam.runs.homing_compare import open_homing_comparison
from fgslam.runs.homing_replay import load_bearing_logs
from fgslam.runs.report import report_from_folder
from fgslam.runs.units import Progress, Stopped

DEFAULT_FOLDER = "compare"


@dataclass(frozen=True, slots=True, eq=False)
class ComparedResult(RunResult):
    """How a comparison of SLAM ended; ``compared`` are its estimators."""

    compared: Compared = field(kw_only=True)


def compare_runs(
    runs: Sequence[Path],
    choice: Choice = EVERY,
    out: Path | None = None,
    existing: ExistingFolder = "refuse",
    jobs: int = 1,
    progress: Progress = lambda what, done, total: None,
    stopped: Stopped = lambda: False,
) -> list[RunResult]:
    """Replays the logs of runs through estimators: measurements of SLAM, or bearings of homing.

    Args:
        runs: run folders, of SLAM or of homing.
        choice: which estimators.
        out: folder of the results; of several runs each gets one below it, by its folder's name.
            None: `compare` inside each run.
        existing: what to do where results are already.
        jobs: processes at a time; more than one disturbs the times.
        progress: called after each estimator that is done.
        stopped: True ends the replays; what was finished is kept.

    Raises:
        FgslamError: a run cannot be read, a name is unknown, or the results cannot be written.
    """
    opener: Callable[[Path, Choice], tuple[Experiment, Task[RunResult]]]
    opener = _open_homing if _all_homing(runs) else _open_slam
    folders = _folders(runs, out)
    opened = [opener(run, choice) for run in runs]
    for run, folder in zip(runs, folders, strict=True):
        _require_apart(run, folder, existing)
    results = []
    for (config, task), folder in zip(opened, folders, strict=True):
        opener_now = functools.partial(_opened, task)
        results.append(run_task(opener_now, config, folder, existing, progress, stopped, jobs))
    compared = [one.compared for one in results if isinstance(one, ComparedResult)]
    if out is not None and len(compared) > 1:
        write_comparison_csv(out / COMPARISON_FILE, [(c.name, c.metrics) for c in compared])
    return results


def metrics_of(results: Sequence[RunResult]) -> dict[str, dict[str, Any]]:
    """Numbers of estimators, as metrics.json has them, by the run's name and their title."""
    return {result.config.name: result.metrics["estimators"] for result in results}


def ate_tables(results: Sequence[RunResult]) -> tuple[TextTable, ...]:
    """Final ATE of each estimator on each run, where there are several runs of SLAM."""
    compared = [one.compared for one in results if isinstance(one, ComparedResult)]
    return (ate_table(compared),) if len(compared) > 1 else ()


def _opened(task: Task[RunResult], config: Experiment, opening: Opening) -> Task[RunResult]:
    """A task whose run was read already."""
    return task


def write_comparison(
    out: Path,
    config: ExperimentConfig,
    frames: int,
    metrics: dict[str, EstimatorMetrics],
    about: dict[str, JsonValue],
    run: Path,
) -> None:
    """metrics.json, comparison.csv and report.html of results that are in ``out``."""
    write_metrics(out / METRICS_FILE, frames, metrics, about)
    write_comparison_csv(out / COMPARISON_FILE, [(config.name, metrics)])
    if config.output.report:
        report_from_folder(out, run)


# --------------------------------------------------------------------------------------------
# One run


def _open_slam(run: Path, choice: Choice) -> tuple[ExperimentConfig, Task[RunResult]]:
    """The comparison of a run; one that cannot be judged is refused before anything is written."""
    config, log = load_run(run)
    load_truth(run, log)
    estimators = choose(config, choice)
    provenance = {"dataset": (config.provenance or {}).get("dataset"), "run": str(run)}
    now = config.model_copy(update={"compare": estimators})

    def compared(context: Context) -> ComparedResult:
        return _compare(run, config, len(log), estimators, context)

    return now, Task(provenance, compared)


def _open_homing(run: Path, choice: Choice) -> tuple[HomingExperiment, Task[RunResult]]:
    config, logs = load_homing(run / RUN_MARKER), load_bearing_logs(run)
    first, *others = estimators = choose(config, choice)
    now = config.model_copy(update={"estimator": first, "compare": tuple(others)})
    return now, open_homing_comparison(config, logs, estimators, run)


def _compare(
    run: Path,
    config: ExperimentConfig,
    frames: int,
    estimators: Sequence[EstimatorSettings],
    context: Context,
) -> ComparedResult:
    """One run's log through the estimators."""
    out = context.folder
    metrics = replay_apart(tasks_of(config, run, out, estimators), context)
    status: Status = "interrupted" if context.stopped() else "finished"
    about: dict[str, JsonValue] = {
        "name": config.name,
        "status": status,
        "run": str(run),
        "odometry": config.odometry.kind,
        "remark": remark_of(config) or None,
        "notes": _notes(run),
    }
    write_comparison(out, config, frames, metrics, about, run)
    compared = Compared(config.name, run, out, frames, metrics)
    return ComparedResult(
        config,
        out,
        status,
        tables=comparison_tables(compared),
        particulars=comparison_particulars(compared),
        failed=len(compared.failures) == len(metrics),
        compared=compared,
    )


def _notes(run: Path) -> list[str]:
    """What was tolerated in the recording, as the run wrote it down."""
    path = run / METRICS_FILE
    notes = read_metrics(path).get("notes") if path.is_file() else None
    return [str(note) for note in notes or ()]


# --------------------------------------------------------------------------------------------
# Folders


def _all_homing(runs: Sequence[Path]) -> bool:
    """Whether all runs are of homing; False where none is.

    Raises:
        FgslamError: some are and some are not, or one is no run folder.
    """
    kinds = [is_run_folder(run) and is_homing(run / RUN_MARKER) for run in runs]
    if any(kinds) and not all(kinds):
        other = runs[kinds.index(False)]
        raise DatasetError(
            f"{other}: is no homing run, others are; compare homing runs by themselves"
        )
    return all(kinds)


def _require_apart(run: Path, folder: Path, existing: ExistingFolder) -> None:
    """A comparison may replace an earlier one, never the run that it is made from."""
    if folder.resolve() == run.resolve() or folder.resolve() in run.resolve().parents:
        raise ConfigError(f"--out {folder}: holds the run itself; choose another folder")
    if existing == "refuse" and is_run_folder(folder):
        raise OutputError(
            f"{folder} holds results already; choose another --out, or add --overwrite"
        )


def _folders(runs: Sequence[Path], out: Path | None) -> list[Path]:
    """Where the results of each run go."""
    if out is None:
        return [run / DEFAULT_FOLDER for run in runs]
    if len(runs) == 1:
        return [out]
    names = [run.resolve().name for run in runs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(
            f"two runs are called {twice[0]}; compare them without --out, or one by one"
        )
    return [out / name for name in names]
