"""The local map: features triangulated from start and target (III-C)."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.homing import BearingMatches, LocalMap, TwoViewVector


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
