"""Unwrapped views: the equirectangular panorama and the cylinder; both are cameras themselves.

Columns run clockwise: the centre column looks forward, the first and the last one both look
backward, so a turn of the robot shifts the picture sideways.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.cameras.omni.camera import inside, require_size, unit_rays
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError

_HALF_TURN = np.pi


def _bearing(columns: FloatArray, width: int) -> FloatArray:
    return _HALF_TURN - columns * (2.0 * _HALF_TURN / (width - 1))


def _column(rays: FloatArray, width: int) -> FloatArray:
    bearing = np.arctan2(rays[:, 1], rays[:, 0])
    return (_HALF_TURN - bearing) * ((width - 1) / (2.0 * _HALF_TURN))


@dataclass(frozen=True, slots=True)
class Equirectangular:
    """Rows proportional to elevation.

    Column u looks to bearing pi - 2 pi u / (width - 1), row v to elevation
    ``top_elevation - v (top_elevation - bottom_elevation) / (height - 1)``; radians.
    """

    width: int
    height: int
    top_elevation: float = np.pi / 2
    bottom_elevation: float = -np.pi / 2

    def __post_init__(self) -> None:
        require_size("equirectangular panorama", self.width, self.height)
        if not -np.pi / 2 <= self.bottom_elevation < self.top_elevation <= np.pi / 2:
            raise CalibrationError(
                f"equirectangular panorama: elevations from {self.bottom_elevation:g} to "
                f"{self.top_elevation:g} rad; they must rise, within a quarter turn of the horizon"
            )

    def _per_row(self) -> float:
        return (self.top_elevation - self.bottom_elevation) / (self.height - 1)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit rays; see :class:`fgslam.cameras.omni.camera.OmniCamera`."""
        pixels = inside(np.asarray(pixels, dtype=np.float64), self.width, self.height)
        bearing = _bearing(pixels[:, 0], self.width)
        elevation = self.top_elevation - pixels[:, 1] * self._per_row()
        return unit_rays(bearing, elevation)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`fgslam.cameras.omni.camera.OmniCamera`."""
        rays = np.asarray(rays, dtype=np.float64)
        elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
        rows = (self.top_elevation - elevation) / self._per_row()
        return inside(np.column_stack([_column(rays, self.width), rows]), self.width, self.height)


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Rows proportional to the tangent of elevation.

    A vertical line then keeps its straightness, and a column segment scales about the horizon's row
    alone when its distance changes. Row v looks along tangent
    ``tan_top - v (tan_top - tan_bottom) / (height - 1)``.
    """

    width: int
    height: int
    tan_bottom: float
    tan_top: float

    def __post_init__(self) -> None:
        require_size("cylinder", self.width, self.height)
        if not -np.inf < self.tan_bottom < self.tan_top < np.inf:
            raise CalibrationError(
                f"cylinder: tangents of elevation from {self.tan_bottom:g} to {self.tan_top:g}; "
                "they must rise"
            )

    def tangents(self, rows: FloatArray) -> FloatArray:
        """Tangents of elevation of rows, any shape."""
        per_row = (self.tan_top - self.tan_bottom) / (self.height - 1)
        return np.asarray(self.tan_top - np.asarray(rows, dtype=np.float64) * per_row)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit rays; see :class:`fgslam.cameras.omni.camera.OmniCamera`."""
        pixels = inside(np.asarray(pixels, dtype=np.float64), self.width, self.height)
        bearing = _bearing(pixels[:, 0], self.width)
        tangent = self.tangents(pixels[:, 1])
        level = 1.0 / np.sqrt(1.0 + tangent**2)
        return np.column_stack([level * np.cos(bearing), level * np.sin(bearing), level * tangent])

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`fgslam.cameras.omni.camera.OmniCamera`."""
        rays = np.asarray(rays, dtype=np.float64)
        per_row = (self.tan_top - self.tan_bottom) / (self.height - 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            tangent = rays[:, 2] / np.hypot(rays[:, 0], rays[:, 1])
        rows = (self.tan_top - tangent) / per_row
        return inside(np.column_stack([_column(rays, self.width), rows]), self.width, self.height)
