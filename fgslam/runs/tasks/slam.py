"""Runs one experiment: images in, run folder out; interruptible and resumable."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.errors import DatasetError
from fgslam.core.features import StereoFeatures
from fgslam.core.recordings import Sequence
from fgslam.evaluation.metrics import EstimatorMetrics
from fgslam.report.tables import write_comparison_csv
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task, run_task
from fgslam.runs.folder import COMPARISON_FILE, ExistingFolder, is_run_folder
from fgslam.runs.metric_tables import comparison_particulars, comparison_tables
from fgslam.runs.report import report_from_folder
from fgslam.runs.slam_comparison import replay_apart
from fgslam.runs.tasks import slam_checkpoint as checkpoint
from fgslam.runs.tasks import slam_map_entry as map_entry
from fgslam.runs.tasks import slam_mapping as mapping
from fgslam.runs.tasks.rendered_truth import TrueDepth
from fgslam.runs.tasks.slam_beginning import BegunRun, OpenedRun, begin, open_run
from fgslam.runs.tasks.slam_outputs import RunOutputs, run_notes, summary_table
from fgslam.runs.tasks.slam_pictures import draw_frame, draw_run, figures_of, frames_to_show
from fgslam.runs.units import Progress
from fgslam.slam.factory import make_stream
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import FrameReport

_SAVING_SHARE = 10.0  # the loop runs at least this many times as long as it saves
_PRECISION_EVERY = 10  # frames between checks of stereo matches against rendered depth
_PRECISION_PX = 1.5  # disparity error of a correct match; a SIFT match's noise is a tenth of it


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


def open_slam(config: ExperimentConfig, opening: Opening) -> Task[SlamResult]:
    """Opens recording and map. Raises FgslamError."""
    opened = open_run(config, opening)
    return Task(opened.provenance, lambda context: _run(opened, context))


def _run(opened: OpenedRun, context: Context) -> SlamResult:
    """The drive that makes the map, where the run asks for one, and the run itself."""
    ended = drive_first(opened.config, context)
    if ended is not None and ended.status == "interrupted":
        return ended
    begun = begin(opened, context.progress)
    saved = _loop(begun.outputs, context.progress, context.stopped)
    if saved is not None:
        return _result(begun.outputs, "interrupted", saved)
    return _finish(begun, context)


def drive_first(config: ExperimentConfig, context: Context) -> SlamResult | None:
    """Makes the map of a run, where it asks for that, in its folder `first`; how that ended.

    None where no map is to be made, or it is there already.
    """
    folder = context.folder / map_entry.FIRST_FOLDER
    first = mapping.first_config(config, folder)
    made = context.resumed and (folder / map_entry.MAP_FILE).is_file()
    # Killed after writing the map, the drive has yet to draw, to report and to tidy up.
    if first is None or (made and not checkpoint.exists(folder)):
        return None
    existing: ExistingFolder = "overwrite"
    if context.resumed and is_run_folder(folder):
        existing = "resume"
    return run_task(open_slam, first, folder, existing, context.progress, context.stopped)


def _loop(
    outputs: RunOutputs, progress: Progress, stopped: Callable[[], bool]
) -> EstimatorMetrics | None:
    """Processes the remaining frames; what was saved when stopped before the last one, or None."""
    sequence, recorder = outputs.sequence, outputs.recorder
    shown = frames_to_show(len(sequence)) if outputs.config.output.pictures else frozenset()
    stream = make_stream(sequence, outputs.config.frontend)(start=len(recorder))
    waiting = time.perf_counter()
    interval = outputs.config.output.checkpoint_seconds
    saved = -math.inf  # the first frame is saved at once: from then on any end can be resumed
    try:
        for found in stream:
            wait_ms = 1e3 * (time.perf_counter() - waiting)
            report = _advance(outputs, found, wait_ms)
            if found.i in shown:
                draw_frame(outputs, found.i, report)
            progress("tracking", len(recorder), len(sequence))
            done = len(recorder) == len(sequence)
            if not done and stopped():
                return save_progress(outputs)
            if not done and time.perf_counter() - saved >= interval:
                interval = _save_timed(outputs)
                saved = time.perf_counter()
            waiting = time.perf_counter()
    except DatasetError:
        # The recording failed before its frame touched any state: all up to it can be kept.
        if len(recorder):
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
    checkpoint.save(outputs.folder, outputs.pipeline, outputs.recorder)
    return metrics


def _advance(outputs: RunOutputs, found: FeatureFrame, wait_ms: float) -> FrameReport:
    """Pushes one frame with its odometry into the session."""
    sequence, session = outputs.sequence, outputs.session
    # A frame without images has a number, too: the one that the selection gives it.
    index = outputs.first_frame + found.i * outputs.config.dataset.stride
    return session.advance(
        found,
        float(sequence.timestamps[found.i]),
        body_motion(sequence, found.i, session.pipeline.motion),
        index,
        wait_ms,
        lambda report: _stereo_precision(sequence, found.i, report.stereo),
    )


def _finish(begun: BegunRun, context: Context) -> SlamResult:
    outputs = begun.outputs
    pictures: tuple[Path, ...] = ()
    live = outputs.write_results("finished")
    about_map = mapping.save(outputs, begun.given)
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
        checkpoint.remove(outputs.folder)
    return _result(outputs, status, live, pictures, compared, about_map)


def _compare(outputs: RunOutputs, live: EstimatorMetrics, context: Context) -> dict[str, Any]:
    """Metrics of the estimators that the configuration compares; empty where there is only one.

    Those beside the live one replay the run's log.
    """
    config, folder = outputs.config, outputs.folder
    others = config.estimators[1:]
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
    tables = comparison_tables(outputs.config.name, len(outputs.recorder), compared or {})
    return SlamResult(
        config=outputs.config,
        folder=outputs.folder,
        status=status,
        tables=(summary_table(outputs, live), *tables),
        notes=run_notes(outputs, live),
        particulars=(*files, *comparison_particulars(compared or {}, outputs.folder)),
        reached=f"after {len(outputs.recorder)} frames",
        outputs=outputs,
        live=live,
        pictures=pictures,
    )


def _stereo_precision(sequence: Sequence, i: int, stereo: StereoFeatures) -> float:
    """Fraction of stereo matches whose disparity is the rendered one's, every tenth frame.

    The nearest of the four pixels around a feature decides: at an edge of depth either side is
    right.
    """
    if i % _PRECISION_EVERY or not isinstance(sequence, TrueDepth) or not len(stereo):
        return float("nan")
    depth = sequence.depth(i)
    height, width = depth.shape
    low = np.floor(stereo.measurement[:, :2]).astype(np.int64)
    columns = np.clip(low[:, 0, None] + [0, 1, 0, 1], 0, width - 1)
    rows = np.clip(low[:, 1, None] + [0, 0, 1, 1], 0, height - 1)
    rig = sequence.rig
    true = rig.fx * rig.baseline / depth[rows, columns]
    error = np.abs(true - stereo.measurement[:, 2:]).min(axis=1)
    return float(np.mean(error <= _PRECISION_PX))
