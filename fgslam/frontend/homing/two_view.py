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

from copy import copy
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.cameras.omni import OmniCamera, measure, unit_rays
from fgslam.core.arrays import BoolArray, ByteArray, Float32, FloatArray, Image, IntArray
from fgslam.core.bearings import (
    BearingMatches,
    ColumnSegments,
    FeatureKind,
    LocalMap,
    OmniFeatures,
    TwoViewVector,
    UprightFeatures,
)
from fgslam.core.geometry import GaussNewton, Linearised, skew, wrap
from fgslam.frontend.features.omni import up_in_image, whitened
from fgslam.frontend.settings import OmniMatchingSettings

LEAST_SEPARATION = np.deg2rad(5.0)
"""Bearing difference that two features need in one of the views: less is one vertical line."""

_CLAMP_SIGMAS = 3.0
"""A negative discriminant within so many of its standard deviations counts as a double root;
beyond, the sample is refused."""

_LOG_RATIO_SIGMA = 0.1
"""Of the paper's test, which states no bound: three of it, a third of a distance, found 0.88 of the
right matches at half a degree of noise (docs/derivations/homing_vector.md)."""

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
    apart = [np.abs(wrap(b[:, 1] - b[:, 0])) for b in (samples.bearing_a, samples.bearing_b)]
    ratios[np.maximum(*apart) < least_separation] = np.nan
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
        log_ratio: (n,) ln of tan(elevation_b) / tan(elevation_a), NaN where their signs differ.
    """

    coefficients: FloatArray
    derivatives: tuple[FloatArray, ...]
    bearing_a: FloatArray
    bearing_b: FloatArray
    log_ratio: FloatArray

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
        with np.errstate(divide="ignore", invalid="ignore"):
            log_ratio = np.log(np.tan(matches.elevation_b) / np.tan(matches.elevation_a))
        bearings = matches.bearing_a, matches.bearing_b
        return cls(_products(a, b), derivatives, *bearings, log_ratio)

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

    def by_ratios(self, direction: FloatArray, rotation: FloatArray) -> FloatArray:
        """(n, c) differences of the logarithms of both ratios of distances, over their deviation.

        As printed in III-B: ``d_1 / d_2`` is ``sin(gamma_2) / sin(gamma_1)`` of the bearings and
        ``tan(alpha_2) / tan(alpha_1)`` of the elevations. What has no ratio is infinitely far off.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            at_b = np.sin(self.bearing_b[:, None] + rotation - direction)
            ratio = at_b / np.sin(self.bearing_a[:, None] - direction)
            residual = (np.log(ratio) - self.log_ratio[:, None]) / _LOG_RATIO_SIGMA
        return np.asarray(np.nan_to_num(residual, nan=np.inf), dtype=np.float64)

    def inliers(
        self,
        direction: FloatArray,
        rotation: FloatArray,
        sigmas: float,
        least_parallax: float,
        printed: bool = False,
    ) -> tuple[BoolArray, FloatArray]:
        """(n, c) inliers of c hypotheses, and their normalised residuals.

        ``printed``: by the paper's two ratios.
        """
        residuals = (self.by_ratios if printed else self.normalised)(direction, rotation)
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


# --------------------------------------------------------------------------------------------
# Tentative correspondences of two omnidirectional images (Goedemé et al. III-A)
#
# SIFT features: the nearest descriptor, clearly nearer than the second, mutually; then the colour
# filter of eq. 1. Column segments: the nearest of the whitened vectors, likewise.
#
# Both images are taken on one plane. What no motion on it explains is left out *before* the nearest
# are sought, so it does not compete either: elevations of opposite sign, and apparent sizes that
# disagree with the elevations. A thing at height z and distance r has size ~ 1/r and sin(elevation)
# = z/r, so s_a / s_b = sin(e_a) / sin(e_b).


