"""Cameras with a mirror or lens of revolution: elevation depends on the radius alone.

The picture of a mirror above an upward-looking camera is seen *from below*: bearings run clockwise
in it, and what is left of the robot lies right of what is ahead, if ahead is up in the picture.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.polynomial import polynomial

from fgslam.cameras.omni.camera import inside, require_size, unit_rays
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
        """(n, 3) unit rays; see :class:`fgslam.cameras.omni.camera.OmniCamera`."""
        pixels = inside(np.asarray(pixels, dtype=np.float64), self.width, self.height)
        radius, bearing = self.frame.polar(pixels)
        elevation = self.elevation(self._within(radius))
        return unit_rays(bearing, elevation)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`fgslam.cameras.omni.camera.OmniCamera`."""
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


# --------------------------------------------------------------------------------------------
# Exact inverse of a smooth monotone function: started from a table, ended by Newton's method


ValueAndSlope: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]

_KNOTS = 513
# From a table of 513 knots two steps reach rounding; the others guard uneven functions.
_STEPS = 5


class MonotoneInverse:
    """Solves ``function(x) = y`` for x in an interval over which the function is monotone."""

    def __init__(self, function: ValueAndSlope, lowest: float, highest: float) -> None:
        """Tabulates ``function``, which gives values and slopes, over [lowest, highest]."""
        self._function, self._limits = function, (lowest, highest)
        knots = np.linspace(lowest, highest, _KNOTS)
        values, slopes = function(knots)
        self.monotone = bool(np.all(slopes > 0.0) or np.all(slopes < 0.0))
        self.knots = knots
        self.slopes = slopes
        rising = values[-1] > values[0]
        self._values = values if rising else values[::-1]
        self._starts = knots if rising else knots[::-1]

    def __call__(self, wanted: FloatArray) -> FloatArray:
        """Arguments (n,) of values (n,); NaN where the function does not take them."""
        wanted = np.asarray(wanted, dtype=np.float64)
        slack = 1e-12 * (1.0 + np.abs(self._values[[0, -1]]).max())
        seen = (wanted >= self._values[0] - slack) & (wanted <= self._values[-1] + slack)
        x = np.interp(np.where(seen, wanted, self._values[0]), self._values, self._starts)
        for _ in range(_STEPS):
            value, slope = self._function(x)
            x = np.clip(x - (value - wanted) / slope, *self._limits)
        return np.where(seen, x, np.nan)


@dataclass(frozen=True)
class InvertedCamera(RadialCamera):
    """A camera whose elevation is a smooth function of the radius, inverted numerically.

    Raises:
        CalibrationError: the elevation is not monotone over the ring.
    """

    _inverse: MonotoneInverse = field(init=False, repr=False, compare=False)
    _turns_back: ClassVar[str]
    """What to do about an elevation that turns back."""

    def __post_init__(self) -> None:
        RadialCamera.__post_init__(self)
        inverse = MonotoneInverse(self._value_and_slope, self.inner_radius, self.outer_radius)
        if not inverse.monotone:
            turn = inverse.knots[int(np.argmin(np.abs(inverse.slopes)))]
            raise CalibrationError(
                f"mirror image: elevation turns back near radius {turn:.1f} px of the ring "
                f"{self.inner_radius:.1f} to {self.outer_radius:.1f} px; {self._turns_back}"
            )
        object.__setattr__(self, "_inverse", inverse)

    def radius(self, elevation: FloatArray) -> FloatArray:
        """(n,) radii, exact to rounding; see :class:`RadialCamera`."""
        return self._inverse(elevation)

    @abstractmethod
    def _value_and_slope(self, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) elevations of radii (n,), and their derivatives."""


# --------------------------------------------------------------------------------------------
# The hyperbolic mirror as a unified sphere, above and below the horizon


@dataclass(frozen=True)
class HyperbolicMirror(RadialCamera):
    """A hyperbolic (xi < 1) or parabolic (xi = 1) mirror above an upward-looking camera.

    A ray is moved to the unit sphere around the mirror's focus and projected from a point ``xi``
    above it: ``radius = focal cos(elevation) / (xi - sin(elevation))``. GTSAM's Cal3Unified divides
    by the ray's third coordinate first, and so covers only what lies below the horizon.

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


