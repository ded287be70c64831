"""Runs an experiment of any task: what `fgslam run` does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from fgslam.core.files import require_output
from fgslam.runs.config import Experiment, ExperimentConfig
from fgslam.runs.engine import Opener, RunResult, run_task
from fgslam.runs.folder import ExistingFolder
from fgslam.runs.units import Progress, Stopped

if TYPE_CHECKING:
    from fgslam.runs.tasks.slam import Watch


def require_outputs(
    config: Experiment,
    folder: Path,
    existing: ExistingFolder,
    others: Iterable[Path | None] = (),
    source: Path | None = None,
) -> None:
    """The gate of what a run writes outside its folder.

    Args:
        config: the experiment, whose inputs are never replaced.
        folder: the run folder; what is in there is its own affair.
        existing: other files are replaced, unless it is `refuse`.
        others: files that are written next to those of the configuration.
        source: the experiment's file or the recording.

    Raises:
        OutputError: a file is there already, or is something else than a regular file.
    """
    inputs = (*config.inputs, *([] if source is None else [source]))
    for path in (*config.outputs, *(one for one in others if one is not None)):
        if path.parent.resolve() != folder.resolve():
            require_output(path, existing != "refuse", inputs)


def run_experiment(
    config: Experiment,
    folder: Path,
    existing: ExistingFolder = "refuse",
    progress: Progress = lambda what, done, total: None,
    stopped: Stopped = lambda: False,
    watch: Watch | None = None,
) -> RunResult:
    """Runs a configuration into a run folder.

    Args:
        config: the experiment, of any task.
        folder: the run folder itself.
        existing: what to do where it holds a run already.
        progress: called after each step of the work.
        stopped: asked after each step; True ends the run early, resumable, with all files valid.
        watch: called after each frame of SLAM on images; other tasks have nothing to watch.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    return run_task(opener_of(config, watch), config, folder, existing, progress, stopped)


_OPENERS: Mapping[str | None, Callable[[], Opener[RunResult]]] = {
    "localisation": lambda: import_module("fgslam.runs.tasks.localisation").open_localisation,
    "homing_pairs": lambda: import_module("fgslam.runs.tasks.homing_views").open_pairs,
    "topological_map": lambda: import_module("fgslam.runs.tasks.homing_views").open_topological_map,
    "omni_video": lambda: import_module("fgslam.runs.tasks.homing_drives").open_video,
    "teach": lambda: import_module("fgslam.runs.tasks.routes").open_teaching,
    "follow": lambda: import_module("fgslam.runs.tasks.routes").open_following,
    "join": lambda: import_module("fgslam.runs.tasks.routes").open_joining,
    "homing_trials": lambda: import_module("fgslam.runs.tasks.homing_replay").open_trials,
    "homing": lambda: import_module("fgslam.runs.tasks.homing_drives").open_drives,
    "path_following": lambda: import_module("fgslam.runs.tasks.homing_drives").open_drives,
    "crossroads": lambda: import_module("fgslam.runs.tasks.homing_drives").open_drives,
}
"""What gives the opener of each task; its module is imported when it is run."""


def opener_of(config: Experiment, watch: Watch | None = None) -> Opener[RunResult]:
    """What opens the data of a configuration; each task is imported when it is run."""
    if isinstance(config, ExperimentConfig):
        if config.on_measurements:
            from fgslam.runs.tasks.slam_measurements import open_measurements_task

            return open_measurements_task
        from fgslam.runs.tasks.slam import open_slam

        return partial(open_slam, watch=watch)
    return _OPENERS[config.task_name]()
