"""Images of patch scenes through any camera, in any number of channels, and exact truth.

One ray a pixel. With ``d`` the pixel's ray and ``d_c``, ``d_r`` its derivatives by column and row,
all that shading needs of a plane is a ratio of functions linear in ``d``: the distance is
``1 / (g_w . d)`` and a texture coordinate ``(g_u . d) / (g_w . d) + c_u``. The derivatives of that
ratio along ``d_c`` and ``d_r`` are the pixel's footprint on the texture, which trilinear mip-maps
filter over. Pixels at the border of two surfaces are replaced by the mean of four points in them.

Light is baked into the scene: lamps with soft shadows, and sky light dimmed in corners. Diffuse
light does not depend on where the camera is, so a surface appears the same from everywhere, as
landmarks must.
"""

from __future__ import annotations

import copy
import hashlib
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgslam.cameras.lenses import pixel_grid
from fgslam.cameras.omni import OmniCamera
from fgslam.core.arrays import BoolArray, Float32, FloatArray, Image, IntArray
from fgslam.core.errors import DatasetError, OutputError
from fgslam.core.files import cache_root, replacing
from fgslam.worlds.patches import PatchArrays, RayCaster
from fgslam.worlds.settings import LabEffectsSettings
from fgslam.worlds.textures import TextureBank

LIGHT_SPACING_M = 0.09
_MAX_CELLS = 120
_AMBIENT = 0.42
_CORNER_REACH_M = 0.7
_CORNER_RAYS = 24
_LAMP_SAMPLES = 3
_LAMP_POWER = 3.6
# Light is measured this far before a surface: a poster must not darken the wall behind it.
_LIFT_M = 0.015


@dataclass(frozen=True, slots=True, eq=False)
class LightMaps:
    """Irradiance on a grid over every patch, 1 = the brightness at which albedo is seen as it is.

    Attributes:
        values: all grids, one after another, row by row.
        offset: (n,) where each patch's grid begins.
        columns, rows: (n,) its size, each at least 2; corners of the grid are the patch's.
    """

    values: Float32
    offset: IntArray
    columns: IntArray
    rows: IntArray


def flat_light(patches: PatchArrays, towards: FloatArray) -> LightMaps:
    """Light of something that moves: from one direction (3,), without shadows."""
    facing = patches.normal @ (towards / np.linalg.norm(towards))
    values = np.repeat(0.72 + 0.28 * facing, 4).astype(np.float32)
    count = len(patches)
    two = np.full(count, 2, dtype=np.int64)
    return LightMaps(values, 4 * np.arange(count, dtype=np.int64), two, two)


