"""The places a robot with a pinhole rig is rendered in: the lab, an office building, corridors.

A place is what stands in it, its lamps, its textures and the drives laid out for it; the renderer,
the light and the time law are the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from fgslam.core import geometry
from fgslam.core.arrays import Float32, FloatArray, IntArray
from fgslam.core.errors import ConfigError
from fgslam.core.sensors import CameraRig
from fgslam.worlds.driving import (
    Drive,
    PlanarPath,
    drive_along,
    paper_loop,
    planar_poses,
    room_laps,
    round_corners,
    through_waypoints,
)
from fgslam.worlds.floor import FloorSpace, draw_poses
from fgslam.worlds.patches import RayCaster, stack
from fgslam.worlds.people import Stance, person
from fgslam.worlds.places import (
    Place,
    build_corridors,
    build_lab,
    build_office,
    office_tour,
    ring_one_way,
    ring_tour,
)
from fgslam.worlds.renderer import Body, Layer, Renderer, bake, flat_light, pinhole_view
from fgslam.worlds.settings import (
    LabDriveSettings,
    LabRigSettings,
    LabSettings,
    PathName,
    PlaceName,
)
from fgslam.worlds.textures import GreyBank, build_library, building_library, corridor_library

FIELD_OF_VIEW_DEG = 60.0  # its width
AHEAD_M, ABOVE_M = 0.25, 1.0  # reference camera from the robot's centre, and above the floor
_BEND_M = 2.3
"""Way of a quarter turn between two rooms: fits into a corridor, and into a lane of 3.3 m twice."""

PATHS: dict[PlaceName, tuple[PathName, ...]] = {
    "lab": ("paper_loop", "laps", "waypoints", "random_poses"),
    "rooms": ("tour", "waypoints", "random_poses"),
    "corridors": ("tour", "one_way", "waypoints", "random_poses"),
}
"""Drives that each place offers; the first is its own."""


_LIBRARIES = {"lab": build_library, "rooms": building_library, "corridors": corridor_library}


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
    seed: int = 0
    visit: int = 1
    identical_posters: bool = False

    @staticmethod
    def of(settings: LabSettings) -> PlaceChoice:
        """The place that the settings name."""
        identical = settings.posters == "identical"
        return PlaceChoice(settings.place, settings.room_seed, settings.visit, identical)


def build_place(choice: PlaceChoice) -> Place:
    """What stands where.

    Raises:
        ConfigError: the place has no such visit, or no two posters.
    """
    visits = {"lab": 3, "rooms": 2, "corridors": 1}[choice.name]
    if choice.visit > visits:
        raise ConfigError(
            f"dataset.visit {choice.visit}: dataset.place {choice.name} has "
            f"{visits}, the lab 3, in which more has been moved each time"
        )
    if choice.identical_posters and choice.name != "lab":
        raise ConfigError(
            f"dataset.posters identical means nothing in dataset.place {choice.name}; the two "
            "posters hang in the lab"
        )
    rng = np.random.default_rng([choice.seed, 2])
    if choice.name == "rooms":
        return build_office(rng, choice.visit)
    if choice.name == "corridors":
        return build_corridors(rng)
    return build_lab(rng, choice.visit, choice.identical_posters)


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
        tour = office_tour if name == "rooms" else ring_tour
        return round_corners(tour(settings.laps), _BEND_M)
    if settings.path == "one_way":
        return round_corners(ring_one_way(), _BEND_M)
    if settings.path == "paper_loop":
        return paper_loop()
    if settings.path == "laps":
        return room_laps(settings.laps)
    points = np.array(settings.waypoints_m, dtype=np.float64).reshape(-1, 2)
    return through_waypoints(points, settings.closed)


def plan_in_place(choice: PlaceChoice, settings: LabDriveSettings, rig: CameraRig) -> Drive:
    """Poses and time stamps of a drive in a place, or of random poses in it.

    Raises:
        ConfigError: the drive does not exist in the place or cannot be driven in so few frames,
            or there are no such poses.
    """
    if settings.path != "random_poses":
        return drive_along(place_path(choice.name, settings), settings, settings.frames)
    place = build_place(choice)
    space = FloorSpace(stack(place.things), place.low, place.high)
    start = first_pose(choice.name, settings)[:2, 3]
    return draw_poses(settings, space, start, rig.bTc[:2, 3])


def first_pose(name: PlaceName, settings: LabDriveSettings) -> FloatArray:
    """(4, 4) robot in the room's frame at the start of the drive; of the place's own, if none.

    Raises:
        ConfigError: the place has no drive of that name.
    """
    own = PATHS[name][0] if settings.path == "random_poses" else settings.path
    path = place_path(name, replace(settings, path=own))
    return np.asarray(planar_poses(np.array([[*path.xy[0], path.heading[0]]]))[0])


# --------------------------------------------------------------------------------------------
# Rendering


def make_rig(settings: LabRigSettings) -> CameraRig:
    """The calibrated cameras that the settings describe."""
    focal = settings.width / 2.0 / np.tan(np.deg2rad(FIELD_OF_VIEW_DEG) / 2.0)
    bTc = geometry.BODY_FORWARD_LEFT_UP_FROM_CAMERA.copy()
    bTc[:3, 3] = AHEAD_M, 0.0, ABOVE_M
    return CameraRig(
        width=settings.width,
        height=settings.height,
        fx=float(focal),
        fy=float(focal),
        cx=(settings.width - 1) / 2.0,
        cy=(settings.height - 1) / 2.0,
        baseline=settings.baseline_m,
        vertical_baseline=settings.vertical_baseline_m,
        bTc=bTc,
        exact=True,
    )


class Room:
    """A furnished place with its light and textures, as at one visit; the same for every rig.

    Attributes:
        low, high: (2,) corners of the floor, metres.
        things: name of each object identity; the person's is the last.
        caster: of the room without the person.
        bank: all textures, the person's among them.
        layer: the room, ready to be shaded.
    """

    def __init__(self, choice: PlaceChoice) -> None:
        """Builds textures, furniture and light.

        Raises:
            ConfigError: there is no such place.
            MissingDependencyError: Open3D is absent.
        """
        place = build_place(choice)
        patches = stack(place.things)
        self.low, self.high = place.low, place.high
        self.things = (*(thing.name for thing in place.things), "person")
        self.caster = RayCaster(patches)
        self.bank = GreyBank(_LIBRARIES[choice.name](np.random.default_rng([choice.seed, 1])))
        rng = np.random.default_rng([choice.seed, 3])
        spacing, reach = place.light_spacing_m, place.light_reach_m
        light = bake(patches, self.caster, place.lamps, rng, spacing, reach)
        self.layer = Layer(patches, self.caster, light, self.bank)


@lru_cache(maxsize=2)
def open_room(choice: PlaceChoice) -> Room:
    """The place, kept for the next sequence that is rendered in it (some 70 MB each)."""
    return Room(choice)


class World:
    """A room seen by a rig's cameras; safe to share between threads."""

    def __init__(self, rig: CameraRig, room: Room) -> None:
        self.room = room
        view = pinhole_view((rig.height, rig.width), rig.fx, rig.cx, rig.cy)
        self._renderer = Renderer(view, room.bank)

    def bodies(self, stance: Stance | None) -> list[Body]:
        """The person standing in the room where there is one."""
        if stance is None:
            return []
        patches = stack([person(stance)], first_thing=len(self.room.things) - 1)
        light = flat_light(patches, np.array([0.3, -0.2, 1.0]))
        layer = Layer(patches, RayCaster(patches), light, self.room.bank)
        return [Body(layer, np.eye(4), np.inf)]

    def image(self, pose: FloatArray, bodies: list[Body]) -> Float32:
        """(h, w) grey levels, not yet rounded, from a camera's pose (4, 4) in the room."""
        return self._renderer.image(self.room.layer, pose, bodies)[..., 0]

    def depth(self, pose: FloatArray, bodies: list[Body]) -> FloatArray:
        """(h, w) exact depth Z in metres at pixel centres; infinite for nothing."""
        return self._renderer.distances(self.room.layer, pose, bodies)

    def object_ids(self, pose: FloatArray, bodies: list[Body]) -> IntArray:
        """(h, w) index into ``room.things`` at pixel centres; -1 for nothing."""
        return self._renderer.things(self.room.layer, pose, bodies)
