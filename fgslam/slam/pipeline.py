"""The SLAM loop (Se et al. 4): predict, match, ego-motion, update, database maintenance."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from fgslam.backend.protocol import Estimator, predicted, recalibrated, updated
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.correction import RigCorrection
from fgslam.core.sensors import (
    CAMERA_NAMES,
    Increment,
    LoopClosure,
    Measured,
    Odometry,
)
from fgslam.core.stopwatch import Stopwatch, timed
from fgslam.core.store import Kept, has_state, put_back, snapshot
from fgslam.core.types import (
    EgoMotion,
    EgoMotionStatus,
    Estimate,
    LandmarkMap,
    Prediction,
    StereoFeatures,
    UpdateStats,
)
from fgslam.frontend.camera_faults import FEW_DISPLACED, CameraWatch
from fgslam.frontend.stereo import RigStereo
from fgslam.frontend.tracking.ego_motion import MatchNoise, unmeasured
from fgslam.frontend.tracking.key_frames import CarriedFrame, KeyFrameTracker, spread
from fgslam.frontend.tracking.tracker import Association, LandmarkTracker, Tracked
from fgslam.slam.bridging import bridged
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import ConstantVelocityMotion, MotionModel, OdometryMotion
from fgslam.slam.witnesses import Frame, Witnesses, has_moved

if TYPE_CHECKING:
    from fgslam.backend.self_calibration import SelfCalibration
    from fgslam.frontend.places.recognition import PlaceRecognition


_DISPLACED = (
    "what one image shows of the map is not where the calibration has it in another (a camera that "
    "was moved, turned, mirrored, covered)"
)


def no_ids() -> IntArray:
    """No landmark's identity."""
    return np.empty(0, np.int64)


