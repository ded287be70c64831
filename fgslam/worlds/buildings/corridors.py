"""Corridors that look alike: a square ring whose sixteen sections are copies of one.

Each leg of the ring is the one before turned by a quarter; each leg is made of sections with the
same doors, posters, cabinets and covers, and the covers repeat with the sections. Images
show how far it is to the next corner, and never which leg it is: perceptual aliasing.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.worlds.buildings import furniture
from fgslam.worlds.buildings.floor_plan import DOOR_HEIGHT, HEIGHT, lamp_things
from fgslam.worlds.patches import Patch, Surface, Thing, box, placed, rectangle

SECTION, SECTIONS = 6.0, 4
SIDE = SECTION * SECTIONS
HALF_WIDTH = 1.2
_TILE = SECTION / 2.0
_WALL = Surface("wall_0", _TILE)

_START = (SECTION, 0.0)


def tour(rounds: int) -> FloatArray:
    """(n, 2) corners of the drive round the ring and back to its start."""
    ring = [(SIDE, 0.0), (SIDE, SIDE), (0.0, SIDE), (0.0, 0.0)]
    corners = [_START]
    for _ in range(rounds):
        corners += [*ring, _START]
    return np.array(corners)


def one_way() -> FloatArray:
    """(n, 2) corners of a drive that ends a leg before its start and sees nothing twice."""
    return np.array([_START, (SIDE, 0.0), (SIDE, SIDE), (0.0, SIDE), (0.0, 1.25 * SECTION)])


def build_alike(rng: np.random.Generator) -> tuple[tuple[Thing, ...], FloatArray]:
    """Everything in the ring, and its lamps (k, 3, 3). The ring's inner square is empty."""
    leg = _leg(rng)
    lamps = _lamps()
    things: list[Thing] = []
    all_lamps = []
    for quarter in range(4):
        for thing in leg:
            patches = _turned(list(thing.patches), quarter)
            things.append(Thing(f"leg_{quarter + 1}_{thing.name}", tuple(patches)))
        turned = _turned([Patch(corner, u, v, Surface("lamp")) for corner, u, v in lamps], quarter)
        all_lamps += [[p.corner, p.edge_u, p.edge_v] for p in turned]
    return tuple(things), np.array(all_lamps)


def _turned(patches: list[Patch], quarter: int) -> list[Patch]:
    """From the first leg, along x from (0, 0), to another one: turned about the ring's middle."""
    centred = placed(patches, -SIDE / 2, -SIDE / 2, 0.0, 0.0)
    return placed(placed(centred, 0.0, 0.0, 0.0, 90.0 * quarter), SIDE / 2, SIDE / 2, 0.0, 0.0)


def _lamps() -> FloatArray:
    """(k, 3, 3) one in the middle of each half section of the leg along x."""
    at = (np.arange(2 * SECTIONS) + 0.5) * SECTION / 2.0
    return np.array([[[x - 0.5, -0.2, HEIGHT - 0.02], [1.0, 0, 0], [0, 0.4, 0]] for x in at])


def _leg(rng: np.random.Generator) -> list[Thing]:
    """Shell and fittings of the leg along x: its inner wall is to the north."""
    w, h = HALF_WIDTH, HEIGHT
    floor = rectangle((-w, w, 0), (SIDE, 0, 0), (0, -2 * w, 0), Surface("floor_1", _TILE))
    ceiling = rectangle((-w, -w, h), (SIDE, 0, 0), (0, 2 * w, 0), Surface("ceiling", _TILE))
    inner = rectangle((w, w, h), (SIDE - 2 * w, 0, 0), (0, 0, -h), _WALL)
    outer = rectangle((SIDE + w, -w, h), (-SIDE - 2 * w, 0, 0), (0, 0, -h), _WALL)
    out = [Thing("floor", (floor,)), Thing("ceiling", (ceiling,))]
    out += [Thing("inner_wall", (inner,)), Thing("outer_wall", (outer,))]
    out += lamp_things(_lamps())
    board = placed(furniture.hanging(1.5, 1.1, Surface("picture_1")), -0.1, 0.005 - w, 1.1, 180.0)
    out.append(Thing("corner_board", tuple(board)))
    section = _section(rng)
    for k in range(SECTIONS):
        for name, patches in section:
            there = placed(patches, (k + 0.5) * SECTION, 0.0, 0.0, 0.0)
            out.append(Thing(f"section_{k + 1}_{name}", tuple(there)))
    return out


def _section(rng: np.random.Generator) -> list[tuple[str, list[Patch]]]:
    """What hangs on and stands along the walls of one section, about its middle."""
    out: list[tuple[str, list[Patch]]] = []

    def north(name: str, patches: list[Patch], x: float, z: float = 0.0) -> None:
        out.append((name, placed(patches, x, HALF_WIDTH - 0.005, z, 0.0)))

    def south(name: str, patches: list[Patch], x: float, z: float = 0.0) -> None:
        out.append((name, placed(patches, x, -HALF_WIDTH + 0.005, z, 180.0)))

    metal = Surface("metal", 0.9)
    north("door", _door(), -1.1)
    north("poster_1", furniture.hanging(0.9, 0.9, Surface("picture_0")), 0.0, 1.15)
    north("poster_2", furniture.hanging(0.8, 1.0, Surface("picture_4")), 1.3, 1.1)
    south("poster_3", furniture.hanging(1.0, 0.8, Surface("picture_2")), -1.5, 1.2)
    south("door", _door(), 0.3)
    south("shelf", furniture.shelf(rng, 1.1, 1.7, 0.3), 1.75)
    north("cabinet", furniture.cabinet(0.7, 0.95, 0.3, metal), 0.4)
    return out


def _door() -> list[Patch]:
    """A closed door with its frame."""
    wood = Surface("wood_dark", 0.8)
    out = furniture.hanging(0.95, DOOR_HEIGHT - 0.05, Surface("door"))
    for low, high, bottom in ((-0.55, -0.475, 0.0), (0.475, 0.55, 0.0), (-0.55, 0.55, 2.05)):
        out += box((low, -0.05, bottom), (high, 0.0, DOOR_HEIGHT), wood)
    return out
