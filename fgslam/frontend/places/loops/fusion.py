"""Landmarks that are one: found twice because the second time was not known to be a return."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.features import LandmarkAppearances
from fgslam.frontend.features.candidates import choose
from fgslam.frontend.features.settings import AppearanceSettings


def duplicates(
    landmarks: LandmarkMap,
    looks: LandmarkAppearances,
    sides: tuple[IntArray, IntArray],
    within_m: float,
    appearance: AppearanceSettings,
) -> IntArray:
    """Pairs (m, 2) of identities (that ends, that stays) near each other that look alike.

    Args:
        landmarks: the map, corrected: what is one lies in one place.
        looks: stored views of the landmarks on both sides.
        sides: (a,) identities that may end, (b,) identities that may stay; none in both.
        within_m: largest distance.
        appearance: how alike; each must be the other's closest, clearly.
    """
    (new, new_at), (old, old_at) = (_one_view_each(looks, ids) for ids in sides)
    if not len(new) or not len(old):
        return np.empty((0, 2), np.int64)
    i, j = _near(_positions(landmarks, new), _positions(landmarks, old), within_m)
    i, j = choose(i, j, (looks.descriptors[new_at], looks.descriptors[old_at]), appearance)
    return np.column_stack([new[i], old[j]]).astype(np.int64)


def _one_view_each(looks: LandmarkAppearances, ids: IntArray) -> tuple[IntArray, IntArray]:
    """Identities with a stored view, and the row of the first one of each."""
    known, first = np.unique(looks.ids, return_index=True)
    chosen = np.isin(known, ids)
    return known[chosen], first[chosen]


def _positions(landmarks: LandmarkMap, ids: IntArray) -> FloatArray:
    return np.asarray(landmarks.positions[landmarks.rows(ids)])


def _near(a: FloatArray, b: FloatArray, within_m: float) -> tuple[IntArray, IntArray]:
    """All pairs (k,), (k,) of rows within a distance, ascending in the first."""
    found = cKDTree(b).query_ball_point(a, within_m, return_sorted=True)
    counts = np.array([len(near) for near in found])
    j = np.concatenate([np.array(near, np.int64) for near in found])
    return np.repeat(np.arange(len(a)), counts), j
