"""Simulated homings from matches to tracks, through the real initialisation step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray
from fgslam.core.bearings import HomingStart, HomingTruth, TrackedBearings, TwoViewVector
from fgslam.frontend.homing.two_view import make_local_map
from fgslam.frontend.homing.vector import estimate_homing_vector
from fgslam.frontend.settings import HomingVectorSettings
from fgslam.worlds.settings import SimulatedBearingsSettings
from fgslam.worlds.simulated_bearings import NO_OUTLIERS, HomingOutliers, simulate_homing

LEVEL = HomingVectorSettings(tilt_sigma_deg=0.0, height_sigma=0.0, max_direction_sigma_deg=15.0)
"""The simulated camera neither tilts nor rises; sparse rooms are to be answered, too."""


@dataclass(frozen=True)
class Trial:
    """What an estimator is given, and the truth; ``correct`` of the matches that were kept."""

    start: HomingStart
    tracks: tuple[TrackedBearings, ...]
    truth: HomingTruth
    correct: BoolArray


def trial(
    seed: int,
    settings: SimulatedBearingsSettings | None = None,
    outliers: HomingOutliers = NO_OUTLIERS,
) -> Trial:
    """One homing of a seed."""
    simulated = simulate_homing(
        settings or SimulatedBearingsSettings(), np.random.default_rng([seed, 1]), outliers
    )
    vector = estimate_homing_vector(simulated.matches, LEVEL, np.random.default_rng([seed, 2]))
    assert isinstance(vector, TwoViewVector), vector
    distance = make_local_map(vector, simulated.matches).distance
    rows = np.flatnonzero(vector.inliers & np.isfinite(distance) & (distance > 0.0))
    matches = simulated.matches.select(rows)
    start = HomingStart(simulated.time, vector, make_local_map(vector, matches), matches)
    tracks, truth = simulated.followed(rows)
    return Trial(start, tracks, truth, simulated.correct[rows])
