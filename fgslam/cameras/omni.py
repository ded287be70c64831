"""Omnidirectional cameras: panoramas, mirrors and lenses, as what every model offers.

Camera axes are the robot's: x forward, y left, z up. A ray's *bearing* is ``atan2(y, x)``, its
*elevation* ``atan2(z, hypot(x, y))``: radians, counter-clockwise and up positive. Pixels are
(column, row), the centre of the top-left one is (0, 0).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.polynomial import polynomial

from fgslam.cameras.lenses import RawCamera, checked_camera, pixel_grid
from fgslam.cameras.trees import Values
from fgslam.core.arrays import Float32, FloatArray, Image
from fgslam.core.errors import CalibrationError, FrameError
from fgslam.core.files import read_text
from fgslam.core.geometry import wrap


class OmniCamera(Protocol):
    """A calibrated camera that sees (nearly) all around. Immutable."""

    @property
    def width(self) -> int:
        """Of the image, in pixels."""
        ...

    @property
    def height(self) -> int:
        """Of the image, in pixels."""
        ...

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit vectors along which pixels (n, 2) look; NaN outside the field of view."""
        ...

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels of rays (n, 3) of any length; NaN where the camera does not see them."""
        ...


def require_own_image(camera: OmniCamera, image: Image) -> None:
    """Raises FrameError unless an image is (height, width, 3) uint8 of the camera's size."""
    wanted = (camera.height, camera.width, 3)
    if image.shape != wanted or image.dtype != np.uint8:
        raise FrameError(
            f"an image is {image.dtype} {image.shape}, but the camera's are uint8 {wanted} "
            "(rows, columns, R G B); take the calibration of this camera at this size"
        )


# --------------------------------------------------------------------------------------------
# Pixels to bearings and elevations with their covariance


_STEP_PX = 0.05  # of the central difference: its error is a millionth of the derivative


def unit_rays(bearing: FloatArray, elevation: FloatArray) -> FloatArray:
    """(n, 3) rays of bearings and elevations (n,), radians; the inverse of :func:`angles_of`."""
    level = np.cos(elevation)
    return np.column_stack([level * np.cos(bearing), level * np.sin(bearing), np.sin(elevation)])


