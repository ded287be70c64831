"""Furniture along the walls of a room: every free stretch of wall is filled from a seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.worlds.buildings import furniture
from fgslam.worlds.buildings.floor_plan import HALF_WALL, Opening, Room
from fgslam.worlds.rendering.patches import Patch, Surface, Thing, placed

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
            return furniture.shelf(rng, width, height, 0.32), height
        if kind == "desk":
            desk = furniture.desk(rng, width, 1 + int(width > 1.9))
            return placed(desk, 0, -0.4, 0, 0), 1.25
        if kind == "cabinet":
            height = float(rng.uniform(0.8, 1.3))
            cover = Surface(str(rng.choice(["metal", "metal_dark", "wood_dark", "door"])), 0.9)
            return furniture.cabinet(width, height, self._style.cabinet_depth, cover), height
        if kind == "sofa":
            return furniture.sofa(width, str(rng.choice(self._style.cloths))), 0.85
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
