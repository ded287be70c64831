"""The rendered house with the front-end of a wheelchair in it."""

from __future__ import annotations

from fgslam.datasets.omni.house import open_house
from fgslam.homing.image_front_end import FrontEndSettings, make_front_end
from fgslam.runs.config_models import DrivingConfig
from fgslam.runs.tasks.homing_drives import Opened


def open_house_drive(config: DrivingConfig, seed: int) -> Opened:
    """World and front-end of one seed. Raises FgslamError where the house cannot be built."""
    world = open_house(config.dataset, seed)
    settings = FrontEndSettings(
        config.features, config.homing_vector, config.tracking, config.wrong_matches
    )
    return world, make_front_end(world.camera, settings, seed)
