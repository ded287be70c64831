"""From one filter a landmark to everything at once: accuracy against cost on four drives.

Strasdat, Montiel and Davison (2012) ask when a filter is worth its time. Each estimator replays the
same measurements in a process of its own, on one thread; :mod:`benchmarks.curves` draws them.
"""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from benchmarks.runs import EXPERIMENTS, experiment, say
from benchmarks.tables import Cell, Table
from fgslam.backend.settings import EstimatorSettings, FastSlamSettings
from fgslam.core.log import MeasurementLog
from fgslam.evaluation.judging import judge_replay
from fgslam.evaluation.statistics import value_at
from fgslam.runs.compare import all_kinds
from fgslam.runs.folder import LOG_FILE
from fgslam.runs.judge import part_of
from fgslam.runs.run import run_experiment
from fgslam.runs.slam_comparison import load_truth
from fgslam.slam.replay import replay

DRIVES = {
    "lab_trials": "simulated",
    "lab_loop": "rendered",
    "euroc_v101": "indoor",
    "kitti06": "road",
}
"""The paper's drive without images and with rendered ones, and two real ones."""
STEPS = (
    "landmark_kalman", "fast_slam", "ekf", "invariant_ekf", "fixed_lag", "sliding_window", "isam2",
    "batch",
)  # fmt: skip
PARTICLES = (1, 3, 10, 30, 100, 300)
EVERY = (16, 8, 4, 2, 1)
"""One landmark in so many is kept: what an estimator gains by its time (Strasdat et al. 3)."""
_RUNS = EXPERIMENTS.parent / "build" / "staircase"  # kept; to measure the drives again, remove it


def tables(data: Path) -> list[Table]:
    """A table a drive, one over the number of particles, and one over that of landmarks."""
    found = []
    for name, what in DRIVES.items():
        if not (_RUNS / name / "metrics.json").is_file():
            say(f"running {name}")
            run_experiment(experiment(name, ("compare=[]",), data), _RUNS / name, "overwrite")
        rows = [_row(name, f"`{kind}`", all_kinds()[kind]) for kind in STEPS]
        found.append(Table(what, ("estimator", *_COLUMNS), rows))
    over = [_row("lab_trials", n, FastSlamSettings(particles=n)) for n in PARTICLES]
    over.append(_row("lab_trials", "`batch`", all_kinds()["batch"]))
    found.append(Table("particles", ("particles", *_COLUMNS), over))
    fewer = [
        (kind, *_row("lab_trials", every, all_kinds()[kind], every))
        for kind in STEPS
        if kind != "fast_slam"  # its curve is that over particles
        for every in EVERY
    ]
    return [*found, Table("landmarks", ("estimator", "one in", *_COLUMNS), fewer)]


_COLUMNS = (
    "ATE live cm", "ATE end cm", "NEES live", "NEES end", "NEES over 20 frames", "CPU ms a frame",
    "MB", "frames", "ended",
)  # fmt: skip


def _row(name: str, first: Cell, settings: EstimatorSettings, every: int = 1) -> tuple[Cell, ...]:
    say(f"replaying {name}: {settings.kind}, {first}")
    apart = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=apart) as executor:
        return (first, *executor.submit(_replayed, name, settings, every).result())


def _replayed(name: str, settings: EstimatorSettings, every: int) -> tuple[Cell, ...]:
    run = _RUNS / name
    log = MeasurementLog.load(run / LOG_FILE)
    log = part_of(log, 0, every)
    began = time.process_time()
    played = replay(log, settings, experiment(name).frontend.ego_motion)
    spent = time.process_time() - began
    metrics = judge_replay(played, load_truth(run, log)).metrics
    more = metrics.more

    def centimetres(ate: float | None) -> float | None:
        return None if ate is None else 100.0 * ate

    return (
        centimetres(value_at(more, "online.ate_rmse_m")), centimetres(metrics.ate_rmse_m),
        value_at(more, "online.nees_pose_per_dof"), metrics.nees_pose_per_dof,
        value_at(more, "nees_relative.20.per_dof"), 1e3 * spent / max(len(played), 1),
        (played.peak_memory_mb or 0.0) - (played.memory_before_mb or 0.0), len(played),
        played.failure,
    )  # fmt: skip
