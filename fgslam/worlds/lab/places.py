"""The places a robot with a pinhole rig can be rendered in: the lab, an office, corridors.

A place is what stands in it, its lamps, its textures and the drives laid out for it; the renderer,
the light and the time law are the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError
from fgslam.core.sensors import CameraRig
from fgslam.worlds.buildings import corridors as alike
from fgslam.worlds.buildings import lab, office
from fgslam.worlds.buildings.wall_textures import building_library, corridor_library
from fgslam.worlds.driving.floor_space import FloorSpace
from fgslam.worlds.driving.paths import (
    PlanarPath,
    PosesInTime,
    drive_along,
    plan_path,
    planar_poses,
    round_corners,
)
from fgslam.worlds.driving.random_poses import draw_poses
from fgslam.worlds.lab.settings import LabDriveSettings, LabSettings, PathName, PlaceName
from fgslam.worlds.rendering.lighting import LIGHT_SPACING_M
from fgslam.worlds.rendering.patches import Thing, stack
from fgslam.worlds.rendering.texture_library import build_library
from fgslam.worlds.rendering.textures import Grey

_BEND_M = 2.3
"""Way of a quarter turn between two rooms: fits into a corridor, and into a lane of 3.3 m twice."""

PATHS: dict[PlaceName, tuple[PathName, ...]] = {
    "lab": ("paper_loop", "laps", "waypoints", "random_poses"),
    "rooms": ("tour", "waypoints", "random_poses"),
    "corridors": ("tour", "one_way", "waypoints", "random_poses"),
}
"""Drives that each place offers; the first is its own."""


@dataclass(frozen=True, slots=True)
class PlaceChoice:
    """What makes a place the one it is.

    Attributes:
        name: which.
        seed: of textures, layout and small things.
        visit: 1, or a later one (2; in the lab 3) that finds things elsewhere.
        identical_posters: two posters of the lab are the same.
    """

    name: PlaceName
    seed: int
    visit: int
    identical_posters: bool

    @staticmethod
    def of(settings: LabSettings) -> PlaceChoice:
        """The place that the settings name."""
        identical = settings.posters == "identical"
        return PlaceChoice(settings.place, settings.room_seed, settings.visit, identical)


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A furnished place.

    Attributes:
        things: with their patches.
        lamps: (k, 3, 3) corner and two edges of each, metres.
        low, high: (2,) corners of the floor, metres.
        light_spacing_m: of the points where the light is computed.
        light_reach_m: of a lamp; None for any distance.
    """

    things: tuple[Thing, ...]
    lamps: FloatArray
    low: FloatArray
    high: FloatArray
    light_spacing_m: float = 0.15
    light_reach_m: float | None = 7.0


def build_place(choice: PlaceChoice) -> Place:
    """What stands where.

    Raises:
        ConfigError: the place has no second visit, or no two posters.
    """
    _require_offer(choice)
    rng = np.random.default_rng([choice.seed, 2])
    if choice.name == "rooms":
        things, lamps = office.build_office(rng, choice.visit)
        return Place(things, lamps, np.zeros(2), np.array([office.WIDTH, office.DEPTH]))
    if choice.name == "corridors":
        things, lamps = alike.build_alike(rng)
        edge = np.full(2, alike.HALF_WIDTH)
        return Place(things, lamps, -edge, alike.SIDE + edge)
    things = lab.build_lab(rng, choice.visit, choice.identical_posters)
    side = np.full(2, lab.HALF_SIDE)
    return Place(things, lab.lamps(), -side, side, LIGHT_SPACING_M, None)


def build_textures(choice: PlaceChoice) -> dict[str, Grey]:
    """The place's textures by name."""
    rng = np.random.default_rng([choice.seed, 1])
    libraries = {"lab": build_library, "rooms": building_library, "corridors": corridor_library}
    return libraries[choice.name](rng)


def place_path(name: PlaceName, settings: LabDriveSettings) -> PlanarPath:
    """The curve that the settings name, in a place.

    Raises:
        ConfigError: the place does not offer it, or the waypoints make no curve.
    """
    if settings.path not in PATHS[name]:
        raise ConfigError(
            f"dataset.drive.path {settings.path} does not exist in dataset.place {name}; choose "
            f"one of {', '.join(PATHS[name])}"
        )
    if settings.path == "tour":
        corners = (office if name == "rooms" else alike).tour(settings.laps)
        return round_corners(corners, _BEND_M)
    if settings.path == "one_way":
        return round_corners(alike.one_way(), _BEND_M)
    return plan_path(settings)


def plan_in_place(choice: PlaceChoice, settings: LabDriveSettings, rig: CameraRig) -> PosesInTime:
    """Poses and time stamps of a drive in a place, or of random poses in it.

    Raises:
        ConfigError: the drive does not exist in the place or cannot be driven in so few frames,
            or there are no such poses.
    """
    if settings.path != "random_poses":
        return drive_along(place_path(choice.name, settings), settings)
    place = build_place(choice)
    space = FloorSpace(stack(place.things), place.low, place.high)
    start = first_pose(choice.name, settings)[:2, 3]
    return draw_poses(settings, space, start, rig.bTc[:2, 3])


def first_pose(name: PlaceName, settings: LabDriveSettings) -> FloatArray:
    """(4, 4) robot in the room's frame where the drive begins whose start is the truth's world.

    Raises:
        ConfigError: the place has no drive of that name.
    """
    own = PATHS[name][0] if settings.path == "random_poses" else settings.path
    path = place_path(name, replace(settings, path=settings.world_from or own))
    return np.asarray(planar_poses(np.array([[*path.xy[0], path.heading[0]]]))[0])


def _require_offer(choice: PlaceChoice) -> None:
    if choice.identical_posters and choice.name != "lab":
        raise ConfigError(
            f"dataset.posters identical means nothing in dataset.place {choice.name}; the two "
            "posters hang in the lab"
        )
    if choice.visit > 1 and choice.name == "corridors":
        raise ConfigError(
            f"dataset.visit {choice.visit}: nothing is ever moved in dataset.place corridors; "
            "choose the lab or rooms"
        )
    if choice.visit > 2 and choice.name != "lab":
        raise ConfigError(
            f"dataset.visit {choice.visit}: only the lab has been rearranged; dataset.place "
            f"{choice.name} has the visits 1 and 2"
        )
