"""The state of a run: its checkpoint, to resume it, and the map that it leaves, to go on with."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.backend.protocol import Estimator, Resumable
from fgslam.core import __version__
from fgslam.core.array_files import load_arrays, write_arrays
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import ConfigError, MapError, MeasurementLogError, OutputError
from fgslam.core.estimates import Estimate
from fgslam.core.files import remove_file, require_writable
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.recordings import Sequence
from fgslam.core.saved_map import SavedMap, require_rig, save_map
from fgslam.runs.config import ExperimentConfig, make_config
from fgslam.runs.folder import LOG_FILE, STATE_FILE
from fgslam.runs.tasks.slam_map_entry import FIRST_FOLDER, MAP_FILE, GivenMap, entry_of
from fgslam.runs.tasks.slam_outputs import RunOutputs
from fgslam.slam.arrival import evidence_of, saved_map
from fgslam.slam.map_settings import MapSettings
from fgslam.slam.motion import MotionModel
from fgslam.slam.pipeline import SlamPipeline
from fgslam.slam.results import RunRecorder


def save_checkpoint(folder: Path, pipeline: SlamPipeline, recorder: RunRecorder) -> None:
    """Writes the state. The log must have been written before: it may not lack a frame of it."""
    write_arrays(folder / STATE_FILE, state_of(pipeline, recorder))


def state_of(pipeline: SlamPipeline, recorder: RunRecorder) -> StateArrays:
    """All that changes during a run but its log, as arrays named ``part/name``."""
    parts = {
        "database": pipeline.tracker.database.state(),
        "estimator": _resumable(pipeline.estimator).state(),
        "motion": _resumable(pipeline.motion).state(),
        "parts": pipeline.tracker.parts.state(),
        "pipeline": pipeline.state(),
        "recorder": recorder.state(),
    }
    if pipeline.places is not None:
        parts["places"] = pipeline.places.state()
    if pipeline.calibration is not None:
        parts["calibration"] = pipeline.calibration.state()
    if pipeline.key_frames is not None:
        parts["key_frames"] = pipeline.key_frames.state()
    if pipeline.watch is not None:
        parts["watch"] = pipeline.watch.state()
    return {
        f"{part}/{name}": array for part, arrays in parts.items() for name, array in arrays.items()
    }


def restore(
    state: StateArrays, log: MeasurementLog, pipeline: SlamPipeline, recorder: RunRecorder
) -> None:
    """Continues from :func:`state_of` and the log.

    Raises:
        KeyError, ValueError, IndexError: the state is another's.
    """
    pipeline.tracker.database.restore(_part(state, "database"))
    _resumable(pipeline.estimator).restore(_part(state, "estimator"))
    _resumable(pipeline.motion).restore(_part(state, "motion"))
    pipeline.tracker.parts.restore(_part(state, "parts"))
    pipeline.restore(_part(state, "pipeline"))
    recorder.restore(_part(state, "recorder"), log)
    if pipeline.places is not None:
        pipeline.places.restore(_part(state, "places"), recorder.log)
    if pipeline.calibration is not None:
        part, frames = _part(state, "calibration"), recorder.log.increments
        pipeline.calibration.restore(part, frames, recorder.online_poses)
    if pipeline.key_frames is not None:
        pipeline.key_frames.restore(_part(state, "key_frames"))
    if pipeline.watch is not None:
        pipeline.watch.restore(_part(state, "watch"))


def has_checkpoint(folder: Path) -> bool:
    """Whether there is a state to continue from."""
    return (folder / STATE_FILE).is_file()


def load_checkpoint(folder: Path, pipeline: SlamPipeline, recorder: RunRecorder) -> None:
    """Continues from a checkpoint.

    Raises:
        OutputError: state and log do not belong to each other or to this fgslam.
        MeasurementLogError: one of the two files cannot be read.
    """
    state = load_arrays(folder / STATE_FILE)
    log = MeasurementLog.load(folder / LOG_FILE)
    try:
        restore(state, log, pipeline, recorder)
    except (KeyError, ValueError, IndexError) as error:
        raise OutputError(
            f"{folder / STATE_FILE}: not a state that this fgslam wrote ({error}); start again "
            "with --overwrite"
        ) from None
    if len(recorder.log) < len(recorder):
        raise OutputError(
            f"{folder / LOG_FILE}: holds {len(log)} frames, the checkpoint {len(recorder)}; "
            "restore it, or start again with --overwrite"
        )


def _resumable(part: Estimator | MotionModel) -> Resumable:
    """The part of a run, if its state can be kept. Raises OutputError where it cannot."""
    if not isinstance(part, Resumable):
        name = f"estimator {part.kind}" if hasattr(part, "kind") else type(part).__name__
        raise OutputError(
            f"{name} has no state() and restore(): its run keeps no "
            "checkpoint; give it both, or set output.checkpoint_seconds beyond the run's length"
        )
    return part


def _part(state: StateArrays, part: str) -> StateArrays:
    return {
        name.removeprefix(f"{part}/"): array
        for name, array in state.items()
        if name.startswith(f"{part}/")
    }


def remove_checkpoint(folder: Path) -> None:
    """Drops the state once the run has finished."""
    remove_file(folder / STATE_FILE)


_LOG = "log/"
_TIMES = "recorder/stage_ms"
_LEFT_OUT = "frames_left_out"
_SAME_SETTINGS = ("seed", "odometry", "frontend", "estimator")


def first_config(config: ExperimentConfig, folder: Path) -> ExperimentConfig | None:
    """The drive that makes the map of a run in ``folder``; None where none is asked for."""
    first = config.map.made_from
    if first is None:
        return None
    return config.model_copy(
        update={
            "name": f"{config.name}_{FIRST_FOLDER}",
            "seed": config.seed if first.seed is None else first.seed,
            "dataset": first.dataset,
            "odometry": first.odometry,
            "compare": (),
            "map": MapSettings(save=str(folder / MAP_FILE)),
        }
    )


def require_savable(settings: MapSettings, run: Path) -> None:
    """Refuses, before the drive, a map file that could not be written after it.

    The folder ``run`` of the run itself is none of its business.

    Raises:
        MapError: the name is a folder's.
        OutputError: its folder does not exist or is not writable.
    """
    if settings.save is None:
        return
    path = Path(settings.save)
    if path.is_dir():
        raise MapError(f"{path}: is a folder; name the map's file, e.g. {path / MAP_FILE}")
    if path.parent.resolve() != run.resolve():
        require_writable(path.parent)


# --------------------------------------------------------------------------------------------
# Going on where the run of a map stopped


def window(config: ExperimentConfig, given: GivenMap) -> ExperimentConfig:
    """The configuration with the frames that the map's run had, too: it goes on after them.

    Raises:
        MapError: the map keeps no session, or one of other settings.
    """
    saved, where = given.saved, str(given.path)
    drive = _last_drive(saved)
    if not saved.session or "settings" not in drive:
        raise MapError(
            f"{where}: was saved without its session, so no run can go on with it; save with "
            "map.session true, or use map.start last"
        )
    now, then = config.as_values(), _settings_of(drive, where)
    for name in _SAME_SETTINGS:
        if now[name] != then[name]:
            raise MapError(
                f"{where}: its run had another {name}; map.start continue needs the same one, "
                "map.start last does not"
            )
    start, stride = then["dataset"]["start"], then["dataset"]["stride"]
    after = start + stride * drive["frames"]
    asked = start - stride * _frames_before(drive)
    same = {name: value for name, value in then["dataset"].items() if name not in ("start", "stop")}
    if any(now["dataset"].get(name) != value for name, value in same.items()):
        raise MapError(
            f"{where}: its run had another dataset; map.start continue needs the same one, "
            "map.start last does not"
        )
    if config.dataset.start not in (asked, start, after):
        raise MapError(
            f"{where}: its run stopped before frame {after}; set dataset.start to {after}, or as "
            f"it was, to {asked}"
        )
    dataset = dataclasses.replace(config.dataset, start=start)
    return config.model_copy(update={"dataset": dataset})


def require_continuable(given: GivenMap, sequence: Sequence) -> None:
    """Refuses a session of another recording, of another fgslam, or with nothing left to do.

    Raises:
        MapError: which it is.
    """
    saved, where, drive = given.saved, str(given.path), _last_drive(given.saved)
    require_rig(saved, sequence.rig, where)
    done = drive["frames"]
    same = drive["recording"]["identity"] == sequence.identity
    stamps = saved.session.get(f"{_LOG}timestamp", np.empty(0))
    if not same or not np.array_equal(sequence.timestamps[:done], stamps):
        raise MapError(
            f"{where}: was made of another recording than {sequence.name}, or it has changed; "
            "map.start continue needs the same one, map.start last does not"
        )
    if drive["fgslam"] != __version__:
        raise MapError(
            f"{where}: its session is of fgslam {drive['fgslam']}, this is {__version__}; use "
            "that one, or map.start last"
        )
    if done >= len(sequence):
        raise MapError(
            f"{where}: its run had all {done} frames up to dataset.stop already; nothing is left "
            "to go on with"
        )


def entered_by(given: GivenMap) -> dict[str, Any] | None:
    """How the run that is gone on with entered a map of its own; None where it had none."""
    return _last_drive(given.saved).get("entered")


def left_out_before(given: GivenMap) -> int:
    """How many frames the run that is gone on with left out, before the first that began a map."""
    return int(_last_drive(given.saved).get(_LEFT_OUT, 0))


def go_on(given: GivenMap, pipeline: SlamPipeline, recorder: RunRecorder) -> None:
    """Takes the session up where it stopped. Raises MapError where its arrays do not fit."""
    session, where = given.saved.session, str(given.path)
    logged = {n.removeprefix(_LOG): a for n, a in session.items() if n.startswith(_LOG)}
    try:
        log = MeasurementLog.from_arrays(logged, where)
        restore(session, log, pipeline, recorder)
    except (KeyError, ValueError, IndexError, MeasurementLogError) as error:
        raise MapError(
            f"{where}: its session is not one that this fgslam wrote ({error}); use map.start last"
        ) from None


def _settings_of(drive: dict[str, Any], where: str) -> dict[str, Any]:
    """A drive's settings, with the defaults of keys that are newer than it."""
    try:
        return make_config({"name": drive["name"], **drive["settings"]}, where).as_values()
    except ConfigError as error:
        raise MapError(
            f"{where}: its run had settings that this fgslam does not know ({error}); use "
            "map.start last"
        ) from None


