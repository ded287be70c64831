"""The house's plan: its rooms, the corridor, and the openings between them."""

from __future__ import annotations

from fgslam.worlds.buildings.floor_plan import FloorPlan, Opening, Room, WallLine

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


def house_plan(door_width: float) -> FloorPlan:
    """The whole plan; the opening between hall and office is half as wide again."""
    doors = (
        Opening(2.5, 7.5, door_width, True),
        Opening(8.5, 7.5, door_width, True),
        Opening(16.5, 7.5, door_width, True),
        Opening(11.0, 3.75, 1.5 * door_width, False),
        Opening(3.5, 9.9, door_width, True),
        Opening(10.25, 9.9, door_width, True),
        Opening(17.0, 9.9, door_width, True),
        Opening(7.0, 12.5, door_width, False),
        Opening(13.5, 12.5, door_width, False),
    )
    return FloorPlan(ROOMS, _LINES, doors, WIDTH, DEPTH, floor_tile_m=_FLOOR_TILE_M)


def room_at(x: float, y: float) -> Room | None:
    """The room that holds a place, or None outside the house."""
    return next((room for room in ROOMS if room.holds(x, y)), None)
