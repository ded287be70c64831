"""Planes that face a moving camera, and boards that pass it: two rigid motions in one view."""

from __future__ import annotations

import cv2
import numpy as np
from textured_room import TEXTURE

from fgslam.core.arrays import Image
from fgslam.core.sensors import CameraRig

PASSING_RIG = CameraRig(240, 180, 180.0, 180.0, 119.5, 89.5, 0.12, None, np.eye(4))
SCENE = ((5.0, -9.0, 9.0), (3.0, -1.6, -0.9), (2.5, 0.7, 1.5))
"""Planes that face the camera: depth, left and right edge in metres."""
Plane = tuple[float, float, float]


def seen(planes: list[Plane], x: float, z: float) -> Image:
    """What a camera at (x, 0, z) sees of planes, far ones first."""
    size = (PASSING_RIG.width, PASSING_RIG.height)
    image = np.zeros(size[::-1], np.float32)
    for k, (depth, left, right) in enumerate(planes):
        texels = 70.0 if k < len(SCENE) else 200.0  # of a metre
        texture = np.asarray(np.roll(TEXTURE, 97 * k, axis=1)[:, : int(texels * (right - left))])
        scale = PASSING_RIG.fx / (depth - z)
        of_texel = scale / texels
        affine = np.array(
            [
                [of_texel, 0.0, scale * (left - x) + PASSING_RIG.cx],
                [0.0, of_texel, PASSING_RIG.cy - 200 * of_texel],
            ]
        )
        warped = cv2.warpAffine(texture.astype(np.float32), affine, size, flags=cv2.INTER_AREA)
        there = cv2.warpAffine(np.ones(texture.shape, np.float32), affine, size)
        image = np.where(there > 0.5, warped, image)
    return np.asarray(np.clip(np.round(image), 0, 255), np.uint8)


def pair_of(planes: list[Plane], x: float, z: float) -> tuple[Image, Image]:
    """Images of the left and the right camera, the right one at (x, 0, z)."""
    return seen(planes, x - PASSING_RIG.baseline, z), seen(planes, x, z)