def _frames_before(drive: dict[str, Any]) -> int:
    """How many selected frames of a drive came before its first one."""
    entered = drive.get("entered") or {}
    return int(drive.get(_LEFT_OUT, 0)) + int(entered.get("frames_before", 0))


def _last_drive(saved: SavedMap) -> dict[str, Any]:
    drives = saved.about.get("drives")
    last = drives[-1] if isinstance(drives, list) and drives else {}
    return last if isinstance(last, dict) else {}


# --------------------------------------------------------------------------------------------
# The map that is left


def leave_map(outputs: RunOutputs) -> str:
    """Writes the map where the configuration wants it; a line about it, empty without."""
    if outputs.config.map.save is None:
        return ""
    path, saved = Path(outputs.config.map.save), _saved_map(outputs)
    size = save_map(saved, path)
    return (
        f"{path}: {len(saved)} landmarks, {int(saved.permanent.sum())} of them permanent, "
        f"{size / 1e6:.1f} MB"
    )


def _saved_map(outputs: RunOutputs) -> SavedMap:
    """The session's map with what is known of its drives."""
    estimate = outputs.pipeline.estimate()
    about = {"drives": [*_drives_before(outputs), _drive(outputs, estimate)]}
    session = _session(outputs) if outputs.config.map.session else None
    before = None if outputs.given is None else outputs.given.saved
    evidence = evidence_of(outputs.pipeline, outputs.recorder, before)
    return saved_map(outputs.pipeline, outputs.sequence.rig, estimate, about, evidence, session)


