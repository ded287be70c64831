"""`fgslam compare`: the logs of runs through other estimators, set side by side.

What a replay is, how it is judged and which tables come of it, is the matter of
:mod:`fgslam.runs.slam_comparison` and :mod:`fgslam.runs.homing_comparison`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from fgslam.core.errors import ConfigError, DatasetError, OutputError
from fgslam.report.content import TextTable
from fgslam.report.tables import write_comparison_csv
from fgslam.runs.choosing import EVERY, Choice, choose
from fgslam.runs.config import is_homing, load_config, load_homing
from fgslam.runs.config_models import Experiment, ExperimentConfig, HomingExperiment
from fgslam.runs.engine import RunResult, Task, is_finished, run_task
from fgslam.runs.folder import COMPARISON_FILE, RUN_MARKER, ExistingFolder, is_run_folder
from fgslam.runs.homing_comparison import open_homing_comparison
from fgslam.runs.metric_tables import ate_table
from fgslam.runs.slam_comparison import open_slam_comparison
from fgslam.runs.units import Progress, Stopped

DEFAULT_FOLDER = "compare"


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
        runs: run folders, all of SLAM or all of homing.
        choice: which estimators.
        out: folder of the results; of several runs each gets one below it, by its folder's name.
            None: `compare` inside each run.
        existing: what to do where results are already. `resume` goes on with what an interrupted
            comparison left: of several runs those that had finished are left as they are, and
            those that were not begun are.
        jobs: processes at a time; more than one disturbs the times.
        progress: called after each estimator that is done.
        stopped: True ends the replays; what was finished is kept.

    Raises:
        FgslamError: a run cannot be read, a name is unknown, or the results cannot be written.
    """
    configs = [load_run(run) for run in runs]
    _require_one_kind(runs, configs)
    folders = _folders(runs, out)
    opened = [_open(*run, choice) for run in zip(runs, configs, strict=True)]
    for run, folder in zip(runs, folders, strict=True):
        require_room(folder, run, existing)
    results = []
    for (config, task), folder in zip(opened, folders, strict=True):
        begun = existing
        if existing == "resume" and len(runs) > 1:
            if is_finished(folder):
                results.append(RunResult(config, folder, "finished", (f"{folder}: had finished",)))
                continue
            begun = "resume" if is_run_folder(folder) else "refuse"
        results.append(
            run_task(partial(_opened, task), config, folder, begun, progress, stopped, jobs)
        )
    if out is not None and len(_of_slam(results)) > 1:
        write_comparison_csv(out / COMPARISON_FILE, _of_slam(results))
    return results


def metrics_of(results: Sequence[RunResult]) -> dict[str, dict[str, Any]]:
    """Numbers of estimators, as metrics.json has them, by the run's name and their title."""
    return {result.config.name: result.metrics["estimators"] for result in results}


def ate_tables(results: Sequence[RunResult]) -> tuple[TextTable, ...]:
    """Final ATE of each estimator on each run, where there are several runs of SLAM."""
    found = _of_slam(results)
    return (ate_table(found),) if len(found) > 1 else ()


def load_run(run: Path) -> ExperimentConfig | HomingExperiment:
    """Configuration of a run folder.

    Raises:
        DatasetError: it is none.
        ConfigError: its configuration cannot be read, or it is of a task without estimators.
    """
    if not is_run_folder(run):
        what = f"not a run folder (no {RUN_MARKER}); give what fgslam run wrote"
        if run.is_file():
            what = "not a run folder; give it to fgslam run first, or add --trials N"
        raise DatasetError(f"{run}: {what}")
    path = run / RUN_MARKER
    return load_homing(path) if is_homing(path) else load_config(path)


def require_room(folder: Path, run: Path, existing: ExistingFolder) -> None:
    """Raises where results would replace earlier ones unasked, or the run they are made from."""
    if folder.resolve() in (run.resolve(), *run.resolve().parents):
        raise ConfigError(f"--out {folder}: holds the run itself; choose another folder")
    if existing == "refuse" and is_run_folder(folder):
        raise OutputError(
            f"{folder} holds results already; choose another --out, or add --overwrite or --resume"
        )


def _open(
    run: Path, config: ExperimentConfig | HomingExperiment, choice: Choice
) -> tuple[Experiment, Task[RunResult]]:
    """The comparison of a run; one that cannot be judged is refused before anything is written."""
    estimators = choose(config, choice)
    if isinstance(config, ExperimentConfig):
        now = config.model_copy(update={"compare": estimators})
        return now, open_slam_comparison(config, run, estimators)
    first, *others = estimators
    chosen = config.model_copy(update={"estimator": first, "compare": tuple(others)})
    return chosen, open_homing_comparison(config, run, estimators)


def _opened(task: Task[RunResult], *_: object) -> Task[RunResult]:
    """A task whose run was read already."""
    return task


def _of_slam(results: Sequence[RunResult]) -> list[tuple[str, dict[str, Any]]]:
    """Name and numbers of each run, where they are of SLAM."""
    slam = [one for one in results if isinstance(one.config, ExperimentConfig)]
    return [(one.config.name, one.metrics["estimators"]) for one in slam]


def _require_one_kind(runs: Sequence[Path], configs: Sequence[Experiment]) -> None:
    homing = [isinstance(config, HomingExperiment) for config in configs]
    if any(homing) and not all(homing):
        raise DatasetError(
            f"{runs[homing.index(False)]}: is no homing run, others are; compare homing runs by "
            "themselves"
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
