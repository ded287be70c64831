"""The house's plan: rooms, the corridor, walls and the openings between them.

The house's frame has its origin on the floor at the south-west corner, x east, y north, z up, in
metres. Walls stand on the lines between rooms and have a thickness; rooms are given by the lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from fgslam.simulation.patches import Patch, Surface, Thing, box, rectangle

HEIGHT = 2.7
DOOR_HEIGHT = 2.1
HALF_WALL = 0.06
_TILE = 3.2
_FLOOR_TILE_M = 5.3
"""No whole number of legs: with tiles of 4 m a leg of 4 m shows the same floor at the same place,
and homing vectors follow the pattern instead of the room."""


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


ROOMS = (
    Room("hall", 0.0, 0.0, 11.0, 7.5, "wall_cream", "parquet"),
    Room("office", 11.0, 0.0, 20.0, 7.5, "wall_blue", "carpet"),
    Room("corridor", 0.0, 7.5, 20.0, 9.9, "wall_white", "carpet"),
    Room("library", 0.0, 9.9, 7.0, 15.0, "wall_green", "parquet"),
    Room("workshop", 7.0, 9.9, 13.5, 15.0, "bricks", "carpet"),
    Room("studio", 13.5, 9.9, 20.0, 15.0, "wall_rose", "parquet"),
)
WIDTH, DEPTH = 20.0, 15.0


def openings(door_width: float) -> tuple[Opening, ...]:
    """All openings; the one between hall and office is half as wide again."""
    return (
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


def room_at(x: float, y: float) -> Room | None:
    """The room that holds a place, or None outside the house."""
    return next((room for room in ROOMS if room.holds(x, y)), None)


def shell(doors: tuple[Opening, ...]) -> list[Thing]:
    """Floors, ceilings, walls and door frames."""
    out: list[Thing] = []
    for room in ROOMS:
        w, d = room.east - room.west, room.north - room.south
        cover = Surface(room.floor, _FLOOR_TILE_M)
        floor = rectangle((room.west, room.north, 0), (w, 0, 0), (0, -d, 0), cover)
        above = Surface("ceiling", 4.8)
        ceiling = rectangle((room.west, room.south, HEIGHT), (w, 0, 0), (0, d, 0), above)
        out += [Thing(f"floor_{room.name}", (floor,)), Thing(f"ceiling_{room.name}", (ceiling,))]
    out += _outer_walls()
    for along_x, at, low, high in (
        (True, 7.5, 0.0, WIDTH),
        (True, 9.9, 0.0, WIDTH),
        (False, 11.0, 0.0, 7.5),
        (False, 7.0, 9.9, DEPTH),
        (False, 13.5, 9.9, DEPTH),
    ):
        out.append(_inner_wall(along_x, at, low, high, doors, len(out)))
    frames = [Thing(f"door_frame_{i}", tuple(_frame(door))) for i, door in enumerate(doors)]
    return out + frames


def _outer_walls() -> list[Thing]:
    """Four sides seen from within, cut where the cover changes from room to room."""
    out = []
    for room in ROOMS:
        patches: list[Patch] = []
        w, d, cover = room.east - room.west, room.north - room.south, Surface(room.wall, _TILE)
        h, down = HEIGHT, (0.0, 0.0, -HEIGHT)
        if room.north == DEPTH:
            patches.append(rectangle((room.west, DEPTH - HALF_WALL, h), (w, 0, 0), down, cover))
        if room.south == 0.0:
            patches.append(rectangle((room.east, HALF_WALL, h), (-w, 0, 0), down, cover))
        if room.east == WIDTH:
            patches.append(rectangle((WIDTH - HALF_WALL, room.north, h), (0, -d, 0), down, cover))
        if room.west == 0.0:
            patches.append(rectangle((HALF_WALL, room.south, h), (0, d, 0), down, cover))
        out.append(Thing(f"wall_{room.name}", tuple(patches)))
    return out


def _inner_wall(
    along_x: bool, at: float, low: float, high: float, doors: tuple[Opening, ...], number: int
) -> Thing:
    """A wall on a line of the plan, cut at its openings and where rooms beside it change."""
    here = sorted(
        (door.x if along_x else door.y, door.width)
        for door in doors
        if door.along_x == along_x and (door.y if along_x else door.x) == at
    )
    edges = [low, *(c + s * w / 2 for c, w in here for s in (-1, 1)), high]
    spans = [(a, b, 0.0) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    spans += [(c - w / 2, c + w / 2, DOOR_HEIGHT) for c, w in here]
    patches: list[Patch] = []
    for a, b, sill in spans:
        inside = [r.west if along_x else r.south for r in ROOMS]
        cuts = [a, *sorted({cut for cut in inside if a < cut < b}), b]
        for first, last in pairwise(cuts):
            patches += _wall_piece(along_x, at, first, last, sill)
    return Thing(f"inner_wall_{number}", tuple(patches))


def _wall_piece(along_x: bool, at: float, a: float, b: float, sill: float) -> list[Patch]:
    """Two faces with the covers of the rooms that they look into, and the rim."""
    middle, h, t = (a + b) / 2, HEIGHT, HALF_WALL
    down = (0.0, 0.0, sill - h)
    rim = Surface("plain_light", 1.0)
    if along_x:
        south, north = _cover(middle, at - 0.5), _cover(middle, at + 0.5)
        out = [
            rectangle((a, at - t, h), (b - a, 0, 0), down, south),
            rectangle((b, at + t, h), (a - b, 0, 0), down, north),
        ]
        if sill > 0.0:
            out.append(rectangle((a, at - t, sill), (b - a, 0, 0), (0, 2 * t, 0), rim))
        return out
    west, east = _cover(at - 0.5, middle), _cover(at + 0.5, middle)
    out = [
        rectangle((at - t, b, h), (0, a - b, 0), down, west),
        rectangle((at + t, a, h), (0, b - a, 0), down, east),
    ]
    if sill > 0.0:
        out.append(rectangle((at - t, a, sill), (2 * t, 0, 0), (0, b - a, 0), rim))
    return out


def _cover(x: float, y: float) -> Surface:
    room = room_at(x, y)
    return Surface(room.wall if room else "wall_white", _TILE)


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
