"""The lab's drive through lenses against ideal pinhole cameras of the same view, seed by seed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from benchmarks.evidence.lens_views import RigInTheLab, loaded, raw_cameras
from benchmarks.runs import (
    FoundFeatures,
    experiment,
    found_features,
    make_system,
    process,
    say,
    trajectory_error,
)
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError
from fgslam.core.threads import one_blas_thread
from fgslam.runs.config_models import ExperimentConfig
from fgslam.worlds.lab import make_rig
from fgslam.worlds.lab_settings import RenderedLabSettings

SEEDS = range(1, 11)
CAMERAS = (3, 2)
ESTIMATORS = ("isam2", "landmark_kalman")
"""The default, and the Kalman filter."""

_COLUMNS = (
    "cameras", "estimator", "ATE cm, pinholes", "ATE cm, lenses", "lenses over pinholes - 1, %",
    "its standard error, %", "worst seed cm, pinholes", "worst seed cm, lenses",
)  # fmt: skip


def tables(seeds: Sequence[int] = SEEDS, changes: Iterable[str] = ()) -> list[Table]:
    """One row a rig and estimator; means over seeds that share drive, odometry and noise."""
    rows: list[tuple[Cell, ...]] = []
    for cameras in CAMERAS:
        pairs = np.array([ates_cm(cameras, seed, changes) for seed in seeds])
        rows += [
            (f"{cameras}", estimator, *_compared(pairs[:, k]))
            for k, estimator in enumerate(ESTIMATORS)
        ]
    return [Table(f"Lab through lenses, {len(seeds)} seeds", _COLUMNS, rows)]


@one_blas_thread()
def ates_cm(cameras: int, seed: int, changes: Iterable[str] = ()) -> FloatArray:
    """ATE (estimators, 2) in cm of pinhole cameras and of lenses at one seed."""
    pinholes, lenses = recordings(cameras, seed, changes)
    found = []
    for sequence in (pinholes, lenses):
        say(f"{sequence.name}: {cameras} cameras, seed {seed}")
        features = found_features(sequence, _config(seed, changes).frontend)
        found.append([_ate_cm(features, seed, k, changes) for k in ESTIMATORS])
    return np.array(found).T


def recordings(
    cameras: int, seed: int, changes: Iterable[str] = ()
) -> tuple[RigInTheLab, RigInTheLab]:
    """The lab seen by ideal pinhole cameras and through lenses, both of one rectified view."""
    settings = _config(seed, changes).dataset
    if not isinstance(settings, RenderedLabSettings):
        raise ConfigError("lenses look at the rendered lab")
    raw = raw_cameras(make_rig(settings.rig))
    rig = loaded(raw[:cameras])
    return RigInTheLab(settings, seed, rig.plain()), RigInTheLab(settings, seed, rig, raw)


def _config(seed: int, changes: Iterable[str], estimator: str = ESTIMATORS[0]) -> ExperimentConfig:
    return experiment("lab_loop", [f"estimator.kind={estimator}", f"seed={seed}", *changes])


def _ate_cm(found: FoundFeatures, seed: int, estimator: str, changes: Iterable[str]) -> float:
    pipeline = make_system(_config(seed, changes, estimator), found.sequence)
    for _ in process(found, pipeline):
        pass
    ate = trajectory_error(pipeline, found.sequence).ate_rmse_m
    return float("nan") if ate is None else 100.0 * ate


def _compared(pairs: FloatArray) -> tuple[Cell, ...]:
    """Means, their ratio less one with its standard error, and the worst of (seeds, 2)."""
    ideal, real = pairs.mean(axis=0).tolist()
    less = pairs[:, 1] - pairs[:, 0]
    error = float(less.std(ddof=1) / np.sqrt(len(less))) if len(less) > 1 else float("nan")
    worst = pairs.max(axis=0).tolist()
    return (ideal, real, 100.0 * (real / ideal - 1.0), 100.0 * error / ideal, *worst)
