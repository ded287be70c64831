"""The SLAM loop (Se et al. 4): predict, match, ego-motion, update, database maintenance."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from fgslam.backend.protocol import Estimator, Resumable, predicted, recalibrated, updated
from fgslam.core.arrays import IntArray, StateArrays
from fgslam.core.estimates import (
    EgoMotion,
    EgoMotionStatus,
    Estimate,
    LandmarkMap,
    Prediction,
    UpdateStats,
)
from fgslam.core.features import StereoFeatures
from fgslam.core.measurements import Increment, LoopClosure, Odometry
from fgslam.core.rig_correction import RigCorrection
from fgslam.frontend.camera_watch import CameraWatch
from fgslam.frontend.rig_stereo import RigStereo
from fgslam.frontend.tracking.ego_motion import unmeasured
from fgslam.frontend.tracking.key_frames import CarriedFrame, KeyFrameTracker, spread
from fgslam.frontend.tracking.tracker import Association, LandmarkTracker
from fgslam.slam.bridging import bridged
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import MotionModel
from fgslam.slam.noise_in_use import FrameNoise, noise_in_use

if TYPE_CHECKING:
    from fgslam.backend.filters.self_calibration import SelfCalibration
    from fgslam.frontend.places.recognition import PlaceRecognition


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


class Stopwatch:
    """Milliseconds by stage, within one frame."""

    def __init__(self) -> None:
        """Starts now."""
        self.ms: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Adds the time since the last lap to ``stage``."""
        now = time.perf_counter()
        self.ms[stage] = self.ms.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now


_Before: TypeAlias = "list[tuple[Resumable, StateArrays]]"
"""Parts, and what they were like before a frame."""


def _nobody() -> IntArray:
    return np.empty(0, np.int64)


