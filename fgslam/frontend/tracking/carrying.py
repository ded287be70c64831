"""Landmarks carried from image to image by their patches, and across to the other cameras (KLT).

A landmark keeps the patch of the reference image in which SIFT found it. In the next image the
pyramid of Lucas and Kanade (Bouguet 2001) finds where it went, started where the predicted pose
expects it, and one patch alignment (:mod:`fgslam.frontend.features.patches`) holds it to its own
patch, so that errors do not add up. The same patch, as deformed by then, is aligned in the other
images where the predicted disparity expects it: all coordinates are of one physical point.
What survives has the patch's looks in every image and lies on the epipolar lines.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Image, IntArray, Rows
from fgslam.core.features import (
    CUT_PIXELS,
    PATCH_PX,
    WHOLE_PX,
    Features,
    LandmarkPatches,
    StereoFeatures,
)
from fgslam.core.rig_correction import RigCorrection
from fgslam.core.sensors import CameraRig
from fgslam.core.store import Kept
from fgslam.frontend.features.fine_image import FineImage, Float32
from fgslam.frontend.features.patches import (
    ReferencePatches,
    align,
    anchor_at,
    crowding,
    cut_out,
)
from fgslam.frontend.patch_stereo import DEFORMATION, GREY_NOISE, across
from fgslam.frontend.stereo import StereoMatcher
from fgslam.frontend.tracking.map_matching import ExpectedLandmarks

_MIN_CORRELATION = 0.65  # of a patch with its first look, gain and offset taken out
_FARTHEST_PX = 2.0  # between what the search found and the patch: beyond, it is another thing
_MARGIN_PX = 4.0  # of the patch's middle to the border of the reference image
_PYRAMID_LEVELS = 2
_SEARCH = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.03)
_MIN_EIGENVALUE = 1e-4
_ALIGNMENTS = 2  # in the reference image, after the search
_FIRST_ALIGNMENTS = 4  # where SIFT finds a landmark again: nothing has refined its place before
_FARTHEST_FLOW = 0.06
"""Of the image's width: where the landmarks are expected to have moved farther in the median,
patches are not looked for at all: half of them would be lost (EuRoC's key frames)."""


NOISE_SHARE = 0.6
"""Sigma of a carried coordinate over that of a SIFT one."""


@dataclass(frozen=True, slots=True, eq=False)
class Carried(Rows):
    """Landmarks found again by their patches.

    Attributes:
        ids: (k,) ascending.
        rows: (k,) which of the expected landmarks they are, ascending.
        features: as measured in all images, with the looks that were expected of them.
    """

    ids: IntArray
    rows: IntArray
    features: StereoFeatures

    @staticmethod
    def nothing() -> Carried:
        """No landmark."""
        none = np.empty(0, np.int64)
        return Carried(none, none, StereoFeatures.empty())


@dataclass(frozen=True, slots=True, eq=False)
class Points(Rows):
    """Landmarks in a reference image: identities (n,) ascending, places (n, 2), depths (n,)."""

    ids: IntArray
    places: FloatArray
    depths: FloatArray

    @staticmethod
    def none() -> Points:
        """No landmark."""
        return Points(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0))


@dataclass(frozen=True, slots=True, eq=False)
class Begun(Rows):
    """Landmarks that are carried from a reference image on, with their own patches.

    Attributes:
        points: where they are in it.
        cut: (n, m) grey values of their patches with a rim, as first seen.
        growth: (n,) sizes in this image over those in the patch.
        known: (n,) whose patch is of an earlier image: they may look different by now.
    """

    points: Points
    cut: Float32
    growth: FloatArray
    known: BoolArray

    @staticmethod
    def none() -> Begun:
        """No landmark."""
        cut = np.empty((0, CUT_PIXELS), np.float32)
        return Begun(Points.none(), cut, np.empty(0), np.empty(0, np.bool_))

    @staticmethod
    def new(reference: FineImage, points: Points) -> Begun:
        """First seen in this image, of which their patches are cut."""
        cut = cut_out(reference, points.places, PATCH_PX)
        return Begun(points, cut, np.ones(len(cut)), np.zeros(len(cut), np.bool_))

    @staticmethod
    def again(points: Points, patches: LandmarkPatches) -> Begun:
        """Seen before: those that have a patch."""
        growth = patches.distances / points.depths
        known = np.ones(len(growth), np.bool_)
        every = Begun(points, patches.grey.astype(np.float32), growth, known)
        return every.select(np.isfinite(growth) & (growth > 0.0))

    def patches(self, image: Image) -> LandmarkPatches:
        """As they are kept; none of those that reach beyond the border of the image by far.

        What is repeated there would pull what is found again to the image's side.
        """
        height, width = image.shape[:2]
        whole = _inside(self.points.places, WHOLE_PX, (width, height))
        grey = np.clip(np.rint(self.cut), 0, 255).astype(np.uint8)  # between pixels it overshoots
        return LandmarkPatches(grey, np.where(whole, self.growth * self.points.depths, 0.0))


