"""Images of patch scenes through any camera, in any number of channels, and exact truth.

One ray a pixel. With ``d`` the pixel's ray and ``d_c``, ``d_r`` its derivatives by column and row,
all that shading needs of a plane is a ratio of functions linear in ``d``: the distance is
``1 / (g_w . d)`` and a texture coordinate ``(g_u . d) / (g_w . d) + c_u``. The derivatives of that
ratio along ``d_c`` and ``d_r`` are the pixel's footprint on the texture, which trilinear mip-maps
filter over. Pixels at the border of two surfaces are replaced by the mean of four points in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fgslam.cameras.omni.camera import OmniCamera
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.worlds.rendering.scene import Body, Layer
from fgslam.worlds.rendering.texture_bank import TextureBank
from fgslam.worlds.rendering.views import Rays, View

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]

# Four points a pixel where two surfaces meet: the rest is smooth by its mip-maps.
_EDGE_SAMPLES = ((-0.25, -0.375), (0.375, -0.25), (0.25, 0.375), (-0.375, 0.25))
# Keeps the rare hit on a patch seen edge-on finite; nothing is a kilometre away.
_LEAST_INVERSE_DISTANCE = 1e-3
_NOTHING = np.int32(-1)
_MOST_LAYERS = np.int32(16)


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """Layer (n,) and its patch (n,), both -1 for nothing, and distance (n,) along the ray."""

    layer: Int32
    patch: Int32
    distance: Float32


class Renderer:
    """Renders images and exact truth of one camera; keeps nothing of the scene.

    Safe to share between threads. Scenes and bodies must be made with the same texture bank.
    """

    def __init__(self, view: View, bank: TextureBank, edge_contrast: float | None = None) -> None:
        """Prepares the camera.

        Args:
            view: the camera's rays.
            bank: all textures.
            edge_contrast: difference of levels over a border of two surfaces, summed over the
                channels, from which on it is smoothed; None smooths all borders.
        """
        self._view, self._bank, self._edge_contrast = view, bank, edge_contrast
        self._pairs = _neighbours(view.valid, view.shape)

    def levels(self, scene: Layer, pose: FloatArray, bodies: Sequence[Body] = ()) -> Float32:
        """(channels, n) levels of the valid pixels, not yet rounded; 0 where nothing is seen.

        Args:
            scene: all that does not move.
            pose: (4, 4) camera in the scene.
            bodies: all that moves.
        """
        layers = _seen(scene, pose, bodies)
        planes = [layer.planes(at, self._view.matrix).astype(np.float32) for layer, at in layers]
        rays = self._view.rays
        hits = self._cast(layers, bodies, rays)
        levels = self._shade(layers, planes, hits, rays)
        border = self._borders(hits, levels)
        if len(border):
            total = np.zeros((len(levels), len(border)), dtype=np.float32)
            for column, row in _EDGE_SAMPLES:
                moved = rays.shifted(border, column, row)
                total += self._shade(layers, planes, self._cast(layers, bodies, moved), moved)
            levels[:, border] = total * np.float32(1.0 / len(_EDGE_SAMPLES))
        return levels

    def image(self, scene: Layer, pose: FloatArray, bodies: Sequence[Body] = ()) -> Float32:
        """(h, w, channels) the same levels in their places; 0 outside the field of view."""
        return self._filled(self.levels(scene, pose, bodies).T, 0.0)

    def assemble(self, levels: Float32) -> npt.NDArray[np.uint8]:
        """(h, w, channels) uint8 of levels (channels, n) of the valid pixels; black elsewhere."""
        rounded = np.clip(levels + np.float32(0.5), 0.0, 255.0).astype(np.uint8).T
        return self._filled(rounded, 0)

    def distances(self, scene: Layer, pose: FloatArray, bodies: Sequence[Body] = ()) -> FloatArray:
        """(h, w) how far each pixel's ray goes, metres: depth Z of a pinhole, else the range.

        NaN outside the field, infinite for nothing. Exact in double precision but for which
        surface is hit, which is the ray caster's.
        """
        layers, exact = _seen(scene, pose, bodies), self._view.exact
        hits = self._cast(layers, bodies, self._view.rays)
        out = np.full(len(exact), np.inf)
        for k, (layer, at) in enumerate(layers):
            chosen = np.flatnonzero(hits.layer == k)
            weights = layer.planes(at, self._view.matrix)[8:, hits.patch[chosen]]
            inverse = np.sum(weights.T * exact[chosen], axis=1)
            out[chosen] = 1.0 / np.maximum(inverse, _LEAST_INVERSE_DISTANCE)
        return self._filled(out, np.nan)

    def things(self, scene: Layer, pose: FloatArray, bodies: Sequence[Body] = ()) -> IntArray:
        """(h, w) index of the thing seen at pixel centres, -1 for nothing."""
        layers = _seen(scene, pose, bodies)
        hits = self._cast(layers, bodies, self._view.rays)
        out = np.full(len(hits.layer), -1, dtype=np.int64)
        for k, (layer, _) in enumerate(layers):
            chosen = hits.layer == k
            out[chosen] = layer.patches.thing[hits.patch[chosen]]
        return self._filled(out, -1)

    def _filled(self, values: npt.NDArray[np.generic], elsewhere: float) -> npt.NDArray[Any]:
        """(h, w, ...) of values (n, ...) of the valid pixels."""
        rows, columns = self._view.shape
        out = np.full((rows * columns, *values.shape[1:]), elsewhere, dtype=values.dtype)
        out[self._view.valid] = values
        return out.reshape(rows, columns, *values.shape[1:])

    def _cast(
        self, layers: Sequence[tuple[Layer, FloatArray]], bodies: Sequence[Body], rays: Rays
    ) -> _Hits:
        scene, pose = layers[0]
        patch, distance = scene.caster.cast(pose[:3, 3], rays.directions(pose))
        layer = np.where(patch >= 0, np.int32(0), _NOTHING)
        for k, body in enumerate(bodies, start=1):
            chosen = rays.towards(body, pose, distance)
            if len(chosen) == 0:
                continue
            other, seen = layers[k]
            directions = rays.shifted(chosen, 0.0, 0.0).directions(seen)
            other_patch, other_distance = other.caster.cast(seen[:3, 3], directions)
            nearer = other_distance < distance[chosen]
            hit = chosen[nearer]
            layer[hit], patch[hit], distance[hit] = k, other_patch[nearer], other_distance[nearer]
        return _Hits(layer, patch, distance)

    def _shade(
        self,
        layers: Sequence[tuple[Layer, FloatArray]],
        planes: list[Float32],
        hits: _Hits,
        rays: Rays,
    ) -> Float32:
        if bool((hits.layer == 0).all()):
            return self._shade_layer(layers[0][0], planes[0], hits.patch, rays)
        levels = np.zeros((self._bank.channels, len(hits.layer)), dtype=np.float32)
        for k, (layer, _) in enumerate(layers):
            chosen = np.flatnonzero(hits.layer == k)
            if len(chosen):
                patch, some = hits.patch[chosen], rays.shifted(chosen, 0.0, 0.0)
                levels[:, chosen] = self._shade_layer(layer, planes[k], patch, some)
        return levels

    def _shade_layer(self, layer: Layer, planes: Float32, patch: Int32, rays: Rays) -> Float32:
        g = planes.take(patch, axis=1)
        g_u, g_v, g_w = g[:3], g[4:7], g[8:]
        inverse = np.maximum(rays.along(g_w), np.float32(_LEAST_INVERSE_DISTANCE))
        distance = np.reciprocal(inverse)
        u, v = rays.along(g_u) * distance, rays.along(g_v) * distance
        w_column, w_row = rays.by_column(g_w), rays.by_row(g_w)
        width, height = (side.take(patch) * distance for side in layer.size.astype(np.float32).T)
        across = np.square((rays.by_column(g_u) - u * w_column) * width)
        across += np.square((rays.by_column(g_v) - v * w_column) * height)
        down = np.square((rays.by_row(g_u) - u * w_row) * width)
        down += np.square((rays.by_row(g_v) - v * w_row) * height)
        footprint = np.sqrt(np.maximum(across, down))
        u += g[3]
        v += g[7]
        levels = self._bank.sample(layer.texture.take(patch), u, v, footprint)
        levels *= layer.light_at(patch, u, v)
        return levels

    def _borders(self, hits: _Hits, levels: Float32) -> IntArray:
        """Pixels beside one that shows another surface, as indices into the valid ones."""
        first, second = self._pairs
        label = hits.patch * _MOST_LAYERS + hits.layer
        change = np.flatnonzero(label[first] != label[second])
        first, second = first[change], second[change]
        if self._edge_contrast is not None:
            contrast = np.abs(levels[:, first] - levels[:, second]).sum(axis=0)
            strong = contrast > np.float32(self._edge_contrast)
            first, second = first[strong], second[strong]
        mark = np.zeros(len(label), dtype=np.bool_)
        mark[first] = True
        mark[second] = True
        return np.flatnonzero(mark)


def visible(
    scene: Layer, camera: OmniCamera, pose: FloatArray, points: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Where points of the scene are seen: exact truth for judging matches.

    Args:
        scene: all that does not move.
        camera: its model.
        pose: (4, 4) camera in the scene.
        points: (n, 3) in the scene, metres.

    Returns:
        Pixels (n, 2), NaN outside the field of view, and whether each point is in the field and
        nothing stands before it (n,). A point *on* a surface is not hidden by it.
    """
    offset = points - pose[:3, 3]
    pixels = camera.pixels(offset @ pose[:3, :3])
    origins = np.broadcast_to(pose[:3, 3], points.shape)
    # A millimetre in four metres short of the point, so that its own surface does not count.
    free = ~scene.caster.blocked(np.asarray(origins), offset, 1.0 - 5e-4)
    return pixels, free & np.isfinite(pixels).all(axis=1)


