"""What a renderer draws: patches with their textures and light, standing or moving."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray
from fgslam.worlds.rendering.lighting import LightMaps
from fgslam.worlds.rendering.patches import PatchArrays
from fgslam.worlds.rendering.raycaster import RayCaster
from fgslam.worlds.rendering.texture_bank import TextureBank

Float32 = npt.NDArray[np.float32]
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