def angles_of(rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bearings and elevations (n,) of rays (n, 3), radians."""
    bearing = np.arctan2(rays[:, 1], rays[:, 0])
    elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    return bearing, elevation


def measure(
    camera: OmniCamera, pixels: FloatArray, sigma_px: float | FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What pixels measure, to first order in their noise.

    Args:
        camera: that took the image.
        pixels: (n, 2).
        sigma_px: standard deviation of each coordinate in pixels, one number or (n,).

    Returns:
        Bearing (n,) and elevation (n,) in radians, and covariance (n, 2, 2) of both; NaN outside
        the field of view. At its very border the derivative is one-sided.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    n = len(pixels)
    offsets = _STEP_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=np.float64)
    bearing, elevation = angles_of(camera.rays((offsets[:, None] + pixels[None]).reshape(-1, 2)))
    bearings, elevations = bearing.reshape(5, n), elevation.reshape(5, n)
    jacobian = np.empty((n, 2, 2))
    for axis in range(2):
        plus, minus = 1 + 2 * axis, 2 + 2 * axis
        jacobian[:, 0, axis] = _slope(bearings[[plus, 0, minus]])
        jacobian[:, 1, axis] = _slope(elevations[[plus, 0, minus]])
    variance = np.broadcast_to(np.square(sigma_px), (n,))
    covariance = (jacobian @ jacobian.transpose(0, 2, 1)) * variance[:, None, None]
    return bearings[0], elevations[0], covariance


def _slope(values: FloatArray) -> FloatArray:
    """(n,) derivative from (3, n) angles after, at and before; one-sided where one is NaN."""
    after, before = wrap(values[0] - values[1]), wrap(values[1] - values[2])
    both = 0.5 * (after + before)
    return np.asarray(
        np.where(np.isfinite(both), both, np.where(np.isfinite(after), after, before)) / _STEP_PX
    )


# --------------------------------------------------------------------------------------------
# Whether pixels lie in a picture, and whether a picture has a sensible size


def require_size(what: str, width: int, height: int) -> None:
    """Raises CalibrationError for a picture without two rows and columns; ``what`` names it."""
    if width < 2 or height < 2:
        raise CalibrationError(f"{what}: a picture of {width}x{height} pixels; give at least 2x2")


def inside(pixels: FloatArray, width: int, height: int) -> FloatArray:
    """Pixels (n, 2), NaN where they lie outside the picture.

    A pixel reaches half a pixel around its centre, so the picture reaches from -0.5 to size - 0.5.
    """
    c, r = pixels[:, 0], pixels[:, 1]
    outside = (c < -0.5) | (c > width - 0.5) | (r < -0.5) | (r > height - 0.5)
    return np.where(outside[:, None], np.nan, pixels)


# --------------------------------------------------------------------------------------------
# Where each pixel of one camera's image lies in another's, both at one viewpoint

OUTSIDE = -1e4
"""Coordinate of pixels that the source does not see: outside any image, so that it stays black."""


def unwrap_maps(source: OmniCamera, target: OmniCamera) -> tuple[Float32, Float32]:
    """Columns and rows (target.height, target.width) in the source's image, for a remap."""
    rays = target.rays(pixel_grid((target.width, target.height)))
    seen = np.isfinite(rays[:, 0])
    found = np.full((len(rays), 2), np.nan)
    found[seen] = source.pixels(rays[seen])
    found = np.where(np.isfinite(found), found, OUTSIDE)
    maps = found.reshape(target.height, target.width, 2).astype(np.float32)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


# --------------------------------------------------------------------------------------------
# Unwrapped views: the equirectangular panorama and the cylinder; both are cameras themselves
#
# Columns run clockwise: the centre column points forward, the first and the last one both point
# backward, so a turn of the robot shifts the picture sideways.


_HALF_TURN = np.pi


def _bearing(columns: FloatArray, width: int) -> FloatArray:
    return _HALF_TURN - columns * (2.0 * _HALF_TURN / (width - 1))


def _column(rays: FloatArray, width: int) -> FloatArray:
    bearing = np.arctan2(rays[:, 1], rays[:, 0])
    return (_HALF_TURN - bearing) * ((width - 1) / (2.0 * _HALF_TURN))


@dataclass(frozen=True, slots=True)
class Equirectangular:
    """Rows proportional to elevation.

    Column u points to bearing pi - 2 pi u / (width - 1), row v to elevation
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

    @property
    def _per_row(self) -> float:
        return (self.top_elevation - self.bottom_elevation) / (self.height - 1)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit rays; see :class:`OmniCamera`."""
        pixels = inside(np.asarray(pixels, dtype=np.float64), self.width, self.height)
        elevation = self.top_elevation - pixels[:, 1] * self._per_row
        return unit_rays(_bearing(pixels[:, 0], self.width), elevation)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`OmniCamera`."""
        rays = np.asarray(rays, dtype=np.float64)
        rows = (self.top_elevation - angles_of(rays)[1]) / self._per_row
        return inside(np.column_stack([_column(rays, self.width), rows]), self.width, self.height)


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Rows proportional to the tangent of elevation.

    A vertical line then keeps its straightness, and a column segment scales about the horizon's row
    alone when its distance changes. Row v points along tangent
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
                f"cylinder: tangents from {self.tan_bottom:g} to {self.tan_top:g} must rise"
            )

    def tangents(self, rows: FloatArray) -> FloatArray:
        """Tangents of elevation of rows, any shape."""
        per_row = (self.tan_top - self.tan_bottom) / (self.height - 1)
        return np.asarray(self.tan_top - np.asarray(rows, dtype=np.float64) * per_row)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit rays; see :class:`OmniCamera`."""
        pixels = inside(np.asarray(pixels, dtype=np.float64), self.width, self.height)
        bearing = _bearing(pixels[:, 0], self.width)
        tangent = self.tangents(pixels[:, 1])
        level = 1.0 / np.sqrt(1.0 + tangent**2)
        return np.column_stack([level * np.cos(bearing), level * np.sin(bearing), level * tangent])

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`OmniCamera`."""
        rays = np.asarray(rays, dtype=np.float64)
        per_row = (self.tan_top - self.tan_bottom) / (self.height - 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            tangent = rays[:, 2] / np.hypot(rays[:, 0], rays[:, 1])
        rows = (self.tan_top - tangent) / per_row
        return inside(np.column_stack([_column(rays, self.width), rows]), self.width, self.height)


# --------------------------------------------------------------------------------------------
# Cameras with a mirror or lens of revolution: elevation depends on the radius alone
#
# The picture of a mirror above an upward-looking camera is seen *from below*: bearings run
# clockwise in it, and what is left of the robot lies right of what is ahead, if ahead is up.


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
            upward-looking camera; False where it was mirrored, or the camera points down.
    """

    width: int
    height: int
    centre: tuple[float, float]
    ahead: float = AHEAD_IS_UP
    clockwise: bool = True

    def __post_init__(self) -> None:
        require_size("mirror image", self.width, self.height)
        column, row = self.centre
        if not (-0.5 <= column <= self.width - 0.5 and -0.5 <= row <= self.height - 0.5):
            raise CalibrationError(
                f"mirror image: the mirror's centre ({column:g}, {row:g}) lies outside the "
                f"{self.width}x{self.height} picture; correct the centre or the size"
            )
        if not math.isfinite(self.ahead):
            raise CalibrationError(f"mirror image: ahead is {self.ahead:g}, it must be finite")

    def polar(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Radius in pixels (n,) and bearing in radians (n,) of pixels (n, 2)."""
        across, down = pixels[:, 0] - self.centre[0], pixels[:, 1] - self.centre[1]
        angle = np.arctan2(down, across) - self.ahead
        return np.hypot(down, across), angle if self.clockwise else -angle

    def pixels(self, radius: FloatArray, bearing: FloatArray) -> FloatArray:
        """(n, 2) pixels of polar coordinates (n,) each, also where they leave the picture."""
        angle = (bearing if self.clockwise else -bearing) + self.ahead
        down, across = radius * np.sin(angle), radius * np.cos(angle)
        return np.column_stack([self.centre[0] + across, self.centre[1] + down])


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
        """(n, 3) unit rays; see :class:`OmniCamera`."""
        pixels = inside(np.asarray(pixels, dtype=np.float64), self.width, self.height)
        radius, bearing = self.frame.polar(pixels)
        elevation = self.elevation(self._within(radius))
        return unit_rays(bearing, elevation)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`OmniCamera`."""
        bearing, elevation = angles_of(np.asarray(rays, dtype=np.float64))
        radius = self._within(self.radius(elevation))
        return inside(self.frame.pixels(radius, bearing), self.width, self.height)

    def _within(self, radius: FloatArray) -> FloatArray:
        seen = (radius >= self.inner_radius * (1.0 - _RIM)) & (
            radius <= self.outer_radius * (1.0 + _RIM)
        )
        return np.where(seen, radius, np.nan)


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
        place: MirrorFrame | tuple[int, int],
        xi: float,
        elevations: tuple[float, float],
        ring: tuple[float, float] | None = None,
        focal_px: float | None = None,
        margin_px: float = 0.0,
    ) -> HyperbolicMirror:
        """A mirror whose rim touches the nearest border of the picture, unless that is stated.

        Args:
            place: where it lies; a size (width, height): in the middle of such a picture.
            xi: as above.
            elevations: at the inner and at the outer rim, radians.
            ring: inner and outer radius in pixels, in place of what follows from these.
            focal_px: in place of what follows from the outer rim.
            margin_px: left free around the rim.
        """
        lowest, highest = elevations
        limit = np.arcsin(min(max(xi, 0.0), 1.0))
        if not -np.pi / 2 <= lowest < highest < limit:
            raise CalibrationError(
                f"hyperbolic mirror: elevations from {np.degrees(lowest):g} (inner_elevation_deg) "
                f"to {np.degrees(highest):g} degrees (outer_elevation_deg); they must rise from "
                f"-90 or more, and stay below arcsin(xi) = {np.degrees(limit):.1f}"
            )
        if isinstance(place, tuple):
            place = MirrorFrame(*place, ((place[0] - 1) / 2.0, (place[1] - 1) / 2.0))
        column, row = place.centre
        border = min(column, row, place.width - 1 - column, place.height - 1 - row) - margin_px
        outer = border if ring is None else ring[1]
        if focal_px is None:
            focal_px = float(outer * (xi - np.sin(highest)) / np.cos(highest))
        elif ring is None:
            outer = float(focal_px * np.cos(highest) / (xi - np.sin(highest)))
        inner = float(focal_px * np.cos(lowest) / (xi - np.sin(lowest)))
        return cls(place, *(ring or (inner, outer)), xi=xi, focal_px=focal_px)

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
_KNOTS = 513
# From a table of 513 knots two steps reach rounding; the others guard uneven functions.
_NEWTON_STEPS = 5


@dataclass(frozen=True)
class RadialPolynomial(RadialCamera):
    """Elevation = sum of ``coefficients[k] x^k``, x = radius scaled to [-1, 1]; rising or falling.

    The paper names the degree, five, and a calibration image, not the argument. Here it is the
    radius, scaled so that the ring's inner and outer rim lie at -1 and 1, which keeps the fit well
    conditioned.

    It falls with the radius where the picture's middle points up: a mirror that is seen from
    above, or one with a second, flat mirror.

    Raises:
        CalibrationError: the elevation is not monotone over the ring.
    """

    coefficients: tuple[float, ...]
    _table: tuple[FloatArray, FloatArray] = field(init=False, repr=False, compare=False)
    """Rising elevations (513,), and the radii that have them."""

    def __post_init__(self) -> None:
        if not self.coefficients or not np.isfinite(self.coefficients).all():
            raise CalibrationError("radial polynomial: its coefficients must be finite, at least 1")
        RadialCamera.__post_init__(self)
        radii = np.linspace(self.inner_radius, self.outer_radius, _KNOTS)
        values, slopes = self._value_and_slope(radii)
        if not (np.all(slopes > 0.0) or np.all(slopes < 0.0)):
            turn = radii[int(np.argmin(np.abs(slopes)))]
            raise CalibrationError(
                f"mirror image: elevation turns back near radius {turn:.1f} px of the ring "
                f"{self.inner_radius:.1f} to {self.outer_radius:.1f} px; fit a lower degree, "
                "correct the samples, or take more near the rims"
            )
        order = slice(None, None, 1 if values[-1] > values[0] else -1)
        object.__setattr__(self, "_table", (values[order], radii[order]))

    def elevation(self, radius: FloatArray) -> FloatArray:
        """(n,) elevations; see :class:`RadialCamera`."""
        x = _scaled(radius, self.inner_radius, self.outer_radius)
        return np.asarray(polynomial.polyval(x, np.array(self.coefficients)))

    def radius(self, elevation: FloatArray) -> FloatArray:
        """(n,) radii, from the table by Newton's method; see :class:`RadialCamera`."""
        wanted, (values, radii) = np.asarray(elevation, dtype=np.float64), self._table
        slack = 1e-12 * (1.0 + np.abs(values[[0, -1]]).max())
        seen = (wanted >= values[0] - slack) & (wanted <= values[-1] + slack)
        x = np.interp(np.where(seen, wanted, values[0]), values, radii)
        for _ in range(_NEWTON_STEPS):
            value, slope = self._value_and_slope(x)
            x = np.clip(x - (value - wanted) / slope, self.inner_radius, self.outer_radius)
        return np.where(seen, x, np.nan)

    def _value_and_slope(self, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
        slope = polynomial.polyder(np.array(self.coefficients))
        per_pixel = 2.0 / (self.outer_radius - self.inner_radius)
        x = _scaled(radius, self.inner_radius, self.outer_radius)
        slopes = per_pixel * polynomial.polyval(x, slope)
        return self.elevation(radius), np.asarray(slopes)


def _scaled(radius: FloatArray, inner: float, outer: float) -> FloatArray:
    return (2.0 * np.asarray(radius, dtype=np.float64) - (inner + outer)) / (outer - inner)


def fit_radial_polynomial(
    frame: MirrorFrame,
    radii: tuple[float, float],
    samples: tuple[FloatArray, FloatArray],
    degree: int = PAPER_DEGREE,
) -> tuple[RadialPolynomial, float]:
    """Least squares of elevation over radius: the camera, and the largest residual in radians.

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
            f"radial polynomial: {different} different radii cannot fix degree {degree}; give more"
        )
    x = _scaled(radius, *radii)
    coefficients = polynomial.polyfit(x, elevation, degree)
    camera = RadialPolynomial(frame, *radii, coefficients=tuple(coefficients.tolist()))
    residuals = elevation - polynomial.polyval(x, coefficients)
    return camera, float(np.abs(residuals).max())


# --------------------------------------------------------------------------------------------
# A lens or mirror calibrated as an ordinary camera, that points straight up or down


AROUND = ("omni", "equidistant", "fov", "ds", "eucm", "ocam")
"""Models of cameras that may see a half space and more."""


@dataclass(frozen=True)
class LensCamera:
    """A camera of :mod:`fgslam.cameras.lenses` whose axis is the robot's vertical one.

    Mei's unified model with its distortion, for one, which need not be radial.

    Attributes:
        width, height: of the picture, pixels.
        lens: name of its model; one of :data:`AROUND`.
        matrix: (9,) intrinsics row by row.
        distortion: parameters of the lens.
        ring: inner and outer radius around the principal point that show the surroundings, pixels.
        up: whether the picture's middle points up; else down, as of a mirror above the camera.
        ahead, clockwise: as of :class:`MirrorFrame`.

    Raises:
        CalibrationError: the lens is none of these, the radii do not rise from 0 or more, or the
            elevation of OCamCalib's polynomial does not rise over them.
    """

    width: int
    height: int
    lens: str
    matrix: tuple[float, ...]
    distortion: tuple[float, ...]
    ring: tuple[float, float]
    up: bool = False
    ahead: float = AHEAD_IS_UP
    clockwise: bool = True
    _raw: RawCamera = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.lens not in AROUND:
            raise CalibrationError(
                f"camera: a {self.lens} lens does not see all around; known: {', '.join(AROUND)}"
            )
        if not 0.0 <= self.ring[0] < self.ring[1] < np.inf:
            raise CalibrationError(
                f"camera: ring_px is {self.ring[0]:g} to {self.ring[1]:g}; it must rise from 0"
            )
        matrix = np.array(self.matrix).reshape(3, 3)
        distortion = np.array(self.distortion)
        size = (self.width, self.height)
        raw = RawCamera(*size, matrix, distortion, np.eye(4), model=self.lens)
        object.__setattr__(self, "_raw", checked_camera(raw))
        if self.lens == "ocam":  # a polynomial that any file may state
            radii = np.linspace(*self.ring, _KNOTS)
            steps = np.diff(np.arctan2(polynomial.polyval(radii, distortion), radii))
            if not (steps > 0.0).all():
                raise CalibrationError(
                    f"camera: elevation turns back near radius {radii[np.argmin(steps > 0.0)]:.1f} "
                    f"px of the ring {self.ring[0]:.1f} to {self.ring[1]:.1f} px; narrow it"
                )

    @classmethod
    def of(
        cls,
        raw: RawCamera,
        ring: tuple[float, float] | None,
        up: bool,
        ahead: float = AHEAD_IS_UP,
        clockwise: bool = True,
    ) -> LensCamera:
        """The camera of a calibration; without a ring the largest circle within the picture."""
        column, row = raw.matrix[:2, 2].tolist()
        circle = min(column, row, raw.width - 1 - column, raw.height - 1 - row)
        numbers = (tuple(raw.matrix.ravel().tolist()), tuple(raw.distortion.tolist()))
        ring = ring or (0.0, circle)
        return cls(raw.width, raw.height, raw.model, *numbers, ring, up, ahead, clockwise)

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point, column and row in pixels."""
        return self.matrix[2], self.matrix[5]

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit rays; see :class:`OmniCamera`."""
        seen = self._raw.unproject(self._within(np.asarray(pixels, np.float64)))
        angle, height = angles_of(seen)
        angle = angle - self.ahead
        return unit_rays(angle if self.clockwise else -angle, height if self.up else -height)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`OmniCamera`."""
        rays = np.asarray(rays, np.float64)
        bearing = np.arctan2(rays[:, 1], rays[:, 0])
        angle = (bearing if self.clockwise else -bearing) + self.ahead
        level, along = np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2] if self.up else -rays[:, 2]
        own = np.column_stack([level * np.cos(angle), level * np.sin(angle), along])
        return self._within(self._raw.project(own))

    def _within(self, pixels: FloatArray) -> FloatArray:
        """The pixels, NaN outside the picture and the ring."""
        radius = np.hypot(*(pixels - self._raw.matrix[:2, 2]).T)
        seen = (radius >= self.ring[0]) & (radius <= self.ring[1])
        return np.where(seen[:, None], inside(pixels, self.width, self.height), np.nan)


# --------------------------------------------------------------------------------------------
# OCamCalib's result file (Scaramuzza, Martinelli and Siegwart 2006)
#
# A pixel at radius rho from the centre points along (rho cos, rho sin, f(rho)), f a polynomial.
# The file's inverse polynomial is a fit of its own, good to a fraction of a pixel; pixels are found
# here by solving f exactly.


_MAX_TERMS = 64
# The file's two polynomials are fits of one another: further apart, one of them is damaged.
_MAX_DISAGREEMENT_PX = 3.0


def read_ocamcalib(path: Path) -> tuple[RawCamera, tuple[float, float] | None, tuple[int, int]]:
    """Of a ``calib_results.txt`` the camera, its ring, and the columns cropped left and right.

    The ring is the inner and outer radius that the mirror shows, pixels; None where not stated.
    Besides OCamCalib's own five entries two more are understood where their comments name them:
    the ring that the mirror shows ("ROI max min radius") and columns that were cut off before
    calibrating ("left right cropped pixel").

    Raises:
        CalibrationError: with file and line, for anything missing, malformed or contradictory.
    """
    entries, comment = [], ""  # lines of numbers, each with the comment before it
    text = read_text(path, CalibrationError, "give OCamCalib's calib_results.txt")
    for number, line in enumerate(text.splitlines(), 1):
        values, _, after = line.replace("%", "#").partition("#")  # MATLAB's comments, too
        words = values.replace(",", " ").split()
        if words:
            entries.append((f"line {number}: ", comment, words))
        comment = "" if words else after.strip(" \t#") or comment
    if len(entries) < 5:
        raise CalibrationError(
            f"{path} has {len(entries)} entries, an OCamCalib result has 5 (two polynomials, "
            "centre, affine parameters, size): export it again"
        )
    names = (
        *("direct polynomial", "inverse polynomial"),
        *("centre (row, column)", "affine parameters (c, d, e)", "size (height, width)"),
    )
    direct, inverse, centre, affine, size = (
        Values(path, {name: words}, where)
        for name, (where, _, words) in zip(names, entries, strict=False)
    )
    polynomials = []
    for part, name in zip((direct, inverse), names, strict=False):
        count, *terms = part.numbers(name)
        if count != len(terms) or not 2 <= count <= _MAX_TERMS:
            raise part.refuse(
                f"{name}: states {count:g} coefficients (2 to {_MAX_TERMS}) and has {len(terms)}; "
                "correct the line"
            )
        polynomials.append(np.array(terms))
    row, column = centre.numbers(names[2], 2)
    c, d, e = affine.numbers(names[3], 3)
    if not c - d * e > 0.0:
        raise affine.refuse("affine parameters: c - d e > 0 is needed")
    height, width = _wholes(size, names[4])
    require_size(f"{path}: {size.where}size", width, height)
    ring: tuple[float, float] | None = None
    cropped = (0, 0)
    for where, comment, words in entries[len(names) :]:
        part = Values(path, {"ring": words, "cropped columns": words}, where)
        if "roi" in comment.lower() and "radius" in comment.lower():
            outer, inner = part.numbers("ring", 2).tolist()
            if not 0.0 <= inner < outer:
                raise part.refuse(
                    f"ring: largest radius {outer:g}, smallest {inner:g}; correct them"
                )
            ring = inner, outer
        elif "crop" in comment.lower():
            cropped = _wholes(part, "cropped columns")
        else:
            raise part.refuse(
                f"an entry that is not known ({comment or 'without a comment'}); remove it"
            )
    # Rows and columns from the centre, (x, y), are seen at (c x + d y, e x + y).
    matrix = np.array([[1.0, e, column], [d, c, row], [0.0, 0.0, 1.0]])
    direct_terms, inverse_terms = polynomials
    raw = RawCamera(width, height, matrix, direct_terms, np.eye(4), str(path), "ocam")
    checked_camera(raw)
    try:
        camera = LensCamera.of(raw, ring, up=False)
    except CalibrationError as cause:
        raise CalibrationError(f"{path}: {cause}") from cause
    radius = np.linspace(*camera.ring, 200)
    angle = np.arctan2(polynomial.polyval(radius, direct_terms), radius)
    apart = float(np.abs(polynomial.polyval(angle, inverse_terms) - radius).max())
    if not apart <= _MAX_DISAGREEMENT_PX:
        raise CalibrationError(
            f"{path}: the inverse polynomial is {apart:.3g} px off the direct one, at most "
            f"{_MAX_DISAGREEMENT_PX:g} px are credible: one of the two is damaged; export it again"
        )
    return raw, ring, cropped


def _wholes(part: Values, name: str) -> tuple[int, int]:
    found = part.numbers(name, 2)
    if (found != np.rint(found)).any() or (found < 0.0).any():
        raise part.refuse(
            f"{name}: {found.tolist()}, not whole numbers of pixels; correct the line"
        )
    return int(found[0]), int(found[1])
