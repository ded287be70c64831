"""Matching features over the rig and measuring disparity (Se et al. 2.2).

Right to left first; the survivors to the top image; a feature with more than one admissible
partner is ambiguous. Two-camera rigs use the same code without the last step.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.features import Features, StereoFeatures
from fgslam.core.geometry import triangulate, triangulation_covariance
from fgslam.core.rig_correction import RigCorrection
from fgslam.core.sensors import CameraRig, measurement_map, vertical_to_horizontal
from fgslam.frontend.features.matching import alike, choose, pairs_within
from fgslam.frontend.features.settings import AppearanceSettings
from fgslam.frontend.settings import StereoSettings


class StereoMatcher:
    """Turns the features of a frame's images into matched stereo features with covariance."""

    def __init__(
        self, rig: CameraRig, settings: StereoSettings, appearance: AppearanceSettings
    ) -> None:
        """Prepares the linear map from raw pixels to (column, row, disparity) for this rig."""
        self._rig = rig
        self._settings = settings
        self._appearance = appearance
        self._angle = np.deg2rad(settings.orientation_deg)
        self._vertical_to_horizontal = vertical_to_horizontal(rig)
        self._map = measurement_map(settings.measurement, rig.cameras, self._vertical_to_horizontal)

    def match(
        self, features: tuple[Features, ...], correction: RigCorrection | None = None
    ) -> StereoFeatures:
        """Matches (right, left[, top]) features of one frame.

        They are matched and measured where an exact rig had found them, by the ``correction``; the
        raw pixels stay as they are.
        """
        straight = features if correction is None else correction.straightened(features)
        i, j = self.match_left(straight[0], straight[1])
        matches: tuple[IntArray, ...] = (i, j)
        if len(features) > 2:
            kept, k = self.match_top(straight[0], straight[1], straight[2], (i, j))
            matches = (i[kept], j[kept], k)
        return self._measure(features, straight, matches)

    def match_left(self, right: Features, left: Features) -> tuple[IntArray, IntArray]:
        """Pairs of right and left features, ascending in the right ones."""
        s = self._settings
        i, j = pairs_within(right.xy[:, 1], s.epipolar_px, left.xy[:, 1])
        disparity = left.xy[j, 0] - right.xy[i, 0]
        ok = (disparity >= s.min_disparity_px) & (disparity <= s.largest_disparity_px)
        i, j = i[ok], j[ok]
        ok = alike(
            (right.scale[i], left.scale[j]),
            (right.orientation[i], left.orientation[j]),
            s.scale_ratio,
            self._angle,
        )
        return choose(i[ok], j[ok], (right.descriptors, left.descriptors), self._appearance)

    def match_top(
        self, right: Features, left: Features, top: Features, pairs: tuple[IntArray, IntArray]
    ) -> tuple[IntArray, IntArray]:
        """Those of the right-left pairs that the top image confirms.

        Returns:
            Indices (k,) into the pairs, ascending, and (k,) into the top features.
        """
        s = self._settings
        i, j = pairs
        horizontal = left.xy[j, 0] - right.xy[i, 0]
        p, k = pairs_within(right.xy[i, 0], s.epipolar_px, top.xy[:, 0])
        vertical = (top.xy[k, 1] - right.xy[i[p], 1]) * self._vertical_to_horizontal
        ok = np.abs(vertical - horizontal[p]) <= s.disparity_agreement_px
        p, k = p[ok], k[ok]
        ok = alike(
            (right.scale[i[p]], top.scale[k]),
            (right.orientation[i[p]], top.orientation[k]),
            s.scale_ratio,
            self._angle,
        )
        descriptors = (right.descriptors[i], top.descriptors)
        return choose(p[ok], k[ok], descriptors, self._appearance)

    def _measure(
        self,
        features: tuple[Features, ...],
        straight: tuple[Features, ...],
        matches: tuple[IntArray, ...],
    ) -> StereoFeatures:
        pixels = np.full((len(matches[0]), 3, 2), np.nan)
        for camera, (found, index) in enumerate(zip(features, matches, strict=True)):
            pixels[:, camera] = found.xy[index]
        used = [found.xy[index] for found, index in zip(straight, matches, strict=True)]
        measurement = np.concatenate(used, axis=1) @ self._map.T
        variance = self._settings.pixel_sigma**2
        covariance = np.tile(variance * (self._map @ self._map.T), (len(pixels), 1, 1))
        scale, orientation = _average(features, matches)
        return StereoFeatures(
            measurement=measurement,
            measurement_covariance=covariance,
            scale=scale,
            orientation=orientation,
            descriptors=features[0].descriptors[matches[0]],
            position=triangulate(self._rig, measurement),
            position_covariance=triangulation_covariance(self._rig, measurement, covariance),
            pixels=pixels,
        )


def _average(
    features: tuple[Features, ...], matches: tuple[IntArray, ...]
) -> tuple[FloatArray, FloatArray]:
    """Mean scale and circular mean orientation over the images (Se et al. 2.2)."""
    pairs = list(zip(features, matches, strict=True))
    scale = np.mean([f.scale[m] for f, m in pairs], axis=0)
    angles = np.array([f.orientation[m] for f, m in pairs])
    orientation = np.arctan2(np.sin(angles).sum(axis=0), np.cos(angles).sum(axis=0))
    # The remainder of a tiny negative angle rounds up to the full turn itself.
    return scale, orientation % (2.0 * np.pi) % (2.0 * np.pi)
