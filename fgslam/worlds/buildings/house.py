"""The furnished house: its plan, what stands and hangs in its rooms, and its lamps.

Furniture and pictures are laid out from a seed: every free stretch of wall is filled in turn. Some
pictures hang in several rooms, so that places can be mistaken for one another.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.worlds.buildings import furniture
from fgslam.worlds.buildings.floor_plan import (
    HALF_WALL,
    HEIGHT,
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
from fgslam.worlds.textures import PAINTINGS, PHOTOGRAPHS, POSTERS

_FLOOR_TILE_M = 5.3
"""No whole number of legs: with tiles of 4 m a leg of 4 m shows the same floor at the same place,
and homing vectors follow the pattern instead of the room."""

ROOMS = (
    Room("hall", 0.0, 0.0, 11.0, 7.5, "wall_cream", "parquet"),
    Room("office", 11.0, 0.0, 20.0, 7.5, "wall_blue", "carpet"),
    Room("corridor", 0.0, 7.5, 20.0, 9.9, "wall_white", "carpet"),
    Room("library", 0.0, 9.9, 7.0, 15.0, "wall_green", "parquet"),
    Room("workshop", 7.0, 9.9, 13.5, 15.0, "bricks", "carpet"),
    Room("studio", 13.5, 9.9, 20.0, 15.0, "wall_rose", "parquet"),
)
WIDTH, DEPTH = 20.0, 15.0

_LINES = (
    WallLine(True, 7.5, 0.0, WIDTH),
    WallLine(True, 9.9, 0.0, WIDTH),
    WallLine(False, 11.0, 0.0, 7.5),
    WallLine(False, 7.0, 9.9, DEPTH),
    WallLine(False, 13.5, 9.9, DEPTH),
)

_LAMP_SPACING = 3.2
_DOOR_WIDTH = 1.6  # a wheelchair passes with room to turn in
# The opening between hall and office is half as wide again.
_DOORS = (
    Opening(2.5, 7.5, _DOOR_WIDTH, True),
    Opening(8.5, 7.5, _DOOR_WIDTH, True),
    Opening(16.5, 7.5, _DOOR_WIDTH, True),
    Opening(11.0, 3.75, 1.5 * _DOOR_WIDTH, False),
    Opening(3.5, 9.9, _DOOR_WIDTH, True),
    Opening(10.25, 9.9, _DOOR_WIDTH, True),
    Opening(17.0, 9.9, _DOOR_WIDTH, True),
    Opening(7.0, 12.5, _DOOR_WIDTH, False),
    Opening(13.5, 12.5, _DOOR_WIDTH, False),
)
PLAN = FloorPlan(ROOMS, _LINES, _DOORS, WIDTH, DEPTH, floor_tile_m=_FLOOR_TILE_M)
_ROOMY = FittingStyle(
    ("shelf", "shelf", "desk", "cabinet", "sofa", "gap", "gap"),
    cloths=("cloth", "cloth_red", "cloth_green"),
)
_NARROW = FittingStyle(("gap", "cabinet"), (0.8, 0.2), cabinet_depth=0.3)
# Hung in every room: the same picture does not mean the same place.
_COMMON_PICTURES = ("painting_0", "poster_0")


def build_house(rng: np.random.Generator) -> tuple[tuple[Thing, ...], FloatArray]:
    """Everything in the house, and its lamps (k, 3, 3): corner and two edges, metres.

    Args:
        rng: for layout and small things.
    """
    lamps = ceiling_lamps(PLAN, _LAMP_SPACING)
    things = [*shell(PLAN), *lamp_things(lamps)]
    for room in PLAN.rooms:
        style = _NARROW if room.name == "corridor" else _ROOMY
        things += RoomFitter(room, PLAN.doors, rng, style, _pictures(rng)).things()
    return (*things, *_islands(rng)), lamps


def _pictures(rng: np.random.Generator) -> list[str]:
    """Those of one room; they are taken from the end, so the common ones first."""
    photos = [f"photo_{name}" for name in PHOTOGRAPHS]
    prints = [f"poster_{i}" for i in range(1, POSTERS)]
    paintings = [f"painting_{i}" for i in range(1, PAINTINGS)]
    shuffled = rng.permutation(np.array([*photos, *prints, *paintings]))
    return [*(str(name) for name in shuffled), *_COMMON_PICTURES]


def _islands(rng: np.random.Generator) -> list[Thing]:
    """What stands free, low enough to see over but for the pillars."""
    pieces: list[tuple[str, list[Patch], float, float, float]] = [
        ("pillar_1", furniture.pillar(0.35, HEIGHT, "bricks"), 5.2, 5.6, 0.0),
        ("pillar_2", furniture.pillar(0.35, HEIGHT, "bricks"), 5.2, 1.9, 0.0),
        ("dining_table", furniture.dining_table(rng, 1.6), 3.0, 3.7, 15.0),
        ("rug_hall", furniture.rug(2.4, 2.0, "painting_5"), 7.9, 3.6, 30.0),
        ("plant_1", furniture.plant(rng), 6.9, 1.7, 0.0),
        ("island_desk", furniture.desk(rng, 2.0, 2), 15.9, 3.2, 90.0),
        ("rug_office", furniture.rug(2.0, 1.6, "painting_9"), 13.2, 5.2, -20.0),
        ("plant_2", furniture.plant(rng), 18.6, 5.9, 0.0),
        ("pillar_3", furniture.pillar(0.3, HEIGHT, "wood_light"), 13.0, 2.2, 0.0),
        ("island_shelf", furniture.shelf(rng, 1.6, 1.1, 0.35), 2.9, 13.1, 180.0),
        ("workbench", furniture.table(1.6, 0.8, 0.85, Surface("metal", 0.8)), 9.2, 13.6, 0.0),
        ("cartons", furniture.carton(rng, (0.6, 0.5, 0.5)), 12.3, 11.1, 25.0),
        ("bed", furniture.bed("cloth_red"), 17.9, 13.4, -90.0),
        ("rug_studio", furniture.rug(1.8, 1.4, "painting_12"), 15.6, 11.6, 10.0),
        ("chair_office", furniture.chair(), 14.7, 3.0, 75.0),
        ("chair_studio", furniture.chair(), 15.0, 13.9, 200.0),
        ("extinguisher", furniture.extinguisher(), 13.4, 7.5 + 2.4 - HALF_WALL, 0.0),
    ]
    return [Thing(name, tuple(placed(p, x, y, 0.0, yaw))) for name, p, x, y, yaw in pieces]
