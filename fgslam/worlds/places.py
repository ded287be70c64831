"""What stands where: floor plans, furniture, and the lab, office, corridors and house made of them.

A plan's frame has its origin on the floor at the south-west corner, the lab's in the middle; x is
east, y north, z up, in metres. A piece of furniture stands on z = 0 with its front towards -y and
its middle at x = 0. Layout and small things are drawn from a seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.worlds.patches import Patch, Surface, Thing, box, placed, prism, rectangle
from fgslam.worlds.textures import (
    BINDER_ROWS,
    BOOK_ROWS,
    CARTONS,
    PAINTINGS,
    PHOTOGRAPHS,
    PICTURES,
    POSTERS,
    SCREENS,
)

HEIGHT, LAB_HEIGHT = 2.7, 3.0  # of ceilings
DOOR_HEIGHT = 2.1
HALF_WALL = 0.06


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


# --------------------------------------------------------------------------------------------
# Floor plans: rectangular rooms, the walls on the lines between them, and the doors in the walls


class Room(NamedTuple):
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

    @property
    def size(self) -> tuple[float, float]:
        """Width along x and depth along y."""
        return self.east - self.west, self.north - self.south

    def holds(self, x: float, y: float) -> bool:
        """Whether a point lies in this room."""
        return self.west <= x < self.east and self.south <= y < self.north


class Door(NamedTuple):
    """An opening in the wall of two rooms: its middle, and whether the wall runs along x."""

    x: float
    y: float
    width: float
    along_x: bool


class WallLine(NamedTuple):
    """A line on which an inner wall stands: at y for one along x, at x for one along y."""

    along_x: bool
    at: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Rooms that fill the rectangle from (0, 0) to (width, depth), inner walls and doors.

    Attributes:
        no_room: cover of an inner wall next to which there is no room.
        wall_tile_m, floor_tile_m: what one copy of a cover spans, metres.
    """

    rooms: tuple[Room, ...]
    lines: tuple[WallLine, ...]
    doors: tuple[Door, ...]
    width: float
    depth: float
    no_room: str = "wall_white"
    wall_tile_m: float = 3.2
    floor_tile_m: float = 5.3

    def cover(self, x: float, y: float) -> Surface:
        """Cover of a wall seen from a point."""
        room = next((room for room in self.rooms if room.holds(x, y)), None)
        return Surface(room.wall if room else self.no_room, self.wall_tile_m)


def build_shell(plan: FloorPlan) -> list[Thing]:
    """Floors, ceilings, walls and door frames."""
    out: list[Thing] = []
    t, h, down = HALF_WALL, HEIGHT, (0.0, 0.0, -HEIGHT)
    for room in plan.rooms:
        w, d = room.size
        cover = Surface(room.floor, plan.floor_tile_m)
        floor = rectangle((room.west, room.north, 0), (w, 0, 0), (0, -d, 0), cover)
        above = Surface("ceiling", 4.8)
        ceiling = rectangle((room.west, room.south, h), (w, 0, 0), (0, d, 0), above)
        out += [Thing(f"floor_{room.name}", (floor,)), Thing(f"ceiling_{room.name}", (ceiling,))]
    for room in plan.rooms:
        w, d = room.size
        sides = (
            (room.north == plan.depth, (room.west, plan.depth - t, h), (w, 0, 0)),
            (room.south == 0.0, (room.east, t, h), (-w, 0, 0)),
            (room.east == plan.width, (plan.width - t, room.north, h), (0, -d, 0)),
            (room.west == 0.0, (t, room.south, h), (0, d, 0)),
        )
        cover = Surface(room.wall, plan.wall_tile_m)
        walls = (rectangle(corner, edge, down, cover) for outer, corner, edge in sides if outer)
        out.append(Thing(f"wall_{room.name}", tuple(walls)))
    for line in plan.lines:
        out.append(Thing(f"inner_wall_{len(out)}", tuple(_inner_wall(plan, line))))
    out += [Thing(f"door_frame_{i}", tuple(_frame(door))) for i, door in enumerate(plan.doors)]
    return out