def surface_points(
    scene: Layer, camera: OmniCamera, pose: FloatArray, pixels: FloatArray
) -> FloatArray:
    """(n, 3) points of the scene that pixels (n, 2) show, NaN where they show nothing.

    Exact in double precision but for which surface is hit, which is the ray caster's.
    """
    rays = camera.rays(pixels)
    directions = np.nan_to_num(rays) @ pose[:3, :3].T
    patch, _ = scene.caster.cast(pose[:3, 3], directions.astype(np.float32))
    weights = scene.planes(pose, np.eye(3))[8:, np.maximum(patch, 0)]
    inverse = np.sum(weights.T * np.nan_to_num(rays), axis=1)
    shown = (patch >= 0) & np.isfinite(rays).all(axis=1)
    out = np.full((len(pixels), 3), np.nan)
    out[shown] = pose[:3, 3] + directions[shown] / inverse[shown, None]
    return out


def _seen(scene: Layer, pose: FloatArray, bodies: Sequence[Body]) -> list[tuple[Layer, FloatArray]]:
    """The scene and each body, with the camera's pose (4, 4) in its frame."""
    return [(scene, pose), *((b.layer, np.linalg.inv(b.wTo) @ pose) for b in bodies)]


def _neighbours(valid: IntArray, shape: tuple[int, int]) -> tuple[IntArray, IntArray]:
    """Pairs of valid pixels beside and below each other, as indices into the valid ones."""
    place = np.full(shape, -1, dtype=np.int64)
    place.ravel()[valid] = np.arange(len(valid))
    first = np.concatenate([place[:, :-1].ravel(), place[:-1].ravel()])
    second = np.concatenate([place[:, 1:].ravel(), place[1:].ravel()])
    both = (first >= 0) & (second >= 0)
    return first[both], second[both]