_MAX_COLUMN_DISTANCE = 4.4  # Mahalanobis, of 11 elements; 4.4 is exceeded by 5 % if normal
_MAX_COLOUR_DISTANCE = 0.2  # Euclidean, of (C_RB, C_RG, C_GB), of matched SIFT features
_COLUMN_RATIO = 0.7  # column segments: nearest over second nearest distance below this
_MAX_SCALE_RATIO = 2.0  # factor between the ratio of scales and that of the sines of the elevations
_HORIZON_MARGIN_DEG = 3.0  # elevations nearer to the horizon may have either sign


_ROUNDING = 1e-5
"""Of squared distances of unit vectors, sums of 128 products in float32: ten times what is seen."""


def match_features(
    a: OmniFeatures,
    b: OmniFeatures,
    settings: OmniMatchingSettings,
    squared: Float32 | None = None,
) -> BearingMatches:
    """Matches of both kinds: SIFT first, then column segments; each ascending in ``index_a``.

    Args:
        a: features of the present image.
        b: of the target image.
        settings: thresholds.
        squared: distances of their SIFT features as of :func:`planar_distances`, where they are
            known; they are not changed.
    """
    sift = match_sift(a.sift, b.sift, settings, squared)
    return sift.join(match_columns(a.columns, b.columns, settings))


# --------------------------------------------------------------------------------------------
# SIFT


