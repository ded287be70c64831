"""Task of SLAM: images in, trajectory, covariances and map out; interruptible and resumable.

Units: none but the replays of further estimators; the drive itself keeps a checkpoint.
Before the first frame: :mod:`fgslam.runs.tasks.slam`. Files and numbers:
:mod:`fgslam.runs.tasks.slam_results`, :mod:`fgslam.runs.report`.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from fgslam.core import __version__, store
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import DatasetError, OutputError
from fgslam.core.files import remove_file, remove_files
from fgslam.core.log import ImageSequence, MeasurementLog
from fgslam.core.saved_map import SavedMap, save_map
from fgslam.core.sensors import Odometry
from fgslam.core.store import load_arrays, write_arrays
from fgslam.core.types import Estimate
from fgslam.evaluation.statistics import EstimatorMetrics
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task, provenance_of, run_task
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
from fgslam.runs.report import located, report_from_folder
from fgslam.runs.slam_comparison import judged_apart, named, replay_apart, with_odometry
from fgslam.runs.tables import comparison_particulars, comparison_tables, write_comparison_csv
from fgslam.runs.tasks import slam_map_entry as map_entry
from fgslam.runs.tasks.slam_map_entry import FIRST_FOLDER, MAP_FILE, Entry, GivenMap
from fgslam.runs.tasks.slam_results import FOLDER as PICTURES
from fgslam.runs.tasks.slam_results import (
    RunOutputs,
    draw_frame,
    draw_run,
    figures_of,
    frames_to_show,
    run_notes,
    stereo_precision,
    summary_table,
)
from fgslam.runs.units import Progress
from fgslam.slam.build import evidence_of, make_estimator, make_stream, require_map_user, saved_map
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.results import RunRecorder, left_out_note
from fgslam.slam.session import Session
from fgslam.slam.settings import MapSettings

# ------------------------------------------------------------------------------------------
# The state of a run: its checkpoint, to resume it, and the map that it leaves, to go on with


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


# ------------------------------------------------------------------------------------------
# Before a run of SLAM: its recording and map are opened, its loop is built, its state taken up

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
    sequence: ImageSequence
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
    resumed = opening.resumed and has_checkpoint(folder)
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
        load_checkpoint(run.folder, session.pipeline, session.recorder)
    return outputs


def _frames_before(folder: Path) -> int:
    """How many frames the run in a folder left out, before the first that began a map."""
    return int((load_config(folder / RUN_MARKER).provenance or {}).get(_FRAMES_BEFORE, 0))


def begin_later(run: OpenedRun, frames: int) -> OpenedRun:
    """The run without so many frames more; nothing of what was driven over these is kept."""
    before = run.frames_before + frames
    run = dataclasses.replace(run, frames_before=before, resumed=False)
    remove_checkpoint(run.folder)
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


def _require_odometry(config: ExperimentConfig, sequence: ImageSequence) -> None:
    """Says before the start, not at frame 1, that a recording lacks odometry."""
    if config.odometry.kind != "recorded" or len(sequence) < 2:
        return
    if all(sequence.odometry(i) is None for i in range(1, len(sequence))):
        raise DatasetError(
            f"{sequence.name} has no odometry; set odometry.kind to constant_velocity, or to "
            "synthetic where there is ground truth"
        )


Watch: TypeAlias = Callable[[RunOutputs, FrameReport], None]
"""Called after each frame, with all that the run has computed; changes nothing of it."""

_SAVING_SHARE = 10.0  # the loop runs at least this many times as long as it saves


@dataclass(frozen=True, slots=True)
class _Founding:
    """The frame of the sequence with which the world begins, after some that showed too little."""

    frame: int


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
    while isinstance(saved := _loop(outputs, context.progress, context.stopped, watch), _Founding):
        opened = begin_later(opened, saved.frame)
        outputs = begin(opened, context.progress)
    if saved is not None:
        return _result(outputs, "interrupted", saved)
    return _finish(outputs, context)


def drive_first(config: ExperimentConfig, context: Context) -> SlamResult | None:
    """Makes the map of a run, where it asks for that, in its folder `first`; how that ended.

    None where no map is to be made, or it is there already.
    """
    folder = context.folder / map_entry.FIRST_FOLDER
    first = first_config(config, folder)
    made = context.resumed and (folder / map_entry.MAP_FILE).is_file()
    # Killed after writing the map, the drive has yet to draw, to report and to tidy up.
    if first is None or (made and not has_checkpoint(folder)):
        give_back(folder)
        return None
    existing: ExistingFolder = "overwrite"
    if context.resumed and is_run_folder(folder):
        existing = "resume"
    return run_task(open_slam, first, folder, existing, context.progress, context.stopped)


def _loop(
    outputs: RunOutputs,
    progress: Progress,
    stopped: Callable[[], bool],
    watch: Watch | None = None,
) -> EstimatorMetrics | _Founding | None:
    """Processes the remaining frames; what was saved when stopped before the last one, or None.

    Ends at a frame with which the world begins anew, without taking it in.
    """
    sequence, recorder = outputs.sequence, outputs.recorder
    shown = frames_to_show(len(sequence)) if outputs.config.output.pictures else frozenset()
    frontend = outputs.config.frontend
    stream = make_stream(sequence, frontend, frontend.tracking == "sift")(start=len(recorder))
    waiting = time.perf_counter()
    interval = outputs.config.output.checkpoint_seconds
    saved = -math.inf  # the first frame is saved at once: from then on any end can be resumed
    try:
        for found in stream:
            wait_ms = 1e3 * (time.perf_counter() - waiting)
            body = body_motion(sequence, found.i, outputs.pipeline.motion)
            # In a map the world is the map's.
            if outputs.given is None and outputs.session.begins_anew(found, body):
                return _Founding(found.i)
            report = _advance(outputs, found, body, wait_ms)
            if found.i in shown:
                draw_frame(outputs, found.i, report)
            if watch is not None:
                watch(outputs, report)
            progress("tracking", len(recorder), len(sequence))
            done = len(recorder) == len(sequence)
            if not done and stopped():
                return save_progress(outputs)
            if not done and time.perf_counter() - saved >= interval:
                interval = _save_timed(outputs)
                saved = time.perf_counter()
            waiting = time.perf_counter()
    except DatasetError:
        # All frames up to this one can be kept, unless it has touched the estimator already.
        if len(recorder) and not outputs.session.failed:
            save_progress(outputs)
        raise
    finally:
        stream.close()
    return None


def _save_timed(outputs: RunOutputs) -> float:
    """Saves; returns the seconds until the next time: long runs shall not drown in saving."""
    start = time.perf_counter()
    save_progress(outputs)
    wanted = outputs.config.output.checkpoint_seconds
    return max(wanted, _SAVING_SHARE * (time.perf_counter() - start)) if wanted else 0.0


def save_progress(outputs: RunOutputs) -> EstimatorMetrics:
    """All results so far, in valid files, and the state to resume from."""
    metrics = outputs.write_results("interrupted")
    save_checkpoint(outputs.folder, outputs.pipeline, outputs.recorder)
    return metrics


def _advance(
    outputs: RunOutputs, found: FeatureFrame, body: Odometry | None, wait_ms: float
) -> FrameReport:
    """Pushes one frame with its odometry into the session."""
    sequence, session = outputs.sequence, outputs.session
    # A frame without images has a number, too: the one that the selection gives it.
    index = outputs.first_frame + found.i * outputs.config.dataset.stride
    return session.advance(
        found,
        float(sequence.timestamps[found.i]),
        body,
        index,
        wait_ms,
        lambda report: stereo_precision(sequence, found.i, report.stereo),
    )


def _finish(outputs: RunOutputs, context: Context) -> SlamResult:
    pictures: tuple[Path, ...] = ()
    live = outputs.write_results("finished")
    about_map = leave_map(outputs)
    if outputs.config.output.pictures:
        pictures = tuple(draw_run(outputs.folder, figures_of(outputs)))
    compared = _compare(outputs, live, context)
    if outputs.config.output.report:
        report_from_folder(outputs.folder)
    status: Status = "finished"
    if compared and context.stopped():
        status = "interrupted"  # the replays that are missing are for the next session
    else:
        # The checkpoint goes last: while anything is left, a run goes on from its last frames.
        context.store.remove()
        remove_checkpoint(outputs.folder)
    return _result(outputs, status, live, pictures, compared, about_map)


def _compare(outputs: RunOutputs, live: EstimatorMetrics, context: Context) -> dict[str, Any]:
    """Metrics of the estimators that the configuration compares; empty where there is only one.

    Those beside the live one replay the run's log.
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
    status: Status,
    live: EstimatorMetrics,
    pictures: tuple[Path, ...] = (),
    compared: Mapping[str, Any] | None = None,
    about_map: str = "",
) -> SlamResult:
    """What is said of the run."""
    own = outputs.folder / outputs.title
    files = [("trajectory", str(own / "final.tum")), ("map", str(own / "map.ply"))]
    files += [("saved map", about_map)] if about_map else []
    files += [("pictures", f"{pictures[0].parent}/")] if pictures else []
    tables = comparison_tables(named(outputs.config), len(outputs.recorder), compared or {})
    return SlamResult(
        config=outputs.config,
        folder=outputs.folder,
        status=status,
        tables=(summary_table(outputs, live), *tables),
        notes=run_notes(outputs, live),
        particulars=(*files, *comparison_particulars(compared or {}, outputs.folder)),
        reached=f"after {len(outputs.recorder)} frames",
        located=located(outputs.recorder),
        outputs=outputs,
        live=live,
        pictures=pictures,
    )
