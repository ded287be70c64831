"""From wide-baseline features to points that can be tracked (Goedemé et al. IV-A).

Features that are recognised from afar are rarely the points that are tracked best. Near each one
the point is chosen whose gradient matrix (eq. 2, summed over the window) has the largest
smaller eigenvalue. In the target image that point was not looked for: it lies where the own
frame of the feature puts it, as if its surroundings were a plane seen alike from both places.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import BoolArray, FloatArray, Image, IntArray
from fgslam.core.homing import BearingMatches, FeatureKind, OmniFeatures
from fgslam.core.planar import wrap
from fgslam.frontend.homing.bearing_tracking import (
    DISTINCT_PX,
    MIN_EIGENVALUE,
    PATCH_PX,
    SIGMA_PX,
    WINDOW_PX,
)

_PLANE_ERROR = 0.2
"""Part of the offset from the feature's centre by which its place in the target view is uncertain:
features are not flat, nor seen head on."""

_SEARCH_PX = 3.0
"""The best trackable point is sought within the feature's scale, at least this far from its centre
and at most three times as far."""


def move_to_trackable(
    grey: Image,
    view: Equirectangular,
    matches: BearingMatches,
    features: tuple[OmniFeatures, OmniFeatures],
) -> tuple[IntArray, FloatArray, BearingMatches]:
    """Replaces features by trackable points.

    Args:
        grey: (height, width - 1) view of the start image; its rows continue over the seam.
        view: its camera.
        matches: of start and target.
        features: of start and target, those that the matches index.

    Returns:
        Rows (m,) of ``matches`` that have such a point, the points (m, 2) in the view, and the
        matches (m) of the points.
    """
    if not len(matches):
        return np.empty(0, dtype=np.int64), np.empty((0, 2)), matches
    radius = _search_radius(matches, features[0], view)
    centres = _in_view(matches, view)
    strength = _strength(grey, WINDOW_PX)
    points, strongest = _best_near(strength, centres, radius)
    rim = max(WINDOW_PX, PATCH_PX) / 2.0
    good = (strongest >= MIN_EIGENVALUE) & (points[:, 1] >= rim)
    good &= points[:, 1] <= view.height - 1 - rim
    good &= _distinct(points, strongest, DISTINCT_PX)
    rows = np.flatnonzero(good)
    ratio = _scale_ratio(matches, *features)
    moved = _moved(matches, points - centres, ratio, view)
    chosen = points[rows]
    chosen[:, 0] %= view.width - 1
    return rows, chosen, moved.select(rows)


def _search_radius(
    matches: BearingMatches, features: OmniFeatures, view: Equirectangular
) -> FloatArray:
    """(n,) pixels: a feature's own size, within bounds."""
    a_radian = (view.width - 1) / (2.0 * np.pi)
    size = np.zeros(len(matches))
    sift = matches.kind == int(FeatureKind.SIFT)
    size[sift] = features.sift.scale[matches.index_a[sift]] * a_radian
    return np.clip(size, _SEARCH_PX, 3.0 * _SEARCH_PX)


def _in_view(matches: BearingMatches, view: Equirectangular) -> FloatArray:
    """(n, 2) pixels of the features in the start's view."""
    columns = (np.pi - matches.bearing_a) * (view.width - 1) / (2.0 * np.pi)
    a_row = (view.top_elevation - view.bottom_elevation) / (view.height - 1)
    return np.column_stack([columns, (view.top_elevation - matches.elevation_a) / a_row])


def _strength(grey: Image, window: int) -> FloatArray:
    """(h, w) smaller eigenvalue of eq. 2, a pixel of the window; the seam is continued."""
    padded = cv2.copyMakeBorder(grey, 0, 0, window, window, cv2.BORDER_WRAP)
    strength = cv2.cornerMinEigenVal(padded, window, ksize=3)
    return np.asarray(strength[:, window:-window], dtype=np.float64)


def _best_near(
    strength: FloatArray, centres: FloatArray, radius: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Strongest whole pixel within a radius of each centre, and its strength; -1 where none is."""
    height, period = strength.shape
    reach = int(np.ceil(np.max(radius)))
    down, across = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    nearest = np.rint(centres).astype(np.int64)
    rows = nearest[:, 1, None] + down.ravel()
    columns = nearest[:, 0, None] + across.ravel()
    distance = np.hypot(columns - centres[:, :1], rows - centres[:, 1:])
    inside = (rows >= 0) & (rows < height) & (distance <= radius[:, None])
    value = strength[np.clip(rows, 0, height - 1), columns % period]
    value = np.where(inside, value, -1.0)
    best = np.argmax(value, axis=1)
    at = np.arange(len(centres))
    points = np.column_stack([columns[at, best], rows[at, best]]).astype(np.float64)
    return points, value[at, best]


def _distinct(points: FloatArray, strength: FloatArray, apart: float) -> BoolArray:
    """(n,) the strongest of each cluster of points; of equals the first."""
    kept = np.zeros(len(points), dtype=np.bool_)
    free = np.ones(len(points), dtype=np.bool_)
    near = np.hypot(*(points[:, None] - points).transpose(2, 0, 1)) < apart
    for k in np.argsort(-strength, kind="stable"):
        if free[k]:
            kept[k] = True
            free &= ~near[k]
    return kept


def _scale_ratio(matches: BearingMatches, a: OmniFeatures, b: OmniFeatures) -> FloatArray:
    """(n,) size of a feature in the target over its size in the start image."""
    ratio = np.ones(len(matches))
    sift = matches.kind == int(FeatureKind.SIFT)
    of_a, of_b = matches.index_a[sift], matches.index_b[sift]
    ratio[sift] = b.sift.scale[of_b] / a.sift.scale[of_a]
    of_a, of_b = matches.index_a[~sift], matches.index_b[~sift]
    length_a, length_b = np.ptp(a.columns.tangents[of_a], 1), np.ptp(b.columns.tangents[of_b], 1)
    ratio[~sift] = length_b / length_a
    return ratio


def _moved(
    matches: BearingMatches,
    offset: FloatArray,
    ratio: FloatArray,
    view: Equirectangular,
) -> BearingMatches:
    """Matches of points at pixel offsets (n, 2) from the features."""
    a_column = 2.0 * np.pi / (view.width - 1)
    a_row = (view.top_elevation - view.bottom_elevation) / (view.height - 1)
    left, up = -offset[:, 0] * a_column, -offset[:, 1] * a_row
    # The point is a pixel of the start image, known as well as a track; in the target it has the
    # feature's own uncertainty, and that of its offset.
    off_plane = _PLANE_ERROR * ratio * np.hypot(left, up)
    sigma = matches.sigma.copy()
    sigma[:, 0], sigma[:, 1] = SIGMA_PX * a_column, SIGMA_PX * a_row
    sigma[:, 2:] = np.hypot(sigma[:, 2:], off_plane[:, None])
    return replace(
        matches,
        bearing_a=wrap(matches.bearing_a + left),
        elevation_a=matches.elevation_a + up,
        bearing_b=wrap(matches.bearing_b + ratio * left),
        elevation_b=matches.elevation_b + ratio * up,
        sigma=sigma,
    )
