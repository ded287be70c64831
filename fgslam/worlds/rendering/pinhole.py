"""Pinhole images of patch scenes: one ray a pixel, exact footprints, trilinear mip-maps.

On a plane everything that shading needs is a ratio of functions linear in the pixel's position:
with p = (column, row, 1), inverse depth is ``g_w . p`` and a texture coordinate at depth Z is
``Z (g_u . p) + c_u``. The derivative of that ratio is the pixel's footprint in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.worlds.rendering.lighting import LightMaps
from fgslam.worlds.rendering.mipmap import TextureBank, TextureSizes, texture_indices
from fgslam.worlds.rendering.patches import PatchArrays
from fgslam.worlds.rendering.raycaster import RayCaster

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]

# Four points a pixel where two surfaces meet: the rest is smooth by its mip-maps.
_EDGE_SAMPLES = np.array([[-0.25, -0.375], [0.375, -0.25], [0.25, 0.375], [-0.375, 0.25]])

# Keeps the rare hit on a patch seen edge-on finite; nothing is a kilometre away.
LEAST_INVERSE_DEPTH = 1e-3


@dataclass(frozen=True, slots=True)
class Pinhole:
    """Intrinsics of one camera: size, focal length and principal point in pixels."""

    width: int
    height: int
    focal: float
    cx: float
    cy: float

    def pixels(self) -> Float32:
        """(h * w, 2) columns and rows of all pixel centres, row by row."""
        columns, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float32)

    def inverse_matrix(self) -> FloatArray:
        """(3, 3) from (column, row, 1) to a ray of unit depth."""
        f = self.focal
        return np.array([[1 / f, 0, -self.cx / f], [0, 1 / f, -self.cy / f], [0, 0, 1.0]])


class Layer:
    """A scene ready to be shaded: patches, their textures and light, and a ray caster."""

    def __init__(
        self, patches: PatchArrays, caster: RayCaster, light: LightMaps, bank: TextureSizes
    ) -> None:
        self.patches = patches
        self.caster = caster
        self.light = light.values
        self._repeats = _repeats(patches)
        self._texture = texture_indices(bank, tuple(s.texture for s in patches.surfaces))
        self.texture = self._texture.astype(np.int32)
        self.size = np.column_stack([bank.full_width, bank.full_height])[self._texture]
        self.light_offset = light.offset.astype(np.int32)
        self.light_columns = light.columns.astype(np.int32)
        cells = np.column_stack([light.columns, light.rows]) - 1.0
        self.light_scale = (cells / self._repeats).astype(np.float32)
        self.light_last = cells.astype(np.float32)

    def planes(self, pose: FloatArray, inverse_matrix: FloatArray) -> FloatArray:
        """(11, n) of all patches seen from a camera: g_u, c_u, g_v, c_v, g_w (see the module).

        Args:
            pose: (4, 4) camera in the scene.
            inverse_matrix: (3, 3) from pixels to rays.
        """
        p = self.patches
        rays = pose[:3, :3] @ inverse_matrix
        offset = pose[:3, 3] - p.corner
        out = np.empty((11, len(p)))
        for row, dual, repeat in ((0, p.dual_u, 0), (4, p.dual_v, 1)):
            scaled = dual * self._repeats[:, repeat : repeat + 1]
            out[row : row + 3] = (scaled @ rays).T
            out[row + 3] = np.sum(scaled * offset, axis=1)
        height = -np.sum(p.normal * offset, axis=1)
        # A patch seen exactly edge-on covers no pixel: any finite value will do.
        out[8:] = (p.normal @ rays).T / np.where(np.abs(height) < 1e-9, 1e-9, height)
        return out


def _repeats(patches: PatchArrays) -> FloatArray:
    """(n, 2) copies of the texture along the edges."""
    tile = np.array([s.tile_m or 0.0 for s in patches.surfaces])
    out = np.ones((len(patches), 2))
    tiled = tile > 0.0
    out[tiled, 0] = np.linalg.norm(patches.edge_u[tiled], axis=1) / tile[tiled]
    out[tiled, 1] = np.linalg.norm(patches.edge_v[tiled], axis=1) / tile[tiled]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What pixels see: layer (n,) and its patch (n,), both -1 for nothing, and depth (n,)."""

    layer: Int32
    patch: Int32
    depth: Float32


