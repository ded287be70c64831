"""Runs one experiment: images in, run folder out; interruptible and resumable."""

from __future__ import annotations

import math
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from fgslam.config import ExperimentConfig, load_config
from fgslam.errors import ConfigError, DatasetError
from fgslam.export.atomic import RUN_MARKER, ExistingFolder, create_run_folder
from fgslam.export.comparison_table import write_comparison_csv
from fgslam.export.metrics import EstimatorMetrics
from fgslam.factory import make_pipeline, make_stream, open_sequence
from fgslam.frontend.stream import FeatureFrame
from fgslam.measurement_log import MeasurementLog
from fgslam.pipeline import FrameReport
from fgslam.recordings import Sequence
from fgslam.runs import checkpoint
from fgslam.runs.choosing import compared_with
from fgslam.runs.comparison import COMPARISON_FILE, Compared, replay_apart, tasks_of
from fgslam.runs.outputs import RunOutputs, versions
from fgslam.runs.pictures import draw_frame, draw_run, figures_of, frames_to_show
from fgslam.runs.recorder import RunRecorder
from fgslam.runs.rendered_truth import TrueDepth
from fgslam.runs.report import report_from_folder
from fgslam.runs.threads import one_blas_thread
from fgslam.types import StereoFeatures

Progress = Callable[[str, int, int], None]
"""Called with what is under way, how much is done, and of how much."""

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
    if existing == "resume" or (existing == "refuse" and folder.exists()):
        create_run_folder(folder, existing)  # refuses now, not after minutes of rendering
    if existing == "resume":
        checkpoint.require(folder)
        _require_same(config, folder)
    sequence = open_sequence(config, lambda done, total: progress("rendering", done, total))
    _require_odometry(config, sequence)
    create_run_folder(folder, existing)
    pipeline = make_pipeline(
        sequence, config.frontend, config.odometry, config.estimator, config.seed
    )
    recorder = RunRecorder(MeasurementLog(sequence.rig, pipeline.motion.description()))
    outputs = RunOutputs(folder, config, sequence, pipeline, recorder)
    if existing == "resume":
        _require_same_ground(sequence, folder)
        checkpoint.load(folder, pipeline, recorder)
    else:
        outputs.write_config()
    saved = _loop(outputs, progress, stopped)
    if saved is not None:
        return RunResult(folder, "interrupted", saved, (), outputs)
    return _finish(outputs, progress, stopped)


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
            report = _process(outputs, found)
            recorder.add(report, wait_ms, _stereo_precision(sequence, found.i, report.stereo))
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


def _process(outputs: RunOutputs, found: FeatureFrame) -> FrameReport:
    timestamp = float(outputs.sequence.timestamps[found.i])
    # A frame without images has a number, too: the one that the selection gives it.
    dataset = outputs.config.dataset
    index = dataset.start + found.i * dataset.stride
    return outputs.pipeline.process(found, index, timestamp)


def _finish(outputs: RunOutputs, progress: Progress, stopped: Callable[[], bool]) -> RunResult:
    pictures: tuple[Path, ...] = ()
    metrics = outputs.write_results("finished")
    if outputs.config.output.pictures:
        pictures = tuple(draw_run(outputs.folder, figures_of(outputs)))
    checkpoint.remove(outputs.folder)
    compared = _compare(outputs, metrics, progress, stopped)
    if outputs.config.output.report:
        report_from_folder(outputs.folder)
    return RunResult(outputs.folder, "finished", metrics, pictures, outputs, compared)


def _compare(
    outputs: RunOutputs,
    live: EstimatorMetrics,
    progress: Progress,
    stopped: Callable[[], bool],
) -> Compared | None:
    """Replays the run's log through the other estimators that the configuration names."""
    config, folder = outputs.config, outputs.folder
    others = compared_with(config)
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


def _require_odometry(config: ExperimentConfig, sequence: Sequence) -> None:
    """Says before the start, not at frame 1, that a recording lacks odometry."""
    if config.odometry.kind != "recorded" or len(sequence) < 2:
        return
    if all(sequence.odometry(i) is None for i in range(1, len(sequence))):
        raise DatasetError(
            f"{sequence.name} has no odometry; set odometry.kind to constant_velocity, or to "
            "synthetic where there is ground truth"
        )


def _require_same(config: ExperimentConfig, folder: Path) -> None:
    """A run resumes only with the configuration that it was started with."""
    path = folder / RUN_MARKER
    if load_config(path).as_values() != config.as_values():
        raise ConfigError(
            f"{path}: differs from the configuration given; resume with the same one "
            f"({resume_command(folder)}) or start again with --overwrite"
        )


def _require_same_ground(sequence: Sequence, folder: Path) -> None:
    """A run resumes to the same bytes only on its own recording and with its own packages."""
    path = folder / RUN_MARKER
    provenance = load_config(path).provenance or {}
    if (provenance.get("dataset") or {}).get("identity") != sequence.identity:
        raise DatasetError(
            f"{sequence.name}: the recording has changed since {path} was written; restore it, or "
            "start again with --overwrite"
        )
    before, now = provenance.get("versions") or {}, versions()
    differing = [name for name in now if name in before and before[name] != now[name]]
    changed = [f"{name} {before[name]} -> {now[name]}" for name in differing]
    if changed:
        raise ConfigError(
            f"{path}: started with other versions ({', '.join(changed)}), which would not give the "
            "same bytes; restore them, or start again with --overwrite"
        )


def resume_command(folder: Path) -> str:
    """What to type to continue the run in ``folder``, whatever overrides it was started with."""
    run = shlex.quote(str(folder))
    return f"fgslam run {shlex.quote(str(folder / RUN_MARKER))} --out {run} --resume"
