"""The planar two-point problem in closed form: two features in two views give the homing vector.

Section III-B of Goedemé et al. (2005), fig. 3. One feature's height
is the same for both cameras, so the ratio of its elevations' tangents is that of its distances,
``rho = e / d = tan(alpha_a) / tan(alpha_b)``. Two features and their bearings then make a
quadrangle with one unknown, ``k = d_2 / d_1``, the root of a quadratic. The paper implies a unique
answer; there are two wherever both features are nearer to the same camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.planar import wrap

LEAST_SEPARATION = np.deg2rad(5.0)
"""Bearing difference that two features need in one of the views: less is one vertical line."""

_ALIKE = 1e-12
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
    clamp_sigmas: float = 3.0,
    least_separation: float = LEAST_SEPARATION,
) -> TwoPointSolutions:
    """All solutions with positive distances; degenerate samples have none.

    Args:
        samples: as described.
        clamp_sigmas: a negative discriminant within so many of its standard deviations counts as
            a double root; beyond, the sample is refused.
        least_separation: of the two bearings in one of the views, radians.
    """
    rho = np.exp(samples.log_ratio)
    ratios = _distance_ratios(samples, rho, clamp_sigmas)
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


def _distance_ratios(samples: TwoPointSamples, rho: FloatArray, clamp_sigmas: float) -> FloatArray:
    """(s, 2) roots k of the quadratic A k^2 - 2 B k + C = 0, NaN where there is none."""
    between_a = samples.bearing_a[:, 1] - samples.bearing_a[:, 0]
    between_b = samples.bearing_b[:, 1] - samples.bearing_b[:, 0]
    # -expm1 keeps 1 - rho^2 exact where both distances are nearly equal.
    a, c = -np.expm1(2.0 * samples.log_ratio[:, 1]), -np.expm1(2.0 * samples.log_ratio[:, 0])
    product = rho[:, 0] * rho[:, 1]
    b = np.cos(between_a) - product * np.cos(between_b)
    discriminant = b * b - a * c
    spread = _discriminant_sigma(samples, rho, (a, b, c), (between_a, between_b))
    refused = discriminant < -clamp_sigmas * spread
    refused |= (np.abs(a) < _ALIKE) & (np.abs(c) < _ALIKE)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    q = b + np.where(b < 0.0, -root, root)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Where A vanishes q / A runs away to infinity and C / q is the paper's k = C / (2 B).
        first = np.where(np.abs(a) < _ALIKE, np.nan, q / a)
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