def _inner_wall(plan: FloorPlan, line: WallLine) -> list[Patch]:
    """Both faces of a wall, cut at its doors and where rooms next to it change, and the rims."""

    def at(along: float, across: float, z: float) -> tuple[float, float, float]:
        return (along, across, z) if line.along_x else (across, along, z)

    doors = [(*at(d.x, d.y, 0.0)[:2], d.width) for d in plan.doors if d.along_x == line.along_x]
    here = sorted((x, w) for x, y, w in doors if y == line.at and line.low < x < line.high)
    edges = [line.low, *(x + side * w / 2 for x, w in here for side in (-1, 1)), line.high]
    spans = [(a, b, 0.0) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    spans += [(x - w / 2, x + w / 2, DOOR_HEIGHT) for x, w in here]
    starts = {room.west if line.along_x else room.south for room in plan.rooms}
    t, h, rim = HALF_WALL, HEIGHT, Surface("plain_light", 1.0)
    out: list[Patch] = []
    for low, high, sill in spans:
        for a, b in pairwise([low, *sorted(cut for cut in starts if low < cut < high), high]):
            first, last = (a, b) if line.along_x else (b, a)
            for side, start, end in ((-1, first, last), (1, last, first)):
                x, y, _ = at((a + b) / 2, line.at + side * 0.5, 0.0)
                corner, edge = at(start, line.at + side * t, h), at(end - start, 0, 0)
                out.append(rectangle(corner, edge, (0.0, 0.0, sill - h), plan.cover(x, y)))
            if sill > 0.0:
                u, v = at(b - a, 0, 0), at(0, 2 * t, 0)
                u, v = (u, v) if line.along_x else (v, u)
                out.append(rectangle(at(a, line.at - t, sill), u, v, rim))
    return out


def _frame(door: Door) -> list[Patch]:
    """Two posts and a beam, a little thicker than the wall."""
    wood = Surface("wood_dark", 0.8)
    t, half, post = HALF_WALL + 0.02, door.width / 2, 0.07
    out: list[Patch] = []
    for low, high, bottom in (
        (-half, -half + post, 0.0),
        (half - post, half, 0.0),
        (-half, half, DOOR_HEIGHT - 0.07),
    ):
        (x0, x1), (y0, y1) = ((low, high), (-t, t)) if door.along_x else ((-t, t), (low, high))
        start, end = (door.x + x0, door.y + y0, bottom), (door.x + x1, door.y + y1, DOOR_HEIGHT)
        out += box(start, end, wood)
    return out


def _lamp(x: float, y: float, width: float, depth: float, height: float) -> list[list[float]]:
    return [[x - width / 2, y - depth / 2, height - 0.02], [width, 0, 0], [0, depth, 0]]


def _ceiling_lamps(plan: FloorPlan, spacing: float) -> FloatArray:
    """(k, 3, 3) lamps in the ceilings, about ``spacing`` metres apart."""
    out = []
    for room in plan.rooms:
        w, d = room.size
        columns, rows = max(round(w / spacing), 1), max(round(d / spacing), 1)
        for i in range(columns):
            for j in range(rows):
                x = room.west + (i + 0.5) * w / columns
                y = room.south + (j + 0.5) * d / rows
                out.append(_lamp(x, y, 1.0, 0.4, HEIGHT))
    return np.array(out)


def _lamp_things(lamps: FloatArray) -> list[Thing]:
    glow = Surface("lamp", None, glow=1.0)
    return [
        Thing(f"lamp_{k}", (rectangle(corner - [0, 0, 0.003], u, v, glow),))
        for k, (corner, u, v) in enumerate(lamps)
    ]


# --------------------------------------------------------------------------------------------
# Furniture

_METAL, _BLACK = Surface("metal_dark", 0.8), Surface("plain_dark", 0.6)
_DARK_WOOD = Surface("wood_dark", 0.8)


def _one_of(rng: np.random.Generator, family: str, count: int) -> str:
    return f"{family}_{int(rng.integers(0, count))}"


def table(width: float, depth: float, height: float, top: Surface) -> list[Patch]:
    """A table top on four legs."""
    w, d = width / 2, depth / 2
    out = box((-w, -d, height - 0.035), (w, d, height), top)
    for x in (-w + 0.05, w - 0.05):
        for y in (-d + 0.05, d - 0.05):
            out += prism((x, y, 0.0), (x, y, height - 0.035), 0.025, _METAL, sides=6)
    return out


def desk(rng: np.random.Generator, width: float, screens: int) -> list[Patch]:
    """A table with computers and mugs, books, papers and a drawer unit below."""
    out = table(
        width, 0.75, 0.74, Surface(str(rng.choice(["wood_light", "wood_desk", "wood_dark"])), 0.9)
    )
    for k in range(screens):
        picture = Surface(_one_of(rng, "screen", SCREENS), None, glow=0.95)
        computer = box((-0.24, -0.02, 0.12), (0.24, 0.04, 0.46), _BLACK, front=picture)
        computer += box((-0.03, 0.0, 0.0), (0.03, 0.03, 0.12), _BLACK)
        computer += box((-0.13, -0.08, 0.0), (0.13, 0.10, 0.015), _BLACK)
        computer += box((-0.22, -0.33, 0.0), (0.22, -0.18, 0.02), _BLACK, top=Surface("keyboard"))
        mug = Surface(_one_of(rng, "carton", CARTONS), 0.2)
        computer += prism((0.33, -0.2, 0.0), (0.33, -0.2, 0.1), 0.04, mug, sides=8)
        x = (k + 0.5) / screens * width - width / 2
        out += placed(computer, x, 0.12, 0.74, float(rng.uniform(-12, 12)))
    for _ in range(2):
        x, y = rng.uniform(-width / 2 + 0.2, width / 2 - 0.2), rng.uniform(-0.25, -0.1)
        paper = Surface(_one_of(rng, "poster", 8))
        sheet = rectangle((-0.1, 0.14, 0.002), (0.2, 0, 0), (0, -0.28, 0), paper)
        out += placed([sheet], float(x), float(y), 0.74, float(rng.uniform(-40, 40)))
    books = Surface(_one_of(rng, "books", BOOK_ROWS))
    row = box((-0.3, -0.09, 0.0), (0.3, 0.09, 0.25), _DARK_WOOD, front=books)
    out += placed(row, width / 2 - 0.34, 0.26, 0.74, float(rng.uniform(-10, 10)))
    drawers = box((-0.2, -0.3, 0.0), (0.2, 0.3, 0.6), _METAL, front=Surface("metal"))
    return out + placed(drawers, width / 2 - 0.32, 0.0, 0.0, 0.0)


def carton(rng: np.random.Generator, size: tuple[float, float, float]) -> list[Patch]:
    """A cardboard box."""
    w, d, h = size
    sides = [Surface(_one_of(rng, "carton", CARTONS)) for _ in range(3)]
    return box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), sides[0], front=sides[1], top=sides[2])


def shelf(rng: np.random.Generator, width: float, height: float, depth: float) -> list[Patch]:
    """An open shelf with rows of books or binders and some cartons; its back is closed."""
    frame = Surface(str(rng.choice(["wood_light", "wood_dark"])), 0.8)
    w, levels = width / 2, max(int(height / 0.42), 1)
    out = box((-w, -depth, 0), (-w + 0.03, 0, height), frame)
    out += box((w - 0.03, -depth, 0), (w, 0, height), frame)
    out += box((-w, -0.02, 0), (w, 0, height), _DARK_WOOD)
    inner, room = width - 0.08, (height - 0.03) / levels - 0.03
    for level in range(levels + 1):
        z = level * (height - 0.03) / levels
        out += box((-w + 0.03, -depth, z), (w - 0.03, -0.02, z + 0.03), frame)
        if level == levels:
            break
        load: list[Patch] = []
        if rng.random() < 0.25:
            for k in range(2):
                wide, high = rng.uniform(0.3, 0.45) * inner, rng.uniform(0.5, 0.95) * room
                x = (k - 0.5) * inner / 2 + float(rng.uniform(-0.02, 0.02))
                packed = carton(rng, (float(wide), 0.7 * depth, float(high)))
                load += placed(packed, x, -depth / 2, 0, float(rng.uniform(-8, 8)))
        else:
            family = ("books", BOOK_ROWS) if rng.random() < 0.5 else ("binders", BINDER_ROWS)
            row = Surface(_one_of(rng, *family))
            front, tall = -depth + float(rng.uniform(0.02, 0.09)), room * 0.96
            load.append(rectangle((-inner / 2, front, tall), (inner, 0, 0), (0, 0, -tall), row))
        out += placed(load, 0, 0, z + 0.03, 0)
    return out


