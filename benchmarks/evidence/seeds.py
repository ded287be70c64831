"""Ten other seeds of image noise and odometry on the paper's drive (docs/results)."""

from __future__ import annotations

from collections.abc import Iterable

from benchmarks.runs import Run, experiment, run_whole
from benchmarks.tables import Cell, Table

COLUMNS = (
    "seed", "ATE cm", "end cm", "yaw deg", "pitch deg", "roll deg",
    "matched, 5 %", "landmarks", "precision", "NEES per dof",
)  # fmt: skip
_LESS_IS_BETTER = ("ATE cm", "end cm", "yaw deg", "pitch deg", "roll deg", "NEES per dof")


def table(seeds: Iterable[int] = range(1, 11)) -> Table:
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
