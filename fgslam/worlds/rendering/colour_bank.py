"""Colour textures with mip-map pyramids, packed so that one gather fetches a whole texel.

A texel is one 64-bit integer with red, green and blue in lanes of 21 bits. The eight texels that
trilinear filtering mixes are added with integer weights that sum to 2^13: 255 * 2^13 < 2^21, so no
lane runs over into its neighbour, and the three channels cost as much as one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]
Packed = npt.NDArray[np.int64]

_LANE = 21
_MASK = np.int64((1 << _LANE) - 1)
_WEIGHTS = 8192.0
# As for grey textures: sharper than the textbook, whose tent of two texels is wider than a pixel.
_LOD_BIAS = np.float32(-0.35)


class ColourBank:
    """All colour textures of a world; sides are powers of two, and textures repeat.

    Attributes:
        index: number of each texture by name.
        full_width, full_height: (n,) texels of the finest level.
    """

    def __init__(self, textures: Mapping[str, Float32]) -> None:
        """Packs textures (h, w, 3), levels 0-255 of red, green, blue, in the mapping's order.

        Raises:
            ValueError: a side is no power of two.
        """
        self.index = {name: i for i, name in enumerate(textures)}
        pyramids = [_pyramid(texture) for texture in textures.values()]
        self._levels = max(len(pyramid) for pyramid in pyramids)
        rows = len(pyramids) * self._levels
        self._offset, self._width, self._height = (np.ones(rows, dtype=np.int32) for _ in range(3))
        parts: list[Packed] = []
        start = 0
        for i, pyramid in enumerate(pyramids):
            for level in range(self._levels):
                row, image = i * self._levels + level, pyramid[min(level, len(pyramid) - 1)]
                self._height[row], self._width[row] = image.shape[:2]
                self._offset[row] = self._offset[row - 1] if level >= len(pyramid) else start
                if level < len(pyramid):
                    parts.append(_packed(image).ravel())
                    start += len(parts[-1])
        self._texels = np.concatenate(parts)
        self.full_width = self._width[:: self._levels].astype(np.float64)
        self.full_height = self._height[:: self._levels].astype(np.float64)

    def sample(self, texture: Int32, u: Float32, v: Float32, footprint: Float32) -> Float32:
        """(3, n) red, green, blue at texture coordinates, filtered over a pixel's footprint.

        Args:
            texture: (n,) number of the texture.
            u: (n,) coordinate to the right, 1 per copy of the texture.
            v: (n,) coordinate downwards, likewise.
            footprint: (n,) width of the pixel in texels of the finest level.
        """
        lod = np.log2(np.maximum(footprint, np.float32(1e-6))) + _LOD_BIAS
        np.clip(lod, 0.0, self._levels - 1.001, out=lod)
        level = lod.astype(np.int32)
        fraction = (lod - level) * np.float32(_WEIGHTS)
        fine = texture * np.int32(self._levels) + level
        total = self._bilinear(fine, u, v, np.float32(_WEIGHTS) - fraction)
        total += self._bilinear(fine + np.int32(1), u, v, fraction)
        out = np.empty((3, len(u)), dtype=np.float32)
        out[0] = total & _MASK
        out[1] = (total >> _LANE) & _MASK
        out[2] = total >> (2 * _LANE)
        out *= np.float32(1.0 / _WEIGHTS)
        return out

    def _bilinear(self, row: Int32, u: Float32, v: Float32, weight: Float32) -> Packed:
        """(n,) packed sums at one level, the four weights adding to ``weight``."""
        width, height = self._width.take(row), self._height.take(row)
        x, y = u * width - np.float32(0.5), v * height - np.float32(0.5)
        x_floor, y_floor = np.floor(x), np.floor(y)
        fx, fy = x - x_floor, (y - y_floor) * weight
        x0, y0 = x_floor.astype(np.int32), y_floor.astype(np.int32)
        last_x, last_y = width - np.int32(1), height - np.int32(1)
        x1, y1 = (x0 + np.int32(1)) & last_x, (y0 + np.int32(1)) & last_y
        x0 &= last_x
        y0 &= last_y
        offset = self._offset.take(row)
        top, bottom = offset + y0 * width, offset + y1 * width
        right_below = fx * fy
        right_above = fx * weight - right_below
        left_below = fy - right_below
        left_above = weight - fx * weight - left_below
        texels = self._texels
        total = texels.take(top + x0) * _rounded(left_above)
        total += texels.take(top + x1) * _rounded(right_above)
        total += texels.take(bottom + x0) * _rounded(left_below)
        total += texels.take(bottom + x1) * _rounded(right_below)
        return np.asarray(total)


def _rounded(weight: Float32) -> Packed:
    # Eight roundings add at most 4 to the sum of the weights, for which the lanes have room.
    return (weight + np.float32(0.5)).astype(np.int32).astype(np.int64)


def _packed(image: Float32) -> Packed:
    levels = np.round(image).astype(np.int64)
    return np.asarray(levels[..., 0] | levels[..., 1] << _LANE | levels[..., 2] << (2 * _LANE))


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
