"""Builds the parts of a session from what a user names; the only place that distinguishes kinds.

An estimator is imported when its kind is made: a filter needs no solver of graphs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import numpy as np

from fgslam.backend.protocol import Estimator, FullEstimator
from fgslam.backend.settings import (
    BatchSettings,
    DeadReckoningSettings,
    EkfSettings,
    EstimatorSettings,
    FixedLagSettings,
    FloorMode,
    Isam2Settings,
    LandmarkKalmanGraphSettings,
    LandmarkKalmanSettings,
    SlidingWindowSettings,
)
from fgslam.core.errors import ConfigError
from fgslam.core.estimates import Prediction, Relocalisation
from fgslam.core.features import CUT_PIXELS
from fgslam.core.floor import DegreesOfFreedom, Floor
from fgslam.core.measurements import MeasurementType
from fgslam.core.recordings import Sequence
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig
from fgslam.datasets.settings import (
    ConstantVelocitySettings,
    OdometrySettings,
    RecordedOdometrySettings,
    SyntheticOdometrySettings,
)
from fgslam.frontend.camera_faults import CameraWatch
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.settings import EgoMotionSettings, FrontendSettings
from fgslam.frontend.stereo import PatchStereo, RigStereo, StereoMatcher
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.frontend.tracking.key_frames import KeyFrameTracker, LandmarkCarrier
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.frontend.tracking.map_matching import MapMatcher
from fgslam.frontend.tracking.tracker import LandmarkTracker
from fgslam.slam.arrival import Arrival, take_over, trusted
from fgslam.slam.choices import is_settings
from fgslam.slam.feature_stream import (
    FeatureExtractor,
    FeatureFrame,
    FeatureStream,
    FrameDescriber,
)
from fgslam.slam.motion import (
    ConstantVelocityMotion,
    MotionModel,
    OdometryMotion,
)
from fgslam.slam.pipeline import SlamPipeline

if TYPE_CHECKING:
    from fgslam.backend.self_calibration import SelfCalibration
    from fgslam.frontend.places.recognition import PlaceRecognition
    from fgslam.frontend.places.relocalisation import Relocaliser

_SOFT_HEIGHT_M, _SOFT_TILT_DEG = 0.005, 0.2  # deviations a frame of a soft floor
_LOCATING_STREAM = 12  # of random numbers, next to those of the recording


def as_measured(rig: CameraRig, settings: FrontendSettings) -> CameraRig:
    """The rig as the front-end measures with it: which images tell a place."""
    by_patches = settings.stereo.by_patches(rig.cameras)
    return dataclasses.replace(rig, places="reference" if by_patches else "all")


def make_stream(
    sequence: Sequence, settings: FrontendSettings, ahead: bool = True
) -> FeatureStream:
    """Features of the sequence's frames, found ahead of the loop; its images alone if not so."""
    extract = make_extractor(settings) if ahead else None
    return FeatureStream(sequence, extract, settings.stereo.by_patches(sequence.rig.cameras))


def make_describer(
    rig: CameraRig, settings: FrontendSettings, extract: FeatureExtractor | None = None
) -> FrameDescriber:
    """What finds the features of single frames, by an own extractor or SIFT."""
    by_patches = settings.stereo.by_patches(rig.cameras)
    return FrameDescriber(extract or make_extractor(settings), by_patches)


def make_extractor(settings: FrontendSettings) -> FeatureExtractor:
    """Feature extractor by the settings: SIFT."""
    return SiftExtractor(settings.sift, settings.appearance.mode).extract


def make_stereo_matcher(rig: CameraRig, settings: FrontendSettings) -> StereoMatcher:
    """Stereo matcher of the rig, for features of all images."""
    return StereoMatcher(as_measured(rig, settings), settings.stereo, settings.appearance)


def make_stereo(rig: CameraRig, settings: FrontendSettings) -> RigStereo:
    """What measures a frame's features in all images of the rig."""
    matcher = make_stereo_matcher(rig, settings)
    patches = PatchStereo(rig, matcher, settings.stereo.largest_disparity_px)
    return RigStereo(matcher, patches, settings.stereo.by_patches(rig.cameras))


def make_tracker(rig: CameraRig, settings: FrontendSettings) -> LandmarkTracker:
    """The landmark database with its matchers and the ego-motion."""
    pixels = 0 if settings.tracking == "sift" else CUT_PIXELS
    largest = settings.stereo.largest_disparity_px
    database = LandmarkDatabase(rig, settings.database, largest, pixels)
    solver = EgoMotionSolver(rig, settings.ego_motion)
    matcher = MapMatcher(settings.matching, settings.appearance)
    tracker = LandmarkTracker(rig, database, matcher, solver)
    tracker.expects_returns = settings.loops
    return tracker


