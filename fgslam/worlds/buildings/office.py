"""An office building of 36 m x 24 m: eleven furnished rooms and four corridors around the core.

Every room has its own covers and pictures; books, binders and furniture come from the same stores
and therefore repeat. North and south rooms open to each other and to the long corridors, core rooms
to both corridors.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.worlds.buildings import furniture
from fgslam.worlds.buildings.floor_plan import (
    FloorPlan,
    Opening,
    Room,
    WallLine,
    ceiling_lamps,
    lamp_things,
    shell,
)
from fgslam.worlds.buildings.furniture import FittingStyle, RoomFitter
from fgslam.worlds.patches import Patch, Surface, Thing, placed
from fgslam.worlds.textures import PICTURES

WIDTH, DEPTH = 36.0, 24.0
_DOOR_WIDTH, _FIRE_DOOR_WIDTH = 1.3, 1.9
_LAMP_SPACING = 2.0

_ROOMS = (
    Room("south_1", 0.0, 0.0, 9.0, 7.0, "wall_0", "floor"),
    Room("south_2", 9.0, 0.0, 18.0, 7.0, "bricks", "floor_1"),
    Room("south_3", 18.0, 0.0, 27.0, 7.0, "paper_0", "floor_2"),
    Room("south_4", 27.0, 0.0, 36.0, 7.0, "wall_1", "floor_3"),
    Room("corridor_south", 0.0, 7.0, 36.0, 9.4, "wall_4", "floor_1"),
    Room("corridor_west", 0.0, 9.4, 2.4, 14.6, "wall_5", "floor_2"),
    Room("core_1", 2.4, 9.4, 12.8, 14.6, "paper_1", "floor_3"),
    Room("core_2", 12.8, 9.4, 23.2, 14.6, "wall_3", "floor"),
    Room("core_3", 23.2, 9.4, 33.6, 14.6, "bricks_dark", "floor_1"),
    Room("corridor_east", 33.6, 9.4, 36.0, 14.6, "wall_5", "floor_2"),
    Room("corridor_north", 0.0, 14.6, 36.0, 17.0, "wall_2", "floor_3"),
    Room("north_1", 0.0, 17.0, 9.0, 24.0, "paper_2", "floor_1"),
    Room("north_2", 9.0, 17.0, 18.0, 24.0, "wall_3", "floor"),
    Room("north_3", 18.0, 17.0, 27.0, 24.0, "wall_0", "floor_2"),
    Room("north_4", 27.0, 17.0, 36.0, 24.0, "bricks", "floor"),
)
_LINES = (
    *(WallLine(True, y, 0.0, WIDTH) for y in (7.0, 9.4, 14.6, 17.0)),
    *(WallLine(False, x, 0.0, 7.0) for x in (9.0, 18.0, 27.0)),
    *(WallLine(False, x, 9.4, 14.6) for x in (2.4, 12.8, 23.2, 33.6)),
    *(WallLine(False, x, 17.0, 24.0) for x in (9.0, 18.0, 27.0)),
)
_DOORS = (
    *(Opening(x, y, _DOOR_WIDTH, True) for y in (7.0, 17.0) for x in (4.5, 13.5, 22.5, 31.5)),
    *(Opening(x, y, _DOOR_WIDTH, True) for y in (9.4, 14.6) for x in (7.6, 18.0, 28.4)),
    *(Opening(x, y, _FIRE_DOOR_WIDTH, True) for y in (9.4, 14.6) for x in (1.2, 34.8)),
    *(Opening(x, y, _DOOR_WIDTH, False) for y in (3.5, 20.5) for x in (9.0, 18.0, 27.0)),
)
PLAN = FloorPlan(_ROOMS, _LINES, _DOORS, WIDTH, DEPTH, "wall_0", wall_tile_m=6.4, floor_tile_m=6.0)

_ROOMY = FittingStyle(("shelf", "shelf", "desk", "cabinet", "sofa", "gap", "gap"))
_NARROW = FittingStyle(("gap", "cabinet", "shelf"), (0.7, 0.15, 0.15), cabinet_depth=0.3)

_START = (6.2, 3.5)
# Once round the building, through all rooms of its north and south: no place is seen twice before
# the start is.
_ROUND = (
    (31.5, 3.5), (31.5, 8.2), (34.8, 8.2), (34.8, 15.8), (31.5, 15.8), (31.5, 20.5), (4.5, 20.5),
    (4.5, 15.8), (1.2, 15.8), (1.2, 8.2), (4.5, 8.2), (4.5, 3.5),
)  # fmt: skip
# Back through the west corridor the other way, and through the middle of the core.
_WEST = (
    (13.5, 3.5), (13.5, 8.2), (1.2, 8.2), (1.2, 15.8), (18.0, 15.8), (18.0, 8.2), (4.5, 8.2),
    (4.5, 3.5),
)  # fmt: skip
# Two rooms that were seen, two that are new, the north corridor the other way.
_CORE = (
    (22.5, 3.5), (22.5, 8.2), (28.4, 8.2), (28.4, 15.8), (7.6, 15.8), (7.6, 8.2), (4.5, 8.2),
    (4.5, 3.5),
)  # fmt: skip
# The first round the other way.
_BACK = (
    (22.5, 3.5), (22.5, 8.2), (1.2, 8.2), (1.2, 15.8), (4.5, 15.8), (4.5, 20.5), (31.5, 20.5),
    (31.5, 15.8), (34.8, 15.8), (34.8, 8.2), (31.5, 8.2), (31.5, 3.5), (13.5, 3.5), (13.5, 8.2),
    (4.5, 8.2), (4.5, 3.5),
)  # fmt: skip


def tour(rounds: int) -> FloatArray:
    """(n, 2) corners of the drive's first rounds of four, each back to the start and its heading.

    Args:
        rounds: 1 to 4; more begin anew.
    """
    legs = (_ROUND, _WEST, _CORE, _BACK)
    corners = [_START]
    for k in range(rounds):
        corners += [*legs[k % len(legs)], _START]
    return np.array(corners)


def build_office(rng: np.random.Generator, visit: int) -> tuple[tuple[Thing, ...], FloatArray]:
    """Everything in the building, and its lamps (k, 3, 3).

    Args:
        rng: for the layout and the small things.
        visit: 1, or a later one that finds chairs and cartons elsewhere.
    """
    lamps = ceiling_lamps(PLAN, _LAMP_SPACING)
    things = [*shell(PLAN), *lamp_things(lamps)]
    pictures = [f"picture_{i}" for i in rng.permutation(PICTURES)]
    for room in PLAN.rooms:
        style = _NARROW if room.name.startswith("corridor") else _ROOMY
        fitter = RoomFitter(room, PLAN.doors, rng, style, pictures)
        things += fitter.things()
        pictures = list(fitter.pictures_left)
    for room in PLAN.rooms:
        if not room.name.startswith("corridor"):
            things += _free_standing(room, rng) + _loose_things(room, rng, moved=visit != 1)
    return tuple(things), lamps


def _free_standing(room: Room, rng: np.random.Generator) -> list[Thing]:
    """One piece in each quarter of the room; the ways between its doors stay free."""
    across = 0.0 if room.name.startswith("core") else 1.85
    slots = [(x, y) for x in (-2.7, 2.7) for y in ((0.0,) if across == 0.0 else (-across, across))]
    out = []
    for k, (x, y) in enumerate(slots):
        name, patches = _piece(rng)
        yaw = float(rng.choice([0.0, 90.0, 180.0])) + float(rng.uniform(-12.0, 12.0))
        cx, cy = room.centre
        there = placed(patches, cx + x, cy + y, 0.0, yaw)
        out.append(Thing(f"{room.name}_{name}_{k}", tuple(there)))
    return out


def _piece(rng: np.random.Generator) -> tuple[str, list[Patch]]:
    kind = str(rng.choice(["desk", "shelf", "cartons", "cabinet"]))
    if kind == "desk":
        return kind, furniture.desk(rng, 1.6, 1)
    if kind == "shelf":
        back = furniture.shelf(rng, 1.5, 1.1, 0.35)
        return kind, back + placed(furniture.shelf(rng, 1.5, 1.1, 0.35), 0.0, 0.0, 0.0, 180.0)
    if kind == "cartons":
        low = furniture.carton(rng, (0.7, 0.6, 0.5))
        return kind, low + placed(furniture.carton(rng, (0.5, 0.4, 0.4)), 0.05, 0.0, 0.5, 15.0)
    return kind, furniture.cabinet(1.0, 1.2, 0.5, Surface("metal", 0.9))


def _loose_things(room: Room, rng: np.random.Generator, moved: bool) -> list[Thing]:
    """Two chairs and a carton, on the side of the room that has no door to a corridor."""
    cx, cy = room.centre
    side = 1.0 if room.name.startswith("north") else -1.0
    carton = furniture.carton(rng, (0.5, 0.4, 0.4))
    across = 1.0 if room.name.startswith("core") else 2.0
    out = []
    for name, patches, first, second in (
        ("chair_1", furniture.chair(), (-1.15, across), (1.1, 0.85 * across)),
        ("chair_2", furniture.chair(), (3.7, 0.4 * across), (-3.8, 0.5 * across)),
        ("carton", carton, (1.2, 1.1 * across), (-1.2, 1.1 * across)),
    ):
        turns = rng.uniform(-180.0, 180.0, 2)
        x, y = second if moved else first
        there = placed(patches, cx + x, cy + side * y, 0.0, float(turns[int(moved)]))
        out.append(Thing(f"{room.name}_{name}", tuple(there)))
    return out
