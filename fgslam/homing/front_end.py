"""The front-end of homing for one omnidirectional camera: features, homing vector, tracking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgslam.cameras.omni import OmniCamera
from fgslam.core.arrays import ByteArray, FloatArray, IntArray
from fgslam.core.bearings import (
    BearingMatches,
    HomingStart,
    OmniFeatures,
    Refusal,
    RefusalReason,
    TrackedBearings,
    TwoViewVector,
)
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.homing.tracking import BearingTracker, move_to_trackable
from fgslam.frontend.homing.two_view import make_local_map, match_features, triangulable
from fgslam.frontend.homing.vector import estimate_homing_vector, re_paired
from fgslam.homing.active import Sighting
from fgslam.homing.features import best_all_around
from fgslam.homing.settings import FrontEndSettings

_MAX_POINTS = 50
"""Tracked in one homing, the surest of all directions alike: the paper finds 30 to 50 (IV-A), and
an image's cost grows with them."""

_STREAM = 8  # of the seed's random numbers; the simulated worlds have others
_SECTORS = 8  # of 45 degrees
_DARK = 8.0  # mean grey value of what the camera sees
_MAX_RELATIVE_SIGMA = 1.0  # of a distance; features known less well wait for parallax


class ImageFrontEnd:
    """Features, matches and tracks of a stream of images (h, w, 3) of one camera.

    ``begin`` and ``track`` are called with times that never decrease. One image may be given to
    ``track`` and then, at the same time, to ``begin``: so a homing starts where another one ends.
    """

    def __init__(
        self, camera: OmniCamera, settings: FrontEndSettings, rng: np.random.Generator
    ) -> None:
        """``rng`` chooses RANSAC's samples."""
        self._settings = settings
        self._rng = rng
        self._extractor = OmniFeatureExtractor(camera, settings.features)
        self._tracker = BearingTracker(camera)

    def describe(self, image: ByteArray) -> OmniFeatures:
        """Features of a path image; changes nothing.

        Raises FrameError where the image is not the camera's.
        """
        return self._extractor.extract(image)

    def begin(self, image: ByteArray, target: OmniFeatures, time: float) -> HomingStart | Refusal:
        """The initialisation step (section III); unless refused, its features are tracked now.

        A refusal leaves the tracks that there are alone.
        """
        answer = self._matched(image, target)
        if isinstance(answer, Refusal):
            return answer
        present, matches, vector = answer
        # Trackable points of the inliers, triangulated; those in front are tracked from now on.
        stabilised = self._tracker.stabilised
        _, pixels, points = move_to_trackable(
            stabilised.grey(image),
            stabilised.view,
            matches.select(vector.inliers),
            (present, target),
        )
        known = np.flatnonzero(triangulable(make_local_map(vector, points), _MAX_RELATIVE_SIGMA))
        known = known[surest_all_around(points.select(known), _MAX_POINTS)]
        points, pixels = points.select(known), pixels[known]
        least = self._settings.homing_vector.min_inliers
        if len(points) < least:
            return Refusal(
                RefusalReason.TOO_FEW_INLIERS,
                f"{len(points)} of {vector.support} inliers can be tracked, of {least} needed",
            )
        vector = replace(vector, inliers=np.ones(len(points), dtype=np.bool_))
        local_map = make_local_map(vector, points)
        self._tracker.start(image, time, local_map.ids, pixels)
        return HomingStart(time, vector, local_map, points)

    def look(self, image: ByteArray, target: OmniFeatures) -> Sighting | Refusal:
        """The homing vector and its inliers; leaves all tracks alone."""
        answer = self._matched(image, target)
        if isinstance(answer, Refusal):
            return answer
        _, matches, vector = answer
        return Sighting(vector, matches.select(vector.inliers))

    def track(self, image: ByteArray, time: float) -> TrackedBearings:
        """The features of the last ``begin`` in a new image; features once lost stay away.

        An image without any of them gives no rows; that is not an error. Raises as
        :meth:`BearingTracker.track`.
        """
        return self._tracker.track(image, time)

    def unwrapped(self, image: ByteArray) -> ByteArray:
        """(height, width) grey view that points are tracked in. Raises as :meth:`track`."""
        return self._tracker.stabilised.grey(image)

    def places(self, tracked: TrackedBearings) -> FloatArray:
        """(m, 2) column and row of tracked points in that view."""
        rise = np.tan(tracked.elevation)
        rays = np.column_stack([np.cos(tracked.bearing), np.sin(tracked.bearing), rise])
        return self._tracker.view.pixels(rays)

    def _matched(
        self, image: ByteArray, target: OmniFeatures
    ) -> tuple[OmniFeatures, BearingMatches, TwoViewVector] | Refusal:
        """Features of the image, their matches with the target's, and the homing vector."""
        present = self.describe(image)
        refusal = unusable(image, present)
        if refusal is not None:
            return refusal
        vector, matches = compare_views(present, target, self._settings, self._rng)
        return vector if isinstance(vector, Refusal) else (present, matches, vector)


