"""What a homing needs of the camera and the image processing behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from fgslam.core.arrays import ByteArray
from fgslam.core.homing import (
    HomingStart,
    OmniFeatures,
    Refusal,
    TrackedBearings,
    TwoViewVector,
)


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A target seen by the side, without tracks of its features.

    Attributes:
        vector: the homing vector.
        parallax: median of its inliers, radians; see
            :func:`fgslam.homing.bearing_consistency.parallax`.
    """

    vector: TwoViewVector
    parallax: float


class HomingFrontEnd(Protocol):
    """Features, matches and tracks of a stream of images (h, w, 3).

    ``begin`` and ``track`` are called with times that never decrease. One image may be given to
    ``track`` and then, at the same time, to ``begin``: so a homing starts where another one ends.
    """

    def describe(self, image: ByteArray) -> OmniFeatures:
        """What is remembered of a path image; changes nothing."""
        ...

    def begin(self, image: ByteArray, target: OmniFeatures, time: float) -> HomingStart | Refusal:
        """Matches the image with a target and, unless refused, tracks these features from now on.

        A refusal leaves the tracks that there are alone.
        """
        ...

    def look(self, image: ByteArray, target: OmniFeatures) -> Sighting | Refusal:
        """Matches the image with a target, and leaves all tracks alone."""
        ...

    def track(self, image: ByteArray, time: float) -> TrackedBearings:
        """The features of the last ``begin`` in a new image; features once lost stay away.

        An image without any of them gives no rows; that is not an error.
        """
        ...
