"""Tracking a frame against the map and deciding each landmark's type (Se et al. 3 and 4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, Image, IntArray
from fgslam.core.estimates import EgoMotion, EgoMotionStatus, LandmarkMap, Prediction
from fgslam.core.features import StereoFeatures
from fgslam.core.geometry import in_front, project, transform_to_camera
from fgslam.core.measurements import Observations
from fgslam.core.sensors import CameraRig
from fgslam.core.store import Kept
from fgslam.frontend.tracking.database import LandmarkDatabase
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem
from fgslam.frontend.tracking.map_matching import (
    REFINE_SHIFT_PX,
    ExpectedLandmarks,
    MapMatcher,
    MapMatches,
    directions_to,
    lean,
    predicted_covariance,
)
from fgslam.frontend.tracking.map_parts import MapParts
from fgslam.frontend.tracking.match_noise import MatchNoise
from fgslam.frontend.tracking.other_motion import OtherMotion
from fgslam.frontend.tracking.regaining import Regainer
from fgslam.frontend.tracking.resection import Resection

_FEW_MATCHED = 0.2
"""Of a frame's features: landmarks in the pose's favour, below which it is looked for anew too."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """One frame tracked: what was expected, what matched, and the pose that follows."""

    expected: ExpectedLandmarks
    matches: MapMatches
    ego_motion: EgoMotion


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """The landmarks' types: III and IV as observations, II as misses; I is all others.

    Attributes:
        observations: matched, then new.
        rejected: (k,) matched ones whose residual made them outliers; they count as misses.
        missed_ids: landmarks expected in view and not seen.
        pruned_ids: landmarks dropped now.
        features: (k,) the frame's features that were observed.
    """

    observations: Observations
    rejected: BoolArray
    missed_ids: IntArray
    pruned_ids: IntArray
    features: IntArray

    def partners(self, count: int) -> IntArray:
        """The landmark that each of the first ``count`` features is taken for; -1 for none."""
        out = np.full(count, -1, np.int64)
        taken = ~self.rejected & (self.features < count)
        out[self.features[taken]] = self.observations.ids[taken]
        return out

    @property
    def known(self) -> IntArray:
        """Identities of the landmarks that were seen again."""
        return self.observations.ids[~self.rejected & ~self.observations.is_new]

    @staticmethod
    def nothing() -> Association:
        """Association of a frame without images: nothing matched, nothing missed."""
        none = np.empty(0, np.int64)
        observations = StereoFeatures.empty().observations(none, none, is_new=False)
        return Association(observations, np.empty(0, np.bool_), none, none, none)


class LandmarkTracker:
    """Joins the database's appearance with the estimator's geometry."""

    database: Kept[LandmarkDatabase]
    noise: Kept[MatchNoise]
    parts: Kept[MapParts]
    other_motion: Kept[OtherMotion]

    def __init__(
        self,
        rig: CameraRig,
        database: LandmarkDatabase,
        matcher: MapMatcher,
        ego_motion: EgoMotionSolver,
    ) -> None:
        """The database is shared with whoever shows or saves it.

        Which part of the map is which is booked in ``parts`` by whoever drives.
        With ``keeps_map`` nothing is booked, started or pruned: the map is only localised in. With
        ``expects_returns`` place recognition tells old landmarks from recent ones where they
        contradict each other; without, the prediction was wrong. It was in either case where few
        features agree with the pose.
        """
        self.keeps_map = False
        self.expects_returns = False
        self._rig = rig
        self.database = database
        self._matcher = matcher
        self._ego_motion = ego_motion
        self.noise = ego_motion.noise
        self.resection = Resection(ego_motion)
        self.parts = MapParts()
        self.other_motion = OtherMotion(rig, ego_motion)
        self._regainer = Regainer(rig, database, ego_motion, self.parts)

    def track(
        self, prediction: Prediction, landmarks: LandmarkMap, features: StereoFeatures
    ) -> Tracked:
        """Matches expected landmarks and solves for the pose; wider or anew around it if set so."""
        around = Prediction(self._ego_motion.floor.constrain(prediction.wTc), prediction.covariance)
        tracked = self.match_and_solve(prediction, around, landmarks, features)
        if self._matcher.rescues and not tracked.ego_motion.status.measured:
            rescued = self.match_and_solve(prediction, around, landmarks, features, anywhere=True)
            # A failed rescue proves nothing about what is new: the first attempt stands.
            tracked = rescued if rescued.ego_motion.status.measured else tracked
        if self._matcher.rescues and self._doubtful(tracked, features):
            anew = self._regained(landmarks, features)
            if anew is not None and _used(anew) >= 2 * _used(tracked):
                return anew
        if self._matcher.refines and self._moved_far(tracked, landmarks):
            around = Prediction(tracked.ego_motion.wTc, tracked.ego_motion.covariance)
            refined = self.match_and_solve(prediction, around, landmarks, features)
            tracked = refined if refined.ego_motion.status.measured else tracked
        return tracked

    def _doubtful(self, tracked: Tracked, features: StereoFeatures) -> bool:
        """Whether what was matched around the prediction contradicts the pose, or is little.

        In the wrong place a few dozen matches may agree: some right ones, of things far off or
        close together, and others by chance.
        """
        found = tracked.ego_motion
        contradicted = not (found.coherent or self.expects_returns)
        few = _used(tracked) < _FEW_MATCHED * len(features)
        return not found.status.measured or contradicted or few

    def _regained(self, landmarks: LandmarkMap, features: StereoFeatures) -> Tracked | None:
        """The frame found by what was seen lately, without the prediction; None where it is not."""
        found = self._regainer.find(landmarks, features)
        if found is None:
            return None
        anew = self.track_anew(found, landmarks, features)
        return anew if anew.ego_motion.status.measured else None

    def _moved_far(self, tracked: Tracked, landmarks: LandmarkMap) -> bool:
        """Whether the pose found shifts the expected landmarks out of the middle of their windows.

        Where it does not, the windows around the prediction held what there is to match.
        """
        if not tracked.ego_motion.status.measured:
            return False
        expected = tracked.expected
        points = transform_to_camera(tracked.ego_motion.wTc, landmarks.positions[expected.rows])
        ahead = in_front(points)
        shift = project(self._rig, points[ahead]) - expected.measurement[ahead]
        return bool(np.median(np.abs(shift[:, :2]).max(axis=1)) > REFINE_SHIFT_PX)

    def track_anew(
        self, around: Prediction, landmarks: LandmarkMap, features: StereoFeatures
    ) -> Tracked:
        """Matches in the neighbourhood of a pose found without a prior, and solves without one."""
        expected = self.database.expected(landmarks, around.wTc)
        matches = self._match_around(around, expected, landmarks, features)
        problem = PoseProblem.of(landmarks, _matched(expected, matches, features))
        return Tracked(expected, matches, self.resection.solve(problem))

    def expected(self, prediction: Prediction, landmarks: LandmarkMap) -> ExpectedLandmarks:
        """Landmarks that may be in view of the prediction, as the floor allows it."""
        return self.database.expected(landmarks, self._ego_motion.floor.constrain(prediction.wTc))

    def matched_around(
        self, around: Prediction, landmarks: LandmarkMap, features: StereoFeatures
    ) -> tuple[ExpectedLandmarks, MapMatches]:
        """Landmarks expected from a pose, and their matches."""
        expected = self.database.expected(landmarks, around.wTc)
        return expected, self._match_around(around, expected, landmarks, features)

    def solved(
        self,
        prediction: Prediction,
        landmarks: LandmarkMap,
        matched: tuple[ExpectedLandmarks, MapMatches, StereoFeatures],
    ) -> Tracked:
        """The frame by matches that are known."""
        expected, matches, _ = matched
        problem = PoseProblem.of(landmarks, _matched(*matched))
        return Tracked(expected, matches, self._ego_motion.solve(prediction, problem))

    def track_blind(self, prediction: Prediction, status: EgoMotionStatus) -> EgoMotion:
        """The odometry's pose, for a frame without images; the same that its replay will find."""
        nothing = PoseProblem.empty()
        found = self._ego_motion.solve(prediction, nothing)
        return replace(found, status=status)

    def match_and_solve(
        self,
        prediction: Prediction,
        around: Prediction,
        landmarks: LandmarkMap,
        features: StereoFeatures,
        anywhere: bool = False,
    ) -> Tracked:
        """Matches in the neighbourhood of ``around``, then solves, stabilised to the prediction."""
        expected = self.database.expected(landmarks, around.wTc)
        if anywhere:
            matches = self._matcher.match_anywhere(expected, features)
        else:
            matches = self._match_around(around, expected, landmarks, features)
        return self.solved(prediction, landmarks, (expected, matches, features))

    def _match_around(
        self,
        around: Prediction,
        expected: ExpectedLandmarks,
        landmarks: LandmarkMap,
        features: StereoFeatures,
    ) -> MapMatches:
        uncertainty = self._uncertainty(around, landmarks, expected)
        return self._matcher.match(expected, features, uncertainty)

    def associate(
        self, tracked: Tracked, features: StereoFeatures, image: Image, start_new: bool = True
    ) -> Association:
        """Records hits and misses, initiates landmarks if allowed, prunes (4.1 to 4.3)."""
        expected, matches = tracked.expected, tracked.matches
        inliers = tracked.ego_motion.inliers
        matched = _matched(expected, matches, features)
        if self.keeps_map:
            none = np.empty(0, np.int64)
            return Association(matched, ~inliers, none, none, matches.features)
        missed_ids = self._missing(tracked)
        directions = directions_to(tracked.ego_motion.wTc, features.position)
        upright = self._upright(features, tracked.ego_motion.wTc)
        seen = matches.features[inliers]
        self.database.record_hits(matched.ids[inliers], upright, seen, directions[seen])
        self.database.record_misses(missed_ids)
        if tracked.ego_motion.status.measured:
            rejected = matched.ids[~inliers]
            self.database.weigh(expected, missed_ids, rejected, features.whole.measurement)
        fresh = np.flatnonzero(~matches.had_candidates & start_new)
        if features.complete is not None:
            fresh = fresh[features.complete[fresh]]
        colour = _grey_values(image, features, fresh)
        new_ids = self.database.add(upright, fresh, colour, directions[fresh])
        new = features.observations(fresh, new_ids, is_new=True)
        return Association(
            observations=matched.join(new),
            rejected=np.concatenate([~inliers, np.zeros(len(new), np.bool_)]),
            missed_ids=missed_ids,
            pruned_ids=self.database.prune(),
            features=np.concatenate([matches.features, fresh]),
        )

    def associate_carried(self, tracked: Tracked, features: StereoFeatures) -> Association:
        """Records hits of carried landmarks, between key frames; nothing is missed or new there."""
        matched = _matched(tracked.expected, tracked.matches, features)
        inliers, none = tracked.ego_motion.inliers, np.empty(0, np.int64)
        if not self.keeps_map:
            self.database.record_carried(matched.ids[inliers], self._missing(tracked))
        return Association(matched, ~inliers, none, none, tracked.matches.features)

    def _missing(self, tracked: Tracked) -> IntArray:
        """Landmarks expected well in view that the frame does not show, as far as it tells."""
        hit = np.zeros(len(tracked.expected), np.bool_)
        hit[tracked.matches.landmarks[tracked.ego_motion.inliers]] = True
        return self.database.missing(tracked.expected, hit)

    def _upright(self, features: StereoFeatures, wTc: FloatArray) -> StereoFeatures:
        """The features with their orientations as a level camera sees them."""
        level = features.orientation - lean(self._rig, wTc, features.position)
        return replace(features, orientation=level)

    def merge(self, pairs: IntArray) -> IntArray:
        """Makes landmarks found to be one into one; returns the identities that end.

        Args:
            pairs: (m, 2) (identity that ends, identity that stays); what is no longer in the
                database, or would go to one that ends itself, is left out.
        """
        known = np.isin(pairs, self.database.ids).all(axis=1)
        known &= ~np.isin(pairs[:, 1], pairs[:, 0])
        _, first = np.unique(pairs[known, 0], return_index=True)
        chosen = pairs[known][first]
        if len(chosen):
            self.database.merge(chosen)
        return np.asarray(chosen[:, 0])

    def _uncertainty(
        self,
        around: Prediction,
        landmarks: LandmarkMap,
        expected: ExpectedLandmarks,
    ) -> FloatArray | None:
        """Standard deviations (v, 3) of the predicted measurements, where the matcher asks."""
        if not self._matcher.widens:
            return None
        rows = expected.rows
        covariance = predicted_covariance(
            self._rig, around, landmarks.positions[rows], landmarks.covariances[rows]
        )
        return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def _used(tracked: Tracked) -> int:
    return int(tracked.ego_motion.inliers.sum())


def _matched(
    expected: ExpectedLandmarks, matches: MapMatches, features: StereoFeatures
) -> Observations:
    ids = expected.ids[matches.landmarks]
    return features.observations(matches.features, ids, is_new=False)


def _grey_values(image: Image, features: StereoFeatures, which: IntArray) -> ByteArray:
    """Grey values (k,) of the reference image at the features, for the map's colour."""
    at = np.rint(features.measurement[which, :2]).astype(np.int64)
    rows = np.clip(at[:, 1], 0, image.shape[0] - 1)
    columns = np.clip(at[:, 0], 0, image.shape[1] - 1)
    return image[rows, columns]