def cabinet(width: float, height: float, depth: float, surface: Surface) -> list[Patch]:
    """A closed cabinet."""
    front = Surface(surface.texture)
    return box((-width / 2, -depth, 0), (width / 2, 0, height), surface, front=front)


def chair() -> list[Patch]:
    """An office chair: seat, back, pole and five feet."""
    fabric = Surface("cloth", 0.35)
    out = box((-0.24, -0.24, 0.44), (0.24, 0.24, 0.51), fabric)
    out += box((-0.22, 0.2, 0.6), (0.22, 0.26, 1.08), fabric)
    out += box((-0.03, 0.22, 0.48), (0.03, 0.25, 0.62), _BLACK)
    out += prism((0, 0, 0.08), (0, 0, 0.44), 0.03, _METAL)
    for k in range(5):
        angle = 2 * np.pi * k / 5
        foot = (0.3 * float(np.cos(angle)), 0.3 * float(np.sin(angle)), 0.05)
        out += prism((0, 0, 0.1), foot, 0.02, _METAL, sides=6)
    return out


def hanging(width: float, height: float, surface: Surface) -> list[Patch]:
    """A flat board, its lower edge at z = 0, just before y = 0: posters, windows, doors."""
    return [rectangle((-width / 2, -0.004, height), (width, 0, 0), (0, 0, -height), surface)]


def _sofa(width: float, cover: str) -> list[Patch]:
    cloth, w = Surface(cover, 0.6), width / 2
    out = box((-w, -0.85, 0.05), (w, 0.0, 0.42), cloth)
    out += box((-w, -0.22, 0.42), (w, 0.0, 0.85), cloth)
    for side in (-w, w - 0.18):
        out += box((side, -0.85, 0.42), (side + 0.18, -0.22, 0.6), cloth)
    return out


def _bed(cover: str) -> list[Patch]:
    """A bed, its head against the wall, with a pillow and a bedspread."""
    out = box((-0.8, -2.0, 0.08), (0.8, 0.0, 0.5), _DARK_WOOD, top=Surface(cover, 0.8))
    out += box((-0.85, -0.06, 0.0), (0.85, 0.0, 1.0), _DARK_WOOD)
    pillow = box((-0.6, -0.5, 0.0), (0.6, -0.1, 0.14), Surface("plain_light", 0.5))
    return out + placed(pillow, 0, 0, 0.5, 0)


def _plant(rng: np.random.Generator) -> list[Patch]:
    """A pot with upright leaves, each seen from both sides."""
    out = prism((0, 0, 0), (0, 0, 0.35), 0.17, Surface("bricks", 0.8))
    for _ in range(9):
        yaw, lean, tall = rng.uniform(0, 360), rng.uniform(0.05, 0.35), rng.uniform(0.5, 1.0)
        green = Surface("cloth_green", float(rng.uniform(0.3, 0.9)))
        leaf = rectangle((-0.08, -lean, 0.3 + tall), (0.16, 0, 0), (0, lean, -tall), green)
        out += placed([leaf], 0.0, 0.0, 0.0, float(yaw))
    return out


def _dining_table(rng: np.random.Generator, width: float) -> list[Patch]:
    """A table with four chairs, a bowl and a carton on it."""
    out = table(width, 0.9, 0.74, Surface("wood_light", 0.9))
    for x, y, yaw in ((-0.4, -0.6, 180), (0.4, -0.65, 170), (-0.4, 0.62, 5), (0.45, 0.6, -10)):
        out += placed(chair(), x, y, 0.0, yaw + float(rng.uniform(-15, 15)))
    out += placed(prism((0, 0, 0), (0, 0, 0.1), 0.14, Surface("cloth_red", 0.4)), 0.1, 0.0, 0.74, 0)
    return out + placed(carton(rng, (0.25, 0.2, 0.25)), -0.45, 0.05, 0.74, 20)


def _rug(width: float, depth: float, texture: str) -> list[Patch]:
    corner = (-width / 2, depth / 2, 0.004)
    return [rectangle(corner, (width, 0, 0), (0, -depth, 0), Surface(texture))]


# --------------------------------------------------------------------------------------------
# Furniture along the walls of a room

# Turned by this much (degrees), a piece whose front is -y faces the room from that wall.
_WALLS = {"north": 0.0, "east": -90.0, "south": 180.0, "west": 90.0}
# Kept free of furniture next to an opening and in corners, metres.
_DOOR_MARGIN, _CORNER_MARGIN = 0.55, 0.25
_WIDTHS = {
    "shelf": (0.9, 1.5),
    "desk": (1.5, 2.3),
    "cabinet": (0.6, 1.1),
    "sofa": (1.5, 2.2),
    "gap": (0.6, 1.4),
}


@dataclass(frozen=True, slots=True)
class FittingStyle:
    """What may stand along the walls of a room.

    Attributes:
        kinds: drawn from, ``gap`` leaves the floor free; weights: of each, None for equal ones.
        cabinet_depth: metres.
        cloths: textures of sofas.
    """

    kinds: tuple[str, ...]
    weights: tuple[float, ...] | None = None
    cabinet_depth: float = 0.45
    cloths: tuple[str, ...] = ("cloth",)


def fit_room(
    room: Room,
    doors: tuple[Door, ...],
    rng: np.random.Generator,
    style: FittingStyle,
    pictures: list[str],
) -> list[Thing]:
    """Furniture along the walls of a room and pictures on them, taken from the list's end."""
    out: list[Thing] = []
    (w, d), (x, y) = room.size, room.centre

    def add(kind: str, patches: list[Patch], wall: str, along: float, bottom: float) -> None:
        off = (d if wall in ("north", "south") else w) / 2 - HALF_WALL - 0.005
        there = placed(placed(patches, along, off, bottom, 0.0), x, y, 0.0, _WALLS[wall])
        out.append(Thing(f"{room.name}_{kind}_{len(out)}", tuple(there)))

    for wall in _WALLS:
        for low, high in _free_intervals(room, doors, wall):
            cursor = low
            while high - cursor > 0.45:
                kind = str(rng.choice(style.kinds, p=style.weights))
                width = min(float(rng.uniform(*_WIDTHS[kind])), high - cursor)
                if width < _WIDTHS[kind][0]:
                    kind = "gap"
                patches, top = _wall_piece(rng, style, kind, width)
                if patches:
                    add(kind, patches, wall, cursor + width / 2, 0.0)
                if top < 1.6 and width > 0.5:  # a picture above, or at eye level over a gap
                    bottom = max(top + 0.08, 1.0) + float(rng.uniform(0.0, 0.2))
                    side = min(width * float(rng.uniform(0.75, 1.0)), 1.2, 2.5 - bottom)
                    if side >= 0.3 and pictures:
                        picture = Surface(pictures.pop())
                        wide = min(width, side * float(rng.uniform(0.8, 1.3)))
                        board = hanging(wide, side, picture)
                        add("picture", board, wall, cursor + width / 2, bottom)
                cursor += width + float(rng.uniform(0.05, 0.3))
    return out


