"""One trial: an experiment in one world of noise, through estimators, start to end."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path

from fgslam.backend.settings import EstimatorSettings
from fgslam.core.log import MeasurementLog
from fgslam.core.threads import one_blas_thread
from fgslam.evaluation.judging import judge_replay
from fgslam.evaluation.statistics import EstimatorMetrics, Nees
from fgslam.runs.config import ExperimentConfig, OutputSettings
from fgslam.runs.engine import run_task
from fgslam.runs.folder import LOG_FILE
from fgslam.runs.slam_comparison import load_truth
from fgslam.runs.tasks.slam import open_slam
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.runs.tasks.slam_measurements import open_measured, write_log_and_truth
from fgslam.slam.replay import replay

_OUTPUT = OutputSettings(pictures=False, report=False, checkpoint_seconds=1e9)


@dataclass(frozen=True, slots=True)
class TrialTask:
    """One world of noise for one process."""

    config: ExperimentConfig
    seed: int
    estimators: tuple[EstimatorSettings, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What one world gave: metrics and normalised errors by title of the estimator."""

    seed: int
    metrics: dict[str, EstimatorMetrics]
    nees: dict[str, dict[str, Nees]]


@one_blas_thread()
def perform_trial(task: TrialTask) -> Trial:
    """One trial, start to end, in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="fgslam-trial-") as scratch:
        run = Path(scratch) / "run"
        maps = dataclasses.replace(task.config.map, save=None)
        config = task.config.model_copy(
            update={"seed": task.seed, "compare": (), "map": maps, "output": _OUTPUT}
        )
        if config.on_measurements:
            run.mkdir()
            write_log_and_truth(run, open_measured(config))
        else:
            run_task(open_slam, config, run)
        log = MeasurementLog.load(run / LOG_FILE)
        truth = load_truth(run, log)
        arrival = None if config.on_measurements else arrival_of(run)  # these begin in no map
    metrics, nees = {}, {}
    for settings in task.estimators:
        answer = replay(log, settings, config.frontend.ego_motion, arrival=arrival)
        judged = judge_replay(answer, truth)
        # A process of several estimators has no memory of each.
        metrics[settings.title] = dataclasses.replace(judged.metrics, peak_memory_mb=None)
        nees[settings.title] = judged.nees
    return Trial(task.seed, metrics, nees)
