"""Task of SLAM: images in, trajectory, covariances and map out; interruptible and resumable.

Units: none but the replays of further estimators; the drive itself keeps a checkpoint. How a run
enters a map: :mod:`fgslam.runs.tasks.slam_map_entry`. Files and numbers:
:mod:`fgslam.runs.tasks.slam_results`, :mod:`fgslam.runs.report`.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from fgslam.core import store
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import DatasetError, FgslamError, OutputError
from fgslam.core.files import remove_file, remove_files
from fgslam.core.kernels import make_kernels
from fgslam.core.log import ImageSequence, MeasurementLog
from fgslam.core.saved_map import save_map
from fgslam.core.store import load_arrays, write_arrays
from fgslam.evaluation.statistics import EstimatorMetrics
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.engine import Context, Opening, RunResult, Task, provenance_of, run_task
from fgslam.runs.folder import (
    COMPARISON_FILE,
    LOG_FILE,
    RUN_MARKER,
    STATE_FILE,
    ExistingFolder,
    give_back,
    is_run_folder,
    write_config,
)
from fgslam.runs.opening import open_sequence
from fgslam.runs.report import alarms, report_from_folder
from fgslam.runs.results import PICTURES
from fgslam.runs.session import map_of
from fgslam.runs.slam_comparison import judged_apart, named, replay_apart, with_odometry
from fgslam.runs.tables import comparison_particulars, comparison_tables, write_comparison_csv
from fgslam.runs.tasks.slam_map_entry import (
    FIRST_FOLDER,
    MAP_FILE,
    RIG_MEMORY_FILE,
    Entry,
    GivenMap,
    GivenMemory,
    arrival_by,
    enter,
    entry_notes,
    entry_of,
    left_out_notes,
    open_map,
    open_memory,
    require_same_map,
)
from fgslam.runs.tasks.slam_results import (
    RunOutputs,
    draw_frame,
    frames_to_show,
    run_notes,
    stereo_precision,
    summary_table,
)
from fgslam.runs.units import Progress
from fgslam.slam.build import make_estimator, make_stream, require_map_user
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.results import RunRecorder
from fgslam.slam.rig_memory import RigMemory
from fgslam.slam.session import Session
from fgslam.slam.settings import MapSettings

Watch: TypeAlias = Callable[[RunOutputs, FrameReport], None]
"""Called after each frame, with all that the run has computed; changes nothing of it."""

_FRAMES_BEFORE = "frames_before"  # in config.yaml's provenance
_SAVING_SHARE = 10.0  # the loop runs at least this many times as long as it saves


@dataclass(frozen=True, slots=True, eq=False)
class SlamResult(RunResult):
    """How a run of SLAM ended.

    Attributes:
        outputs: all that was computed.
        live: numbers of the estimator that steered; after an interruption, of the frames so far.
        pictures: drawn, if any.
    """

    outputs: RunOutputs = field(kw_only=True)
    live: EstimatorMetrics = field(kw_only=True)
    pictures: tuple[Path, ...] = ()


def open_slam(
    config: ExperimentConfig, opening: Opening, watch: Watch | None = None
) -> Task[SlamResult]:
    """Opens recording and map. Raises FgslamError."""
    opened = open_run(config, opening)
    return Task(opened.provenance, lambda context: _run(opened, context, watch))


def _run(opened: OpenedRun, context: Context, watch: Watch | None) -> SlamResult:
    """The drive that makes the map, where the run asks for one, and the run itself."""
    ended = drive_first(opened.config, context)
    if ended is not None and ended.status == "interrupted":
        return ended
    outputs = begin(opened, context.progress)
    while isinstance(saved := _loop(outputs, context, watch), int):
        # Without so many frames more; nothing of what was driven over these is kept.
        opened = dataclasses.replace(opened, frames_before=opened.frames_before + saved)
        remove_file(context.folder / STATE_FILE)
        remove_files(context.folder / PICTURES, "*.png")
        write_config(context.folder, opened.config, opened.provenance)
        outputs = begin(opened, context.progress)
    if saved is not None:
        return _result(outputs, saved)
    return _finish(outputs, context)


def drive_first(config: ExperimentConfig, context: Context) -> SlamResult | None:
    """Makes the map of a run, where it asks for that, in its folder `first`; how that ended.

    None where no map is to be made, or it is there already.
    """
    folder = context.folder / FIRST_FOLDER
    first = first_config(config, folder)
    made = context.resumed and (folder / MAP_FILE).is_file()
    # Killed after writing the map, the drive has yet to draw, to report and to tidy up.
    if first is None or (made and not (folder / STATE_FILE).is_file()):
        give_back(folder)
        return None
    existing: ExistingFolder = "overwrite"
    if context.resumed and is_run_folder(folder):
        existing = "resume"
    return run_task(open_slam, first, folder, existing, context.progress, context.stopped)


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


def _loop(
    outputs: RunOutputs, context: Context, watch: Watch | None = None
) -> EstimatorMetrics | int | None:
    """Processes the remaining frames.

    Returns:
        None after the last one; what was saved, if stopped before it; or the number of a frame with
        which the world begins again after some that showed too little: it is not taken in.
    """
    sequence, recorder, session = outputs.sequence, outputs.recorder, outputs.session
    output, frontend = outputs.config.output, outputs.config.frontend
    shown = frames_to_show(len(sequence)) if output.pictures else frozenset()
    frames = make_stream(sequence, frontend, frontend.tracking == "sift")
    stream = frames(start=len(recorder))
    if (os.cpu_count() or 1) > 1:
        outputs.pipeline.look_ahead = lambda: session.describer.begin(frames.upcoming())
    waiting = time.perf_counter()
    interval, saved = output.checkpoint_seconds, waiting
    try:
        for found in stream:
            wait_ms = 1e3 * (time.perf_counter() - waiting)
            body = body_motion(sequence, found.i, outputs.pipeline.motion)
            # In a map the world is the map's.
            if outputs.given is None and session.begins_anew(found, body):
                return found.i
            report = session.advance(
                found,
                float(sequence.timestamps[found.i]),
                body,
                # A frame without images has a number, too: the one that the selection gives it.
                outputs.first_frame + found.i * outputs.config.dataset.stride,
                wait_ms,
                lambda report: stereo_precision(sequence, report.found.i, report.stereo),
            )
            if found.i in shown:
                draw_frame(outputs, found.i, report)
            if watch is not None:
                watch(outputs, report)
            context.progress("tracking", len(recorder), len(sequence))
            if len(recorder) < len(sequence):
                if context.stopped():
                    return _save_progress(outputs)
                start = time.perf_counter()
                if start - saved >= interval:
                    _save_progress(outputs)
                    saved = time.perf_counter()
                    # Long runs shall not drown in saving.
                    wanted = output.checkpoint_seconds
                    interval = max(wanted, _SAVING_SHARE * (saved - start)) if wanted else 0.0
            waiting = time.perf_counter()
    except DatasetError:
        # All frames up to this one can be kept, unless it has touched the estimator already.
        if len(recorder) and not session.failed:
            _save_progress(outputs)
        raise
    finally:
        stream.close()
    return None


def _save_progress(outputs: RunOutputs) -> EstimatorMetrics:
    """All results so far, in valid files, and the state to resume from.

    The log is written before the state, which may not lack a frame of it.
    """
    metrics = outputs.write_results("interrupted")
    write_arrays(outputs.folder / STATE_FILE, state_of(outputs.pipeline, outputs.recorder))
    return metrics


def _finish(outputs: RunOutputs, context: Context) -> SlamResult:
    folder, output, progress = outputs.folder, outputs.config.output, context.progress
    progress("final path", 0, 1)
    live = outputs.write_results("finished")
    about_map, about_rig = _leave_map(outputs), _leave_memory(outputs)
    progress("final path", 1, 1)
    compared = _compare(outputs, live, context)
    if output.pictures or output.report:
        progress("page", 0, 1)
        report_from_folder(folder, page=output.report, plan=output.pictures)
        progress("page", 1, 1)
    result = _result(outputs, live, compared, about_map, about_rig)
    if compared and context.stopped():
        return result  # the replays that are missing are for the next session
    # The checkpoint goes last: while anything is left, a run goes on from its last frames.
    context.store.remove()
    remove_file(folder / STATE_FILE)
    return dataclasses.replace(result, status="finished")


def _compare(outputs: RunOutputs, live: EstimatorMetrics, context: Context) -> dict[str, Any]:
    """Metrics of the estimators that the configuration compares; empty where there is only one.

    Those next to the live one replay the run's log.
    """
    config, folder = outputs.config, outputs.folder
    others = judged_apart(config, config.estimators[1:])
    if not others:
        return {}
    metrics = {outputs.title: live} | replay_apart(config, folder, others, context)
    outputs.write_metrics(metrics, "interrupted" if context.stopped() else "finished")
    values = {title: one.as_json() for title, one in metrics.items()}
    write_comparison_csv(folder / COMPARISON_FILE, [(config.name, with_odometry(config, values))])
    return values


def _result(
    outputs: RunOutputs,
    live: EstimatorMetrics,
    compared: Mapping[str, Any] | None = None,
    about_map: str = "",
    about_rig: str = "",
) -> SlamResult:
    """The result of an interrupted run."""
    config, compared = outputs.config, compared or {}
    pictures = tuple(sorted((outputs.folder / PICTURES).glob("*.png")))
    files = {
        "trajectory": f"{outputs.folder / outputs.title / 'final.tum'}",
        "map": f"{outputs.folder / outputs.title / 'map.ply'}",
        "saved map": about_map,
        "rig memory": about_rig,
        "pictures": f"{outputs.folder / PICTURES}/" if pictures else "",
    }
    tables = comparison_tables(named(config), len(outputs.recorder), compared)
    particulars = comparison_particulars(compared, outputs.folder)
    return SlamResult(
        config=config,
        folder=outputs.folder,
        status="interrupted",
        tables=(summary_table(outputs, live), *tables),
        notes=run_notes(outputs, live),
        particulars=(*((name, text) for name, text in files.items() if text), *particulars),
        reached=f"after {len(outputs.recorder)} frames",
        located=outputs.located,
        alarms=alarms(outputs.located, live.landmarks),
        outputs=outputs,
        live=live,
        pictures=pictures,
    )


def _leave_memory(outputs: RunOutputs) -> str:
    """Keeps what the drive has shown of the rig; a line about it, empty where it does not."""
    memory = outputs.memory
    if memory is None or memory.fault or not outputs.located.enough:
        return ""
    sequence = outputs.sequence
    try:  # others may have driven meanwhile
        found = RigMemory.open(memory.path, sequence.rig, getattr(sequence, "rectifier", None))
        found = outputs.session.remembered(found)
        found.save(memory.path)
    except FgslamError as error:
        return f"not kept: {error}"
    return f"{memory.path}: what drives have shown of the calibration, with this one {len(found)}"


def _leave_map(outputs: RunOutputs) -> str:
    """Writes the map where the configuration wants it; a line about it, empty without."""
    config, pipeline = outputs.config, outputs.pipeline
    if config.map.save is None:
        return ""
    estimate, values = pipeline.estimate(), config.as_values()
    saved = map_of(
        outputs.session,
        estimate,
        None if outputs.given is None else outputs.given.saved,
        name=config.name,
        recording={"name": outputs.sequence.name, "identity": outputs.sequence.identity},
        truth_frame=outputs.sequence.truth_frame,
        remark=outputs.remark,
        remarks=list(estimate.remarks),
        settings={
            name: values[name] for name in ("seed", "odometry", "frontend", "estimator", "dataset")
        },
    )
    size = save_map(saved, Path(config.map.save))
    return (
        f"{config.map.save}: {len(saved)} landmarks, {int(saved.permanent.sum())} of them "
        f"permanent, {size / 1e6:.1f} MB"
    )


# ------------------------------------------------------------------------------------------
# Before the first frame: recording and map are opened, the loop is built, its state restored


@dataclass(frozen=True, slots=True, eq=False)
class OpenedRun:
    """A run whose recording is open.

    Attributes:
        config: as given.
        given: the map to go on with; None without one, or while it is still to be made.
        entry: how the run enters it; None where it does not, or that is not yet known.
        frames_before: selected frames before the first that shows enough to begin a map: left out.
        memory: what earlier drives have shown of the rig; None where it does not remember.
    """

    config: ExperimentConfig
    folder: Path
    sequence: ImageSequence
    given: GivenMap | None
    entry: Entry | None
    frames_before: int = 0
    memory: GivenMemory | None = None

    @property
    def provenance(self) -> dict[str, Any]:
        """What it takes to repeat the run, next to its configuration."""
        out = provenance_of(self.sequence)
        if self.entry is not None:
            out["map"] = self.entry
        if self.frames_before:
            out[_FRAMES_BEFORE] = self.frames_before
        if self.memory is not None:
            out["rig_memory"] = {"file": str(self.memory.path), "drives": len(self.memory.known)}
        return out


def open_run(config: ExperimentConfig, opening: Opening) -> OpenedRun:
    """Opens the recording and the map; nothing is driven or written yet.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    folder, progress = opening.folder, opening.progress
    given = None if config.map.load is None else open_map(Path(config.map.load))
    sequence = open_sequence(config, progress)
    steps = range(1, len(sequence)) if config.odometry.kind == "recorded" else ()
    # Refused before the start, not at frame 1.
    if steps and all(sequence.odometry(i) is None for i in steps):
        raise DatasetError(
            f"{sequence.name} has no odometry; set odometry.kind to constant_velocity, or to "
            "synthetic where there is ground truth"
        )
    if config.map.given:
        estimator = make_estimator(sequence.rig, config.estimator, config.frontend.ego_motion)
        user = require_map_user(estimator, config.map.extend)
        if given is not None:  # one that is too large is refused now, not in a folder begun
            landmarks = given.saved.landmarks
            user.begin_in(landmarks, given.saved.hits, fixed=not config.map.extend)
    resumed, before = opening.resumed and (folder / STATE_FILE).is_file(), 0
    if resumed:
        known = load_config(folder / RUN_MARKER).provenance or {}
        before = int(known.get(_FRAMES_BEFORE, 0))
    memory = open_memory(config, sequence, folder if resumed else None)
    run = OpenedRun(config, folder, sequence, given, None, before, memory)
    return dataclasses.replace(run, entry=_entry(run, given, resumed))


