"""The rendered house as a world to act in: a wheelchair whose camera sees where it is driven."""

from __future__ import annotations

from fgslam.worlds.house import OmniWorld
from fgslam.worlds.house_settings import OmniHouseSettings


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
