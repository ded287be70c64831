"""`fgslam localize MAP RECORDING`: where in the map were these frames taken?"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fgslam.core.errors import ConfigError, FgslamError, OutputError
from fgslam.core.recordings import Sequence as Recording
from fgslam.core.saved_map import SavedMap, require_rig
from fgslam.core.threads import one_blas_thread
from fgslam.datasets.layouts import recognise_layout
from fgslam.runs.config import (
    ExperimentConfig,
    as_task,
    load_config,
    load_experiment,
    make_experiment,
)
from fgslam.runs.config_models import LocalisationConfig
from fgslam.runs.engine import Context
from fgslam.runs.folder import ExistingFolder, create_run_folder, is_run_folder, write_config
from fgslam.runs.tasks.localisation import open_queries, provenance_of
from fgslam.runs.tasks.localisation_files import write_results
from fgslam.runs.tasks.localisation_queries import ask_all
from fgslam.runs.tasks.localisation_results import (
    LocalisationResult,
    answer_line,
    details,
    result_of,
)
from fgslam.runs.tasks.slam_map_entry import GivenMap, open_map
from fgslam.runs.units import Progress, UnitStore

_YAML = (".yaml", ".yml")
_NAME_WIDTH = 18


@dataclasses.dataclass(frozen=True, slots=True)
class Wanted:
    """What is asked.

    Attributes:
        map_file: the saved map.
        recording: a recording's folder, or an experiment's .yaml for its data set.
        overrides: ``a.b=value`` of the experiment.
        frame: number of the one frame to locate; None: all of them, one by one.
        frames: of a query: 1, or a short submap of so many.
        out: folder of the results; None: none are written.
        existing: what to do where it holds a run already.
    """

    map_file: Path
    recording: Path
    overrides: tuple[str, ...] = ()
    frame: int | None = None
    frames: int = 1
    out: Path | None = None
    existing: ExistingFolder = "refuse"


@one_blas_thread()
def localize(wanted: Wanted, progress: Progress, stopped: Callable[[], bool]) -> LocalisationResult:
    """Locates frames of a recording in a map without any prior.

    Raises:
        FgslamError: map, recording, frame or configuration cannot be used.
    """
    out = wanted.out
    if out is not None and wanted.existing == "refuse" and is_run_folder(out):
        raise OutputError(f"{out} holds a run already; choose another --out, or add --overwrite")
    given = open_map(wanted.map_file)
    config = _config(wanted, given.saved)
    sequence = _open(wanted, config, progress)
    require_rig(given.saved, sequence.rig, str(given.path))
    if out is not None:
        create_run_folder(out, wanted.existing)
        write_config(out, config, provenance_of(given, sequence))
    context = Context(out or Path(), False, UnitStore(None), 1, progress, stopped)
    asked = ask_all(config, given, sequence, context)
    result = result_of(config, out, asked, sequence.notes)
    notes = (*_other_eyes(config, given), *result.notes)
    result = dataclasses.replace(result, notes=notes)
    write_results(result, given, f"{sequence.name}, in the map {given.path}")
    return _one_by_one(result)


def _one_by_one(result: LocalisationResult) -> LocalisationResult:
    """The result with a line for each query, or with a single one in full."""
    attempts = result.asked.attempts
    if len(attempts) == 1:
        lines = tuple(f"{name:<{_NAME_WIDTH}}{value}" for name, value in details(attempts[0]))
        return dataclasses.replace(result, lines=lines, tables=())
    lines = tuple(answer_line(attempt) for attempt in attempts)
    return dataclasses.replace(result, lines=(*lines, *result.lines))


def _config(wanted: Wanted, saved: SavedMap) -> LocalisationConfig:
    """The experiment's settings for queries in this map; of a folder those that made the map."""
    where = str(wanted.recording)
    if wanted.recording.suffix.lower() in _YAML:
        given = load_experiment(wanted.recording, wanted.overrides)
        if not isinstance(given, ExperimentConfig | LocalisationConfig):
            load_config(wanted.recording)  # says which task this cannot do
            raise ConfigError(f"{where}: holds no recording of stereo images; give another")
        values = given.as_values()
        overrides: tuple[str, ...] = ()
    else:
        values = {
            "name": "localize",
            "dataset": recognise_layout(wanted.recording),
            "odometry": {"kind": "recorded"},
            "frontend": settings_of_map(saved).get("frontend", {}),
        }
        overrides = wanted.overrides
    known = LocalisationConfig.model_fields
    kept = {name: value for name, value in values.items() if name in known}
    queries = {**kept.get("localisation", {}), "frames": [wanted.frames], "every": 1}
    kept |= {"task": "localisation", "localisation": queries, "map": {"load": str(wanted.map_file)}}
    config = as_task(LocalisationConfig, make_experiment(kept, overrides, where), where)
    return _of_one_frame(config, wanted)


def settings_of_map(saved: SavedMap) -> dict[str, Any]:
    """Settings of the last drive that made the map; empty where it holds none."""
    drives = saved.about.get("drives")
    last = drives[-1] if isinstance(drives, list) and drives else {}
    settings = last.get("settings") if isinstance(last, dict) else None
    return settings if isinstance(settings, dict) else {}


def _of_one_frame(config: LocalisationConfig, wanted: Wanted) -> LocalisationConfig:
    """The configuration of one query alone, where only one is asked for."""
    frame, dataset = wanted.frame, config.dataset
    if frame is None:
        return config
    first = frame - (wanted.frames - 1) * dataset.stride
    selected = (frame - dataset.start) % dataset.stride == 0
    if frame < dataset.start or not selected or (dataset.stop or frame + 1) <= frame:
        raise ConfigError(
            f"--frame {frame}: not among the frames selected (start {dataset.start}, stop "
            f"{dataset.stop}, stride {dataset.stride}); choose another, or --set dataset.start=..."
        )
    if first < dataset.start:
        raise ConfigError(
            f"--frame {frame}: too few frames before it for a submap of {wanted.frames}; lower "
            "--frames"
        )
    one = dataclasses.replace(dataset, start=first, stop=frame + 1)
    return config.model_copy(update={"dataset": one})


def _open(wanted: Wanted, config: LocalisationConfig, progress: Progress) -> Recording:
    frame = wanted.frame
    if frame is None:
        return open_queries(config, progress)
    try:
        sequence = open_queries(config, progress)
    except FgslamError as error:
        raise type(error)(f"--frame {frame}: {error}") from None
    if len(sequence) < wanted.frames:
        last = config.dataset.start + (len(sequence) - 1) * config.dataset.stride
        raise ConfigError(
            f"--frame {frame}: {sequence.name} ends with frame {last}; choose a smaller one"
        )
    return sequence


def _other_eyes(config: LocalisationConfig, given: GivenMap) -> Sequence[str]:
    """A note where features are looked for otherwise than when the map was made."""
    made, now = settings_of_map(given.saved).get("frontend"), config.as_values()["frontend"]
    if not isinstance(made, dict):
        return ()
    other = [name for name in ("sift", "appearance", "stereo") if made.get(name) != now[name]]
    if not other:
        return ()
    keys = " and ".join(f"frontend.{name}" for name in other)
    return (f"{keys} differs from that of the map's drive: fewer features will be recognised",)
