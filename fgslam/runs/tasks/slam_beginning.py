"""Everything of a run before its first frame: recording, folder, map, and the parts of the loop."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.recordings import Sequence
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.folder import RUN_MARKER, ExistingFolder, create_run_folder
from fgslam.runs.opening import open_sequence
from fgslam.runs.tasks import slam_checkpoint as checkpoint
from fgslam.runs.tasks import slam_map_entry as map_entry
from fgslam.runs.tasks import slam_mapping as mapping
from fgslam.runs.tasks.slam_map_entry import Entry, GivenMap
from fgslam.runs.tasks.slam_outputs import RunOutputs, versions, write_config
from fgslam.slam.arrival import require_map_user
from fgslam.slam.factory import make_estimator
from fgslam.slam.session import Session

Progress = Callable[[str, int, int], None]
"""Called with what is under way, how much is done, and of how much."""


@dataclass(frozen=True, slots=True, eq=False)
class OpenedRun:
    """A run whose recording is open and whose folder is made.

    Attributes:
        config: as given; ``opened`` is what its recording was opened with.
        given: the map to go on with; None without one, or while it is still to be made.
        entry: how the run enters it; None where it does not, or that is not yet known.
        resumed: the folder holds a state to go on from.
    """

    config: ExperimentConfig
    opened: ExperimentConfig
    folder: Path
    sequence: Sequence
    given: GivenMap | None
    entry: Entry | None
    resumed: bool

    @property
    def goes_on(self) -> bool:
        """Whether the run is the continuation of the one that made its map."""
        return self.given is not None and self.config.map.start == "continue"


@dataclass(frozen=True, slots=True, eq=False)
class BegunRun:
    """A run ready for its next frame, and the map that it was given."""

    outputs: RunOutputs
    given: GivenMap | None


def open_run(
    config: ExperimentConfig, folder: Path, existing: ExistingFolder, progress: Progress
) -> OpenedRun:
    """Opens the recording and the map, and makes or checks the folder; nothing is driven yet.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    if existing == "resume" or (existing == "refuse" and folder.exists()):
        create_run_folder(folder, existing)  # refuses now, not after minutes of rendering
    if existing == "resume":
        if not _waits_for_first(config, folder):
            checkpoint.require(folder)
        _require_same(config, folder)
    mapping.require_savable(config.map, folder)
    given = None if config.map.load is None else map_entry.open_map(Path(config.map.load))
    opened = config
    if given is not None and config.map.start == "continue":
        opened = mapping.window(config, given)
    sequence = open_sequence(opened, lambda done, total: progress("rendering", done, total))
    _require_odometry(config, sequence)
    if config.map.given and config.map.start != "continue":
        estimator = make_estimator(sequence.rig, config.estimator, config.frontend.ego_motion)
        user = require_map_user(estimator, config.map.extend)
        if given is not None:  # one that is too large is refused now, not in a folder begun
            landmarks = given.saved.landmarks
            user.begin_in(landmarks, given.saved.hits, fixed=not config.map.extend)
    resumed = existing == "resume" and checkpoint.exists(folder)
    run = OpenedRun(config, opened, folder, sequence, given, None, resumed)
    run = dataclasses.replace(run, entry=_entry(run, given))
    create_run_folder(folder, existing)
    if existing == "resume":
        _require_same_ground(sequence, folder)
    else:
        _write_config(run)
    return run