def _free_intervals(room: Room, doors: tuple[Door, ...], wall: str) -> list[tuple[float, float]]:
    """Intervals along a wall without a door, metres to the right of its middle as one faces it."""
    along_x, (x, y) = wall in ("north", "south"), room.centre
    at = {"north": room.north, "south": room.south, "east": room.east, "west": room.west}[wall]
    sign = 1 if wall in ("north", "west") else -1
    half = (room.size[0] if along_x else room.size[1]) / 2 - _CORNER_MARGIN
    cuts = []
    for door in doors:
        off, along = (door.y, door.x - x) if along_x else (door.x, door.y - y)
        on_it = room.west < door.x < room.east if along_x else room.south < door.y < room.north
        if door.along_x == along_x and off == at and on_it:
            middle, reach = along * sign, door.width / 2
            cuts.append((middle - reach - _DOOR_MARGIN, middle + reach + _DOOR_MARGIN))
    edges = [-half, *(edge for cut in sorted(cuts) for edge in cut), half]
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [(low, high) for low, high in pairs if high - low > 0.3]


def _wall_piece(
    rng: np.random.Generator, style: FittingStyle, kind: str, width: float
) -> tuple[list[Patch], float]:
    """Patches and height of a piece; none for a gap."""
    if kind == "shelf":
        height = float(rng.uniform(1.6, 2.2))
        return shelf(rng, width, height, 0.32), height
    if kind == "desk":
        return placed(desk(rng, width, 1 + int(width > 1.9)), 0, -0.4, 0, 0), 1.25
    if kind == "cabinet":
        height = float(rng.uniform(0.8, 1.3))
        cover = Surface(str(rng.choice(["metal", "metal_dark", "wood_dark", "door"])), 0.9)
        return cabinet(width, height, style.cabinet_depth, cover), height
    if kind == "sofa":
        return _sofa(width, str(rng.choice(style.cloths))), 0.85
    return [], 0.9


# --------------------------------------------------------------------------------------------
# The lab: a room of 10 m x 10 m

HALF_SIDE = 5.0

# Wall, metres along it to the right as one faces it, width, then height or, of a desk, screens.
_AT_WALLS = {
    "shelf": (
        ("north", -3.8, 1.2, 2.1), ("north", -2.5, 1.2, 2.1), ("north", 2.9, 1.4, 1.8),
        ("east", -3.6, 1.2, 2.0), ("east", 3.3, 1.3, 2.2),
        ("south", -2.4, 1.3, 2.1), ("south", 3.6, 1.2, 1.9),
        ("west", -0.3, 1.3, 1.8), ("west", 3.5, 1.2, 2.1),
    ),
    "desk": (
        ("north", 0.3, 2.4, 2), ("east", -1.6, 2.2, 2), ("east", 1.1, 2.2, 2),
        ("south", 0.5, 2.6, 3), ("west", -2.6, 2.2, 2), ("west", 1.8, 1.8, 1),
    ),
    "cabinet": (("north", 4.3, 0.9, 1.35), ("south", -4.0, 1.0, 1.5), ("west", -4.3, 0.9, 1.2)),
}  # fmt: skip
# Wall, metres along it, lower edge, width, height.
_POSTER_PLACES = (
    ("north", -1.2, 1.25, 0.9, 0.9), ("north", -0.1, 1.5, 1.0, 1.2), ("north", 1.2, 1.3, 0.9, 0.9),
    ("north", 4.2, 1.6, 0.9, 0.9), ("north", 2.9, 1.95, 0.9, 0.8),
    ("east", -2.3, 1.3, 0.9, 0.9), ("east", -1.0, 1.4, 1.2, 1.2), ("east", 0.4, 1.3, 0.9, 1.1),
    ("east", 1.7, 1.35, 1.0, 1.0), ("south", -1.2, 1.3, 0.9, 0.9), ("south", -4.0, 1.65, 0.9, 0.9),
    ("west", -3.4, 1.35, 1.0, 1.0), ("west", -2.2, 1.3, 0.9, 1.2), ("west", 0.9, 1.4, 0.9, 0.9),
    ("west", 2.2, 1.35, 1.1, 1.1), ("west", -4.4, 1.5, 0.7, 0.9), ("west", -0.3, 1.95, 1.0, 0.8),
)  # fmt: skip
_PINBOARD_PLACES = (
    ("east", 1.03, 0.8, 0.6, 0.5), ("east", -1.65, 0.8, 0.6, 0.5), ("east", 2.55, 1.3, 0.6, 0.8),
    ("west", 1.55, 0.8, 0.6, 0.6), ("west", -2.75, 0.8, 0.6, 0.5),
)  # fmt: skip
# Of the poster places: one of 1.0 m x 1.2 m on the north wall, and where its copy hangs.
_COPIED_POSTER = (1, 7)
_ISLAND_DESK = (0.2, 2.35)
# Size of a carton; x, y, z and yaw in degrees at the first visit, and at the second.
_LOOSE = (
    ("chair", None, (0.0, 0.0, 0.0, 25.0), (0.35, -0.1, 0.0, -70.0)),
    ("chair_desk_1", None, (4.0, 1.5, 0.0, 70.0), (4.0, -1.2, 0.0, 110.0)),
    ("chair_desk_2", None, (-4.0, 1.9, 0.0, 240.0), (-4.0, -2.4, 0.0, 280.0)),
    ("chair_desk_3", None, (0.5, 4.05, 0.0, 190.0), (-0.5, 4.1, 0.0, 160.0)),
    ("carton_1", (0.5, 0.4, 0.35), (4.62, -4.22, 0.0, 5.0), (-4.7, 4.4, 0.0, 75.0)),
    ("carton_2", (0.4, 0.4, 0.3), (4.62, -4.22, 0.35, 20.0), (3.25, -4.5, 0.0, 5.0)),
    ("carton_3", (0.6, 0.45, 0.4), (1.7, 2.35, 0.0, 80.0), (-1.4, 2.4, 0.0, 15.0)),
    ("carton_4", (0.35, 0.3, 0.25), (-0.1, -2.45, 1.1, 25.0), (-0.9, -2.45, 1.1, -30.0)),
    ("carton_5", (0.3, 0.3, 0.3), (-0.8, -2.45, 1.1, -15.0), (0.1, -2.5, 1.1, 10.0)),
    ("carton_6", (0.45, 0.4, 0.4), (4.25, 4.15, 0.0, 5.0), (1.5, -2.4, 0.0, 40.0)),
    ("carton_7", (0.4, 0.35, 0.35), (4.0, -4.72, 1.5, 12.0), (3.85, -4.72, 1.5, -20.0)),
    ("plotter", None, (-2.0, 2.6, 0.0, 0.0), (1.9, 2.7, 0.0, 15.0)),
)
# What is exchanged before the third visit.
_POSTER_PAIRS = ((1, 10), (2, 13), (3, 7), (4, 16), (6, 12), (8, 14), (9, 15))
_SHELF_PAIRS = (
    (("shelf_1", ("north", -3.8)), ("shelf_4", ("east", -3.6))),
    (("shelf_2", ("north", -2.5)), ("shelf_9", ("west", 3.5))),
    (("shelf_5", ("east", 3.3)), ("shelf_6", ("south", -2.4))),
)


