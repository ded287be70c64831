"""Builds the parts of a session by their settings, from what a user names or hands over.

An estimator is imported when its kind is made: a filter needs no solver of graphs.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeGuard, cast, get_args

import numpy as np
from pydantic import TypeAdapter, ValidationError

from fgslam.backend.protocol import Estimator, MapUser
from fgslam.backend.settings import ESTIMATORS, EstimatorSettings, FloorMode
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.correction import term_names
from fgslam.core.errors import ConfigError, MapError
from fgslam.core.log import ImageSequence
from fgslam.core.saved_map import SavedMap, require_rig
from fgslam.core.sensors import CameraRig, MeasurementType
from fgslam.core.types import (
    CUT_PIXELS,
    DegreesOfFreedom,
    Estimate,
    Floor,
    LandmarkAppearances,
    LandmarkMap,
    Prediction,
    Relocalisation,
)
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
from fgslam.slam.feature_stream import FeatureExtractor, FeatureFrame, FeatureStream, FrameDescriber
from fgslam.slam.motion import MOTION_MEMBERS, ConstantVelocityMotion, MotionModel, OdometryMotion
from fgslam.slam.pipeline import SlamPipeline
from fgslam.slam.results import RunRecorder
from fgslam.slam.settings import MapSettings

if TYPE_CHECKING:
    from fgslam.backend.self_calibration import SelfCalibration
    from fgslam.frontend.places.recognition import PlaceRecognition
    from fgslam.frontend.places.relocalisation import Relocaliser
    from fgslam.slam.rig_memory import RigMemory


def make_pipeline(
    rig: CameraRig,
    frontend: FrontendSettings,
    odometry: OdometrySettings | MotionModel,
    estimator_settings: EstimatorSettings | Estimator,
    seed: int = 0,
    memory: RigMemory | None = None,
    arrival: Arrival | None = None,
) -> SlamPipeline:
    """All parts of a session for one rig.

    Args:
        rig: the rectified cameras.
        frontend: settings of all that measures.
        odometry: settings of what predicts the motion; or what predicts it.
        estimator_settings: which estimator to make; or one already made, at its prior pose.
        seed: of place recognition's samples.
        memory: what earlier drives have shown of the rig.
        arrival: where the run begins in a saved map; None begins with an empty one.
    """
    rig = as_measured(rig, frontend)
    prior = None if arrival is None else arrival.prior
    estimator = made_or_given(rig, estimator_settings, frontend.ego_motion, prior)
    measured_odometry = not isinstance(odometry, ConstantVelocitySettings)
    require_support(estimator, measured_odometry, loops=frontend.loops)
    tracker, of_depth = make_tracker(rig, frontend), has_depth_camera(frontend)
    if arrival is not None:
        take_over(estimator, arrival)
        tracker.database.load(arrival.saved)
        tracker.keeps_map = not arrival.extends
    stereo = make_stereo(rig, frontend)
    carrier = None if frontend.tracking == "sift" else LandmarkCarrier(rig, stereo.matcher)
    return SlamPipeline(
        stereo=stereo,
        tracker=tracker,
        motion=make_motion(rig, odometry),
        estimator=estimator,
        places=make_places(
            rig, frontend, tracker, seed, MeasurementType.LOOP in estimator.supports
        ),
        calibration=make_calibration(rig, frontend, memory),
        key_frames=None if carrier is None else KeyFrameTracker(tracker, carrier),
        stated=np.zeros(len(term_names(rig))) if of_depth else None,
        watch=CameraWatch(rig) if frontend.watch_cameras and not of_depth else None,
        located=prior if arrival is not None and arrival.relocalised else None,
    )


_SOFT_HEIGHT_M, _SOFT_TILT_DEG = 0.005, 0.2  # deviations a frame of a soft floor
_LOCATING_STREAM = 12  # of random numbers, next to those of the recording


def as_measured(rig: CameraRig, settings: FrontendSettings) -> CameraRig:
    """The rig as the front-end measures with it: which images tell a place, what corrects it."""
    by_patches = settings.stereo.by_patches(rig.cameras)
    return dataclasses.replace(
        rig.plain(),
        places="reference" if by_patches else "all",
        stated=not (calibrates_itself(settings) or has_depth_camera(settings)),
    )


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


def make_estimator(
    rig: CameraRig,
    settings: EstimatorSettings,
    ego_motion: EgoMotionSettings | None = None,
    prior: Prediction | None = None,
) -> Estimator:
    """The estimator, at the prior pose; without one the world is the first camera frame, exactly.

    ``ego_motion`` are the front-end's settings: ``floor: auto`` takes their degrees of freedom
    over, ``landmark_kalman_graph`` their whole cost.
    """
    prior = prior or Prediction(np.eye(4), np.zeros((6, 6)))
    make, ego_motion = _MAKERS[settings.kind](), ego_motion or EgoMotionSettings()
    if settings.kind == "odometry":
        return cast("Estimator", make(rig, prior))
    mode: FloorMode | None = getattr(settings, "floor", None)
    if mode is None:
        return cast("Estimator", make(rig, settings, prior, ego_motion))
    floor = make_floor(rig, mode, ego_motion.dof)
    more = (ego_motion,) if settings.kind == "batch" else ()
    return cast("Estimator", make(rig, settings, floor, prior, *more))


# By kind what makes an estimator; its module is loaded when it is wanted.
_MAKERS: Mapping[str, Callable[[], Any]] = {
    "odometry": lambda: import_module("fgslam.backend.filters.dead_reckoning").DeadReckoning,
    "landmark_kalman": lambda: import_module("fgslam.backend.filters.kalman").LandmarkKalman,
    "landmark_kalman_graph": lambda: (
        import_module("fgslam.backend.filters.kalman_graph").LandmarkKalmanGraph
    ),
    "ekf": lambda: import_module("fgslam.backend.filters.ekf").FullEkf,
    "invariant_ekf": lambda: import_module("fgslam.backend.filters.invariant_ekf").InvariantEkf,
    "fast_slam": lambda: import_module("fgslam.backend.filters.fast_slam").FastSlam,
    "fixed_lag": lambda: import_module("fgslam.backend.smoothers.lag").fixed_lag_smoother,
    "isam2": lambda: import_module("fgslam.backend.smoothers.isam2").isam2_smoother,
    "sliding_window": lambda: import_module("fgslam.backend.smoothers.lag").sliding_window_smoother,
    "batch": lambda: import_module("fgslam.backend.smoothers.batch").batch_smoother,
}


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


def make_stereo(rig: CameraRig, settings: FrontendSettings) -> RigStereo:
    """What measures a frame's features in all images of the rig."""
    matcher = StereoMatcher(as_measured(rig, settings), settings.stereo, settings.appearance)
    patches = PatchStereo(rig, matcher, settings.stereo.largest_disparity_px)
    return RigStereo(matcher, patches, settings.stereo.by_patches(rig.cameras))


