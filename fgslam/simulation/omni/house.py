"""The furnished house: what stands along its walls, hangs on them and stands free, and its lamps.

Furniture and pictures are laid out from a seed: every free stretch of wall is filled in turn. Some
pictures hang in several rooms, so that places can be mistaken for one another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.simulation import furniture
from fgslam.simulation.omni import home_furniture as home
from fgslam.simulation.omni.colour_textures import PAINTINGS
from fgslam.simulation.omni.floor_plan import (
    HALF_WALL,
    HEIGHT,
    ROOMS,
    Opening,
    Room,
    openings,
    shell,
)
from fgslam.simulation.patches import Patch, Surface, Thing, placed, rectangle
from fgslam.simulation.texture_library import PHOTOGRAPHS, POSTERS
from fgslam.types import FloatArray

# Turned by this much (degrees), a piece whose front is -y faces the room from that wall.
_WALLS = {"north": 0.0, "east": -90.0, "south": 180.0, "west": 90.0}
# Kept free of furniture beside an opening and in corners, metres.
_DOOR_MARGIN, _CORNER_MARGIN = 0.55, 0.25
_LAMP_SPACING = 3.2
# Hung in every room: the same picture does not mean the same place.
_COMMON_PICTURES = ("painting_0", "poster_0")


@dataclass(frozen=True, slots=True, eq=False)
class House:
    """Everything that does not move.

    Attributes:
        things: with their patches.
        lamps: (k, 3, 3) corner and two edges of the lamps in the ceilings, metres.
        doors: openings between rooms.
    """

    things: tuple[Thing, ...]
    lamps: FloatArray
    doors: tuple[Opening, ...]


def build_house(rng: np.random.Generator, door_width: float) -> House:
    """The house with all its furniture.

    Args:
        rng: for layout and small things.
        door_width: of the openings, metres.
    """
    doors = openings(door_width)
    lamps = _lamps()
    things = [*shell(doors), *_lamp_things(lamps)]
    for room in ROOMS:
        things += _RoomFitter(room, doors, rng).things()
    return House((*things, *_islands(rng)), lamps, doors)


def _lamps() -> FloatArray:
    out = []
    for room in ROOMS:
        w, d = room.east - room.west, room.north - room.south
        columns, rows = max(round(w / _LAMP_SPACING), 1), max(round(d / _LAMP_SPACING), 1)
        for i in range(columns):
            for j in range(rows):
                x = room.west + (i + 0.5) * w / columns
                y = room.south + (j + 0.5) * d / rows
                out.append([[x - 0.5, y - 0.2, HEIGHT - 0.02], [1.0, 0, 0], [0, 0.4, 0]])
    return np.array(out)


def _lamp_things(lamps: FloatArray) -> list[Thing]:
    glow = Surface("lamp", None, glow=1.0)
    return [
        Thing(f"lamp_{k}", (rectangle(corner - [0, 0, 0.003], u, v, glow),))
        for k, (corner, u, v) in enumerate(lamps)
    ]


class _RoomFitter:
    """Fills the walls of one room."""

    def __init__(self, room: Room, doors: tuple[Opening, ...], rng: np.random.Generator) -> None:
        self._room, self._doors, self._rng = room, doors, rng
        self._out: list[Thing] = []
        photos = [f"photo_{name}" for name in PHOTOGRAPHS]
        prints = [f"poster_{i}" for i in range(1, POSTERS)]
        paintings = [f"painting_{i}" for i in range(1, PAINTINGS)]
        shuffled = rng.permutation(np.array([*photos, *prints, *paintings]))
        # Taken from the end: the common ones first.
        self._pictures = [*(str(name) for name in shuffled), *_COMMON_PICTURES]

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
        rng, narrow = self._rng, self._room.name == "corridor"
        kind = str(rng.choice(["gap", "cabinet"], p=[0.8, 0.2]) if narrow else rng.choice(_KINDS))
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
            return furniture.shelf(rng, width, height, 0.32), height
        if kind == "desk":
            desk = furniture.desk(rng, width, 1 + int(width > 1.9))
            return placed(desk, 0, -0.4, 0, 0), 1.25
        if kind == "cabinet":
            height = float(rng.uniform(0.8, 1.3))
            cover = Surface(str(rng.choice(["metal", "metal_dark", "wood_dark", "door"])), 0.9)
            depth = 0.3 if self._room.name == "corridor" else 0.45
            return furniture.cabinet(width, height, depth, cover), height
        if kind == "sofa":
            return home.sofa(width, str(rng.choice(["cloth", "cloth_red", "cloth_green"]))), 0.85
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
        self._add("picture", furniture.hanging(wide, side, Surface(texture)), wall, along, bottom)

    def _add(
        self, kind: str, patches: list[Patch], wall: str, along: float, bottom: float = 0.0
    ) -> None:
        room = self._room
        across = "east" if wall in ("north", "south") else "north"
        off = room.length(across) / 2 - HALF_WALL - 0.005
        there = placed(patches, along, off, bottom, 0.0)
        there = placed(there, *room.centre, 0.0, _WALLS[wall])
        self._out.append(Thing(f"{room.name}_{kind}_{len(self._out)}", tuple(there)))


_KINDS = ("shelf", "shelf", "desk", "cabinet", "sofa", "gap", "gap")
_WIDTHS = {
    "shelf": (0.9, 1.5),
    "desk": (1.5, 2.3),
    "cabinet": (0.6, 1.1),
    "sofa": (1.5, 2.2),
    "gap": (0.6, 1.4),
}


def _islands(rng: np.random.Generator) -> list[Thing]:
    """What stands free, low enough to see over but for the pillars."""
    pieces: list[tuple[str, list[Patch], float, float, float]] = [
        ("pillar_1", home.pillar(0.35, HEIGHT, "bricks"), 5.2, 5.6, 0.0),
        ("pillar_2", home.pillar(0.35, HEIGHT, "bricks"), 5.2, 1.9, 0.0),
        ("dining_table", home.dining_table(rng, 1.6), 3.0, 3.7, 15.0),
        ("rug_hall", home.rug(2.4, 2.0, "painting_5"), 7.9, 3.6, 30.0),
        ("plant_1", home.plant(rng), 6.9, 1.7, 0.0),
        ("island_desk", furniture.desk(rng, 2.0, 2), 15.9, 3.2, 90.0),
        ("rug_office", home.rug(2.0, 1.6, "painting_9"), 13.2, 5.2, -20.0),
        ("plant_2", home.plant(rng), 18.6, 5.9, 0.0),
        ("pillar_3", home.pillar(0.3, HEIGHT, "wood_light"), 13.0, 2.2, 0.0),
        ("island_shelf", furniture.shelf(rng, 1.6, 1.1, 0.35), 2.9, 13.1, 180.0),
        ("workbench", furniture.table(1.6, 0.8, 0.85, Surface("metal", 0.8)), 9.2, 13.6, 0.0),
        ("cartons", furniture.carton(rng, (0.6, 0.5, 0.5)), 12.3, 11.1, 25.0),
        ("bed", home.bed("cloth_red"), 17.9, 13.4, -90.0),
        ("rug_studio", home.rug(1.8, 1.4, "painting_12"), 15.6, 11.6, 10.0),
        ("chair_office", furniture.chair(), 14.7, 3.0, 75.0),
        ("chair_studio", furniture.chair(), 15.0, 13.9, 200.0),
        ("extinguisher", home.extinguisher(), 13.4, 7.5 + 2.4 - HALF_WALL, 0.0),
    ]
    return [Thing(name, tuple(placed(p, x, y, 0.0, yaw))) for name, p, x, y, yaw in pieces]
