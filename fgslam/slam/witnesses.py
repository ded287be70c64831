"""Images against measured odometry: which of two contradicting witnesses a frame's pose follows.

Where the pose that images give (*I*) lies farther from the one that odometry gives (*O*) than both
explain, one of them errs: wheels that slip, or something that moves and fills much of the view. How
far the two are apart does not tell which; what else in the image each of them explains does. The
evidence of all frames of such an episode adds up in one score. While it decides nothing, the pose
follows the images, and odometry goes on next to it: it may turn out to have been right.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows, robust_spread
from fgslam.core.geometry import (
    adjoint,
    compose_covariance,
    inverse,
    motion_covariance,
    rotate_covariances,
    se3_log,
    so3_log,
    transform_to_world,
)
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.store import Kept
from fgslam.core.types import (
    EgoMotion,
    EgoMotionStatus,
    Estimate,
    LandmarkMap,
    Prediction,
    Remark,
    StereoFeatures,
    Trajectory,
)
from fgslam.frontend.features.matching import descriptor_distance, mutual_nearest, squared_distances
from fgslam.frontend.tracking.ego_motion import PoseProblem
from fgslam.frontend.tracking.map_matching import MapMatches
from fgslam.frontend.tracking.tracker import LATELY, LandmarkTracker, Tracked

Verdict: TypeAlias = Literal["agreed", "images", "odometry", "undecided"]

_GATE = 40.0
"""Chi-square, six degrees of freedom, beyond which the witnesses contradict each other: chance once
in two million; errors of a map persist, and reach 17 on sound drives."""
_SIGMAS = 3.0  # by which ways of a whole drive differ, where that is reported: no pose changes
_MOUNT = 0.02
"""Of the way: a camera's yaw on its robot is known to a degree, a rig's scale to two percent; in no
covariance is either. Without, a real road contradicts its odometry until the rig is known."""
_CAP = 10.0  # of each kind of evidence in a frame, so that none decides for ever
_MOST = 20.0  # of the score: a hypothesis that turns out wrong is left within frames
_DECIDED = 3.0  # odds of 20 to 1
_BY_CHANCE = 0.25  # of matches around a wrong pose, share that fits it nevertheless
_SLACK = 3.0  # taken off what such matches or motions tell: what explains them was fitted
_PROVEN = 1.16  # of a landmark seen again from elsewhere: ln of 0.8 over 0.25
_SIGHTINGS, _MOVED_PX = 2, 3.0  # that prove a landmark: a hood stays where it is in the image
_LOWE, _ELSEWHERE_PX = 0.8, 5.0  # a twin: as near by its descriptor, elsewhere in the same image
_REMEMBERED = 30  # frames that a body is known by its descriptors
_ENDS = 5  # agreeing frames in a row end an episode
_RATIOS, _FEWEST_RATIOS = 15, 5  # contradicted frames that tell the ratio of the ways
_STUCK = 0.05  # ratio of ways that counts as none: a hood shows that, too
_NAMED = 3  # frames of a kind, from which on a cause is named
_JUMPS = 2  # of images that are out of order: away, and back
_STEADY = 0.1  # scatter of the ways' ratio, or radians: of wheels that slip it is many times that
_TURN_AND_WAY = slice(0, 3), slice(3, 6)
_WITNESSES = "by_images", "by_odometry"
_EXACT = 1e-12 * np.eye(6)  # a covariance that states no error at all


class Witnesses:
    """Follows both witnesses of a drive with measured odometry, and decides between them.

    Attributes:
        score: odds (natural logarithm) that odometry is right, at the end of each episode; of the
            last one, as it is now.
        apart: frames that followed the images while odometry's pose was another.
        found: all contradicted frames.
        disordered: numbers of the frames whose images belong to other frames.
    """

    score: Kept[list[float]]
    apart: Kept[list[Apart]]
    found: Kept[list[Contradiction]]
    disordered: Kept[list[int]]
    _shown: Kept[list[Shown]]
    _jumping: Kept[bool]
    _agreeing: Kept[int]
    _other: Kept[Apart | None]
    _erred: Kept[FloatArray]
    _agreed_m: Kept[float]
    _relative: Kept[FloatArray]
    _scale: Kept[FloatArray]
    _proofs: Kept[Proofs]
    _body: Kept[ByteArray]
    _seen: Kept[IntArray]
    _rows: Kept[int]

    def __init__(self, tracker: LandmarkTracker, follows_images: bool = True) -> None:
        """Nothing contradicts anything yet, nor ever if the pose never follows the images."""
        self._tracker, self._follows_images = tracker, follows_images
        self.score, self.apart, self.found, self.disordered = [], [], [], []
        self._shown, self._jumping = [], False  # the last frames; images, in this episode
        self._agreeing = _ENDS
        self._other = None  # of the last frame
        self._erred = np.zeros(6)  # odometry, where the images contradicted it last
        self._agreed_m = 0.0  # way since then
        self._relative = np.zeros((6, 6))  # covariance of the last pose, relative to its landmarks
        self._scale = np.zeros(2)  # information and score of the images' scale over odometry's
        self._proofs = Proofs.none()
        self._body, self._seen = np.empty((0, 128), np.uint8), np.empty(0, np.int64)
        self._rows = 0
        self._judged: EgoMotion | None = None  # the pose of a frame as images have it

    # -- one frame -----------------------------------------------------------------------------

    def contradicts(self, frame: Frame, tracking: EgoMotion) -> bool:
        """Whether odometry contradicts a pose; while its own chain lies elsewhere, it may."""
        step = frame.odometry
        if step is None or not step.measured or not self._follows_images:
            return False
        if self._other or self._jumping or tracking.status is EgoMotionStatus.CAPPED:
            return True
        return self._squared(step, frame.prediction, tracking) > _GATE

    def widened(self, odometry: Odometry | None) -> Odometry | None:
        """Odometry, as uncertain as it errs while images are decided to be right.

        Else it would pull a frame of few matches along, which then seems to agree.
        """
        if odometry is None or self._other is None or self.score[-1] >= -_DECIDED:
            return odometry
        errs = np.outer(self._erred, self._erred)
        return replace(odometry, covariance=odometry.covariance + errs)

    def judge(self, frame: Frame, tracked: Tracked) -> Judged:
        """The frame as it is to be taken in.

        Args:
            frame: what the images and odometry of it are.
            tracked: the frame as images have it, stabilised by the prediction or without it.
        """
        step = frame.odometry
        if step is None or not step.measured or not self._follows_images:
            doubted = self._jumping and tracked.ego_motion.status.measured
            return Judged(_doubted(tracked) if doubted else tracked, "agreed", step)
        self._judged = tracked.ego_motion
        body = self._body_in(frame.features)
        tracked = _beginning_none(tracked, body)
        agreed = Judged(tracked, "agreed", frame.taken)
        found, here = tracked.ego_motion, self._other
        # What was cut off its correction is the contradiction.
        free = found.status is EgoMotionStatus.CAPPED
        images = self._of_images(frame, tracked) if free else tracked
        far = found.status.measured and self._contradicted(frame, images)
        jumps = self._jumping
        if not far and here is None:
            self._agreeing += 1
            if jumps:  # by chance: of which moment it is, nothing shows
                return Judged(self._blind(frame, tracked, frame.prediction), "odometry", step)
            return agreed
        if here is None and self._agreeing >= _ENDS:
            self.score.append(0.0)  # an episode begins
        if not far:
            images = tracked
        elif not free:
            images = self._of_images(frame, tracked)
        self._judged = images.ego_motion
        chain = self._chain(frame)
        odometry = self._of_odometry(frame, images, chain)
        self._weigh(odometry, far, body, jumps)
        score = self.score[-1]
        verdict: Verdict = "undecided"
        if abs(score) > _DECIDED:
            verdict = "odometry" if score > 0.0 else "images"
        self._agreeing = 0 if far else self._agreeing + 1
        if far:
            self._record(frame, images.ego_motion, odometry, verdict)
        if verdict == "odometry":
            if jumps:
                odometry = odometry._replace(repeats=True, aliased=False)
            if not odometry.repeats:
                self._remember(frame.features.descriptors[odometry.features])
            odometry = odometry._replace(tracked=_beginning_none(odometry.tracked, body))
            return self._gone_over(frame, odometry, chain)
        self._go_on(frame, images.ego_motion.wTc, chain)
        if not far:
            return agreed
        if verdict == "undecided":
            images = _doubted(images)
        return Judged(images, verdict, frame.step)

    def observe(self, increment: Increment, tracking: EgoMotion) -> None:
        """Ends a frame: counts agreement, proves landmarks, goes on with odometry's chain."""
        judged, self._judged = self._judged, None
        step = increment.odometry
        self._look_for_order(increment, judged or tracking)
        known = step is not None and step.measured
        if judged is None:
            self._agreeing += 1
            if step is not None and self._other is not None:
                there = inverse(step.motion) @ self._other.iTo @ step.motion
                spread = compose_covariance(step.motion, self._other.covariance, step.covariance)
                self._other = replace(self._other, row=self._rows, iTo=there, covariance=spread)
                self.apart.append(self._other)
        if step is not None and self._agreeing:
            self._agreed_m += float(np.linalg.norm(step.motion[:3, 3]))
        if self._agreeing >= _ENDS:
            self._other, self._jumping = None, False
            seen = increment.kept
            if known and tracking.status.measured:
                self._proofs = self._proofs.seen(seen.ids, seen.measurement[:, :2])
            if len(increment.pruned_ids):
                keep = ~np.isin(self._proofs.ids, increment.pruned_ids)
                self._proofs = self._proofs.select(keep)
        if tracking.status.measured or step is None:
            self._relative = tracking.covariance
        else:
            self._relative = compose_covariance(step.motion, self._relative, step.covariance)
        self._rows += 1

    # -- its steps -----------------------------------------------------------------------------

    def _squared(
        self, step: Odometry, prediction: Prediction, tracking: EgoMotion, old: bool = False
    ) -> float:
        """Innovation of a pose, squared in the metric of what both witnesses leave open.

        Relative to landmarks seen lately that is the odometry's step; of ``old`` ones, to which
        the drive returns, what the prediction states.
        """
        noise = self._noise(step, tracking) + (prediction.covariance if old else 0.0)
        return _squared(self._tracker.constrained(prediction).wTc, tracking.wTc, noise)

    def _noise(self, step: Odometry, tracking: EgoMotion) -> FloatArray:
        """(6, 6) what a step, the poses around it and the camera's place on its robot explain."""
        noise = compose_covariance(step.motion, self._relative, step.covariance)
        noise = noise + tracking.covariance + _EXACT
        noise[3:, 3:] += np.eye(3) * (_MOUNT * np.linalg.norm(step.motion[:3, 3])) ** 2
        return noise

    def _contradicted(self, frame: Frame, tracked: Tracked) -> bool:
        used = tracked.expected.ids[tracked.matches.landmarks[tracked.ego_motion.inliers]]
        recent = np.isin(used, self._tracker.database.described_lately(LATELY))
        old = 2 * int(recent.sum()) < len(used)
        return self._squared(frame.step, frame.prediction, tracked.ego_motion, old) > _GATE

    def _of_images(self, frame: Frame, tracked: Tracked) -> Tracked:
        """The images' hypothesis, without the odometry that it contradicts."""
        around = Prediction(tracked.ego_motion.wTc, tracked.ego_motion.covariance)
        found = self._tracker.track_around(around, frame.landmarks, frame.features)
        return found if found.ego_motion.status.measured else tracked

    def _chain(self, frame: Frame) -> Prediction:
        """Odometry's pose: since both agreed last, where the frames since followed the images."""
        if self._other is None:
            return frame.prediction
        step = frame.step
        before = frame.prediction.wTc @ inverse(step.motion) @ self._other.iTo
        spread = compose_covariance(step.motion, self._other.covariance, step.covariance)
        return Prediction(before @ step.motion, spread)

    def _where_odometry_has_them(self, landmarks: LandmarkMap) -> LandmarkMap:
        """The map, with the landmarks of frames that followed the images moved to its chain."""
        if self._other is None:
            return landmarks
        positions, covariances = landmarks.positions.copy(), landmarks.covariances.copy()
        for one in self.apart:  # later ones overwrite what earlier ones moved
            if one.episode == self._other.episode:
                own = landmarks.ids >= one.first_new
                positions[own] = transform_to_world(one.oTi, landmarks.positions[own])
                turned = rotate_covariances(one.oTi[:3, :3], landmarks.covariances[own])
                covariances[own] = turned
        return LandmarkMap(landmarks.ids, positions, covariances)

    def _of_odometry(self, frame: Frame, images: Tracked, chain: Prediction) -> Odometrys:
        """Odometry's hypothesis, refined by the matches around it, and what separates the two.

        What the images' pose alone explains is left out around odometry's: it is the other body.
        """
        tracker, features = self._tracker, frame.features
        there = self._where_odometry_has_them(frame.landmarks)
        pose, used = images.ego_motion, images.ego_motion.inliers
        ids = images.expected.ids[images.matches.landmarks[used]]
        at = images.matches.features[used]
        seen = features.observations(at, ids, is_new=False)
        for_odometry = PoseProblem.of(there, seen)
        other = ~tracker.fits(chain.wTc, for_odometry, _SLACK)
        nothing = np.empty(0, np.int64)
        tracked = self._around(chain, there.without(ids[other]), features, nothing)
        also = tracked.matches.features[tracked.ego_motion.inliers]
        sure = _surprise(len(also), len(tracked.matches.features)) > _CAP + _SLACK
        aliased = sure and 2 * int(np.isin(also, at[other]).sum()) > len(also)
        if not aliased:
            tracked = self._around(chain, there, features, at[other])
        if self._off(frame, chain, tracked.ego_motion):  # the body has pulled it along
            tracked = self._around(chain, there, features, at)
        expected, full, own = tracked.expected, tracked.matches, tracked.ego_motion
        if self._off(frame, chain, own):
            own = tracker.track_blind(chain, EgoMotionStatus.TOO_FEW_MATCHES)
            none = np.zeros(len(full.landmarks), np.bool_)
            own = replace(own, inliers=none, residuals=np.full(len(none), np.inf))
        only = ~tracker.fits(own.wTc, for_odometry)
        known = features.observations(full.features, expected.ids[full.landmarks], is_new=False)
        against = np.ones(len(known), np.bool_)
        if pose.status.measured:
            against = ~tracker.fits(pose.wTc, PoseProblem.of(frame.landmarks, known))
        return Odometrys(
            Tracked(expected, full, own),
            bool(self._rejoined(frame, pose, chain)),
            at[only],
            ids[only],
            known.ids[against & own.inliers],
            int(against.sum()),
            aliased,
            aliased or self.repeats(features, at[only], images, ids[only]),
        )

    def _around(
        self, chain: Prediction, there: LandmarkMap, features: StereoFeatures, left_out: IntArray
    ) -> Tracked:
        """The frame around odometry's pose, without some of its features; they begin nothing."""
        free: BoolArray = np.ones(len(features), np.bool_)
        free[left_out] = False
        rest, where = features.select(free), np.flatnonzero(free)
        expected, matches = self._tracker.matched_around(chain, there, rest)
        solved = self._tracker.solved(chain, there, (expected, matches, rest))
        had = ~free
        had[where] = matches.had_candidates
        matches = MapMatches(matches.landmarks, where[matches.features], had)
        return replace(solved, matches=matches)

    def _off(self, frame: Frame, chain: Prediction, pose: EgoMotion) -> bool:
        """Whether a pose is none that odometry explains."""
        if not pose.status.measured:
            return False
        if self._other is None:
            return self._squared(frame.step, chain, pose) > _GATE
        noise = chain.covariance + pose.covariance + _EXACT
        return _squared(self._tracker.constrained(chain).wTc, pose.wTc, noise) > _GATE

    def _rejoined(self, frame: Frame, pose: EgoMotion, chain: Prediction) -> bool:
        """Whether what the images show, after frames that followed them, is odometry's chain.

        Nothing comes back to a chain so uncertain that the images never left it.
        """
        if self._other is None or not pose.status.measured or self._off(frame, chain, pose):
            return False
        last = replace(pose, wTc=frame.prediction.wTc @ inverse(frame.step.motion))
        if not self._off(frame, chain, last):
            return False
        return self._squared(frame.step, frame.prediction, pose) > _GATE

    def repeats(
        self, features: StereoFeatures, at: IntArray, images: Tracked, ids: IntArray
    ) -> bool:
        """Whether most of some features (k,) resemble others of the image as their landmarks."""
        if not len(at):
            return False
        known = images.expected.descriptors[np.searchsorted(images.expected.ids, ids)]
        own = features.descriptors[at]
        squared = squared_distances(own, features.descriptors).astype(np.float64)
        places = features.measurement[:, :2]
        far = np.linalg.norm(places[at][:, None] - places[None], axis=2) > _ELSEWHERE_PX
        twin = np.sqrt(np.where(far, squared, np.inf).min(axis=1))
        return bool(np.mean(descriptor_distance(own, known) > _LOWE * twin) > 0.5)

    def _body_in(self, features: StereoFeatures) -> IntArray:
        """The features (k,) that look like the body that passed lately."""
        keep = self._seen > self._rows - _REMEMBERED
        self._body, self._seen = self._body[keep], self._seen[keep]
        return mutual_nearest(features.descriptors, self._body)[0]

    def _remember(self, descriptors: ByteArray) -> None:
        """What only the images' pose explains, while odometry is right, is the other body."""
        again = mutual_nearest(descriptors, self._body)[1]
        old = np.delete(np.arange(len(self._seen)), again)
        self._body = np.concatenate([self._body[old], descriptors])
        self._seen = np.concatenate([self._seen[old], np.full(len(descriptors), self._rows)])

    def _weigh(self, odometry: Odometrys, far: bool, body: IntArray, jumps: bool) -> None:
        """Adds a frame's evidence to the score, each kind no more than its cap."""
        fits, of = len(odometry.ids), odometry.against
        # What began in frames that do not repeat has another reason.
        repeats = [odometry.repeats, *(one.repeats for one in self._lately())]
        proven = self._proofs.proven
        kinds = [
            _surprise(fits, of) - _SLACK if fits > _BY_CHANCE * of else 0.0,
            _PROVEN * proven(odometry.ids),
            _CAP * (far and 2 * sum(repeats) >= len(repeats) and odometry.repeats),
            _CAP * (2 * len(np.intersect1d(odometry.features, body)) > len(odometry.features)),
        ]
        total = sum(min(max(kind, 0.0), _CAP) for kind in kinds)
        if not odometry.repeats:
            total -= min(_PROVEN * proven(odometry.only_images), _CAP)
        if far:
            total -= min(max(self._steady(), 0.0), _CAP)
        score = min(max(self.score[-1] + total, -_MOST), _MOST)
        self.score[-1] = _MOST if odometry.rejoined or jumps else score

    @property
    def _longer(self) -> tuple[float, float]:
        """Share by which ways of all agreed frames are longer in images, and its deviation."""
        information, score = self._scale.tolist()
        variance = 1.0 / max(information, 1e-12)
        return score * variance, math.sqrt(variance)

    def _look_for_order(self, increment: Increment, pose: EgoMotion) -> None:
        """Whether the images of the last frames belong to others of them."""
        step = increment.odometry  # measured, or of a constant velocity
        if step is None or not pose.status.measured:
            self._shown = []
            return
        noise = self._noise(step, pose)
        here = Shown(increment.index, step.measured, pose.wTc, step.motion, noise)
        self._shown = [*self._shown, here][-_RATIOS:]
        if len(self._shown) > 1 and step.measured and self._other is None:
            self._compare_ways(*self._shown[-2:])
        given, self._shown = self._shown, in_order(self._shown)
        pairs = zip(given, self._shown, strict=True)
        if moved := [one.number for one, there in pairs if one.wTc is not there.wTc]:
            self.disordered = sorted({*self.disordered, *moved})
            self._jumping, self._agreeing = True, 0

    def _compare_ways(self, before: Shown, here: Shown) -> None:
        """Adds what an agreeing step shows of the images' scale over odometry's."""
        expected, way = before.wTc @ here.motion, np.append(np.zeros(3), here.motion[:3, 3])
        known = np.linalg.solve(here.covariance, way)
        # What is noise alone has no scale.
        if _squared(expected, here.wTc, here.covariance) < _GATE < known @ way:
            longer = known @ se3_log(inverse(expected) @ here.wTc)
            self._scale = self._scale + np.array([known @ way, longer])

    def _lately(self) -> list[Contradiction]:
        """The last contradicted frames of this episode."""
        return [one for one in self.found if one.episode == len(self.score) - 1][-_RATIOS:]

    def _steady(self) -> float:
        """Evidence that odometry errs by a factor: its way is a fixed share of the images'.

        Or its turn of theirs.
        """
        lately = self._lately()
        if len(lately) < _FEWEST_RATIOS:
            return 0.0
        seen, given = (np.array([getattr(one, name) for one in lately]) for name in _WITNESSES)
        return max(_by_factor(seen[:, k], given[:, k]) for k in _TURN_AND_WAY)

    def _record(
        self, frame: Frame, images: EgoMotion, odometry: Odometrys, verdict: Verdict
    ) -> None:
        """Books a contradicted frame, for the cause that is named."""
        self._erred = se3_log(inverse(frame.prediction.wTc) @ images.wTc)
        self._agreed_m = 0.0
        before = frame.prediction.wTc @ inverse(frame.step.motion)
        by_images, by_odometry = (
            np.append(
                so3_log(before[:3, :3].T @ wTc[:3, :3]), before[:3, :3].T @ (wTc - before)[:3, 3]
            )
            for wTc in (images.wTc, frame.prediction.wTc)
        )
        noise = np.diagonal(self._noise(frame.step, images))
        columns = frame.features.measurement[odometry.features, 0] / self._tracker.rig.width
        left, right = np.percentile(columns, (5.0, 95.0)) if len(columns) else (0.0, 0.0)
        share = len(columns) / max(len(columns) + len(odometry.ids), 1)
        self.found.append(
            Contradiction(
                number=frame.number,
                episode=len(self.score) - 1,
                verdict=verdict,
                by_images=by_images,
                by_odometry=by_odometry,
                misfit=((by_images - by_odometry) ** 2 / noise).reshape(2, 3).sum(axis=1),
                view=np.clip([left, right, share], 0.0, 1.0),
                fits=len(odometry.ids),
                repeats=odometry.repeats,
            )
        )

    def _gone_over(self, frame: Frame, odometry: Odometrys, chain: Prediction) -> Judged:
        """The frame as odometry has it; landmarks begun since the pose left its chain end."""
        other, self._other = self._other, None
        tracked, step = odometry.tracked, frame.step
        if odometry.repeats and not odometry.aliased:
            tracked = self._blind(frame, tracked, chain)
        if other is None:
            return Judged(tracked, "odometry", step)
        begun = min(one.first_new for one in self.apart if one.episode == other.episode)
        ids = frame.landmarks.ids
        before = frame.prediction.wTc @ inverse(step.motion)
        step = Odometry(inverse(before) @ chain.wTc, chain.covariance)
        return Judged(_without(tracked, begun), "odometry", step, ids[ids >= begun])

    def _blind(self, frame: Frame, tracked: Tracked, chain: Prediction) -> Tracked:
        """The frame by odometry alone: its images have no say, and begin nothing."""
        alone = self._tracker.track_blind(chain, EgoMotionStatus.TOO_FEW_MATCHES)
        none, had = np.empty(0, np.int64), np.ones(len(frame.features), np.bool_)
        return Tracked(tracked.expected, MapMatches(none, none, had), alone)

    def _go_on(self, frame: Frame, wTc: FloatArray, chain: Prediction) -> None:
        """Odometry's chain next to a frame that follows the images."""
        self._other = Apart(
            row=self._rows,
            episode=len(self.score) - 1,
            iTo=inverse(wTc) @ chain.wTc,
            covariance=chain.covariance,
            first_new=self._tracker.database.next_id,
            oTi=chain.wTc @ inverse(wTc),
        )
        self.apart.append(self._other)

    # -- what it makes of the drive ------------------------------------------------------------

    def spread(self, estimate: Estimate) -> Estimate:
        """The estimate with what is open between the witnesses in its covariances.

        Where odometry turned out right, frames that followed the images are placed by its chain.
        """
        by_images, relative = estimate.trajectory.poses, {}
        others = self._others(by_images)
        if not self.apart and not others:
            return estimate
        poses, chains = by_images.copy(), np.zeros_like(estimate.covariances)
        episodes = np.full(len(poses), -1)
        for one in self.apart:
            if self.score[one.episode] > _DECIDED:
                poses[one.row] = by_images[one.row] @ one.iTo
                chains[one.row], episodes[one.row] = one.covariance, one.episode
        online = dict(estimate.online_relative)
        for lag in {**estimate.relative, **online}:
            motions = inverse(poses[:-lag]) @ poses[lag:]
            back, first, last = inverse(motions), chains[:-lag], chains[lag:]
            ways = [(p, back @ inverse(iTo[:-lag]) @ motions @ iTo[lag:]) for p, iTo in others]
            apart = _mixture(ways)
            if lag in estimate.relative:
                same = episodes[:-lag] == episodes[lag:]  # one chain errs on from there
                cross = same[:, None, None] * first @ np.swapaxes(adjoint(back), 1, 2)
                chained = motion_covariance(motions, first, last, cross)
                relative[lag] = estimate.relative[lag] + chained + apart
            if lag in online:  # frames that were moved later stood elsewhere
                moved = np.maximum(episodes[:-lag], episodes[lag:]) >= 0
                online[lag] = np.where(moved[:, None, None], np.nan, online[lag] + apart)
        trajectory = Trajectory(estimate.trajectory.timestamps, poses)
        covariances = estimate.covariances + chains + _mixture(others)
        known = replace(estimate, relative=relative, online_relative=online)
        return replace(known, trajectory=trajectory, covariances=covariances)

    def open_covariance(self, wTc: FloatArray) -> FloatArray:
        """(6, 6) to be added to the covariance of the last pose: what is open between the two."""
        return _mixture(self._others(wTc[None], self._rows - 1)).reshape(6, 6)

    def _others(self, poses: FloatArray, first: int = 0) -> list[tuple[float, FloatArray]]:
        """What odometry may be right about: the odds, and from poses (n, 4, 4) to its own of them.

        An episode each that has not turned to odometry; all that comes after it moves with it.
        """
        out = []
        for episode, score in enumerate(self.score):
            frames = [one for one in self.apart if one.episode == episode]
            if frames and score <= _DECIDED:
                iTo = inverse(poses) @ frames[-1].oTi @ poses
                iTo[: max(frames[-1].row + 1 - first, 0)] = np.eye(4)
                for one in frames:
                    if one.row >= first:
                        iTo[one.row - first] = one.iTo
                out.append((1.0 / (1.0 + math.exp(-score)), iTo))
        longer, sigma = self._longer
        if abs(longer) > sigma:  # beyond noise it is open whose scale is wrong
            scaled = poses.copy()
            scaled[:, :3, 3] /= 1.0 + longer
            out.append((0.5 - 0.5 * (sigma / longer) ** 2, inverse(poses) @ scaled))
        return out

    def _decided(self, one: Contradiction) -> Verdict:
        score = self.score[one.episode]
        if one.verdict != "undecided" or abs(score) <= _DECIDED:
            return one.verdict
        return "odometry" if score > 0.0 else "images"

    @property
    def misplaced(self) -> list[int]:
        """Numbers of the frames whose images belong to others, or do so in all likelihood."""
        jumping = {one.episode for one in self.found if one.number in self.disordered}
        also = (one.number for one in self.found if one.episode in jumping)
        return sorted({*self.disordered, *also})

    def remarks(self) -> tuple[Remark, ...]:
        """The causes, as far as the drive shows them."""
        by, jumps = defaultdict[str, list[Contradiction]](list), self.misplaced
        for one in self.found:
            by["jumps" if one.number in jumps else self._decided(one)].append(one)
        repeats = [one for one in by["odometry"] if one.repeats]
        bodies = [one for one in by["odometry"] if not one.repeats]
        errs, values = _odometry_errs(by["undecided"], self._agreed_m)
        named: tuple[tuple[list[Contradiction], _Cause], ...] = (
            (by["images"], _odometry_errs(by["images"], self._agreed_m)),
            (repeats, ("scene_repeats", {})),
            (bodies, _body_moves(bodies)),
            (by["undecided"], ("witnesses_undecided", {"errs": errs, **values})),
        )
        out = [Remark("images_out_of_order", tuple(jumps))] if jumps else []
        longer, sigma = self._longer
        if abs(longer) > _SIGMAS * math.hypot(_MOUNT, sigma):
            out.append(Remark("scale_doubted", values={"ratio": 1.0 / (1.0 + longer)}))
        out += (
            Remark(code, tuple(one.number for one in frames), values)
            for frames, (code, values) in named
            if len(frames) >= _NAMED
        )
        return tuple(out)


