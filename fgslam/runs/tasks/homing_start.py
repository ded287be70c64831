"""From matches of start and target to what a homing estimator is told once."""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.core.arrays import IntArray
from fgslam.core.homing import BearingMatches, HomingStart, Refusal
from fgslam.frontend.homing.local_map import make_local_map
from fgslam.frontend.homing.ransac import estimate_homing_vector
from fgslam.frontend.homing.settings import HomingVectorSettings


def start_from_matches(
    time: float,
    matches: BearingMatches,
    settings: HomingVectorSettings,
    rng: np.random.Generator,
) -> tuple[HomingStart, IntArray] | Refusal:
    """Homing vector and local map of the matches that support it.

    Returns:
        The start, whose features are numbered from 0, and the rows (n,) of ``matches`` that they
        were; or why there is none.
    """
    vector = estimate_homing_vector(matches, settings, rng)
    if isinstance(vector, Refusal):
        return vector
    rows = np.flatnonzero(vector.inliers)
    kept = matches.select(rows)
    of_kept = dataclasses.replace(vector, inliers=np.ones(len(rows), np.bool_))
    return HomingStart(time, of_kept, make_local_map(of_kept, kept), kept), rows
