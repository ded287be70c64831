"""Task of SLAM: images in, trajectory, covariances and map out; interruptible and resumable.

Units: none but the replays of further estimators; the drive itself keeps a checkpoint.
Files and numbers: :mod:`fgslam.runs.tasks.slam_outputs`, :mod:`fgslam.runs.tasks.slam_metrics`.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from fgslam.backend.protocol import KeepsRecord
from fgslam.core.errors import DatasetError
from fgslam.core.files import remove_files
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Sequence
from fgslam.evaluation.metrics import EstimatorMetrics
from fgslam.report.tables import write_comparison_csv
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task, provenance_of, run_task
from fgslam.runs.folder import (
    BLOCKS_FOLDER,
    COMPARISON_FILE,
    INPUTS_FOLDER,
    LOG_FILE,
    RUN_MARKER,
    SUBMAPS_FOLDER,
    ExistingFolder,
    is_run_folder,
    write_config,
)
from fgslam.runs.metric_tables import comparison_particulars, comparison_tables
from fgslam.runs.opening import open_sequence
from fgslam.runs.owner import give_back
from fgslam.runs.report import report_from_folder
from fgslam.runs.slam_comparison import judged_apart, named, replay_apart
from fgslam.runs.tasks import slam_map_entry as map_entry
from fgslam.runs.tasks import slam_state as state
from fgslam.runs.tasks.slam_map_entry import Entry, GivenMap
from fgslam.runs.tasks.slam_metrics import located
from fgslam.runs.tasks.slam_outputs import FOLDER as PICTURES
from fgslam.runs.tasks.slam_outputs import (
    RunOutputs,
    draw_frame,
    draw_run,
    figures_of,
    frames_to_show,
    run_notes,
    summary_table,
)
from fgslam.runs.tasks.truth import stereo_precision
from fgslam.runs.units import Progress
from fgslam.slam.arrival import require_map_user
from fgslam.slam.factory import make_estimator, make_stream
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.part_remarks import left_out_note
from fgslam.slam.pipeline import FrameReport
from fgslam.slam.session import Session

Watch: TypeAlias = Callable[[RunOutputs, FrameReport], None]
"""Called after each frame, with all that the run has computed; changes nothing of it."""


@dataclass(frozen=True, slots=True, eq=False)
class OpenedRun:
    """A run whose recording is open.

    Attributes:
        config: as given; ``opened`` is what its recording was opened with.
        given: the map to go on with; None without one, or while it is still to be made.
        entry: how the run enters it; None where it does not, or that is not yet known.
        resumed: the folder holds a state to go on from.
        frames_before: selected frames before the first that shows enough to begin a map: left out.
    """

    config: ExperimentConfig
    opened: ExperimentConfig
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
        elif self.given is not None and (entered := state.entered_by(self.given)):
            out["map"] = entered
        if self.frames_before:
            out[_FRAMES_BEFORE] = self.frames_before
        return out

    @property
    def goes_on(self) -> bool:
        """Whether the run is the continuation of the one that made its map."""
        return self.given is not None and self.config.map.start == "continue"


def open_run(config: ExperimentConfig, opening: Opening) -> OpenedRun:
    """Opens the recording and the map; nothing is driven or written yet.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    folder, progress = opening.folder, opening.progress
    state.require_savable(config.map, folder)
    given = None if config.map.load is None else map_entry.open_map(Path(config.map.load))
    opened = config
    if given is not None and config.map.start == "continue":
        opened = state.window(config, given)
    sequence = open_sequence(opened, lambda done, total: progress("rendering", done, total))
    _require_odometry(config, sequence)
    if config.map.active_radius_m is not None:
        from fgslam.slam.submaps.memory import require_sets_aside

        require_sets_aside(
            make_estimator(sequence.rig, config.estimator, config.frontend.ego_motion)
        )
    if config.map.given and config.map.start != "continue":
        estimator = make_estimator(sequence.rig, config.estimator, config.frontend.ego_motion)
        user = require_map_user(estimator, config.map.extend)
        if given is not None:  # one that is too large is refused now, not in a folder begun
            landmarks = given.saved.landmarks
            user.begin_in(landmarks, given.saved.hits, fixed=not config.map.extend)
    resumed = opening.resumed and state.has_checkpoint(folder)
    before = _frames_before(folder) if resumed else 0
    run = OpenedRun(config, opened, folder, sequence, given, None, resumed, before)
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
    given, entry, sequence, opened = run.given, run.entry, run.sequence, run.opened
    before = run.frames_before if entry is None else entry.frames_before
    if before:
        opened = _later(opened, before)
        sequence = open_sequence(opened, lambda done, total: progress("rendering", done, total))
    arrival = None
    notes: tuple[str, ...] = (left_out_note(before),) if run.frames_before else ()
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
    _keep_on_disk(session, run)
    session.recorder.left_out = run.frames_before
    first_frame = opened.dataset.start
    outputs = RunOutputs(run.folder, config, sequence, session, first_frame, notes, given)
    if run.resumed:
        state.load_checkpoint(run.folder, session.pipeline, session.recorder)
    elif given is not None and run.goes_on:
        state.go_on(given, session.pipeline, session.recorder)
    return outputs