def in_order(shown: Sequence[Shown]) -> list[Shown]:
    """The frames, each with the image that fits its motion: where all do so, and else not.

    The motion is the odometry's; where none was measured, that of the sorted images stays. Both
    err by what was known before the first of them: later ones are as uncertain as they are odd.
    """
    odd = [_squared(a.wTc @ b.motion, b.wTc, b.covariance) > _GATE for a, b in pairwise(shown)]
    if sum(odd) < _JUMPS:
        return [*shown]
    at = max(odd.index(True) + 1 - _JUMPS, 1)  # what came before its time may have passed the gate
    out, rest, first, motion = [*shown[:at]], [*shown[at:]], shown[at], shown[at].motion
    way = reduce(np.matmul, [one.motion for one in rest]) if first.measured else motion
    if _squared(np.eye(4), way, first.covariance) < _GATE:  # at rest no order is seen
        return [*shown]
    for frame in shown[at:]:
        motion = frame.motion if frame.measured else motion
        expected = out[-1].wTc @ motion
        off = [_squared(expected, one.wTc, first.covariance) for one in rest]
        if min(off) > _GATE:
            return [*shown]
        out.append(replace(frame, wTc=rest.pop(int(np.argmin(off))).wTc))
        motion = inverse(out[-2].wTc) @ out[-1].wTc
    return out


