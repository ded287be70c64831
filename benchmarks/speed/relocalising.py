"""How long a look for oneself takes, beside the front-end's frame, in maps of up to 100,000.

A short drive through the rendered lab makes a map of real landmarks with real descriptors. Copies
of it around it are a building: each copy's descriptors have their 16 cells permuted, so that
the rooms have textures of their own whose statistics are SIFT's. The drive's frames are sought in
the building by a robot that is lost there: all that place recognition then does in a frame, which
is to choose the landmarks, to learn them, to locate the frame among them and to track it there. A
look for a return does the same with fewer landmarks. Both times are the processor's; each look is
made three times, the maps taking turns, and its median counts, so that other load of the machine
does not make the slowest frame.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, field

import cv2
import numpy as np

from benchmarks.runs import EXPERIMENTS
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import pose
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import (
    LandmarkAppearances,
    LandmarkMap,
    Prediction,
    StereoFeatures,
    Trajectory,
)
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.places.recognition import LostRules, PlaceRecognition
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.tracking.tracker import LandmarkTracker
from fgslam.runs.config import load_config
from fgslam.runs.opening import open_sequence
from fgslam.slam.build import make_pipeline, make_relocaliser, make_stereo, make_tracker
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion

SIZES = (1_000, 3_000, 10_000, 30_000, 100_000)
FRAMES, EVERY = 120, 8
ROUNDS = 3
LIMITS = {
    "look_100k_over_frontend": 2.0,
    "look_100k_worst_over_frontend": 2.0,
    "look_10k_over_1k": 1.5,
    "look_100k_over_10k": 1.5,
}
_RIGHT_M = 0.2
_APART_M = 12.0
_CELLS, _BINS = 16, 8
_FAR_AWAY = Prediction(pose(np.eye(3), np.array([0.0, 0.0, 1e4])), 1e-4 * np.eye(6))


@dataclass(frozen=True)
class Driven:
    """A map, features of some frames with their true poses, and the front-end's times."""

    landmarks: LandmarkMap
    looks: LandmarkAppearances
    queries: list[StereoFeatures]
    poses: FloatArray
    frontend_s: list[float]


@dataclass
class Lost:
    """A robot that does not know where it is in a map of one size."""

    landmarks: LandmarkMap
    tracker: LandmarkTracker
    places: PlaceRecognition
    rounds: list[list[float]] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)
    false: int = 0

    @property
    def seconds(self) -> list[float]:
        """Of each frame."""
        return [statistics.median(frame) for frame in zip(*self.rounds, strict=True)]

    @staticmethod
    def among(known: SavedMap, settings: FrontendSettings) -> Lost:
        """In a saved map; every frame that is not located by tracking is sought at once."""
        tracker = make_tracker(known.rig, settings)
        tracker.database.load(known)
        relocaliser = make_relocaliser(known.rig, settings)
        lost = LostRules(after=1)
        places = PlaceRecognition(tracker, relocaliser, settings.appearance, 0, lost=lost)
        return Lost(known.landmarks, tracker, places)

    def look(self, features: StereoFeatures, wTc: FloatArray) -> None:
        """One frame, timed; tracked from far away, it is not located before."""
        tracked = self.tracker.track(_FAR_AWAY, self.landmarks, features)
        start = time.process_time()
        tracked, found = self.places.recover(tracked, self.landmarks, features)
        self.rounds[-1].append(time.process_time() - start)
        off = np.linalg.norm(tracked.ego_motion.wTc[:3, 3] - wTc[:3, 3])
        self.right.append(bool(found and off < _RIGHT_M))
        self.false += int(found and off >= _RIGHT_M)


def drive() -> Driven:
    """Features one image after the other, stereo, tracking: all of it timed together."""
    config = load_config(EXPERIMENTS / "lab_loop.yaml", [f"dataset.stop={FRAMES}"])
    sequence, frontend = open_sequence(config), config.frontend
    extractor = SiftExtractor(frontend.sift, frontend.appearance.mode)
    stereo = make_stereo(sequence.rig, frontend)
    pipeline = make_pipeline(sequence.rig, frontend, config.odometry, config.estimator)
    queries, frontend_s = [], []
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        start = time.process_time()
        found = tuple(extractor.extract(image) for image in frame.images)
        pipeline.process(
            FeatureFrame(i, frame, found, "", 0.0, 0.0),
            i,
            float(sequence.timestamps[i]),
            body_motion(sequence, i, pipeline.motion),
        )
        frontend_s.append(time.process_time() - start)
        if i % EVERY == 0:
            queries.append(stereo.match(frame, found).whole)
    landmarks, database = pipeline.estimator.landmarks(), pipeline.tracker.database
    assert sequence.ground_truth is not None
    return Driven(
        landmarks,
        database.appearances(landmarks.ids),
        queries,
        sequence.ground_truth.poses[::EVERY],
        frontend_s,
    )


