"""Tracking a frame against the map and deciding each landmark's type (Se et al. 3 and 4.1)."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, Image, IntArray
from fgslam.core.geometry import (
    compose_covariance,
    in_front,
    inverse,
    rotate_covariances,
    transform_to_camera,
    transform_to_world,
)
from fgslam.core.sensors import (
    UNKNOWN_DISPARITY_PX,
    CameraRig,
    Observations,
    pixel_model,
    vertical_to_horizontal,
)
from fgslam.core.store import Kept
from fgslam.core.types import (
    EgoMotion,
    EgoMotionStatus,
    LandmarkAppearances,
    LandmarkMap,
    Prediction,
    Remark,
    StereoFeatures,
)
from fgslam.frontend.features.matching import mutual_nearest
from fgslam.frontend.tracking.ego_motion import (
    EgoMotionSolver,
    MatchNoise,
    PoseProblem,
    Resection,
    sample_size,
)
from fgslam.frontend.tracking.landmarks import LandmarkDatabase, MapParts
from fgslam.frontend.tracking.map_matching import (
    REFINE_SHIFT_PX,
    ExpectedLandmarks,
    MapMatcher,
    MapMatches,
    directions_to,
    lean,
    predicted_covariance,
)

_FEW_MATCHED = 0.2
"""Of a frame's features: landmarks in the pose's favour, below which it is sought again too."""


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
        """The database is shared with callers that show or save it.

        Which part of the map is which is recorded in ``parts`` by the caller.
        With ``keeps_map`` nothing is recorded, begun or pruned: the map is only localised in. With
        ``expects_returns`` place recognition separates old landmarks from recent ones where they
        contradict each other; without, the prediction was wrong. It was in either case where few
        features agree with the pose.
        """
        self.keeps_map = False
        self.expects_returns = False
        self.rig = rig
        self.database = database
        self.matcher = matcher
        self._ego_motion = ego_motion
        self.noise = ego_motion.noise
        self.resection = Resection(ego_motion)
        self.parts = MapParts()
        self.other_motion = OtherMotion(rig, ego_motion)
        self._regainer = Regainer(rig, database, ego_motion, self.parts)

    def track(
        self, prediction: Prediction, landmarks: LandmarkMap, features: StereoFeatures
    ) -> Tracked:
        """Matches expected landmarks, solves for the pose; wider or again around it if set so."""
        around = self.constrained(prediction)
        tracked = self.match_and_solve(prediction, around, landmarks, features)
        if self.matcher.rescues and not tracked.ego_motion.status.measured:
            rescued = self.match_and_solve(prediction, around, landmarks, features, anywhere=True)
            # A failed rescue proves nothing about what is new: the first attempt stands.
            tracked = rescued if rescued.ego_motion.status.measured else tracked
        if self.matcher.rescues and self._is_doubtful(tracked, features):
            again = self._regained(landmarks, features)
            if again is not None and _used(again) >= 2 * _used(tracked):
                return again
        if self.matcher.refines and self._moved_far(tracked, landmarks):
            around = Prediction(tracked.ego_motion.wTc, tracked.ego_motion.covariance)
            refined = self.match_and_solve(prediction, around, landmarks, features)
            tracked = refined if refined.ego_motion.status.measured else tracked
        return tracked

    def match_and_solve(
        self,
        prediction: Prediction,
        around: Prediction,
        landmarks: LandmarkMap,
        features: StereoFeatures,
        anywhere: bool = False,
    ) -> Tracked:
        """Matches in the neighbourhood of ``around``, then solves, stabilised to the prediction."""
        matched = self.matched_around(around, landmarks, features, anywhere)
        return self.solved(prediction, landmarks, (*matched, features))

    def _uncertainty(
        self,
        around: Prediction,
        landmarks: LandmarkMap,
        expected: ExpectedLandmarks,
    ) -> FloatArray | None:
        """Standard deviations (v, 3) of the predicted measurements, where the matcher asks."""
        if not self.matcher.widens:
            return None
        rows = expected.rows
        covariance = predicted_covariance(
            self.rig, around, landmarks.positions[rows], landmarks.covariances[rows]
        )
        return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))

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

    def _is_doubtful(self, tracked: Tracked, features: StereoFeatures) -> bool:
        """Whether what was matched around the prediction contradicts the pose, or is little.

        In the wrong place a few dozen matches may agree: some right ones, of things far off or
        close together, and others by chance.
        """
        found, few = tracked.ego_motion, _used(tracked) < _FEW_MATCHED * len(features)
        return not (found.status.measured and (found.coherent or self.expects_returns)) or few

    def _regained(self, landmarks: LandmarkMap, features: StereoFeatures) -> Tracked | None:
        """The frame found by what was seen lately, without the prediction; None where it is not."""
        found = self._regainer.find(landmarks, features)
        if found is None:
            return None
        again = self.track_around(found, landmarks, features)
        return again if again.ego_motion.status.measured else None

    def track_around(
        self, around: Prediction, landmarks: LandmarkMap, features: StereoFeatures
    ) -> Tracked:
        """Matches in the neighbourhood of a pose found without a prior, and solves without one."""
        expected, matches = self.matched_around(around, landmarks, features)
        problem = PoseProblem.of(landmarks, _matched(expected, matches, features))
        return Tracked(expected, matches, self.resection.solve(problem))

    def _moved_far(self, tracked: Tracked, landmarks: LandmarkMap) -> bool:
        """Whether the pose found shifts the expected landmarks out of the middle of their windows.

        Where it does not, the windows around the prediction held what there is to match.
        """
        if not tracked.ego_motion.status.measured:
            return False
        expected = tracked.expected
        points = transform_to_camera(tracked.ego_motion.wTc, landmarks.positions[expected.rows])
        ahead = in_front(points)
        shift = self.rig.predict(points[ahead]) - expected.measurement[ahead]
        return bool(np.median(np.abs(shift[:, :2]).max(axis=1)) > REFINE_SHIFT_PX)

    def associate(
        self,
        tracked: Tracked,
        features: StereoFeatures,
        image: Image,
        start_new: bool = True,
        misses: bool = True,
    ) -> Association:
        """Records hits and misses, initiates landmarks, if allowed, and prunes (4.1 to 4.3)."""
        expected, matches = tracked.expected, tracked.matches
        inliers = tracked.ego_motion.inliers
        matched = _matched(expected, matches, features)
        if self.keeps_map:
            none = np.empty(0, np.int64)
            return Association(matched, ~inliers, none, none, matches.features)
        missed_ids = self._missing(tracked) if misses else np.empty(0, np.int64)
        directions = directions_to(tracked.ego_motion.wTc, features.position)
        # The orientations as a level camera sees them.
        level = features.orientation - lean(self.rig, tracked.ego_motion.wTc, features.position)
        upright = replace(features, orientation=level)
        seen = matches.features[inliers]
        self.database.record_hits(matched.ids[inliers], upright, seen, directions[seen])
        self.database.record_misses(missed_ids)
        if misses and tracked.ego_motion.status.measured:
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

    def _missing(self, tracked: Tracked) -> IntArray:
        """Landmarks expected well in view that the frame does not show, as far as is seen."""
        hit = np.zeros(len(tracked.expected), np.bool_)
        hit[tracked.matches.landmarks[tracked.ego_motion.inliers]] = True
        return self.database.missing(tracked.expected, hit)

    def associate_carried(self, tracked: Tracked, features: StereoFeatures) -> Association:
        """Records hits of carried landmarks, between key frames; nothing is missed or new there."""
        matched = _matched(tracked.expected, tracked.matches, features)
        inliers, none = tracked.ego_motion.inliers, np.empty(0, np.int64)
        if not self.keeps_map:
            self.database.record_carried(matched.ids[inliers], self._missing(tracked))
        return Association(matched, ~inliers, none, none, tracked.matches.features)

    def track_alone(
        self, camera: int, prediction: Prediction, landmarks: LandmarkMap, found: StereoFeatures
    ) -> tuple[Tracked, StereoFeatures]:
        """A frame by one camera's image, and its features as the rig's.

        It is tracked as if that camera were the reference, whose place on the rig is known. Then
        the landmark's disparity completes each measurement, its error as good as unbounded.

        Args:
            camera: 0 right, 1 left, 2 top.
            prediction: of the rig.
            landmarks: the map.
            found: features of that image (:meth:`StereoMatcher.alone`).
        """
        rig = self.rig
        cTo, exact = rig.camera_poses[camera], np.zeros((6, 6))
        spread = compose_covariance(cTo, prediction.covariance, exact)
        tracked = self.track(Prediction(prediction.wTc @ cTo, spread), landmarks, found)
        found_pose = tracked.ego_motion
        wTc, status = found_pose.wTc @ inverse(cTo), found_pose.status
        ego_motion = replace(
            found_pose,
            wTc=wTc,
            covariance=compose_covariance(inverse(cTo), found_pose.covariance, exact),
            status=EgoMotionStatus.ONE_IMAGE if status.measured else status,
            weighted_at=None,
            misfit=math.nan,
        )
        rows = tracked.expected.rows[tracked.matches.landmarks]
        points = transform_to_camera(wTc, landmarks.positions[rows])
        ahead = in_front(points)
        disparity = np.ones(len(found))
        disparity[tracked.matches.features[ahead]] = rig.predict(points[ahead])[:, 2]
        by_disparity = pixel_model(rig.cameras, vertical_to_horizontal(rig))[2 * camera :, 2][:2]
        along = np.append(-by_disparity, 1.0)
        measurement, covariance = found.measurement.copy(), found.measurement_covariance.copy()
        measurement[:, 2] = 0.0
        measurement += disparity[:, None] * along
        covariance[:, 2, 2] = 0.0
        covariance += UNKNOWN_DISPARITY_PX**2 * np.outer(along, along)
        as_rig = replace(found, measurement=measurement, measurement_covariance=covariance)
        return replace(tracked, ego_motion=ego_motion), as_rig

    def track_blind(self, prediction: Prediction, status: EgoMotionStatus) -> EgoMotion:
        """The odometry's pose, for a frame without images; the same that its replay will find."""
        return replace(self._ego_motion.solve(prediction, PoseProblem.empty()), status=status)

    def expected(self, prediction: Prediction, landmarks: LandmarkMap) -> ExpectedLandmarks:
        """Landmarks that may be in view of the prediction, as the floor allows it."""
        return self.database.expected(landmarks, self.constrained(prediction).wTc)

    def constrained(self, prediction: Prediction) -> Prediction:
        """The prediction on the floor."""
        return Prediction(self._ego_motion.floor.constrain(prediction.wTc), prediction.covariance)

    def fits(self, wTc: FloatArray, problem: PoseProblem, slack: float = 1.0) -> BoolArray:
        """Which matches (k,) a pose explains, by ``slack`` times the bound of an inlier."""
        return self._ego_motion.image_residuals(wTc, problem) <= slack * self._ego_motion.farthest

    def matched_around(
        self,
        around: Prediction,
        landmarks: LandmarkMap,
        features: StereoFeatures,
        anywhere: bool = False,
    ) -> tuple[ExpectedLandmarks, MapMatches]:
        """Landmarks expected from a pose, and their matches: near there, or ``anywhere``."""
        expected = self.database.expected(landmarks, around.wTc)
        if anywhere:
            return expected, self.matcher.match_anywhere(expected, features)
        uncertainty = self._uncertainty(around, landmarks, expected)
        return expected, self.matcher.match(expected, features, uncertainty)

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


