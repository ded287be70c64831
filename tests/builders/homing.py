"""Two views of points, for tests of the homing vector: exact geometry with noise on top."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.bearings import BearingMatches, FeatureKind
from fgslam.core.geometry import bearings, unit


@dataclass(frozen=True)
class TwoViews:
    """Matches of two views with their truth; lengths in metres."""

    matches: BearingMatches
    direction: float
    rotation: float
    leg_m: float
    points: FloatArray
    right: BoolArray


def two_views(
    seed: int,
    count: int,
    sigma: float = 0.0,
    wrong_share: float = 0.0,
    leg_m: float = 2.0,
    tilts: tuple[FloatArray, FloatArray] | None = None,
    lift_m: float = 0.0,
) -> TwoViews:
    """Points around both cameras, some of the matches swapped among each other.

    ``tilts`` are (2,) roll and pitch in radians of the start's and the target's camera, ``lift_m``
    by how much the latter is higher.
    """
    rng = np.random.default_rng(seed)
    direction, rotation = rng.uniform(-np.pi, np.pi, 2)
    target = np.array([*(leg_m * unit(direction)), rotation])
    points = rng.uniform(-4.0, 4.0, (count, 2))
    height = rng.uniform(-1.0, 1.5, count)
    a = _seen(np.zeros(3), points, height, None if tilts is None else tilts[0])
    b = _seen(target, points, height - lift_m, None if tilts is None else tilts[1])
    swapped = rng.permutation(count)[: int(wrong_share * count)]
    b[swapped] = b[np.roll(swapped, 1)]
    angles = np.hstack([a, b])
    angles += rng.normal(0.0, 1.0, angles.shape) * sigma
    right = np.ones(count, dtype=np.bool_)
    right[swapped] = False
    return TwoViews(
        make_matches(angles, max(sigma, 1e-6)), direction, rotation, leg_m, points, right
    )


def make_matches(angles: FloatArray, sigma: float) -> BearingMatches:
    """Matches of (n, 4) angles: bearing and elevation at the start, then at the target."""
    n = len(angles)
    index = np.arange(n, dtype=np.int64)
    kind = np.full(n, int(FeatureKind.SIFT), dtype=np.int64)
    noise = np.full((n, 4), sigma)
    b_start, e_start, b_target, e_target = angles.T
    return BearingMatches(
        kind, index, index, b_start, e_start, b_target, e_target, noise, np.ones(n)
    )


def _seen(
    pose: FloatArray, points: FloatArray, height: FloatArray, tilt: FloatArray | None
) -> FloatArray:
    distance = np.hypot(*(points - pose[:2]).T)
    bearing = bearings(pose, points)
    if tilt is None:
        return np.column_stack([bearing, np.arctan2(height, distance)])
    rays = np.column_stack([distance[:, None] * unit(bearing), height])
    rays = rays @ _rotation(tilt)  # level to camera axes: the transpose of the tilt
    return np.column_stack(
        [np.arctan2(rays[:, 1], rays[:, 0]), np.arctan2(rays[:, 2], np.hypot(*rays[:, :2].T))]
    )


def _rotation(tilt: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec([tilt[0], tilt[1], 0.0]).as_matrix())
