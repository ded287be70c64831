"""The rendered house with the eyes of a wheelchair in it."""

from __future__ import annotations

import numpy as np

from fgslam.homing.image_eyes import EyesSettings, ImageEyes
from fgslam.runs.homing.config import DrivingConfig
from fgslam.runs.homing.driving import Opened
from fgslam.worlds.house.omni_world import OmniWorld


def open_house_drive(config: DrivingConfig, seed: int) -> Opened:
    """World and eyes of one seed. Raises FgslamError where the house cannot be built."""
    world = OmniWorld(config.dataset, seed)
    settings = EyesSettings(
        config.features,
        config.features.matching,
        config.homing_vector,
        config.tracking,
        config.wrong_matches,
    )
    return world, ImageEyes(world.camera, settings, np.random.default_rng((seed, 8)))
