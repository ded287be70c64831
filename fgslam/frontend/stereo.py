"""Matching features over the rig and measuring disparity (Se et al. 2.2).

Right to left first; the survivors to the top image; a feature with more than one admissible
partner is ambiguous. Two-camera rigs use the same code without the last step.
"""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.features import Features, StereoFeatures
from fgslam.core.geometry import triangulate, triangulation_covariance
from fgslam.core.rig_correction import RigCorrection
from fgslam.core.sensors import (
    CameraRig,
    measurement_map,
    partial_map,
    pixel_covariance,
    rig_map,
    vertical_to_horizontal,
)
from fgslam.frontend.features.matching import alike, choose, pairs_within
from fgslam.frontend.features.settings import AppearanceSettings
from fgslam.frontend.settings import StereoSettings

Linear: TypeAlias = tuple[FloatArray, FloatArray]
"""A map (3, 2 * cameras) from pixels to (column, row, disparity), and their covariance (3, 3)."""


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
        paper = settings.measurement == "paper"
        ratio = self._vertical_to_horizontal
        self._map = measurement_map("paper", rig.cameras, ratio) if paper else rig_map(rig)

    def match(
        self, features: tuple[Features, ...], correction: RigCorrection | None = None
    ) -> StereoFeatures:
        """Matches (right, left[, top]) features of one frame.

        They are matched and measured where an exact rig had found them, by the ``correction``; the
        raw pixels stay as they are.
        """
        straight = features if correction is None else correction.straightened(features)
        pairs = self.match_left(straight[0], straight[1])
        return self._measure(features, straight, self._confirmed(straight, pairs))

    def match_all(
        self, features: tuple[Features, ...], correction: RigCorrection | None = None
    ) -> StereoFeatures:
        """The same, and after them what only two of three images show; ``complete`` tells them.

        The third image confirms what is new (Se et al. 2.2). A landmark is confirmed by the map
        that predicts it, and SIFT misses a fifth of all landmarks in each image, however small the
        motion. Without descriptors, as in the paper, one more candidate would only be ambiguous.
        """
        if len(features) == 2 or self._appearance.mode == "paper":
            return self.match(features, correction)
        straight = features if correction is None else correction.straightened(features)
        i, j = pairs = self.match_left(straight[0], straight[1])
        confirmed = self._confirmed(straight, pairs)
        whole = self._measure(features, straight, confirmed)
        n, k = self._match_along(1, straight[0], straight[2], self._vertical_to_horizontal)
        # What both images show, but not at one depth, is contradicted and not seen twice.
        beside = np.isin(i, np.union1d(n, confirmed[0]), invert=True)
        above = np.isin(n, i, invert=True)
        without_top = self._measure(features, straight, (i[beside], j[beside], None))
        without_left = self._measure(features, straight, (n[above], None, k[above]))
        every = whole.join(without_top).join(without_left)
        return dataclasses.replace(every, complete=np.arange(len(every)) < len(whole))

    def measured(
        self,
        found: tuple[Features, ...],
        linear: Linear,
        correction: RigCorrection | None = None,
    ) -> tuple[StereoFeatures, BoolArray]:
        """Stereo features of points found row by row in all images, and which (n,) can be right.

        The latter lie on the epipolar lines and at one depth, by the gates of :meth:`match`.
        ``linear`` is the map to measurements (:meth:`equally`, :meth:`by_reference`).
        """
        straight = found if correction is None else correction.straightened(found)
        s, right, left = self._settings, straight[0].xy, straight[1].xy
        horizontal = left[:, 0] - right[:, 0]
        good = np.abs(left[:, 1] - right[:, 1]) <= s.epipolar_px
        good &= (horizontal >= s.min_disparity_px) & (horizontal <= s.largest_disparity_px)
        if len(straight) > 2:
            top = straight[2].xy
            vertical = (top[:, 1] - right[:, 1]) * self._vertical_to_horizontal
            good &= np.abs(top[:, 0] - right[:, 0]) <= s.epipolar_px
            good &= np.abs(vertical - horizontal) <= s.disparity_agreement_px
        kept = np.flatnonzero(good)
        every = (kept,) * len(found)
        return self._measure(found, straight, every, linear), np.asarray(good)

    def equally(self, share: float) -> Linear:
        """By images alike good; ``share``: a coordinate's sigma over that of SIFT's."""
        return self._map, share**2 * self._independent(self._map)

    def by_reference(self) -> Linear:
        """As :meth:`equally`; the other images' places are shifts from the first one's."""
        of_pixels = pixel_covariance(self._rig.cameras, "reference")
        covariance = self._map @ of_pixels @ self._map.T
        covariance = 0.5 * (covariance + covariance.T)  # to the bit: logs keep one half
        return self._map, self._with_depth(self._settings.pixel_sigma**2 * covariance)

    def match_left(self, right: Features, left: Features) -> tuple[IntArray, IntArray]:
        """Pairs of right and left features, ascending in the right ones."""
        return self._match_along(0, right, left, 1.0)

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

    def _confirmed(
        self, features: tuple[Features, ...], pairs: tuple[IntArray, IntArray]
    ) -> tuple[IntArray, ...]:
        """The pairs that the third image confirms, with its features; all where there is none."""
        if len(features) == 2:
            return pairs
        kept, k = self.match_top(features[0], features[1], features[2], pairs)
        return pairs[0][kept], pairs[1][kept], k

    def _match_along(
        self, axis: int, right: Features, other: Features, to_horizontal: float
    ) -> tuple[IntArray, IntArray]:
        """Pairs (k,) with a camera beside the right one (``axis`` 0) or above it (1)."""
        s = self._settings
        i, j = pairs_within(right.xy[:, 1 - axis], s.epipolar_px, other.xy[:, 1 - axis])
        disparity = (other.xy[j, axis] - right.xy[i, axis]) * to_horizontal
        ok = (disparity >= s.min_disparity_px) & (disparity <= s.largest_disparity_px)
        i, j = i[ok], j[ok]
        ok = alike(
            (right.scale[i], other.scale[j]),
            (right.orientation[i], other.orientation[j]),
            s.scale_ratio,
            self._angle,
        )
        return choose(i[ok], j[ok], (right.descriptors, other.descriptors), self._appearance)

    def _measure(
        self,
        features: tuple[Features, ...],
        straight: tuple[Features, ...],
        matches: tuple[IntArray | None, ...],
        linear: Linear | None = None,
    ) -> StereoFeatures:
        """Matched features (n,) of each camera, None for one that does not show them."""
        seen = [(camera, m) for camera, m in enumerate(matches) if m is not None]
        first = seen[0][1]
        pixels = np.full((len(first), 3, 2), np.nan)
        for camera, index in seen:
            pixels[:, camera] = features[camera].xy[index]
        used = [straight[camera].xy[index] for camera, index in seen]
        cameras = [camera for camera, _ in seen]
        if linear is None:
            linear = self._linear(cameras, len(features))
        measurement = np.concatenate(used, axis=1) @ linear[0].T
        covariance = np.tile(linear[1], (len(pixels), 1, 1))
        scale, orientation = _average([(features[camera], index) for camera, index in seen])
        position = triangulate(self._rig, measurement)
        return StereoFeatures(
            measurement=measurement,
            measurement_covariance=covariance,
            scale=scale,
            orientation=orientation,
            descriptors=features[0].descriptors[first],
            position=position,
            position_covariance=triangulation_covariance(self._rig, measurement, covariance),
            pixels=pixels,
        )

    def _linear(self, seen: list[int], cameras: int) -> Linear:
        """The map from the pixels of SIFT features in the images ``seen``, all equally good."""
        linear = self._map
        if len(seen) < cameras:
            linear = partial_map(seen, cameras, self._vertical_to_horizontal)
        return linear, self._independent(linear)

    def _independent(self, linear: FloatArray) -> FloatArray:
        """Covariance (3, 3) by a map of coordinates with independent errors as those of SIFT."""
        return self._with_depth(self._settings.pixel_sigma**2 * (linear @ linear.T))

    def _with_depth(self, covariance: FloatArray) -> FloatArray:
        """Of (column, row, disparity) (3, 3), with that of a measured depth where one is."""
        if self._settings.disparity_sigma_px is not None:
            covariance[2, :] = covariance[:, 2] = 0.0
            covariance[2, 2] = self._settings.disparity_sigma_px**2
        return np.asarray(covariance)


def _average(pairs: list[tuple[Features, IntArray]]) -> tuple[FloatArray, FloatArray]:
    """Mean scale and circular mean orientation over the images (Se et al. 2.2)."""
    scale = np.mean([f.scale[m] for f, m in pairs], axis=0)
    angles = np.array([f.orientation[m] for f, m in pairs])
    orientation = np.arctan2(np.sin(angles).sum(axis=0), np.cos(angles).sum(axis=0))
    # The remainder of a tiny negative angle rounds up to the full turn itself.
    return scale, orientation % (2.0 * np.pi) % (2.0 * np.pi)