def compare_views(
    present: OmniFeatures,
    target: OmniFeatures,
    settings: FrontEndSettings,
    rng: np.random.Generator,
) -> tuple[TwoViewVector | Refusal, BearingMatches]:
    """The homing vector between two images by their features alone, and the tentative matches."""
    matches = match_features(present, target, settings.features.matching)
    if settings.wrong_matches > 0.0:
        matches = mixed_with_wrong(matches, settings.wrong_matches, rng)
    return estimate_homing_vector(matches, settings.homing_vector, rng), matches


def make_front_end(camera: OmniCamera, settings: FrontEndSettings, seed: int) -> ImageFrontEnd:
    """The front-end of one drive, with a random generator of its own."""
    return ImageFrontEnd(camera, settings, np.random.default_rng((seed, _STREAM)))


def surest_all_around(matches: BearingMatches, most: int) -> IntArray:
    """Rows, ascending, of at most so many matches: the most distinctive of each sector in turn.

    Features on one side alone would leave the homing vector open along a valley.
    """
    order = np.argsort(-matches.quality, kind="stable")
    return best_all_around(matches.bearing_a, order, most, _SECTORS)


def mixed_with_wrong(
    matches: BearingMatches, share: float, rng: np.random.Generator
) -> BearingMatches:
    """Matches with wrong ones among them: features of two matches of one kind, as distinct.

    Args:
        matches: (n).
        share: of wrong ones among the (n + m) returned, in [0, 1).
        rng: which features are paired.
    """
    first, second = [], []
    for kind in np.unique(matches.kind):
        rows = np.flatnonzero(matches.kind == kind)
        extra = round(len(rows) * share / (1.0 - share)) if len(rows) > 1 else 0
        at = rng.integers(0, len(rows), extra)
        other = (at + rng.integers(1, max(len(rows), 2), extra)) % len(rows)
        first.append(rows[at])
        second.append(rows[other])
    if not first:
        return matches
    wrong = re_paired(matches, np.concatenate(first), np.concatenate(second))
    return matches.join(wrong)


def unusable(image: ByteArray, present: OmniFeatures) -> Refusal | None:
    """Refusal of an image (h, w, 3) that is too dark or has no features; None if it is usable."""
    # What is black is not seen, and adds nothing to the sum.
    lit = int(np.count_nonzero(image[..., 0] | image[..., 1] | image[..., 2]))
    brightness = float(np.sum(image)) / (3.0 * max(lit, 1))
    if brightness < _DARK:
        return Refusal(RefusalReason.TOO_DARK, f"mean grey value {brightness:.1f} of 255")
    if not len(present.sift) and not len(present.columns):
        return Refusal(RefusalReason.NO_FEATURES, "nothing to recognise in the present image")
    return None
