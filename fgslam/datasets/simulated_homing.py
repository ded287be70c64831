"""Simulated homings of bearings alone, as trials of homing estimators."""

from __future__ import annotations

import numpy as np

from fgslam.worlds.simulated.bearings import SimulatedHoming, simulate_homing
from fgslam.worlds.simulated.settings import SimulatedBearingsSettings, with_outliers


def open_simulated_homing(
    settings: SimulatedBearingsSettings, outliers: float, rng: np.random.Generator
) -> SimulatedHoming:
    """Matches, tracks and truth of one homing.

    Args:
        settings: the room, the drive and the noise.
        outliers: part of the matches, and of the bearings tracked at the drive's end, that is
            wrong; replaces the settings' own.
        rng: source of everything random.

    Raises:
        ConfigError: there is no such room.
    """
    return simulate_homing(with_outliers(settings, outliers), rng)
