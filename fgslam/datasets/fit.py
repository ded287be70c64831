"""Whether a calibration fits the images that it rectifies, by matches in the first pairs."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress

import cv2
import numpy as np

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import FrameError

_PAIRS = 3  # that are looked at
_TRIED = 12  # frames, until so many could be read
_FEATURES = 800
_WIDE_PX = 400  # wider images are made smaller: a misfit is large
_RATIO = 0.8
_FEWEST_MATCHES = 60
"""In all pairs; below, nothing is reported."""
_ROW_PX = 2.0  # at 640 columns: rows of a sound pair agree within half a pixel
_LEAST_SHARE = 1.0 / 3.0
"""Of matches whose rows agree, wrong matches included. Real pairs by their own calibration: 0.74 to
0.96 (chessboards whose pattern repeats, a room); by another's: 0.01 to 0.16."""
_MOST_NEGATIVE = 0.5
"""Of disparities: wrong matches make a tenth so."""


def fit_notes(load: Callable[[int], tuple[Image, ...]], count: int) -> tuple[str, ...]:
    """What rectified pairs say against their calibration, in one line; empty where it fits.

    Args:
        load: rectified images (right, left[, top]) of a frame, 0 <= index < count; may raise
            FrameError.
        count: how many frames there are.
    """
    pairs: list[tuple[Image, ...]] = []
    for index in range(min(count, _TRIED)):
        with suppress(FrameError):
            pairs.append(load(index)[:2])
        if len(pairs) == _PAIRS:
            break
    found = [_matched(*pair) for pair in pairs]
    if sum(map(len, found)) < _FEWEST_MATCHES:
        return ()
    offsets = np.concatenate(found)
    wide = pairs[0][0].shape[1]
    limit = _ROW_PX * max(1.0, wide / 640.0)
    share = float(np.mean(np.abs(offsets[:, 1]) < limit))
    negative = float(np.mean(offsets[:, 0] < 0.0))
    swapped = "; left and right look swapped" if negative > _MOST_NEGATIVE else ""
    if share < _LEAST_SHARE:
        middle = float(np.median(offsets[:, 1]))
        return (
            f"the calibration does not fit the images: in the first {len(found)} pairs the rows of "
            f"{len(offsets)} matches differ by {middle:+.1f} px (median), {100.0 * share:.0f} % by "
            f"less than {limit:.0f} px{swapped}; give the calibration of these cameras as they are "
            "now, or swap left and right",
        )
    if swapped:
        return (
            f"left and right are swapped: {100.0 * negative:.0f} % of {len(offsets)} matches in "
            f"the first {len(found)} pairs have negative disparity; swap the images",
        )
    return ()


def _matched(right: Image, left: Image) -> FloatArray:
    """(n, 2) column and row in the left minus those in the right image, of features that match."""
    detector = cv2.SIFT.create(_FEATURES)
    factor = max(1, math.ceil(right.shape[1] / _WIDE_PX))
    size = (right.shape[1] // factor, right.shape[0] // factor)
    (there, a), (here, b) = (
        detector.detectAndCompute(cv2.resize(image, size, interpolation=cv2.INTER_AREA), None)
        for image in (left, right)
    )
    if a is None or b is None or len(a) < 2 or len(b) < 2:
        return np.empty((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {pair[0].queryIdx: pair[0].trainIdx for pair in matcher.knnMatch(a, b, 1)}
    kept = [
        (first.queryIdx, first.trainIdx)
        for first, second in matcher.knnMatch(b, a, 2)
        if first.distance < _RATIO * second.distance and back[first.trainIdx] == first.queryIdx
    ]
    moved = [np.subtract(there[j].pt, here[i].pt) for i, j in kept]
    return np.asarray(factor * np.array(moved, np.float64).reshape(-1, 2))