def make_motion(rig: CameraRig, settings: OdometrySettings | MotionModel) -> MotionModel:
    """Motion model by the settings; one that is given is taken as it is."""
    if isinstance(settings, ConstantVelocitySettings):
        return ConstantVelocityMotion()
    if not isinstance(settings, RecordedOdometrySettings | SyntheticOdometrySettings):
        return settings
    return OdometryMotion(rig.bTc, settings.kind, ConstantVelocityMotion())


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
    from fgslam.frontend.places.recognition import LoopGates, LostRules, PlaceRecognition

    return PlaceRecognition(
        tracker,
        make_relocaliser(rig, settings),
        settings.appearance,
        seed,
        loops=LoopGates() if settings.loops else None,
        lost=LostRules() if settings.lost else None,
        joins=joins,
    )


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


def make_calibration(
    rig: CameraRig, settings: FrontendSettings, memory: RigMemory | None = None
) -> SelfCalibration | None:
    """Calibration of the rig from the drive; None where the calibration is to be taken as it is."""
    if not calibrates_itself(settings):
        return None
    from fgslam.backend.self_calibration import SelfCalibration

    known = None if memory is None else memory.known
    return SelfCalibration(rig, settings.stereo.pixel_sigma, known)


def calibrates_itself(settings: FrontendSettings) -> bool:
    """Whether the rig is to be calibrated from the drive.

    The paper's measurement is not the least squares over all images that a correction changes.
    """
    fused = settings.stereo.measurement == "fused"
    return settings.self_calibration and fused and not has_depth_camera(settings)


def has_depth_camera(settings: FrontendSettings) -> bool:
    """Whether the left camera is made up from depth: one that cannot have moved, or be late."""
    return settings.stereo.disparity_sigma_px is not None


