"""Homing experiments: each task to its own module."""

from __future__ import annotations

from pathlib import Path

from fgslam.core.errors import ConfigError, OutputError
from fgslam.core.threads import one_blas_thread
from fgslam.runs.config_models import (
    HomingConfig,
    HomingExperiment,
    HomingPairsConfig,
    HomingTrialsConfig,
    OmniVideoConfig,
    PathFollowingConfig,
    TopologicalMapConfig,
)
from fgslam.runs.folder import ExistingFolder, is_run_folder
from fgslam.runs.homing_results import HomingResult, Progress, Stopped
from fgslam.runs.tasks.homing_drives import run_driving, with_one_leg
from fgslam.runs.tasks.homing_house import open_house_drive
from fgslam.runs.tasks.homing_map import run_topological_map
from fgslam.runs.tasks.homing_pairs import run_homing_pairs
from fgslam.runs.tasks.homing_trials import run_homing_trials
from fgslam.runs.tasks.homing_video import run_omni_video


@one_blas_thread()
def run_homing(
    config: HomingExperiment,
    folder: Path,
    existing: ExistingFolder = "refuse",
    progress: Progress = lambda what, done, total: None,
    stopped: Stopped = lambda: False,
) -> HomingResult:
    """Runs a homing experiment into a run folder.

    Args:
        config: the experiment, of any task.
        folder: the run folder itself.
        existing: what to do where it holds a run already; homing runs cannot be resumed.
        progress: told of each step of the work.
        stopped: asked after each step; True ends the run early, with all files valid.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    if existing == "resume":
        raise ConfigError(
            f"--resume: a homing experiment (task {config.task}) cannot be resumed; run it again "
            "with --overwrite"
        )
    if existing == "refuse" and is_run_folder(folder):  # now, not after minutes of work
        raise OutputError(f"{folder} holds a run already; choose another --out, or add --overwrite")
    match config:
        case HomingPairsConfig():
            return run_homing_pairs(config, folder, existing, progress, stopped)
        case TopologicalMapConfig():
            return run_topological_map(config, folder, existing, progress, stopped)
        case OmniVideoConfig():
            return run_omni_video(config, folder, existing, progress, stopped)
        case HomingTrialsConfig():
            return run_homing_trials(config, folder, existing, progress, stopped)
        case HomingConfig():
            one = with_one_leg(config)
            return run_driving(one, folder, existing, progress, stopped, open_house_drive)
        case PathFollowingConfig():
            return run_driving(config, folder, existing, progress, stopped, open_house_drive)
    raise ConfigError(f"task {config.task}: cannot be run")
