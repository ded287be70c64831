"""The lab: a room of 10 m x 10 m, where everything stands, and its lamps.

The room's frame has its origin on the floor in the middle, x east, y north, z up, in metres.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.worlds.buildings import furniture
from fgslam.worlds.buildings.floor_plan import lamp_things
from fgslam.worlds.patches import Patch, Surface, Thing, placed, rectangle
from fgslam.worlds.textures import PHOTOGRAPHS, POSTERS

HALF_SIDE = 5.0
HEIGHT = 3.0

# Turned by this much (degrees), a piece whose front is -y faces the room from that wall.
_WALLS = {"north": 0.0, "east": -90.0, "south": 180.0, "west": 90.0}


def build_lab(
    rng: np.random.Generator, visit: int, identical_posters: bool = False
) -> tuple[Thing, ...]:
    """All things of the room; the second visit finds some of them elsewhere.

    Args:
        rng: for the small things: which books, which posters, at what angles.
        visit: 1; 2: chairs, cartons and the plotter stand elsewhere; 3: posters and shelves have
            been exchanged too, and the desk in the middle turned about. All draw the same random
            numbers, so that what has not moved is the same.
        identical_posters: two posters on different walls show the same and are equally large.
    """
    things = [*_shell(), *_along_walls(rng), *_on_walls(rng), *_islands(rng)]
    if identical_posters:
        things = _with_copied_poster(things)
    if visit == 3:
        things = _rearranged(things)
    things += _loose_things(rng, moved=visit > 1)
    return tuple(things)


def lamps() -> FloatArray:
    """(k, 3, 3) corner and two edges of the lamps in the ceiling, metres."""
    out = []
    for x in (-3.75, -1.25, 1.25, 3.75):
        for y in (-3.1, 0.0, 3.1):
            out.append([[x - 0.3, y - 0.6, HEIGHT - 0.02], [0.6, 0, 0], [0, 1.2, 0]])
    return np.array(out)


def _shell() -> list[Thing]:
    """Floor, ceiling, lamps and four walls."""
    a, h = HALF_SIDE, HEIGHT
    side = 2 * a
    floor = rectangle((-a, a, 0), (side, 0, 0), (0, -side, 0), Surface("floor", 10.0))
    ceiling = rectangle((-a, -a, h), (side, 0, 0), (0, side, 0), Surface("ceiling", 4.8))
    out = [Thing("floor", (floor,)), Thing("ceiling", (ceiling,))]
    out += lamp_things(lamps())
    covers = {"north": "bricks", "east": "plaster", "south": "plaster_dark", "west": "plaster"}
    for wall, cover in covers.items():
        surface = Surface(cover, 3.2)
        patch = rectangle((-a, 0, h), (side, 0, 0), (0, 0, -h), surface)
        out.append(Thing(f"wall_{wall}", tuple(_against([patch], wall, 0.0, 0.0, 0.0))))
    return out


def _against(
    patches: list[Patch], wall: str, along: float, off: float = 0.01, z: float = 0.0
) -> list[Patch]:
    """Puts a piece against a wall, ``along`` metres to the right as one faces it."""
    at_north = placed(patches, along, HALF_SIDE - off, z, 0.0)
    return placed(at_north, 0.0, 0.0, 0.0, _WALLS[wall])


# Width of each, then its height or, of a desk, the number of screens.
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


def _along_walls(rng: np.random.Generator) -> list[Thing]:
    """Shelves, desks and cabinets with their backs to the walls."""
    out: list[Thing] = []
    for name, places in _AT_WALLS.items():
        for number, (wall, along, width, size) in enumerate(places, start=1):
            if name == "shelf":
                patches = furniture.shelf(rng, width, size, 0.32)
            elif name == "desk":
                patches = placed(furniture.desk(rng, width, int(size)), 0, -0.4, 0, 0)
            else:
                patches = furniture.cabinet(width, size, 0.5, Surface("metal", 0.9))
            out.append(Thing(f"{name}_{number}", tuple(_against(patches, wall, along))))
    return out


def _on_walls(rng: np.random.Generator) -> list[Thing]:
    """Posters, photographs, windows and the door."""
    out: list[Thing] = []
    photos = [f"photo_{name}" for name in rng.permutation(np.array(PHOTOGRAPHS))]
    prints = [f"poster_{i}" for i in range(POSTERS)]
    for wall, along, z, width, height in _POSTER_PLACES:
        texture = photos.pop() if (len(out) % 2 == 0 and photos) or not prints else prints.pop()
        board = furniture.hanging(width, height, Surface(texture))
        out.append(Thing(f"poster_{len(out) + 1}", tuple(_against(board, wall, along, 0.0, z))))
    for i, (wall, along, z, width, height) in enumerate(_PINBOARD_PLACES):
        board = furniture.hanging(width, height, Surface(f"pinboard_{i}"))
        out.append(Thing(f"pinboard_{i + 1}", tuple(_against(board, wall, along, 0.0, z))))
    window = furniture.hanging(1.6, 1.2, Surface("window", None, glow=1.05))
    out.append(Thing("window_1", tuple(_against(window, "south", 0.5, 0.0, 1.35))))
    door = furniture.hanging(0.95, 2.05, Surface("door"))
    out.append(Thing("door", tuple(_against(door, "south", 2.45, 0.0, 0.0))))
    return out


_POSTER_PLACES = (
    ("north", -1.2, 1.25, 0.9, 0.9), ("north", -0.1, 1.5, 1.0, 1.2), ("north", 1.2, 1.3, 0.9, 0.9),
    ("north", 4.2, 1.6, 0.9, 0.9), ("north", 2.9, 1.95, 0.9, 0.8),
    ("east", -2.3, 1.3, 0.9, 0.9), ("east", -1.0, 1.4, 1.2, 1.2), ("east", 0.4, 1.3, 0.9, 1.1),
    ("east", 1.7, 1.35, 1.0, 1.0), ("south", -1.2, 1.3, 0.9, 0.9), ("south", -4.0, 1.65, 0.9, 0.9),
    ("west", -3.4, 1.35, 1.0, 1.0), ("west", -2.2, 1.3, 0.9, 1.2), ("west", 0.9, 1.4, 0.9, 0.9),
    ("west", 2.2, 1.35, 1.1, 1.1), ("west", -4.4, 1.5, 0.7, 0.9), ("west", -0.3, 1.95, 1.0, 0.8),
)  # fmt: skip

_COPIED_POSTER = (1, 7)
"""Of the places above: a poster 1.0 m x 1.2 m of the north wall, and where its copy hangs."""

_PINBOARD_PLACES = (
    ("east", 1.03, 0.8, 0.6, 0.5), ("east", -1.65, 0.8, 0.6, 0.5), ("east", 2.55, 1.3, 0.6, 0.8),
    ("west", 1.55, 0.8, 0.6, 0.6), ("west", -2.75, 0.8, 0.6, 0.5),
)  # fmt: skip


def _with_copied_poster(things: list[Thing]) -> list[Thing]:
    """The things with one poster replaced by a copy of another, on the next wall."""
    names = [f"poster_{1 + k}" for k in _COPIED_POSTER]
    shown = next(thing.patches[0].surface for thing in things if thing.name == names[0])
    _, _, z, width, height = _POSTER_PLACES[_COPIED_POSTER[0]]
    wall, along, *_ = _POSTER_PLACES[_COPIED_POSTER[1]]
    board = furniture.hanging(width, height, shown)
    copy = Thing(names[1], tuple(_against(board, wall, along, 0.0, z)))
    return [copy if thing.name == copy.name else thing for thing in things]


def _rearranged(things: list[Thing]) -> list[Thing]:
    """Things after a new start in the room: same names, and what has moved is elsewhere.

    The posters of a pair show what the other one showed; of a pair of equally wide shelves each
    stands where the other stood; the desk in the middle faces the other way.
    """
    by_name = {thing.name: thing.patches for thing in things}
    for pair in _POSTER_PAIRS:
        names = [f"poster_{number}" for number in pair]
        shown = [by_name[name][0].surface for name in names]
        for name, surface in zip(names, shown[::-1], strict=True):
            by_name[name] = tuple(replace(p, surface=surface) for p in by_name[name])
    for (a, place_a), (b, place_b) in _SHELF_PAIRS:
        first, second = by_name[a], by_name[b]
        by_name[a] = tuple(_carried(first, place_a, place_b))
        by_name[b] = tuple(_carried(second, place_b, place_a))
    x, y = _ISLAND_DESK
    by_name["island_desk"] = tuple(placed(by_name["island_desk"], 2 * x, 2 * y, 0.0, 180.0))
    return [Thing(name, patches) for name, patches in by_name.items()]


def _carried(
    patches: tuple[Patch, ...], start: tuple[str, float], end: tuple[str, float]
) -> list[Patch]:
    """A piece carried from one (wall, along) to another."""
    at_north = placed(patches, 0.0, 0.0, 0.0, -_WALLS[start[0]])
    return placed(placed(at_north, end[1] - start[1], 0.0, 0.0, 0.0), 0, 0, 0, _WALLS[end[0]])


_POSTER_PAIRS = ((1, 10), (2, 13), (3, 7), (4, 16), (6, 12), (8, 14), (9, 15))
_SHELF_PAIRS = (
    (("shelf_1", ("north", -3.8)), ("shelf_4", ("east", -3.6))),
    (("shelf_2", ("north", -2.5)), ("shelf_9", ("west", 3.5))),
    (("shelf_5", ("east", 3.3)), ("shelf_6", ("south", -2.4))),
)
_ISLAND_DESK = (0.2, 2.35)


def _islands(rng: np.random.Generator) -> list[Thing]:
    """Free-standing rows north and south of the middle, low enough to see the walls over them."""
    north = placed(furniture.desk(rng, 2.2, 2), *_ISLAND_DESK, 0.0, 0.0)
    south = placed(furniture.shelf(rng, 1.8, 1.1, 0.35), -0.4, -2.45, 0.0, 180.0)
    back = placed(furniture.shelf(rng, 1.8, 1.1, 0.35), -0.4, -2.45, 0.0, 0.0)
    return [Thing("island_desk", tuple(north)), Thing("island_shelf", tuple(south + back))]


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


def _loose_things(rng: np.random.Generator, moved: bool) -> list[Thing]:
    """What people move about: chairs, cartons, a plotter; ``moved`` puts them elsewhere."""
    out = []
    for name, size, first, second in _LOOSE:
        if size is not None:
            patches = furniture.carton(rng, size)
        elif name == "plotter":
            patches = furniture.cabinet(0.7, 1.0, 0.5, Surface("metal", 0.8))
        else:
            patches = furniture.chair()
        out.append(Thing(name, tuple(placed(patches, *(second if moved else first)))))
    return out