def build_lab(rng: np.random.Generator, visit: int = 1, identical_posters: bool = False) -> Place:
    """The lab; the later visits find some things elsewhere.

    Args:
        rng: for the small things: which books, which posters, at what angles.
        visit: 1; 2: chairs, cartons and the plotter stand elsewhere; 3: posters and shelves have
            been exchanged too, and the desk in the middle turned about. All draw the same random
            numbers, so that what has not moved is the same.
        identical_posters: two posters on different walls show the same and are equally large.
    """
    a, h, side = HALF_SIDE, LAB_HEIGHT, 2 * HALF_SIDE
    lamps = [_lamp(x, y, 0.6, 1.2, h) for x in (-3.75, -1.25, 1.25, 3.75) for y in (-3.1, 0.0, 3.1)]
    floor = rectangle((-a, a, 0), (side, 0, 0), (0, -side, 0), Surface("floor", 10.0))
    ceiling = rectangle((-a, -a, h), (side, 0, 0), (0, side, 0), Surface("ceiling", 4.8))
    things = {"floor": [floor], "ceiling": [ceiling]}
    things |= {thing.name: list(thing.patches) for thing in _lamp_things(np.array(lamps))}
    covers = {"north": "bricks", "east": "plaster", "south": "plaster_dark", "west": "plaster"}
    for wall, cover in covers.items():
        patch = rectangle((-a, 0, h), (side, 0, 0), (0, 0, -h), Surface(cover, 3.2))
        things[f"wall_{wall}"] = _against([patch], wall, 0.0, 0.0, 0.0)
    for kind, places in _AT_WALLS.items():
        for number, (wall, along, width, size) in enumerate(places, start=1):
            if kind == "shelf":
                patches = shelf(rng, width, size, 0.32)
            elif kind == "desk":
                patches = placed(desk(rng, width, int(size)), 0, -0.4, 0, 0)
            else:
                patches = cabinet(width, size, 0.5, Surface("metal", 0.9))
            things[f"{kind}_{number}"] = _against(patches, wall, along)
    things |= _on_lab_walls(rng, identical_posters)
    things["island_desk"] = placed(desk(rng, 2.2, 2), *_ISLAND_DESK, 0.0, 0.0)
    south = placed(shelf(rng, 1.8, 1.1, 0.35), -0.4, -2.45, 0.0, 180.0)
    things["island_shelf"] = south + placed(shelf(rng, 1.8, 1.1, 0.35), -0.4, -2.45, 0.0, 0.0)
    if visit == 3:
        _rearrange(things)
    for name, carton_size, first, second in _LOOSE:
        if carton_size is not None:
            patches = carton(rng, carton_size)
        elif name == "plotter":
            patches = cabinet(0.7, 1.0, 0.5, Surface("metal", 0.8))
        else:
            patches = chair()
        things[name] = placed(patches, *(second if visit > 1 else first))
    named = tuple(Thing(name, tuple(patches)) for name, patches in things.items())
    return Place(named, np.array(lamps), np.full(2, -a), np.full(2, a), 0.09, None)


def _against(
    patches: list[Patch], wall: str, along: float, off: float = 0.01, z: float = 0.0
) -> list[Patch]:
    """Puts a piece against a wall of the lab, ``along`` metres to the right as one faces it."""
    return placed(placed(patches, along, HALF_SIDE - off, z, 0.0), 0.0, 0.0, 0.0, _WALLS[wall])


def _on_lab_walls(rng: np.random.Generator, identical_posters: bool) -> dict[str, list[Patch]]:
    """Posters, photographs, pinboards, a window and the door."""
    photos = [f"photo_{name}" for name in rng.permutation(np.array(PHOTOGRAPHS))]
    prints = [f"poster_{i}" for i in range(POSTERS)]
    boards = []
    for i, where in enumerate(_POSTER_PLACES):
        texture = photos.pop() if (i % 2 == 0 and photos) or not prints else prints.pop()
        boards.append((f"poster_{i + 1}", *where, Surface(texture)))
    if identical_posters:
        original, copy = _COPIED_POSTER
        boards[copy] = (*boards[copy][:3], *boards[original][3:])
    pinned = enumerate(_PINBOARD_PLACES)
    boards += [(f"pinboard_{i + 1}", *where, Surface(f"pinboard_{i}")) for i, where in pinned]
    window = Surface("window", None, glow=1.05)
    boards.append(("window_1", "south", 0.5, 1.35, 1.6, 1.2, window))
    boards.append(("door", "south", 2.45, 0.0, 0.95, 2.05, Surface("door")))
    return {
        name: _against(hanging(width, height, surface), wall, along, 0.0, z)
        for name, wall, along, z, width, height, surface in boards
    }