@dataclass(slots=True, eq=False)
class SlamPipeline:
    """The parts of the system and the loop over them.

    Attributes:
        places: None where none are recognised.
        calibration: of the rig, from the drive; None where the calibration is taken as stated.
        stated: (p,) zeros, the correction of a rig that no drive corrects but that is not exact: of
            a depth camera scale and lens are unknown; None: it is taken as exact.
        key_frames: tracking between key frames; None where every frame is one.
        watch: which frames' images cannot be used; None uses all.
        witnesses: decides between images and odometry where they contradict each other.
        describe: finds the features of a frame that came without: of all images, or of the
            reference image where patches measure the rest (`frontend.stereo.others`).
        describe_reference: of the first frame, and of one that tracked patches have located,
            those of its reference image alone.
        located: pose of the first frame, found in a saved map without a prior; None where it was
            not.
        look_ahead: called before the estimator's work where the next frame is likely to need
            features; None where they cannot be found meanwhile.
        rewound: the last frame's features could not be found, and it was rolled back; but what a
            closure before it ended has ended.
        watch_of_frame: time of the last frame, by stage.
    """

    stereo: RigStereo
    tracker: LandmarkTracker
    motion: MotionModel
    estimator: Estimator
    places: PlaceRecognition | None = None
    calibration: SelfCalibration | None = None
    stated: FloatArray | None = None
    key_frames: KeyFrameTracker | None = None
    watch: CameraWatch | None = None
    located: Prediction | None = None
    describe: Callable[[FeatureFrame], FeatureFrame] | None = None
    describe_reference: Callable[[FeatureFrame], FeatureFrame] | None = None
    look_ahead: Callable[[], None] | None = None
    rewound: bool = False
    watch_of_frame: Stopwatch = field(default_factory=Stopwatch, init=False)
    witnesses: Witnesses = field(init=False)
    _ended: Kept[IntArray] = field(default_factory=no_ids, init=False)
    _tried: tuple[FeatureFrame, StereoFeatures] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        """Begins with witnesses that agree."""
        self.witnesses = Witnesses(self.tracker, self.estimator.kind != "odometry")

    def process(
        self,
        frame: FeatureFrame,
        index: int,
        timestamp: float,
        body: Odometry | None = None,
        measured: tuple[Measured, ...] = (),
    ) -> FrameReport:
        """Processes one frame: Sections 2 to 4 of the paper in order, then loops (its section 7).

        Args:
            frame: its images, with or without their features.
            index: its number in the recording, for the log.
            timestamp: seconds.
            body: the robot's motion since the last frame; None where none was measured.
            measured: by other sensors.
        """
        self.watch_of_frame = Stopwatch()
        self.rewound = False
        parts = self.watch, self.motion, self.key_frames  # what a frame changes before its features
        before = [(part, snapshot(part)) for part in parts if has_state(part)]
        odometry, prediction = self._predict(timestamp, body)  # 3.1
        landmarks = self._current_map()
        step = self.witnesses.widened(odometry)
        around = prediction if step is odometry else predicted(self.estimator, step)
        now = Frame(index, odometry, prediction, step, around, landmarks, StereoFeatures.empty())
        carried = self._track_patches(now, frame)  # between key frames
        frame = self._check_cameras(frame, index, body, carried)  # late, frozen, swapped: not used
        if frame.refused and self.key_frames is not None:
            put_back(*before[-1])
            carried = None
        if self.key_frames and carried and self._needs_no_features(carried, now):
            stereo, features = carried.carried.features, None
            matched = Matched(carried.tracked.ego_motion, self.key_frames.record(carried), step)
        else:
            frame = self._find_features(frame, carried, before)  # 2.1
            every = self._match_stereo(frame)  # 2.2
            every, matched = self._track(now._replace(features=every), frame, carried)
            if matched.problem:
                frame = dataclasses.replace(frame, problem=matched.problem, refused=True)
            stereo = features = every.whole
            matched = self._recognise_places(matched, stereo, landmarks)
        if self.look_ahead is not None and self.key_frames and self.key_frames.nears_end:
            self.look_ahead()
        matched = self._end_landmarks(matched)
        increment = self._increment(index, timestamp, matched, measured)  # what the log holds
        stats, noise = self._update(increment, matched.ego_motion)  # 6.4
        if features is not None and not _known(matched.odometry):
            self._look_for_other_motion(index, features, matched, stats)
        self._calibrate(increment, stats)
        mixed = stats.covariance + self.witnesses.open_covariance(stats.wTc)
        if self.calibration is not None:
            mixed = mixed + self.calibration.open_covariances(1)[0]
        stats = dataclasses.replace(stats, covariance=mixed)
        times = self.watch_of_frame.ms
        return FrameReport(frame, stereo, increment, matched.ego_motion, stats, times, noise)

    # -- the steps, in their order -------------------------------------------------------------

    @timed("watch")
    def _check_cameras(
        self,
        frame: FeatureFrame,
        index: int,
        body: Odometry | None = None,
        carried: CarriedFrame | None = None,
    ) -> FeatureFrame:
        """The frame; of images not of one moment and this one, that of one camera, or none."""
        if self.watch is None or (whole := frame.whole) is None:
            return frame
        tracked = None
        if carried is not None:
            tracked = carried.carried.before, carried.carried.features.pixels
        fault = self.watch.look(whole.images, index, has_moved(body), tracked)
        if not fault:
            return frame
        alone = self.watch.alone
        if alone is None:
            return dataclasses.replace(frame, frame=None, features=(), problem=fault, refused=True)
        return dataclasses.replace(
            frame,
            frame=dataclasses.replace(whole, alone=alone),
            features=frame.features[alone : alone + 1],
            problem=f"{fault} (the {CAMERA_NAMES[alone]} image alone is left)",
            refused=True,
        )

    @timed("predict")
    def _predict(
        self, timestamp: float, body: Odometry | None
    ) -> tuple[Odometry | None, Prediction]:
        """The camera's motion, and the pose after it, on the map that the calibration has moved."""
        if self.calibration is not None:
            correction = self.calibration.found.applied.values
            recalibrated(self.estimator, correction, self.calibration.settled.since)
        odometry = self.motion.between(timestamp, body)
        return odometry, predicted(self.estimator, odometry)

    @timed("track")
    def _current_map(self) -> LandmarkMap:
        """The map to track on, without the landmarks that a loop closed in the last frame ends.

        The estimator drops these with this frame's measurements, as the log records it.
        """
        landmarks = self.estimator.landmarks().below(Measured.FIRST_ID)
        if self.places is not None:
            self._ended = np.union1d(self._ended, self.places.fuse(landmarks))
        return landmarks.without(self._ended) if len(self._ended) else landmarks

    @timed("track")
    def _track_patches(self, now: Frame, frame: FeatureFrame) -> CarriedFrame | None:
        """The frame by the landmarks whose patches are tracked into it; None where none are."""
        whole, correction = frame.whole, self._correction()
        if self.key_frames is None or whole is None:
            return None
        return self.key_frames.carry(now.around, now.landmarks, whole.images, correction)

    def _needs_no_features(self, carried: CarriedFrame, now: Frame) -> bool:
        """Whether enough patches are tracked, none contradicts, and no place is looked for."""
        if not carried.suffices or (self.places is not None and self.places.wants_features):
            return False
        return not self.witnesses.contradicts(now, carried.tracked.ego_motion)

    @timed("sift")
    def _find_features(
        self, frame: FeatureFrame, carried: CarriedFrame | None, before: Snapshot
    ) -> FeatureFrame:
        """The frame with features; of its reference image where tracked patches locate it.

        Whatever an extractor of the user's raises, the loop is then as it was before the frame.
        """
        first = self.key_frames is not None and frame.i == 0
        patches = first or (carried is not None and carried.placed)
        find = self.describe_reference if patches else self.describe
        if find is None:
            return frame
        try:
            return find(frame)
        except BaseException:
            for part, kept in before:
                put_back(part, kept)
            self.rewound = True
            raise

    @timed("stereo")
    def _match_stereo(self, frame: FeatureFrame) -> StereoFeatures:
        if frame.whole is None:
            return StereoFeatures.empty()
        tried, self._tried = self._tried, None
        if tried and tried[0].frame is frame.frame and tried[0].features is frame.features:
            return tried[1]
        return self.stereo.match(frame.frame, frame.features, self._correction())

    @timed("track")
    def _track(
        self, now: Frame, frame: FeatureFrame, carried: CarriedFrame | None
    ) -> tuple[StereoFeatures, Matched]:
        """A key frame by all its features, those of tracked patches among them (3.1 to 4.3)."""
        prediction, landmarks, stereo = now.around, now.landmarks, now.features
        if (whole := frame.whole) is None:
            if by_one := self._track_alone(now, frame):
                return stereo, by_one
            status = EgoMotionStatus.CAMERA_FAULT if frame.refused else EgoMotionStatus.NO_IMAGE
            blind = self.tracker.track_blind(prediction, status)
            return stereo, Matched(blind, Association.nothing(), now.taken)
        if self.key_frames is None:
            tracked = self.tracker.track(prediction, landmarks, stereo)
        else:
            tracked, stereo = self.key_frames.track(carried, prediction, landmarks, stereo)
        located, initialises = False, True
        if frame.i == 0 and self.located is not None:
            again = self.tracker.track_around(self.located, landmarks, stereo)
            located = again.ego_motion.status.measured
            tracked = again if located else tracked
        elif self.places is not None and frame.i > 0:  # where the prediction failed
            guessed = now.odometry is not None and not now.odometry.measured
            tracked = self.places.placed_by_recent(tracked, prediction, landmarks, stereo)
            tracked, located = self.places.recover(tracked, landmarks, stereo.whole, guessed)
            initialises = self.places.maps_on
        if len(landmarks) and (by_one := self._track_displaced(now, frame, tracked)):
            return stereo, by_one
        judged = self.witnesses.judge(now._replace(features=stereo), tracked)
        tracked = judged.tracked
        status = tracked.ego_motion.status
        by_images = status in (EgoMotionStatus.RELOCALISED, EgoMotionStatus.CONTRADICTED)
        relocalised = by_images or (located and judged.verdict == "agreed")
        settled = judged.verdict in ("agreed", "images")  # what is missing is so to both witnesses
        image = whole.images[0]
        if self.key_frames is not None:
            tracked = spread(tracked, stereo)
        association = self.tracker.associate(tracked, stereo, image, initialises, settled)
        if len(judged.ended):
            self.tracker.database.drop(judged.ended)
            pruned = np.union1d(association.pruned_ids, judged.ended)
            association = dataclasses.replace(association, pruned_ids=pruned)
        if self.key_frames is not None:
            self.key_frames.begin(image, stereo, association)
        if frame.i == 0 and not len(landmarks):
            first = unmeasured(prediction, EgoMotionStatus.FIRST)
            return stereo, Matched(first, association, now.odometry)
        return stereo, Matched(tracked.ego_motion, association, judged.step, (), relocalised)

    def _track_alone(self, now: Frame, frame: FeatureFrame) -> Matched | None:
        """The frame by its only usable image; None where that fails or odometry contradicts it."""
        if frame.frame is None or frame.frame.alone is None or not frame.features:
            return None
        camera = frame.frame.alone
        seen = self.stereo.matcher.alone(camera, frame.features[0], self._correction())
        tracked, as_rig = self.tracker.track_alone(camera, now.prediction, now.landmarks, seen)
        pose = tracked.ego_motion
        if self.witnesses.contradicts(now, pose) or not pose.status.measured:
            return None
        return Matched(pose, self.tracker.associate_carried(tracked, as_rig), now.odometry)

    def _track_displaced(self, now: Frame, frame: FeatureFrame, tracked: Tracked) -> Matched | None:
        """A frame whose pair fits no landmark, by the image that does; None where the pair counts.

        Where none does any more, by odometry: what such a pair measures begins no map.
        """
        watch = self.watch
        if watch is None:
            return None
        if tracked.ego_motion.status.measured:
            watch.displaced = 0
            return None
        for camera, found in enumerate(frame.features):
            seen = self.stereo.matcher.alone(camera, found, self._correction())
            alone, as_rig = self.tracker.track_alone(camera, now.prediction, now.landmarks, seen)
            pose, at = alone.ego_motion, alone.matches.features[alone.ego_motion.inliers]
            if not pose.status.measured or self.witnesses.contradicts(now, pose):
                continue
            pair = now.features
            places = map(tuple, pair.pixels[:, camera].tolist())
            shown = dict(zip(places, pair.measurement[:, 2].tolist(), strict=True))
            measured = np.array([shown.get(tuple(xy), math.nan) for xy in found.xy[at].tolist()])
            if watch.in_place(as_rig.measurement[at, 2], measured):
                return None
            kept = self.tracker.associate_carried(alone, as_rig)
            problem = f"{_DISPLACED} (the {CAMERA_NAMES[camera]} image alone is left)"
            ids = alone.expected.ids[alone.matches.landmarks[pose.inliers]]
            if self.witnesses.repeats(seen, at, alone, ids):  # the pair may have mistaken its parts
                problem, watch.displaced = "", 0
            return Matched(pose, kept, now.odometry, problem=problem)
        if watch.displaced < FEW_DISPLACED:
            return None
        blind = self.tracker.track_blind(now.around, EgoMotionStatus.CAMERA_FAULT)
        return Matched(blind, Association.nothing(), now.taken, problem=_DISPLACED)

    @timed("places")
    def _recognise_places(
        self, matched: Matched, stereo: StereoFeatures, landmarks: LandmarkMap
    ) -> Matched:
        """The frame with the loops that it may close."""
        if self.places is None:
            return matched
        wTc, association = matched.ego_motion.wTc, matched.association
        loops = self.places.look(wTc, landmarks, stereo, association)
        return dataclasses.replace(matched, loops=loops)

    def _end_landmarks(self, matched: Matched) -> Matched:
        """Landmarks that ended before the frame go with it."""
        ended, self._ended = self._ended, no_ids()
        if not len(ended):
            return matched
        pruned = np.union1d(matched.association.pruned_ids, ended)
        association = dataclasses.replace(matched.association, pruned_ids=pruned)
        return dataclasses.replace(matched, association=association)

    def _increment(
        self, index: int, timestamp: float, matched: Matched, measured: tuple[Measured, ...]
    ) -> Increment:
        association, calibration = matched.association, self.calibration
        return Increment(
            index=index,
            timestamp=timestamp,
            odometry=matched.odometry,
            observations=association.observations,
            rejected=association.rejected,
            missed_ids=association.missed_ids,
            pruned_ids=association.pruned_ids,
            loops=matched.loops,
            relocalised=matched.relocalised,
            rig_correction=self.stated if calibration is None else calibration.found.applied.values,
            settled_rig=None if calibration is None else calibration.settled,
            measured=measured,
        )

    @timed("update")
    def _update(
        self, increment: Increment, ego_motion: EgoMotion
    ) -> tuple[UpdateStats, FrameNoise]:
        """The estimator takes the frame in; motion model, noise and places learn from it."""
        stats = updated(self.estimator, increment, ego_motion)
        noise = noise_in_use(self.motion, increment.odometry, self.tracker.noise, self.estimator)
        observe(self.motion, increment, ego_motion, stats)
        self.tracker.noise.learn(ego_motion)
        self.witnesses.observe(increment, ego_motion)
        self.tracker.parts.record(increment, stats.closed)
        if self.places is not None:
            self.places.remember(increment, ego_motion.wTc, stats)
        return stats, noise

    @timed("watch")  # not the estimator's time
    def _look_for_other_motion(
        self, index: int, features: StereoFeatures, matched: Matched, stats: UpdateStats
    ) -> None:
        """Whether the features that the map does not explain move rigidly, too."""
        if self.watch is None:
            return
        of_scene = matched.association, matched.ego_motion
        self.tracker.other_motion.look(index, features, *of_scene, stats.wTc)

    @timed("calibrate")
    def _calibrate(self, increment: Increment, stats: UpdateStats) -> None:
        found = self.witnesses.found[-1:]  # what passes is no evidence of the rig
        passes = any(f.number == increment.index and f.verdict == "odometry" for f in found)
        if self.calibration is not None:
            self.calibration.observe(increment, stats.wTc, passes)

    def _correction(self) -> RigCorrection | None:
        return None if self.calibration is None else self.calibration.found.applied

    # -- before and between the frames ---------------------------------------------------------

    def can_initialise(self, frame: FeatureFrame, least: int) -> bool:
        """Whether a map could begin with the frame: it has ``least`` stereo matches, or more.

        Not with images that the watch refuses: what they match is chance, or of two moments.
        """
        if frame.whole is None:
            return False
        if self.watch is not None:
            before = snapshot(self.watch)
            refused = self._check_cameras(frame, frame.i).refused
            put_back(self.watch, before)  # the frame comes again
            if refused:
                return False
        first = self._find_features(dataclasses.replace(frame, i=0), None, [])
        self._tried = first, self._match_stereo(first)
        return len(self._tried[1].whole) >= least

    def estimate(self) -> Estimate:
        """The estimator's, with frames bridged that nothing measured between located ones.

        Landmarks that have ended are not among it.
        """
        found = self.estimator.estimate()
        if len(self._ended):
            found = dataclasses.replace(found, landmarks=found.landmarks.without(self._ended))
        found = self.witnesses.spread(found)
        if self.calibration is not None:
            more = self.calibration.open_covariances(len(found.covariances))
            found = dataclasses.replace(found, covariances=found.covariances + more)
        return bridged(found, self.tracker.parts)


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """One frame matched: its pose, what its landmarks are, and which places it recognised."""

    ego_motion: EgoMotion
    association: Association
    odometry: Odometry | None
    loops: tuple[LoopClosure, ...] = ()
    relocalised: bool = False
    problem: str = ""  # of images that are not used