def _drives_before(outputs: RunOutputs) -> list[Any]:
    if outputs.given is None:
        return []
    before = list(outputs.given.saved.about.get("drives", ()))
    return before[:-1] if outputs.config.map.start == "continue" else before


def _drive(outputs: RunOutputs, estimate: Estimate) -> dict[str, Any]:
    config, values = outputs.config, outputs.config.as_values()
    settings = {name: values[name] for name in (*_SAME_SETTINGS, "dataset")}
    settings["dataset"]["start"] = outputs.first_frame
    entry = entry_of(outputs.folder)
    return {
        "name": config.name,
        "fgslam": __version__,
        "recording": {"name": outputs.sequence.name, "identity": outputs.sequence.identity},
        "frames": len(outputs.recorder),
        _LEFT_OUT: outputs.recorder.left_out,
        "entered": None if entry is None else entry.as_values(),
        "estimator": outputs.pipeline.estimator.kind,
        "valid_hits": config.frontend.database.valid_hits,
        "remark": outputs.remark,
        "remarks": list(estimate.remarks),
        "settings": settings,
    }


def _session(outputs: RunOutputs) -> StateArrays:
    """What the run needs to go on; its times are the clock's, and no part of it."""
    log = outputs.recorder.log.to_arrays()
    state = state_of(outputs.pipeline, outputs.recorder)
    state[_TIMES] = np.full_like(state[_TIMES], np.nan)
    return state | {f"{_LOG}{name}": array for name, array in log.items()}
