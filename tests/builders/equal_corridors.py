"""The rendered ring of corridors, whose sections are copies of one, seen all around."""

from __future__ import annotations

from functools import cache

import numpy as np

from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import FloatArray, Image
from fgslam.worlds.house import CAMERA_HEIGHT_M, camera_pose
from fgslam.worlds.patches import RayCaster, stack
from fgslam.worlds.places import build_corridors
from fgslam.worlds.renderer import Layer, Renderer, bake, noisy, omni_view
from fgslam.worlds.textures import GreyBank, corridor_library

CAMERA = Equirectangular(1024, 512)
SECTION_M = 6.0


@cache
def renderer() -> tuple[Renderer, Layer]:
    """The camera and the ring; some seconds."""
    bank = GreyBank(corridor_library(np.random.default_rng([0, 1])))
    place = build_corridors(np.random.default_rng([0, 2]))
    patches = stack(place.things)
    caster = RayCaster(patches)
    light = bake(patches, caster, place.lamps, np.random.default_rng([0, 3]), 0.4)
    return Renderer(omni_view(CAMERA), bank, 24.0), Layer(patches, caster, light, bank)


def picture(pose: FloatArray, number: int) -> Image:
    """(512, 1024, 3) from a planar pose (3,); ``number`` seeds its noise."""
    camera, scene = renderer()
    levels = camera.levels(scene, camera_pose(pose, CAMERA_HEIGHT_M, np.zeros(2)))
    return np.dstack([camera.assemble(noisy(levels, 2.0, (0, 4, number)))] * 3)
