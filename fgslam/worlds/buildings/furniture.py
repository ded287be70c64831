"""Furniture, and the walls of rooms filled with it.

Each piece stands on z = 0 with its front towards -y and its middle at x = 0. A fitter fills every
free stretch of wall from a seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.worlds.buildings.floor_plan import HALF_WALL, Opening, Room
from fgslam.worlds.patches import Patch, Surface, Thing, box, placed, prism, rectangle
from fgslam.worlds.textures import BINDER_ROWS, BOOK_ROWS, CARTONS, SCREENS

_METAL = Surface("metal_dark", 0.8)
_BLACK = Surface("plain_dark", 0.6)
_POT = Surface("bricks", 0.8)


def _pick(rng: np.random.Generator, family: str, count: int) -> str:
    return f"{family}_{int(rng.integers(0, count))}"


def table(width: float, depth: float, height: float, top: Surface) -> list[Patch]:
    """A table top on four legs."""
    w, d = width / 2, depth / 2
    out = box((-w, -d, height - 0.035), (w, d, height), top)
    for x in (-w + 0.05, w - 0.05):
        for y in (-d + 0.05, d - 0.05):
            out += prism((x, y, 0.0), (x, y, height - 0.035), 0.025, _METAL, sides=6)
    return out


def computer(rng: np.random.Generator) -> list[Patch]:
    """A monitor on its foot, with a keyboard before it and a mug beside it."""
    picture = Surface(_pick(rng, "screen", SCREENS), None, glow=0.95)
    out = box((-0.24, -0.02, 0.12), (0.24, 0.04, 0.46), _BLACK, front=picture)
    out += box((-0.03, 0.0, 0.0), (0.03, 0.03, 0.12), _BLACK)
    out += box((-0.13, -0.08, 0.0), (0.13, 0.10, 0.015), _BLACK)
    out += box((-0.22, -0.33, 0.0), (0.22, -0.18, 0.02), _BLACK, top=Surface("keyboard"))
    mug = Surface(_pick(rng, "carton", CARTONS), 0.2)
    return out + prism((0.33, -0.2, 0.0), (0.33, -0.2, 0.1), 0.04, mug, sides=8)


def desk(rng: np.random.Generator, width: float, screens: int) -> list[Patch]:
    """A table with computers, books, papers and a drawer unit below."""
    top = Surface(str(rng.choice(["wood_light", "wood_desk", "wood_dark"])), 0.9)
    out = table(width, 0.75, 0.74, top)
    for k in range(screens):
        x = (k + 0.5) / screens * width - width / 2
        out += placed(computer(rng), x, 0.12, 0.74, float(rng.uniform(-12, 12)))
    for _ in range(2):
        x, y = rng.uniform(-width / 2 + 0.2, width / 2 - 0.2), rng.uniform(-0.25, -0.1)
        paper = Surface(f"poster_{int(rng.integers(0, 8))}")
        sheet = rectangle((-0.1, 0.14, 0.002), (0.2, 0, 0), (0, -0.28, 0), paper)
        out += placed([sheet], float(x), float(y), 0.74, float(rng.uniform(-40, 40)))
    books = Surface(_pick(rng, "books", BOOK_ROWS))
    row = box((-0.3, -0.09, 0.0), (0.3, 0.09, 0.25), Surface("wood_dark", 0.8), front=books)
    out += placed(row, width / 2 - 0.34, 0.26, 0.74, float(rng.uniform(-10, 10)))
    drawers = box((-0.2, -0.3, 0.0), (0.2, 0.3, 0.6), _METAL, front=Surface("metal"))
    return out + placed(drawers, width / 2 - 0.32, 0.0, 0.0, 0.0)


def carton(rng: np.random.Generator, size: tuple[float, float, float]) -> list[Patch]:
    """A cardboard box."""
    w, d, h = size
    sides = [Surface(_pick(rng, "carton", CARTONS)) for _ in range(3)]
    return box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), sides[0], front=sides[1], top=sides[2])


def shelf(rng: np.random.Generator, width: float, height: float, depth: float) -> list[Patch]:
    """An open shelf with rows of books and some boxes; its back is closed."""
    frame = Surface(str(rng.choice(["wood_light", "wood_dark"])), 0.8)
    w = width / 2
    out = box((-w, -depth, 0), (-w + 0.03, 0, height), frame)
    out += box((w - 0.03, -depth, 0), (w, 0, height), frame)
    out += box((-w, -0.02, 0), (w, 0, height), Surface("wood_dark", 0.8))
    levels = max(int(height / 0.42), 1)
    for level in range(levels + 1):
        z = level * (height - 0.03) / levels
        out += box((-w + 0.03, -depth, z), (w - 0.03, -0.02, z + 0.03), frame)
        if level < levels:
            room = (height - 0.03) / levels - 0.03
            out += placed(_shelf_load(rng, width - 0.08, room, depth), 0, 0, z + 0.03, 0)
    return out


def _shelf_load(rng: np.random.Generator, width: float, room: float, depth: float) -> list[Patch]:
    if rng.random() < 0.25:
        out = []
        for k in range(2):
            w, h = rng.uniform(0.3, 0.45) * width, rng.uniform(0.5, 0.95) * room
            x = (k - 0.5) * width / 2 + float(rng.uniform(-0.02, 0.02))
            size = (float(w), 0.7 * depth, float(h))
            out += placed(carton(rng, size), x, -depth / 2, 0, float(rng.uniform(-8, 8)))
        return out
    books = rng.random() < 0.5
    row = Surface(_pick(rng, "books", BOOK_ROWS) if books else _pick(rng, "binders", BINDER_ROWS))
    front = -depth + float(rng.uniform(0.02, 0.09))
    w = width / 2
    return [rectangle((-w, front, room * 0.96), (width, 0, 0), (0, 0, -room * 0.96), row)]


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


def sofa(width: float, cover: str) -> list[Patch]:
    """Seat, back and two arms."""
    cloth, w = Surface(cover, 0.6), width / 2
    out = box((-w, -0.85, 0.05), (w, 0.0, 0.42), cloth)
    out += box((-w, -0.22, 0.42), (w, 0.0, 0.85), cloth)
    for side in (-w, w - 0.18):
        out += box((side, -0.85, 0.42), (side + 0.18, -0.22, 0.6), cloth)
    return out


def hanging(width: float, height: float, surface: Surface) -> list[Patch]:
    """A flat board, its lower edge at z = 0, just before y = 0: posters, windows, doors."""
    return [rectangle((-width / 2, -0.004, height), (width, 0, 0), (0, 0, -height), surface)]


# --------------------------------------------------------------------------------------------
# Of a home


def bed(cover: str) -> list[Patch]:
    """A bed, its head against the wall, with a pillow and a bedspread."""
    wood = Surface("wood_dark", 0.8)
    out = box((-0.8, -2.0, 0.08), (0.8, 0.0, 0.5), wood, top=Surface(cover, 0.8))
    out += box((-0.85, -0.06, 0.0), (0.85, 0.0, 1.0), wood)
    pillow = box((-0.6, -0.5, 0.0), (0.6, -0.1, 0.14), Surface("plain_light", 0.5))
    return out + placed(pillow, 0, 0, 0.5, 0)


def plant(rng: np.random.Generator) -> list[Patch]:
    """A pot with upright leaves, each seen from both sides."""
    out = prism((0, 0, 0), (0, 0, 0.35), 0.17, _POT)
    for _ in range(9):
        yaw, lean, tall = rng.uniform(0, 360), rng.uniform(0.05, 0.35), rng.uniform(0.5, 1.0)
        green = Surface("cloth_green", float(rng.uniform(0.3, 0.9)))
        leaf = rectangle((-0.08, -lean, 0.3 + tall), (0.16, 0, 0), (0, lean, -tall), green)
        out += placed([leaf], 0.0, 0.0, 0.0, float(yaw))
    return out


def pillar(side: float, height: float, cover: str) -> list[Patch]:
    """A square column from floor to ceiling."""
    half = side / 2
    return box((-half, -half, 0.0), (half, half, height), Surface(cover, 1.6))


def dining_table(rng: np.random.Generator, width: float) -> list[Patch]:
    """A table with four chairs, a bowl and a carton on it."""
    out = table(width, 0.9, 0.74, Surface("wood_light", 0.9))
    for x, y, yaw in ((-0.4, -0.6, 180), (0.4, -0.65, 170), (-0.4, 0.62, 5), (0.45, 0.6, -10)):
        turn = yaw + float(rng.uniform(-15, 15))
        out += placed(chair(), x, y, 0.0, turn)
    out += placed(prism((0, 0, 0), (0, 0, 0.1), 0.14, Surface("cloth_red", 0.4)), 0.1, 0.0, 0.74, 0)
    return out + placed(carton(rng, (0.25, 0.2, 0.25)), -0.45, 0.05, 0.74, 20)


def rug(width: float, depth: float, texture: str) -> list[Patch]:
    """A carpet lying on the floor."""
    corner = (-width / 2, depth / 2, 0.004)
    return [rectangle(corner, (width, 0, 0), (0, -depth, 0), Surface(texture))]


def extinguisher() -> list[Patch]:
    """A red cylinder on the wall."""
    return prism((0, -0.1, 0.5), (0, -0.1, 1.0), 0.08, Surface("cloth_red", 2.0))


# --------------------------------------------------------------------------------------------
# Along the walls of a room


# Turned by this much (degrees), a piece whose front is -y faces the room from that wall.
_WALLS = {"north": 0.0, "east": -90.0, "south": 180.0, "west": 90.0}
# Kept free of furniture beside an opening and in corners, metres.
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


class RoomFitter:
    """Fills the walls of one room."""

    def __init__(
        self,
        room: Room,
        doors: tuple[Opening, ...],
        rng: np.random.Generator,
        style: FittingStyle,
        pictures: Sequence[str],
    ) -> None:
        """Pictures are textures, hung once each, the last ones first."""
        self._room, self._doors, self._rng, self._style = room, doors, rng, style
        self._out: list[Thing] = []
        self._pictures = list(pictures)

    @property
    def pictures_left(self) -> tuple[str, ...]:
        """Pictures that have not been hung yet."""
        return tuple(self._pictures)

    def things(self) -> list[Thing]:
        """All pieces along the walls and all pictures on them."""
        for wall in _WALLS:
            for low, high in self._free_stretches(wall):
                self._fill(wall, low, high)
        return self._out

    def _free_stretches(self, wall: str) -> list[tuple[float, float]]:
        """Intervals along a wall, metres to the right of its middle as one faces it."""
        half = self._room.length(wall) / 2 - _CORNER_MARGIN
        cuts = sorted(
            (along - door.width / 2 - _DOOR_MARGIN, along + door.width / 2 + _DOOR_MARGIN)
            for door in self._doors
            if (along := self._along(door, wall)) is not None
        )
        edges = [-half, *(edge for cut in cuts for edge in cut), half]
        pairs = zip(edges[::2], edges[1::2], strict=True)
        return [(low, high) for low, high in pairs if high - low > 0.3]

    def _along(self, door: Opening, wall: str) -> float | None:
        """Where on that wall a door lies, or None if it does not."""
        room = self._room
        at = {"north": room.north, "south": room.south, "east": room.east, "west": room.west}[wall]
        x, y = room.centre
        if wall in ("north", "south"):
            on_it = door.along_x and door.y == at and room.west < door.x < room.east
            return (door.x - x) * (1 if wall == "north" else -1) if on_it else None
        on_it = not door.along_x and door.x == at and room.south < door.y < room.north
        return (door.y - y) * (-1 if wall == "east" else 1) if on_it else None

    def _fill(self, wall: str, low: float, high: float) -> None:
        cursor = low
        while high - cursor > 0.45:
            cursor += self._piece(wall, cursor, high - cursor) + float(self._rng.uniform(0.05, 0.3))

    def _piece(self, wall: str, start: float, free: float) -> float:
        """Puts one piece at ``start``; returns the width that it takes."""
        rng, style = self._rng, self._style
        kind = str(rng.choice(style.kinds, p=style.weights))
        width = min(float(rng.uniform(*_WIDTHS[kind])), free)
        if kind != "gap" and width < _WIDTHS[kind][0]:
            kind = "gap"
        patches, top = self._built(kind, width)
        if patches:
            self._add(kind, patches, wall, start + width / 2)
        if top < 1.6 and width > 0.5:
            self._hang(wall, start + width / 2, width, top)
        return width

    def _built(self, kind: str, width: float) -> tuple[list[Patch], float]:
        """The piece's patches and height."""
        rng = self._rng
        if kind == "shelf":
            height = float(rng.uniform(1.6, 2.2))
            return shelf(rng, width, height, 0.32), height
        if kind == "desk":
            return placed(desk(rng, width, 1 + int(width > 1.9)), 0, -0.4, 0, 0), 1.25
        if kind == "cabinet":
            height = float(rng.uniform(0.8, 1.3))
            cover = Surface(str(rng.choice(["metal", "metal_dark", "wood_dark", "door"])), 0.9)
            return cabinet(width, height, self._style.cabinet_depth, cover), height
        if kind == "sofa":
            return sofa(width, str(rng.choice(self._style.cloths))), 0.85
        return [], 0.9

    def _hang(self, wall: str, along: float, width: float, top: float) -> None:
        """A picture above a piece, or at eye level where nothing stands."""
        rng = self._rng
        bottom = max(top + 0.08, 1.0) + float(rng.uniform(0.0, 0.2))
        side = min(width * float(rng.uniform(0.75, 1.0)), 1.2, 2.5 - bottom)
        if side < 0.3 or not self._pictures:
            return
        texture = self._pictures.pop()
        wide = min(width, side * float(rng.uniform(0.8, 1.3)))
        self._add("picture", hanging(wide, side, Surface(texture)), wall, along, bottom)

    def _add(
        self, kind: str, patches: list[Patch], wall: str, along: float, bottom: float = 0.0
    ) -> None:
        room = self._room
        across = "east" if wall in ("north", "south") else "north"
        off = room.length(across) / 2 - HALF_WALL - 0.005
        there = placed(patches, along, off, bottom, 0.0)
        there = placed(there, *room.centre, 0.0, _WALLS[wall])
        self._out.append(Thing(f"{room.name}_{kind}_{len(self._out)}", tuple(there)))