def _rearrange(things: dict[str, list[Patch]]) -> None:
    """Things after a new start in the lab: same names, and what has moved is elsewhere.

    The posters of a pair show what the other one showed; of a pair of equally wide shelves each
    stands where the other stood; the desk in the middle faces the other way.
    """
    for pair in _POSTER_PAIRS:
        names = [f"poster_{number}" for number in pair]
        shown = [things[name][0].surface for name in names]
        for name, surface in zip(names, shown[::-1], strict=True):
            things[name] = [replace(patch, surface=surface) for patch in things[name]]
    for (a, place_a), (b, place_b) in _SHELF_PAIRS:
        first, second = things[a], things[b]
        for name, patches, start, end in (
            (a, first, place_a, place_b),
            (b, second, place_b, place_a),
        ):
            at_north = placed(patches, 0.0, 0.0, 0.0, -_WALLS[start[0]])
            along = placed(at_north, end[1] - start[1], 0.0, 0.0, 0.0)
            things[name] = placed(along, 0, 0, 0, _WALLS[end[0]])
    x, y = _ISLAND_DESK
    things["island_desk"] = placed(things["island_desk"], 2 * x, 2 * y, 0.0, 180.0)


# --------------------------------------------------------------------------------------------
# An office building of 36 m x 24 m: eleven furnished rooms and four corridors around the core
#
# Every room has its own covers and pictures; books, binders and furniture come from the same stores
# and therefore repeat. North and south rooms open to each other and to the long corridors, core
# rooms to both corridors.

OFFICE = FloorPlan(
    rooms=(
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
    ),
    lines=(
        *(WallLine(True, y, 0.0, 36.0) for y in (7.0, 9.4, 14.6, 17.0)),
        *(WallLine(False, x, 0.0, 7.0) for x in (9.0, 18.0, 27.0)),
        *(WallLine(False, x, 9.4, 14.6) for x in (2.4, 12.8, 23.2, 33.6)),
        *(WallLine(False, x, 17.0, 24.0) for x in (9.0, 18.0, 27.0)),
    ),
    doors=(
        *(Door(x, y, 1.3, True) for y in (7.0, 17.0) for x in (4.5, 13.5, 22.5, 31.5)),
        *(Door(x, y, 1.3, True) for y in (9.4, 14.6) for x in (7.6, 18.0, 28.4)),
        *(Door(x, y, 1.9, True) for y in (9.4, 14.6) for x in (1.2, 34.8)),  # fire doors
        *(Door(x, y, 1.3, False) for y in (3.5, 20.5) for x in (9.0, 18.0, 27.0)),
    ),
    width=36.0,
    depth=24.0,
    no_room="wall_0",
    wall_tile_m=6.4,
    floor_tile_m=6.0,
)
_OFFICE_STYLE = FittingStyle(("shelf", "shelf", "desk", "cabinet", "sofa", "gap", "gap"))
_OFFICE_CORRIDOR = FittingStyle(("gap", "cabinet", "shelf"), (0.7, 0.15, 0.15), cabinet_depth=0.3)
_OFFICE_START = (6.2, 3.5)
# The four rounds of a tour: once round the building, through all rooms of its north and south, no
# place seen twice before the start is; back through the west corridor the other way, and through
# the middle of the core; two rooms that were seen, two that are new, the north corridor the other
# way; and the first round the other way.
_OFFICE_ROUNDS = (
    ((31.5, 3.5), (31.5, 8.2), (34.8, 8.2), (34.8, 15.8), (31.5, 15.8), (31.5, 20.5), (4.5, 20.5),
     (4.5, 15.8), (1.2, 15.8), (1.2, 8.2), (4.5, 8.2), (4.5, 3.5)),
    ((13.5, 3.5), (13.5, 8.2), (1.2, 8.2), (1.2, 15.8), (18.0, 15.8), (18.0, 8.2), (4.5, 8.2),
     (4.5, 3.5)),
    ((22.5, 3.5), (22.5, 8.2), (28.4, 8.2), (28.4, 15.8), (7.6, 15.8), (7.6, 8.2), (4.5, 8.2),
     (4.5, 3.5)),
    ((22.5, 3.5), (22.5, 8.2), (1.2, 8.2), (1.2, 15.8), (4.5, 15.8), (4.5, 20.5), (31.5, 20.5),
     (31.5, 15.8), (34.8, 15.8), (34.8, 8.2), (31.5, 8.2), (31.5, 3.5), (13.5, 3.5), (13.5, 8.2),
     (4.5, 8.2), (4.5, 3.5)),
)  # fmt: skip


def office_tour(rounds: int) -> FloatArray:
    """(n, 2) corners of the drive's first rounds of four, each back to the start and its heading.

    After the fourth the first comes again.
    """
    corners = [_OFFICE_START]
    for k in range(rounds):
        corners += [*_OFFICE_ROUNDS[k % len(_OFFICE_ROUNDS)], _OFFICE_START]
    return np.array(corners)


def build_office(rng: np.random.Generator, visit: int = 1) -> Place:
    """The office building; a second visit finds chairs and cartons elsewhere."""
    plan = OFFICE
    lamps = _ceiling_lamps(plan, 2.0)
    things = [*build_shell(plan), *_lamp_things(lamps)]
    pictures = [f"picture_{i}" for i in rng.permutation(PICTURES)]
    for room in plan.rooms:
        style = _OFFICE_CORRIDOR if room.name.startswith("corridor") else _OFFICE_STYLE
        things += fit_room(room, plan.doors, rng, style, pictures)
    for room in plan.rooms:
        if not room.name.startswith("corridor"):
            things += _office_islands(room, rng) + _office_chairs(room, rng, moved=visit != 1)
    return Place(tuple(things), lamps, np.zeros(2), np.array([plan.width, plan.depth]))


