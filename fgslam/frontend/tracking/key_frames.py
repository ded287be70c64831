"""Frames tracked by carried landmarks, and when it takes a key frame instead.

On a key frame SIFT finds features in the reference image, whose patches are measured in the others
(:mod:`fgslam.frontend.patch_stereo`); in all images where carried landmarks do not place the
camera. It describes the landmarks that are carried, finds again those that were lost, and starts
new ones. Between key frames the carried landmarks alone place the camera, and nothing is missed,
pruned or started.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Image, IntArray
from fgslam.core.estimates import LandmarkMap, Prediction
from fgslam.core.features import StereoFeatures
from fgslam.core.rig_correction import RigCorrection
from fgslam.core.store import Kept
from fgslam.frontend.tracking.carrying import Begun, Carried, LandmarkCarrier, Points
from fgslam.frontend.tracking.map_matching import ExpectedLandmarks, MapMatches
from fgslam.frontend.tracking.tracker import Association, LandmarkTracker, Tracked

_LEAST_SHARE = 0.4  # of the key frame's landmarks; fewer left take a new one
_LEAST_LANDMARKS = 40  # a pose by fewer is poor, whatever the key frame had
_LEAST_COVERAGE = 0.6  # of the image's cells that the key frame's landmarks covered
_MOST_REJECTED = 0.2
"""Of the carried landmarks: where more contradict the pose, something else moves, or patches went
astray. On real roads nine frames of ten stay below 0.12."""
_CELLS = (4, 3)  # columns, rows
_APART_PX = 5.0
"""Side of the squares of which each starts one landmark: a third of a patch. SIFT finds a sixth of
its features twice in one place, by two orientations, whose patches are the same measurement; of
patches that overlap by less each still adds to the pose."""


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

        Patches that went astray together agree on a wrong pose, too.
        """
        pose = self.tracked.ego_motion
        enough = pose.inliers.sum() >= _LEAST_LANDMARKS
        return bool(pose.status.measured and pose.coherent and enough)

    @property
    def suffices(self) -> bool:
        """It needs no key frame."""
        return self.placed and self.lasting


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
        begun = Begun.new(self._carrier.reference(image), points.select(new))
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
    """Carried features with the looks of the features of SIFT ``also`` (k,); -1 for none."""
    known = also >= 0
    scale, orientation = carried.scale.copy(), carried.orientation.copy()
    descriptors = carried.descriptors.copy()
    scale[known], orientation[known] = sift.scale[also[known]], sift.orientation[also[known]]
    descriptors[known] = sift.descriptors[also[known]]
    return dataclasses.replace(
        carried, scale=scale, orientation=orientation, descriptors=descriptors
    )