def bake(
    patches: PatchArrays,
    caster: RayCaster,
    lamps: FloatArray,
    rng: np.random.Generator,
    spacing_m: float = LIGHT_SPACING_M,
    reach_m: float | None = None,
) -> LightMaps:
    """Irradiance of all patches.

    Args:
        patches: the scene.
        caster: of the same scene, for the shadows.
        lamps: (k, 3, 3) corner and two edges of each rectangular lamp, shining down, metres.
        rng: for the directions of the sky light and the points on the lamps.
        spacing_m: greatest distance of the grid's points, but for very large patches, metres.
        reach_m: how far a lamp shines, its light fading smoothly to nothing; None for any
            distance. Where walls hide most lamps from most places this saves most of the work.
    """
    columns, rows = (
        np.clip(np.ceil(np.linalg.norm(edge, axis=1) / spacing_m).astype(int) + 1, 2, _MAX_CELLS)
        for edge in (patches.edge_u, patches.edge_v)
    )
    count = columns * rows
    offset = np.concatenate([[0], np.cumsum(count)[:-1]])
    patch = np.repeat(np.arange(len(patches)), count)
    place = np.arange(len(patch)) - offset[patch]
    # Drawn in from the edges, and just before the surface.
    s = 0.02 + 0.96 * ((place % columns[patch]) / (columns[patch] - 1.0))
    t = 0.02 + 0.96 * ((place // columns[patch]) / (rows[patch] - 1.0))
    normals, on_patch = patches.normal[patch], patches.corner[patch]
    on_patch = on_patch + s[:, None] * patches.edge_u[patch] + t[:, None] * patches.edge_v[patch]
    points = on_patch + _LIFT_M * normals
    light = _AMBIENT * _openness(caster, points, normals, rng)
    light += _lamp_light(caster, points, normals, lamps, rng, reach_m)
    glow = np.array([surface.glow for surface in patches.surfaces])[patch]
    values = np.where(glow > 0.0, glow, light)
    return LightMaps(values.astype(np.float32), offset, columns, rows)


def _openness(
    caster: RayCaster, points: FloatArray, normals: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(n,) fraction of a cosine-weighted hemisphere that is free within a short reach."""
    ball = rng.standard_normal((_CORNER_RAYS, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    free = np.zeros(len(points))
    for direction in ball:
        towards = normals + 0.999 * direction
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        free += ~caster.blocked(points, towards, _CORNER_REACH_M)
    return free / _CORNER_RAYS


def _lamp_light(
    caster: RayCaster,
    points: FloatArray,
    normals: FloatArray,
    lamps: FloatArray,
    rng: np.random.Generator,
    reach_m: float | None,
) -> FloatArray:
    """(n,) light of all lamps; each is sampled at a few points, which softens its shadows.

    With a reach all are sampled at the same points of their surfaces: lamps that are alike shine
    alike.
    """
    light = np.zeros(len(points))
    samples = rng.random((_LAMP_SAMPLES, 2)) if reach_m is not None else None
    for corner, edge_u, edge_v in lamps:
        near: slice | IntArray = slice(None)
        total, window = light, None
        if reach_m is not None:
            far2 = np.sum(np.square(points - (corner + 0.5 * (edge_u + edge_v))), axis=1)
            near = np.flatnonzero(far2 < reach_m**2)
            window = np.square(1.0 - far2[near] / reach_m**2)
            total = np.zeros(len(near))
        here, normal = points[near], normals[near]
        for s, t in rng.random((_LAMP_SAMPLES, 2)) if samples is None else samples:
            offset = corner + s * edge_u + t * edge_v - here
            far2 = np.sum(offset * offset, axis=1)
            towards = offset / np.sqrt(far2)[:, None]
            facing = np.sum(normal * towards, axis=1) * np.maximum(towards[:, 2], 0.0)
            lit = facing > 1e-3
            lit[lit] = ~caster.blocked(here[lit], offset[lit], 0.995)
            total[lit] += facing[lit] / (1.0 + far2[lit])
        if window is not None:
            light[near] += window * total
    return np.asarray(light * (_LAMP_POWER / _LAMP_SAMPLES))


# --------------------------------------------------------------------------------------------
# Layers and bodies


Int32 = npt.NDArray[np.int32]


class Layer:
    """A scene ready to be shaded: patches, their textures and light, and a ray caster."""

    def __init__(
        self, patches: PatchArrays, caster: RayCaster, light: LightMaps, bank: TextureBank
    ) -> None:
        self.patches = patches
        self.caster = caster
        self.light = light.values
        self._repeats = _repeats(patches)
        self._texture = bank.indices(tuple(s.texture for s in patches.surfaces))
        self.texture = self._texture.astype(np.int32)
        self.size = np.column_stack([bank.full_width, bank.full_height])[self._texture]
        self.light_offset = light.offset.astype(np.int32)
        self.light_columns = light.columns.astype(np.int32)
        cells = np.column_stack([light.columns, light.rows]) - 1.0
        self.light_scale = (cells / self._repeats).astype(np.float32)
        self.light_last = cells.astype(np.float32)

    def lit(self, light: Float32) -> Layer:
        """The same patches in another light, on the same grids."""
        out = copy.copy(self)
        out.light = light
        return out

    def planes(self, pose: FloatArray, matrix: FloatArray) -> FloatArray:
        """(11, n) of all patches seen from a camera: g_u (3), c_u, g_v (3), c_v, g_w (3).

        For a pixel's ray ``d`` the hit lies at ``1 / (g_w . d)`` times the ray, at the texture
        coordinates ``(g_u . d) / (g_w . d) + c_u`` and likewise v.

        Args:
            pose: (4, 4) camera in the scene.
            matrix: (3, 3) from the rays' coordinates to the camera's axes.
        """
        p = self.patches
        rays = pose[:3, :3] @ matrix
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

    def light_at(self, patch: Int32, u: Float32, v: Float32) -> Float32:
        """Bilinear light (n,) on patches (n,) at texture coordinates."""
        scale, last = self.light_scale, self.light_last
        x = np.clip(u * scale[:, 0].take(patch), 0.0, last[:, 0].take(patch) - np.float32(1e-3))
        y = np.clip(v * scale[:, 1].take(patch), 0.0, last[:, 1].take(patch) - np.float32(1e-3))
        x0, y0 = x.astype(np.int32), y.astype(np.int32)
        fx, fy = x - x0, y - y0
        columns = self.light_columns.take(patch)
        at = self.light_offset.take(patch) + y0 * columns + x0
        upper = self.light.take(at) * (1 - fx) + self.light.take(at + 1) * fx
        below = at + columns
        lower = self.light.take(below) * (1 - fx) + self.light.take(below + 1) * fx
        return np.asarray(upper * (1 - fy) + lower * fy)


def _repeats(patches: PatchArrays) -> FloatArray:
    """(n, 2) copies of the texture along the edges."""
    tile = np.array([s.tile_m or 0.0 for s in patches.surfaces])
    out = np.ones((len(patches), 2))
    tiled = tile > 0.0
    out[tiled, 0] = np.linalg.norm(patches.edge_u[tiled], axis=1) / tile[tiled]
    out[tiled, 1] = np.linalg.norm(patches.edge_v[tiled], axis=1) / tile[tiled]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A moving object at its present pose.

    Attributes:
        layer: its patches in its own frame.
        wTo: (4, 4) pose of that frame in the scene.
        radius: of an upright cylinder about the frame's z axis that holds it, metres.
    """

    layer: Layer
    wTo: FloatArray
    radius: float


# --------------------------------------------------------------------------------------------
# Cameras as the renderer sees them


_TILT_MARGIN = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Rays of n pixels in single precision, and how they change within a pixel.

    Shading needs of a ray its products ``g . d`` with a plane's coefficients and their derivatives
    by column and row.

    Attributes:
        direction: (3, n) viewing directions.
        column, row: (3, n), or (3, 1) where all are the same: their derivatives.
        level: (2, n) their level parts as units; None for a narrow field of view.
    """

    direction: Float32
    column: Float32
    row: Float32
    level: Float32 | None

    def shifted(self, chosen: IntArray, column: float, row: float) -> Rays:
        """Some of the rays, moved within their pixels to first order."""
        level = None if self.level is None else self.level[:, chosen]
        dc, dr = (d if d.shape[1] == 1 else d.take(chosen, axis=1) for d in (self.column, self.row))
        d = self.direction.take(chosen, axis=1)
        return Rays(d + np.float32(column) * dc + np.float32(row) * dr, dc, dr, level)

    def towards(self, body: Body, pose: FloatArray, distance: Float32) -> IntArray:
        """Rays that may meet a body: by their bearing, and as nothing nearer is before it.

        The camera's tilt, a few degrees, is allowed for by a margin.
        """
        offset = (body.wTo[:3, 3] - pose[:3, 3])[:2]
        far = float(np.hypot(*offset))
        if self.level is None or far <= body.radius + 0.1:
            return np.arange(len(distance))
        forward = float(np.arctan2(pose[1, 0], pose[0, 0]))
        middle = float(np.arctan2(offset[1], offset[0])) - forward
        half = np.arcsin(body.radius / far) + _TILT_MARGIN
        x, y, least = np.array([np.cos(middle), np.sin(middle), np.cos(half)], dtype=np.float32)
        nearest = np.float32(far - body.radius)
        return np.flatnonzero(
            (self.level[0] * x + self.level[1] * y > least) & (distance > nearest)
        )


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera as the renderer sees it.

    Attributes:
        shape: rows and columns.
        valid: (n,) flat indices of the pixels in its field of view, ascending.
        exact: (n, 3) their rays in double precision.
        matrix: (3, 3) from the rays' coordinates to the camera's axes.
        rays: the same rays as they are shaded.
    """

    shape: tuple[int, int]
    valid: IntArray
    exact: FloatArray
    matrix: FloatArray
    rays: Rays


def pinhole_view(shape: tuple[int, int], focal: float, cx: float, cy: float) -> View:
    """A pinhole camera, axes x right, y down, z forward; distances along its rays are depths Z.

    ``shape`` is rows and columns; focal length and principal point are in pixels.
    """
    columns, rows = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    exact = np.column_stack([columns.ravel(), rows.ravel(), np.ones(rows.size)]).astype(np.float64)
    matrix = np.array([[1 / focal, 0, -cx / focal], [0, 1 / focal, -cy / focal], [0, 0, 1.0]])
    right, down = np.eye(3, dtype=np.float32)[:2, :, None]
    seen = Rays(np.ascontiguousarray(exact.T, np.float32), right, down, None)
    return View(shape, np.arange(rows.size), exact, matrix, seen)


def omni_view(camera: OmniCamera) -> View:
    """Any camera with a single viewpoint, axes x forward, y left, z up; distances are ranges."""
    pixels = pixel_grid((camera.width, camera.height))
    rays = camera.rays(pixels)
    steps = []  # central differences of half a pixel, one-sided at the border of the field
    for step in (np.array([0.5, 0.0]), np.array([0.0, 0.5])):
        after, before = camera.rays(pixels + step), camera.rays(pixels - step)
        both = after - before
        one = 2.0 * np.where(np.isnan(after), rays - before, after - rays)
        steps.append(np.nan_to_num(np.where(np.isnan(both), one, both)))
    valid = np.flatnonzero(np.isfinite(rays[:, 0]))
    direction, column, row = (np.ascontiguousarray(a[valid].T, np.float32) for a in (rays, *steps))
    level = direction[:2]
    level = level / np.maximum(np.linalg.norm(level, axis=0), np.float32(1e-9))
    seen = Rays(direction, column, row, level)
    return View((camera.height, camera.width), valid, rays[valid], np.eye(3), seen)


def _dot(a: Float32, b: Float32) -> Float32:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


# --------------------------------------------------------------------------------------------
# Rendering


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
        patch, distance = scene.caster.cast(pose[:3, 3], self._directions(rays, pose))
        layer = np.where(patch >= 0, np.int32(0), _NOTHING)
        for k, body in enumerate(bodies, start=1):
            chosen = rays.towards(body, pose, distance)
            if len(chosen) == 0:
                continue
            other, seen = layers[k]
            directions = self._directions(rays.shifted(chosen, 0.0, 0.0), seen)
            other_patch, other_distance = other.caster.cast(seen[:3, 3], directions)
            nearer = other_distance < distance[chosen]
            hit = chosen[nearer]
            layer[hit], patch[hit], distance[hit] = k, other_patch[nearer], other_distance[nearer]
        return _Hits(layer, patch, distance)

    def _directions(self, rays: Rays, pose: FloatArray) -> Float32:
        """(n, 3) in the scene's axes."""
        matrix = (pose[:3, :3] @ self._view.matrix).astype(np.float32)
        return np.asarray((matrix @ rays.direction).T)

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
        inverse = np.maximum(_dot(g_w, rays.direction), np.float32(_LEAST_INVERSE_DISTANCE))
        distance = np.reciprocal(inverse)
        u, v = _dot(g_u, rays.direction) * distance, _dot(g_v, rays.direction) * distance
        width, height = (side.take(patch) * distance for side in layer.size.astype(np.float32).T)
        across, down = (
            np.square((_dot(g_u, change) - u * w_change) * width)
            + np.square((_dot(g_v, change) - v * w_change) * height)
            for change, w_change in ((d, _dot(g_w, d)) for d in (rays.column, rays.row))
        )
        footprint = np.sqrt(np.maximum(across, down))
        u += g[3]
        v += g[7]
        levels = self._bank.sample(layer.texture.take(patch), u, v, footprint)
        levels *= layer.light_at(patch, u, v)
        return levels

    def _borders(self, hits: _Hits, levels: Float32) -> IntArray:
        """Pixels next to one that shows another surface, as indices into the valid ones."""
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
    """Pairs of valid pixels, right and below neighbours, as indices into the valid ones."""
    place = np.full(shape, -1, dtype=np.int64)
    place.ravel()[valid] = np.arange(len(valid))
    first = np.concatenate([place[:, :-1].ravel(), place[:-1].ravel()])
    second = np.concatenate([place[:, 1:].ravel(), place[1:].ravel()])
    both = (first >= 0) & (second >= 0)
    return first[both], second[both]


# --------------------------------------------------------------------------------------------
# Effects of a real camera on rendered images: gain, noise, and a cover before the lens
#
# Each image has its own random generator, so that any can be had alone and always the same.


_COVER_SEED = 7


def noisy(levels: Float32, sigma: float, seed: tuple[int, ...]) -> Float32:
    """Levels with Gaussian noise; the seed names the image, so that it is always the same."""
    if sigma == 0.0:
        return levels
    rng = np.random.Generator(np.random.SFC64(seed))
    noise = rng.standard_normal(levels.shape, dtype=np.float32)
    noise *= np.float32(sigma)
    noise += levels
    return noise


def is_blocked(settings: LabEffectsSettings, index: int) -> bool:
    """Whether the cover is on the cameras in frame ``index``."""
    blocked = settings.blocked_frames
    return blocked is not None and blocked[0] <= index < blocked[1]


def cover(shape: tuple[int, ...]) -> Float32:
    """A dark cloth right before the lens: nearly black, blurred blotches; images (k, h, w)."""
    rng = np.random.default_rng(_COVER_SEED)
    coarse = rng.random((shape[0], 4, 5)).astype(np.float32)
    rows = np.linspace(0, 2.999, shape[1], dtype=np.float32)
    columns = np.linspace(0, 3.999, shape[2], dtype=np.float32)
    r, c = rows.astype(int), columns.astype(int)
    fr, fc = (rows - r)[None, :, None], (columns - c)[None, None, :]
    upper = coarse[:, r][:, :, c] * (1 - fc) + coarse[:, r][:, :, c + 1] * fc
    lower = coarse[:, r + 1][:, :, c] * (1 - fc) + coarse[:, r + 1][:, :, c + 1] * fc
    return np.asarray(6.0 + 9.0 * (upper * (1 - fr) + lower * fr), dtype=np.float32)


def apply_effects(
    clean: Image, settings: LabEffectsSettings, index: int, seed: int
) -> tuple[Image, ...]:
    """Images as the camera delivers them.

    Args:
        clean: (k, h, w) rendered images of one frame.
        settings: the effects; the person is in the render already.
        index: the recording's frame number.
        seed: of the recording; frame and seed together determine the noise.
    """
    if is_blocked(settings, index):
        grey = cover(clean.shape)
    elif settings.noise_grey == 0.0:
        return tuple(clean)
    else:
        grey = clean.astype(np.float32)
    grey = noisy(grey, settings.noise_grey, (seed, index, 0))
    # Adding one half before the cut to integers rounds; it is faster than np.rint and clip.
    grey += np.float32(0.5)
    np.clip(grey, 0.0, 255.0, out=grey)
    return tuple(grey.astype(np.uint8))


# --------------------------------------------------------------------------------------------
# Rendered frames on disk: one uncompressed file a frame with its checksum, written atomically


_MAGIC = b"FGSLAB1\n"
_HEADER = struct.Struct("<8sIIII")


def content_hash(description: Mapping[str, Any]) -> str:
    """SHA-256 of the canonical JSON of a description."""
    text = json.dumps(description, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


class RenderCache:
    """The clean frames of one rendering, each a uint8 array (cameras, height, width)."""

    def __init__(self, digest: str, description: Mapping[str, Any], shape: tuple[int, int, int]):
        """Opens or makes the folder. Raises DatasetError when it cannot be made or written."""
        self.folder = cache_root() / f"lab-{digest[:20]}"
        self._shape = shape
        note = self.folder / "settings.json"
        if not note.exists():
            self._replace(note, json.dumps(description, indent=1, sort_keys=True).encode())

    def path(self, index: int) -> Path:
        """File of one frame."""
        return self.folder / f"frame_{index:06d}.raw"

    def present(self, index: int) -> bool:
        """Whether a file of the right length is there (its checksum is tested on reading)."""
        try:
            return self.path(index).stat().st_size == _HEADER.size + int(np.prod(self._shape))
        except OSError:
            return False

    def read(self, index: int) -> Image | None:
        """Images of one frame, or None where the file is absent, foreign, cut or damaged."""
        try:
            content = self.path(index).read_bytes()
        except OSError:
            return None
        header, pixels = content[: _HEADER.size], content[_HEADER.size :]
        if header != self._header(pixels):
            return None
        return np.frombuffer(pixels, dtype=np.uint8).reshape(self._shape)

    def write(self, index: int, images: Image) -> None:
        """Stores one frame; another process sees the whole of it or nothing.

        Raises:
            DatasetError: the folder cannot be written or the disk is full.
        """
        pixels = np.ascontiguousarray(images).tobytes()
        self._replace(self.path(index), self._header(pixels) + pixels)

    def _header(self, pixels: bytes) -> bytes:
        return _HEADER.pack(_MAGIC, *self._shape, zlib.crc32(pixels))

    def _replace(self, path: Path, content: bytes) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with replacing(path) as partial:
                partial.write_bytes(content)
        except (OSError, OutputError) as error:
            raise DatasetError(
                f"rendered frames cannot be stored in {self.folder}: {error}; set FGSLAM_CACHE to "
                "a folder that can be written"
            ) from error