@dataclass(frozen=True, slots=True, eq=False)
class FrameReport:
    """What one frame gave, for outputs and pictures; ``stereo`` is what all images show."""

    found: FeatureFrame
    stereo: StereoFeatures
    increment: Increment
    tracking: EgoMotion
    stats: UpdateStats
    stage_ms: dict[str, float]
    noise: FrameNoise


Snapshot: TypeAlias = list[tuple[Any, Any]]
"""Parts, and their states before a frame, for the rollback where its features cannot be found."""


def observe(
    motion: MotionModel, increment: Increment, tracking: EgoMotion, stats: UpdateStats
) -> None:
    """Hands the pose to the motion model; a jump by loop or against the odometry is no motion.

    Nor is what the estimator corrects the pose by, after it was tracked on the map as it was: the
    pose before moves alike.
    """
    time, wTc = increment.timestamp, tracking.wTc
    regained = increment.relocalised and not _known(increment.odometry)
    if any(stats.closed) or (increment.relocalised and not regained):
        motion.displaced(time, stats.wTc, increment.relocalised)
        return
    founding = stats.landmarks > 0 and stats.landmarks == int(increment.observations.is_new.sum())
    tied = _known(increment.odometry) or tracking.status.measured  # to odometry or the map
    measured = regained or tied or founding
    if regained:
        motion.regained(time, wTc)
    else:
        motion.observe(time, Prediction(wTc, tracking.covariance), measured)
    if measured and (stats.wTc != wTc).any():
        motion.displaced(time, stats.wTc, carried=False)


