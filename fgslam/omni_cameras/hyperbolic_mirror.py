"""A hyperbolic mirror above an upward camera: the paper's sensor, as a unified sphere (design B7).

The mirror's reflection towards its focus, seen by a pinhole in the other focus, equals a projection
over the unit sphere from a point ``xi`` above its centre. With elevation alpha (up positive) the
image radius is

    r = focal * cos(alpha) / (xi - sin(alpha)),

for every alpha below asin(xi): below the horizon and above it. For semi-axes a, b of the
hyperboloid with c = sqrt(a^2 + b^2) and e = c / a, and a pinhole of focal length f,

    xi = 2 e / (1 + e^2),    focal = f (e^2 - 1) / (e^2 + 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.errors import CalibrationError
from fgslam.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class HyperbolicMirror:
    """Unified-sphere model of a central catadioptric camera, axis vertical.

    Attributes:
        width, height: of the image, pixels.
        centre_x, centre_y: image of the mirror's axis, pixels.
        focal: the unified model's focal length, pixels.
        xi: the mirror's parameter; below 1 for a hyperboloid, 1 for a paraboloid.
        inner_radius, outer_radius: what the mirror shows, pixels; the camera sees itself inside.
        forward: bearing (radians) that points up in the image.
        mirrored: True where bearings run clockwise in the image, as for a camera that looks *up*
            into the mirror; False where the image was flipped, or the camera looks down.
    """

    width: int
    height: int
    centre_x: float
    centre_y: float
    focal: float
    xi: float
    inner_radius: float
    outer_radius: float
    forward: float = 0.0
    mirrored: bool = True

    def __post_init__(self) -> None:
        numbers = (self.centre_x, self.centre_y, self.focal, self.xi, self.forward)
        if not np.all(np.isfinite(numbers)) or self.focal <= 0.0 or not 0.0 < self.xi <= 1.0:
            raise CalibrationError(
                f"mirror: focal {self.focal:g}, xi {self.xi:g}; need a positive focal length in "
                "pixels and 0 < xi <= 1"
            )
        if not 0.0 <= self.inner_radius < self.outer_radius < np.inf:
            raise CalibrationError(
                f"mirror: radii {self.inner_radius:g} to {self.outer_radius:g} px; they must rise"
            )
        inside = 0.0 <= self.centre_x < self.width and 0.0 <= self.centre_y < self.height
        if not inside:
            raise CalibrationError(
                f"mirror: centre ({self.centre_x:g}, {self.centre_y:g}) lies outside the picture "
                f"of {self.width}x{self.height} pixels; mend centre_x and centre_y"
            )

    def elevation(self, radius: FloatArray) -> FloatArray:
        """Elevation in radians at image radii in pixels, any shape; the inverse in design B7."""
        scaled = np.asarray(radius, dtype=np.float64) / self.focal
        eta = (self.xi + np.sqrt(1.0 + (1.0 - self.xi**2) * scaled**2)) / (1.0 + scaled**2)
        return np.asarray(np.arctan2(self.xi - eta, eta * scaled))

    def radius(self, elevation: FloatArray) -> FloatArray:
        """Image radius in pixels at elevations in radians; infinite where the mirror ends."""
        elevation = np.asarray(elevation, dtype=np.float64)
        below = self.xi - np.sin(elevation)
        with np.errstate(divide="ignore"):
            radius = self.focal * np.cos(elevation) / np.maximum(below, 0.0)
        return np.asarray(radius)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit rays; see :class:`fgslam.omni_cameras.protocol.OmniCamera`."""
        pixels = np.asarray(pixels, dtype=np.float64)
        right, up = pixels[:, 0] - self.centre_x, self.centre_y - pixels[:, 1]
        radius = np.hypot(right, up)
        bearing = self.forward + self._turn() * np.arctan2(right, up)
        elevation = self.elevation(radius)
        level = np.cos(elevation)
        rays = np.column_stack(
            [level * np.cos(bearing), level * np.sin(bearing), np.sin(elevation)]
        )
        return np.where(self._shown(radius, pixels)[:, None], rays, np.nan)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`fgslam.omni_cameras.protocol.OmniCamera`."""
        rays = np.asarray(rays, dtype=np.float64)
        level = np.hypot(rays[:, 0], rays[:, 1])
        length = np.hypot(level, rays[:, 2])
        below = self.xi * length - rays[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            radius = self.focal * level / np.where(below > 0.0, below, np.nan)
        turn = self._turn() * (np.arctan2(rays[:, 1], rays[:, 0]) - self.forward)
        pixels = np.column_stack(
            [self.centre_x + radius * np.sin(turn), self.centre_y - radius * np.cos(turn)]
        )
        return np.where(self._shown(radius, pixels)[:, None], pixels, np.nan)

    def _turn(self) -> float:
        return 1.0 if self.mirrored else -1.0

    def _shown(self, radius: FloatArray, pixels: FloatArray) -> BoolArray:
        c, r = pixels[:, 0], pixels[:, 1]
        inside = (c > -0.5) & (c < self.width - 0.5) & (r > -0.5) & (r < self.height - 0.5)
        return np.asarray(
            inside & (radius >= self.inner_radius) & (radius <= self.outer_radius), dtype=np.bool_
        )


def unified_parameters(a: float, b: float, pinhole_focal: float) -> tuple[float, float]:
    """(xi, focal) of a hyperboloid with semi-axes a (along the axis) and b, seen by a pinhole.

    Raises:
        CalibrationError: a number is not positive.
    """
    if min(a, b, pinhole_focal) <= 0.0:
        raise CalibrationError(
            f"mirror: semi-axes {a:g} and {b:g}, focal length {pinhole_focal:g}; all must be "
            "positive"
        )
    eccentricity = np.hypot(a, b) / a
    squared = eccentricity**2
    xi = 2.0 * eccentricity / (1.0 + squared)
    return float(xi), float(pinhole_focal * (squared - 1.0) / (squared + 1.0))


def mirror_seeing(
    width: int, height: int, xi: float, highest_elevation: float, inner_radius: float = 0.0
) -> HyperbolicMirror:
    """A centred mirror that fills the picture's height and shows elevations up to the given one.

    Args:
        width: of the picture, pixels.
        height: likewise.
        xi: the mirror's parameter.
        highest_elevation: at the outer rim, radians; below asin(xi).
        inner_radius: pixels.

    Raises:
        CalibrationError: the mirror cannot see that high.
    """
    if not np.sin(highest_elevation) < xi:
        raise CalibrationError(
            f"mirror: xi {xi:g} does not show elevation {np.rad2deg(highest_elevation):g} deg; its "
            f"limit is {np.rad2deg(np.arcsin(min(xi, 1.0))):g} deg"
        )
    outer = 0.5 * min(width, height) - 1.0
    focal = outer * (xi - np.sin(highest_elevation)) / np.cos(highest_elevation)
    centre_x, centre_y = 0.5 * (width - 1), 0.5 * (height - 1)
    return HyperbolicMirror(
        width, height, centre_x, centre_y, float(focal), xi, inner_radius, outer
    )
