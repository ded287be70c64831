"""A run of SLAM through other estimators: its log replayed, each in a process of its own, judged.

The run itself compares the estimators of its configuration so, and `fgslam compare` any.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.backend.settings import DeadReckoningSettings, EstimatorSettings
from fgslam.core.errors import DatasetError
from fgslam.core.log import LANDMARK_TRUTH_FILE, MeasurementLog, read_landmark_truth
from fgslam.core.types import Trajectory
from fgslam.evaluation.judging import Truth, judge_replay, seen_often
from fgslam.evaluation.statistics import EstimatorMetrics, JsonValue
from fgslam.report.content import read_metrics, write_metrics
from fgslam.report.formats import read_ply
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.engine import Context, RunResult, Status, Task
from fgslam.runs.folder import COMPARISON_FILE, LOG_FILE, METRICS_FILE, RUN_MARKER, digest_of
from fgslam.runs.report import report_from_folder
from fgslam.runs.tables import (
    SYNTHETIC,
    comparison_particulars,
    comparison_tables,
    with_marks,
    write_comparison_csv,
    write_replay,
)
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.slam.replay import replay

GROUND_TRUTH_FILE = "ground_truth.tum"


def open_slam_comparison(
    config: ExperimentConfig, run: Path, estimators: Sequence[EstimatorSettings]
) -> Task[RunResult]:
    """The log of a run, through estimators; one that cannot be judged is refused now.

    Raises:
        FgslamError: log or truth of the run cannot be read.
    """
    log = MeasurementLog.load(run / LOG_FILE)
    if not len(log):
        raise DatasetError(f"{run / LOG_FILE}: holds no frame; resume the run first")
    load_truth(run, log)
    metrics_file = run / METRICS_FILE
    notes = read_metrics(metrics_file).get("notes") if metrics_file.is_file() else None
    about: dict[str, JsonValue] = {
        "run": str(run),
        "notes": [str(note) for note in notes or ()],  # what was tolerated in the recording
    }

    def compare(context: Context) -> RunResult:
        metrics = replay_apart(config, run, estimators, context)
        return write_comparison(context, config, len(log), metrics, about, run)

    provenance = {
        "dataset": (config.provenance or {}).get("dataset"),
        "run": str(run),
        "log": digest_of([run / LOG_FILE]),
    }
    return Task(provenance, compare)


def named(config: ExperimentConfig) -> str:
    """The run's name over tables; marked where its odometry was made from the truth."""
    return with_marks(config.name, [SYNTHETIC if config.remark else ""])


def with_odometry(config: ExperimentConfig, values: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of estimators by title, and the kind of odometry, for tables in files."""
    kind = config.odometry.kind
    return {title: {**metrics, "odometry": kind} for title, metrics in values.items()}


def judged_apart(
    config: ExperimentConfig, estimators: Sequence[EstimatorSettings]
) -> tuple[EstimatorSettings, ...]:
    """Estimators whose replay means something: without odometry, dead reckoning has no motion."""
    if config.odometry.kind != "constant_velocity":
        return tuple(estimators)
    return tuple(one for one in estimators if one.kind != DeadReckoningSettings.kind)


def replay_apart(
    config: ExperimentConfig,
    run: Path,
    estimators: Sequence[EstimatorSettings],
    context: Context,
) -> dict[str, EstimatorMetrics]:
    """Metrics of estimators by title, each replayed in its own process into the context's folder.

    With one job the times do not disturb each other.
    """
    names, work = ("replays", "replaying"), partial(perform, config, run, context.folder)
    found = context.perform(names, work, estimators, EstimatorMetrics, fresh=True).all(
        lambda k, why: EstimatorMetrics(more={"kind": estimators[k].kind, "failure": why})
    )
    return {settings.title: one for settings, one in zip(estimators, found, strict=True)}


def perform(
    config: ExperimentConfig, run: Path, out: Path, settings: EstimatorSettings
) -> EstimatorMetrics:
    """One estimator, start to end: replays the log of ``run``, writes ``out/<title>/``, judges.

    Raises:
        FgslamError: the log or the truth cannot be read, or a file cannot be written.
    """
    log = MeasurementLog.load(run / LOG_FILE)
    result = replay(log, settings, config.frontend.ego_motion, arrival=arrival_of(run))
    # The colours that the live front-end saw, where the run had images.
    colours = run / load_config(run / RUN_MARKER).estimator.title / "map.ply"
    look = read_ply(colours) if colours.is_file() else None
    truth, live = load_truth(run, log), colours.parent / "final.tum"
    known = Trajectory.load(live) if live.is_file() else truth.trajectory
    frame = "left" if known is None else known.frame  # as the run's other files
    write_replay(out, result, log, config.remark, look, frame)
    return judge_replay(result, truth).metrics


def write_comparison(
    context: Context,
    config: ExperimentConfig,
    frames: int,
    metrics: Mapping[str, EstimatorMetrics],
    about: Mapping[str, JsonValue],
    run: Path,
) -> RunResult:
    """metrics.json, comparison.csv and report.html of estimators, and the result that shows them.

    Args:
        context: its folder holds the estimators' own files.
        config: of the run.
        frames: in its log.
        metrics: by title.
        about: further values of metrics.json, after the run's name and status.
        run: folder of the run.
    """
    out = context.folder
    status: Status = "interrupted" if context.stopped() else "finished"
    values = {title: one.as_json() for title, one in metrics.items()}
    own: dict[str, JsonValue] = {"name": config.name, "status": status}
    own |= {"odometry": config.odometry.kind, "remark": config.remark or None, **about}
    write_metrics(out / METRICS_FILE, frames, metrics, own)
    write_comparison_csv(out / COMPARISON_FILE, [(config.name, with_odometry(config, values))])
    if config.output.report:
        report_from_folder(out, run)
    return RunResult(
        config,
        out,
        status,
        tables=comparison_tables(named(config), frames, values),
        particulars=comparison_particulars(values, out),
        failed=all(one.more.get("failure") for one in metrics.values()),
    )


# --------------------------------------------------------------------------------------------
# What a run folder knows


def load_truth(run: Path, log: MeasurementLog) -> Truth:
    """What the run folder knows to be true, the landmarks being those seen often enough.

    Raises:
        DatasetError: a file of it is damaged.
    """
    path, landmark_path = run / GROUND_TRUTH_FILE, run / LANDMARK_TRUTH_FILE
    trajectory = Trajectory.load(path) if path.is_file() else None
    if not landmark_path.is_file():
        return Truth(trajectory, rig=log.rig)
    landmarks, sigma = read_landmark_truth(landmark_path)
    judged = seen_often(log, landmarks)
    own = sigma[np.isin(landmarks.ids, judged.ids)]
    return Truth(trajectory, judged, float(np.median(own)) if len(own) else None, log.rig)
