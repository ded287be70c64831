"""Runs a recording of measurements, which needs no front-end: every estimator replays it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from fgslam.core.log import LANDMARK_TRUTH_FILE, MeasurementRecording, write_landmark_truth
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import MeasurementDatasetSettings
from fgslam.evaluation.statistics import JsonValue
from fgslam.report.content import read_table, records, write_timing
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.engine import Context, Opening, RunResult, Task, provenance_of
from fgslam.runs.folder import LOG_FILE
from fgslam.runs.report import count_spread
from fgslam.runs.slam_comparison import GROUND_TRUTH_FILE, replay_apart, write_comparison
from fgslam.runs.tables import FRAMES_FILE

_NUMBERS = ("inliers", "solve_ms", "update_ms")


def open_measurements_task(config: ExperimentConfig, opening: Opening) -> Task[RunResult]:
    """Opens or simulates the recording. Raises FgslamError."""
    assert isinstance(config.dataset, MeasurementDatasetSettings)  # noqa: S101 - run.py has asked
    recording = open_measurements(config.dataset, config.seed, config.odometry)
    return Task(provenance_of(recording), lambda context: _run(config, recording, context))


def _run(config: ExperimentConfig, recording: MeasurementRecording, context: Context) -> RunResult:
    """Replays the recording through the configuration's estimators."""
    folder = context.folder
    write_log_and_truth(folder, recording)
    metrics = replay_apart(config, folder, config.estimators, context)
    # Frame by frame, what the estimator of `estimator.kind` did; nothing where it gave none.
    path = folder / config.estimator.title / FRAMES_FILE
    rows = records(read_table(path, _NUMBERS, ("status",))) if path.is_file() else []
    times = (
        (increment.index, increment.timestamp, stage, row[column])
        for increment, row in zip(recording.log.increments, rows, strict=False)
        for stage, column in (("track", "solve_ms"), ("update", "update_ms"))
    )
    write_timing(folder / "timing.csv", times)
    about: dict[str, JsonValue] = {
        "frames_in_recording": len(recording.log),
        "notes": list(recording.notes),
        "status_counts": dict(sorted(Counter(row["status"] for row in rows).items())),
        "landmark_matches": count_spread(np.array([row["inliers"] for row in rows[1:]], np.int64)),
    }
    return write_comparison(context, config, len(recording.log), metrics, about, folder)


def write_log_and_truth(folder: Path, recording: MeasurementRecording) -> None:
    """The log, and what is known to be true. Raises OutputError."""
    recording.log.save(folder / LOG_FILE)
    if recording.ground_truth is not None:
        truth = recording.ground_truth.of(recording.truth_frame, recording.log.rig)
        truth.save(folder / GROUND_TRUTH_FILE)
    if recording.landmark_truth is not None:
        exact = np.zeros(len(recording.landmark_truth))
        write_landmark_truth(folder / LANDMARK_TRUTH_FILE, recording.landmark_truth, exact)
