"""The rendered house with a mirror on a wall: what it shows is a second house behind the wall."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np

from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import FloatArray, Image
from fgslam.worlds.house import CAMERA_HEIGHT_M, camera_pose
from fgslam.worlds.patches import Patch, RayCaster, Thing, stack
from fgslam.worlds.places import HALF_WALL, HEIGHT, build_house
from fgslam.worlds.renderer import Layer, LightMaps, Renderer, bake, noisy, omni_view
from fgslam.worlds.textures import ColourBank, build_colour_library

CAMERA = Equirectangular(1024, 512)
DOOR = (2.6, 5.0, 2.2)
"""Where it begins and ends along y on the west wall of the hall, and its height, metres."""


@cache
def renderer() -> tuple[Renderer, Layer]:
    """The camera, and the house with its reflection; some seconds."""
    bank = ColourBank(build_colour_library(np.random.default_rng([0, 1])))
    house = build_house(np.random.default_rng([0, 2]))
    things = [_with_opening(thing) for thing in house.things]
    patches = stack(things)
    light = bake(patches, RayCaster(patches), house.lamps, np.random.default_rng([0, 3]), 0.4)
    both = stack([*things, *map(_reflected, things)])
    twice = LightMaps(
        np.tile(light.values, 2),
        np.concatenate([light.offset, light.offset + len(light.values)]),
        np.tile(light.columns, 2),
        np.tile(light.rows, 2),
    )
    return Renderer(omni_view(CAMERA), bank, 24.0), Layer(both, RayCaster(both), twice, bank)


def picture(pose: FloatArray, number: int) -> Image:
    """(512, 1024, 3) from a planar pose (3,); ``number`` seeds its noise."""
    camera, scene = renderer()
    levels = camera.levels(scene, camera_pose(pose, CAMERA_HEIGHT_M, np.zeros(2)))
    return camera.assemble(noisy(1.25 * levels, 2.0, (0, 1, number)))


def _reflected(thing: Thing) -> Thing:
    patches = [
        Patch(_across(one.corner) + 2.0 * np.array([HALF_WALL, 0.0, 0.0]), _across(one.edge_u),
              _across(one.edge_v), one.surface)
        for one in thing.patches
    ]  # fmt: skip
    return replace(thing, patches=tuple(patches))


def _across(vector: FloatArray) -> FloatArray:
    return np.asarray(vector * np.array([-1.0, 1.0, 1.0]))


def _with_opening(thing: Thing) -> Thing:
    """The same but for the mirror's place, which is left open, and what would hang before it."""
    out: list[Patch] = []
    for one in thing.patches:
        ends = one.corner + np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) @ [one.edge_u, one.edge_v]
        low, high = ends.min(axis=0), ends.max(axis=0)
        begin, end, top = DOOR
        if high[0] > 0.6 or high[1] < begin or low[1] > end or low[2] > top or high[2] < 0.01:
            out.append(one)
        elif high[2] - low[2] > HEIGHT - 0.1:  # the wall itself
            out += _around(one, low, high)
    return replace(thing, patches=tuple(out))


def _around(wall: Patch, low: FloatArray, high: FloatArray) -> list[Patch]:
    """The wall in pieces beside and above the opening."""
    along = np.array([low[1], DOOR[0], DOOR[1], high[1]])
    shares = (along - wall.corner[1]) / wall.edge_u[1]
    out = []
    for k, (a, b) in enumerate(pairwise(shares)):
        v = wall.edge_v if k != 1 else wall.edge_v * (1.0 - DOOR[2] / HEIGHT)
        first, last = sorted((a, b))
        out.append(Patch(wall.corner + first * wall.edge_u, (last - first) * wall.edge_u, v,
                         wall.surface))  # fmt: skip
    return out
