"""Two omnidirectional views on a plane: two-point problem, epipolar constraint, triangulation.

Sections III-B and III-C of Goedemé et al. (2005), fig. 3.

*Two points.* One feature's height is the same for both cameras, so the ratio of its elevations'
tangents is that of its distances, ``rho = e / d = tan(alpha_a) / tan(alpha_b)``. Two features and
their bearings then make a quadrangle with one unknown, ``k = d_2 / d_1``, the root of a quadratic.
The paper implies a unique answer; there are two wherever both features are nearer to the same
camera.

*Epipolar constraint.* With unit rays a and b and a homing vector (theta, psi), the two rays and the
leg t = (cos theta, sin theta, 0) lie in one plane:

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

from fgslam.cameras.omni import unit_rays
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.homing import BearingMatches, LocalMap, TwoViewVector
from fgslam.core.planar import wrap

LEAST_SEPARATION = np.deg2rad(5.0)
"""Bearing difference that two features need in one of the views: less is one vertical line."""

_CLAMP_SIGMAS = 3.0
"""A negative discriminant within so many of its standard deviations counts as a double root;
beyond, the sample is refused."""

_EQUALLY_FAR = 1e-12
"""|1 - rho^2| below which a feature counts as equally far from both cameras."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoPointSamples:
    """s samples of two correspondences each.

    Attributes:
        bearing_a, bearing_b: (s, 2) radians, as seen from the present pose and from the target.
        log_ratio: (s, 2) ln rho, rho = tan(elevation_a) / tan(elevation_b).
        sigma_bearing, sigma_log_ratio: (s, 2) standard deviations of bearings (root mean square
            of both views, radians) and of ln rho; zero makes the test of the discriminant exact.
    """

    bearing_a: FloatArray
    bearing_b: FloatArray
    log_ratio: FloatArray
    sigma_bearing: FloatArray
    sigma_log_ratio: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TwoPointSolutions:
    """Up to two solutions a sample: (s, 2) each, NaN where there is none; the legs' length is 1.

    Attributes:
        direction, rotation: theta and psi, radians.
        first_distance: d_1, of the first feature from the present pose.
        distance_ratio: k = d_2 / d_1 > 0.
    """

    direction: FloatArray
    rotation: FloatArray
    first_distance: FloatArray
    distance_ratio: FloatArray

    @property
    def valid(self) -> BoolArray:
        """(s, 2) where there is a solution."""
        return np.isfinite(self.direction)


def solve_two_point(
    samples: TwoPointSamples,
    least_separation: float = LEAST_SEPARATION,
) -> TwoPointSolutions:
    """All solutions with positive distances; degenerate samples have none.

    Args:
        samples: as described.
        least_separation: of the two bearings in one of the views, radians.
    """
    rho = np.exp(samples.log_ratio)
    ratios = _distance_ratios(samples, rho)
    ratios[_separation(samples) < least_separation] = np.nan
    z_a, z_b = np.exp(1j * samples.bearing_a), np.exp(1j * samples.bearing_b)
    with np.errstate(divide="ignore", invalid="ignore"):
        seen_a = ratios * z_a[:, 1:] - z_a[:, :1]
        seen_b = rho[:, 1:] * ratios * z_b[:, 1:] - rho[:, :1] * z_b[:, :1]
        turn = seen_a * np.conj(seen_b)
        rotation = np.angle(turn)
        baseline = z_a[:, :1] - rho[:, :1] * z_b[:, :1] * np.exp(1j * rotation)
        length = np.abs(baseline)
        first = 1.0 / length
    good = np.isfinite(ratios) & (ratios > 0.0) & (np.abs(turn) > 0.0) & (length > 0.0)
    direction = np.where(good, np.angle(baseline), np.nan)
    return TwoPointSolutions(
        direction,
        np.where(good, rotation, np.nan),
        np.where(good, first, np.nan),
        np.where(good, ratios, np.nan),
    )


def _distance_ratios(samples: TwoPointSamples, rho: FloatArray) -> FloatArray:
    """(s, 2) roots k of the quadratic A k^2 - 2 B k + C = 0, NaN where there is none."""
    between_a = samples.bearing_a[:, 1] - samples.bearing_a[:, 0]
    between_b = samples.bearing_b[:, 1] - samples.bearing_b[:, 0]
    # -expm1 keeps 1 - rho^2 exact where both distances are nearly equal.
    a, c = -np.expm1(2.0 * samples.log_ratio[:, 1]), -np.expm1(2.0 * samples.log_ratio[:, 0])
    product = rho[:, 0] * rho[:, 1]
    b = np.cos(between_a) - product * np.cos(between_b)
    discriminant = b * b - a * c
    spread = _discriminant_sigma(samples, rho, (a, b, c), (between_a, between_b))
    refused = discriminant < -_CLAMP_SIGMAS * spread
    refused |= (np.abs(a) < _EQUALLY_FAR) & (np.abs(c) < _EQUALLY_FAR)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    q = b + np.where(b < 0.0, -root, root)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Where A vanishes q / A runs away to infinity and C / q is the paper's k = C / (2 B).
        first = np.where(np.abs(a) < _EQUALLY_FAR, np.nan, q / a)
        ratios = np.column_stack([first, c / q])
    double = (root == 0.0) & np.isfinite(first)
    ratios[double, 1] = np.nan
    ratios[refused] = np.nan
    return ratios