def _squared(expected: FloatArray, wTc: FloatArray, noise: FloatArray) -> float:
    """Chi-square of how far a pose (4, 4) is from where it was expected."""
    off = se3_log(inverse(expected) @ wTc)
    return float(off @ np.linalg.solve(noise, off))


def has_moved(step: Odometry | None) -> bool:
    """Whether measured odometry contradicts that the robot stands."""
    if step is None or not step.measured:
        return False
    return _squared(np.eye(4), step.motion, step.covariance + _EXACT) > _GATE


def _by_factor(seen: FloatArray, given: FloatArray) -> float:
    """Log odds that motions (n, 3) are others turned and times a factor, of better explanations.

    That what is seen passes with a constant velocity, the difference of both is fixed; or that it
    is carried along, and the images show no motion.
    """
    u, size, v = np.linalg.svd(seen.T @ given)  # orthogonal Procrustes (Schoenemann 1966)
    alike = size.sum() / max(float((given**2).sum()), 1e-12) * given @ (u @ v).T
    noise = (0.01 * float(np.abs(seen).max()) + 0.001) ** 2
    factor = float(np.mean((seen - alike) ** 2))
    other = min(float(np.var(seen - given, axis=0).mean()), float(np.mean(seen**2)))
    return 0.5 * len(seen) * math.log((other + noise) / (factor + noise)) - _SLACK


