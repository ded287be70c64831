"""The state of a run: its checkpoint, to resume it, and the map that it leaves, to go on with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fgslam.core import __version__, store
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import OutputError
from fgslam.core.estimates import Estimate
from fgslam.core.files import remove_file
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.saved_map import SavedMap, save_map
from fgslam.core.store import load_arrays, write_arrays
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.folder import LOG_FILE, STATE_FILE
from fgslam.runs.tasks.slam_map_entry import FIRST_FOLDER, MAP_FILE
from fgslam.runs.tasks.slam_outputs import RunOutputs
from fgslam.slam.arrival import evidence_of, saved_map
from fgslam.slam.map_settings import MapSettings
from fgslam.slam.pipeline import SlamPipeline
from fgslam.slam.results import RunRecorder


def save_checkpoint(folder: Path, pipeline: SlamPipeline, recorder: RunRecorder) -> None:
    """Writes the state. The log must have been written before: it may not lack a frame of it."""
    write_arrays(folder / STATE_FILE, state_of(pipeline, recorder))


def state_of(pipeline: SlamPipeline, recorder: RunRecorder) -> StateArrays:
    """All that changes during a run but its log, as arrays named ``part/name``."""
    states = {part: store.state_of(it) for part, it in _parts(pipeline, recorder).items()}
    return {
        f"{part}/{name}": array for part, state in states.items() for name, array in state.items()
    }


def restore(
    state: StateArrays, log: MeasurementLog, pipeline: SlamPipeline, recorder: RunRecorder
) -> None:
    """Continues from :func:`state_of` and the log.

    Raises:
        Exception: one of ``store.UNFIT``; the state is another's.
    """
    for part, it in _parts(pipeline, recorder).items():
        start = f"{part}/"
        own = {n.removeprefix(start): array for n, array in state.items() if n.startswith(start)}
        store.restore(it, own)
    frames = log.increments[: len(recorder)]
    recorder.log.increments[:] = frames
    if pipeline.places is not None:
        pipeline.places.memory.frames[:] = frames


def _parts(pipeline: SlamPipeline, recorder: RunRecorder) -> dict[str, Any]:
    """Whose state a run has. Raises OutputError where that of one cannot be kept."""
    parts = {
        "tracker": pipeline.tracker,
        "estimator": pipeline.estimator,
        "motion": pipeline.motion,
        "pipeline": pipeline,
        "recorder": recorder,
        "places": pipeline.places,
        "calibration": pipeline.calibration,
        "key_frames": pipeline.key_frames,
        "watch": pipeline.watch,
    }
    for part in (pipeline.estimator, pipeline.motion):
        if not store.has_state(part):
            name = f"estimator {part.kind}" if hasattr(part, "kind") else type(part).__name__
            raise OutputError(
                f"{name} has no state() and restore(): its run keeps no "
                "checkpoint; give it both, or set output.checkpoint_seconds beyond the run's length"
            )
    return {name: part for name, part in parts.items() if part is not None}


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
    except store.UNFIT as error:
        raise OutputError(
            f"{folder / STATE_FILE}: not a state that this fgslam wrote ({error}); start again "
            "with --overwrite"
        ) from None
    if len(recorder.log) < len(recorder):
        raise OutputError(
            f"{folder / LOG_FILE}: holds {len(log)} frames, the checkpoint {len(recorder)}; "
            "restore it, or start again with --overwrite"
        )


def remove_checkpoint(folder: Path) -> None:
    """Drops the state once the run has finished."""
    remove_file(folder / STATE_FILE)


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
    before = None if outputs.given is None else outputs.given.saved
    evidence = evidence_of(outputs.pipeline, outputs.recorder, before)
    return saved_map(outputs.pipeline, outputs.sequence.rig, estimate, about, evidence)


def _drives_before(outputs: RunOutputs) -> list[Any]:
    if outputs.given is None:
        return []
    return list(outputs.given.saved.about.get("drives", ()))


def _drive(outputs: RunOutputs, estimate: Estimate) -> dict[str, Any]:
    config, values = outputs.config, outputs.config.as_values()
    names = ("seed", "odometry", "frontend", "estimator", "dataset")
    return {
        "name": config.name,
        "fgslam": __version__,
        "recording": {"name": outputs.sequence.name, "identity": outputs.sequence.identity},
        "frames": len(outputs.recorder),
        "estimator": outputs.pipeline.estimator.kind,
        "valid_hits": config.frontend.database.valid_hits,
        "remark": outputs.remark,
        "remarks": list(estimate.remarks),
        "settings": {name: values[name] for name in names},
    }
