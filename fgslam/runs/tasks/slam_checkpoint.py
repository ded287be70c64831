"""The state of a run on disk, so that it can be resumed to the same bytes."""

from __future__ import annotations

from pathlib import Path

from fgslam.backend.protocol import Estimator, Resumable
from fgslam.core.array_files import load_arrays, write_arrays
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import OutputError
from fgslam.core.measurement_log import MeasurementLog
from fgslam.runs.folder import LOG_FILE, STATE_FILE
from fgslam.slam.pipeline import SlamPipeline
from fgslam.slam.results import RunRecorder


def save(folder: Path, pipeline: SlamPipeline, recorder: RunRecorder) -> None:
    """Writes the state. The log must have been written before: it may not lack a frame of it."""
    write_arrays(folder / STATE_FILE, state_of(pipeline, recorder))


def state_of(pipeline: SlamPipeline, recorder: RunRecorder) -> StateArrays:
    """All that changes during a run but its log, as arrays named ``part/name``."""
    parts = {
        "database": pipeline.tracker.database.state(),
        "estimator": _resumable(pipeline.estimator).state(),
        "motion": pipeline.motion.state(),
        "recorder": recorder.state(),
    }
    if pipeline.places is not None:
        parts["places"] = pipeline.places.state()
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
    pipeline.motion.restore(_part(state, "motion"))
    recorder.restore(_part(state, "recorder"), log)
    if pipeline.places is not None:
        pipeline.places.restore(_part(state, "places"), recorder.log)


def save_log(folder: Path, log: MeasurementLog) -> None:
    """Writes the measurement log."""
    log.save(folder / LOG_FILE)


def exists(folder: Path) -> bool:
    """Whether there is a state to continue from."""
    return (folder / STATE_FILE).is_file()


def load(folder: Path, pipeline: SlamPipeline, recorder: RunRecorder) -> None:
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


def _resumable(estimator: Estimator) -> Resumable:
    """The estimator, if its state can be kept. Raises OutputError where it cannot."""
    if not isinstance(estimator, Resumable):
        raise OutputError(
            f"estimator {estimator.kind} has no state() and restore(): its run keeps no "
            "checkpoint; give it both, or set output.checkpoint_seconds beyond the run's length"
        )
    return estimator


def _part(state: StateArrays, part: str) -> StateArrays:
    return {
        name.removeprefix(f"{part}/"): array
        for name, array in state.items()
        if name.startswith(f"{part}/")
    }


def remove(folder: Path) -> None:
    """Drops the state once the run has finished."""
    (folder / STATE_FILE).unlink(missing_ok=True)
