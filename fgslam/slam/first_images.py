"""Remarks on images that stereo matching cannot use: swapped cameras, darkness, 12-bit values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.results import RunRecorder

_FRAMES = 10  # judged: what is wrong with cables, drivers or calibration is wrong from the start
_FEWEST = 3  # frames: one or two may show a blank wall
_LEAST_MATCHED = 0.02
"""Of the right image's features, share that finds its partner. Of swapped images only what agrees
by chance does, under 0.01 (rendered lab with three cameras, kitti06); of sound ones a third and
more (those two, the light field, the drone, the suburb). Of two swapped cameras up to 0.13 agree
in the lab, 0.07 in euroc_v101: those the camera watch finds."""
_DARK = 15
"""Largest grey value of a dark image, of 255: 12-bit values reach 4095, of which the upper eight of
16 bits are 15."""


class FirstImages:
    """What the first images of a session were like."""

    def __init__(self) -> None:
        """No image yet."""
        self._frames = 0
        self._left: list[int] = []  # features, where they were sought
        self._spread = np.zeros((0, 2))  # standard deviations of grey values, right and left
        self._brightest = 0
        self._uint16 = False

    def add(self, found: FeatureFrame, uint16: bool) -> None:
        """Counts a frame with features; ``uint16``: they were given so."""
        if found.frame is None or not found.features or self._frames >= _FRAMES:
            return
        self._frames += 1
        self._left += [len(own) for own in found.features[1:2]]
        spread = [float(image.std()) for image in found.frame.images[:2]]
        self._spread = np.vstack([self._spread, spread])
        self._brightest = max(self._brightest, *(int(image.max()) for image in found.frame.images))
        self._uint16 |= uint16

    def left(self) -> str:
        """What the left images have: features, or contrast; empty where there was no image."""
        if self._left or not self._frames:
            return f"{np.mean(self._left):.0f} in the left image" if self._left else ""
        right, left = self._spread.mean(axis=0)
        return f"grey values vary by {right:.0f} in the right image, by {left:.0f} in the left one"

    def lost_bits(self) -> str:
        """That bits were given which are not used; empty where none were."""
        if not self._frames or self._brightest > _DARK or not self._uint16:
            return ""
        return (
            f"of uint16 the upper eight bits count, and they reach {self._brightest} of 255: "
            "shift 12-bit values to 16 bits (image << 4)"
        )

    def fault(self) -> str:
        """What is wrong with the grey values: bits lost, or darkness; empty where nothing is."""
        if not self._frames or self._brightest > _DARK:
            return ""
        dark = f"the images are dark, their largest grey value is {self._brightest} of 255"
        return self.lost_bits() or dark


def any_uint16(images: Sequence[npt.ArrayLike]) -> bool:
    """True if one of the images is an array of 16 bits a value."""
    return any(getattr(image, "dtype", None) == np.uint16 for image in images)


def stereo_remarks(recorder: RunRecorder, seen: FirstImages | None = None) -> tuple[str, ...]:
    """A remark where the first frames with images have next to no stereo match, or lost bits."""
    rows = [row for row in recorder.rows if not row.problem][:_FRAMES]
    features, matched = sum(row.features for row in rows), sum(row.stereo for row in rows)
    if len(rows) < _FEWEST:
        return ()
    seen = seen or FirstImages()
    if matched > _LEAST_MATCHED * features:
        return (seen.lost_bits(),) if seen.lost_bits() else ()
    n = len(rows)
    found = f"no stereo matches in the first {n} frames: {features / n:.0f} features in the right"
    found += f" image, {matched / n:.0f} of them matched"
    if seen.fault():
        return (f"{found}; {seen.fault()}",)
    if seen.left():
        found += f" ({seen.left()})"
    if not features:
        return (f"{found}; are the images dark, or 12-bit values in 16-bit images?",)
    return (f"{found}; are left and right swapped, or the images not rectified?",)