def make_key_frames(
    rig: CameraRig, settings: FrontendSettings, tracker: LandmarkTracker
) -> KeyFrameTracker | None:
    """Tracking between key frames; None where every frame is one."""
    if settings.tracking == "sift":
        return None
    return KeyFrameTracker(tracker, LandmarkCarrier(rig, make_stereo_matcher(rig, settings)))


def make_motion(rig: CameraRig, settings: OdometrySettings | MotionModel) -> MotionModel:
    """Motion model by the settings; one that is given is taken as it is."""
    if isinstance(settings, ConstantVelocitySettings):
        return ConstantVelocityMotion(settings)
    if not isinstance(settings, RecordedOdometrySettings | SyntheticOdometrySettings):
        return settings
    gap = settings.gap if isinstance(settings, RecordedOdometrySettings) else None
    stand_in = ConstantVelocityMotion(gap or ConstantVelocitySettings())
    return OdometryMotion(rig.bTc, settings.kind, stand_in)


def make_estimator(
    rig: CameraRig,
    settings: EstimatorSettings,
    ego_motion: EgoMotionSettings | None = None,
    prior: Prediction | None = None,
) -> FullEstimator:
    """The estimator, at the prior pose; without one the world is the first camera frame, exactly.

    ``ego_motion`` are the front-end's settings: ``floor: auto`` takes their degrees of freedom
    over, ``landmark_kalman_graph`` their whole cost.
    """
    prior = prior or Prediction(np.eye(4), np.zeros((6, 6)))
    ego_motion = ego_motion or EgoMotionSettings()
    estimator: FullEstimator
    match settings:
        case DeadReckoningSettings():
            from fgslam.backend.filters.dead_reckoning import DeadReckoning

            estimator = DeadReckoning(rig, prior)
        case LandmarkKalmanSettings():
            from fgslam.backend.filters.kalman import LandmarkKalman

            estimator = LandmarkKalman(rig, settings, prior, ego_motion)
        case LandmarkKalmanGraphSettings():
            from fgslam.backend.filters.kalman_graph import LandmarkKalmanGraph

            estimator = LandmarkKalmanGraph(rig, settings, prior, ego_motion)
        case EkfSettings():
            from fgslam.backend.filters.ekf import FullEkf

            estimator = FullEkf(
                rig, settings, make_floor(rig, settings.floor, ego_motion.dof), prior
            )
        case FixedLagSettings():
            from fgslam.backend.smoothers.fixed_lag import fixed_lag_smoother

            floor = make_floor(rig, settings.floor, ego_motion.dof)
            estimator = fixed_lag_smoother(rig, settings, floor, prior)
        case Isam2Settings():
            from fgslam.backend.smoothers.isam2 import isam2_smoother

            floor = make_floor(rig, settings.floor, ego_motion.dof)
            estimator = isam2_smoother(rig, settings, floor, prior)
        case SlidingWindowSettings():
            from fgslam.backend.smoothers.sliding_window import sliding_window_smoother

            floor = make_floor(rig, settings.floor, ego_motion.dof)
            estimator = sliding_window_smoother(rig, settings, floor, prior)
        case BatchSettings():
            from fgslam.backend.smoothers.batch import batch_smoother

            floor = make_floor(rig, settings.floor, ego_motion.dof)
            estimator = batch_smoother(rig, settings, floor, prior)
    return estimator


def made_or_given(
    rig: CameraRig,
    estimator: EstimatorSettings | Estimator,
    ego_motion: EgoMotionSettings | None = None,
    prior: Prediction | None = None,
) -> Estimator:
    """As :func:`make_estimator`; an estimator that is made already is handed back."""
    if is_settings(estimator):
        return make_estimator(rig, estimator, ego_motion, prior)
    return cast("Estimator", estimator)


def make_floor(rig: CameraRig, mode: FloorMode, dof: DegreesOfFreedom) -> Floor:
    """The floor as an estimator is to use it."""
    if mode == "auto":
        return Floor.under(rig, dof)
    if mode == "none":
        return Floor.under(rig, 6)
    return dataclasses.replace(
        Floor.under(rig, 3 if dof == 6 else dof),
        hard=mode == "hard",
        height_sigma_m=_SOFT_HEIGHT_M,
        tilt_sigma_rad=float(np.deg2rad(_SOFT_TILT_DEG)),
    )


