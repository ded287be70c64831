"""The hyperbolic mirror as a unified sphere, above and below the horizon.

A ray is moved to the unit sphere around the mirror's focus and projected from a point ``xi`` above
it: ``radius = focal cos(elevation) / (xi - sin(elevation))``. GTSAM's Cal3Unified divides by the
ray's third coordinate first, and so covers only what lies below the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.cameras.omni.radial import AHEAD_IS_UP, MirrorFrame, RadialCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError


@dataclass(frozen=True)
class HyperbolicMirror(RadialCamera):
    """A hyperbolic (xi < 1) or parabolic (xi = 1) mirror above an upward-looking camera.

    Attributes:
        xi: ``2 e / (1 + e^2)`` of the hyperbola's eccentricity e.
        focal_px: of the unified model; the horizon has the radius ``focal_px / xi``.
    """

    xi: float
    focal_px: float

    def __post_init__(self) -> None:
        RadialCamera.__post_init__(self)
        if not (0.0 < self.xi <= 1.0 and 0.0 < self.focal_px < np.inf):
            raise CalibrationError(
                f"hyperbolic mirror: xi {self.xi:g} must lie in (0, 1] and focal_px "
                f"{self.focal_px:g} be positive; correct them"
            )

    @classmethod
    def from_semi_axes(
        cls,
        frame: MirrorFrame,
        radii: tuple[float, float],
        semi_axes: tuple[float, float],
        camera_focal_px: float,
    ) -> HyperbolicMirror:
        """A mirror ``z'^2 / a^2 - r^2 / b^2 = 1`` whose second focus holds a pinhole camera.

        Args:
            frame: where the mirror lies in the picture.
            radii: inner and outer, pixels.
            semi_axes: a (along the axis) and b, in any one unit.
            camera_focal_px: focal length of the camera itself, pixels.
        """
        a, b = semi_axes
        if not (0.0 < a < np.inf and 0.0 < b < np.inf):
            raise CalibrationError(f"hyperbolic mirror: semi-axes {a:g} and {b:g}; give positive")
        both = 2.0 * a * a + b * b
        xi = 2.0 * a * float(np.hypot(a, b)) / both
        return cls(frame, *radii, xi=xi, focal_px=camera_focal_px * b * b / both)

    @classmethod
    def with_view(
        cls,
        size: tuple[int, int],
        xi: float,
        elevations: tuple[float, float],
        ahead: float = AHEAD_IS_UP,
        clockwise: bool = True,
        margin_px: float = 0.0,
    ) -> HyperbolicMirror:
        """A mirror centred in a picture (width, height), whose rim touches the nearest border.

        ``elevations`` in radians are those at the inner and at the outer rim; ``margin_px`` is left
        free around the rim.
        """
        lowest, highest = elevations
        limit = np.arcsin(min(max(xi, 0.0), 1.0))
        if not -np.pi / 2 <= lowest < highest < limit:
            raise CalibrationError(
                f"hyperbolic mirror: elevations from {np.degrees(lowest):g} to "
                f"{np.degrees(highest):g} degrees; they must rise from -90 or more, and stay "
                f"below arcsin(xi) = {np.degrees(limit):.1f}"
            )
        outer = (min(size) - 1) / 2.0 - margin_px
        focal_px = outer * (xi - np.sin(highest)) / np.cos(highest)
        inner = focal_px * np.cos(lowest) / (xi - np.sin(lowest))
        centre = ((size[0] - 1) / 2.0, (size[1] - 1) / 2.0)
        frame = MirrorFrame(*size, centre, ahead, clockwise)
        return cls(frame, float(inner), outer, xi=xi, focal_px=float(focal_px))

    def elevation(self, radius: FloatArray) -> FloatArray:
        """(n,) elevations; see :class:`RadialCamera`."""
        r = np.asarray(radius, dtype=np.float64) / self.focal_px
        eta = (self.xi + np.sqrt(1.0 + (1.0 - self.xi**2) * r**2)) / (1.0 + r**2)
        return np.asarray(np.arctan2(self.xi - eta, eta * r))

    def radius(self, elevation: FloatArray) -> FloatArray:
        """(n,) radii; see :class:`RadialCamera`."""
        below = self.xi - np.sin(elevation)
        with np.errstate(divide="ignore", invalid="ignore"):
            r = self.focal_px * np.cos(elevation) / below
        return np.where(below > 0.0, r, np.nan)
