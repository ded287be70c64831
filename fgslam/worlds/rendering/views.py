"""How cameras look at a scene: the rays of their pixels, and how those change within a pixel.

A ray ``d`` has three coordinates. Shading needs of it the products ``g . d`` with a plane's
coefficients and their derivatives by column and row (``along`` and its companions).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.cameras.omni.camera import OmniCamera
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.worlds.rendering.scene import Body

Float32 = npt.NDArray[np.float32]

_TILT_MARGIN = 0.1


# --------------------------------------------------------------------------------------------
# Pinhole


@dataclass(frozen=True, slots=True, eq=False)
class PixelRays:
    """Rays (column, row, 1) of pixels (n, 2); ``matrix`` (3, 3) takes them to unit depth."""

    pixels: Float32
    matrix: FloatArray

    def along(self, g: Float32) -> Float32:
        """(n,) products with coefficients (3, n)."""
        column, row = self.pixels[:, 0], self.pixels[:, 1]
        return np.asarray(g[0] * column + g[1] * row + g[2])

    def by_column(self, g: Float32) -> Float32:
        """(n,) derivative by the column."""
        return np.asarray(g[0])

    def by_row(self, g: Float32) -> Float32:
        """(n,) derivative by the row."""
        return np.asarray(g[1])

    def shifted(self, chosen: IntArray, column: float, row: float) -> PixelRays:
        """Some of the rays, moved within their pixels."""
        shift = np.array([column, row], dtype=np.float32)
        return PixelRays(self.pixels[chosen] + shift, self.matrix)

    def directions(self, pose: FloatArray) -> Float32:
        """(n, 3) of unit depth."""
        matrix = (pose[:3, :3] @ self.matrix).astype(np.float32)
        return np.asarray(self.pixels @ matrix[:, :2].T + matrix[:, 2])

    def towards(self, body: Body, pose: FloatArray, distance: Float32) -> IntArray:
        """All: the field of view is narrow."""
        return np.arange(len(distance))


# --------------------------------------------------------------------------------------------
# Omnidirectional


@dataclass(frozen=True, slots=True, eq=False)
class OmniRays:
    """Unit viewing directions (3, n), their derivatives, and their level parts (2, n) as units."""

    direction: Float32
    column: Float32
    row: Float32
    level: Float32

    def along(self, g: Float32) -> Float32:
        """(n,) products with coefficients (3, n)."""
        return _dot(g, self.direction)

    def by_column(self, g: Float32) -> Float32:
        """(n,) derivative by the column."""
        return _dot(g, self.column)

    def by_row(self, g: Float32) -> Float32:
        """(n,) derivative by the row."""
        return _dot(g, self.row)

    def shifted(self, chosen: IntArray, column: float, row: float) -> OmniRays:
        """Some of the rays, moved within their pixels to first order."""
        d, level = self.direction.take(chosen, axis=1), self.level[:, chosen]
        dc, dr = self.column.take(chosen, axis=1), self.row.take(chosen, axis=1)
        return OmniRays(d + np.float32(column) * dc + np.float32(row) * dr, dc, dr, level)

    def directions(self, pose: FloatArray) -> Float32:
        """(n, 3) of unit length."""
        return np.asarray((pose[:3, :3].astype(np.float32) @ self.direction).T)

    def towards(self, body: Body, pose: FloatArray, distance: Float32) -> IntArray:
        """Rays that may meet a body: by their bearing, and as nothing nearer is before it.

        The camera's tilt, a few degrees, is allowed for by a margin.
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
        return np.flatnonzero(
            (self.level[0] * x + self.level[1] * y > least) & (distance > nearest)
        )


# --------------------------------------------------------------------------------------------
# Cameras as the renderer sees them


Rays: TypeAlias = PixelRays | OmniRays
"""Rays of n pixels, in single precision."""


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
    seen = PixelRays(exact[:, :2].astype(np.float32), matrix)
    return View(shape, np.arange(rows.size), exact, matrix, seen)


def omni_view(camera: OmniCamera) -> View:
    """Any camera with a single viewpoint, axes x forward, y left, z up; distances are ranges."""
    rays, steps = _pixel_rays(camera)
    valid = np.flatnonzero(np.isfinite(rays[:, 0]))
    direction, column, row = (np.ascontiguousarray(a[valid].T, np.float32) for a in (rays, *steps))
    level = direction[:2]
    level = level / np.maximum(np.linalg.norm(level, axis=0), np.float32(1e-9))
    seen = OmniRays(direction, column, row, level)
    return View((camera.height, camera.width), valid, rays[valid], np.eye(3), seen)


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


def _dot(a: Float32, b: Float32) -> Float32:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
