"""Task of SLAM: images in, trajectory, covariances and map out; interruptible and resumable.

Units: none but the replays of further estimators; the drive itself keeps a checkpoint.
Before the first frame: :mod:`fgslam.runs.tasks.slam_opening`. Files and numbers:
:mod:`fgslam.runs.tasks.slam_outputs`, :mod:`fgslam.runs.tasks.slam_metrics`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from fgslam.core.errors import DatasetError
from fgslam.core.measurements import Odometry
from fgslam.evaluation.statistics import EstimatorMetrics
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task, run_task
from fgslam.runs.folder import COMPARISON_FILE, ExistingFolder, is_run_folder
from fgslam.runs.owner import give_back
from fgslam.runs.report import report_from_folder
from fgslam.runs.slam_comparison import judged_apart, named, replay_apart, with_odometry
from fgslam.runs.tables import comparison_particulars, comparison_tables, write_comparison_csv
from fgslam.runs.tasks import slam_map_entry as map_entry
from fgslam.runs.tasks import slam_state as state
from fgslam.runs.tasks.slam_metrics import located
from fgslam.runs.tasks.slam_opening import OpenedRun, begin, begin_later, open_run
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
from fgslam.slam.factory import make_stream
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import FrameReport

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
