"""Which landmarks last, and what speaks against one that is said to (Se et al. 6.2; S36)."""

from __future__ import annotations

import numpy as np

from fgslam.frontend.candidates import pairs_within
from fgslam.frontend.visibility import ExpectedLandmarks
from fgslam.settings.frontend import PermanenceSettings
from fgslam.types import BoolArray, FloatArray, IntArray

_APART_PX = 2.0  # disparities that differ by more are of different depths; a match's noise is 0.3


def reliable(hits: IntArray, misses: IntArray, settings: PermanenceSettings) -> BoolArray:
    """Landmarks (n,) seen often enough, at a share of the frames in which they were expected."""
    enough = hits >= settings.hits
    return np.asarray(enough & (hits > settings.ratio * (hits + misses)))


def is_blind(expected: ExpectedLandmarks, hit: BoolArray, settings: PermanenceSettings) -> bool:
    """Whether so few of the landmarks well in view were matched (v,) that the view is blocked."""
    certain = int(expected.certain.sum())
    return int((hit & expected.certain).sum()) < settings.blind_below * certain


def clearly_absent(
    places: FloatArray, seen: FloatArray, known: BoolArray, near_px: float
) -> BoolArray:
    """Places (m,) that the frame sees clearly, so that what is missed there is not there.

    Near the place in the image something lies behind it, so the cameras see past it, or a landmark
    was matched, so they recognise what surrounds it; and nothing lies before it that might hide it.

    Args:
        places: (m, 3) predicted (column, row, disparity) of missed landmarks.
        seen: (f, 3) the frame's stereo features.
        known: (f,) those that matched a landmark and agree with the pose.
        near_px: how near is near, in the image.
    """
    i, j = pairs_within(places[:, 1], near_px, seen[:, 1])
    near = np.hypot(*(seen[j, :2] - places[i, :2]).T) <= near_px
    i, j = i[near], j[near]
    nearer_by = seen[j, 2] - places[i, 2]
    hidden, clear = np.zeros(len(places), np.bool_), np.zeros(len(places), np.bool_)
    hidden[i[nearer_by > _APART_PX]] = True
    clear[i[known[j] | (nearer_by < -_APART_PX)]] = True
    return clear & ~hidden