def _known(odometry: Odometry | None) -> bool:
    return odometry is not None and odometry.measured


# ------------------------------------------------------------------------------------------
# The noise that each frame was estimated with, where the drive itself shows how large it is


class FrameNoise(NamedTuple):
    """Noise in use in one frame; NaN where the frame had no noise of the kind.

    Attributes:
        rotation_sigma_dps2, translation_sigma_mps2: deviation of the random acceleration by which
            the velocity is taken to change, root mean square of the three axes; of frames that no
            odometry measured, the translation also where a gyroscope measured the rotation.
        gyroscope_factor: on the stated deviation of a gyroscope's turn.
        match_factor: on the stated deviations of measurements, where the frame's pose was found.
        single_factor: on the same, as an estimator's graph judges single measurements by.
        correlated_factor: on the same, as the graph weighs measurements by: errors that persist
            from frame to frame count for more than independent ones.
    """

    rotation_sigma_dps2: float = math.nan
    translation_sigma_mps2: float = math.nan
    gyroscope_factor: float = math.nan
    match_factor: float = math.nan
    single_factor: float = math.nan
    correlated_factor: float = math.nan


def noise_in_use(
    motion: MotionModel, odometry: Odometry | None, matches: MatchNoise, estimator: Estimator
) -> FrameNoise:
    """The noise of a frame that the estimator has taken in, and that nothing has learnt from yet.

    Args:
        motion: the model that gave ``odometry``; one that is not of this package has no noise here.
        odometry: what the frame was predicted with.
        matches: what the ego-motion takes the noise of matches to be.
        estimator: after its update.
    """
    turned = odometry is not None and odometry.turned
    rotation, translation = math.nan, math.nan
    guessed = odometry is not None and not odometry.measured
    if guessed and isinstance(motion, ConstantVelocityMotion | OdometryMotion):
        rotation, translation = np.sqrt(motion.acceleration_variance.reshape(2, 3).mean(axis=1))
    single, correlated = getattr(estimator, "noise_factors", (math.nan, math.nan))
    return FrameNoise(
        rotation_sigma_dps2=math.nan if turned else math.degrees(rotation),
        translation_sigma_mps2=float(translation),
        gyroscope_factor=(
            motion.gyroscope_factor if turned and isinstance(motion, OdometryMotion) else math.nan
        ),
        match_factor=math.sqrt(matches.variance),
        single_factor=single,
        correlated_factor=correlated,
    )
