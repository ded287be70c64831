"""Whole drives: the paper's loop, ten other seeds of it, and the real recordings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.runs import DATA, Run, experiment, run_whole
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import IntArray


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

FINAL_GOALS = (
    Goal("euroc_v101", ("estimator.kind=isam2", "compare=[]"), 0.015, None),
    Goal("kitti06", ("estimator.kind=isam2", "compare=[]"), 0.055, None),
)
"""Of the final estimate of the default estimator, with the default front-end."""


def reach(goal: Goal, data: Path = DATA) -> Run:
    """Runs one of the goals."""
    return run_whole(experiment(goal.experiment, goal.overrides, data))


def real_table(data: Path = DATA) -> Table:
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


COLUMNS = (
    "seed", "ATE cm", "end cm", "yaw deg", "pitch deg", "roll deg",
    "matched, 5 %", "landmarks", "precision", "NEES per dof",
)  # fmt: skip
_LESS_IS_BETTER = ("ATE cm", "end cm", "yaw deg", "pitch deg", "roll deg", "NEES per dof")


def seeds_table(seeds: Iterable[int] = range(1, 11)) -> Table:
    """One row a seed, and the worst of each column."""
    rows = [row(run_whole(experiment("lab_loop", [f"seed={seed}"]))) for seed in seeds]
    return Table("Ten other seeds", COLUMNS, [*rows, _worst(rows)])


def row(run: Run) -> tuple[Cell, ...]:
    """The numbers that are bounded, of one run of the lab loop."""
    end = run.estimator["end_against_start"]
    return (
        run.result.outputs.config.seed,
        100.0 * run.estimator["ate_rmse_m"],
        end["distance_cm"],
        end["yaw_deg"],
        end["pitch_deg"],
        end["roll_deg"],
        run.metrics["landmark_matches"]["p05"],
        run.estimator["landmarks"],
        run.metrics["stereo_precision"],
        run.estimator["nees_pose_per_dof"],
    )


def _worst(rows: list[tuple[Cell, ...]]) -> tuple[Cell, ...]:
    out: list[Cell] = ["**worst**"]
    for name, values in zip(COLUMNS[1:], list(zip(*rows, strict=True))[1:], strict=True):
        numbers = [abs(float(v)) for v in values if v is not None]
        out.append(max(numbers) if name in _LESS_IS_BETTER else min(numbers))
    return tuple(out)


_VARIANTS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("3 degrees of freedom (default)", ()),
    ("5 (the paper's)", ("frontend.ego_motion.dof=5",)),
    ("6", ("frontend.ego_motion.dof=6",)),
    ("3, `appearance: paper`", ("frontend.appearance.mode=paper",)),
    ("5, `appearance: paper`", ("frontend.appearance.mode=paper", "frontend.ego_motion.dof=5")),
)


def paper_tables() -> list[Table]:
    """End pose and accuracy; landmarks and matches. One row a variant, the paper's first."""
    runs = [(name, run_whole(experiment("lab_loop", options))) for name, options in _VARIANTS]
    return [_end_poses(runs), _maps(runs)]


def _end_poses(runs: list[tuple[str, Run]]) -> Table:
    columns = (
        "degrees of freedom", "X cm", "Y cm", "Z cm", "distance cm",
        "yaw deg", "pitch deg", "roll deg", "ATE cm", "NEES per dof",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = [
        ("paper (5)", -2.09, 0.0, -3.91, 4.43, 0.30, 2.10, -2.02, None, None)
    ]
    rows += [_end_row(name, run) for name, run in runs]
    return Table("End pose against the start", columns, rows)


def _end_row(name: str, run: Run) -> tuple[Cell, ...]:
    end = run.estimator["end_against_start"]
    keys = ("x_cm", "y_cm", "z_cm", "distance_cm", "yaw_deg", "pitch_deg", "roll_deg")
    accuracy = (100.0 * run.estimator["ate_rmse_m"], run.estimator["nees_pose_per_dof"])
    return (name, *(end[key] + 0.0 for key in keys), *accuracy)


def _maps(runs: list[tuple[str, Run]]) -> Table:
    columns = (
        "degrees of freedom", "landmarks", "valid (3 hits)", "stereo matches, median",
        "matched to the map: 5 %", "median", "95 %", "frames with more than 30, %", "mean E px",
        "stereo precision",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = [
        ("paper (5)", 3590, None, 60, "40", None, "60", None, None, None)
    ]
    rows += [_map_row(name, run) for name, run in runs]
    return Table("Landmarks and matches", columns, rows)


def _map_row(name: str, run: Run) -> tuple[Cell, ...]:
    outputs, matched = run.result.outputs, run.metrics["landmark_matches"]
    inliers: IntArray = outputs.recorder.column("inliers")[1:]
    return (
        name,
        run.estimator["landmarks"],
        int(outputs.pipeline.tracker.database.valid.sum()),
        run.metrics["stereo_matches"]["median"],
        matched["p05"],
        matched["median"],
        matched["p95"],
        100.0 * float(np.mean(inliers > 30)),
        run.metrics["mean_residual_px"],
        run.metrics["stereo_precision"],
    )