class Renderer:
    """Renders grey images and exact truth of layers that share a texture bank."""

    def __init__(self, camera: Pinhole, bank: TextureBank) -> None:
        self._camera = camera
        self._bank = bank
        self._pixels = camera.pixels()
        self._inverse = camera.inverse_matrix()

    def image(self, layers: list[Layer], pose: FloatArray) -> Float32:
        """Grey levels (h, w), not yet rounded, of the scene from a camera ``pose`` (4, 4)."""
        planes = [layer.planes(pose, self._inverse).astype(np.float32) for layer in layers]
        hits = self._cast(layers, pose, self._pixels)
        grey = self._shade(layers, planes, hits, self._pixels)
        self._refine_edges(layers, planes, pose, hits, grey)
        return np.asarray(grey.reshape(self._camera.height, self._camera.width))

    def depth(self, layers: list[Layer], pose: FloatArray) -> FloatArray:
        """(h, w) depth Z in metres at pixel centres, in double precision; infinite for nothing."""
        hits = self._cast(layers, pose, self._pixels)
        depth = np.full(len(self._pixels), np.inf)
        for k, layer in enumerate(layers):
            chosen = np.flatnonzero(hits.layer == k)
            g = layer.planes(pose, self._inverse)[8:, hits.patch[chosen]]
            p = self._pixels[chosen].astype(np.float64)
            inverse_depth = g[0] * p[:, 0] + g[1] * p[:, 1] + g[2]
            depth[chosen] = 1.0 / np.maximum(inverse_depth, LEAST_INVERSE_DEPTH)
        return depth.reshape(self._camera.height, self._camera.width)

    def things(self, layers: list[Layer], pose: FloatArray) -> IntArray:
        """(h, w) index of the thing seen at pixel centres, -1 for nothing."""
        hits = self._cast(layers, pose, self._pixels)
        out = np.full(len(self._pixels), -1, dtype=np.int64)
        for k, layer in enumerate(layers):
            chosen = hits.layer == k
            out[chosen] = layer.patches.thing[hits.patch[chosen]]
        return out.reshape(self._camera.height, self._camera.width)

    def _cast(self, layers: list[Layer], pose: FloatArray, pixels: Float32) -> Hits:
        matrix = (pose[:3, :3] @ self._inverse).astype(np.float32)
        directions = pixels @ matrix[:, :2].T + matrix[:, 2]
        patch, depth = layers[0].caster.cast(pose[:3, 3], directions)
        layer = np.where(patch >= 0, np.int32(0), np.int32(-1))
        for k, other in enumerate(layers[1:], start=1):
            other_patch, other_depth = other.caster.cast(pose[:3, 3], directions)
            nearer = other_depth < depth
            layer[nearer], patch[nearer] = k, other_patch[nearer]
            depth[nearer] = other_depth[nearer]
        return Hits(layer, patch, depth)

    def _shade(
        self, layers: list[Layer], planes: list[Float32], hits: Hits, pixels: Float32
    ) -> Float32:
        if len(layers) == 1 and bool((hits.layer == 0).all()):
            return self._shade_layer(layers[0], planes[0], hits.patch, pixels)
        grey = np.zeros(len(pixels), dtype=np.float32)
        for k, layer in enumerate(layers):
            chosen = np.flatnonzero(hits.layer == k)
            if len(chosen):
                patch = hits.patch[chosen]
                grey[chosen] = self._shade_layer(layer, planes[k], patch, pixels[chosen])
        return grey

    def _shade_layer(self, layer: Layer, planes: Float32, patch: Int32, pixels: Float32) -> Float32:
        gathered = planes.take(patch, axis=1)
        column, row = np.ascontiguousarray(pixels.T)
        inverse_depth = gathered[8] * column + gathered[9] * row + gathered[10]
        depth = 1.0 / np.maximum(inverse_depth, np.float32(LEAST_INVERSE_DEPTH))
        size = layer.size.astype(np.float32)
        u, u_column, u_row = _coordinate(gathered[0:4], gathered[8:], column, row, depth)
        v, v_column, v_row = _coordinate(gathered[4:8], gathered[8:], column, row, depth)
        width, height = size[:, 0].take(patch), size[:, 1].take(patch)
        across = np.square(u_column * width) + np.square(v_column * height)
        down = np.square(u_row * width) + np.square(v_row * height)
        footprint = np.sqrt(np.maximum(across, down))
        albedo = self._bank.sample(layer.texture.take(patch), u, v, footprint)
        return np.asarray(albedo * light_at(layer, patch, u, v))

    def _refine_edges(
        self,
        layers: list[Layer],
        planes: list[Float32],
        pose: FloatArray,
        hits: Hits,
        grey: Float32,
    ) -> None:
        """Replaces pixels at the border of two surfaces by the mean of four points in them."""
        shape = (self._camera.height, self._camera.width)
        border = np.flatnonzero(_borders(hits, shape))
        if len(border) == 0:
            return
        total = np.zeros(len(border), dtype=np.float32)
        for shift in _EDGE_SAMPLES.astype(np.float32):
            pixels = self._pixels[border] + shift
            total += self._shade(layers, planes, self._cast(layers, pose, pixels), pixels)
        grey[border] = total / np.float32(len(_EDGE_SAMPLES))


def _borders(hits: Hits, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """(n,) pixels whose right or lower neighbour, or left or upper one, shows another patch."""
    label = (hits.patch * 4 + hits.layer).reshape(shape)
    border = np.zeros(shape, dtype=np.bool_)
    change = label[:, 1:] != label[:, :-1]
    border[:, 1:] |= change
    border[:, :-1] |= change
    change = label[1:] != label[:-1]
    border[1:] |= change
    border[:-1] |= change
    return border.ravel()


def _coordinate(
    g: Float32, w: Float32, column: Float32, row: Float32, depth: Float32
) -> tuple[Float32, Float32, Float32]:
    """Texture coordinate (n,) and its derivatives by column and row."""
    ratio = (g[0] * column + g[1] * row + g[2]) * depth
    return ratio + g[3], (g[0] - ratio * w[0]) * depth, (g[1] - ratio * w[1]) * depth


def light_at(layer: Layer, patch: Int32, u: Float32, v: Float32) -> Float32:
    """Bilinear light (n,) at texture coordinates."""
    scale, last = layer.light_scale, layer.light_last
    x = np.clip(u * scale[:, 0].take(patch), 0.0, last[:, 0].take(patch) - np.float32(1e-3))
    y = np.clip(v * scale[:, 1].take(patch), 0.0, last[:, 1].take(patch) - np.float32(1e-3))
    x0, y0 = x.astype(np.int32), y.astype(np.int32)
    fx, fy = x - x0, y - y0
    columns = layer.light_columns.take(patch)
    at = layer.light_offset.take(patch) + y0 * columns + x0
    upper = layer.light.take(at) * (1 - fx) + layer.light.take(at + 1) * fx
    below = at + columns
    lower = layer.light.take(below) * (1 - fx) + layer.light.take(below + 1) * fx
    return np.asarray(upper * (1 - fy) + lower * fy)
