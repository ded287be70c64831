"""The epipolar constraint of two omnidirectional views on a plane, for many hypotheses at once.

With unit rays a and b and a homing vector (theta, psi), the two rays and the leg
t = (cos theta, sin theta, 0) lie in one plane:

    r = a . (t x Rz(psi) b) = a_x b_z sin(theta) - a_y b_z cos(theta)
                              + a_z b_x sin(psi - theta) + a_z b_y cos(psi - theta) = 0.

This is the coplanarity of both rays and the baseline times the cosines of both elevations, so it
stays finite towards the zenith; the paper's test of two ratios (III-B, second step) is the same
constraint. It is linear in four numbers of the hypothesis, as are its derivatives by the measured
angles: all hypotheses are tested by five matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.cameras.omni.camera import unit_rays
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.homing import BearingMatches
from fgslam.core.planar import wrap


def ray_derivatives(bearing: FloatArray, elevation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives (n, 3) of :func:`.unit_rays` by bearing and by elevation."""
    level, up = np.cos(elevation), np.sin(elevation)
    c, s = np.cos(bearing), np.sin(bearing)
    by_bearing = np.column_stack([-level * s, level * c, np.zeros(len(bearing))])
    return by_bearing, np.column_stack([-up * c, -up * s, level])


def _products(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, 4) coefficients of the constraint, bilinear in both rays."""
    return np.column_stack(
        [a[:, 0] * b[:, 2], a[:, 1] * b[:, 2], a[:, 2] * b[:, 0], a[:, 2] * b[:, 1]]
    )


def in_front(
    bearings: tuple[FloatArray, FloatArray],
    direction: FloatArray,
    rotation: FloatArray,
    least_parallax: float,
) -> BoolArray:
    """(n, c) both distances positive, or the rays too parallel to tell.

    Args:
        bearings: (n,) from a and from b, radians.
        direction: (c,) of the hypotheses.
        rotation: (c,) likewise.
        least_parallax: radians.
    """
    from_start = bearings[0][:, None]
    turned = wrap(bearings[1][:, None] + rotation)
    parallax = np.sin(turned - from_start)
    from_a = np.sin(turned - direction) * parallax
    from_b = np.sin(from_start - direction) * parallax
    parallel = np.abs(wrap(turned - from_start)) < least_parallax
    return ((from_a > 0.0) & (from_b > 0.0)) | parallel


@dataclass(frozen=True, slots=True, eq=False)
class EpipolarTest:
    """The matches, prepared for testing hypotheses.

    Attributes:
        coefficients: (n, 4) of the constraint; derivatives: four (n, 4), each already multiplied
            by the standard deviation of its angle.
        bearing_a, bearing_b: (n,) radians.
    """

    coefficients: FloatArray
    derivatives: tuple[FloatArray, ...]
    bearing_a: FloatArray
    bearing_b: FloatArray

    @classmethod
    def of(cls, matches: BearingMatches, tilt_sigma: float = 0.0) -> EpipolarTest:
        """Prepares matches; a tilt of unknown direction (radians) widens their elevations."""
        a = unit_rays(matches.bearing_a, matches.elevation_a)
        b = unit_rays(matches.bearing_b, matches.elevation_b)
        a_by = ray_derivatives(matches.bearing_a, matches.elevation_a)
        b_by = ray_derivatives(matches.bearing_b, matches.elevation_b)
        sigma = matches.sigma.copy()
        sigma[:, [1, 3]] = np.hypot(sigma[:, [1, 3]], tilt_sigma / np.sqrt(2.0))
        parts = (
            _products(a_by[0], b),
            _products(a_by[1], b),
            _products(a, b_by[0]),
            _products(a, b_by[1]),
        )
        derivatives = tuple(part * sigma[:, k : k + 1] for k, part in enumerate(parts))
        return cls(_products(a, b), derivatives, matches.bearing_a, matches.bearing_b)

    def normalised(self, direction: FloatArray, rotation: FloatArray) -> FloatArray:
        """(n, c) residuals over their first-order standard deviations, for c hypotheses."""
        between = rotation - direction
        hypothesis = np.stack(
            [np.sin(direction), -np.cos(direction), np.sin(between), np.cos(between)]
        )
        variance = np.zeros((len(self.coefficients), hypothesis.shape[1]))
        for part in self.derivatives:
            variance += (part @ hypothesis) ** 2
        # A ray along the leg itself fits any hypothesis: 0 / 0 is no contradiction.
        sigma = np.sqrt(np.maximum(variance, 1e-24))
        return np.asarray(self.coefficients @ hypothesis / sigma, dtype=np.float64)

    def inliers(
        self,
        direction: FloatArray,
        rotation: FloatArray,
        sigmas: float,
        least_parallax: float,
    ) -> tuple[BoolArray, FloatArray]:
        """(n, c) inliers of c hypotheses, and their normalised residuals."""
        residuals = self.normalised(direction, rotation)
        good = np.abs(residuals) < sigmas
        bearings = self.bearing_a, self.bearing_b
        good &= in_front(bearings, direction, rotation, least_parallax)
        return good, residuals
