"""Textures packed with their mip-map pyramids, sampled trilinearly by vectorised gathers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import IntArray

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]
Packed = npt.NDArray[np.int64]

# Sharper than the textbook's choice, whose tent of two texels is wider than a pixel.
_LOD_BIAS = np.float32(-0.35)


class _Corners(NamedTuple):
    """Where the four texels around each point lie, and how far the point is right and below."""

    upper_left: Int32
    upper_right: Int32
    lower_left: Int32
    lower_right: Int32
    right: Float32
    below: Float32


class TextureBank(ABC):
    """All textures of a world in one array; sides are powers of two, and textures repeat.

    Attributes:
        channels: of a texel; textures are (h, w) for one, else (h, w, channels).
        index: number of each texture by name.
        full_width, full_height: (n,) texels of the finest level.
    """

    channels: int

    def __init__(self, textures: Mapping[str, Float32]) -> None:
        """Packs textures, levels 0 to 255, in the mapping's order.

        Raises:
            ValueError: a side is no power of two.
        """
        self.index = {name: i for i, name in enumerate(textures)}
        pyramids = [_pyramid(texture) for texture in textures.values()]
        self._levels = max(len(pyramid) for pyramid in pyramids)
        rows = len(pyramids) * self._levels
        self._offset, self._width, self._height = (np.ones(rows, dtype=np.int32) for _ in range(3))
        parts: list[npt.NDArray[Any]] = []
        start = 0
        for i, pyramid in enumerate(pyramids):
            for level in range(self._levels):
                row, image = i * self._levels + level, pyramid[min(level, len(pyramid) - 1)]
                self._height[row], self._width[row] = image.shape[:2]
                self._offset[row] = self._offset[row - 1] if level >= len(pyramid) else start
                if level < len(pyramid):
                    parts.append(self._packed(image).ravel())
                    start += len(parts[-1])
        self._texels: npt.NDArray[Any] = np.concatenate(parts)
        self.full_width = self._width[:: self._levels].astype(np.float64)
        self.full_height = self._height[:: self._levels].astype(np.float64)

    def indices(self, names: tuple[str, ...]) -> IntArray:
        """(n,) number of each name. Raises KeyError for a texture that the bank lacks."""
        return np.array([self.index[name] for name in names], dtype=np.int64)

    def sample(self, texture: Int32, u: Float32, v: Float32, footprint: Float32) -> Float32:
        """(channels, n) levels at texture coordinates, filtered over a pixel's footprint.

        Args:
            texture: (n,) number of the texture.
            u: (n,) coordinate to the right, 1 per copy of the texture.
            v: (n,) coordinate downwards, likewise.
            footprint: (n,) width of the pixel in texels of the finest level.
        """
        lod = np.log2(np.maximum(footprint, np.float32(1e-6))) + _LOD_BIAS
        np.clip(lod, 0.0, self._levels - 1.001, out=lod)
        level = lod.astype(np.int32)
        finer = texture * np.int32(self._levels) + level
        near, far = self._corners(finer, u, v), self._corners(finer + np.int32(1), u, v)
        return self._mixed(near, far, lod - level)

    @staticmethod
    @abstractmethod
    def _packed(image: Float32) -> npt.NDArray[Any]:
        """(h, w) one number a texel."""

    @abstractmethod
    def _mixed(self, near: _Corners, far: _Corners, fraction: Float32) -> Float32:
        """(channels, n) bilinear at both levels, ``fraction`` (n,) of the way to the coarser."""

    def _corners(self, row: Int32, u: Float32, v: Float32) -> _Corners:
        """The texels around points at one level; ``row`` (n,) picks texture and level."""
        width, height = self._width.take(row), self._height.take(row)
        x, y = u * width - np.float32(0.5), v * height - np.float32(0.5)
        x_floor, y_floor = np.floor(x), np.floor(y)
        x0, y0 = x_floor.astype(np.int32), y_floor.astype(np.int32)
        last_x, last_y = width - np.int32(1), height - np.int32(1)
        x1, y1 = (x0 + np.int32(1)) & last_x, (y0 + np.int32(1)) & last_y
        x0 &= last_x
        y0 &= last_y
        offset = self._offset.take(row)
        top, bottom = offset + y0 * width, offset + y1 * width
        return _Corners(top + x0, top + x1, bottom + x0, bottom + x1, x - x_floor, y - y_floor)


class GreyBank(TextureBank):
    """Grey textures; texels are 16-bit fixed point: half the memory traffic of float32."""

    channels = 1
    _FIXED = 256.0  # steps a grey level: an error of 1/512

    @staticmethod
    def _packed(image: Float32) -> npt.NDArray[np.uint16]:
        return np.round(image * GreyBank._FIXED).astype(np.uint16)

    def _mixed(self, near: _Corners, far: _Corners, fraction: Float32) -> Float32:
        fine, coarse = self._bilinear(near), self._bilinear(far)
        mixed = (fine + fraction * (coarse - fine)) * np.float32(1.0 / self._FIXED)
        return np.asarray(mixed[None])

    def _bilinear(self, at: _Corners) -> Float32:
        texels = self._texels
        a, b = texels.take(at.upper_left), texels.take(at.upper_right)
        c, d = texels.take(at.lower_left), texels.take(at.lower_right)
        upper = a + at.right * (b.astype(np.float32) - a)
        lower = c + at.right * (d.astype(np.float32) - c)
        return np.asarray(upper + at.below * (lower - upper))


class ColourBank(TextureBank):
    """Colour textures, packed so that one gather fetches a whole texel.

    A texel is one 64-bit integer with red, green and blue in lanes of 21 bits. The eight texels
    that trilinear filtering mixes are added with integer weights that sum to 2^13: as
    255 * 2^13 < 2^21, no lane runs over into its neighbour, and three channels cost as much as one.
    """

    channels = 3
    _LANE = 21
    _MASK = np.int64((1 << 21) - 1)
    _WEIGHTS = 8192.0

    @staticmethod
    def _packed(image: Float32) -> Packed:
        levels, lane = np.round(image).astype(np.int64), ColourBank._LANE
        return np.asarray(levels[..., 0] | levels[..., 1] << lane | levels[..., 2] << (2 * lane))

    def _mixed(self, near: _Corners, far: _Corners, fraction: Float32) -> Float32:
        coarse = fraction * np.float32(self._WEIGHTS)
        total = self._bilinear(near, np.float32(self._WEIGHTS) - coarse)
        total += self._bilinear(far, coarse)
        out = np.empty((3, len(total)), dtype=np.float32)
        out[0] = total & self._MASK
        out[1] = (total >> self._LANE) & self._MASK
        out[2] = total >> (2 * self._LANE)
        out *= np.float32(1.0 / self._WEIGHTS)
        return out

    def _bilinear(self, at: _Corners, weight: Float32) -> Packed:
        """(n,) packed sums, the four weights adding to ``weight``."""
        right, below = at.right, at.below * weight
        lower_right = right * below
        upper_right = right * weight - lower_right
        lower_left = below - lower_right
        upper_left = weight - right * weight - lower_left
        texels = self._texels
        total = texels.take(at.upper_left) * _rounded(upper_left)
        total += texels.take(at.upper_right) * _rounded(upper_right)
        total += texels.take(at.lower_left) * _rounded(lower_left)
        total += texels.take(at.lower_right) * _rounded(lower_right)
        return np.asarray(total)


def _rounded(weight: Float32) -> Packed:
    # Eight roundings add at most 4 to the sum of the weights, for which the lanes have room.
    return (weight + np.float32(0.5)).astype(np.int32).astype(np.int64)


def _pyramid(texture: Float32) -> list[Float32]:
    """The texture and its halvings by 2 x 2 means, down to one texel."""
    height, width = texture.shape[:2]
    if height & (height - 1) or width & (width - 1):
        raise ValueError(f"texture sides must be powers of two, got {width} x {height}")
    out = [np.clip(texture, 0.0, 255.0).astype(np.float32)]
    while out[-1].shape[0] * out[-1].shape[1] > 1:
        image = out[-1]
        if image.shape[0] > 1:
            image = 0.5 * (image[0::2] + image[1::2])
        if image.shape[1] > 1:
            image = 0.5 * (image[:, 0::2] + image[:, 1::2])
        out.append(image)
    return out