class LandmarkCarrier:
    """The patches of the landmarks in view, and the last reference image."""

    _last: Kept[FineImage | None]
    _points: Kept[Points]
    _patches: Kept[ReferencePatches]
    _fresh: Kept[Begun]

    def __init__(self, rig: CameraRig, stereo: StereoMatcher) -> None:
        """Carries nothing yet; ``stereo`` measures, by its gates."""
        self._rig = rig
        self._stereo = stereo
        self._last = None
        self._points = Points.none()
        self._patches = ReferencePatches.none(PATCH_PX)
        self._fresh = Begun.none()  # of the last image, their patches yet to be looked for

    @property
    def ids(self) -> IntArray:
        """(n,) landmarks with a patch, ascending."""
        return np.union1d(self._points.ids, self._fresh.points.ids)

    def reference(self, image: Image) -> FineImage:
        """The image as the last reference: that of the frame which was followed, if it is the same.

        A frame's image is one array from beginning to end, and the next frame's is another.
        """
        if self._last is None or self._last.image is not image:
            self._last = FineImage(image)
        return self._last

    def begin(self, image: Image, begun: Begun) -> None:
        """Landmarks seen in the reference image are carried from here, in place of older ones.

        Their patches are worked on only when they are looked for: a frame that is given up before
        costs nothing.
        """
        self._keep(~np.isin(self._points.ids, begun.points.ids))
        self._last, self._fresh = self.reference(image), begun

    def forget(self, ids: IntArray) -> None:
        """Carries these no further."""
        self._keep(~np.isin(self._points.ids, ids))

    def follow(
        self,
        images: tuple[Image, ...],
        expected: ExpectedLandmarks,
        correction: RigCorrection | None = None,
    ) -> Carried | None:
        """The landmarks in the next frame; the others are forgotten.

        None where there are none to look for, or all have moved too far.

        Args:
            images: right, left[, top].
            expected: landmarks of the map where the predicted pose expects them.
            correction: of the rig; None where its calibration is taken as stated.
        """
        last, now = self._last, FineImage(images[0])
        self._last = now
        self._keep(np.isin(self._points.ids, expected.ids))
        self._fresh = self._fresh.select(np.isin(self._fresh.points.ids, expected.ids))
        if last is None or not self._within_reach(expected):
            self._points, self._fresh = Points.none(), Begun.none()
            self._patches = ReferencePatches.none(PATCH_PX)
            return None
        patches = self._anchored(last)
        if not len(self._points):  # all that was to be carried looks different by now
            return None
        rows = np.searchsorted(expected.ids, self._points.ids)
        predicted = expected.measurement[rows]
        depths = self._rig.fx * self._rig.baseline / predicted[:, 2]
        # What comes nearer grows.
        maps = patches.maps * (self._points.depths / depths)[:, None, None]
        patches = dataclasses.replace(patches, maps=maps)
        patches, places, good = self._in_reference(last, now, patches, predicted)
        pixels = [places]
        for camera in range(1, len(images)):
            seen, alike = across(
                self._rig, FineImage(images[camera]), camera, patches, places, predicted[:, 2]
            )
            pixels.append(seen)
            good &= alike >= _MIN_CORRELATION
        looks = (expected.scale[rows], expected.orientation[rows], expected.descriptors[rows])
        found = tuple(Features(seen, *looks).select(good) for seen in pixels)
        features, consistent = self._stereo.measured(
            found, self._stereo.equally(NOISE_SHARE), correction
        )
        good[good] = consistent
        features = features.noisier(crowding(places[good], PATCH_PX))
        self._points = Points(self._points.ids[good], places[good], depths[good])
        self._patches = patches.select(good)
        return Carried(self._points.ids, rows[good], features)

    # ----------------------------------------------------------------------------------------

    def _keep(self, keep: BoolArray) -> None:
        self._points = self._points.select(keep)
        self._patches = self._patches.select(keep)

    def _within_reach(self, expected: ExpectedLandmarks) -> bool:
        """False where there is nothing to look for, or the image has moved too far."""
        flow = []
        for points in (self._points, self._fresh.points):
            there = expected.measurement[np.searchsorted(expected.ids, points.ids), :2]
            flow.append(np.linalg.norm(there - points.places, axis=1))
        moved = np.concatenate(flow)
        return bool(len(moved)) and float(np.median(moved)) <= _FARTHEST_FLOW * self._rig.width

    def _anchored(self, last: FineImage) -> ReferencePatches:
        """The patches of all points, those of the fresh ones found in the last image first."""
        fresh, self._fresh = self._fresh, Begun.none()
        if len(fresh.points):
            new, begun = self.find_again(last, fresh)
            patches, points = self._patches.join(new), self._points.join(begun)
            order = np.argsort(points.ids)
            self._points, self._patches = points.select(order), patches.select(order)
        return self._patches

    def find_again(self, last: FineImage, fresh: Begun) -> tuple[ReferencePatches, Points]:
        """Patches and places of landmarks begun in an image; what looks different by now is left.

        Those known from before are placed by their own patch, not by SIFT.
        """
        patches = anchor_at(fresh.cut, PATCH_PX, GREY_NOISE, DEFORMATION)
        known, points = fresh.known, fresh.points
        old, at = patches.select(known), points.places[known]
        old = dataclasses.replace(old, maps=old.maps * fresh.growth[known, None, None])
        old, found, correlation = _aligned(old, last, at, _FIRST_ALIGNMENTS)
        alike = (correlation >= _MIN_CORRELATION) & self._inside(found, _MARGIN_PX)
        maps, places, keep = patches.maps.copy(), points.places.copy(), ~known
        maps[known], places[known] = old.maps, found
        keep[known] = alike & (np.linalg.norm(found - at, axis=1) < _FARTHEST_PX)
        points = dataclasses.replace(points, places=places)
        return dataclasses.replace(patches, maps=maps).select(keep), points.select(keep)

    def _in_reference(
        self,
        last: FineImage,
        now: FineImage,
        patches: ReferencePatches,
        predicted: FloatArray,
    ) -> tuple[ReferencePatches, FloatArray, BoolArray]:
        """Patches as deformed now, places (n, 2), and which (n,) are the same things."""
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            last.image, now.image, self._points.places.astype(np.float32),
            predicted[:, :2].astype(np.float32), None, None, (PATCH_PX, PATCH_PX),
            _PYRAMID_LEVELS, _SEARCH, cv2.OPTFLOW_USE_INITIAL_FLOW, _MIN_EIGENVALUE,
        )  # fmt: skip
        at = np.asarray(found, np.float64)
        patches, places, correlation = _aligned(patches, now, at, _ALIGNMENTS)
        good = (status[:, 0] == 1) & (correlation >= _MIN_CORRELATION)
        good &= np.linalg.norm(places - at, axis=1) < _FARTHEST_PX
        return patches, places, np.asarray(good & self._inside(places, _MARGIN_PX))

    def _inside(self, places: FloatArray, margin: float) -> BoolArray:
        return _inside(places, margin, (self._rig.width, self._rig.height))


def _inside(places: FloatArray, margin: float, size: tuple[int, int]) -> BoolArray:
    """Which places (n, 2) lie so far from the border of an image of this width and height."""
    last = np.array(size) - 1.0 - margin
    return np.asarray(((places >= margin) & (places <= last)).all(axis=1))


_POINTS = Points.__slots__
_BEGUN = ("cut", "growth", "known")
_PATCH_ARRAYS = ("first", "light", "step", "contrast", "maps")


def _aligned(
    patches: ReferencePatches, view: FineImage, places: FloatArray, times: int
) -> tuple[ReferencePatches, FloatArray, FloatArray]:
    """Patches, places and correlations after so many alignments."""
    correlation = np.empty(0)
    for _ in range(times):
        patches, places, correlation = align(patches, view, places)
    return patches, places, correlation
