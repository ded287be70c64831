"""`fgslam compare`: the logs of runs through other estimators, set side by side.

What a replay is, how it is judged and which tables come of it, is the matter of
:mod:`fgslam.runs.slam_comparison` and :mod:`fgslam.runs.homing_comparison`.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from fgslam.backend.homing.settings import (
    AverageLandmarkVectorSettings,
    HomingEkfSettings,
    HomingGraphSettings,
    PaperEkfSettings,
    SnapshotSettings,
)
from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError, DatasetError, OutputError
from fgslam.report.content import TextTable
from fgslam.runs.config import (
    Experiment,
    ExperimentConfig,
    HomingExperiment,
    is_homing,
    load_config,
    load_homing,
    make_experiment,
)
from fgslam.runs.engine import (
    RunResult,
    Task,
    is_finished,
    require_same,
    require_same_ground,
    run_task,
)
from fgslam.runs.folder import COMPARISON_FILE, RUN_MARKER, ExistingFolder, is_run_folder
from fgslam.runs.slam_comparison import (
    judged_apart,
    named,
    open_slam_comparison,
    with_odometry,
)
from fgslam.runs.tables import ate_table, write_comparison_csv
from fgslam.runs.tasks.homing_replay import open_homing_comparison
from fgslam.runs.units import Progress, Stopped

DEFAULT_FOLDER = "compare"

# --------------------------------------------------------------------------------------------
# Which estimators

_PREFIX = "estimators."

HOMING_VARIANTS = {
    settings.title: settings
    for settings in (
        HomingGraphSettings(),
        HomingGraphSettings(label="graph_batch", solver="batch"),
        HomingEkfSettings(),
        PaperEkfSettings(),
        PaperEkfSettings(label="paper_ekf_gated", gate_sigmas=3.0),
        AverageLandmarkVectorSettings(),
        SnapshotSettings(),
    )
}
"""Homing estimators that can be named without a configuration: kinds, solvers, the paper's."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What the user asked for.

    Attributes:
        names: titles of the configuration's estimators, or kinds; None: those of the configuration
            where it compares any, else every kind.
        overrides: `estimators.TITLE.key=value` of an estimator, `key=value` of the experiment.
    """

    names: tuple[str, ...] | None = None
    overrides: tuple[str, ...] = ()

    @property
    def of_experiment(self) -> tuple[str, ...]:
        """Overrides of the experiment's own keys."""
        return tuple(o for o in self.overrides if not o.strip().startswith(_PREFIX))

    @property
    def of_estimators(self) -> Choice:
        """The same without the overrides of the experiment's own keys."""
        own = set(self.of_experiment)
        return Choice(self.names, tuple(o for o in self.overrides if o not in own))


EVERY = Choice()


def all_kinds() -> dict[str, EstimatorSettings]:
    """Every kind of SLAM estimator with its defaults, by kind."""
    union = typing.get_args(EstimatorSettings)[0]
    return {settings.kind: settings() for settings in typing.get_args(union)}


def choose(config: Experiment, choice: Choice) -> tuple[Any, ...]:
    """Settings of the estimators of a comparison.

    Args:
        config: of the run whose log is replayed; of SLAM or of homing.
        choice: what the user asked for.

    Raises:
        ConfigError: an unknown name, or an override that is no key of that estimator.
    """
    variants: dict[str, Any] = dict(
        HOMING_VARIANTS if isinstance(config, HomingExperiment) else all_kinds()
    )
    variants = _of_one_noise(variants, config)
    known = variants | {settings.title: settings for settings in config.estimators}
    if choice.names is None:
        own = [settings.title for settings in config.estimators]
        chosen = own if getattr(config, "compare", ()) else list(known)
    else:
        chosen = list(dict.fromkeys(name.strip() for name in choice.names if name.strip()))
    chosen = _with_motion(config, choice, chosen, known)
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen:
        what = f"no estimator {unknown[0]!r}" if unknown else "no estimator named"
        raise ConfigError(f"{what}; give --estimators with some of {', '.join(known)}")
    for override in choice.of_experiment:
        raise ConfigError(
            f"--set {override}: what was measured stays as it is; estimators.NAME.key=value with "
            f"NAME one of {', '.join(chosen)}, or --trials to run the experiment again"
        )
    for override in choice.overrides:
        if not any(_addresses(override, title) for title in chosen):
            raise ConfigError(
                f"--set {override}: not of the form estimators.NAME.key=value with NAME one of "
                f"{', '.join(chosen)}"
            )
    return tuple(_with(known[title], config, choice.overrides) for title in chosen)


def _with_motion(
    config: Experiment, choice: Choice, chosen: list[str], known: dict[str, Any]
) -> list[str]:
    """The titles without dead reckoning where there was no odometry.

    Raises ConfigError where it is asked for by name.
    """
    if not isinstance(config, ExperimentConfig):
        return chosen
    slam = [known[title] for title in chosen if title in known]
    kept = judged_apart(config, slam)
    left_out = [one.title for one in slam if one not in kept]
    if left_out and choice.names is not None:
        raise ConfigError(
            f"--estimators {left_out[0]}: the run had no odometry (odometry.kind constant_velocity)"
            ", so dead reckoning has no motion to add up; leave it out"
        )
    return [title for title in chosen if title not in left_out]


