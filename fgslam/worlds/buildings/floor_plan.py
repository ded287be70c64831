"""Floor plans: rectangular rooms, the walls on the lines between them, and the doors in the walls.

A plan's frame has its origin on the floor at the south-west corner, x east, y north, z up, in
metres. Walls stand on the lines between rooms and have a thickness; rooms are given by the lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.worlds.patches import Patch, Surface, Thing, box, rectangle

HEIGHT = 2.7
DOOR_HEIGHT = 2.1
HALF_WALL = 0.06


@dataclass(frozen=True, slots=True)
class Room:
    """A rectangle of the plan and what covers its walls and floor."""

    name: str
    west: float
    south: float
    east: float
    north: float
    wall: str
    floor: str

    @property
    def centre(self) -> tuple[float, float]:
        """x, y of the middle."""
        return (self.west + self.east) / 2, (self.south + self.north) / 2

    def length(self, wall: str) -> float:
        """Of one wall (``north``, ``east``, ``south``, ``west``), metres."""
        sides = self.east - self.west, self.north - self.south
        return sides[0] if wall in ("north", "south") else sides[1]

    def holds(self, x: float, y: float) -> bool:
        """Whether a place lies in this room."""
        return self.west <= x < self.east and self.south <= y < self.north


@dataclass(frozen=True, slots=True)
class Opening:
    """A door's opening in the wall of two rooms: its middle, and which way the wall runs."""

    x: float
    y: float
    width: float
    along_x: bool


@dataclass(frozen=True, slots=True)
class WallLine:
    """A line of the plan on which a wall stands: y for one along x, x for one along y."""

    along_x: bool
    at: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Rooms that fill a rectangle, the lines between them and the doors.

    Attributes:
        rooms: they cover the rectangle from (0, 0) to (width, depth).
        lines: of the inner walls.
        doors: openings in the inner walls.
        width, depth: of the whole, metres.
        no_room: cover of an inner wall beside which there is no room.
        wall_tile_m, floor_tile_m: what one copy of a cover spans, metres.
    """

    rooms: tuple[Room, ...]
    lines: tuple[WallLine, ...]
    doors: tuple[Opening, ...]
    width: float
    depth: float
    no_room: str = "wall_white"
    wall_tile_m: float = 3.2
    floor_tile_m: float = 5.3

    def room_at(self, x: float, y: float) -> Room | None:
        """The room that holds a place, or None outside the building."""
        return next((room for room in self.rooms if room.holds(x, y)), None)


def shell(plan: FloorPlan) -> list[Thing]:
    """Floors, ceilings, walls and door frames."""
    out: list[Thing] = []
    for room in plan.rooms:
        w, d = room.east - room.west, room.north - room.south
        cover = Surface(room.floor, plan.floor_tile_m)
        floor = rectangle((room.west, room.north, 0), (w, 0, 0), (0, -d, 0), cover)
        above = Surface("ceiling", 4.8)
        ceiling = rectangle((room.west, room.south, HEIGHT), (w, 0, 0), (0, d, 0), above)
        out += [Thing(f"floor_{room.name}", (floor,)), Thing(f"ceiling_{room.name}", (ceiling,))]
    out += [_outer_wall(plan, room) for room in plan.rooms]
    for line in plan.lines:
        out.append(_inner_wall(plan, line, len(out)))
    frames = [Thing(f"door_frame_{i}", tuple(_frame(d))) for i, d in enumerate(plan.doors)]
    return out + frames


def ceiling_lamps(plan: FloorPlan, spacing: float) -> FloatArray:
    """(k, 3, 3) corner and two edges of lamps in the ceilings, about ``spacing`` metres apart."""
    out = []
    for room in plan.rooms:
        w, d = room.east - room.west, room.north - room.south
        columns, rows = max(round(w / spacing), 1), max(round(d / spacing), 1)
        for i in range(columns):
            for j in range(rows):
                x = room.west + (i + 0.5) * w / columns
                y = room.south + (j + 0.5) * d / rows
                out.append([[x - 0.5, y - 0.2, HEIGHT - 0.02], [1.0, 0, 0], [0, 0.4, 0]])
    return np.array(out)


def lamp_things(lamps: FloatArray) -> list[Thing]:
    """The lamps as things that glow."""
    glow = Surface("lamp", None, glow=1.0)
    return [
        Thing(f"lamp_{k}", (rectangle(corner - [0, 0, 0.003], u, v, glow),))
        for k, (corner, u, v) in enumerate(lamps)
    ]


def _outer_wall(plan: FloorPlan, room: Room) -> Thing:
    """The sides of a room that bound the building, seen from within."""
    patches: list[Patch] = []
    w, d = room.east - room.west, room.north - room.south
    cover = Surface(room.wall, plan.wall_tile_m)
    h, t, down = HEIGHT, HALF_WALL, (0.0, 0.0, -HEIGHT)
    if room.north == plan.depth:
        patches.append(rectangle((room.west, plan.depth - t, h), (w, 0, 0), down, cover))
    if room.south == 0.0:
        patches.append(rectangle((room.east, t, h), (-w, 0, 0), down, cover))
    if room.east == plan.width:
        patches.append(rectangle((plan.width - t, room.north, h), (0, -d, 0), down, cover))
    if room.west == 0.0:
        patches.append(rectangle((t, room.south, h), (0, d, 0), down, cover))
    return Thing(f"wall_{room.name}", tuple(patches))


def _inner_wall(plan: FloorPlan, line: WallLine, number: int) -> Thing:
    """A wall on a line of the plan, cut at its openings and where rooms beside it change."""
    here = sorted(
        (along, door.width)
        for door in plan.doors
        if (along := _along(door, line)) is not None and line.low < along < line.high
    )
    edges = [line.low, *(c + s * w / 2 for c, w in here for s in (-1, 1)), line.high]
    spans = [(a, b, 0.0) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    spans += [(c - w / 2, c + w / 2, DOOR_HEIGHT) for c, w in here]
    patches: list[Patch] = []
    for a, b, sill in spans:
        inside = [r.west if line.along_x else r.south for r in plan.rooms]
        cuts = [a, *sorted({cut for cut in inside if a < cut < b}), b]
        for first, last in pairwise(cuts):
            patches += _wall_piece(plan, line, first, last, sill)
    return Thing(f"inner_wall_{number}", tuple(patches))


def _along(door: Opening, line: WallLine) -> float | None:
    """Where on a line a door's middle lies, or None where the door is not on it."""
    if door.along_x != line.along_x or (door.y if door.along_x else door.x) != line.at:
        return None
    return door.x if door.along_x else door.y