_Cause: TypeAlias = tuple[str, dict[str, float | str]]
"""Code and values of a remark."""


def _odometry_errs(frames: Sequence[Contradiction], agreed_m: float) -> _Cause:
    """How odometry errs where images are right: by a factor, into a direction, or by slipping.

    A wrong factor stays: what agrees again, over some way, has slipped.
    """
    if not frames:
        return "", {}
    turns, ways = np.median([one.misfit for one in frames], axis=0)
    kind = _TURN_AND_WAY[0 if turns > ways else 1]
    seen, given = (np.array([getattr(one, name)[kind] for one in frames]) for name in _WITNESSES)
    lengths = np.maximum(np.linalg.norm([seen, given], axis=2), 1e-12)
    common = (seen * given).sum(axis=1)
    ratios = common / lengths[0] ** 2
    angles = np.arccos(np.clip(common / lengths.prod(axis=0), -1.0, 1.0))
    length, ratio, angle = np.median([lengths[1] / lengths[0], ratios, angles], axis=1).tolist()
    scatter, strays = robust_spread(ratios), robust_spread(angles)
    if turns > ways:
        return "odometry_turns", {"ratio": ratio, "scatter": scatter}
    if length < _STUCK:
        return "odometry_stuck", {}
    if scatter > _STEADY * max(abs(ratio), 1.0) or min(angle, np.pi - angle) > 3.0 * _STEADY:
        code = "odometry_turned" if strays < _STEADY < angle / 3.0 else "odometry_slips"
        return code, {"degrees": math.degrees(angle)}
    if ratio > 0.0 and agreed_m > _ENDS * float(np.median(lengths[0])):
        return "odometry_slips", {}
    code = "odometry_reversed" if ratio < 0.0 else "odometry_scaled"
    return code, {"ratio": ratio, "scatter": scatter}


