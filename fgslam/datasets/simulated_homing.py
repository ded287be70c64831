"""Simulated recordings for homing: bearings alone, and the rendered house as a world to act in."""

from __future__ import annotations

import numpy as np

from fgslam.worlds.house import OmniWorld as OmniWorld
from fgslam.worlds.settings import OmniHouseSettings, SimulatedBearingsSettings
from fgslam.worlds.simulated_bearings import HomingOutliers, SimulatedHoming, simulate_homing


def open_simulated_homing(
    settings: SimulatedBearingsSettings, outliers: float, rng: np.random.Generator
) -> SimulatedHoming:
    """Matches, tracks and truth of one homing.

    Args:
        settings: the room, the drive and the noise.
        outliers: part of the matches, and of the bearings tracked at the drive's end, that is
            wrong.
        rng: source of everything random.
    """
    return simulate_homing(settings, rng, HomingOutliers.of_all(outliers))


def open_house(settings: OmniHouseSettings, seed: int) -> OmniWorld:
    """The house with the wheelchair at the start of its reference path.

    Args:
        settings: camera, path, wheelchair, people, light and noise.
        seed: of the path and of everything random on it.

    Raises:
        DatasetError: no reference path of that kind is found.
        MissingDependencyError: Open3D cannot be loaded.
    """
    return OmniWorld(settings, seed)
