"""A textured wall before three cameras, whose projections are known exactly."""

from __future__ import annotations

import cv2
import numpy as np
from textured_room import TEXTURE

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.sensors import CameraRig

RIG = CameraRig(320, 240, 260.0, 260.0, 159.5, 119.5, 0.1, 0.1, np.eye(4))
WALL_M = 2.0
TEXELS_A_METRE = 130.0  # one a pixel, from the first place
WALL = np.asarray(TEXTURE[:, :900], np.float32)
MIDDLE = np.array([450.0, 200.0])
HERE = np.zeros(3)


def pictures(place: FloatArray, rng: np.random.Generator | None = None) -> tuple[Image, ...]:
    """What right, left and top camera see of the wall from a place (3,) before it."""
    out = []
    for offset in ((0.0, 0.0), (-RIG.baseline, 0.0), (0.0, -RIG.baseline)):
        depth = WALL_M - place[2]
        scale = RIG.fx / depth / TEXELS_A_METRE
        centre = MIDDLE + TEXELS_A_METRE * (place[:2] + np.array(offset))
        shift = np.array([RIG.cx, RIG.cy]) - scale * centre
        affine = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
        seen = cv2.warpAffine(WALL, affine, (RIG.width, RIG.height), flags=cv2.INTER_CUBIC)
        noise = 0.0 if rng is None else rng.normal(0.0, 1.0, seen.shape)
        out.append(np.asarray(np.clip(np.round(seen + noise), 0, 255), np.uint8))
    return tuple(out)
