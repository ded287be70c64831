"""Runs an experiment of any task: what `fgslam run` does."""

from __future__ import annotations

from collections.abc import Iterable
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


_OPENERS = {
    "localisation": "localisation.open_localisation",
    "homing_pairs": "homing_views.open_pairs",
    "topological_map": "homing_views.open_topological_map",
    "omni_video": "homing_drives.open_video",
    "teach": "routes.open_teaching",
    "follow": "routes.open_following",
    "join": "routes.open_joining",
    "homing_trials": "homing_replay.open_trials",
    "homing": "homing_drives.open_drives",
    "path_following": "homing_drives.open_drives",
    "crossroads": "homing_drives.open_drives",
}
"""Module and function that open each task; it is imported when it is run."""


def opener_of(config: Experiment, watch: Watch | None = None) -> Opener[RunResult]:
    """What opens the data of a configuration; each task is imported when it is run."""
    if isinstance(config, ExperimentConfig):
        if config.on_measurements:
            from fgslam.runs.tasks.slam_measurements import open_measurements_task

            return open_measurements_task
        from fgslam.runs.tasks.slam import open_slam

        return partial(open_slam, watch=watch)
    module, name = _OPENERS[config.task_name or ""].split(".")
    return getattr(import_module(f"fgslam.runs.tasks.{module}"), name)  # type: ignore[no-any-return]
