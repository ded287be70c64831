"""The real recordings (docs/results)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarks.runs import DATA, Run, experiment, run_whole
from benchmarks.tables import Cell, Table


@dataclass(frozen=True)
class Goal:
    """A run on a real recording and what it must reach."""

    experiment: str
    overrides: tuple[str, ...]
    ate_m: float
    drift_percent: float | None


GOALS = (
    Goal("euroc_v101", (), 0.10, None),
    Goal("kitti_raw_0926", (), 0.40, None),
    Goal("kitti_raw_0926", ("odometry.kind=constant_velocity",), 0.50, 1.1),
    Goal("kitti06", (), 0.15, None),
)


def reach(goal: Goal, data: Path = DATA) -> Run:
    """Runs one of the goals."""
    return run_whole(experiment(goal.experiment, goal.overrides, data))


def table(data: Path = DATA) -> Table:
    """Accuracy on each of the recordings."""
    columns = (
        "experiment", "odometry", "tracked", "ATE m", "drift %", "RPE m", "RPE deg", "NEES per dof",
    )  # fmt: skip
    return Table("Real recordings", columns, [_row(goal, reach(goal, data)) for goal in GOALS])


def _row(goal: Goal, run: Run) -> tuple[Cell, ...]:
    numbers = run.estimator
    return (
        goal.experiment,
        run.metrics["odometry"],
        run.tracked,
        numbers["ate_rmse_m"],
        numbers["drift_percent"],
        numbers["rpe_trans_m"],
        numbers["rpe_rot_deg"],
        numbers["nees_pose_per_dof"],
    )
