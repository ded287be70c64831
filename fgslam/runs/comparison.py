"""Replays the log of a run through estimators, each in a process of its own, and compares them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import DatasetError
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.trajectories import read_tum
from fgslam.evaluation.judging import Truth, judge_replay, seen_often
from fgslam.evaluation.metrics import EstimatorMetrics
from fgslam.frontend.tracking.settings import EgoMotionSettings
from fgslam.report.point_cloud import MapPoints, read_ply
from fgslam.report.tables import LANDMARK_TRUTH_FILE, read_landmark_truth
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.engine import Context
from fgslam.runs.estimator_files import write_replay
from fgslam.runs.folder import LOG_FILE, RUN_MARKER, is_run_folder
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.runs.units import Stage, one_by_one
from fgslam.slam.replay import replay

GROUND_TRUTH_FILE = "ground_truth.tum"
SYNTHETIC_REMARK = "odometry: SYNTHETIC (ground truth plus stated noise, see config.yaml)"


@dataclass(frozen=True, slots=True)
class ReplayTask:
    """What one process is to do: replay the log of ``run``, write into ``out/<title>/``."""

    run: Path
    out: Path
    settings: EstimatorSettings
    ego_motion: EgoMotionSettings
    remark: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """The estimators of one run side by side.

    Attributes:
        name: of the run.
        run: its folder.
        out: where the results are.
        frames: in the log.
        metrics: by title, in the order asked for.
        notes: what was tolerated in the recording.
        pictures: drawn, if any.
    """

    name: str
    run: Path
    out: Path
    frames: int
    metrics: dict[str, EstimatorMetrics]
    notes: tuple[str, ...] = ()
    pictures: tuple[Path, ...] = field(default=())

    @property
    def failures(self) -> dict[str, str]:
        """Why an estimator ended early, by title."""
        found = {title: failure_of(metrics) for title, metrics in self.metrics.items()}
        return {title: why for title, why in found.items() if why}


def failure_of(metrics: EstimatorMetrics) -> str:
    """Why the estimator ended early; empty where it did not."""
    return str(metrics.more.get("failure") or "")


def tasks_of(
    config: ExperimentConfig, run: Path, out: Path, estimators: Sequence[EstimatorSettings]
) -> list[ReplayTask]:
    """A task for each estimator."""
    ego_motion, remark = config.frontend.ego_motion, remark_of(config)
    return [ReplayTask(run, out, settings, ego_motion, remark) for settings in estimators]


def replay_apart(
    tasks: Sequence[ReplayTask], context: Context, single_threaded: bool = False
) -> dict[str, EstimatorMetrics]:
    """Every task in its own process; metrics by title, in the order of the tasks.

    With one job the times do not disturb each other.
    """
    stage = Stage(
        name="replays",
        label="replaying",
        count=len(tasks),
        work=_perform_all,
        argument=lambda units: [tasks[k] for k in units],
        kind=EstimatorMetrics,
        blocks=one_by_one,
    )
    done = context.perform(stage, single_threaded)
    found = dict(done.results)
    for (k,), why in done.ended:
        found[k] = EstimatorMetrics(more={"kind": tasks[k].settings.kind, "failure": why})
    return {task.settings.title: found[k] for k, task in enumerate(tasks)}


def _perform_all(tasks: Sequence[ReplayTask]) -> list[EstimatorMetrics]:
    return [perform(task) for task in tasks]


def perform(task: ReplayTask) -> EstimatorMetrics:
    """One estimator, start to end: replay, files, judgement.

    Raises:
        FgslamError: the log or the truth cannot be read, or a file cannot be written.
    """
    log = MeasurementLog.load(task.run / LOG_FILE)
    result = replay(log, task.settings, task.ego_motion, arrival=arrival_of(task.run))
    write_replay(task.out, result, log, task.remark, _look(task.run))
    return judge_replay(result, load_truth(task.run, log)).metrics


def load_truth(run: Path, log: MeasurementLog) -> Truth:
    """What the run folder knows to be true, the landmarks being those seen often enough.

    Raises:
        DatasetError: a file of it is damaged.
    """
    path, landmark_path = run / GROUND_TRUTH_FILE, run / LANDMARK_TRUTH_FILE
    trajectory = read_tum(path) if path.is_file() else None
    if not landmark_path.is_file():
        return Truth(trajectory)
    landmarks, sigma = read_landmark_truth(landmark_path)
    judged = seen_often(log, landmarks)
    own = sigma[np.isin(landmarks.ids, judged.ids)]
    return Truth(trajectory, judged, float(np.median(own)) if len(own) else None)


def load_run(run: Path) -> tuple[ExperimentConfig, MeasurementLog]:
    """Configuration and log of a run folder.

    Raises:
        DatasetError: it is none.
        FgslamError: one of the two cannot be read.
    """
    if not is_run_folder(run):
        what = f"not a run folder (no {RUN_MARKER}); give what fgslam run wrote"
        if run.is_file():
            what = "not a run folder; give it to fgslam run first, or add --trials N"
        raise DatasetError(f"{run}: {what}")
    config = load_config(run / RUN_MARKER)
    log = MeasurementLog.load(run / LOG_FILE)
    if not len(log):
        raise DatasetError(f"{run / LOG_FILE}: holds no frame; resume the run first")
    return config, log


def remark_of(config: ExperimentConfig) -> str:
    """Marks results whose odometry was made from ground truth; empty otherwise."""
    return SYNTHETIC_REMARK if config.odometry.kind == "synthetic" else ""


def _look(run: Path) -> MapPoints | None:
    """The colours that the live front-end saw; None where the run had no images."""
    config = load_config(run / RUN_MARKER)
    path = run / config.estimator.title / "map.ply"
    return read_ply(path) if path.is_file() else None
