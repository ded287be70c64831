"""Textures packed with their mip-map pyramids, sampled trilinearly by vectorised gathers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, IntArray

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]

# Texels are kept as 16-bit fixed point: half the memory traffic of float32, error 1/512 grey.
_FIXED = 256.0
# Sharper than the textbook's choice, whose tent of two texels is wider than a pixel.
_LOD_BIAS = -0.35


class TextureSizes(Protocol):
    """What a scene must know of its textures: their numbers and sizes in texels.

    Attributes:
        index: number of each texture by name.
        full_width, full_height: (n,) of the finest level.
    """

    index: dict[str, int]
    full_width: FloatArray
    full_height: FloatArray


class TextureBank:
    """All textures of a world in one array; sides are powers of two, and textures repeat."""

    def __init__(self, textures: Mapping[str, Float32]) -> None:
        """Packs textures (h, w) in grey levels, in the mapping's order."""
        self.index = {name: i for i, name in enumerate(textures)}
        pyramids = [_pyramid(texture) for texture in textures.values()]
        self._levels = max(len(p) for p in pyramids)
        shape = (len(pyramids), self._levels)
        self._offset = np.zeros(shape, dtype=np.int32)
        self._width = np.ones(shape, dtype=np.int32)
        self._height = np.ones(shape, dtype=np.int32)
        parts: list[npt.NDArray[np.uint16]] = []
        start = 0
        for i, pyramid in enumerate(pyramids):
            for level in range(self._levels):
                image = pyramid[min(level, len(pyramid) - 1)]
                self._height[i, level], self._width[i, level] = image.shape
                if level < len(pyramid):
                    parts.append(np.round(image * _FIXED).astype(np.uint16).ravel())
                    self._offset[i, level] = start
                    start += image.size
                else:
                    self._offset[i, level] = self._offset[i, level - 1]
        self._texels = np.concatenate(parts)
        self.full_width = self._width[:, 0].astype(np.float64)
        self.full_height = self._height[:, 0].astype(np.float64)

    def sample(self, texture: Int32, u: Float32, v: Float32, footprint: Float32) -> Float32:
        """Grey levels at texture coordinates, filtered over a pixel's footprint.

        Args:
            texture: (n,) index of the texture.
            u: (n,) coordinate to the right, 1 per copy of the texture.
            v: (n,) coordinate downwards, likewise.
            footprint: (n,) width of the pixel in texels of the finest level.
        """
        lod = np.log2(np.maximum(footprint, 1e-6)) + np.float32(_LOD_BIAS)
        np.clip(lod, 0.0, self._levels - 1.001, out=lod)
        level = lod.astype(np.int32)
        fraction = lod - level
        fine = texture * np.int32(self._levels) + level
        near = self._bilinear(fine, u, v)
        far = self._bilinear(fine + np.int32(1), u, v)
        return np.asarray((near + fraction * (far - near)) * np.float32(1.0 / _FIXED))

    def _bilinear(self, row: Int32, u: Float32, v: Float32) -> Float32:
        """Fixed-point values at one level; ``row`` (n,) picks texture and level."""
        width, height = self._width.ravel().take(row), self._height.ravel().take(row)
        x, y = u * width - np.float32(0.5), v * height - np.float32(0.5)
        x_floor, y_floor = np.floor(x), np.floor(y)
        fx, fy = x - x_floor, y - y_floor
        x0, y0 = x_floor.astype(np.int32), y_floor.astype(np.int32)
        mask_x, mask_y = width - 1, height - 1
        x1, y1 = (x0 + 1) & mask_x, (y0 + 1) & mask_y
        x0 &= mask_x
        y0 &= mask_y
        offset = self._offset.ravel().take(row)
        top, bottom = offset + y0 * width, offset + y1 * width
        a, b = self._texels.take(top + x0), self._texels.take(top + x1)
        c, d = self._texels.take(bottom + x0), self._texels.take(bottom + x1)
        upper = a + fx * (b.astype(np.float32) - a)
        lower = c + fx * (d.astype(np.float32) - c)
        return np.asarray(upper + fy * (lower - upper))


def _pyramid(texture: Float32) -> list[Float32]:
    """The texture and its halvings by 2 x 2 means, down to one texel."""
    height, width = texture.shape
    if height & (height - 1) or width & (width - 1):
        raise ValueError(f"texture sides must be powers of two, got {width} x {height}")
    out = [np.clip(texture, 0.0, 255.0).astype(np.float32)]
    while out[-1].size > 1:
        image = out[-1]
        if image.shape[0] > 1:
            image = 0.5 * (image[0::2] + image[1::2])
        if image.shape[1] > 1:
            image = 0.5 * (image[:, 0::2] + image[:, 1::2])
        out.append(image)
    return out


def texture_indices(bank: TextureSizes, names: tuple[str, ...]) -> IntArray:
    """(n,) index of each name. Raises KeyError for a texture that the bank lacks."""
    return np.array([bank.index[name] for name in names], dtype=np.int64)