def begin(run: OpenedRun, progress: Progress) -> RunOutputs:
    """Finds the run's place in its map, builds the loop, and restores what there is to go on from.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    config, resumed = run.config, (run.folder / STATE_FILE).is_file()
    if config.map.made_from is not None:
        made = open_map(run.folder / FIRST_FOLDER / MAP_FILE)
        run = dataclasses.replace(run, given=made, entry=_entry(run, made, resumed))
        write_config(run.folder, config, run.provenance)
    given, entry, sequence = run.given, run.entry, run.sequence
    before = run.frames_before if entry is None else entry["frames_before"]
    if before:
        start = config.dataset.start + before * config.dataset.stride
        later = dataclasses.replace(config.dataset, start=start)
        config = config.model_copy(update={"dataset": later})
        sequence = open_sequence(config, progress)
    arrival, notes = None, left_out_notes(run.frames_before)
    if entry is not None and given is not None:
        arrival = arrival_by(entry, given, config.map)
        notes = entry_notes(entry, given, config.map)
    make_kernels(progress)
    session = Session(
        sequence.rig,
        config.estimator,
        frontend=config.frontend,
        odometry=config.odometry,
        seed=config.seed,
        beginning=arrival,
        rig_memory=None if run.memory is None else run.memory.known,
    )
    if run.memory is not None and not resumed:
        run.memory.known.save(run.folder / RIG_MEMORY_FILE)
    session.recorder.left_out = run.frames_before
    first = config.dataset.start
    outputs = RunOutputs(run.folder, run.config, sequence, session, first, notes, given, run.memory)
    if resumed:
        _load_checkpoint(run.folder, session.pipeline, session.recorder)
    return outputs


def _entry(run: OpenedRun, given: GivenMap | None, resumed: bool) -> Entry | None:
    """How the run enters the map; on resuming, how it did."""
    if given is None:
        return None
    known = entry_of(run.folder) if resumed else None
    if known is not None:
        require_same_map(known, given)
    return known or enter(run.config, given, run.sequence)


# ------------------------------------------------------------------------------------------
# The checkpoint


def state_of(pipeline: SlamPipeline, recorder: RunRecorder) -> StateArrays:
    """All that changes during a run but its log, as arrays named ``part/name``."""
    return {
        f"{part}/{name}": array
        for part, it in _parts(pipeline, recorder).items()
        for name, array in store.state_of(it).items()
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
    for part in (pipeline.estimator, pipeline.motion):
        if not store.has_state(part):
            name = f"estimator {part.kind}" if hasattr(part, "kind") else type(part).__name__
            raise OutputError(
                f"{name} has no state() and restore(): its run keeps no "
                "checkpoint; give it both, or set output.checkpoint_seconds beyond the run's length"
            )
    parts = {
        "tracker": pipeline.tracker,
        "estimator": pipeline.estimator,
        "motion": pipeline.motion,
        "pipeline": pipeline,
        "witnesses": pipeline.witnesses,
        "recorder": recorder,
        "places": pipeline.places,
        "calibration": pipeline.calibration,
        "key_frames": pipeline.key_frames,
        "watch": pipeline.watch,
    }
    return {name: part for name, part in parts.items() if part is not None}


def _load_checkpoint(folder: Path, pipeline: SlamPipeline, recorder: RunRecorder) -> None:
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