def _matched(
    expected: ExpectedLandmarks, matches: MapMatches, features: StereoFeatures
) -> Observations:
    ids = expected.ids[matches.landmarks]
    return features.observations(matches.features, ids, is_new=False)


def _used(tracked: Tracked) -> int:
    return int(tracked.ego_motion.inliers.sum())


def _grey_values(image: Image, features: StereoFeatures, which: IntArray) -> ByteArray:
    """Grey values (k,) of the reference image at the features, for the map's colour."""
    at = np.rint(features.measurement[which, :2]).astype(np.int64)
    rows = np.clip(at[:, 1], 0, image.shape[0] - 1)
    columns = np.clip(at[:, 0], 0, image.shape[1] - 1)
    return image[rows, columns]


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


# ------------------------------------------------------------------------------------------
# The pose of a frame whose prediction failed: a sudden turn, a gap, a blurred or dark image

LATELY = 10  # frames before the last sighting whose landmarks are looked for
_AT_LAST = 0  # likewise where that fails: among few landmarks few others look like the right one
FALSE_POSES = 1e-6  # poses by chance that are allowed in a frame


class Regainer:
    """Finds a frame by landmarks seen lately, without a prediction."""

    def __init__(
        self, rig: CameraRig, database: LandmarkDatabase, solver: EgoMotionSolver, parts: MapParts
    ) -> None:
        """Takes the tracker's own parts."""
        self._database = database
        self._solver = solver
        self._parts = parts
        self._resection = Resection(solver)
        self._by_chance = math.pi * solver.farthest**2 / (rig.width * rig.height)

    def find(self, landmarks: LandmarkMap, features: StereoFeatures) -> Prediction | None:
        """Pose and covariance; None where none is accepted. The same input, the same bits."""
        for frames in (LATELY, _AT_LAST):
            found = self._found_by(frames, landmarks, features)
            if found is not None:
                return Prediction(found.wTc, found.covariance)
        return None

    def _found_by(
        self, frames: int, landmarks: LandmarkMap, features: StereoFeatures
    ) -> EgoMotion | None:
        """The frame by what the last frames described; None if it is rejected."""
        recent = np.intersect1d(self._database.described_lately(frames), landmarks.ids)
        appearances = self._database.appearances(recent)
        latest = np.flatnonzero(np.diff(appearances.ids, append=-1))
        part = self._parts.of(appearances.ids[latest])
        within = [
            self._among(latest[part == one], appearances, landmarks, features)
            for one in np.unique(part).tolist()
        ]
        found = [one for one in within if one is not None]
        return max(found, key=lambda one: int(one.inliers.sum()), default=None)

    def _among(
        self,
        rows: IntArray,
        appearances: LandmarkAppearances,
        landmarks: LandmarkMap,
        features: StereoFeatures,
    ) -> EgoMotion | None:
        """The frame by some landmarks, given by rows of their appearances; None if rejected."""
        seen = features.whole
        i, j = mutual_nearest(seen.descriptors, appearances.descriptors[rows])
        observed = seen.observations(i, appearances.ids[rows[j]], is_new=False)
        problem = PoseProblem.of(landmarks, observed)
        found = self._resection.solve(problem)
        if not found.status.measured or not self._certain(found, problem):
            return None
        return found

    def _certain(self, found: EgoMotion, problem: PoseProblem) -> bool:
        agreeing = places(problem.measurement[found.inliers, :2], self._solver.farthest)
        size = sample_size(self._solver.floor)
        if log_false_poses(len(problem), agreeing, size, self._by_chance) > math.log(FALSE_POSES):
            return False
        return 2 * self._resection.rival(problem, found) <= int(found.inliers.sum())


