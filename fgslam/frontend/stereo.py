"""Matching features over the rig and measuring disparity (Se et al. 2.2).

Right to left first; the survivors to the top image; a feature with more than one admissible
partner is ambiguous. Two-camera rigs use the same code without the last step.
"""

from __future__ import annotations

import numpy as np

from fgslam.frontend.candidates import alike, choose, pairs_within
from fgslam.geometry import triangulate, triangulation_covariance
from fgslam.settings.frontend import AppearanceSettings, StereoSettings
from fgslam.types import CameraRig, Features, FloatArray, IntArray, StereoFeatures


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
        # Vertical disparity times this is horizontal disparity (1 for the paper's rig).
        self._vertical_to_horizontal = (
            1.0
            if rig.vertical_baseline is None
            else rig.fx * rig.baseline / (rig.fy * rig.vertical_baseline)
        )
        self._map = measurement_map(settings.measurement, rig.cameras, self._vertical_to_horizontal)

    def match(self, features: tuple[Features, ...]) -> StereoFeatures:
        """Matches (right, left[, top]) features of one frame."""
        right, left = features[0], features[1]
        i, j = self.match_left(right, left)
        if len(features) == 2:
            return self._measure(features, (i, j))
        kept, k = self.match_top(right, left, features[2], (i, j))
        return self._measure(features, (i[kept], j[kept], k))

    def match_left(self, right: Features, left: Features) -> tuple[IntArray, IntArray]:
        """Pairs of right and left features, ascending in the right ones."""
        s = self._settings
        i, j = pairs_within(right.xy[:, 1], s.epipolar_px, left.xy[:, 1])
        disparity = left.xy[j, 0] - right.xy[i, 0]
        ok = (disparity >= s.min_disparity_px) & (disparity <= s.max_disparity_px)
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
        self, features: tuple[Features, ...], matches: tuple[IntArray, ...]
    ) -> StereoFeatures:
        pixels = np.full((len(matches[0]), 3, 2), np.nan)
        for camera, (found, index) in enumerate(zip(features, matches, strict=True)):
            pixels[:, camera] = found.xy[index]
        used = pixels[:, : len(features)].reshape(len(pixels), 2 * len(features))
        measurement = used @ self._map.T
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


def measurement_map(kind: str, cameras: int, vertical_to_horizontal: float) -> FloatArray:
    """Linear map (3, 2 * cameras) from pixels (c, r) per camera to (column, row, disparity).

    The covariance of the measurement follows as ``sigma^2 M M^T`` for equal independent noise on
    all coordinates. For `paper`, d is the mean of both disparities, which correlates with row and
    column (design B4); `fused` is the least-squares solution of the rig's linear model, which
    for three cameras has variances 5/12, 5/12 and 3/4 against the paper's 1, 1 and 1.
    """
    model = np.zeros((2 * cameras, 3))
    model[0::2, 0] = 1.0  # columns of right, left, top
    model[1::2, 1] = 1.0  # rows
    model[2, 2] = 1.0  # the left camera's column grows by the disparity
    if cameras == 3:
        model[5, 2] = 1.0 / vertical_to_horizontal  # and the top camera's row
    if kind == "fused":
        return np.asarray(np.linalg.pinv(model), np.float64)
    out = np.zeros((3, 2 * cameras))
    out[0, 0] = out[1, 1] = 1.0
    # Weights inverse to the variances; one half each where both baselines are equal.
    weight = 1.0 if cameras == 2 else _horizontal_weight(vertical_to_horizontal)
    out[2, 2], out[2, 0] = weight, -weight
    if cameras == 3:
        out[2, 5] = (1.0 - weight) * vertical_to_horizontal
        out[2, 1] = -out[2, 5]
    return out


def _horizontal_weight(vertical_to_horizontal: float) -> float:
    squared = vertical_to_horizontal**2
    return squared / (1.0 + squared)


def _average(
    features: tuple[Features, ...], matches: tuple[IntArray, ...]
) -> tuple[FloatArray, FloatArray]:
    """Mean scale and circular mean orientation over the images (Se et al. 2.2; S7)."""
    pairs = list(zip(features, matches, strict=True))
    scale = np.mean([f.scale[m] for f, m in pairs], axis=0)
    angles = np.array([f.orientation[m] for f, m in pairs])
    orientation = np.arctan2(np.sin(angles).sum(axis=0), np.cos(angles).sum(axis=0))
    # The remainder of a tiny negative angle rounds up to the full turn itself.
    return scale, orientation % (2.0 * np.pi) % (2.0 * np.pi)
