"""Furniture of a home, beside the lab's: fronts towards -y, standing on z = 0, middle at x = 0."""

from __future__ import annotations

import numpy as np

from fgslam.worlds.buildings import furniture
from fgslam.worlds.rendering.patches import Patch, Surface, box, placed, prism, rectangle

_POT = Surface("bricks", 0.8)


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
        leaf = rectangle((-0.08, -lean, 0.3 + tall), (0.16, 0, 0), (0, lean, -tall), _leaf(rng))
        out += placed([leaf], 0.0, 0.0, 0.0, float(yaw))
    return out


def _leaf(rng: np.random.Generator) -> Surface:
    return Surface("cloth_green", float(rng.uniform(0.3, 0.9)))


def pillar(side: float, height: float, cover: str) -> list[Patch]:
    """A square column from floor to ceiling."""
    half = side / 2
    return box((-half, -half, 0.0), (half, half, height), Surface(cover, 1.6))


def dining_table(rng: np.random.Generator, width: float) -> list[Patch]:
    """A table with four chairs, a bowl and a carton on it."""
    out = furniture.table(width, 0.9, 0.74, Surface("wood_light", 0.9))
    for x, y, yaw in ((-0.4, -0.6, 180), (0.4, -0.65, 170), (-0.4, 0.62, 5), (0.45, 0.6, -10)):
        turn = yaw + float(rng.uniform(-15, 15))
        out += placed(furniture.chair(), x, y, 0.0, turn)
    out += placed(prism((0, 0, 0), (0, 0, 0.1), 0.14, Surface("cloth_red", 0.4)), 0.1, 0.0, 0.74, 0)
    return out + placed(furniture.carton(rng, (0.25, 0.2, 0.25)), -0.45, 0.05, 0.74, 20)


def rug(width: float, depth: float, texture: str) -> list[Patch]:
    """A carpet lying on the floor."""
    corner = (-width / 2, depth / 2, 0.004)
    return [rectangle(corner, (width, 0, 0), (0, -depth, 0), Surface(texture))]


def extinguisher() -> list[Patch]:
    """A red cylinder on the wall."""
    return prism((0, -0.1, 0.5), (0, -0.1, 1.0), 0.08, Surface("cloth_red", 2.0))