def _office_islands(room: Room, rng: np.random.Generator) -> list[Thing]:
    """One piece in each quarter of the room; the ways between its doors stay free."""
    (cx, cy), across = room.centre, (0.0,) if room.name.startswith("core") else (-1.85, 1.85)
    out = []
    for k, (x, y) in enumerate((x, y) for x in (-2.7, 2.7) for y in across):
        kind = str(rng.choice(["desk", "shelf", "cartons", "cabinet"]))
        if kind == "desk":
            patches = desk(rng, 1.6, 1)
        elif kind == "shelf":
            patches = shelf(rng, 1.5, 1.1, 0.35)
            patches += placed(shelf(rng, 1.5, 1.1, 0.35), 0.0, 0.0, 0.0, 180.0)
        elif kind == "cartons":
            patches = carton(rng, (0.7, 0.6, 0.5))
            patches += placed(carton(rng, (0.5, 0.4, 0.4)), 0.05, 0.0, 0.5, 15.0)
        else:
            patches = cabinet(1.0, 1.2, 0.5, Surface("metal", 0.9))
        yaw = float(rng.choice([0.0, 90.0, 180.0])) + float(rng.uniform(-12.0, 12.0))
        there = placed(patches, cx + x, cy + y, 0.0, yaw)
        out.append(Thing(f"{room.name}_{kind}_{k}", tuple(there)))
    return out


def _office_chairs(room: Room, rng: np.random.Generator, moved: bool) -> list[Thing]:
    """Two chairs and a carton, on the side of the room that has no door to a corridor."""
    cx, cy = room.centre
    side = 1.0 if room.name.startswith("north") else -1.0
    across = 1.0 if room.name.startswith("core") else 2.0
    packed = carton(rng, (0.5, 0.4, 0.4))
    out = []
    for name, patches, first, second in (
        ("chair_1", chair(), (-1.15, across), (1.1, 0.85 * across)),
        ("chair_2", chair(), (3.7, 0.4 * across), (-3.8, 0.5 * across)),
        ("carton", packed, (1.2, 1.1 * across), (-1.2, 1.1 * across)),
    ):
        turns = rng.uniform(-180.0, 180.0, 2)
        x, y = second if moved else first
        there = placed(patches, cx + x, cy + side * y, 0.0, float(turns[int(moved)]))
        out.append(Thing(f"{room.name}_{name}", tuple(there)))
    return out


# --------------------------------------------------------------------------------------------
# Corridors that look alike: a square ring whose sixteen sections are copies of one
#
# Each leg of the ring is the one before turned by a quarter; each leg is made of sections with the
# same doors, posters, cabinets and covers, and the covers repeat with the sections. Images show how
# far it is to the next corner, and never which leg it is: perceptual aliasing.

_SECTION, _SECTIONS = 6.0, 4
_RING = _SECTION * _SECTIONS
_HALF_WIDTH = 1.2
_RING_START = (_SECTION, 0.0)


def ring_tour(rounds: int) -> FloatArray:
    """(n, 2) corners of the drive round the ring and back to its start."""
    ring = [(_RING, 0.0), (_RING, _RING), (0.0, _RING), (0.0, 0.0)]
    return np.array([_RING_START, *[*ring, _RING_START] * rounds])


def ring_one_way() -> FloatArray:
    """(n, 2) corners of a drive that ends a leg before its start and sees nothing twice."""
    ring = [(_RING, 0.0), (_RING, _RING), (0.0, _RING), (0.0, 1.25 * _SECTION)]
    return np.array([_RING_START, *ring])


def build_corridors(rng: np.random.Generator) -> Place:
    """The ring of corridors. Its inner square is empty."""
    at = (np.arange(2 * _SECTIONS) + 0.5) * _SECTION / 2.0
    lamps = np.array([_lamp(x, 0.0, 1.0, 0.4, HEIGHT) for x in at])
    leg = _ring_leg(rng, lamps)
    things: list[Thing] = []
    all_lamps: list[list[FloatArray]] = []
    for quarter in range(4):
        for thing in leg:
            patches = _turned_leg(list(thing.patches), quarter)
            things.append(Thing(f"leg_{quarter + 1}_{thing.name}", tuple(patches)))
        flat = [Patch(corner, u, v, Surface("lamp")) for corner, u, v in lamps]
        turned = _turned_leg(flat, quarter)
        all_lamps += [[p.corner, p.edge_u, p.edge_v] for p in turned]
    edge = np.full(2, _HALF_WIDTH)
    return Place(tuple(things), np.array(all_lamps), -edge, _RING + edge)


def _turned_leg(patches: list[Patch], quarter: int) -> list[Patch]:
    """From the first leg, along x from (0, 0), to another one: turned about the ring's middle."""
    half = _RING / 2
    centred = placed(patches, -half, -half, 0.0, 0.0)
    return placed(placed(centred, 0.0, 0.0, 0.0, 90.0 * quarter), half, half, 0.0, 0.0)


def _ring_leg(rng: np.random.Generator, lamps: FloatArray) -> list[Thing]:
    """Shell and fittings of the leg along x: its inner wall is to the north."""
    w, h, tile = _HALF_WIDTH, HEIGHT, _SECTION / 2.0
    wall = Surface("wall_0", tile)
    floor = rectangle((-w, w, 0), (_RING, 0, 0), (0, -2 * w, 0), Surface("floor_1", tile))
    ceiling = rectangle((-w, -w, h), (_RING, 0, 0), (0, 2 * w, 0), Surface("ceiling", tile))
    inner = rectangle((w, w, h), (_RING - 2 * w, 0, 0), (0, 0, -h), wall)
    outer = rectangle((_RING + w, -w, h), (-_RING - 2 * w, 0, 0), (0, 0, -h), wall)
    out = [Thing("floor", (floor,)), Thing("ceiling", (ceiling,))]
    out += [Thing("inner_wall", (inner,)), Thing("outer_wall", (outer,)), *_lamp_things(lamps)]
    board = placed(hanging(1.5, 1.1, Surface("picture_1")), -0.1, 0.005 - w, 1.1, 180.0)
    out.append(Thing("corner_board", tuple(board)))
    door = hanging(0.95, DOOR_HEIGHT - 0.05, Surface("door"))
    for low, high, bottom in ((-0.55, -0.475, 0.0), (0.475, 0.55, 0.0), (-0.55, 0.55, 2.05)):
        door += box((low, -0.05, bottom), (high, 0.0, DOOR_HEIGHT), _DARK_WOOD)
    north, south = (w - 0.005, 0.0), (-w + 0.005, 180.0)
    section = (  # name, patches, wall, x from the section's middle, z
        ("door", door, north, -1.1, 0.0),
        ("poster_1", hanging(0.9, 0.9, Surface("picture_0")), north, 0.0, 1.15),
        ("poster_2", hanging(0.8, 1.0, Surface("picture_4")), north, 1.3, 1.1),
        ("poster_3", hanging(1.0, 0.8, Surface("picture_2")), south, -1.5, 1.2),
        ("door", door, south, 0.3, 0.0),
        ("shelf", shelf(rng, 1.1, 1.7, 0.3), south, 1.75, 0.0),
        ("cabinet", cabinet(0.7, 0.95, 0.3, Surface("metal", 0.9)), north, 0.4, 0.0),
    )
    for k in range(_SECTIONS):
        for name, patches, (y, yaw), x, z in section:
            there = placed(placed(patches, x, y, z, yaw), (k + 0.5) * _SECTION, 0.0, 0.0, 0.0)
            out.append(Thing(f"section_{k + 1}_{name}", tuple(there)))
    return out


