"""Grey textures of the buildings, beside the lab's: a cover for each room, and many pictures.

The lab has a dozen pictures; a building whose rooms are recognised by what hangs in them
needs a different one for every place.
"""

from __future__ import annotations

import numpy as np

from fgslam.worlds.rendering import textures
from fgslam.worlds.rendering.texture_library import build_library, faded
from fgslam.worlds.rendering.textures import Grey

PICTURES, CORRIDOR_PICTURES = 240, 5
_SCUFFS = 800  # on 41 square metres
FLOORS = ("floor", "floor_1", "floor_2", "floor_3")


def building_library(rng: np.random.Generator) -> dict[str, Grey]:
    """Every texture of the office building, by name."""
    out = build_library(rng)
    for i, base in enumerate((185.0, 150.0, 170.0, 132.0, 195.0, 160.0)):
        out[f"wall_{i}"] = textures.plaster(rng, 1024, base, scuffs=_SCUFFS)
    for i, base in enumerate((165.0, 140.0, 182.0)):
        out[f"paper_{i}"] = textures.wallpaper(rng, 1024, base, scuffs=_SCUFFS)
    out["bricks_dark"] = textures.bricks(rng, 1024, 21) - np.float32(28.0)
    for name in FLOORS[1:]:
        out[name] = textures.carpet(rng, 1024)
    for i in range(PICTURES):
        out[f"picture_{i}"] = _picture(rng, i)
    return out


def corridor_library(rng: np.random.Generator) -> dict[str, Grey]:
    """Every texture of the corridors that look alike, by name."""
    out = build_library(rng)
    out["wall_0"] = textures.plaster(rng, 1024, 185.0, scuffs=_SCUFFS)
    out["floor_1"] = textures.carpet(rng, 1024)
    for i in range(CORRIDOR_PICTURES):
        out[f"picture_{i}"] = _picture(rng, i)
    return out


def _picture(rng: np.random.Generator, number: int) -> Grey:
    """Prints, pinboards and paintings in turn, with more contrast than the lab's."""
    kind = number % 5
    if kind in (0, 2):
        return faded(textures.poster(rng, 256, 256), 0.75)
    if kind in (1, 3):
        return faded(textures.pinboard(rng, 256), 0.8)
    return faded(textures.abstract(rng, 256), 0.8)
