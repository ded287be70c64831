"""Task `localisation`: a map is made or loaded, and a recording's frames are sought in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from fgslam.core.errors import ConfigError, OutputError
from fgslam.core.recordings import Sequence
from fgslam.core.saved_map import require_rig
from fgslam.core.threads import one_blas_thread
from fgslam.runs.config_models import LocalisationConfig
from fgslam.runs.folder import ExistingFolder, create_run_folder, is_run_folder
from fgslam.runs.opening import open_sequence
from fgslam.runs.tasks.localisation_files import write_results
from fgslam.runs.tasks.localisation_queries import Progress, ask_all, nothing_asked
from fgslam.runs.tasks.localisation_results import LocalisationResult, result_of
from fgslam.runs.tasks.slam import run_experiment
from fgslam.runs.tasks.slam_map_entry import FIRST_FOLDER, MAP_FILE, GivenMap, open_map
from fgslam.runs.tasks.slam_mapping import first_config
from fgslam.runs.tasks.slam_outputs import write_config


@one_blas_thread()
def run_localisation(
    config: LocalisationConfig,
    folder: Path,
    existing: ExistingFolder = "refuse",
    progress: Progress = lambda what, done, total: None,
    stopped: Callable[[], bool] = lambda: False,
) -> LocalisationResult:
    """Runs a localisation experiment into a run folder.

    Args:
        config: the experiment.
        folder: the run folder itself; a map that is made first is in its folder `first`.
        existing: what to do where it holds a run already; such runs cannot be resumed.
        progress: told after each step.
        stopped: asked after each step; True ends the run early, with all files valid.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    if existing == "resume":
        raise ConfigError(
            f"--resume: task {config.task} cannot be resumed; run it again with --overwrite"
        )
    if existing == "refuse" and is_run_folder(folder):  # now, not after minutes of work
        raise OutputError(f"{folder} holds a run already; choose another --out, or add --overwrite")
    given = None if config.map.load is None else open_map(Path(config.map.load))
    sequence = open_queries(config, progress)
    if given is not None:
        require_rig(given.saved, sequence.rig, str(given.path))
    create_run_folder(folder, existing)
    write_run_config(config, folder, given, sequence)
    if given is None:
        given = _make_map(config, folder, progress, stopped)
    if given is None:
        return result_of(config, folder, nothing_asked("the map was not finished"), sequence.notes)
    write_run_config(config, folder, given, sequence)
    result = answer(config, folder, given, sequence, progress, stopped)
    subtitle = f"{sequence.name}, in a map of {len(result.asked.landmarks)} landmarks"
    write_results(result, given, subtitle)
    return result


def open_queries(config: LocalisationConfig, progress: Progress) -> Sequence:
    """Opens the recording whose frames are sought. Raises FgslamError."""
    return open_sequence(
        config.as_experiment(), lambda done, total: progress("rendering", done, total)
    )


def answer(
    config: LocalisationConfig,
    folder: Path | None,
    given: GivenMap,
    sequence: Sequence,
    progress: Progress,
    stopped: Callable[[], bool],
) -> LocalisationResult:
    """Asks the map and judges its answers; writes nothing."""
    asked = ask_all(config, given, sequence, progress, stopped)
    return result_of(config, folder, asked, sequence.notes)


def _make_map(
    config: LocalisationConfig, folder: Path, progress: Progress, stopped: Callable[[], bool]
) -> GivenMap | None:
    """Drives the first drive and opens its map; None where it was ended early."""
    first = folder / FIRST_FOLDER
    drive = first_config(config.as_experiment(), first)
    if drive is None:
        raise ConfigError("map needs either load or made_from; give one of them")
    result = run_experiment(drive, first, "overwrite", progress, stopped)
    return open_map(first / MAP_FILE) if result.status == "finished" else None


def write_run_config(
    config: LocalisationConfig, folder: Path, given: GivenMap | None, sequence: Sequence
) -> None:
    """The resolved configuration with what it takes to repeat the run."""
    provenance: dict[str, Any] = {"dataset": {"name": sequence.name, "identity": sequence.identity}}
    if given is not None:
        provenance["map"] = {"path": str(given.path), "sha256": given.identity}
    write_config(folder, config, provenance)