def places(pixels: FloatArray, side: float) -> int:
    """How many places of the image, squares of this side, the pixels (n, 2) lie in."""
    return len(np.unique(np.floor(pixels / side), axis=0))


def log_false_poses(matches: int, agreeing: int, sample: int, by_chance: float) -> float:
    """Logarithm of the number of poses that as many matches would agree with by chance.

    Args:
        matches: m of the frame.
        agreeing: k of them with a pose.
        sample: s that fix a pose, and agree for nothing.
        by_chance: p, probability that a wrong match agrees.

    ``(m - s) C(m, k) C(k, s) p^(k - s)``, equation 11 of Moisan and Stival.
    """
    if agreeing <= sample:
        return math.inf
    return (
        math.log(matches - sample)
        + _log_choose(matches, agreeing)
        + _log_choose(agreeing, sample)
        + (agreeing - sample) * math.log(by_chance)
    )


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)


# ------------------------------------------------------------------------------------------
# Whether much of what a frame shows moves rigidly, but otherwise than its pose

_FEWEST = 15  # matches that move otherwise; chance is judged besides
_SHARE = 0.1  # of those that the pose follows
_FRAMES, _WINDOW = 3, 10  # so many of so many described frames: no wrong match, no blurred frame
_LARGEST = 300  # features of each frame that are matched: the time is that of their square


