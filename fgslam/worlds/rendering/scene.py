"""What a renderer draws: patches with their textures and light, standing or moving.

Light is baked into the scene: lamps with soft shadows, and sky light dimmed in corners. Diffuse
light does not depend on where the camera is, so a surface looks the same from everywhere, as
landmarks must.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.worlds.rendering.patches import PatchArrays, RayCaster
from fgslam.worlds.rendering.texture_bank import TextureBank

Float32 = npt.NDArray[np.float32]

LIGHT_SPACING_M = 0.09
_MAX_CELLS = 120
_AMBIENT = 0.42
_CORNER_REACH_M = 0.7
_CORNER_RAYS = 24
_LAMP_SAMPLES = 3
_LAMP_POWER = 3.6
# Light is measured this far before a surface: a poster must not darken the wall it hangs on.
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
    columns = _grid_size(np.linalg.norm(patches.edge_u, axis=1), spacing_m)
    rows = _grid_size(np.linalg.norm(patches.edge_v, axis=1), spacing_m)
    count = columns * rows
    offset = np.concatenate([[0], np.cumsum(count)[:-1]])
    patch = np.repeat(np.arange(len(patches)), count)
    points = _grid_points(patches, columns, patch, offset, rows)
    normals = patches.normal[patch]
    light = _AMBIENT * _openness(caster, points, normals, rng)
    if reach_m is None:
        light += _lamp_light(caster, points, normals, lamps, rng)
    else:
        light += _lamp_light_within(reach_m, caster, points, normals, lamps, rng)
    glow = np.array([surface.glow for surface in patches.surfaces])[patch]
    values = np.where(glow > 0.0, glow, light)
    return LightMaps(values.astype(np.float32), offset, columns, rows)


def _grid_size(metres: FloatArray, spacing_m: float) -> IntArray:
    return np.clip(np.ceil(metres / spacing_m).astype(np.int64) + 1, 2, _MAX_CELLS)


def _grid_points(
    patches: PatchArrays, columns: IntArray, patch: IntArray, offset: IntArray, rows: IntArray
) -> FloatArray:
    """Points just before the patches' surfaces, drawn in from their edges."""
    place = np.arange(len(patch)) - offset[patch]
    s = (place % columns[patch]) / (columns[patch] - 1.0)
    t = (place // columns[patch]) / (rows[patch] - 1.0)
    s, t = 0.02 + 0.96 * s, 0.02 + 0.96 * t
    on_patch = patches.corner[patch]
    on_patch = on_patch + s[:, None] * patches.edge_u[patch] + t[:, None] * patches.edge_v[patch]
    return np.asarray(on_patch + _LIFT_M * patches.normal[patch])


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
) -> FloatArray:
    """(n,) light of all lamps; each is sampled at a few points, which softens its shadows."""
    light = np.zeros(len(points))
    for lamp in lamps:
        samples = rng.random((_LAMP_SAMPLES, 2))
        _add_light(light, lamp, samples, caster, (points, normals))
    return np.asarray(light * (_LAMP_POWER / _LAMP_SAMPLES))


def _lamp_light_within(
    reach_m: float,
    caster: RayCaster,
    points: FloatArray,
    normals: FloatArray,
    lamps: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """(n,) light of all lamps on what is less than ``reach_m`` from the middle of each.

    All are sampled at the same points of their surfaces: lamps that are alike shine alike.
    """
    light = np.zeros(len(points))
    samples = rng.random((_LAMP_SAMPLES, 2))
    for lamp in lamps:
        middle = lamp[0] + 0.5 * (lamp[1] + lamp[2])
        far2 = np.sum(np.square(points - middle), axis=1)
        near = np.flatnonzero(far2 < reach_m**2)
        window = np.square(1.0 - far2[near] / reach_m**2)
        here = np.zeros(len(near))
        _add_light(here, lamp, samples, caster, (points[near], normals[near]))
        light[near] += window * here
    return np.asarray(light * (_LAMP_POWER / _LAMP_SAMPLES))


def _add_light(
    light: FloatArray,
    lamp: FloatArray,
    samples: FloatArray,
    caster: RayCaster,
    surface: tuple[FloatArray, FloatArray],
) -> None:
    """Adds one lamp's light, not yet scaled, from samples (k, 2) of it, to points and normals."""
    points, normals = surface
    for s, t in samples:
        offset = lamp[0] + s * lamp[1] + t * lamp[2] - points
        far2 = np.sum(offset * offset, axis=1)
        towards = offset / np.sqrt(far2)[:, None]
        facing = np.sum(normals * towards, axis=1) * np.maximum(towards[:, 2], 0.0)
        lit = facing > 1e-3
        lit[lit] = ~caster.blocked(points[lit], offset[lit], 0.995)
        light[lit] += facing[lit] / (1.0 + far2[lit])


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
