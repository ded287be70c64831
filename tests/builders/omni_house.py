"""A small scene for tests of the omnidirectional renderer, quick to build."""

from __future__ import annotations

import numpy as np

from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import FloatArray
from fgslam.worlds.patches import RayCaster, Surface, Thing, rectangle, stack
from fgslam.worlds.renderer import Layer, flat_light
from fgslam.worlds.textures import ColourBank

PANORAMA = Equirectangular(512, 256)


def plain(*colours: tuple[int, int, int]) -> ColourBank:
    """Textures of one colour each, named ``c0``, ``c1`` and so on."""
    return ColourBank(
        {f"c{i}": np.full((4, 4, 3), colour, np.float32) for i, colour in enumerate(colours)}
    )


def room(bank: ColourBank, marks: FloatArray, side: float = 0.16) -> Layer:
    """A closed room of 8 m x 6 m x 3 m, covered in ``c0``, with square marks in ``c1``.

    The marks' centres (n, 3) lie on the north wall (y = 3) and look south.
    """
    x, y, h = 4.0, 3.0, 3.0
    wall = Surface("c0")
    patches = [
        rectangle((-x, y, h), (2 * x, 0, 0), (0, 0, -h), wall),
        rectangle((x, -y, h), (-2 * x, 0, 0), (0, 0, -h), wall),
        rectangle((x, y, h), (0, -2 * y, 0), (0, 0, -h), wall),
        rectangle((-x, -y, h), (0, 2 * y, 0), (0, 0, -h), wall),
        rectangle((-x, y, 0), (2 * x, 0, 0), (0, -2 * y, 0), wall),
        rectangle((-x, -y, h), (2 * x, 0, 0), (0, 2 * y, 0), wall),
    ]
    half = side / 2
    for mx, my, mz in marks:
        corner = (mx - half, my - 0.002, mz + half)
        patches.append(rectangle(corner, (side, 0, 0), (0, 0, -side), Surface("c1")))
    scene = stack([Thing("room", tuple(patches))])
    light = flat_light(scene, np.array([0.0, 0.0, 1.0]))
    light.values[:] = 1.0
    return Layer(scene, RayCaster(scene), light, bank)
