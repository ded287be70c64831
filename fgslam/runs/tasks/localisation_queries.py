"""Asks a map where the frames of a recording were taken: one by one, or in short submaps."""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Iterator
from collections.abc import Sequence as Items
from dataclasses import dataclass

import numpy as np

from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, MapError
from fgslam.core.estimates import LandmarkMap, Relocalisation
from fgslam.core.features import LandmarkAppearances, StereoFeatures
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    congruence,
    project,
    projection_jacobian,
    rotate_covariances,
    transform_to_camera,
)
from fgslam.core.recordings import Sequence
from fgslam.core.saved_map import require_rig
from fgslam.core.sensors import CameraRig
from fgslam.datasets.settings import OdometrySettings
from fgslam.frontend.places.relocalisation import Relocaliser
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.stereo import RigStereo
from fgslam.runs.config_models import LocalisationConfig
from fgslam.runs.engine import Context
from fgslam.runs.tasks.slam_map_entry import GivenMap
from fgslam.runs.tasks.truth import Sighted, TrueSights, TruthInMap, truth_in_map
from fgslam.slam.arrival import trusted
from fgslam.slam.factory import make_pipeline, make_relocaliser, make_stereo, make_stream
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import SlamPipeline

_STREAM = 13  # of random numbers, beside those of the recording
_STAGE = "queries"
SAVE_EVERY_S = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One query and its answer.

    Attributes:
        i: place of the query's last frame among the selected ones.
        frame: its number in the recording.
        frames: how many frames it had.
        features: that were looked up.
        found: the answer; of a frame that could not be read None.
        problem: why it could not; empty where it could.
        truth: (4, 4) true pose in the map's world; NaN where unknown.
        sighted: landmarks truly in view of it.
        milliseconds: for the answer, without features.
        frontend_ms: for the frame's features in all images, and for matching them.
    """

    i: int
    frame: int
    frames: int
    features: int
    found: Relocalisation | None
    problem: str
    truth: FloatArray
    sighted: Sighted
    milliseconds: float
    frontend_ms: float

    @property
    def accepted(self) -> bool:
        """Whether there is a pose to be believed."""
        return self.found is not None and self.found.found


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """All queries of a run.

    Attributes:
        attempts: by frames of a query, then in order.
        landmarks: that could be recognised.
        alignment: how truth and map were brought together, in words.
        whole: whether all that was wanted has been done.
    """

    attempts: tuple[Attempt, ...]
    landmarks: LandmarkMap
    alignment: str
    whole: bool

    def of(self, frames: int) -> tuple[Attempt, ...]:
        """The queries of so many frames."""
        return tuple(one for one in self.attempts if one.frames == frames)


def nothing_asked(why: str) -> Asked:
    """No query at all, and why."""
    none = LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
    return Asked((), none, why, whole=False)


_ANSWERS = tuple[Attempt, ...]


class Asker:
    """A map that has been learnt, and what it takes to ask it."""

    def __init__(self, config: LocalisationConfig, given: GivenMap, sequence: Sequence) -> None:
        """Learns the map.

        Raises:
            MapError: other cameras made it, or it holds no landmark.
        """
        require_rig(given.saved, sequence.rig, str(given.path))
        frontend = config.frontend
        self.landmarks, looks = trusted(given.saved, frontend.database.valid_hits)
        if not len(self.landmarks):
            raise MapError(f"{given.path}: holds no trusted landmark; make the map again")
        self._config, self._sequence = config, sequence
        self._stereo: RigStereo = make_stereo(sequence.rig, frontend)
        self._relocaliser: Relocaliser = make_relocaliser(sequence.rig, frontend)
        self._relocaliser.learn(self.landmarks, looks)
        self._floor = Floor.under(sequence.rig, frontend.ego_motion.dof)
        self.truth: TruthInMap = truth_in_map(given.saved, sequence, config.as_experiment())
        self._sights = TrueSights(given.saved, self.landmarks, sequence, frontend)

    def ask(self, found: list[FeatureFrame], sighted: Sighted) -> Attempt:
        """One query: consecutive frames, the last of which is to be located.

        Args:
            found: the frames with their features.
            sighted: landmarks truly in view of the last one.
        """
        last = found[-1]
        frame = self._frame_number(last.i)
        blank = Attempt(
            i=last.i,
            frame=frame,
            frames=len(found),
            features=0,
            found=None,
            problem=last.problem,
            truth=self.truth.poses[last.i],
            sighted=sighted,
            milliseconds=float("nan"),
            frontend_ms=last.sift_ms,
        )
        if last.frame is None:
            return blank
        rng = np.random.default_rng([self._config.seed, _STREAM, frame, len(found)])
        start = time.perf_counter()
        if len(found) == 1:
            features, spread = self._stereo.match(last.frame, last.features).whole, None
        else:
            features, spread = submap_features(
                self._sequence, found, self._config.frontend, self._config.odometry
            )
        matched = time.perf_counter()
        answer = self._relocaliser.locate(features, rng)
        done = time.perf_counter()
        if spread is not None and np.isfinite(answer.covariance).all():
            own = self._floor.allowed_part(answer.wTc, spread)
            answer = dataclasses.replace(answer, covariance=answer.covariance + own)
        return dataclasses.replace(
            blank,
            features=len(features),
            found=answer,
            milliseconds=1e3 * (done - matched),
            frontend_ms=last.sift_ms + 1e3 * (matched - start),
        )

    def sighted(self, i: int) -> Sighted:
        """Landmarks truly in view of the selected frame ``i``."""
        return self._sights.of(i, self.truth.poses[i])

    def _frame_number(self, i: int) -> int:
        dataset = self._config.dataset
        return dataset.start + i * dataset.stride


def ask_all(
    config: LocalisationConfig, given: GivenMap, sequence: Sequence, context: Context
) -> Asked:
    """All queries of a configuration; those of an earlier session are not asked again.

    Raises:
        MapError: the map cannot be used with these cameras, or is empty.
        ConfigError: the recording is shorter than a query.
    """
    wanted = config.localisation
    if len(sequence) < max(wanted.frames):
        raise ConfigError(
            f"{sequence.name}: {len(sequence)} frames are selected, and a query takes "
            f"{max(wanted.frames)}; lower the frames of a query, or select more"
        )
    asker = Asker(config, given, sequence)
    queries = len(range(max(wanted.frames) - 1, len(sequence), wanted.every))
    answered = _answered(asker, config, sequence, queries, context)
    attempts = [attempt for answers in answered.values() for attempt in answers]
    attempts.sort(key=lambda one: (wanted.frames.index(one.frames), one.i))
    whole = len(answered) == queries
    return Asked(tuple(attempts), asker.landmarks, asker.truth.alignment, whole)


def _answered(
    asker: Asker, config: LocalisationConfig, sequence: Sequence, queries: int, context: Context
) -> dict[int, tuple[Attempt, ...]]:
    """Answers by number of the query, in the order asked; kept in the run folder now and then."""
    kept: dict[int, tuple[Attempt, ...]] = context.store.load(_STAGE, _ANSWERS)
    # Killed while it tidied up, a run has lost the first answers, but not the last ones.
    first = next(k for k in range(queries + 1) if k not in kept)
    done, fresh = {k: kept[k] for k in range(first)}, dict[int, tuple[Attempt, ...]]()
    context.progress("localising", len(done), queries)
    saved = time.perf_counter()
    for k, found in _queries(config, sequence, first):
        sighted = asker.sighted(found[-1].i)
        frames = config.localisation.frames
        fresh[k] = tuple(asker.ask(found[len(found) - n :], sighted) for n in frames)
        context.progress("localising", len(done) + len(fresh), queries)
        stopped = context.stopped()
        if stopped or k == queries - 1 or time.perf_counter() - saved >= SAVE_EVERY_S:
            done |= context.store.add(_STAGE, fresh, _ANSWERS)
            fresh, saved = {}, time.perf_counter()
        if stopped:
            break
    return done


def _queries(
    config: LocalisationConfig, sequence: Sequence, first: int
) -> Iterator[tuple[int, list[FeatureFrame]]]:
    """Number and frames of each query from the ``first`` on, the longest submap's.

    Each frame's features are found once.
    """
    longest, every = max(config.localisation.frames), config.localisation.every
    held: deque[FeatureFrame] = deque(maxlen=longest)
    start = first * every
    if start + longest > len(sequence):
        return
    stream = make_stream(sequence, config.frontend)(start=start)
    try:
        for found in stream:
            held.append(found)
            k, rest = divmod(found.i - longest + 1, every)
            if found.i >= start + longest - 1 and not rest:
                yield k, list(held)
    finally:
        stream.close()


_NEAREST_M = 0.1  # of the last camera's plane: nearer ones have no size in its image


def submap_features(
    sequence: Sequence,
    found: Items[FeatureFrame],
    frontend: FrontendSettings,
    odometry: OdometrySettings,
) -> tuple[StereoFeatures, FloatArray]:
    """Landmarks of a few consecutive frames that the ordinary loop has tracked.

    Args:
        sequence: the recording.
        found: the frames' features, in order, at least one.
        frontend: the configuration's; neither loops are closed nor lost cameras found, and every
            frame's features are used: a sub-map is to show as much as it can.
        odometry: the configuration's; what was before the first of the frames is not used.

    Returns:
        The submap's landmarks in the last camera's frame, with fused covariances and their last
        looks; those outside its image, too. And the covariance (6, 6) of that camera in the
        submap, which whoever is located by the submap has beside the map's.
    """
    plain = dataclasses.replace(frontend, tracking="sift", loops=False, lost=False)
    pipeline = make_pipeline(sequence.rig, plain, odometry, LandmarkKalmanSettings())
    for k, one in enumerate(found):
        timestamp = float(sequence.timestamps[one.i])
        body = body_motion(sequence, one.i, pipeline.motion) if k else None
        stats = pipeline.process(dataclasses.replace(one, i=k), k, timestamp, body).stats
    return _as_features(pipeline, sequence.rig, stats.wTc), stats.covariance


def _as_features(pipeline: SlamPipeline, rig: CameraRig, wTc: FloatArray) -> StereoFeatures:
    """The landmarks as the camera at ``wTc`` would measure them, were its image large enough."""
    landmarks = pipeline.estimator.landmarks()
    looks = _last_looks(pipeline.tracker.database.appearances(landmarks.ids))
    points = transform_to_camera(wTc, landmarks.positions)
    covariances = rotate_covariances(wTc[:3, :3].T, landmarks.covariances)
    keep = np.abs(points[:, 2]) > _NEAREST_M
    points, covariances = points[keep], covariances[keep]
    looks = looks.of(landmarks.ids[keep])
    measurement, noise = _measured(rig, points, covariances)
    pixels = np.full((len(points), 3, 2), np.nan)
    pixels[:, 0] = measurement[:, :2]
    return StereoFeatures(
        measurement=measurement,
        measurement_covariance=noise,
        scale=looks.size / np.abs(points[:, 2]),
        orientation=looks.orientation,
        descriptors=looks.descriptors,
        position=points,
        position_covariance=covariances,
        pixels=pixels,
    )


def _last_looks(appearances: LandmarkAppearances) -> LandmarkAppearances:
    """The view of each landmark that was seen last."""
    last = np.flatnonzero(np.diff(appearances.ids, append=-1))
    return LandmarkAppearances(
        appearances.ids[last],
        appearances.descriptors[last],
        appearances.size[last],
        appearances.orientation[last],
        appearances.direction[last],
    )


def _measured(
    rig: CameraRig, points: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Image measurements (n, 3) of points and their covariances; NaN of those behind the camera."""
    before = points[:, 2] > 0.0
    measurement = np.full((len(points), 3), np.nan)
    noise = np.full((len(points), 3, 3), np.nan)
    measurement[before] = project(rig, points[before])
    noise[before] = congruence(projection_jacobian(rig, points[before]), covariances[before])
    return measurement, noise
