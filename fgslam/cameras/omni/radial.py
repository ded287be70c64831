"""What all cameras with a mirror or lens of revolution share: elevation depends on radius alone.

The picture of a mirror above an upward-looking camera is seen *from below*: bearings run clockwise
in it, and what is left of the robot lies right of what is ahead, if ahead is up in the picture.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from fgslam.cameras.omni.bearing_measurement import unit_rays
from fgslam.cameras.omni.image_bounds import inside, require_size
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError

# Relative: what a round trip may lose at the very rim.
_RIM = 1e-9
AHEAD_IS_UP = -np.pi / 2


@dataclass(frozen=True, slots=True)
class MirrorFrame:
    """How polar coordinates around the mirror's centre lie in the picture.

    Attributes:
        width, height: of the picture, pixels.
        centre: column and row of the mirror's axis.
        ahead: direction in the picture of the robot's heading: ``atan2(row, column)`` from the
            centre, so 0 is right and -pi/2, the default, is up. This is where a camera that is
            turned on its axis is corrected.
        clockwise: whether bearings grow clockwise in the picture. True for the raw picture of an
            upward-looking camera; False where it was mirrored, or the camera looks down.
        affine: (c, d, e) of OCamCalib, for sensors that are skew or have oblong pixels: a point at
            (x, y) rows and columns from the centre is seen at (c x + d y, e x + y).
    """

    width: int
    height: int
    centre: tuple[float, float]
    ahead: float = AHEAD_IS_UP
    clockwise: bool = True
    affine: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        require_size("mirror image", self.width, self.height)
        column, row = self.centre
        if not (-0.5 <= column <= self.width - 0.5 and -0.5 <= row <= self.height - 0.5):
            raise CalibrationError(
                f"mirror image: the mirror's centre ({column:g}, {row:g}) lies outside the "
                f"{self.width}x{self.height} picture; correct the centre or the size"
            )
        c, d, e = self.affine
        if not (np.isfinite([self.ahead, c, d, e]).all() and c - d * e > 0.0):
            raise CalibrationError(
                f"mirror image: ahead {self.ahead:g} and affine ({c:g}, {d:g}, {e:g}) must be "
                "finite, with c - d e > 0"
            )

    def polar(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Radius in pixels (n,) and bearing in radians (n,) of pixels (n, 2)."""
        across, down = pixels[:, 0] - self.centre[0], pixels[:, 1] - self.centre[1]
        c, d, e = self.affine
        determinant = c - d * e
        x, y = (down - d * across) / determinant, (c * across - e * down) / determinant
        angle = np.arctan2(x, y) - self.ahead
        return np.hypot(x, y), angle if self.clockwise else -angle

    def pixels(self, radius: FloatArray, bearing: FloatArray) -> FloatArray:
        """(n, 2) pixels of polar coordinates (n,) each, also where they leave the picture."""
        angle = (bearing if self.clockwise else -bearing) + self.ahead
        x, y = radius * np.sin(angle), radius * np.cos(angle)
        c, d, e = self.affine
        return np.column_stack(
            [self.centre[0] + e * x + y, self.centre[1] + c * x + d * y],
        )


@dataclass(frozen=True)
class RadialCamera(ABC):
    """A camera whose elevation is a function of the radius alone.

    Attributes:
        frame: where in the picture.
        inner_radius, outer_radius: the ring that shows the surroundings, pixels; nothing is seen
            inside (the camera sees itself there) or outside.
    """

    frame: MirrorFrame
    inner_radius: float
    outer_radius: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.inner_radius < self.outer_radius < np.inf:
            raise CalibrationError(
                f"mirror image: radii from {self.inner_radius:g} to {self.outer_radius:g} px; they "
                "must rise from 0 or more"
            )

    @abstractmethod
    def elevation(self, radius: FloatArray) -> FloatArray:
        """(n,) elevations in radians of radii (n,) in pixels within the ring."""

    @abstractmethod
    def radius(self, elevation: FloatArray) -> FloatArray:
        """(n,) radii of elevations (n,); NaN or outside the ring where they are not seen."""

    @property
    def width(self) -> int:
        """Of the image, in pixels."""
        return self.frame.width

    @property
    def height(self) -> int:
        """Of the image, in pixels."""
        return self.frame.height

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit rays; see :class:`fgslam.cameras.omni.protocol.OmniCamera`."""
        pixels = inside(np.asarray(pixels, dtype=np.float64), self.width, self.height)
        radius, bearing = self.frame.polar(pixels)
        elevation = self.elevation(self._within(radius))
        return unit_rays(bearing, elevation)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`fgslam.cameras.omni.protocol.OmniCamera`."""
        rays = np.asarray(rays, dtype=np.float64)
        elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
        bearing = np.arctan2(rays[:, 1], rays[:, 0])
        radius = self._within(self.radius(elevation))
        return inside(self.frame.pixels(radius, bearing), self.width, self.height)

    def _within(self, radius: FloatArray) -> FloatArray:
        seen = (radius >= self.inner_radius * (1.0 - _RIM)) & (
            radius <= self.outer_radius * (1.0 + _RIM)
        )
        return np.where(seen, radius, np.nan)
