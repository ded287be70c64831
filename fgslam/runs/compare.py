"""`fgslam compare`: run folders in, tables and pages out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError, OutputError
from fgslam.evaluation.metrics import EstimatorMetrics, JsonValue
from fgslam.report.comparison_table import write_comparison_csv
from fgslam.report.metrics import read_metrics, write_metrics
from fgslam.runs.choosing import EVERY, Choice, choose
from fgslam.runs.comparison import (
    COMPARISON_FILE,
    Compared,
    Progress,
    load_run,
    load_truth,
    remark_of,
    replay_apart,
    tasks_of,
)
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.folder import ExistingFolder, create_run_folder, is_run_folder
from fgslam.runs.report import report_from_folder
from fgslam.runs.tasks.slam_outputs import write_config

DEFAULT_FOLDER = "compare"
METRICS_FILE = "metrics.json"


def compare_runs(
    runs: Sequence[Path],
    choice: Choice = EVERY,
    out: Path | None = None,
    existing: ExistingFolder = "refuse",
    jobs: int = 1,
    progress: Progress = lambda what, done, total: None,
    stopped: Callable[[], bool] = lambda: False,
) -> list[Compared]:
    """Replays the logs of runs through estimators.

    Args:
        runs: run folders.
        choice: which estimators.
        out: folder of the results; of several runs each gets one below it, by its folder's name.
            None: `compare` inside each run.
        existing: what to do where results are already.
        jobs: processes at a time; more than one disturbs the times.
        progress: told of each estimator that is done.
        stopped: True ends the replays; what was finished is kept.

    Raises:
        FgslamError: a run cannot be read, a name is unknown, or the results cannot be written.
    """
    folders = _folders(runs, out)
    chosen = [_estimators_for(run, choice) for run in runs]
    compared = []
    for run, folder in zip(runs, folders, strict=True):
        _require_apart(run, folder, existing)
    for run, folder, estimators in zip(runs, folders, chosen, strict=True):
        create_run_folder(folder, existing)
        compared.append(compare_run(run, estimators, folder, jobs, progress, stopped))
    if out is not None and len(runs) > 1:
        write_comparison_csv(out / COMPARISON_FILE, [(c.name, c.metrics) for c in compared])
    return compared


def compare_run(
    run: Path,
    estimators: Sequence[EstimatorSettings],
    out: Path,
    jobs: int = 1,
    progress: Progress = lambda what, done, total: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Compared:
    """One run's log through the estimators, into the existing folder ``out``."""
    config, log = load_run(run)
    dataset = (config.provenance or {}).get("dataset")
    now_compared = config.model_copy(update={"compare": tuple(estimators)})
    write_config(out, now_compared, {"dataset": dataset, "run": str(run)})
    metrics = replay_apart(tasks_of(config, run, out, estimators), jobs, progress, stopped)
    interrupted = stopped()
    about: dict[str, JsonValue] = {
        "name": config.name,
        "status": "interrupted" if interrupted else "finished",
        "run": str(run),
        "odometry": config.odometry.kind,
        "remark": remark_of(config) or None,
        "notes": _notes(run),
    }
    write_comparison(out, config, len(log), metrics, about, run)
    return Compared(config.name, run, out, len(log), metrics)


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


def _estimators_for(run: Path, choice: Choice) -> tuple[EstimatorSettings, ...]:
    """What is to be replayed; a run that cannot be judged is told before anything is written."""
    config, log = load_run(run)
    load_truth(run, log)
    return choose(config, choice)


def _notes(run: Path) -> list[str]:
    """What was tolerated in the recording, as the run wrote it down."""
    path = run / METRICS_FILE
    notes = read_metrics(path).get("notes") if path.is_file() else None
    return [str(note) for note in notes or ()]


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