def _of_one_noise(variants: dict[str, Any], config: Experiment) -> dict[str, Any]:
    """Estimators that the configuration does not name, with the noise model of those that it does.

    Else a graph that weighs a log as its configuration says would be set beside one that does not.
    """
    stated = [s.noise_factor for s in config.estimators if hasattr(s, "noise_factor")]
    if not stated:
        return variants
    return {
        title: dataclasses.replace(settings, noise_factor=stated[0])
        if hasattr(settings, "noise_factor")
        else settings
        for title, settings in variants.items()
    }


def _addresses(override: str, title: str) -> bool:
    return override.strip().startswith(f"{_PREFIX}{title}.")


def _with(settings: Any, config: Experiment, overrides: tuple[str, ...]) -> Any:
    """Settings with their own overrides, checked as those of a configuration."""
    title = settings.title
    own = [o.strip() for o in overrides if _addresses(o, title)]
    if not own:
        return settings
    values = config.model_copy(update={"estimator": settings}).as_values() | {"compare": []}
    moved = [f"estimator{override[len(_PREFIX) + len(title) :]}" for override in own]
    found = make_experiment(values, f"--set {own[0]}", moved).estimators[0]
    if found.kind != settings.kind:
        raise ConfigError(f"--set {own[0]}: the kind is what names it; use --estimators")
    return found


# --------------------------------------------------------------------------------------------
# Logs of runs through them


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
            comparison left: of several runs those that had finished with these estimators on these
            logs are left as they are, and those that were not begun are.
        jobs: processes at a time; more than one disturbs the times.
        progress: called after each estimator that is done.
        stopped: True ends the replays; what was finished is kept.

    Raises:
        FgslamError: a run cannot be read, a name is unknown, what was begun is of other estimators
            or of another log, or the results cannot be written.
    """
    configs = [load_run(run) for run in runs]
    _require_one_kind(runs, configs)
    folders = _folders(runs, out)
    opened = [_open(*run, choice) for run in zip(runs, configs, strict=True)]
    for run, folder in zip(runs, folders, strict=True):
        require_room(folder, run, existing)
    several_resumed = existing == "resume" and len(runs) > 1
    if several_resumed:
        for (config, task), folder in zip(opened, folders, strict=True):
            _require_same_where_begun(config, task, folder)
    results = []
    for (config, task), folder in zip(opened, folders, strict=True):
        begun = existing
        if several_resumed:
            begun = "resume" if is_run_folder(folder) else "refuse"
            if begun == "resume" and is_finished(folder):
                results.append(_had_finished(config, folder))
                continue
        results.append(
            run_task(partial(_opened, task), config, folder, begun, progress, stopped, jobs)
        )
    if out is not None and len(_of_slam(results)) > 1:
        write_comparison_csv(out / COMPARISON_FILE, _of_slam(results))
    return results


def ate_tables(results: Sequence[RunResult]) -> tuple[TextTable, ...]:
    """Final ATE of each estimator on each run, where there are several runs of SLAM."""
    slam = [one for one in results if isinstance(one.config, ExperimentConfig)]
    names = _told_apart([named(one.config) for one in slam], slam)  # type: ignore[arg-type]
    found = [values for _, values in _of_slam(results)]
    return (ate_table(list(zip(names, found, strict=True))),) if len(found) > 1 else ()


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


def _require_same_where_begun(config: Experiment, task: Task[RunResult], folder: Path) -> None:
    """Raises before anything is done where a table would mix estimators, logs or versions."""
    if is_run_folder(folder):
        require_same(config.resolved(), folder)
        require_same_ground(task.provenance, folder)


def _had_finished(config: Experiment, folder: Path) -> RunResult:
    """What an earlier session has finished, as it stands."""
    result = RunResult(config, folder, "finished", (f"{folder}: had finished",))
    found = result.metrics["estimators"].values()
    return dataclasses.replace(result, failed=all(one.get("failure") for one in found))


def _opened(task: Task[RunResult], *_: object) -> Task[RunResult]:
    """A task whose run was read already."""
    return task


def _of_slam(results: Sequence[RunResult]) -> list[tuple[str, dict[str, Any]]]:
    """Name and numbers of each run, where they are of SLAM."""
    slam = [one for one in results if isinstance(one.config, ExperimentConfig)]
    names = _told_apart([one.config.name for one in slam], slam)
    return [
        (name, with_odometry(one.config, one.metrics["estimators"]))  # type: ignore[arg-type]
        for name, one in zip(names, slam, strict=True)
    ]


def _told_apart(names: Sequence[str], results: Sequence[RunResult]) -> list[str]:
    """The runs' names; those that several have, as runs of one recording do, with the folder."""
    folders = [r.folder.parent if r.folder.name == DEFAULT_FOLDER else r.folder for r in results]
    return [
        name if names.count(name) == 1 else f"{name}, {folder}"
        for name, folder in zip(names, folders, strict=True)
    ]


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
