"""Matching features over the rig and measuring disparity (Se et al. 2.2).

Right to left first; the survivors to the top image; a feature with more than one admissible
partner is ambiguous. Two-camera rigs use the same code without the last step.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import TypeAlias

import cv2
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Image, IntArray
from fgslam.core.correction import RigCorrection
from fgslam.core.log import Frame, clearance
from fgslam.core.sensors import (
    UNKNOWN_DISPARITY_PX,
    CameraRig,
    measurement_map,
    partial_map,
    pixel_covariance,
    rig_map,
    vertical_to_horizontal,
)
from fgslam.core.types import PATCH_PX, Features, StereoFeatures
from fgslam.frontend.features.matching import alike, choose, pairs_within
from fgslam.frontend.features.patches import ReferencePatches, align, anchor
from fgslam.frontend.features.sift import GREY_NOISE, FineImage
from fgslam.frontend.settings import AppearanceSettings, StereoSettings

Linear: TypeAlias = tuple[FloatArray, FloatArray]
"""A map (3, 2 * cameras) from pixels to (column, row, disparity), and their covariance (3, 3)."""


_SCALE_RATIO = 1.5  # of partners' scales, at most: one level in IJRR 2002
_ORIENTATION = np.deg2rad(20.0)  # difference of partners' orientations, at most (IJRR 2002)
_FINE_IMAGES = 6  # of the frame and the one before
_DISPARITY_AGREEMENT_PX = 1.0  # between horizontal and vertical disparity, at most (IJRR 2002)


class StereoMatcher:
    """Turns the features of a frame's images into matched stereo features with covariance."""

    def __init__(
        self, rig: CameraRig, settings: StereoSettings, appearance: AppearanceSettings
    ) -> None:
        """Prepares the linear map from raw pixels to (column, row, disparity) for this rig."""
        self._rig = rig
        self._settings = settings
        self._appearance = appearance
        self._vertical_to_horizontal = vertical_to_horizontal(rig)
        paper = settings.measurement == "paper"
        ratio = self._vertical_to_horizontal
        self._map = measurement_map("paper", rig.cameras, ratio) if paper else rig_map(rig)
        self._fine: deque[FineImage] = deque(maxlen=_FINE_IMAGES)

    def fine(self, image: Image) -> FineImage:
        """The image with values between its pixels, which are found once for all who ask.

        A frame's image is one array from beginning to end, and the next frame's is another.
        """
        known = next((one for one in tuple(self._fine) if one.image is image), None)
        if known is None:
            known = FineImage(image)
            self._fine.append(known)
        return known

    def match(
        self, features: tuple[Features, ...], correction: RigCorrection | None = None
    ) -> StereoFeatures:
        """Matches (right, left[, top]) features of one frame.

        They are matched and measured where an exact rig had found them, by the ``correction``; the
        raw pixels stay as they are.
        """
        straight = features if correction is None else correction.straightened(features)
        pairs = self.match_left(straight[0], straight[1])
        return self._measure(features, straight, self._confirmed(straight, pairs), correction)

    def match_all(
        self, features: tuple[Features, ...], correction: RigCorrection | None = None
    ) -> StereoFeatures:
        """The same, and after them what only two of three images show; ``complete`` marks them.

        The third image confirms what is new (Se et al. 2.2). A landmark is confirmed by the map
        that predicts it, and SIFT misses a fifth of all landmarks in each image, however small the
        motion. Without descriptors, as in the paper, one more candidate would only be ambiguous.
        """
        if len(features) == 2 or self._appearance.mode == "paper":
            return self.match(features, correction)
        straight = features if correction is None else correction.straightened(features)
        i, j = pairs = self.match_left(straight[0], straight[1])
        confirmed = self._confirmed(straight, pairs)
        whole = self._measure(features, straight, confirmed, correction)
        n, k = self._match_along(1, straight[0], straight[2], self._vertical_to_horizontal)
        # What both images show, but not at one depth, is contradicted and not seen twice.
        aside = np.isin(i, np.union1d(n, confirmed[0]), invert=True)
        above = np.isin(n, i, invert=True)
        matches = (i[aside], j[aside], None), (n[above], None, k[above])
        without_top, without_left = (
            self._measure(features, straight, one, correction) for one in matches
        )
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
            good &= np.abs(vertical - horizontal) <= _DISPARITY_AGREEMENT_PX
        kept = np.flatnonzero(good)
        every = (kept,) * len(found)
        return self._measure(found, straight, every, correction, linear), np.asarray(good)

    def alone(
        self, camera: int, found: Features, correction: RigCorrection | None = None
    ) -> StereoFeatures:
        """Features of one camera's image as if it were the reference; disparities are unknown."""
        n = len(found.xy)
        straight = found
        if correction is not None:
            straight = correction.straightened((found,) * (camera + 1))[camera]
        measurement = np.column_stack([straight.xy, np.ones(n)])
        variance = np.repeat([self._settings.pixel_sigma, UNKNOWN_DISPARITY_PX], [2, 1]) ** 2
        covariance = np.tile(np.diag(variance), (n, 1, 1))
        pixels = np.full((n, 3, 2), np.nan)
        pixels[:, camera] = found.xy
        return StereoFeatures(
            measurement=measurement,
            measurement_covariance=covariance,
            scale=found.scale,
            orientation=found.orientation,
            descriptors=found.descriptors,
            position=self._rig.triangulate(measurement),
            position_covariance=self._rig.triangulation_covariance(measurement, covariance),
            pixels=pixels,
        )

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
        ok = np.abs(vertical - horizontal[p]) <= _DISPARITY_AGREEMENT_PX
        p, k = p[ok], k[ok]
        ok = alike(
            (right.scale[i[p]], top.scale[k]),
            (right.orientation[i[p]], top.orientation[k]),
            _SCALE_RATIO,
            _ORIENTATION,
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
        """Pairs (k,) with a camera next to the right one (``axis`` 0) or above it (1)."""
        s = self._settings
        i, j = pairs_within(right.xy[:, 1 - axis], s.epipolar_px, other.xy[:, 1 - axis])
        disparity = (other.xy[j, axis] - right.xy[i, axis]) * to_horizontal
        ok = (disparity >= s.min_disparity_px) & (disparity <= s.largest_disparity_px)
        i, j = i[ok], j[ok]
        ok = alike(
            (right.scale[i], other.scale[j]),
            (right.orientation[i], other.orientation[j]),
            _SCALE_RATIO,
            _ORIENTATION,
        )
        return choose(i[ok], j[ok], (right.descriptors, other.descriptors), self._appearance)

    def _measure(
        self,
        features: tuple[Features, ...],
        straight: tuple[Features, ...],
        matches: tuple[IntArray | None, ...],
        correction: RigCorrection | None,
        linear: Linear | None = None,
    ) -> StereoFeatures:
        """Matched features (n,) of each camera, None for one that does not show them."""
        seen = [(camera, m) for camera, m in enumerate(matches) if m is not None]
        first = seen[0][1]
        pixels = np.full((len(first), 3, 2), np.nan)
        for camera, index in seen:
            pixels[:, camera] = features[camera].xy[index]
        used = [straight[camera].xy[index] for camera, index in seen]
        if correction is not None:
            pairs = zip(seen, used, strict=True)
            used = [at - correction.by_direction(k, used[0], at) for (k, _), at in pairs]
        cameras = [camera for camera, _ in seen]
        if linear is None:
            linear = self._linear(cameras, len(features))
        measurement = np.concatenate(used, axis=1) @ linear[0].T
        covariance = np.tile(linear[1], (len(pixels), 1, 1))
        scale, orientation = _average([(features[camera], index) for camera, index in seen])
        position = self._rig.triangulate(measurement)
        return StereoFeatures(
            measurement=measurement,
            measurement_covariance=covariance,
            scale=scale,
            orientation=orientation,
            descriptors=features[0].descriptors[first],
            position=position,
            position_covariance=self._rig.triangulation_covariance(measurement, covariance),
            pixels=pixels,
        )

    def _linear(self, seen: list[int], cameras: int) -> Linear:
        """The map from the pixels of SIFT features in the images ``seen``, all equally good."""
        linear = self._map
        if len(seen) < cameras:
            linear = partial_map(tuple(seen), cameras, self._vertical_to_horizontal)
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


# ------------------------------------------------------------------------------------------
# Features of the reference image alone, measured in the other images by their patches

DEFORMATION = 0.05  # sigma of a patch's stretching between two images
ALIGNMENTS_ACROSS = 3  # in another camera's image, from a disparity known to a pixel or two
_MIN_CORRELATION = 0.8
"""Of a patch with what it is in another image, gain and offset taken out. Of patches whose partner
is elsewhere, or is none, two or three in a hundred reach it by chance."""

_BLOCK_PX = 9  # of the images of half the size: about a patch
_LARGEST_SHARE = 0.5  # of the image's width: the largest disparity looked for, where none is set
_UNIQUE_PERCENT = 10  # by which the best block must beat any other
_BELOW_ZERO = 2  # pixels of half the size that disparities may be too small, by the calibration
_FRACTIONS = 16.0  # of a pixel, in which OpenCV states disparities
_AT_ONCE = 8192  # patches, some ten kilobytes each; OpenCV samples less than 32767 rows at once


class PatchStereo:
    """Turns features of the reference image into stereo features."""

    def __init__(self, rig: CameraRig, stereo: StereoMatcher, largest_px: float) -> None:
        """``stereo`` measures, by its gates; disparities up to ``largest_px`` are looked for."""
        self._rig = rig
        self._stereo = stereo
        limit = largest_px if np.isfinite(largest_px) else _LARGEST_SHARE * rig.width
        reach = 0.5 * min(limit, rig.width) + _BELOW_ZERO
        self._margin = 16 * int(np.ceil(reach / 16.0))
        self._blocks = cv2.StereoBM.create(self._margin, _BLOCK_PX)
        self._blocks.setMinDisparity(-_BELOW_ZERO)
        self._blocks.setTextureThreshold(0)
        self._blocks.setUniquenessRatio(_UNIQUE_PERCENT)
        self._blocks.setDisp12MaxDiff(1)  # the same from either image

    def match(
        self, frame: Frame, found: Features, correction: RigCorrection | None = None
    ) -> StereoFeatures:
        """The features that all images show, measured in each.

        Args:
            frame: the images, right, left[, top], and where they show nothing.
            found: features of the right one.
            correction: of the rig; None where its calibration is taken as stated.
        """
        found = found.select(np.asarray(np.isfinite(found.xy).all(axis=1)))
        coarse = self._coarse(frame.images, found.xy)
        known = np.isfinite(coarse)
        found, coarse = found.select(known), coarse[known]
        views = [self._stereo.fine(image) for image in frame.images]
        pixels = np.empty((len(found.xy), len(frame.images), 2))
        good: BoolArray = np.empty(len(found.xy), np.bool_)
        for first in range(0, len(found.xy), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            pixels[some], good[some] = self._aligned(frame, views, found.xy[some], coarse[some])
        rest = (found.scale, found.orientation, found.descriptors)
        in_each = tuple(
            Features(pixels[:, camera], *rest).select(good) for camera in range(len(frame.images))
        )
        return self._stereo.measured(in_each, self._stereo.by_reference(), correction)[0]

    def _aligned(
        self, frame: Frame, views: list[FineImage], places: FloatArray, coarse: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, cameras, 2) of places (n, 2) in each image, and which all of them show."""
        patches = anchor(views[0], places, PATCH_PX, GREY_NOISE, DEFORMATION)
        good: BoolArray = np.ones(len(places), np.bool_)
        pixels = [places]
        for camera, view in enumerate(views[1:], 1):
            seen, alike = across(self._rig, view, camera, patches, places, coarse)
            pixels.append(seen)
            good &= alike >= _MIN_CORRELATION
        for margin, seen in zip(frame.margins, pixels, strict=False):  # none: all are full
            good &= clearance(margin, seen) > PATCH_PX // 2
        return np.stack(pixels, axis=1), good

    def _coarse(self, images: tuple[Image, ...], places: FloatArray) -> FloatArray:
        """Disparities (n,) at places (n, 2) of the right image, to a pixel or two; NaN unknown."""
        if min(images[0].shape) < 2 * _BLOCK_PX:
            return np.full(len(places), np.nan)
        table = self._blocks.compute(*(self._prepared(image) for image in images[:2]))
        at = np.rint((places - 0.5) / 2.0).astype(np.int64)
        width = table.shape[1] - self._margin - _BELOW_ZERO
        column = self._margin + np.clip(width - 1 - at[:, 0], 0, width - 1)
        found = table[np.clip(at[:, 1], 0, len(table) - 1), column].astype(np.float64)
        known = found >= -_FRACTIONS * _BELOW_ZERO
        return np.where(known, 2.0 * found / _FRACTIONS, np.nan)

    def _prepared(self, image: Image) -> Image:
        """The image at half its size, mirrored, with margins.

        OpenCV's reference is the left image: seen in a mirror, ours is. It measures nothing of what
        lies nearer to the border than the largest disparity.
        """
        half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        mirrored = cv2.flip(half, 1)
        sides = (0, 0, self._margin, _BELOW_ZERO)
        return np.asarray(cv2.copyMakeBorder(mirrored, *sides, cv2.BORDER_REPLICATE), np.uint8)


def across(
    rig: CameraRig,
    view: FineImage,
    camera: int,
    patches: ReferencePatches,
    places: FloatArray,
    disparity: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) of points in another camera's image, and how well (n,) they correlate there.

    Args:
        rig: the cameras.
        view: of the other camera.
        camera: 1 left, 2 top.
        patches: of the points, as they look in the reference image.
        places: (n, 2) there.
        disparity: (n,) expected, within a few pixels.
    """
    seen = places.copy()
    if camera == 1:
        seen[:, 0] += disparity
    else:
        seen[:, 1] += disparity / vertical_to_horizontal(rig)
    _, seen, correlation = align(patches, view, seen, ALIGNMENTS_ACROSS)
    last = np.array([rig.width, rig.height]) - 1.0
    inside = ((seen >= 0.0) & (seen <= last)).all(axis=1)
    return seen, np.where(inside, correlation, -1.0)


# ------------------------------------------------------------------------------------------
# Stereo features of a frame, from the features that were found in it


class RigStereo:
    """Measures features in all of a rig's images, whichever they were found in."""

    def __init__(self, matcher: StereoMatcher, patches: PatchStereo, by_patches: bool) -> None:
        """Takes what matches features of all images, and what measures those of the first.

        ``by_patches``: whether the latter is asked whatever images have features.
        """
        self.matcher = matcher
        self._patches = patches
        self._by_patches = by_patches

    def match(
        self,
        frame: Frame | None,
        features: tuple[Features, ...],
        correction: RigCorrection | None = None,
    ) -> StereoFeatures:
        """What all images show, then what only two of three do; empty without features.

        Args:
            frame: the images, right, left[, top]; patches need them.
            features: of the right image, or of each.
            correction: of the rig; None where its calibration is taken as stated.
        """
        if not features:
            return StereoFeatures.empty()
        if frame is not None and (self._by_patches or len(features) == 1):
            return self._patches.match(frame, features[0], correction)
        return self.matcher.match_all(features, correction)