# --------------------------------------------------------------------------------------------
# The paper's own calibration: elevation as a polynomial of the image radius (fig. 3)


PAPER_DEGREE = 5


@dataclass(frozen=True)
class RadialPolynomial(InvertedCamera):
    """Elevation = sum of ``coefficients[k] x^k``, x = radius scaled to [-1, 1]; rising or falling.

    The paper names the degree, five, and a calibration image, not the argument. Here it is the
    radius, scaled so that the ring's inner and outer rim lie at -1 and 1, which keeps the fit well
    conditioned.

    It falls with the radius where the picture's middle looks up: a mirror that is looked at from
    above, or one with a second, flat mirror.
    """

    coefficients: tuple[float, ...]
    _turns_back = "fit a lower degree, correct the samples, or take more near the rims"

    def __post_init__(self) -> None:
        if not self.coefficients or not np.isfinite(self.coefficients).all():
            raise CalibrationError("radial polynomial: its coefficients must be finite, at least 1")
        InvertedCamera.__post_init__(self)

    def elevation(self, radius: FloatArray) -> FloatArray:
        """(n,) elevations; see :class:`RadialCamera`."""
        return np.asarray(polynomial.polyval(self._scaled(radius), np.array(self.coefficients)))

    def _scaled(self, radius: FloatArray) -> FloatArray:
        return _scaled(radius, self.inner_radius, self.outer_radius)

    def _value_and_slope(self, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
        slope = polynomial.polyder(np.array(self.coefficients))
        per_pixel = 2.0 / (self.outer_radius - self.inner_radius)
        slopes = per_pixel * polynomial.polyval(self._scaled(radius), slope)
        return self.elevation(radius), np.asarray(slopes)


def _scaled(radius: FloatArray, inner: float, outer: float) -> FloatArray:
    return (2.0 * np.asarray(radius, dtype=np.float64) - (inner + outer)) / (outer - inner)


@dataclass(frozen=True, slots=True, eq=False)
class RadialFit:
    """A fitted camera and the residuals (n,) of its samples: measured minus fitted, radians."""

    camera: RadialPolynomial
    residuals: FloatArray

    @property
    def worst(self) -> float:
        """Largest residual, radians."""
        return float(np.abs(self.residuals).max())


def fit_radial_polynomial(
    frame: MirrorFrame,
    radii: tuple[float, float],
    samples: tuple[FloatArray, FloatArray],
    degree: int = PAPER_DEGREE,
) -> RadialFit:
    """Least squares of elevation over radius.

    Args:
        frame: where the mirror lies in the picture.
        radii: inner and outer, pixels. The fit is extrapolated where samples do not reach them.
        samples: radii (n,) in pixels and elevations (n,) in radians, n > degree.
        degree: of the polynomial.

    Raises:
        CalibrationError: too few different radii, values that are not finite, or a polynomial
            that is not monotone over the ring.
    """
    radius, elevation = (np.asarray(v, dtype=np.float64) for v in samples)
    if not (np.isfinite(radius).all() and np.isfinite(elevation).all()):
        raise CalibrationError("radial polynomial: a sample is not finite; leave it out")
    different = len(np.unique(radius))
    if different <= degree:
        raise CalibrationError(
            f"radial polynomial: {different} different radii cannot fix degree {degree}; give at "
            f"least {degree + 1}"
        )
    x = _scaled(radius, *radii)
    coefficients = polynomial.polyfit(x, elevation, degree)
    camera = RadialPolynomial(frame, *radii, coefficients=tuple(coefficients.tolist()))
    return RadialFit(camera, elevation - polynomial.polyval(x, coefficients))