def building(driven: Driven, size: int) -> tuple[LandmarkMap, LandmarkAppearances]:
    """The drive's map amid copies of it, the nearest ones first, cut to ``size`` landmarks.

    A map smaller than the drive's keeps the landmarks that came first.
    """
    one, looks = driven.landmarks, driven.looks
    copies = -(-size // len(one))
    step = int(one.ids[-1]) + 1
    side = int(np.ceil(np.sqrt(copies)))
    reach = np.arange(side) - side // 2
    places = np.array([(x, 0, z) for x in reach for z in reach])
    places = _APART_M * places[np.argsort((places**2).sum(axis=1), kind="stable")]
    ids, positions, views = [], [], []
    for k in range(copies):
        rng = np.random.default_rng(k)
        order = rng.permutation(_CELLS) if k else np.arange(_CELLS)
        cells = looks.descriptors.reshape(-1, _CELLS, _BINS)[:, order].reshape(-1, 128)
        ids.append(one.ids + k * step)
        positions.append(one.positions + places[k])
        views.append((looks.ids + k * step, cells))
    whole = LandmarkMap(
        np.concatenate(ids)[:size],
        np.concatenate(positions)[:size],
        np.tile(one.covariances, (copies, 1, 1))[:size],
    )
    every = LandmarkAppearances(
        np.concatenate([own for own, _ in views]),
        np.concatenate([cells for _, cells in views]),
        np.tile(looks.size, copies),
        np.tile(looks.orientation, copies),
        np.tile(looks.direction, (copies, 1)),
    )
    return whole, every.of(whole.ids)


def saved(known: tuple[LandmarkMap, LandmarkAppearances], rig: CameraRig) -> SavedMap:
    """The building as a map of landmarks that were all seen often."""
    landmarks, looks = known
    n = len(landmarks)
    return SavedMap(
        rig=rig,
        landmarks=landmarks,
        appearances=looks,
        hits=np.full(n, 8),
        misses=np.zeros(n, np.int64),
        farthest=np.full(n, np.inf),
        permanent=np.zeros(n, np.bool_),
        colour=np.zeros(n, np.uint8),
        trajectory=Trajectory(np.zeros(1), np.eye(4)[None]),
        about={},
        evidence=np.empty(0, np.int64),
    )


def seek(robots: dict[int, Lost], driven: Driven) -> None:
    """One round of looks: every frame in every map."""
    for robot in robots.values():
        robot.rounds.append([])
    for features, wTc in zip(driven.queries, driven.poses, strict=True):
        for robot in robots.values():
            robot.look(features, wTc)


@one_blas_thread()
def ratios_of_relocalising() -> dict[str, float]:
    """Milliseconds of the processor by the size of the map, and over the front-end's median."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        driven = drive()
        config = load_config(EXPERIMENTS / "lab_loop.yaml")
        rig = open_sequence(config).rig
        robots = {
            size: Lost.among(saved(building(driven, size), rig), config.frontend) for size in SIZES
        }
        for k in range(1 + ROUNDS):
            seek(robots, driven)
            if k == 0:  # in the first one libraries and memory were fetched
                for robot in robots.values():
                    robot.rounds.clear()
                    robot.right.clear()
                    robot.false = 0
    finally:
        cv2.setNumThreads(threads)
    frontend = statistics.median(driven.frontend_s)
    out = {"frontend_ms": 1e3 * frontend}
    for size, robot in robots.items():
        name = f"look_{size // 1000}k"
        out[f"{name}_ms"] = 1e3 * statistics.median(robot.seconds)
        out[f"{name}_over_frontend"] = statistics.median(robot.seconds) / frontend
        out[f"{name}_worst_over_frontend"] = max(robot.seconds) / frontend
        out[f"{name}_right"] = float(np.mean(robot.right))
        out[f"{name}_false"] = float(robot.false)
    return out | _growth(robots)


def _growth(robots: dict[int, Lost]) -> dict[str, float]:
    """Time in a map over that in one of a tenth of it, of the frames that both locate."""
    out = {}
    for size, robot in robots.items():
        tenth = robots.get(size // 10)
        if tenth is None:
            continue
        count = len(robot.seconds)
        both = np.flatnonzero(np.array(robot.right[:count]) & np.array(tenth.right[:count]))
        slow, fast = (np.median(np.array(r.seconds)[both]) for r in (robot, tenth))
        out[f"look_{size // 1000}k_over_{size // 10_000}k"] = float(slow / fast)
    return out
