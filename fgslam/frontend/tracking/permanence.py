"""Permanent landmarks: which qualify, and what contradicts one (Se et al. 6.2)."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.frontend.features.candidates import pairs_within
from fgslam.frontend.tracking.settings import PermanenceSettings
from fgslam.frontend.tracking.visibility import ExpectedLandmarks

_NEAR_PX = 40.0  # what is seen past a place is this near to it in the image
_APART_PX = 2.0
"""What lies before or behind a place has a disparity that differs by more."""


def reliable(hits: IntArray, misses: IntArray, settings: PermanenceSettings) -> BoolArray:
    """Landmarks (n,) seen often enough, at a share of the frames in which they were expected."""
    enough = hits >= settings.hits
    return np.asarray(enough & (hits > settings.ratio * (hits + misses)))


def is_blind(expected: ExpectedLandmarks, hit: BoolArray, settings: PermanenceSettings) -> bool:
    """True if so few of the landmarks well in view were matched (v,) that the view is blocked."""
    certain = int(expected.certain.sum())
    return int((hit & expected.certain).sum()) < settings.blind_below * certain


def seen_past(places: FloatArray, seen: FloatArray) -> BoolArray:
    """Places (m,) that the cameras see past, so that what is missed there is not there.

    Near the place in the image something lies behind it, and nothing before it that might hide it.
    That what surrounds a missed landmark is recognised says nothing: true landmarks are missed in
    many frames in a row for their scale or direction, while others beside them are not
    (docs/concepts/maps.md has the numbers).

    Args:
        places: (m, 3) predicted (column, row, disparity) of missed landmarks.
        seen: (f, 3) the frame's stereo features.
    """
    reach = _NEAR_PX
    i, j = pairs_within(places[:, 1], reach, seen[:, 1])
    near = np.hypot(*(seen[j, :2] - places[i, :2]).T) <= reach
    i, j = i[near], j[near]
    nearer_by = seen[j, 2] - places[i, 2]
    hidden, past = np.zeros(len(places), np.bool_), np.zeros(len(places), np.bool_)
    hidden[i[nearer_by > _APART_PX]] = True
    past[i[nearer_by < -_APART_PX]] = True
    return past & ~hidden