def _separation(samples: TwoPointSamples) -> FloatArray:
    """(s,) bearing difference of the two features in the view where it is larger, at most pi."""
    apart = [np.abs(wrap(b[:, 1] - b[:, 0])) for b in (samples.bearing_a, samples.bearing_b)]
    return np.maximum(*apart)


def _discriminant_sigma(
    samples: TwoPointSamples,
    rho: FloatArray,
    coefficients: tuple[FloatArray, FloatArray, FloatArray],
    betas: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """(s,) first-order standard deviation of B^2 - A C under the samples' noise."""
    a, b, c = coefficients
    product = rho[:, 0] * rho[:, 1]
    by_log = np.column_stack(
        [
            -2.0 * b * product * np.cos(betas[1]) + 2.0 * a * rho[:, 0] ** 2,
            -2.0 * b * product * np.cos(betas[1]) + 2.0 * c * rho[:, 1] ** 2,
        ]
    )
    by_a, by_b = -2.0 * b * np.sin(betas[0]), 2.0 * b * product * np.sin(betas[1])
    angles = np.sum(samples.sigma_bearing**2, axis=1)
    variance = np.sum((by_log * samples.sigma_log_ratio) ** 2, axis=1)
    return np.asarray(np.sqrt(variance + (by_a**2 + by_b**2) * angles), dtype=np.float64)


# --------------------------------------------------------------------------------------------
# Epipolar constraint


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
    turned = bearings[1][:, None] + rotation
    apart = turned - from_start
    parallax = np.sin(apart)
    from_a = np.sin(turned - direction) * parallax
    from_b = np.sin(from_start - direction) * parallax
    # What wraps angles takes longer than their cosines.
    parallel = np.cos(apart) > np.cos(least_parallax)
    return np.asarray(((from_a > 0.0) & (from_b > 0.0)) | parallel)


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


# --------------------------------------------------------------------------------------------
# Triangulation


def triangulate(matches: BearingMatches, direction: float, rotation: float) -> FloatArray:
    """(n,) distance d from the start, in legs; not positive or infinite where rays diverge."""
    seen_b = matches.bearing_b + rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.sin(seen_b - direction) / np.sin(seen_b - matches.bearing_a)
    return np.asarray(distance, dtype=np.float64)


def make_local_map(vector: TwoViewVector, matches: BearingMatches) -> LocalMap:
    """Triangulates all matches with their covariance, first order.

    The distance's uncertainty has two sources: both bearings' noise and the homing vector's own
    covariance. Identities are the rows of ``matches``; where :func:`triangulable` is False the
    distance means nothing.
    """
    theta, psi = vector.direction, vector.rotation
    distance = triangulate(matches, theta, psi)
    seen_b = matches.bearing_b + psi
    with np.errstate(divide="ignore", invalid="ignore"):
        parallax = np.sin(seen_b - matches.bearing_a)
        across = np.cos(seen_b - matches.bearing_a)
        # d = sin(phi - theta) / sin(phi - delta)
        by_phi = (np.cos(seen_b - theta) - distance * across) / parallax
        by_delta = distance * across / parallax
        by_theta = -np.cos(seen_b - theta) / parallax
    by_vector = np.stack([by_theta, by_phi], axis=1)
    own = (by_phi * matches.sigma[:, 2]) ** 2
    bearing = matches.sigma[:, 0] ** 2
    covariance = np.empty((len(matches), 2, 2))
    shared = np.einsum("ni,ij,nj->n", by_vector, vector.covariance, by_vector)
    covariance[:, 0, 0] = own + by_delta**2 * bearing + shared
    covariance[:, 0, 1] = covariance[:, 1, 0] = by_delta * bearing
    covariance[:, 1, 1] = bearing
    ids = np.arange(len(matches), dtype=np.int64)
    return LocalMap(ids, matches.bearing_a, distance, covariance)


def triangulable(local_map: LocalMap, max_relative_sigma: float) -> BoolArray:
    """(n,) whether a feature lies in front and its distance is known to this share of itself."""
    sigma = np.sqrt(local_map.covariance[:, 0, 0])
    with np.errstate(invalid="ignore"):
        good = (local_map.distance > 0.0) & (sigma < max_relative_sigma * local_map.distance)
    return np.asarray(good & np.isfinite(sigma))