def _wall_piece(plan: FloorPlan, line: WallLine, a: float, b: float, sill: float) -> list[Patch]:
    """Two faces with the covers of the rooms that they look into, and the rim."""
    middle, at, h, t = (a + b) / 2, line.at, HEIGHT, HALF_WALL
    down = (0.0, 0.0, sill - h)
    rim = Surface("plain_light", 1.0)
    if line.along_x:
        south, north = _cover(plan, middle, at - 0.5), _cover(plan, middle, at + 0.5)
        out = [
            rectangle((a, at - t, h), (b - a, 0, 0), down, south),
            rectangle((b, at + t, h), (a - b, 0, 0), down, north),
        ]
        if sill > 0.0:
            out.append(rectangle((a, at - t, sill), (b - a, 0, 0), (0, 2 * t, 0), rim))
        return out
    west, east = _cover(plan, at - 0.5, middle), _cover(plan, at + 0.5, middle)
    out = [
        rectangle((at - t, b, h), (0, a - b, 0), down, west),
        rectangle((at + t, a, h), (0, b - a, 0), down, east),
    ]
    if sill > 0.0:
        out.append(rectangle((at - t, a, sill), (2 * t, 0, 0), (0, b - a, 0), rim))
    return out


def _cover(plan: FloorPlan, x: float, y: float) -> Surface:
    room = plan.room_at(x, y)
    return Surface(room.wall if room else plan.no_room, plan.wall_tile_m)


def _frame(door: Opening) -> list[Patch]:
    """Two posts and a beam, a little thicker than the wall."""
    wood = Surface("wood_dark", 0.8)
    t, half, post = HALF_WALL + 0.02, door.width / 2, 0.07
    posts = ((-half, -half + post, 0.0), (half - post, half, 0.0))
    spans = (*posts, (-half, half, DOOR_HEIGHT - 0.07))
    out: list[Patch] = []
    for low, high, bottom in spans:
        if door.along_x:
            a, b = (door.x + low, door.y - t, bottom), (door.x + high, door.y + t, DOOR_HEIGHT)
        else:
            a, b = (door.x - t, door.y + low, bottom), (door.x + t, door.y + high, DOOR_HEIGHT)
        out += box(a, b, wood)
    return out
