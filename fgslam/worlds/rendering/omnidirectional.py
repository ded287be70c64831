"""Colour images of patch scenes through any single-viewpoint omnidirectional camera.

One ray a pixel. With ``d`` the pixel's viewing direction and ``d_c``, ``d_r`` its derivatives by
column and row, all that shading needs of a plane is a ratio of functions linear in ``d``: the
distance is ``1 / (g_w . d)`` and a texture coordinate ``(g_u . d) / (g_w . d) + c_u``. The
derivatives of that ratio along ``d_c`` and ``d_r`` are the pixel's footprint on the texture, which
the trilinear mip-map filters over. Pixels at the border of two surfaces that differ in colour are
replaced by the mean of four points within them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgslam.cameras.omni.protocol import OmniCamera
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.worlds.rendering.colour_bank import ColourBank
from fgslam.worlds.rendering.pinhole import LEAST_INVERSE_DEPTH, Layer, light_at

Float32 = npt.NDArray[np.float32]
Int32 = npt.NDArray[np.int32]

_EDGE_SAMPLES = ((-0.25, -0.375), (0.375, -0.25), (0.25, 0.375), (-0.375, 0.25))
# Colour difference over an edge, summed over channels, from which on it is worth smoothing.
_EDGE_CONTRAST = 24.0
_NOTHING = np.int32(-1)
_TILT_MARGIN = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Something that moves, seen where it stands.

    Attributes:
        layer: its patches in its own frame.
        wTo: (4, 4) pose of that frame in the scene.
        radius: of an upright cylinder about the frame's z axis that holds it, metres.
    """

    layer: Layer
    wTo: FloatArray
    radius: float


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Viewing directions (3, n) in the camera's axes and their derivatives by column and row."""

    direction: Float32
    by_column: Float32
    by_row: Float32

    def shifted(self, chosen: IntArray, column: float, row: float) -> _Rays:
        """Some of the rays, moved within their pixels (to first order)."""
        d = self.direction.take(chosen, axis=1)
        dc, dr = self.by_column.take(chosen, axis=1), self.by_row.take(chosen, axis=1)
        return _Rays(d + np.float32(column) * dc + np.float32(row) * dr, dc, dr)

    def taken(self, chosen: IntArray) -> _Rays:
        """Some of the rays."""
        return self.shifted(chosen, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """Layer (n,) and its patch (n,), both -1 for nothing, and distance (n,)."""

    layer: Int32
    patch: Int32
    distance: Float32


class MirrorRenderer:
    """Renders colour images and exact truth of one camera; keeps nothing of the scene."""

    def __init__(self, camera: OmniCamera, bank: ColourBank) -> None:
        """Takes the camera's rays once."""
        self.camera, self._bank = camera, bank
        self._shape = (camera.height, camera.width)
        self._exact, steps = _pixel_rays(camera)
        self._valid = np.flatnonzero(np.isfinite(self._exact[:, 0]))
        picked = (self._exact, *steps)
        self._rays = _Rays(*(np.ascontiguousarray(a[self._valid].T, np.float32) for a in picked))
        level = self._rays.direction[:2]
        self._level = level / np.maximum(np.linalg.norm(level, axis=0), np.float32(1e-9))
        self._pairs = _neighbours(self._valid, self._shape)

    @property
    def valid(self) -> BoolArray:
        """(h, w) pixels within the camera's field of view."""
        out = np.zeros(self._shape, dtype=np.bool_)
        out.ravel()[self._valid] = True
        return out

    def levels(self, scene: Layer, pose: FloatArray, bodies: Sequence[Body] = ()) -> Float32:
        """(3, n) red, green, blue of the valid pixels, not yet rounded.

        Args:
            scene: all that does not move.
            pose: (4, 4) camera in the scene, axes x forward, y left, z up.
            bodies: all that moves.
        """
        layers = [(scene, pose), *((b.layer, np.linalg.inv(b.wTo) @ pose) for b in bodies)]
        planes = [layer.planes(seen, np.eye(3)).astype(np.float32) for layer, seen in layers]
        hits = self._cast(layers, bodies, self._rays, self._level)
        levels = self._shade(layers, planes, hits, self._rays)
        border = self._borders(hits, levels)
        if len(border):
            level = self._level[:, border]
            total = np.zeros((3, len(border)), dtype=np.float32)
            for column, row in _EDGE_SAMPLES:
                rays = self._rays.shifted(border, column, row)
                total += self._shade(layers, planes, self._cast(layers, bodies, rays, level), rays)
            levels[:, border] = total * np.float32(1.0 / len(_EDGE_SAMPLES))
        return levels

    def assemble(self, levels: Float32) -> npt.NDArray[np.uint8]:
        """(h, w, 3) uint8 of levels (3, n) of the valid pixels, rounded; black elsewhere."""
        out = np.zeros((self._shape[0] * self._shape[1], 3), dtype=np.uint8)
        out[self._valid] = np.clip(levels + np.float32(0.5), 0.0, 255.0).astype(np.uint8).T
        return out.reshape(*self._shape, 3)

    def ranges(self, scene: Layer, pose: FloatArray) -> FloatArray:
        """(h, w) distance along each pixel's ray in metres; NaN outside the field, inf for nothing.

        Exact in double precision but for which surface is hit, which is the ray caster's.
        """
        hits = self._cast([(scene, pose)], (), self._rays, self._level)
        weights = scene.planes(pose, np.eye(3))[8:, np.maximum(hits.patch, 0)]
        inverse = np.sum(weights.T * self._exact[self._valid], axis=1)
        out = np.full(self._shape[0] * self._shape[1], np.nan)
        with np.errstate(divide="ignore"):
            out[self._valid] = np.where(hits.patch >= 0, 1.0 / inverse, np.inf)
        return out.reshape(self._shape)

    def _cast(
        self,
        layers: Sequence[tuple[Layer, FloatArray]],
        bodies: Sequence[Body],
        rays: _Rays,
        level: Float32,
    ) -> _Hits:
        scene, pose = layers[0]
        patch, distance = scene.caster.cast(pose[:3, 3], _turned(pose, rays.direction))
        layer = np.where(patch >= 0, np.int32(0), _NOTHING)
        for k, body in enumerate(bodies, start=1):
            chosen = _towards(body, pose, level, distance)
            if len(chosen) == 0:
                continue
            other, seen = layers[k]
            directions = _turned(seen, rays.direction.take(chosen, axis=1))
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
        rays: _Rays,
    ) -> Float32:
        if bool((hits.layer == 0).all()):
            return self._shade_layer(layers[0][0], planes[0], hits.patch, rays)
        levels = np.zeros((3, len(hits.layer)), dtype=np.float32)
        for k, (layer, _) in enumerate(layers):
            chosen = np.flatnonzero(hits.layer == k)
            if len(chosen):
                patch = hits.patch[chosen]
                levels[:, chosen] = self._shade_layer(layer, planes[k], patch, rays.taken(chosen))
        return levels

    def _shade_layer(self, layer: Layer, planes: Float32, patch: Int32, rays: _Rays) -> Float32:
        g = planes.take(patch, axis=1)
        d, dc, dr = rays.direction, rays.by_column, rays.by_row
        distance = np.reciprocal(np.maximum(_dot(g[8:], d), np.float32(LEAST_INVERSE_DEPTH)))
        u, v = _dot(g[:3], d) * distance, _dot(g[4:7], d) * distance
        w_column, w_row = _dot(g[8:], dc), _dot(g[8:], dr)
        width, height = (side.take(patch) * distance for side in layer.size.astype(np.float32).T)
        across = np.square((_dot(g[:3], dc) - u * w_column) * width)
        across += np.square((_dot(g[4:7], dc) - v * w_column) * height)
        down = np.square((_dot(g[:3], dr) - u * w_row) * width)
        down += np.square((_dot(g[4:7], dr) - v * w_row) * height)
        footprint = np.sqrt(np.maximum(across, down))
        u += g[3]
        v += g[7]
        levels = self._bank.sample(layer.texture.take(patch), u, v, footprint)
        levels *= light_at(layer, patch, u, v)
        return levels

    def _borders(self, hits: _Hits, levels: Float32) -> IntArray:
        """Pixels beside one of another surface and colour, as indices into the valid ones."""
        first, second = self._pairs
        label = hits.patch * np.int32(16) + hits.layer
        change = np.flatnonzero(label[first] != label[second])
        first, second = first[change], second[change]
        contrast = np.abs(levels[:, first] - levels[:, second]).sum(axis=0)
        strong = contrast > np.float32(_EDGE_CONTRAST)
        mark = np.zeros(len(label), dtype=np.bool_)
        mark[first[strong]] = True
        mark[second[strong]] = True
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


