"""`fgslam compare`: the logs of runs through other estimators, set side by side.

How a log is replayed and judged: :mod:`fgslam.runs.slam_comparison`, and for homing
:mod:`fgslam.runs.tasks.homing_replay`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from fgslam.backend.settings import (
    ESTIMATORS,
    AverageLandmarkVectorSettings,
    EstimatorSettings,
    HomingEkfSettings,
    HomingGraphSettings,
    PaperEkfSettings,
    SnapshotSettings,
)
from fgslam.core.errors import ConfigError, DatasetError, OutputError
from fgslam.report.content import TextTable
from fgslam.runs.config import (
    Experiment,
    ExperimentConfig,
    HomingExperiment,
    as_task,
    load_experiment,
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
    return {kind: settings() for kind, settings in ESTIMATORS.items()}


def choose(config: Experiment, choice: Choice) -> tuple[Any, ...]:
    """Settings of the estimators of a comparison.

    Args:
        config: of the run whose log is replayed; of SLAM or of homing.
        choice: what the user asked for.

    Raises:
        ConfigError: an unknown name, or an override that is no key of that estimator.
    """
    known: dict[str, Any] = dict(
        HOMING_VARIANTS if isinstance(config, HomingExperiment) else all_kinds()
    )
    # One log has one noise model: what the configuration does not name weighs it as what it does.
    weights = [s.noise_factor for s in config.estimators if hasattr(s, "noise_factor")]
    for title, settings in known.items():
        if weights and hasattr(settings, "noise_factor"):
            known[title] = dataclasses.replace(settings, noise_factor=weights[0])
    own = {settings.title: settings for settings in config.estimators}
    known |= own
    if choice.names is not None:
        chosen = list(dict.fromkeys(name.strip() for name in choice.names if name.strip()))
    else:
        chosen = list(own if getattr(config, "compare", ()) else known)
    if isinstance(config, ExperimentConfig):
        slam = [known[title] for title in chosen if title in known]
        still = [one.title for one in slam if one not in judged_apart(config, slam)]
        if still and choice.names is not None:
            raise ConfigError(
                f"--estimators {still[0]}: the run had no odometry (odometry.kind "
                "constant_velocity), so dead reckoning has no motion to add up; leave it out"
            )
        chosen = [title for title in chosen if title not in still]
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen:
        what = f"no estimator {unknown[0]!r}" if unknown else "no estimator named"
        raise ConfigError(f"{what}; give --estimators with some of {', '.join(known)}")
    for override in choice.of_experiment:
        raise ConfigError(
            f"--set {override}: what was measured stays as it is; estimators.NAME.key=value with "
            f"NAME one of {', '.join(chosen)}, or --trials to run the experiment again"
        )
    overrides: dict[str, list[str]] = {title: [] for title in chosen}
    for override in map(str.strip, choice.overrides):
        addressed = [title for title in chosen if override.startswith(f"{_PREFIX}{title}.")]
        if not addressed:
            raise ConfigError(
                f"--set {override}: not of the form estimators.NAME.key=value with NAME one of "
                f"{', '.join(chosen)}"
            )
        for title in addressed:
            overrides[title].append(override)
    return tuple(_override(known[title], config, given) for title, given in overrides.items())


def _override(settings: Any, config: Experiment, overrides: Sequence[str]) -> Any:
    """Settings with their own overrides, checked as those of a configuration."""
    if not overrides:
        return settings
    values = config.model_copy(update={"estimator": settings}).as_values() | {"compare": []}
    before = len(_PREFIX) + len(settings.title)
    moved = [f"estimator{override[before:]}" for override in overrides]
    try:
        found = make_experiment(values, f"--set {overrides[0]}", moved).estimators[0]
    except ConfigError as error:  # which names keys of the configuration
        own = f"{_PREFIX}{settings.title}."
        raise ConfigError(str(error).replace("estimator.", own)) from None
    if found.kind != settings.kind:
        raise ConfigError(f"--set {overrides[0]}: the kind is what names it; use --estimators")
    return found


def with_estimators(config: Experiment, estimators: tuple[Any, ...]) -> Experiment:
    """The configuration with these estimators alone; of SLAM next to the one that steers."""
    if isinstance(config, ExperimentConfig):
        return config.model_copy(update={"compare": estimators})
    return config.model_copy(update={"estimator": estimators[0], "compare": estimators[1:]})


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
    configs = [_load_run(run) for run in runs]
    slam = [isinstance(config, ExperimentConfig) for config in configs]
    if len(set(slam)) > 1:
        raise DatasetError(
            f"{runs[slam.index(True)]}: is no homing run, others are; compare homing runs by "
            "themselves"
        )
    folders = _folders(runs, out)
    opened: list[tuple[Experiment, Task[RunResult]]] = []
    for run, config in zip(runs, configs, strict=True):
        # One that cannot be judged is refused before anything is written.
        estimators = choose(config, choice)
        if isinstance(config, ExperimentConfig):
            task = open_slam_comparison(config, run, estimators)
        else:
            from fgslam.runs.tasks.homing_replay import open_homing_comparison  # loads Plotly

            task = open_homing_comparison(config, run, estimators)
        opened.append((with_estimators(config, estimators), task))
    # No results replace earlier ones unasked, or the run that they are made from.
    for run, folder in zip(runs, folders, strict=True):
        if folder.resolve() in (run.resolve(), *run.resolve().parents):
            raise ConfigError(f"--out {folder}: holds the run itself; choose another folder")
        if existing == "refuse" and is_run_folder(folder):
            raise OutputError(
                f"{folder} holds results already; choose another --out, or add --overwrite or "
                "--resume"
            )
    several_resumed = existing == "resume" and len(runs) > 1
    for (now, task), folder in zip(opened, folders, strict=True):
        if several_resumed and is_run_folder(folder):  # no table shall mix estimators or logs
            require_same(now.resolved(), folder)
            require_same_ground(task.provenance, folder)
    results = []
    for (now, task), folder in zip(opened, folders, strict=True):
        if several_resumed and is_run_folder(folder) and is_finished(folder):
            result = RunResult(now, folder, "finished", (f"{folder}: had finished",))
            found = result.metrics["estimators"].values()
            failed = all(one.get("failure") for one in found)
            results.append(dataclasses.replace(result, failed=failed))
        else:
            opener = partial(lambda opened, *_: opened, task)  # it is open already
            begun = "refuse" if several_resumed and not is_run_folder(folder) else existing
            results.append(run_task(opener, now, folder, begun, progress, stopped, jobs))
    if out is not None and len(runs) > 1 and slam[0]:
        names = _distinct([one.config.name for one in results], results)
        write_comparison_csv(
            out / COMPARISON_FILE, list(zip(names, map(_values_of, results), strict=True))
        )
    return results


def ate_tables(results: Sequence[RunResult]) -> tuple[TextTable, ...]:
    """Final ATE of each estimator on each run, where there are several runs of SLAM."""
    configs = [one.config for one in results if isinstance(one.config, ExperimentConfig)]
    if len(configs) < 2:
        return ()
    names = _distinct(list(map(named, configs)), results)
    return (ate_table(list(zip(names, map(_values_of, results), strict=True))),)


def _values_of(result: RunResult) -> dict[str, Any]:
    """The numbers of a run of SLAM."""
    return with_odometry(result.config, result.metrics["estimators"])  # type: ignore[arg-type]


def _distinct(names: Sequence[str], results: Sequence[RunResult]) -> list[str]:
    """The runs' names; those that several have, as runs of one recording do, with the folder."""
    folders = [r.folder.parent if r.folder.name == DEFAULT_FOLDER else r.folder for r in results]
    return [
        name if names.count(name) == 1 else f"{name}, {folder}"
        for name, folder in zip(names, folders, strict=True)
    ]


def _load_run(run: Path) -> ExperimentConfig | HomingExperiment:
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
    config = load_experiment(path)
    if isinstance(config, HomingExperiment):
        return config
    return as_task(ExperimentConfig, config, str(path))


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
