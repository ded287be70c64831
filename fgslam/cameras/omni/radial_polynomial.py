"""The paper's own calibration: elevation as a polynomial of the image radius (fig. 3).

The paper names the degree, five, and a calibration image; the argument is ours: the radius,
scaled so that the ring's inner and outer rim lie at -1 and 1, which keeps the fit well conditioned.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import polynomial

from fgslam.cameras.omni.monotone_inverse import MonotoneInverse
from fgslam.cameras.omni.radial import MirrorFrame, RadialCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError

PAPER_DEGREE = 5


@dataclass(frozen=True)
class RadialPolynomial(RadialCamera):
    """Elevation = sum of ``coefficients[k] x^k``, x = radius scaled to [-1, 1]; rising or falling.

    It falls with the radius where the picture's middle looks up: a mirror that is looked at from
    above, or one with a second, flat mirror.
    """

    coefficients: tuple[float, ...]
    _inverse: MonotoneInverse = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        RadialCamera.__post_init__(self)
        if not self.coefficients or not np.isfinite(self.coefficients).all():
            raise CalibrationError("radial polynomial: its coefficients must be finite, at least 1")
        inverse = MonotoneInverse(self._value_and_slope, self.inner_radius, self.outer_radius)
        if not inverse.monotone:
            turn = inverse.knots[int(np.argmin(np.abs(inverse.slopes)))]
            raise CalibrationError(
                f"radial polynomial: elevation turns back near radius {turn:.1f} px, so a pixel "
                "would have two radii; fit a lower degree, correct the samples, or take more near "
                "the rims"
            )
        object.__setattr__(self, "_inverse", inverse)

    def elevation(self, radius: FloatArray) -> FloatArray:
        """(n,) elevations; see :class:`RadialCamera`."""
        return np.asarray(polynomial.polyval(self._scaled(radius), np.array(self.coefficients)))

    def radius(self, elevation: FloatArray) -> FloatArray:
        """(n,) radii; see :class:`RadialCamera`."""
        return self._inverse(elevation)

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
    weights: FloatArray | None = None,
) -> RadialFit:
    """Least squares of elevation over radius.

    Args:
        frame: where the mirror lies in the picture.
        radii: inner and outer, pixels. The fit is extrapolated where samples do not reach them.
        samples: radii (n,) in pixels and elevations (n,) in radians, n > degree.
        degree: of the polynomial.
        weights: (n,) inverse standard deviations of the elevations, or None for equal ones.

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
    coefficients = polynomial.polyfit(x, elevation, degree, w=weights)
    camera = RadialPolynomial(frame, *radii, coefficients=tuple(coefficients.tolist()))
    return RadialFit(camera, elevation - polynomial.polyval(x, coefficients))