def match_sift(
    a: UprightFeatures,
    b: UprightFeatures,
    settings: OmniMatchingSettings,
    squared: Float32 | None = None,
) -> BearingMatches:
    """Mutual nearest descriptors that are distinct, planar and of one colour."""
    if not len(a) or not len(b):
        return sift_matches(a, b, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    i, j, ratio = _mutual_nearest(planar_distances(a, b, settings) if squared is None else squared)
    colour = np.linalg.norm(a.colour[i] - b.colour[j], axis=1)
    keep = (ratio < settings.ratio) & (colour < _MAX_COLOUR_DISTANCE)
    return sift_matches(a, b, i[keep], j[keep], 1.0 - ratio[keep])


def planar_distances(
    a: UprightFeatures, b: UprightFeatures, settings: OmniMatchingSettings
) -> Float32:
    """(n, m) squared distances of descriptors, infinite where no motion on the plane explains."""
    squared = _squared_distances(a.descriptors, b.descriptors, settings.root)
    if settings.planar_gates:
        _forbid_impossible(squared, a, b)
    return squared


def _squared_distances(a: ByteArray, b: ByteArray, root: bool) -> Float32:
    x, y = _comparable(a, root), _comparable(b, root)
    norms = np.einsum("ij,ij->i", y, y)
    squared = x @ y.T
    squared *= -2.0
    squared += norms
    squared += np.einsum("ij,ij->i", x, x)[:, None]
    return np.asarray(squared, np.float32)


def _comparable(descriptors: ByteArray, root: bool) -> Float32:
    values = descriptors.astype(np.float32)
    if not root:
        return values
    total = np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    return np.asarray(np.sqrt(values / total), np.float32)


def _forbid_impossible(squared: Float32, a: UprightFeatures, b: UprightFeatures) -> None:
    """Sets distances of candidates to infinity that no planar motion explains."""
    margin = np.deg2rad(_HORIZON_MARGIN_DEG)
    side_a, side_b = _side(a.elevation, margin), _side(b.elevation, margin)
    apart = _height_in_sizes(a, margin)[:, None] - _height_in_sizes(b, margin)
    impossible = np.abs(apart, out=apart) > np.float32(np.log(_MAX_SCALE_RATIO))
    # Near the horizon in both views the elevations tell nothing about the sizes.
    impossible &= (side_a != 0)[:, None] | (side_b != 0)
    impossible |= side_a[:, None] * side_b < 0
    np.putmask(squared, impossible, np.inf)


def _side(elevation: FloatArray, margin: float) -> npt.NDArray[np.int8]:
    return np.where(np.abs(elevation) > margin, np.sign(elevation), 0.0).astype(np.int8)


def _height_in_sizes(features: UprightFeatures, margin: float) -> Float32:
    """(n,) log of |sin(elevation)| over the apparent size, the same from everywhere."""
    height = np.maximum(np.abs(np.sin(features.elevation)), np.sin(max(margin, 1e-3)))
    return np.log(height / features.scale).astype(np.float32)


def _mutual_nearest(squared: Float32) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows, columns, and nearest over second nearest distance of mutual nearest pairs.

    A candidate without any competing candidate has ratio 0.
    """
    every = np.arange(len(squared))
    j = squared.argmin(axis=1)
    mutual = squared.argmin(axis=0)[j] == every
    best = squared[every, j].astype(np.float64)
    squared[every, j] = np.inf
    second = squared.min(axis=1).astype(np.float64)
    squared[every, j] = best
    keep = mutual & np.isfinite(best)
    # Equal descriptors differ by rounding; two equal ones in a row compete all the same.
    best, second = (np.maximum(d[keep], _ROUNDING) for d in (best, second))
    return every[keep], j[keep], np.minimum(np.sqrt(best / second), 1.0)


def sift_matches(
    a: UprightFeatures, b: UprightFeatures, i: IntArray, j: IntArray, quality: FloatArray
) -> BearingMatches:
    """Features i (k,) of one view with features j of the other."""
    variances = [
        c[k, axis, axis] for c, k in ((a.covariance, i), (b.covariance, j)) for axis in (0, 1)
    ]
    return BearingMatches(
        kind=np.full(len(i), int(FeatureKind.SIFT), np.int64),
        index_a=i,
        index_b=j,
        bearing_a=a.bearing[i],
        elevation_a=a.elevation[i],
        bearing_b=b.bearing[j],
        elevation_b=b.elevation[j],
        sigma=np.sqrt(np.column_stack(variances)),
        quality=quality,
    )


# --------------------------------------------------------------------------------------------
# Column segments


def match_columns(
    a: ColumnSegments, b: ColumnSegments, settings: OmniMatchingSettings
) -> BearingMatches:
    """Mutual nearest whitened vectors that are distinct."""
    none = np.zeros(0, np.int64)
    if len(a) < 2 or len(b) < 2:
        return _column_matches(a, b, none, none, np.zeros(0))
    i, j, distance, ratio = nearest_segments(whitened(a.descriptors), whitened(b.descriptors))
    keep = (ratio < _COLUMN_RATIO) & (distance < _MAX_COLUMN_DISTANCE)
    return _column_matches(a, b, i[keep], j[keep], 1.0 - ratio[keep])


def nearest_segments(
    a: FloatArray, b: FloatArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Mutual nearest of vectors (n, k) and (m, k), n and m at least 2.

    Returns:
        Indices (k,) into ``a``, ascending, and into ``b``, the distance, and its ratio to that of
        the second nearest in ``b``.
    """
    # In as many dimensions as segments have elements a product of matrices outruns any tree. It
    # finds who is near; how near, down to no distance at all, is then taken from the vectors.
    squared = np.einsum("ij,ij->i", b, b) - 2.0 * (a @ b.T)
    i = np.arange(len(a))
    j = squared.argmin(axis=1)
    back = (squared + np.einsum("ij,ij->i", a, a)[:, None]).argmin(axis=0)
    squared[i, j] = np.inf
    other = squared.argmin(axis=1)
    i = np.flatnonzero(back[j] == i)
    best, second = (np.linalg.norm(a[i] - b[k[i]], axis=1) for k in (j, other))
    # A second one just as near, be it at no distance at all, competes in full.
    ratio = np.ones(len(i))
    np.divide(best, second, out=ratio, where=second > best)
    return i, j[i], best, ratio


def _column_matches(
    a: ColumnSegments, b: ColumnSegments, i: IntArray, j: IntArray, quality: FloatArray
) -> BearingMatches:
    tangents_a, tangents_b, factor = consistent_tangents(a.tangents[i], b.tangents[j])
    sigma_a = factor * a.sigma_tangents[i].mean(axis=1) / (1.0 + tangents_a**2)
    sigma_b = factor * b.sigma_tangents[j].mean(axis=1) / (1.0 + tangents_b**2)
    return BearingMatches(
        kind=np.full(len(i), int(FeatureKind.COLUMN), np.int64),
        index_a=i,
        index_b=j,
        bearing_a=a.bearing[i],
        elevation_a=np.arctan(tangents_a),
        bearing_b=b.bearing[j],
        elevation_b=np.arctan(tangents_b),
        sigma=np.column_stack([a.sigma_bearing[i], sigma_a, b.sigma_bearing[j], sigma_b]),
        quality=quality,
    )


def consistent_tangents(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One tangent of each view, their ratio the best estimate of e / d from both ends.

    The ends (low, high) of a segment are a vector that grows and shrinks with 1 / distance: a and b
    (n, 2) are parallel. With c the unit vector of their common direction, c.a / c.b is the ratio
    that both ends support most, also where one is at the horizon. The tangents that are returned
    are near the end that is further from the horizon, where something is to be seen.

    Returns:
        (n,) tangents in a and in b, and (n,) by what their standard deviation is that of an end.
    """
    along_a = np.hypot(a[:, 0], a[:, 1])
    along_b = np.hypot(b[:, 0], b[:, 1])
    common = a / along_a[:, None] + b / along_b[:, None]
    norm = np.hypot(common[:, 0], common[:, 1])
    common = common / np.maximum(norm, 1e-12)[:, None]
    end = np.argmax(np.abs(common), axis=1)
    share = common[np.arange(len(a)), end]
    return (
        np.einsum("ij,ij->i", a, common) * share,
        np.einsum("ij,ij->i", b, common) * share,
        np.abs(share),
    )


# --------------------------------------------------------------------------------------------
# How likely a match is right, and what a hypothesis that it agrees with gains by it
#
# A match much better than its runner-up is nearly always right, one barely better hardly ever.
# Counting both alike wastes what matching knows; so a hypothesis is supported by likelihoods
# (Tordoff and Murray 2005): with probability p of being right, a normalised epipolar residual r has
# density (1 - p) u + p N(r), u being what wrong matches have.


_LOGIT = {FeatureKind.SIFT: (-3.0, 10.5), FeatureKind.COLUMN: (-2.3, 3.5)}
"""Logit of p as a line over quality: offset and slope, by kind.

Measured on the 22 pairs of ``omni_home`` that were answered rightly, 8,555 SIFT matches and 876
column matches in bins of quality: SIFT 0.1 at 0.05, 0.4 at 0.22, 0.7 at 0.35, 0.9 at 0.6; columns
0.2 at 0.22, 0.3 at 0.4, 0.5 at 0.6.
"""
_LEAST, _MOST = 0.02, 0.95
_SCATTER = 1.2  # of right matches' residuals over their stated noise, measured on the same pairs
COMMON_CHANCE = 0.05
"""That a wrong match agrees with a hypothesis, while searching; an answer's own is measured."""
_SHARES = np.array([1.0, 0.5, 0.25, 0.1])
"""Scenes differ in how many of their matches survive; p is taken times each of these, evenly."""


def right_probability(matches: BearingMatches) -> FloatArray:
    """(n,) probability that a match is right, before any geometry."""
    p = np.empty(len(matches))
    for kind, (offset, slope) in _LOGIT.items():
        of_kind = matches.kind == int(kind)
        p[of_kind] = 1.0 / (1.0 + np.exp(-offset - slope * matches.quality[of_kind]))
    return np.clip(p, _LEAST, _MOST)


def gain(residuals: FloatArray, sigmas: float, chance: float) -> FloatArray:
    """N(r) / u: how much denser right residuals are than wrong ones; any shape.

    ``chance`` is the probability that a wrong match keeps within ``sigmas``.
    """
    density = np.exp(-0.5 * (residuals / _SCATTER) ** 2) / (_SCATTER * np.sqrt(2.0 * np.pi))
    return np.asarray(density * (2.0 * sigmas / chance))


def log_likelihood_ratio(gains: FloatArray, probability: FloatArray) -> float:
    """Log of how much better a hypothesis explains the matches than chance does.

    Args:
        gains: (n,) as from :func:`gain`, zero for matches that contradict it.
        probability: (n,) of being right.

    If all matches are wrong the ratio's expectation is 1; by Markov's inequality it exceeds x with
    probability 1 / x at most.
    """
    shares = _SHARES[:, None] * probability
    logs = np.sum(np.log1p(shares * (gains - 1.0)), axis=1)
    return float(np.logaddexp.reduce(logs) - np.log(len(_SHARES)))


# --------------------------------------------------------------------------------------------
# The baseline of all comparisons: SIFT as OpenCV has it


PLAIN_MATCHING = OmniMatchingSettings(ratio=0.8, root=False, planar_gates=False)
"""Lowe's ratio test alone, for :func:`plain_sift`."""


_PLAIN_SIGMA_PX = 1.2  # of a feature's place


def plain_sift(camera: OmniCamera, image: Image) -> UprightFeatures:
    """OpenCV's SIFT with its own parameters, orientations and all, on an image (h, w, 3).

    Features that the camera does not see are left out. There is no colour: it is zero.
    """
    detector = cv2.SIFT.create(enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(
        cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None
    )
    if descriptors is None:
        descriptors = np.zeros((0, 128), np.float32)
    table = np.array([(*k.pt, 0.5 * k.size) for k in keypoints], np.float64).reshape(-1, 3)
    bearing, elevation, covariance = measure(camera, table[:, :2], _PLAIN_SIGMA_PX)
    up = np.linalg.norm(up_in_image(camera, table[:, :2]), axis=1)
    seen = np.isfinite(bearing) & np.isfinite(up)
    return UprightFeatures(
        pixels=table[seen, :2],
        bearing=bearing[seen],
        elevation=elevation[seen],
        covariance=covariance[seen],
        scale=table[seen, 2] / up[seen],
        descriptors=np.asarray(descriptors, np.uint8)[seen],
        colour=np.zeros((int(seen.sum()), 3)),
    )


# --------------------------------------------------------------------------------------------
# Least-squares refinement of a homing vector on its inliers, with covariance
#
# The planar constraint supposes level cameras at one height. Real ones tilt by a fraction of a
# degree ("estimate or inflate"), which shifts elevations alike on whole sides of the view; so each
# view's roll and pitch and the difference of heights are estimated along with theta and psi, held
# by a prior. The residual is the epipolar one with general rotations, a weighted first-order
# (Sampson) distance, minimised with its noise's own slope: held, the noise that residual and
# derivative share would pull towards what explains less (Kanatani 1996).


_WIDENED = (4.0, 3.0, 2.0, 1.5)
"""Inliers' threshold in the first iterations: a hypothesis from two matches is a few degrees off,
and the matches that would pull it right are its outliers (1 to 2 degrees)."""
_MAD_TO_SIGMA = 1.4826
_SEARCH = GaussNewton(
    iterations=15,
    converged=1e-7,  # radians; a thousandth of the best covariance's square root
    settling=len(_WIDENED),
    longest=0.3,  # radians, legs
    damping=1e-3,  # of the information: a handful of inliers may leave a direction open
)
_LEAST_VARIANCE = 1e-24  # of a residual; a ray along the leg fits any of them
_LEAST_SHARE = 0.1  # of the information that is no noise; less leaves a direction open
_LEAST_SIGMA = 1e-6  # of a parameter that is not to be estimated; less spoils the conditioning


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A refined solution.

    Attributes:
        parameters: (7,) theta, psi, roll and pitch of a, roll and pitch of b (radians, about each
            camera's x and y axis), height of b above a in legs.
        covariance: (7, 7), widened by the residuals' scatter where that exceeds the stated noise.
        residuals: (n,) of all matches, normalised.
        inliers: (n,).
    """

    parameters: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    inliers: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """All matches (n) seen from parameters (c, 7).

    Attributes:
        residuals: (c, n) normalised.
        jacobian: (c, 7, n) their derivatives, sigma held.
        derivatives: (c, 7, 9) of E.
        noise: (c, 4, n) the residual's deviation by each of the four angles, not normalised.
        variance: (c, n) the sum of their squares.
    """

    residuals: FloatArray
    jacobian: FloatArray
    derivatives: FloatArray
    noise: FloatArray
    variance: FloatArray


def spread_over(near: list[Refined], scores: FloatArray, temper: float) -> FloatArray:
    """(2, 2) covariance of direction and rotation, of the first of solutions near each other.

    Each weighs by its likelihood exp(score), tempered: residuals have common causes, so that
    ``temper`` units of the score count as one.
    """
    weights = np.exp((scores - scores[0]) / temper)
    offsets = wrap(np.array([r.parameters[:2] for r in near]) - near[0].parameters[:2])
    spread = np.array([r.covariance[:2, :2] for r in near])
    spread = spread + offsets[:, :, None] * offsets[:, None, :]
    return np.asarray(np.tensordot(weights / np.sum(weights), spread, axes=1))


class HomingRefinement:
    """The matches, prepared for refining any number of hypotheses."""

    def __init__(
        self,
        matches: BearingMatches,
        prior: tuple[float, float],
        inlier_sigmas: float,
        least_parallax: float,
        right: FloatArray | None = None,
    ) -> None:
        """Prepares the matches.

        Args:
            matches: inliers and outliers.
            prior: standard deviations of the tilts (radians) and of the height (legs).
            inlier_sigmas: largest normalised residual of an inlier.
            least_parallax: radians; below, the signs of distances are noise.
            right: (n,) probability of being right before any geometry; None: by kind and quality.
        """
        a = unit_rays(matches.bearing_a, matches.elevation_a)
        b = unit_rays(matches.bearing_b, matches.elevation_b)
        by_a = ray_derivatives(matches.bearing_a, matches.elevation_a)
        by_b = ray_derivatives(matches.bearing_b, matches.elevation_b)
        # a^T E b is linear in E: one product of matrices gives all residuals and derivatives.
        self._outer = _outer(a, b)
        noisy = [_outer(d * matches.sigma[:, k, None], b) for k, d in enumerate(by_a)]
        noisy += [_outer(a, d * matches.sigma[:, k + 2, None]) for k, d in enumerate(by_b)]
        self._noisy = np.concatenate(noisy)
        self._bearings = matches.bearing_a, matches.bearing_b
        self._prior = _information_of(prior)
        right = right_probability(matches) if right is None else right
        self._odds = right / (1.0 - right)
        self._sigmas = inlier_sigmas
        self._least_parallax = least_parallax

    def held_by(self, prior: tuple[float, float]) -> HomingRefinement:
        """The same matches under a prior that is nowhere tighter, as of the constructor."""
        out = copy(self)
        out._prior = np.minimum(self._prior, _information_of(prior))
        return out

    def strain(self, solution: Refined) -> float:
        """Sum of the squared tilts and height over those of the prior."""
        return float(self._prior @ solution.parameters**2)

    def refine(self, directions: FloatArray, rotations: FloatArray) -> list[Refined]:
        """Gauss-Newton from hypotheses (c,), side by side; inliers are chosen again each time."""
        parameters = np.zeros((len(directions), 7))
        parameters[:, 0], parameters[:, 1] = directions, rotations
        parameters = _SEARCH.minimise(parameters, self._normal)
        parameters[:, :2] = wrap(parameters[:, :2])
        return self._finished(parameters)

    def _normal(self, parameters: FloatArray, iteration: int) -> Linearised:
        """Information (c, 7, 7) and gradient (c, 7) at parameters (c, 7)."""
        widened = _WIDENED[iteration] if iteration < len(_WIDENED) else 1.0
        view = self._linearised(parameters)
        weights = self._weights(parameters, view.residuals, widened)
        slope = view.jacobian - view.residuals[:, None] * self._noise_slope(view)
        gradient = (slope @ (weights * view.residuals)[:, :, None])[:, :, 0]
        gradient += self._prior * parameters
        return self._information(view.jacobian, weights), gradient

    def _information(self, jacobian: FloatArray, weights: FloatArray) -> FloatArray:
        """(c, 7, 7) of Jacobians (c, 7, n) and weights (c, n), with the prior's."""
        weighted = jacobian * weights[:, None]
        return np.asarray(weighted @ jacobian.transpose(0, 2, 1) + np.diag(self._prior))

    def _finished(self, parameters: FloatArray) -> list[Refined]:
        view = self._linearised(parameters)
        residuals = view.residuals
        inliers = self._inliers(parameters, residuals)
        weights = _matched_weights(self._weights(parameters, residuals), residuals)
        scatter = np.array([_scatter(r[kept]) for r, kept in zip(residuals, inliers, strict=True)])
        variance = scatter[:, None, None] ** 2
        noise = self._noise_information(view, weights) * variance
        covariances = _sandwich(self._information(view.jacobian, weights), noise)
        covariances *= np.maximum(variance, 1.0)
        return list(map(Refined, parameters, covariances, residuals, inliers))

    def _weights(
        self, parameters: FloatArray, residuals: FloatArray, widened: float = 1.0
    ) -> FloatArray:
        """(c, n) probability that each match is right, given how it fits."""
        inliers = self._inliers(parameters, residuals, widened)
        likely = self._odds * gain(residuals / widened, self._sigmas, COMMON_CHANCE)
        return inliers * likely / (1.0 + likely)

    def _inliers(
        self, parameters: FloatArray, residuals: FloatArray, widened: float = 1.0
    ) -> BoolArray:
        """(c, n), of (c, n) residuals."""
        theta, psi = parameters[:, 0], parameters[:, 1]
        ahead = in_front(self._bearings, theta, psi, self._least_parallax).T
        return np.asarray((np.abs(residuals) < widened * self._sigmas) & ahead)

    def _linearised(self, parameters: FloatArray) -> _Linearised:
        """All matches at parameters (c, 7)."""
        essential, derivatives = _essential(parameters)
        count = len(parameters)
        flat, by_each = essential.reshape(count, 9), derivatives.reshape(count, 7, 9)
        noise = (flat @ self._noisy.T).reshape(count, 4, -1)
        variance = np.maximum(np.einsum("ckn,ckn->cn", noise, noise), _LEAST_VARIANCE)
        sigma = np.sqrt(variance)
        residuals = flat @ self._outer.T / sigma
        jacobian = by_each @ self._outer.T / sigma[:, None]
        return _Linearised(residuals, jacobian, by_each, noise, variance)

    def _noise_slope(self, view: _Linearised) -> FloatArray:
        """(c, 7, n) derivatives of ln sigma of the residuals."""
        carried = np.einsum("ckn,kne->cen", view.noise, self._noisy.reshape(4, -1, 9))
        return np.asarray(view.derivatives @ carried / view.variance[:, None])

    def _noise_information(self, view: _Linearised, weights: FloatArray) -> FloatArray:
        """(c, 7, 7) what noise alone adds to the information: derivatives are of noisy rays.

        Noise in line with the residual moves it, and not its derivatives.
        """
        count = len(weights)
        by = (view.derivatives @ self._noisy.T).reshape(count, 7, 4, -1)
        along = np.einsum("ckn,cpkn->cpn", view.noise, by) / view.variance[:, None]
        by -= along[:, :, None] * view.noise[:, None]
        by *= np.sqrt(weights / view.variance)[:, None, None]
        flat = by.reshape(count, 7, -1)
        return np.asarray(flat @ flat.transpose(0, 2, 1))


def _information_of(prior: tuple[float, float]) -> FloatArray:
    """(7,) of the parameters, of deviations of tilts and height; theta and psi are free."""
    held = np.maximum([*[prior[0]] * 4, prior[1]], _LEAST_SIGMA)
    return np.concatenate([np.zeros(2), 1.0 / held**2])


def _matched_weights(weights: FloatArray, residuals: FloatArray) -> FloatArray:
    """(c, n) information of matches over that of right ones, by how likely they are right.

    Less what is missing as that is not known (Louis 1982).
    """
    return np.asarray(np.maximum(weights * (1.0 - (1.0 - weights) * residuals**2), 0.0))


def _sandwich(information: FloatArray, noise: FloatArray) -> FloatArray:
    """Covariances (c, 7, 7) of estimates whose information (c, 7, 7) is partly noise.

    The score's covariance is the information, its slope what is left of it without the noise:
    slope^-1 information slope^-1 (Godambe).
    """
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, _LEAST_VARIANCE))[:, None] ** -1.0
    inverse = root @ vectors.transpose(0, 2, 1)
    shares, axes = np.linalg.eigh(inverse @ noise @ inverse)
    left = np.maximum(1.0 - shares, _LEAST_SHARE)
    carried = inverse @ (axes / left[:, None])
    return np.asarray(carried @ carried.transpose(0, 2, 1))


def _scatter(residuals: FloatArray) -> float:
    """Robust standard deviation of inliers' residuals; 1 where there are none."""
    return _MAD_TO_SIGMA * float(np.median(np.abs(residuals))) if len(residuals) else 1.0


def _outer(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, 9) products of all coordinates of two rays (n, 3)."""
    return np.asarray((a[:, :, None] * b[:, None, :]).reshape(len(a), 9))


def _essential(p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """E (c, 3, 3) of parameters (c, 7), with a^T E b = 0, and its (c, 7, 3, 3) derivatives.

    E = A^T [t]x Rz(psi) B, with tilts A and B. Their derivatives are taken as if by a further small
    tilt, exact where the tilt itself vanishes.
    """
    c, s, none = np.cos(p[:, 0]), np.sin(p[:, 0]), np.zeros(len(p))
    tilts = _tilt(p[:, 2:6].reshape(-1, 2))  # those of both views at once
    tilt_a, tilt_b = tilts[::2].transpose(0, 2, 1), tilts[1::2]
    turn = _turn(p[:, 1])
    leg = skew(np.column_stack([c, s, p[:, 6]]))
    right, left = turn @ tilt_b, tilt_a @ leg
    middle, turned = leg @ right, left @ turn
    derivatives = np.stack(
        [
            tilt_a @ skew(np.column_stack([-s, c, none])) @ right,
            turned @ _AXES[2] @ tilt_b,
            -tilt_a @ _AXES[0] @ middle,
            -tilt_a @ _AXES[1] @ middle,
            turned @ _AXES[0] @ tilt_b,
            turned @ _AXES[1] @ tilt_b,
            tilt_a @ _AXES[2] @ right,
        ],
        axis=1,
    )
    return left @ right, derivatives


_AXES = skew(np.eye(3))


def _turn(angle: FloatArray) -> FloatArray:
    """(c, 3, 3) rotations about the vertical."""
    c, s = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    return np.asarray(np.eye(3) + s * _AXES[2] + (1.0 - c) * (_AXES[2] @ _AXES[2]))


def _tilt(vector: FloatArray) -> FloatArray:
    """(c, 3, 3) rotations by small vectors (roll, pitch, 0), (c, 2): Rodrigues' formula."""
    x, y = vector.T
    half_angle = 0.5 * np.hypot(x, y)
    # sin(a) / a and (1 - cos(a)) / a^2 by half angles, also where a vanishes.
    half = np.sinc(half_angle / np.pi)
    first, second = half * np.cos(half_angle), 0.5 * half**2
    out = np.empty((len(vector), 3, 3))
    out[:, 0, 0], out[:, 1, 1] = 1.0 - second * y * y, 1.0 - second * x * x
    out[:, 0, 1] = out[:, 1, 0] = second * x * y
    out[:, 2, 2] = 1.0 - second * (x * x + y * y)
    out[:, 0, 2], out[:, 1, 2] = first * y, -first * x
    out[:, 2, 0], out[:, 2, 1] = -first * y, first * x
    return out