def _frames_before(folder: Path) -> int:
    """How many frames the run in a folder left out, before the first that began a map."""
    return int((load_config(folder / RUN_MARKER).provenance or {}).get(_FRAMES_BEFORE, 0))


def _begin_later(run: OpenedRun, frames: int) -> OpenedRun:
    """The run without so many frames more; nothing of what was driven over these is kept."""
    before = run.frames_before + frames
    run = dataclasses.replace(run, frames_before=before, resumed=False)
    state.remove_checkpoint(run.folder)
    remove_files(run.folder / PICTURES, "*.png")
    write_config(run.folder, run.config, run.provenance)
    return run


def _keep_on_disk(session: Session, run: OpenedRun) -> None:
    """What no frame needs is in files: the log, landmarks far away, what an estimator was given."""
    about_map, estimator = run.config.map, session.pipeline.estimator
    if about_map.active_radius_m is not None:
        session.keep_near(about_map.active_radius_m, run.folder / SUBMAPS_FOLDER)
    elif isinstance(estimator, KeepsRecord) and not about_map.saves_session:
        estimator.keep_record_in(run.folder / INPUTS_FOLDER)
    session.keep_log(run.folder / BLOCKS_FOLDER)


def _entry(run: OpenedRun, given: GivenMap | None) -> Entry | None:
    """How the run enters the map; on resuming, how it did."""
    if given is None:
        return None
    if run.goes_on:
        state.require_continuable(given, run.sequence)
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


_FRAMES_BEFORE = "frames_before"  # in config.yaml's provenance
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
        opened = _begin_later(opened, saved.frame)
        outputs = begin(opened, context.progress)
    if saved is not None:
        outputs.recorder.log.rest_in(outputs.folder / LOG_FILE)
        return _result(outputs, "interrupted", saved)
    return _finish(outputs, context)


def drive_first(config: ExperimentConfig, context: Context) -> SlamResult | None:
    """Makes the map of a run, where it asks for that, in its folder `first`; how that ended.

    None where no map is to be made, or it is there already.
    """
    folder = context.folder / map_entry.FIRST_FOLDER
    first = state.first_config(config, folder)
    made = context.resumed and (folder / map_entry.MAP_FILE).is_file()
    # Killed after writing the map, the drive has yet to draw, to report and to tidy up.
    if first is None or (made and not state.has_checkpoint(folder)):
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
            # A run that goes on with another one's session keeps its frames and its world.
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
    state.save_checkpoint(outputs.folder, outputs.pipeline, outputs.recorder)
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
    outputs.recorder.log.rest_in(outputs.folder / LOG_FILE)
    about_map = state.leave_map(outputs)
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
        state.remove_checkpoint(outputs.folder)
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
    write_comparison_csv(folder / COMPARISON_FILE, [(config.name, values)])
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