# --------------------------------------------------------------------------------------------
# The furnished house of 20 m x 15 m
#
# Some pictures hang in several rooms, so that places can be mistaken for one another.

HOUSE = FloorPlan(
    rooms=(
        Room("hall", 0.0, 0.0, 11.0, 7.5, "wall_cream", "parquet"),
        Room("office", 11.0, 0.0, 20.0, 7.5, "wall_blue", "carpet"),
        Room("corridor", 0.0, 7.5, 20.0, 9.9, "wall_white", "carpet"),
        Room("library", 0.0, 9.9, 7.0, 15.0, "wall_green", "parquet"),
        Room("workshop", 7.0, 9.9, 13.5, 15.0, "bricks", "carpet"),
        Room("studio", 13.5, 9.9, 20.0, 15.0, "wall_rose", "parquet"),
    ),
    lines=(
        WallLine(True, 7.5, 0.0, 20.0),
        WallLine(True, 9.9, 0.0, 20.0),
        WallLine(False, 11.0, 0.0, 7.5),
        WallLine(False, 7.0, 9.9, 15.0),
        WallLine(False, 13.5, 9.9, 15.0),
    ),
    # A wheelchair passes with room to turn in; the opening between hall and office is wider.
    doors=(
        *(Door(x, 7.5, 1.6, True) for x in (2.5, 8.5, 16.5)),
        Door(11.0, 3.75, 1.5 * 1.6, False),
        *(Door(x, 9.9, 1.6, True) for x in (3.5, 10.25, 17.0)),
        *(Door(x, 12.5, 1.6, False) for x in (7.0, 13.5)),
    ),
    width=20.0,
    depth=15.0,
    # No whole number of legs: with tiles of 4 m a leg of 4 m shows the same floor at the same
    # place, and homing vectors follow the pattern instead of the room.
    floor_tile_m=5.3,
)
_HOUSE_STYLE = FittingStyle(
    ("shelf", "shelf", "desk", "cabinet", "sofa", "gap", "gap"),
    cloths=("cloth", "cloth_red", "cloth_green"),
)
_HOUSE_CORRIDOR = FittingStyle(("gap", "cabinet"), (0.8, 0.2), cabinet_depth=0.3)


def build_house(rng: np.random.Generator) -> Place:
    """The house."""
    lamps = _ceiling_lamps(HOUSE, 3.2)
    things = [*build_shell(HOUSE), *_lamp_things(lamps)]
    pictures = [f"photo_{name}" for name in PHOTOGRAPHS]
    pictures += [f"poster_{i}" for i in range(1, POSTERS)]
    pictures += [f"painting_{i}" for i in range(1, PAINTINGS)]
    for room in HOUSE.rooms:
        style = _HOUSE_CORRIDOR if room.name == "corridor" else _HOUSE_STYLE
        # The last two hang in every room: the same picture does not mean the same place.
        shuffled = [str(name) for name in rng.permutation(np.array(pictures))]
        hung = [*shuffled, "painting_0", "poster_0"]
        things += fit_room(room, HOUSE.doors, rng, style, hung)
    brick, wood = Surface("bricks", 1.6), Surface("wood_light", 1.6)
    pillar = box((-0.175, -0.175, 0.0), (0.175, 0.175, HEIGHT), brick)
    extinguisher = prism((0, -0.1, 0.5), (0, -0.1, 1.0), 0.08, Surface("cloth_red", 2.0))
    # What stands free, low enough to see over but for the pillars.
    for name, patches, x, y, yaw in (
        ("pillar_1", pillar, 5.2, 5.6, 0.0),
        ("pillar_2", pillar, 5.2, 1.9, 0.0),
        ("dining_table", _dining_table(rng, 1.6), 3.0, 3.7, 15.0),
        ("rug_hall", _rug(2.4, 2.0, "painting_5"), 7.9, 3.6, 30.0),
        ("plant_1", _plant(rng), 6.9, 1.7, 0.0),
        ("island_desk", desk(rng, 2.0, 2), 15.9, 3.2, 90.0),
        ("rug_office", _rug(2.0, 1.6, "painting_9"), 13.2, 5.2, -20.0),
        ("plant_2", _plant(rng), 18.6, 5.9, 0.0),
        ("pillar_3", box((-0.15, -0.15, 0.0), (0.15, 0.15, HEIGHT), wood), 13.0, 2.2, 0.0),
        ("island_shelf", shelf(rng, 1.6, 1.1, 0.35), 2.9, 13.1, 180.0),
        ("workbench", table(1.6, 0.8, 0.85, Surface("metal", 0.8)), 9.2, 13.6, 0.0),
        ("cartons", carton(rng, (0.6, 0.5, 0.5)), 12.3, 11.1, 25.0),
        ("bed", _bed("cloth_red"), 17.9, 13.4, -90.0),
        ("rug_studio", _rug(1.8, 1.4, "painting_12"), 15.6, 11.6, 10.0),
        ("chair_office", chair(), 14.7, 3.0, 75.0),
        ("chair_studio", chair(), 15.0, 13.9, 200.0),
        ("extinguisher", extinguisher, 13.4, 7.5 + 2.4 - HALF_WALL, 0.0),
    ):
        things.append(Thing(name, tuple(placed(patches, x, y, 0.0, yaw))))
    size = np.array([HOUSE.width, HOUSE.depth])
    return Place(tuple(things), lamps, np.zeros(2), size, 0.2, None)
