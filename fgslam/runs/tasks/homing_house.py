"""The rendered house with the front-end of a wheelchair in it."""

from __future__ import annotations

import numpy as np

from fgslam.datasets.omni.house import open_house
from fgslam.homing.image_front_end import FrontEndSettings, ImageFrontEnd
from fgslam.runs.config_models import DrivingConfig
from fgslam.runs.tasks.homing_drives import Opened


def open_house_drive(config: DrivingConfig, seed: int) -> Opened:
    """World and front-end of one seed. Raises FgslamError where the house cannot be built."""
    world = open_house(config.dataset, seed)
    settings = FrontEndSettings(
        config.features,
        config.features.matching,
        config.homing_vector,
        config.tracking,
        config.wrong_matches,
    )
    return world, ImageFrontEnd(world.camera, settings, np.random.default_rng((seed, 8)))
