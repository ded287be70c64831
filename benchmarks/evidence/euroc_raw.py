"""EuRoC as its cameras gave it against the pairs that others rectified at half the size."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.runs import (
    DATA,
    FoundFeatures,
    ate_m,
    experiment,
    find_features,
    make_system,
    process,
    say,
)
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray
from fgslam.core.threads import one_blas_thread
from fgslam.evaluation.statistics import align, associate, moved

SEEDS = range(3)
"""Of the synthetic odometry; both sets get errors of the same draws."""
ESTIMATORS = {
    "isam2": ("estimator.kind=isam2",),
    "batch": ("estimator.kind=batch",),
    "landmark_kalman": ("estimator.kind=landmark_kalman",),
}
_RAW = "euroc_v101_raw"

_COLUMNS = (
    "estimator", "ATE cm, rectified at half the size", "ATE cm, raw", "raw over rectified",
    "standard error of that", "located, rectified", "located, raw",
    "too short by %, rectified", "too short by %, raw",
    "ATE cm without that, rectified", "ATE cm without that, raw",
)  # fmt: skip


def tables(data: Path = DATA, seeds: Sequence[int] = SEEDS) -> list[Table]:
    """One row an estimator, means over the seeds."""
    found = np.array([_both(data, seed) for seed in seeds])  # (seeds, sets, estimators, 4)
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(ESTIMATORS):
        ates, rest = found[:, :, k, 0], found[:, :, k, 1:].mean(axis=0)
        half, raw = ates.mean(axis=0).tolist()
        spread = (ates[:, 1] - ates[:, 0]).std(ddof=1) if len(ates) > 1 else np.nan
        error = float(spread / np.sqrt(len(ates)) / half)
        rows.append((name, half, raw, raw / half, error, *rest.T.ravel().tolist()))
    return [Table(f"EuRoC V1_01, raw and rectified, {len(seeds)} draws", _COLUMNS, rows)]


def _both(data: Path, seed: int) -> FloatArray:
    return np.array([of_set(data, seed, raw, ESTIMATORS) for raw in (False, True)])


@one_blas_thread()
def of_set(data: Path, seed: int, raw: bool, estimators: Iterable[str]) -> FloatArray:
    """(estimators, 4) of one set, as :func:`_judged` has them."""
    where = (f"dataset={{kind: euroc, path: {data / _RAW}}}",) if raw else ()
    base = (*where, f"seed={seed}", "compare=[]")
    found = find_features(experiment("euroc_v101", base, data))
    say(f"{found.sequence.name}: {len(found.frames)} pairs")
    return np.array([_judged(found, (*base, *ESTIMATORS[name]), data) for name in estimators])


def _judged(
    found: FoundFeatures, overrides: Iterable[str], data: Path
) -> tuple[float, float, float, float]:
    """ATE in cm after SE3 alignment, share of frames located, percent too short, ATE without that.

    Raises ValueError where there is no truth.
    """
    pipeline = make_system(experiment("euroc_v101", overrides, data), found.sequence)
    measured = [report.tracking.status.measured for report in process(found, pipeline)][1:]
    estimate, truth = pipeline.estimate().trajectory, found.sequence.ground_truth
    if truth is None:
        raise ValueError("EuRoC's recordings have ground truth")
    rows, known = associate(estimate.timestamps, truth.timestamps)
    scale, rest = without_scale(estimate.poses[rows], truth.poses[known])
    ate = ate_m(pipeline, found.sequence)
    return 100.0 * ate, float(np.mean(measured)), 100.0 * (scale - 1.0), 100.0 * rest


def without_scale(estimate: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """The factor that fits poses (n, 4, 4) to the truth best, and the RMS error left, metres.

    The rotation of the best rigid motion is that of the best similarity, too (Umeyama 1991).
    Raises ValueError where there is none.
    """
    tTe = align(estimate, truth)
    if tTe is None:
        raise ValueError("too few poses to be aligned")
    aligned = moved(tTe, estimate)
    a, b = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (aligned, truth))
    scale = float((a * b).sum() / (a * a).sum())
    return scale, float(np.sqrt(((scale * a - b) ** 2).sum(axis=1).mean()))
