"""Both front-ends on a rendered street: what self-calibration finds of a rig that is known."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np

import fgslam as fg
from benchmarks.evidence.hybrid import KINDS
from benchmarks.evidence.street_world import FRAMES, RIG, Float32, Street
from benchmarks.runs import say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.correction import RigCorrection, term_names
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import Trajectory
from fgslam.evaluation.statistics import Alignment, evaluate_trajectory

SEEDS = range(6)
LIGHTS = {
    "full": (1.0, 0.0),
    "noise of 8 grey levels": (1.0, 8.0),
    "a twelfth as bright": (1.0 / 12.0, 0.0),
}
"""Factor of the grey levels, and sigma of the noise."""
REAL_RIG = np.array(
    [
        0.02626304, 0.00086563, -0.0265722, -0.00072247, 0.00026369, -0.00073674, 0.00910446,
        0.00058046, 0.00123244, -0.00202068, -0.0003995, 0.00967301,
    ]
)  # fmt: skip
"""What self-calibration finds on `kitti06` with all terms: a rig that is off as real ones are."""
RIGS = {"exact": np.zeros(len(term_names(RIG))), "off as kitti06's": REAL_RIG}
ESTIMATOR = "landmark_kalman"
_PERIOD_S = 0.1


def tables(seeds: Iterable[int] = SEEDS) -> list[Table]:
    """One row a rig, light and front-end; means over the seeds."""
    streets = [(seed, Street(seed)) for seed in seeds]
    rows: list[tuple[Cell, ...]] = []
    for rig, correction in RIGS.items():
        clean = [street.images(correction) for _, street in streets]
        for light in LIGHTS:
            for kind in KINDS:
                say(f"{rig} rig, {light}, {kind}")
                found = [
                    drive(kind, shots, street.poses, (seed, light))
                    for (seed, street), shots in zip(streets, clean, strict=True)
                ]
                rows.append((rig, light, kind, *_summary(np.array(found))))
    columns = (
        "rig", "light", "front-end", "ATE cm", "length %", "offset px", "its deviation",
        "its sigma", "taken off px",
    )  # fmt: skip
    truth = {rig: _offset(correction)[0] for rig, correction in RIGS.items()}
    notes = tuple(f"true offset, {rig} rig: {value:.3f} px" for rig, value in truth.items())
    title = f"Rendered street, {len(streets)} seeds of {FRAMES} frames"
    return [Table(title, columns, rows, notes)]


@one_blas_thread()
def drive(
    kind: Literal["sift", "hybrid"], clean: Float32, poses: FloatArray, draw: tuple[int, str]
) -> tuple[float, ...]:
    """How well a drive is measured, and what is found of its rig.

    Args:
        kind: of front-end.
        clean: (n, 2, h, w) levels in right and left image.
        poses: (n, 4, 4) true ones.
        draw: seed of the image noise, and the name of the light.

    Returns:
        ATE in cm, error of the way's length in percent, disparity offset in the middle as found
        with all terms and its sigma, and the one that is taken off in the end, pixels.
    """
    slam = fg.Slam(RIG, ESTIMATOR, frontend={"tracking": kind})
    for k, images in enumerate(taken(clean, *draw)):
        slam.track(k * _PERIOD_S, images)
    result = slam.result()
    slam.close()
    times = np.asarray(_PERIOD_S * np.arange(len(poses)), np.float64)
    error = evaluate_trajectory(result.trajectory, Trajectory(times, poses), Alignment.SE3)
    way = _length(result.trajectory.poses) / _length(poses)
    assert result.rig is not None
    offset, sigma = result.rig.estimated.centre_px()
    applied = result.rig.applied.centre_px()[0]
    return 100.0 * (error.ate_rmse_m or np.nan), 100.0 * (way - 1.0), offset, sigma, applied


def taken(clean: Float32, seed: int, light: str) -> Iterator[tuple[Image, Image]]:
    """Left and right image of each frame."""
    gain, sigma = LIGHTS[light]
    rng = np.random.default_rng([seed, 5])
    for pair in clean:
        levels = [gain * image + sigma * rng.normal(size=image.shape) for image in pair]
        right, left = (np.clip(np.round(one), 0, 255).astype(np.uint8) for one in levels)
        yield left, right


def _summary(found: FloatArray) -> tuple[Cell, ...]:
    ate, length, offset, sigma, taken = found.mean(axis=0).tolist()
    spread = float(found[:, 2].std(ddof=1)) if len(found) > 1 else None
    return round(ate, 2), round(length, 3), round(offset, 4), spread, sigma, round(taken, 4)


def _offset(correction: FloatArray) -> tuple[float, float]:
    none = RigCorrection.none(RIG)
    return RigCorrection(RIG, correction, none.covariance).centre_px()


def _length(poses: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
