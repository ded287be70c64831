"""Task `localisation`: a map is made or loaded, and a recording's frames are sought in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fgslam.core.recordings import Sequence
from fgslam.core.saved_map import require_rig
from fgslam.runs.config_models import LocalisationConfig
from fgslam.runs.engine import Context, Opening, Task
from fgslam.runs.folder import write_config
from fgslam.runs.opening import open_sequence
from fgslam.runs.tasks.localisation_files import write_results
from fgslam.runs.tasks.localisation_queries import ask_all, nothing_asked
from fgslam.runs.tasks.localisation_results import LocalisationResult, result_of
from fgslam.runs.tasks.slam import drive_first
from fgslam.runs.tasks.slam_map_entry import FIRST_FOLDER, MAP_FILE, GivenMap, open_map
from fgslam.runs.units import Progress


def open_localisation(config: LocalisationConfig, opening: Opening) -> Task[LocalisationResult]:
    """Opens the recording, and the map where it is there already. Raises FgslamError."""
    given = None if config.map.load is None else open_map(Path(config.map.load))
    sequence = open_queries(config, opening.progress)
    if given is not None:
        require_rig(given.saved, sequence.rig, str(given.path))
    provenance = provenance_of(given, sequence)
    return Task(provenance, lambda context: _run(config, given, sequence, context))


def _run(
    config: LocalisationConfig, given: GivenMap | None, sequence: Sequence, context: Context
) -> LocalisationResult:
    """The drive that makes the map, where the run asks for one, and all queries."""
    folder = context.folder
    if given is None:
        ended = drive_first(config.as_experiment(), context)
        if ended is not None and ended.status == "interrupted":
            nothing = nothing_asked("the map was not finished")
            return result_of(config, folder, nothing, sequence.notes)
        given = open_map(folder / FIRST_FOLDER / MAP_FILE)
        write_config(folder, config, provenance_of(given, sequence))
    asked = ask_all(config, given, sequence, context)
    result = result_of(config, folder, asked, sequence.notes)
    subtitle = f"{sequence.name}, in a map of {len(asked.landmarks)} landmarks"
    write_results(result, given, subtitle)
    return result


def open_queries(config: LocalisationConfig, progress: Progress) -> Sequence:
    """Opens the recording whose frames are sought. Raises FgslamError."""
    return open_sequence(
        config.as_experiment(), lambda done, total: progress("rendering", done, total)
    )


def provenance_of(given: GivenMap | None, sequence: Sequence) -> dict[str, Any]:
    """What it takes to repeat the run, beside its configuration."""
    provenance: dict[str, Any] = {"dataset": {"name": sequence.name, "identity": sequence.identity}}
    if given is not None:
        provenance["map"] = {"path": str(given.path), "sha256": given.identity}
    return provenance
