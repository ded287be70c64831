"""Whether an estimate still fits the bearings it was made of.

An estimator's own covariance tells how certain it believes to be; these tell whether it may.
Medians, so that the wrong matches among the tracks, a minority, decide nothing.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.homing import (
    BearingMatches,
    HomingEstimate,
    HomingStart,
    TrackedBearings,
    among,
)
from fgslam.core.planar import bearings, wrap

_FEWEST = 3  # fewer bearings say nothing about a pose with three unknowns


def tracked_misfit(estimate: HomingEstimate, tracked: TrackedBearings) -> float:
    """Median absolute difference of tracked bearings from their prediction, radians.

    NaN where fewer than three features are both tracked and in the map.
    """
    mine, other = among(estimate.ids, tracked.ids), among(tracked.ids, estimate.ids)
    return _misfit(estimate.robot, estimate.landmarks[mine], tracked.bearing[other])


def target_misfit(estimate: HomingEstimate, start: HomingStart) -> float:
    """The same of the bearings from the target, predicted from where the target is estimated."""
    ids = start.local_map.ids
    mine, other = among(estimate.ids, ids), among(ids, estimate.ids)
    return _misfit(estimate.target, estimate.landmarks[mine], start.matches.bearing_b[other])


def _misfit(pose: FloatArray, landmarks: FloatArray, seen: FloatArray) -> float:
    known = np.isfinite(landmarks).all(axis=1)
    if np.count_nonzero(known) < _FEWEST:
        return float("nan")
    residuals = wrap(seen[known] - bearings(pose, landmarks[known]))
    return float(np.median(np.abs(residuals)))


def parallax(matches: BearingMatches, rotation: float) -> float:
    """Median absolute parallax of matches (n), n > 0, radians: what the turn does not explain.

    It falls to zero at the target, and needs no direction: a measure of how near the target is.
    """
    return float(np.median(np.abs(wrap(matches.bearing_a - matches.bearing_b - rotation))))


def common_turn(before: TrackedBearings, now: TrackedBearings) -> float:
    """By how much the robot turned between two images, radians; NaN without common features.

    The circular median of the bearings' changes, the other way round: translation moves bearings,
    too, but to both sides.
    """
    mine, other = among(before.ids, now.ids), among(now.ids, before.ids)
    if not mine.any():
        return float("nan")
    change = wrap(before.bearing[mine] - now.bearing[other])
    return circular_median(change)


def circular_median(angles: FloatArray) -> float:
    """The angle of (n,), n > 0, with the least sum of absolute differences to all."""
    apart = np.abs(wrap(angles[:, None] - angles[None, :]))
    return float(angles[int(np.argmin(apart.sum(axis=0)))])