def _body_moves(frames: Sequence[Contradiction]) -> _Cause:
    """What passes, and where in the view it is seen."""
    if not frames:
        return "", {}
    left, right, share = 100.0 * np.median([one.view for one in frames], axis=0)
    fills = 2 * sum(one.fits == 0 for one in frames) > len(frames)
    code = "body_fills_view" if fills else "body_moves"
    return code, {"percent": float(share), "low": float(left), "high": float(right)}


def _surprise(fits: int, of: int) -> float:
    """``n KL(k/n || chance)``: how little chance explains that k of n matches fit a pose."""
    share = fits / max(of, 1)
    total = 0.0
    for found, expected in ((share, _BY_CHANCE), (1.0 - share, 1.0 - _BY_CHANCE)):
        total += found * math.log(found / expected) if found > 0.0 else 0.0
    return of * total


def _mixture(others: Iterable[tuple[float, FloatArray]]) -> FloatArray:
    """(n, 6, 6) of hypotheses: the odds of each, times the squares of how far (n, 4, 4) it is."""
    total = np.zeros((6, 6))
    for odds, motions in others:
        off = np.array([se3_log(one) for one in motions]).reshape(-1, 6)
        total = total + odds * off[:, :, None] * off[:, None, :]
    return total


def _doubted(tracked: Tracked) -> Tracked:
    """The frame, as one whose images something contradicts."""
    found = replace(tracked.ego_motion, status=EgoMotionStatus.CONTRADICTED)
    return replace(tracked, ego_motion=found)


