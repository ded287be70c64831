"""Frames tracked by carried landmarks, and when it takes a key frame instead.

On a key frame SIFT finds features in the reference image, whose patches are measured in the others
(:mod:`fgslam.frontend.stereo`); in all images where carried landmarks do not place the
camera. It describes the landmarks that are carried, finds again those that were lost, and starts
new ones. Between key frames the carried landmarks alone place the camera, and nothing is missed,
pruned or started.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np

from fgslam.core.arrays import BoolArray, Float32, FloatArray, Image, IntArray, Rows
from fgslam.core.correction import RigCorrection
from fgslam.core.sensors import CameraRig
from fgslam.core.store import Kept
from fgslam.core.types import (
    CUT_PIXELS,
    PATCH_PX,
    WHOLE_PX,
    Features,
    LandmarkMap,
    LandmarkPatches,
    Prediction,
    StereoFeatures,
)
from fgslam.frontend.features.patches import ReferencePatches, align, anchor_at, crowding, cut_out
from fgslam.frontend.features.sift import GREY_NOISE, FineImage
from fgslam.frontend.stereo import DEFORMATION, StereoMatcher, across
from fgslam.frontend.tracking.map_matching import ExpectedLandmarks, MapMatches
from fgslam.frontend.tracking.tracker import Association, LandmarkTracker, Tracked

_LEAST_SHARE = 0.4  # of the key frame's landmarks; fewer left take a new one
_LEAST_LANDMARKS = 40  # a pose by fewer is poor, whatever the key frame had
_LEAST_COVERAGE = 0.6  # of the image's cells that the key frame's landmarks covered
_MOST_REJECTED = 0.2
"""Of the carried landmarks: where more contradict the pose, something else moves, or patches went
lost. On real roads nine frames of ten stay below 0.12."""
_CELLS = (4, 3)  # columns, rows
_APART_PX = 5.0
"""Side of the squares of which each starts one landmark: a third of a patch. SIFT finds a sixth of
its features twice in one place, by two orientations, whose patches are the same measurement; of
patches that overlap by less each still adds to the pose."""


class KeyFrameTracker:
    """A tracker that is asked for matches of SIFT features on key frames only."""

    _carrier: Kept[LandmarkCarrier]
    _count: Kept[int]
    _cells: Kept[int]

    def __init__(self, tracker: LandmarkTracker, carrier: LandmarkCarrier) -> None:
        """Takes the tracker whose landmarks are carried."""
        self._tracker = tracker
        self._carrier = carrier
        self._count = 0  # landmarks of the last key frame
        self._cells = 0  # of the image that they covered
        self._left: tuple[int, ...] = (0, 0)  # of them, in the last two frames
        self._again = False  # whether it came right after another

    @property
    def nears_end(self) -> bool:
        """Whether the next frame is likely to be a key frame; what is found does not depend on it.

        If it loses as large a share as the last one did, or after two key frames in a row. Of a key
        frame's landmarks the first frame after it loses twice that: those that do not last. On
        three recordings 145 of the 156 frames expected to be key frames were, of 160 that were.
        """
        if len(self._left) == 1:
            return self._again
        least, (before, now) = _LEAST_SHARE * self._count, self._left
        if before == self._count:
            return now**3 < least**2 * before
        return now**2 < least * before

    def carry(
        self,
        prediction: Prediction,
        landmarks: LandmarkMap,
        images: tuple[Image, ...],
        correction: RigCorrection | None = None,
    ) -> CarriedFrame | None:
        """The next frame by its carried landmarks; None where there are none to be expected."""
        expected = self._tracker.expected(prediction, landmarks)
        carried = self._carrier.follow(images, expected, correction)
        if carried is None or not len(carried):
            return None
        every = np.arange(len(carried))
        matches = MapMatches(carried.rows, every, np.ones(len(carried), np.bool_))
        tracked = self._tracker.solved(prediction, landmarks, (expected, matches, carried.features))
        return CarriedFrame(carried, tracked, self.lasts(carried, tracked, images[0]))

    def record(self, frame: CarriedFrame) -> Association:
        """Records a frame between key frames; outliers are carried no further."""
        inliers = frame.tracked.ego_motion.inliers
        self._carrier.forget(frame.carried.ids[~inliers])
        self._left = (self._left[-1], int(inliers.sum()))
        return self._tracker.associate_carried(frame.tracked, frame.carried.features)

    def track(
        self,
        frame: CarriedFrame | None,
        prediction: Prediction,
        landmarks: LandmarkMap,
        sift: StereoFeatures,
    ) -> tuple[Tracked, StereoFeatures]:
        """A key frame: what is carried, and of the others what SIFT finds; all features of both.

        A frame that carried landmarks do not place is tracked as if SIFT were all there is.

        Landmarks that are carried and found by SIFT are measured by their patch, whose place in
        the image has not changed, and described by SIFT.
        """
        if frame is None or not frame.placed:
            return self._tracker.track(prediction, landmarks, sift), sift
        pose = frame.tracked.ego_motion
        around = Prediction(pose.wTc, pose.covariance)
        expected, matches = self._tracker.matched_around(around, landmarks, sift)
        kept = pose.inliers & np.isin(frame.carried.ids, expected.ids)
        features, joined = _joined(expected, matches, frame.carried.select(kept), sift)
        tracked = self._tracker.solved(prediction, landmarks, (expected, joined, features))
        if not tracked.ego_motion.status.measured:
            return self._tracker.track(prediction, landmarks, sift), sift
        return tracked, features

    def begin(self, image: Image, features: StereoFeatures, association: Association) -> None:
        """After a key frame: its landmarks are carried from here, each by its own patch.

        Args:
            image: the reference image.
            features: all of the frame's.
            association: what they were taken for.
        """
        observed, good = association.observations, ~association.rejected
        self._carrier.forget(observed.ids[~good])
        self._carrier.forget(np.setdiff1d(self._carrier.ids, observed.ids))
        self._count = int(good.sum())
        self._again, self._left = len(self._left) == 1, (self._count,)
        self._cells = len(_cells(observed.pixels[good, 0], image))
        fresh = good & ~np.isin(observed.ids, self._carrier.ids)
        distances = features.position[association.features[fresh], 2]
        points = Points(observed.ids[fresh], observed.pixels[fresh, 0], distances)
        self._carrier.begin(image, self._with_patches(image, points, observed.is_new[fresh]))

    def _with_patches(self, image: Image, points: Points, new: BoolArray) -> Begun:
        """Those that can be carried: new ones by what they show here, others by their own patch.

        SIFT finds a landmark again some tenths of a pixel off. A patch cut out there would repeat
        that error in every frame to come, as if all of them had seen it.
        """
        database, old = self._tracker.database, points.select(~new)
        begun = Begun.new(self._carrier.fine(image), points.select(new))
        database.keep_patches(begun.points.ids, begun.patches(image))
        begun = begun.join(Begun.again(old, database.patches(old.ids)))
        return begun.select(np.argsort(begun.points.ids))

    def lasts(self, carried: Carried, tracked: Tracked, image: Image) -> bool:
        """Whether enough landmarks are left, over enough of the image, and few contradict."""
        agreeing = tracked.ego_motion.inliers
        enough = max(_LEAST_SHARE * self._count, (1.0 - _MOST_REJECTED) * len(carried))
        if agreeing.sum() < enough:
            return False
        cells = _cells(carried.features.pixels[agreeing, 0], image)
        return len(cells) >= _LEAST_COVERAGE * self._cells


def _joined(
    expected: ExpectedLandmarks, matches: MapMatches, carried: Carried, sift: StereoFeatures
) -> tuple[StereoFeatures, MapMatches]:
    """Features carried, then those of SIFT that are none of these; matches of both, ascending."""
    rows = np.searchsorted(expected.ids, carried.ids)
    described = np.full(len(expected), -1)
    described[matches.landmarks] = matches.features
    also = described[rows]
    features = _described(carried.features, also, sift)
    rest: BoolArray = np.ones(len(sift), np.bool_)
    rest[also[also >= 0]] = False
    place = np.cumsum(rest) - 1 + len(carried)  # of a feature of SIFT among all
    others = ~np.isin(matches.landmarks, rows)
    landmarks = np.concatenate([rows, matches.landmarks[others]])
    seen = np.concatenate([np.arange(len(carried)), place[matches.features[others]]])
    order = np.argsort(landmarks)
    had = np.concatenate([np.ones(len(carried), np.bool_), matches.had_candidates[rest]])
    others_seen = sift.select(rest)
    every = features.join(others_seen)
    if others_seen.complete is not None:
        complete = np.concatenate([np.ones(len(carried), np.bool_), others_seen.complete])
        every = dataclasses.replace(every, complete=complete)
    return every, MapMatches(landmarks[order], seen[order], had)


def _described(carried: StereoFeatures, also: IntArray, sift: StereoFeatures) -> StereoFeatures:
    """Carried features with the appearance of the features of SIFT ``also`` (k,); -1 for none."""
    known = also >= 0
    scale, orientation = carried.scale.copy(), carried.orientation.copy()
    descriptors = carried.descriptors.copy()
    scale[known], orientation[known] = sift.scale[also[known]], sift.orientation[also[known]]
    descriptors[known] = sift.descriptors[also[known]]
    return dataclasses.replace(
        carried, scale=scale, orientation=orientation, descriptors=descriptors
    )


def _cells(places: FloatArray, image: Image) -> IntArray:
    """Cells of the image in which there are places (n, 2)."""
    size = np.array([image.shape[1], image.shape[0]])
    at = np.clip(places * _CELLS // size, 0, np.array(_CELLS) - 1).astype(np.int64)
    return np.unique(at[:, 0] * _CELLS[1] + at[:, 1])


def spread(tracked: Tracked, features: StereoFeatures) -> Tracked:
    """The frame starting landmarks only in squares (:data:`_APART_PX`) that show none yet.

    Of several features the finest is taken, which is seen longest on the way towards it.
    """
    matches = tracked.matches
    square = _squares(features.measurement[:, :2])
    taken = np.isin(square, square[matches.features[tracked.ego_motion.inliers]])
    partial = False if features.complete is None else ~features.complete  # these start none
    order = np.lexsort((features.scale, matches.had_candidates | taken | partial, square))
    first = np.ones(len(square), np.bool_)
    first[order[1:]] = np.diff(square[order]) > 0
    starts = first & ~taken & ~matches.had_candidates
    return dataclasses.replace(
        tracked, matches=dataclasses.replace(matches, had_candidates=~starts)
    )


def _squares(places: FloatArray) -> IntArray:
    """Number (n,) of the square, :data:`_APART_PX` wide, in which each place (n, 2) lies."""
    at = np.floor(places / _APART_PX).astype(np.int64)
    at -= at.min(axis=0, initial=0)  # a corrected calibration moves places beyond the border
    return np.asarray(at[:, 0] + (at[:, 0].max(initial=0) + 1) * at[:, 1])


@dataclass(frozen=True, slots=True, eq=False)
class CarriedFrame:
    """A frame as its carried landmarks place it.

    Attributes:
        carried: the landmarks found again.
        tracked: the pose that follows; its matches are rows of ``carried``.
        lasting: enough of the last key frame's landmarks are left, over enough of the image, and
            few of those found contradict the pose.
    """

    carried: Carried
    tracked: Tracked
    lasting: bool

    @property
    def placed(self) -> bool:
        """Whether the pose can be relied on: enough landmarks agree on it, and most of them do.

        Patches that left their points together agree on a wrong pose, too.
        """
        pose = self.tracked.ego_motion
        enough = pose.inliers.sum() >= _LEAST_LANDMARKS
        return bool(pose.status.measured and pose.coherent and enough)

    @property
    def suffices(self) -> bool:
        """It needs no key frame."""
        return self.placed and self.lasting


# ------------------------------------------------------------------------------------------
# Landmarks carried from image to image by their patches, and across to the other cameras (KLT)

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
        self.fine = stereo.fine
        self._last = None
        self._points = Points.none()
        self._patches = ReferencePatches.none(PATCH_PX)
        self._fresh = Begun.none()  # of the last image, their patches yet to be looked for

    @property
    def ids(self) -> IntArray:
        """(n,) landmarks with a patch, ascending."""
        return np.union1d(self._points.ids, self._fresh.points.ids)

    def begin(self, image: Image, begun: Begun) -> None:
        """Landmarks seen in the reference image are carried from here, in place of older ones.

        Their patches are worked on only when they are looked for: a frame that fails before
        costs nothing.
        """
        self._keep(~np.isin(self._points.ids, begun.points.ids))
        self._last, self._fresh = self.fine(image), begun

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
        last, now = self._last, self.fine(images[0])
        self._last = now
        self._keep(np.isin(self._points.ids, expected.ids))
        self._fresh = self._fresh.select(np.isin(self._fresh.points.ids, expected.ids))
        if last is None or not self._within_reach(expected):
            self._points, self._fresh = Points.none(), Begun.none()
            self._patches = ReferencePatches.none(PATCH_PX)
            return None
        patches = self._anchored(last)
        if not len(self._points):  # all that was to be carried appears different by now
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
            view = self.fine(images[camera])
            seen, alike = across(self._rig, view, camera, patches, places, predicted[:, 2])
            pixels.append(seen)
            good &= alike >= _MIN_CORRELATION
        views = (expected.scale[rows], expected.orientation[rows], expected.descriptors[rows])
        found = tuple(Features(seen, *views).select(good) for seen in pixels)
        features, consistent = self._stereo.measured(
            found, self._stereo.equally(NOISE_SHARE), correction
        )
        good[good] = consistent
        features = features.noisier(crowding(places[good], PATCH_PX))
        before = self._points.places[good]
        self._points = Points(self._points.ids[good], places[good], depths[good])
        self._patches = patches.select(good)
        return Carried(self._points.ids, rows[good], before, features)

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
        """Patches and places of landmarks begun in an image; what appears different by now is left.

        Those known from before are placed by their own patch, not by SIFT.
        """
        patches = anchor_at(fresh.cut, PATCH_PX, GREY_NOISE, DEFORMATION)
        known, points = fresh.known, fresh.points
        old, at = patches.select(known), points.places[known]
        old = dataclasses.replace(old, maps=old.maps * fresh.growth[known, None, None])
        old, found, correlation = align(old, last, at, _FIRST_ALIGNMENTS)
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
            last.quiet, now.quiet, self._points.places.astype(np.float32),
            predicted[:, :2].astype(np.float32), None, None, (PATCH_PX, PATCH_PX),
            _PYRAMID_LEVELS, _SEARCH, cv2.OPTFLOW_USE_INITIAL_FLOW, _MIN_EIGENVALUE,
        )  # fmt: skip
        at = np.asarray(found, np.float64)
        patches, places, correlation = align(patches, now, at, _ALIGNMENTS)
        good = (status[:, 0] == 1) & (correlation >= _MIN_CORRELATION)
        good &= np.linalg.norm(places - at, axis=1) < _FARTHEST_PX
        return patches, places, np.asarray(good & self._inside(places, _MARGIN_PX))

    def _inside(self, places: FloatArray, margin: float) -> BoolArray:
        return _inside(places, margin, (self._rig.width, self._rig.height))


def _inside(places: FloatArray, margin: float, size: tuple[int, int]) -> BoolArray:
    """Which places (n, 2) lie so far from the border of an image of this width and height."""
    last = np.array(size) - 1.0 - margin
    return np.asarray(((places >= margin) & (places <= last)).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Carried(Rows):
    """Landmarks found again by their patches.

    Attributes:
        ids: (k,) ascending.
        rows: (k,) which of the expected landmarks they are, ascending.
        before: (k, 2) where the last reference image showed them.
        features: as measured in all images, with the appearance that was expected of them.
    """

    ids: IntArray
    rows: IntArray
    before: FloatArray
    features: StereoFeatures


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