def _pixel_rays(camera: OmniCamera) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """Rays (h * w, 3) of all pixels and their derivatives by central differences of half a pixel.

    Where a neighbour is out of the field, the other side's difference stands in.
    """
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    centre = camera.rays(pixels)
    steps = []
    for step in (np.array([0.5, 0.0]), np.array([0.0, 0.5])):
        after, before = camera.rays(pixels + step), camera.rays(pixels - step)
        both = after - before
        one = 2.0 * np.where(np.isnan(after), centre - before, after - centre)
        steps.append(np.nan_to_num(np.where(np.isnan(both), one, both)))
    return centre, (steps[0], steps[1])


def _neighbours(valid: IntArray, shape: tuple[int, int]) -> tuple[IntArray, IntArray]:
    """Pairs of valid pixels beside and below each other, as indices into the valid ones."""
    place = np.full(shape, -1, dtype=np.int64)
    place.ravel()[valid] = np.arange(len(valid))
    first = np.concatenate([place[:, :-1].ravel(), place[:-1].ravel()])
    second = np.concatenate([place[:, 1:].ravel(), place[1:].ravel()])
    both = (first >= 0) & (second >= 0)
    return first[both], second[both]


def _turned(pose: FloatArray, directions: Float32) -> Float32:
    """(n, 3) directions in the scene's axes of (3, n) in the camera's."""
    return np.asarray((pose[:3, :3].astype(np.float32) @ directions).T)


def _towards(body: Body, pose: FloatArray, level: Float32, distance: Float32) -> IntArray:
    """Rays that may meet a body: by their bearing, and as nothing nearer is before it.

    ``level`` (2, n) are the rays' horizontal unit directions in the camera's axes. The camera's
    tilt, a few degrees, is allowed for by a margin.
    """
    offset = (body.wTo[:3, 3] - pose[:3, 3])[:2]
    far = float(np.hypot(*offset))
    if far <= body.radius + 0.1:
        return np.arange(len(distance))
    forward = float(np.arctan2(pose[1, 0], pose[0, 0]))
    middle = float(np.arctan2(offset[1], offset[0])) - forward
    half = np.arcsin(body.radius / far) + _TILT_MARGIN
    x, y, least = np.array([np.cos(middle), np.sin(middle), np.cos(half)], dtype=np.float32)
    nearest = np.float32(far - body.radius)
    return np.flatnonzero((level[0] * x + level[1] * y > least) & (distance > nearest))


def _dot(a: Float32, b: Float32) -> Float32:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