class OtherMotion:
    """Remembers the frames of a drive that show a second rigid motion."""

    _before: Kept[tuple[IntArray, StereoFeatures]]
    _latest: Kept[deque[tuple[int, float]]]
    _contradicting: Kept[dict[int, float]]

    def __init__(self, rig: CameraRig, solver: EgoMotionSolver) -> None:
        """Nothing seen yet."""
        self._solver = solver
        self._resection = Resection(solver)
        self._by_chance = math.pi * solver.farthest**2 / (rig.width * rig.height)
        self._before = np.empty(0, np.int64), StereoFeatures.empty()
        self._latest = deque(maxlen=_WINDOW)
        self._contradicting = {}

    def look(
        self,
        index: int,
        features: StereoFeatures,
        association: Association,
        tracking: EgoMotion,
        wTc: FloatArray,
    ) -> None:
        """Takes in a frame whose features were found.

        Args:
            index: its number.
            features: (n,) those found in every image.
            association: what they make of the landmarks.
            tracking: its pose, as it was tracked.
            wTc: (4, 4) the same after the update, from which the next frame is predicted.
        """
        partners, old = association.partners(len(features)), association.known
        left = np.flatnonzero(~np.isin(partners, old))
        left = left[np.argsort(-features.scale[left], kind="stable")[:_LARGEST]]
        share = self._share(features, left, old, tracking) if tracking.status.measured else 0.0
        self._latest.append((index, share))
        seen = [one for one in self._latest if one[1] > _SHARE]
        if len(seen) >= _FRAMES:
            self._contradicting.update(seen)
        followed = tracking.status.measured or tracking.status is EgoMotionStatus.FIRST
        left = left if followed else left[:0]
        rest = features.select(left)
        where = transform_to_world(wTc, rest.position)
        turned = rotate_covariances(wTc[:3, :3], rest.position_covariance)
        there = replace(rest, position=where, position_covariance=turned)
        self._before = partners[left], there  # what no landmark explained, and which it began

    def remarks(self) -> tuple[Remark, ...]:
        """On the frames with two motions; none where there are none."""
        if not self._contradicting:
            return ()
        percent = 100.0 * max(self._contradicting.values())
        return (Remark("other_motion", tuple(sorted(self._contradicting)), {"percent": percent}),)

    def _share(
        self, features: StereoFeatures, left: IntArray, old: IntArray, tracking: EgoMotion
    ) -> float:
        """Matches that agree with another motion over those of the pose; zero where none is."""
        ids, before = self._before
        before = before.select(~np.isin(ids, old))
        if min(len(left), len(before)) < _FEWEST:
            return 0.0
        i, j = mutual_nearest(features.descriptors[left], before.descriptors)
        problem = PoseProblem(
            before.position[j],
            before.position_covariance[j],
            features.measurement[left[i]],
            features.measurement_covariance[left[i]],
        )
        against = self._solver.image_residuals(tracking.wTc, problem) > self._solver.farthest
        if against.sum() < _FEWEST:
            return 0.0
        rest = problem.select(against)
        found = self._resection.solve(rest)
        agreeing = int(found.inliers.sum()) if found.status.measured else 0
        apart = places(rest.measurement[found.inliers, :2], self._solver.farthest)
        size = sample_size(self._solver.floor)
        by_chance = log_false_poses(len(problem), apart, size, self._by_chance)
        if agreeing < _FEWEST or by_chance > math.log(FALSE_POSES):
            return 0.0
        return agreeing / max(int(tracking.inliers.sum()), 1)