def begin(run: OpenedRun, progress: Progress) -> BegunRun:
    """Finds the run's place in its map, builds the loop, and takes up what there is to go on from.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    config = run.config
    if config.map.made_from is not None:
        made = map_entry.open_map(run.folder / map_entry.FIRST_FOLDER / map_entry.MAP_FILE)
        run = dataclasses.replace(run, given=made, entry=_entry(run, made))
        _write_config(run)
    given, entry, sequence, opened = run.given, run.entry, run.sequence, run.opened
    if entry is not None and entry.frames_before:
        opened = _later(opened, entry.frames_before)
        sequence = open_sequence(opened, lambda done, total: progress("rendering", done, total))
    arrival, notes = None, tuple[str, ...]()
    if entry is not None and given is not None:
        arrival, notes = entry.arrival(given, config.map), entry.notes(given, config.map)
    session = Session(
        sequence.rig,
        config.estimator,
        frontend=config.frontend,
        odometry=config.odometry,
        seed=config.seed,
        arrival=arrival,
    )
    first_frame = opened.dataset.start
    outputs = RunOutputs(run.folder, config, sequence, session, first_frame, notes)
    if run.resumed:
        checkpoint.load(run.folder, session.pipeline, session.recorder)
    elif given is not None and run.goes_on:
        mapping.go_on(given, session.pipeline, session.recorder)
    return BegunRun(outputs, given)


def _entry(run: OpenedRun, given: GivenMap | None) -> Entry | None:
    """How the run enters the map; on resuming, how it did."""
    if given is None:
        return None
    if run.goes_on:
        mapping.require_continuable(given, run.sequence)
        return None
    known = map_entry.entry_of(run.folder) if run.resumed else None
    if known is not None:
        known.require_same(given)
    return known or map_entry.enter(run.config, given, run.sequence)


def _later(config: ExperimentConfig, frames: int) -> ExperimentConfig:
    """The configuration without its first selected frames."""
    start = config.dataset.start + frames * config.dataset.stride
    return config.model_copy(update={"dataset": dataclasses.replace(config.dataset, start=start)})


def _write_config(run: OpenedRun) -> None:
    """The resolved configuration with what it takes to repeat the run."""
    provenance: dict[str, Any] = {
        "dataset": {"name": run.sequence.name, "identity": run.sequence.identity}
    }
    if run.entry is not None:
        provenance["map"] = run.entry.as_values()
    elif run.given is not None and (entered := mapping.entered_by(run.given)):
        provenance["map"] = entered
    write_config(run.folder, run.config, provenance)


def _waits_for_first(config: ExperimentConfig, folder: Path) -> bool:
    """Whether a run that makes its own map was ended before its own first frame."""
    return config.map.made_from is not None and not (folder / "metrics.json").is_file()


def _require_odometry(config: ExperimentConfig, sequence: Sequence) -> None:
    """Says before the start, not at frame 1, that a recording lacks odometry."""
    if config.odometry.kind != "recorded" or len(sequence) < 2:
        return
    if all(sequence.odometry(i) is None for i in range(1, len(sequence))):
        raise DatasetError(
            f"{sequence.name} has no odometry; set odometry.kind to constant_velocity, or to "
            "synthetic where there is ground truth"
        )


def _require_same(config: ExperimentConfig, folder: Path) -> None:
    """A run resumes only with the configuration that it was started with."""
    path = folder / RUN_MARKER
    if load_config(path).as_values() != config.as_values():
        raise ConfigError(
            f"{path}: differs from the configuration given; resume with the same one "
            f"({resume_command(folder)}) or start again with --overwrite"
        )


def _require_same_ground(sequence: Sequence, folder: Path) -> None:
    """A run resumes to the same bytes only on its own recording and with its own packages."""
    path = folder / RUN_MARKER
    provenance = load_config(path).provenance or {}
    if (provenance.get("dataset") or {}).get("identity") != sequence.identity:
        raise DatasetError(
            f"{sequence.name}: the recording has changed since {path} was written; restore it, or "
            "start again with --overwrite"
        )
    before, now = provenance.get("versions") or {}, versions()
    differing = [name for name in now if name in before and before[name] != now[name]]
    changed = [f"{name} {before[name]} -> {now[name]}" for name in differing]
    if changed:
        raise ConfigError(
            f"{path}: started with other versions ({', '.join(changed)}), which would not give the "
            "same bytes; restore them, or start again with --overwrite"
        )


def resume_command(folder: Path) -> str:
    """What to type to continue the run in ``folder``, whatever overrides it was started with."""
    run = shlex.quote(str(folder))
    return f"fgslam run {shlex.quote(str(folder / RUN_MARKER))} --out {run} --resume"
