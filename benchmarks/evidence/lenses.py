"""The lab's drive through lenses against ideal pinhole cameras of the same view, seed by seed.

Every seed has a room of its own. What a rendered image does to a patch between its pixels is the
same at every draw of noise, so that drives through one room are no independent samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce

import numpy as np

from benchmarks.evidence.lens_views import RigInTheLab, loaded, raw_cameras
from benchmarks.runs import (
    FoundFeatures,
    ate_m,
    experiment,
    found_features,
    make_system,
    process,
    say,
)
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError
from fgslam.core.geometry import KERNEL, GaussNewton, Linearised, inverse_spd3
from fgslam.core.sensors import CameraRig, Increment, Observations
from fgslam.core.threads import one_blas_thread
from fgslam.runs.config import ExperimentConfig
from fgslam.worlds.lab import make_rig
from fgslam.worlds.settings import RenderedLabSettings

SEEDS = range(1, 11)
CAMERAS = (3, 2)
ESTIMATORS = ("isam2", "landmark_kalman")
"""The default, and the Kalman filter."""

_COLUMNS = (
    "cameras", "estimator", "ATE cm, pinholes", "ATE cm, lenses", "lenses over pinholes - 1, %",
    "its standard error, %", "worst seed cm, pinholes", "worst seed cm, lenses",
    "a coordinate's error px, pinholes", "a coordinate's error px, lenses",
)  # fmt: skip
_LEAST_FRAMES = 5  # of a landmark whose place is to be known better than each measurement of it
_FARTHEST_SIGMAS = 8.0  # of a measurement; beyond, it is of something else
_FIT = GaussNewton(iterations=15, converged=0.0, damping=1e-9)  # all together, to the end


def tables(seeds: Sequence[int] = SEEDS, changes: Iterable[str] = ()) -> list[Table]:
    """One row a rig and estimator; means over seeds that share room, drive, odometry and noise."""
    rows: list[tuple[Cell, ...]] = []
    for cameras in CAMERAS:
        found = np.array([errors(cameras, seed, changes) for seed in seeds])
        rows += [
            (f"{cameras}", estimator, *_compared(found[:, k]))
            for k, estimator in enumerate(ESTIMATORS)
        ]
    return [Table(f"Lab through lenses, {len(seeds)} seeds", _COLUMNS, rows)]


@one_blas_thread()
def errors(cameras: int, seed: int, changes: Iterable[str] = ()) -> FloatArray:
    """What pinhole cameras and lenses err by at one seed: (estimators, 2, 2).

    The last axis is ATE in cm and the root mean square error of a measured column or row in px.
    """
    found = []
    for sequence in recordings(cameras, seed, changes):
        say(f"{sequence.name}: {cameras} cameras, seed {seed}")
        features = found_features(sequence, _config(seed, changes).frontend)
        found.append([_errors(features, seed, k, changes) for k in ESTIMATORS])
    return np.array(found).swapaxes(0, 1)


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
    seeds = [f"seed={seed}", f"dataset.room_seed={seed}"]
    return experiment("lab_loop", [f"estimator.kind={estimator}", *seeds, *changes])


def _errors(
    found: FoundFeatures, seed: int, estimator: str, changes: Iterable[str]
) -> tuple[float, float]:
    pipeline = make_system(_config(seed, changes, estimator), found.sequence)
    increments = [report.increment for report in process(found, pipeline)]
    truth = found.sequence.ground_truth
    if truth is None:
        raise ConfigError("the lab's drive gives no truth")
    error = coordinate_error_px(found.sequence.rig, truth.poses, increments)
    return 100.0 * ate_m(pipeline, found.sequence), error


def coordinate_error_px(
    rig: CameraRig, poses: FloatArray, increments: Sequence[Increment]
) -> float:
    """Root mean square of measured columns and rows about landmarks that true poses place, px.

    Args:
        rig: the rectified cameras.
        poses: (n, 4, 4) true ``wTc`` of the increments' frames.
        increments: of a whole run; what its poses rejected is left out, and so are landmarks of
            few frames, and what is far from its landmark.
    """
    kept = [one.kept for one in increments]
    frames = np.repeat(np.arange(len(kept)), [len(one.ids) for one in kept])
    seen = reduce(Observations.join, kept)
    _, landmark, times = np.unique(seen.ids, return_inverse=True, return_counts=True)
    enough = times[landmark] >= _LEAST_FRAMES
    seen, wTc = seen.select(enough), poses[frames[enough]]
    _, first, landmark = np.unique(seen.ids, return_index=True, return_inverse=True)
    weight = inverse_spd3(seen.covariance)

    def residuals(places: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of landmarks' places: points in their cameras, residuals, and squares in sigmas."""
        here = np.einsum("nji,nj->ni", wTc[:, :3, :3], places[landmark] - wTc[:, :3, 3])
        rest = rig.predict(here) - seen.measurement
        return here, rest, np.einsum("ni,nij,nj->n", rest, weight, rest)

    def linearised(places: FloatArray, _: int) -> Linearised:
        here, rest, squares = residuals(places)
        slope = rig.jacobian(here) @ wTc[:, :3, :3].swapaxes(1, 2)
        robust = weight / (1.0 + squares / KERNEL**2)[:, None, None]
        weighted = slope.swapaxes(1, 2) @ robust
        hessian, gradient = np.zeros((len(first), 3, 3)), np.zeros((len(first), 3))
        np.add.at(hessian, landmark, weighted @ slope)
        np.add.at(gradient, landmark, (weighted @ rest[:, :, None])[:, :, 0])
        return hessian, gradient

    start = rig.triangulate(seen.measurement[first])
    start = np.einsum("nij,nj->ni", wTc[first, :3, :3], start) + wTc[first, :3, 3]
    _, rest, squares = residuals(_FIT.minimise(start, linearised))
    return float(np.sqrt(np.mean(rest[squares < _FARTHEST_SIGMAS**2, :2] ** 2)))


def _compared(found: FloatArray) -> tuple[Cell, ...]:
    """Of (seeds, 2, 2): mean ATEs, their ratio less one and its standard error, worst, pixels."""
    pairs = found[:, :, 0]
    ideal, real = pairs.mean(axis=0).tolist()
    less = pairs[:, 1] - real / ideal * pairs[:, 0]  # of a ratio of two means
    error = float(less.std(ddof=1) / np.sqrt(len(less))) if len(less) > 1 else float("nan")
    worst, pixels = pairs.max(axis=0).tolist(), found[:, :, 1].mean(axis=0).tolist()
    return (ideal, real, 100.0 * (real / ideal - 1.0), 100.0 * error / ideal, *worst, *pixels)