def _beginning_none(tracked: Tracked, features: IntArray) -> Tracked:
    """The frame, some features of which begin no landmark."""
    had = tracked.matches.had_candidates.copy()
    had[features] = True
    return replace(tracked, matches=replace(tracked.matches, had_candidates=had))


def _without(tracked: Tracked, begun: int) -> Tracked:
    """The frame without its matches of landmarks from an identity on."""
    found, matches = tracked.ego_motion, tracked.matches
    keep = tracked.expected.ids[matches.landmarks] < begun
    kept = MapMatches(matches.landmarks[keep], matches.features[keep], matches.had_candidates)
    found = replace(found, inliers=found.inliers[keep], residuals=found.residuals[keep])
    return replace(tracked, matches=kept, ego_motion=found)


# ------------------------------------------------------------------------------------------
# What a frame is, and what is kept of it


class Frame(NamedTuple):
    """A frame before it is decided.

    Attributes:
        number: in its recording.
        odometry: the camera's motion since the last frame; None where nothing gives it.
        prediction: pose by it.
        taken: the same motion, as uncertain as it errs (:meth:`Witnesses.widened`).
        around: pose by that, around which landmarks are looked for.
        landmarks: the map.
        features: all of the frame's.
    """

    number: int
    odometry: Odometry | None
    prediction: Prediction
    taken: Odometry | None
    around: Prediction
    landmarks: LandmarkMap
    features: StereoFeatures

    @property
    def step(self) -> Odometry:
        """The odometry, of a frame for which it was measured. ValueError of another."""
        if self.odometry is None or not self.odometry.measured:
            raise ValueError(f"frame {self.number}: no odometry was measured")
        return self.odometry


