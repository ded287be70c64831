"""Matching a frame's features to the landmarks expected in view (Se et al. 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.features import StereoFeatures
from fgslam.frontend.features.candidates import alike, pairs_within, pick, resembling
from fgslam.frontend.features.settings import AppearanceSettings
from fgslam.frontend.tracking.settings import MapMatchingSettings
from fgslam.frontend.tracking.visibility import ExpectedLandmarks

_SCALE_RATIO = 1.5
"""Largest ratio to the predicted scale: one level of the scale space (Se et al., IJRR 2002)."""

_ORIENTATION_DEG = 20.0  # largest difference to the predicted orientation, as between images


@dataclass(frozen=True, slots=True, eq=False)
class MapMatches:
    """Matches between expected landmarks and features.

    Attributes:
        landmarks: (k,) indices into the expected landmarks, ascending.
        features: (k,) indices into the features.
        had_candidates: (n,) features that resemble a landmark near by, matched or ambiguous: they
            start no landmark, which would make the ambiguity worse.
    """

    landmarks: IntArray
    features: IntArray
    had_candidates: BoolArray


class MapMatcher:
    """Search window, disparity, scale and orientation gates, then the appearance."""

    def __init__(self, settings: MapMatchingSettings, appearance: AppearanceSettings) -> None:
        """Takes the gates and the use of descriptors."""
        self._settings = settings
        self._appearance = appearance
        self._limit = 0.5 * settings.max_window_px

    @property
    def widens(self) -> bool:
        """True if the gates widen with the predicted uncertainty."""
        return self._settings.widen_sigmas > 0.0

    @property
    def refines(self) -> bool:
        """True if a frame is matched a second time, around the pose found."""
        return self._settings.refine

    def match_anywhere(self, expected: ExpectedLandmarks, features: StereoFeatures) -> MapMatches:
        """Matches within the largest window, regardless of the predicted uncertainty."""
        reach = np.full((len(expected), 3), self._limit)
        return self._match_within(expected, features, reach)

    @property
    def rescues(self) -> bool:
        """Whether :meth:`match_anywhere` is to be tried where too few match.

        Never without descriptors: in so large a window all would be ambiguous.
        """
        return self._settings.rescue and self._appearance.mode == "descriptor"

    def match(
        self,
        expected: ExpectedLandmarks,
        features: StereoFeatures,
        uncertainty: FloatArray | None = None,
    ) -> MapMatches:
        """Matches one frame.

        Args:
            expected: landmarks in view with predicted characteristics.
            features: the frame's stereo features.
            uncertainty: (v, 3) standard deviations of the predicted (column, row, disparity) by
                which the gates are widened; None keeps the fixed window.
        """
        return self._match_within(expected, features, self._reach(len(expected), uncertainty))

    def _match_within(
        self, expected: ExpectedLandmarks, features: StereoFeatures, reach: FloatArray
    ) -> MapMatches:
        i, j = pairs_within(expected.measurement[:, 1], reach[:, 1], features.measurement[:, 1])
        offset = np.abs(features.measurement[j] - expected.measurement[i])
        near = (offset <= reach[i]).all(axis=1)
        i, j = i[near], j[near]
        same = alike(
            (expected.scale[i], features.scale[j]),
            (expected.orientation[i], features.orientation[j]),
            _SCALE_RATIO,
            np.deg2rad(_ORIENTATION_DEG),
        )
        descriptors = (expected.descriptors, features.descriptors)
        pairs = resembling(i[same], j[same], descriptors, self._appearance)
        had_candidates = np.zeros(len(features), np.bool_)
        had_candidates[pairs[1]] = True
        return MapMatches(*pick(pairs, self._appearance), had_candidates)

    def _reach(self, count: int, uncertainty: FloatArray | None) -> FloatArray:
        """Half widths (v, 3) of the gates in column, row and disparity."""
        s = self._settings
        half = 0.5 * s.window_px
        base = np.array([half, half, s.disparity_px])
        if uncertainty is None:
            return np.tile(base, (count, 1))
        widened = base + s.widen_sigmas * uncertainty
        return np.asarray(np.minimum(widened, np.maximum(self._limit, base)))
