"""Before a run of SLAM: its recording and map are opened, its loop is built, its state taken up."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fgslam.core.errors import DatasetError
from fgslam.core.files import remove_files
from fgslam.core.recordings import Sequence
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.engine import Opening, provenance_of
from fgslam.runs.folder import (
    RUN_MARKER,
    write_config,
)
from fgslam.runs.opening import open_sequence
from fgslam.runs.tasks import slam_map_entry as map_entry
from fgslam.runs.tasks import slam_state as state
from fgslam.runs.tasks.slam_map_entry import Entry, GivenMap
from fgslam.runs.tasks.slam_outputs import FOLDER as PICTURES
from fgslam.runs.tasks.slam_outputs import RunOutputs
from fgslam.runs.units import Progress
from fgslam.slam.arrival import require_map_user
from fgslam.slam.factory import make_estimator
from fgslam.slam.part_remarks import left_out_note
from fgslam.slam.session import Session

_FRAMES_BEFORE = "frames_before"  # in config.yaml's provenance


@dataclass(frozen=True, slots=True, eq=False)
class OpenedRun:
    """A run whose recording is open.

    Attributes:
        config: as given.
        given: the map to go on with; None without one, or while it is still to be made.
        entry: how the run enters it; None where it does not, or that is not yet known.
        resumed: the folder holds a state to go on from.
        frames_before: selected frames before the first that shows enough to begin a map: left out.
    """

    config: ExperimentConfig
    folder: Path
    sequence: Sequence
    given: GivenMap | None
    entry: Entry | None
    resumed: bool
    frames_before: int = 0

    @property
    def provenance(self) -> dict[str, Any]:
        """What it takes to repeat the run, beside its configuration."""
        out = provenance_of(self.sequence)
        if self.entry is not None:
            out["map"] = self.entry.as_values()
        if self.frames_before:
            out[_FRAMES_BEFORE] = self.frames_before
        return out


def open_run(config: ExperimentConfig, opening: Opening) -> OpenedRun:
    """Opens the recording and the map; nothing is driven or written yet.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    folder, progress = opening.folder, opening.progress
    given = None if config.map.load is None else map_entry.open_map(Path(config.map.load))
    sequence = open_sequence(config, lambda done, total: progress("rendering", done, total))
    _require_odometry(config, sequence)
    if config.map.given:
        estimator = make_estimator(sequence.rig, config.estimator, config.frontend.ego_motion)
        user = require_map_user(estimator, config.map.extend)
        if given is not None:  # one that is too large is refused now, not in a folder begun
            landmarks = given.saved.landmarks
            user.begin_in(landmarks, given.saved.hits, fixed=not config.map.extend)
    resumed = opening.resumed and state.has_checkpoint(folder)
    before = _frames_before(folder) if resumed else 0
    run = OpenedRun(config, folder, sequence, given, None, resumed, before)
    return dataclasses.replace(run, entry=_entry(run, given))


def begin(run: OpenedRun, progress: Progress) -> RunOutputs:
    """Finds the run's place in its map, builds the loop, and takes up what there is to go on from.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    config = run.config
    if config.map.made_from is not None:
        made = map_entry.open_map(run.folder / map_entry.FIRST_FOLDER / map_entry.MAP_FILE)
        run = dataclasses.replace(run, given=made, entry=_entry(run, made))
        write_config(run.folder, config, run.provenance)
    given, entry, sequence = run.given, run.entry, run.sequence
    before = run.frames_before if entry is None else entry.frames_before
    if before:
        config = _later(config, before)
        sequence = open_sequence(config, lambda done, total: progress("rendering", done, total))
    arrival, left_out = None, run.frames_before
    notes: tuple[str, ...] = (left_out_note(left_out),) if left_out else ()
    if entry is not None and given is not None:
        arrival, notes = entry.arrival(given, config.map), entry.notes(given, config.map)
    session = Session(
        sequence.rig,
        config.estimator,
        frontend=config.frontend,
        odometry=config.odometry,
        seed=config.seed,
        beginning=arrival,
    )
    session.recorder.left_out = left_out
    first = config.dataset.start
    outputs = RunOutputs(run.folder, run.config, sequence, session, first, notes, given)
    if run.resumed:
        state.load_checkpoint(run.folder, session.pipeline, session.recorder)
    return outputs


def _frames_before(folder: Path) -> int:
    """How many frames the run in a folder left out, before the first that began a map."""
    return int((load_config(folder / RUN_MARKER).provenance or {}).get(_FRAMES_BEFORE, 0))


def begin_later(run: OpenedRun, frames: int) -> OpenedRun:
    """The run without so many frames more; nothing of what was driven over these is kept."""
    before = run.frames_before + frames
    run = dataclasses.replace(run, frames_before=before, resumed=False)
    state.remove_checkpoint(run.folder)
    remove_files(run.folder / PICTURES, "*.png")
    write_config(run.folder, run.config, run.provenance)
    return run


def _entry(run: OpenedRun, given: GivenMap | None) -> Entry | None:
    """How the run enters the map; on resuming, how it did."""
    if given is None:
        return None
    known = map_entry.entry_of(run.folder) if run.resumed else None
    if known is not None:
        known.require_same(given)
    return known or map_entry.enter(run.config, given, run.sequence)


def _later(config: ExperimentConfig, frames: int) -> ExperimentConfig:
    """The configuration without its first selected frames."""
    start = config.dataset.start + frames * config.dataset.stride
    return config.model_copy(update={"dataset": dataclasses.replace(config.dataset, start=start)})


def _require_odometry(config: ExperimentConfig, sequence: Sequence) -> None:
    """Says before the start, not at frame 1, that a recording lacks odometry."""
    if config.odometry.kind != "recorded" or len(sequence) < 2:
        return
    if all(sequence.odometry(i) is None for i in range(1, len(sequence))):
        raise DatasetError(
            f"{sequence.name} has no odometry; set odometry.kind to constant_velocity, or to "
            "synthetic where there is ground truth"
        )