class Odometrys(NamedTuple):
    """Odometry's hypothesis of a frame.

    Attributes:
        tracked: the frame as odometry has it.
        rejoined: the images have come back to odometry's chain.
        features: that the images' pose alone explains.
        only_images: landmarks that it alone explains.
        ids: landmarks that odometry's pose alone explains.
        against: matches around odometry's pose that the images' does not explain.
        aliased: features fit one landmark by the images' pose and another by odometry's.
        repeats: so they do, or they resemble other places of the same image: they tell nothing.
    """

    tracked: Tracked
    rejoined: bool
    features: IntArray
    only_images: IntArray
    ids: IntArray
    against: int
    aliased: bool
    repeats: bool


class Judged(NamedTuple):
    """A frame as it is to be taken in.

    Attributes:
        tracked: with the pose that is followed.
        verdict: which witness that is.
        step: the odometry to it, from the last pose: of the whole chain where the pose goes over.
        ended: landmarks begun while the pose was off odometry's chain, which turned out right.
    """

    tracked: Tracked
    verdict: Verdict
    step: Odometry | None
    ended: IntArray = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Contradiction:
    """One frame whose witnesses contradict each other.

    Attributes:
        number: in its recording.
        episode: that it belongs to.
        verdict: what was followed.
        by_images, by_odometry: (6,) turn and way since the last frame, radians and metres.
        misfit: (2,) chi-square of how far turns, and ways, are apart.
        view: (3,) what only the images' pose explains: columns between which it is seen, as shares
            of the width; share of the matches.
        fits: matches that speak for odometry alone.
        repeats: what the images' pose explains resembles other places of the same image.
    """

    number: int
    episode: int
    verdict: Verdict
    by_images: FloatArray
    by_odometry: FloatArray
    misfit: FloatArray
    view: FloatArray
    fits: int
    repeats: bool


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """Where the images have a frame, in any order of them.

    Attributes:
        number: of the frame in its recording.
        measured: its motion is odometry's; else that of a constant velocity.
        wTc: (4, 4) pose by the images.
        motion: (4, 4) expected since the last frame.
        covariance: (6, 6) of how far the pose may be off from there.
    """

    number: int
    measured: bool
    wTc: FloatArray
    motion: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Apart:
    """A frame that followed the images while odometry's pose is another.

    Attributes:
        row: of the frame among all.
        episode: that it belongs to.
        iTo: (4, 4) odometry's pose in the camera's frame as the images have it.
        covariance: (6, 6) of odometry's pose, since both agreed last.
        first_new: identity from which on its landmarks, and later ones, are numbered.
        oTi: (4, 4) moves these to where odometry has them.
    """

    row: int
    episode: int
    iTo: FloatArray
    covariance: FloatArray
    first_new: int
    oTi: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Proofs(Rows):
    """How often landmarks (n,) were seen again elsewhere in the image while both witnesses agreed.

    Attributes:
        ids: ascending.
        counts: of such sightings.
        places: (n, 2) where they were counted last, pixels.
    """

    ids: IntArray
    counts: IntArray
    places: FloatArray

    @staticmethod
    def none() -> Proofs:
        """Of no landmark."""
        return Proofs(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))

    def seen(self, ids: IntArray, places: FloatArray) -> Proofs:
        """With one frame's landmarks (k,), which it shows at places (k, 2)."""
        known = np.isin(ids, self.ids)
        rows = np.searchsorted(self.ids, ids[known])
        moved = np.linalg.norm(places[known] - self.places[rows], axis=1) > _MOVED_PX
        counts, there = self.counts.copy(), self.places.copy()
        counts[rows[moved]] += 1
        there[rows[moved]] = places[known][moved]
        fresh = Proofs(ids[~known], np.zeros(int((~known).sum()), np.int64), places[~known])
        joined = Proofs(self.ids, counts, there).join(fresh)
        return joined.select(np.argsort(joined.ids, kind="stable"))

    def proven(self, ids: IntArray) -> int:
        """How many of the landmarks are proven."""
        return int(np.isin(ids, self.ids[self.counts >= _SIGHTINGS]).sum())