def make_stream(
    sequence: ImageSequence, settings: FrontendSettings, ahead: bool = True
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


# ------------------------------------------------------------------------------------------
# Reads what a user names or hands over: an estimator, settings of the front-end, odometry

_ESSENTIAL = ("kind", "supports", "predict", "landmarks", "update", "estimate")
"""What the loop needs of an estimator; the protocol's other members serve resuming and tests."""
_ODOMETRIES = get_args(get_args(OdometrySettings)[0])


def is_settings(value: object) -> TypeGuard[EstimatorSettings]:
    """True if the value is the settings of an estimator of this package."""
    return isinstance(value, tuple(ESTIMATORS.values()))


def chosen_estimator(
    estimator: str | EstimatorSettings | Estimator,
) -> EstimatorSettings | Estimator:
    """Settings of the estimator that is named, or what was given.

    Raises:
        ConfigError: there is no such kind, or the object lacks members of an estimator.
    """
    kinds = ", ".join(ESTIMATORS)
    if isinstance(estimator, str):
        if estimator not in ESTIMATORS:
            close = difflib.get_close_matches(estimator, ESTIMATORS, n=1, cutoff=0.4)
            hint = f"did you mean {close[0]}? " if close else ""
            raise ConfigError(f"estimator: no kind {estimator!r}; {hint}known: {kinds}")
        return cast("EstimatorSettings", ESTIMATORS[estimator]())
    if is_settings(estimator):
        return estimator
    give = f"give a kind ({kinds}), its settings, or an object with the members of fgslam.Estimator"
    _require_members("estimator", estimator, _ESSENTIAL, give)
    supports = getattr(estimator, "supports", None)
    if not isinstance(supports, set | frozenset) or not all(
        isinstance(one, MeasurementType) for one in supports
    ):
        raise ConfigError(
            f"estimator: supports of {type(estimator).__name__} is {supports!r}; give a frozenset "
            "of fgslam.core.sensors.MeasurementType"
        )
    return cast("Estimator", estimator)


def chosen_frontend(given: FrontendSettings | Mapping[str, Any] | None) -> FrontendSettings:
    """Settings of the front-end as given; None: the defaults; a mapping: what differs from these.

    Raises:
        ConfigError: a key of the mapping is not known, or its value is not usable.
    """
    if isinstance(given, FrontendSettings):
        return given
    adapter: TypeAdapter[FrontendSettings] = TypeAdapter(FrontendSettings)
    try:
        return adapter.validate_python(dict(given or {}))
    except (ValidationError, TypeError, ValueError) as error:
        what = "not a mapping"
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            what = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise ConfigError(
            f"frontend: {what}; give settings by group, e.g. "
            '{"stereo": {"max_disparity_px": 80}}, as in the settings reference'
        ) from None


def chosen_odometry(
    given: OdometrySettings | MotionModel | None,
) -> OdometrySettings | MotionModel:
    """Settings of the odometry, or a motion model, as given; None: the default settings.

    Raises:
        ConfigError: it is neither.
    """
    if given is None:
        return RecordedOdometrySettings()
    if not isinstance(given, _ODOMETRIES):
        give = (
            "give settings, e.g. fgslam.datasets.settings.ConstantVelocitySettings(), or an object "
            "with the members of fgslam.MotionModel"
        )
        _require_members("odometry", given, MOTION_MEMBERS, give)
    return given


def _require_members(what: str, given: object, members: Sequence[str], give: str) -> None:
    """Raises ConfigError for a class, and for an object that lacks members."""
    if isinstance(given, type):
        raise ConfigError(
            f"{what}: {given.__name__} is a class; give an object of it, made for this rig"
        )
    lacking = ", ".join(name for name in members if not hasattr(given, name))
    if lacking:
        raise ConfigError(f"{what}: {type(given).__name__} lacks {lacking}; {give}")


# ------------------------------------------------------------------------------------------
# Saved maps of sessions: where one begins, what its estimator takes over, and what is saved


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """The first pose of a run in a map.

    Attributes:
        saved: the map; its world is the run's.
        prior: pose expected of the first frame, and how well it is known before its landmarks
            are seen.
        relocalised: it was found by these landmarks, and adds nothing to them.
        extends: the run adds to the map and corrects it; else it leaves it as it is.
    """

    saved: SavedMap
    prior: Prediction
    relocalised: bool
    extends: bool


@dataclass(frozen=True, slots=True, eq=False)
class MapStart:
    """A saved map in which a session begins, and how it finds its first pose there.

    Attributes:
        saved: the map; its world is the session's.
        settings: ``start`` (`relocalise`, `origin` or `last`), ``extend`` and ``begin`` count.
        name: of the map, for messages.
    """

    saved: SavedMap
    settings: MapSettings
    name: str = "the map"

    def require_usable(self, rig: CameraRig) -> None:
        """Refuses a map of other cameras, and an empty one. Raises MapError."""
        require_rig(self.saved, rig, self.name)
        if not len(self.saved):
            raise MapError(f"{self.name}: holds no landmark; make the map again")

    def known(self) -> Arrival | None:
        """Where the map itself states the first pose; None where a frame is to be located in it.

        Raises:
            MapError: it is to be the map's last pose, and the map has no trajectory.
        """
        if self.settings.start == "relocalise":
            return None
        if self.settings.start != "last":
            return self.at(np.eye(4), relocalised=False)
        if not len(self.saved.trajectory):
            raise MapError(f"{self.name}: knows no last pose; use map.start relocalise")
        return self.at(self.saved.trajectory.poses[-1], relocalised=False)

    def at(self, wTc: FloatArray, relocalised: bool) -> Arrival:
        """A first pose that is known roughly: what is known better its landmarks will tell."""
        begin = self.settings.begin
        sigma = np.repeat([np.deg2rad(begin.sigma_deg), begin.sigma_m], 3)
        prior = Prediction(wTc, np.diag(sigma**2))
        return Arrival(self.saved, prior, relocalised, self.settings.extend)


def trusted(saved: SavedMap, valid_hits: int) -> tuple[LandmarkMap, LandmarkAppearances]:
    """Landmarks seen often enough to be there (Se et al. 6.1), with their appearances."""
    sure = saved.permanent | (saved.hits >= valid_hits)
    landmarks = saved.landmarks.select(sure)
    return landmarks, saved.appearances.of(landmarks.ids)


def take_over(estimator: Estimator, arrival: Arrival) -> None:
    """Gives a new estimator the map's landmarks.

    Raises:
        ConfigError: it cannot begin in a saved map, or cannot leave one as it is.
        EstimatorError: the map is too large for it.
    """
    user = require_map_user(estimator, arrival.extends)
    user.begin_in(arrival.saved.landmarks, arrival.saved.hits, fixed=not arrival.extends)


def require_map_user(estimator: Estimator, extends: bool) -> MapUser:
    """The estimator, if it can begin in a saved map, and leave it as it is unless it ``extends``.

    Raises:
        ConfigError: it cannot.
    """
    if not isinstance(estimator, MapUser):
        raise ConfigError(
            f"estimator.kind {estimator.kind} cannot begin in a saved map; use landmark_kalman, "
            "ekf, isam2, sliding_window or batch"
        )
    if not extends and not estimator.keeps_maps:
        raise ConfigError(
            f"estimator.kind {estimator.kind} cannot leave a map as it is; use landmark_kalman or "
            "ekf, or map.extend true"
        )
    return estimator


def saved_map(
    pipeline: SlamPipeline,
    rig: CameraRig,
    estimate: Estimate,
    about: dict[str, Any],
    evidence: IntArray,
) -> SavedMap:
    """The estimator's geometry joined with the database's appearances and counts.

    Args:
        pipeline: the parts as they are now.
        rig: the cameras that saw the map.
        estimate: the estimator's.
        about: where the map comes from; plain JSON values.
        evidence: the frames that are in it (:func:`evidence_of`).
    """
    database, places = pipeline.tracker.database, pipeline.places
    landmarks = estimate.landmarks
    if places is not None:  # no later frame of this run ends them
        landmarks = landmarks.without(places.ending)
    rows, patches = database.rows(landmarks.ids), database.patches(landmarks.ids)
    return SavedMap(
        rig=rig.plain(),
        landmarks=landmarks,
        appearances=database.appearances(landmarks.ids),
        hits=database.hits[rows],
        misses=database.misses[rows],
        farthest=database.farthest[rows],
        permanent=database.lasting[rows],
        colour=database.colour[rows],
        patches=patches if patches.kept else None,
        trajectory=estimate.trajectory,
        about=about,
        evidence=evidence,
    )


def evidence_of(pipeline: SlamPipeline, recorder: RunRecorder, before: SavedMap | None) -> IntArray:
    """Frames (f,) whose measurements are in a session's map, ascending.

    Those of the map that it began in count, too; a map that is only localised in takes in nothing.
    """
    own = recorder.seen[:0] if pipeline.tracker.keeps_map else recorder.seen
    return own if before is None else np.union1d(before.evidence, own)
