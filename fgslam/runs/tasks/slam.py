"""Runs one experiment: images in, run folder out; interruptible and resumable."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from fgslam.core.errors import DatasetError
from fgslam.core.features import StereoFeatures
from fgslam.core.recordings import Sequence
from fgslam.core.threads import one_blas_thread
from fgslam.evaluation.metrics import EstimatorMetrics
from fgslam.report.comparison_table import write_comparison_csv
from fgslam.runs.comparison import COMPARISON_FILE, Compared, replay_apart, tasks_of
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.folder import ExistingFolder
from fgslam.runs.report import report_from_folder
from fgslam.runs.tasks import slam_checkpoint as checkpoint
from fgslam.runs.tasks import slam_map_entry as map_entry
from fgslam.runs.tasks import slam_mapping as mapping
from fgslam.runs.tasks.rendered_truth import TrueDepth
from fgslam.runs.tasks.slam_beginning import BegunRun, OpenedRun, Progress, begin, open_run
from fgslam.runs.tasks.slam_outputs import RunOutputs
from fgslam.runs.tasks.slam_pictures import draw_frame, draw_run, figures_of, frames_to_show
from fgslam.slam.factory import make_stream
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import FrameReport

_SAVING_SHARE = 10.0  # the loop runs at least this many times as long as it saves
_PRECISION_EVERY = 10  # frames between checks of stereo matches against rendered depth
_PRECISION_PX = 1.5  # disparity error of a correct match; a SIFT match's noise is a tenth of it


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """How a run ended."""

    folder: Path
    status: Literal["finished", "interrupted"]
    metrics: EstimatorMetrics
    pictures: tuple[Path, ...]
    outputs: RunOutputs
    compared: Compared | None = None
    about_map: str = ""


@one_blas_thread()
def run_experiment(
    config: ExperimentConfig,
    folder: Path,
    existing: ExistingFolder = "refuse",
    progress: Progress = lambda what, done, total: None,
    stopped: Callable[[], bool] = lambda: False,
) -> RunResult:
    """Runs a configuration into a run folder.

    Args:
        config: the experiment.
        folder: the run folder itself.
        existing: what to do where it holds a run already.
        progress: told after each frame.
        stopped: asked after each frame; True ends the run early, resumable, with all files valid.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    run = open_run(config, folder, existing, progress)
    ended = _drive_first(run, existing, progress, stopped)
    if ended is not None:
        return ended
    begun = begin(run, progress)
    saved = _loop(begun.outputs, progress, stopped)
    if saved is not None:
        return RunResult(folder, "interrupted", saved, (), begun.outputs)
    return _finish(begun, progress, stopped)


def _drive_first(
    run: OpenedRun, existing: ExistingFolder, progress: Progress, stopped: Callable[[], bool]
) -> RunResult | None:
    """Makes the run's own map, where it asks for that; how it ended if that was early."""
    folder = run.folder / map_entry.FIRST_FOLDER
    config = mapping.first_config(run.config, folder)
    if config is None or (existing == "resume" and (folder / map_entry.MAP_FILE).is_file()):
        return None
    resumable = existing == "resume" and checkpoint.exists(folder)
    result = run_experiment(
        config, folder, "resume" if resumable else "overwrite", progress, stopped
    )
    return result if result.status == "interrupted" else None


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


def _finish(begun: BegunRun, progress: Progress, stopped: Callable[[], bool]) -> RunResult:
    outputs = begun.outputs
    pictures: tuple[Path, ...] = ()
    metrics = outputs.write_results("finished")
    about_map = mapping.save(outputs, begun.given)
    if outputs.config.output.pictures:
        pictures = tuple(draw_run(outputs.folder, figures_of(outputs)))
    checkpoint.remove(outputs.folder)
    compared = _compare(outputs, metrics, progress, stopped)
    if outputs.config.output.report:
        report_from_folder(outputs.folder)
    return RunResult(outputs.folder, "finished", metrics, pictures, outputs, compared, about_map)


def _compare(
    outputs: RunOutputs,
    live: EstimatorMetrics,
    progress: Progress,
    stopped: Callable[[], bool],
) -> Compared | None:
    """Replays the run's log through the other estimators that the configuration names."""
    config, folder = outputs.config, outputs.folder
    others = config.estimators[1:]
    if not others:
        return None
    metrics = {outputs.title: live}
    metrics |= replay_apart(tasks_of(config, folder, folder, others), 1, progress, stopped)
    outputs.write_metrics(metrics, "finished")
    write_comparison_csv(folder / COMPARISON_FILE, [(config.name, metrics)])
    return Compared(config.name, folder, folder, len(outputs.recorder), metrics)


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