@dataclass(slots=True, eq=False)
class SlamPipeline:
    """The parts of the system and the loop over them.

    Attributes:
        places: None where none are recognised.
        calibration: of the rig, from the drive; None where the calibration is taken as stated.
        key_frames: tracking between key frames; None where every frame is one.
        watch: says which frames' images cannot be used; None uses all.
        describe: finds the features of a frame that came without: of all images, or of the
            reference image where patches tell the rest (`frontend.stereo.others`).
        describe_reference: of the first frame, and of one that carried landmarks have placed,
            those of its reference image alone.
        located: pose of the first frame, found in a saved map without a prior; None where it was
            not.
        rewound: the last frame's features could not be found, and it left no trace; but what a
            closure before it ended has ended.
    """

    stereo: RigStereo
    tracker: LandmarkTracker
    motion: MotionModel
    estimator: Estimator
    places: PlaceRecognition | None = None
    calibration: SelfCalibration | None = None
    key_frames: KeyFrameTracker | None = None
    watch: CameraWatch | None = None
    located: Prediction | None = None
    describe: Callable[[FeatureFrame], FeatureFrame] | None = None
    describe_reference: Callable[[FeatureFrame], FeatureFrame] | None = None
    rewound: bool = False
    _ended: IntArray = field(default_factory=_nobody, init=False)
    _tried: tuple[FeatureFrame, StereoFeatures] | None = field(default=None, init=False)

    def process(
        self, found: FeatureFrame, index: int, timestamp: float, body: Odometry | None = None
    ) -> FrameReport:
        """Processes one frame: Sections 2 to 4 of the paper in order, then loops (its section 7).

        Args:
            found: the frame with its features.
            index: its number in the recording, for the log.
            timestamp: seconds.
            body: the robot's motion since the last frame; None where none was measured.
        """
        watch = Stopwatch()
        before = self._before(found)
        found = self._watched(found, index)
        watch.lap("watch")
        correction = self._correction()
        recalibrated(self.estimator, None if correction is None else correction.values)
        odometry = self.motion.between(timestamp, body)
        prediction = predicted(self.estimator, odometry)
        watch.lap("predict")
        landmarks = self._fused()
        carried = self._carried(prediction, found, landmarks)
        watch.lap("track")
        if self.key_frames is not None and carried is not None and self._goes_on(carried):
            stereo, described = carried.carried.features, None
            seen = _Seen(carried.tracked.ego_motion, self.key_frames.book(carried))
        else:
            found = self._described(found, carried, before)
            watch.lap("sift")
            every = self._match_stereo(found)
            watch.lap("stereo")
            guessed = odometry is not None and not odometry.measured
            every, seen = self._track(prediction, found, every, landmarks, carried, guessed)
            stereo = described = every.whole
            watch.lap("track")
            seen = self._recognise(seen, stereo, landmarks)
        watch.lap("places")
        seen, self._ended = seen.without(self._ended), _nobody()
        increment = self._increment(index, timestamp, odometry, seen)
        stats = updated(self.estimator, increment, seen.tracking)
        noise = noise_in_use(self.motion, odometry, self.tracker.noise, self.estimator)
        observe(self.motion, increment, seen.tracking, stats)
        self.tracker.noise.learn(seen.tracking)
        self._remember(increment, seen, stats)
        watch.lap("update")
        if described is not None and self.watch is not None:
            self._look_for_other_motion(index, described, seen, stats)
        watch.lap("watch")  # not the estimator's time
        if self.calibration is not None:
            self.calibration.observe(increment, stats.wTc)
        watch.lap("calibrate")
        return FrameReport(found, stereo, increment, seen.tracking, stats, watch.ms, noise)

    def founds(self, found: FeatureFrame, least: int) -> bool:
        """Whether a map could begin with the frame: it has ``least`` stereo matches, or more.

        Not with images that the watch refuses: what they match is chance, or of two moments.
        """
        if found.frame is None or self._refused(found):
            return False
        first = self._described(dataclasses.replace(found, i=0), None, [])
        self._tried = first, self._match_stereo(first)
        return len(self._tried[1].whole) >= least

    def estimate(self) -> Estimate:
        """The estimator's, with frames bridged that nothing measured between located ones.

        Landmarks that have ended are not among it.
        """
        found = self.estimator.estimate()
        if len(self._ended):
            found = dataclasses.replace(found, landmarks=found.landmarks.without(self._ended))
        return bridged(found, self.tracker.parts)

    def state(self) -> StateArrays:
        """What the loop itself keeps between frames."""
        tracker = self.tracker
        return {"ended": self._ended} | tracker.noise.state() | tracker.other_motion.state()

    def restore(self, state: StateArrays) -> None:
        """Continues from :meth:`state`; the parts have states of their own."""
        self._ended = state["ended"]
        self.tracker.noise.restore(state)
        self.tracker.other_motion.restore(state)

    def _before(self, found: FeatureFrame) -> _Before:
        """What a frame changes until its features are found, where it came without."""
        self.rewound = False
        if self.describe is None or found.frame is None or found.features:
            return []
        parts = self.watch, self.motion, self.key_frames
        return [(part, part.state()) for part in parts if isinstance(part, Resumable)]

    def _watched(self, found: FeatureFrame, index: int) -> FeatureFrame:
        """The frame, without its images where these are not of one moment and this one."""
        if self.watch is None or found.frame is None:
            return found
        fault = self.watch.look(found.frame.images, index)
        if not fault:
            return found
        return dataclasses.replace(found, frame=None, features=(), problem=fault, refused=True)

    def _refused(self, found: FeatureFrame) -> bool:
        """Whether the watch refuses the frame, which it does not take in here."""
        if self.watch is None:
            return False
        before = self.watch.state()
        refused = self._watched(found, found.i).refused
        self.watch.restore(before)
        return refused

    def _carried(
        self, prediction: Prediction, found: FeatureFrame, landmarks: LandmarkMap
    ) -> CarriedFrame | None:
        """The frame by the landmarks carried into it; None where there are none."""
        if self.key_frames is None or found.frame is None:
            return None
        return self.key_frames.carry(prediction, landmarks, found.frame.images, self._correction())

    def _goes_on(self, carried: CarriedFrame) -> bool:
        """Whether the frame needs no features: enough is carried, and no place is looked for."""
        return carried.suffices and (self.places is None or not self.places.wants_features)

    def _described(
        self, found: FeatureFrame, carried: CarriedFrame | None, before: _Before
    ) -> FeatureFrame:
        """The frame with features; of its reference image where carried landmarks place it.

        Whatever an extractor of the user's raises, the loop is then as it was before the frame.
        """
        first = self.key_frames is not None and found.i == 0
        patches = first or (carried is not None and carried.placed)
        find = self.describe_reference if patches else self.describe
        if find is None:
            return found
        try:
            return find(found)
        except BaseException:
            for part, state in before:
                part.restore(state)
            self.rewound = True
            raise

    def _match_stereo(self, found: FeatureFrame) -> StereoFeatures:
        if found.frame is None:
            return StereoFeatures.empty()
        tried, self._tried = self._tried, None
        if tried and tried[0].frame is found.frame and tried[0].features is found.features:
            return tried[1]
        return self.stereo.match(found.frame, found.features, self._correction())

    def _correction(self) -> RigCorrection | None:
        return None if self.calibration is None else self.calibration.found.applied

    def _increment(
        self, index: int, timestamp: float, odometry: Odometry | None, seen: _Seen
    ) -> Increment:
        association, calibration = seen.association, self.calibration
        return Increment(
            index=index,
            timestamp=timestamp,
            odometry=odometry,
            observations=association.observations,
            rejected=association.rejected,
            missed_ids=association.missed_ids,
            pruned_ids=association.pruned_ids,
            loops=seen.loops,
            relocalised=seen.relocalised,
            rig_correction=None if calibration is None else calibration.found.applied.values,
            settled_rig=None if calibration is None else calibration.settled,
        )

    def _fused(self) -> LandmarkMap:
        """The map to track on, without the landmarks that a loop closed in the last frame ends.

        The estimator drops these with this frame's measurements, as the log records it.
        """
        landmarks = self.estimator.landmarks()
        if self.places is not None:
            self._ended = np.union1d(self._ended, self.places.fuse(landmarks))
        return landmarks.without(self._ended) if len(self._ended) else landmarks

    def _track(
        self,
        prediction: Prediction,
        found: FeatureFrame,
        stereo: StereoFeatures,
        landmarks: LandmarkMap,
        carried: CarriedFrame | None,
        guessed: bool,
    ) -> tuple[StereoFeatures, _Seen]:
        """A key frame by all its features, those carried among them."""
        if found.frame is None:
            status = EgoMotionStatus.CAMERA_FAULT if found.refused else EgoMotionStatus.NO_IMAGE
            blind = self.tracker.track_blind(prediction, status)
            return stereo, _Seen(blind, Association.nothing())
        if self.key_frames is None:
            tracked = self.tracker.track(prediction, landmarks, stereo)
        else:
            tracked, stereo = self.key_frames.beside(carried, prediction, landmarks, stereo)
        located, maps_on = False, True
        if found.i == 0 and self.located is not None:
            anew = self.tracker.track_anew(self.located, landmarks, stereo)
            located = anew.ego_motion.status.measured
            tracked = anew if located else tracked
        elif self.places is not None and found.i > 0:
            tracked = self.places.placed_by_recent(tracked, prediction, landmarks, stereo)
            tracked, located = self.places.recover(tracked, landmarks, stereo.whole, guessed)
            maps_on = self.places.maps_on
        relocalised = located or tracked.ego_motion.status is EgoMotionStatus.RELOCALISED
        if self.key_frames is not None:
            tracked = spread(tracked, stereo)
        image = found.frame.images[0]
        association = self.tracker.associate(tracked, stereo, image, maps_on)
        if self.key_frames is not None:
            self.key_frames.begin(image, stereo, association)
        if found.i == 0 and not len(landmarks):
            return stereo, _Seen(unmeasured(prediction, EgoMotionStatus.FIRST), association)
        return stereo, _Seen(tracked.ego_motion, association, relocalised=relocalised)

    def _recognise(self, seen: _Seen, stereo: StereoFeatures, landmarks: LandmarkMap) -> _Seen:
        """The frame with the loops that it may close."""
        if self.places is None:
            return seen
        loops = self.places.look(seen.tracking.wTc, landmarks, stereo, seen.association)
        return dataclasses.replace(seen, loops=loops)

    def _look_for_other_motion(
        self, index: int, stereo: StereoFeatures, seen: _Seen, stats: UpdateStats
    ) -> None:
        """Whether the features that the map does not explain move rigidly, too."""
        association = seen.association
        known = association.partners(len(stereo)), association.known
        self.tracker.other_motion.look(index, stereo, known, seen.tracking, stats.wTc)

    def _remember(self, increment: Increment, seen: _Seen, stats: UpdateStats) -> None:
        self.tracker.parts.book(increment, stats.closed)
        if self.places is not None:
            self.places.remember(increment, seen.tracking.wTc, stats)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One frame matched: its pose, what its landmarks are, and which places it recognised."""

    tracking: EgoMotion
    association: Association
    loops: tuple[LoopClosure, ...] = ()
    relocalised: bool = False

    def without(self, ended: IntArray) -> _Seen:
        """Landmarks that ended before the frame go with it."""
        if not len(ended):
            return self
        pruned = np.union1d(self.association.pruned_ids, ended)
        return dataclasses.replace(
            self, association=dataclasses.replace(self.association, pruned_ids=pruned)
        )


def observe(
    motion: MotionModel, increment: Increment, tracking: EgoMotion, stats: UpdateStats
) -> None:
    """Hands the pose to the motion model; a jump by loop or against the odometry is no motion."""
    if increment.relocalised and not any(stats.closed) and not _known(increment.odometry):
        motion.regained(increment.timestamp, stats.wTc)
    elif any(stats.closed) or increment.relocalised:
        motion.displaced(increment.timestamp, stats.wTc, increment.relocalised)
    else:
        pose = Prediction(stats.wTc, tracking.covariance)
        motion.observe(increment.timestamp, pose, _anchored(increment, tracking, stats))


def _anchored(increment: Increment, tracking: EgoMotion, stats: UpdateStats) -> bool:
    """True if odometry or the map determined the pose, or the frame starts the map."""
    founding = stats.landmarks > 0 and stats.landmarks == int(increment.observations.is_new.sum())
    return _known(increment.odometry) or tracking.status.measured or founding


def _known(odometry: Odometry | None) -> bool:
    return odometry is not None and odometry.measured