def make_pipeline(
    rig: CameraRig,
    frontend: FrontendSettings,
    odometry: OdometrySettings | MotionModel,
    estimator_settings: EstimatorSettings | Estimator,
    seed: int = 0,
    arrival: Arrival | None = None,
) -> SlamPipeline:
    """All parts of a session for one rig.

    Args:
        rig: the rectified cameras.
        frontend: settings of all that measures.
        odometry: settings of what predicts the motion; or what predicts it.
        estimator_settings: which estimator to make; or one already made, at its prior pose.
        seed: of place recognition's samples.
        arrival: where the run begins in a saved map; None begins with an empty one.
    """
    rig = as_measured(rig, frontend)
    prior = None if arrival is None else arrival.prior
    estimator = made_or_given(rig, estimator_settings, frontend.ego_motion, prior)
    measured_odometry = not isinstance(odometry, ConstantVelocitySettings)
    require_support(estimator, measured_odometry, loops=frontend.loops)
    tracker = make_tracker(rig, frontend)
    if arrival is not None:
        take_over(estimator, arrival)
        tracker.database.load(arrival.saved)
        tracker.keeps_map = not arrival.extends
    return SlamPipeline(
        stereo=make_stereo(rig, frontend),
        tracker=tracker,
        motion=make_motion(rig, odometry),
        estimator=estimator,
        places=make_places(
            rig, frontend, tracker, seed, MeasurementType.LOOP in estimator.supports
        ),
        calibration=make_calibration(rig, frontend),
        key_frames=make_key_frames(rig, frontend, tracker),
        watch=CameraWatch(rig) if frontend.watch_cameras else None,
        located=prior if arrival is not None and arrival.relocalised else None,
    )


def calibrates_itself(settings: FrontendSettings) -> bool:
    """Whether the rig is to be calibrated from the drive.

    The paper's measurement is not the least squares over all images that a correction changes.
    """
    return settings.self_calibration and settings.stereo.measurement == "fused"


def make_calibration(rig: CameraRig, settings: FrontendSettings) -> SelfCalibration | None:
    """Calibration of the rig from the drive; None where the calibration is to be taken as it is."""
    if not calibrates_itself(settings):
        return None
    from fgslam.backend.self_calibration import SelfCalibration

    return SelfCalibration(rig, settings.stereo.pixel_sigma)


def make_places(
    rig: CameraRig,
    settings: FrontendSettings,
    tracker: LandmarkTracker,
    seed: int,
    joins: bool = False,
) -> PlaceRecognition | None:
    """Place recognition: loop closures and relocalisation; None where neither is wanted.

    Where the estimator takes closures it joins parts of the map (``joins``).
    """
    if not (settings.loops or settings.lost or joins):
        return None
    from fgslam.frontend.places.recognition import (
        LoopGates,
        LostRules,
        PlaceRecognition,
        RecognitionParts,
    )

    parts = RecognitionParts(
        joins=joins,
        loops=LoopGates() if settings.loops else None,
        lost=LostRules() if settings.lost else None,
        appearance=settings.appearance,
        relocaliser=make_relocaliser(rig, settings),
        seed=seed,
    )
    return PlaceRecognition(parts, tracker)


def make_relocaliser(rig: CameraRig, settings: FrontendSettings) -> Relocaliser:
    """Relocaliser without a prior, for the poses that the ego-motion allows."""
    from fgslam.frontend.places.relocalisation import Relocaliser

    floor = Floor.under(rig, settings.ego_motion.dof)
    return Relocaliser(rig, floor, settings.relocalisation)


def make_locator(
    rig: CameraRig, settings: FrontendSettings, saved: SavedMap, seed: int
) -> Callable[[FeatureFrame], Relocalisation]:
    """Locates the frames of a recording in a saved map, each alone and without a prior."""
    relocaliser = make_relocaliser(rig, settings)
    relocaliser.learn(*trusted(saved, settings.database.valid_hits))
    stereo = make_stereo(rig, settings)

    def locate(found: FeatureFrame) -> Relocalisation:
        rng = np.random.default_rng([seed, _LOCATING_STREAM, found.i])
        return relocaliser.locate(stereo.match(found.frame, found.features).whole, rng)

    return locate


def require_support(estimator: Estimator, measured_odometry: bool, loops: bool = False) -> None:
    """Refuses, before a run starts, an estimator that cannot use what the run will measure."""
    needed = {MeasurementType.STEREO}
    if measured_odometry:
        needed.add(MeasurementType.ODOMETRY)
    if loops:
        needed.add(MeasurementType.LOOP)
    lacking = sorted(kind.value for kind in needed - estimator.supports)
    if lacking:
        raise ConfigError(
            f"estimator.kind {estimator.kind} cannot use {' and '.join(lacking)} measurements; "
            "choose another estimator; one of your own names in `supports` all that it is handed, "
            "used or not"
        )
