"""How a frame's tracking grows with the map: 1,000, 10,000 and 100,000 landmarks.

A building of like rooms, 1,000 landmarks each on its walls; the robot looks around in the one in
its middle, so that what it sees is the same whatever the map holds. Prediction of what is in view,
matching, pose, bookkeeping and pruning are timed, by the processor; the maps take turns.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, field

import numpy as np

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig, Observations
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import (
    LandmarkAppearances,
    LandmarkMap,
    Prediction,
    StereoFeatures,
    Trajectory,
)
from fgslam.frontend.settings import (
    DatabaseSettings,
    FrontendSettings,
    PermanenceSettings,
)
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.frontend.tracking.tracker import LandmarkTracker
from fgslam.slam.build import make_tracker

SIZES = (1_000, 10_000, 100_000)
FRAMES = 30
LIMITS = {"map_frame_100k_ms": 20.0, "map_expected_100k_ms": 10.0}
PER_ROOM = 1_000
ROOM_M, HEIGHT_M = 10.0, 2.4
RIG = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, 0.1, g.BODY_FORWARD_LEFT_UP_FROM_CAMERA)
SIGMA_PX = 0.2
NEW_A_FRAME = 40
FRONTEND = FrontendSettings(
    database=DatabaseSettings(least_scale_px=0.8, permanence=PermanenceSettings(), viewpoints=True)
)
IMAGE = np.full((RIG.height, RIG.width), 128, np.uint8)
VAGUE = np.diag([0.002] * 3 + [0.01] * 3) ** 2


def building(landmarks: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Landmarks (n, 3) on the walls of a square of rooms, and the middle of each one's room.

    The first room is the one around the origin, the others follow by their distance.
    """
    rooms = landmarks // PER_ROOM
    reach = np.arange(-8, 9)
    cells = np.array([(x, z) for x in reach for z in reach])
    nearest = np.argsort((cells**2).sum(axis=1), kind="stable")[:rooms]
    middle = np.repeat(ROOM_M * cells[nearest].astype(np.float64), PER_ROOM, axis=0)
    along = rng.uniform(-0.5, 0.5, landmarks) * ROOM_M
    wall = rng.integers(4, size=landmarks)
    across = np.where(wall % 2, 0.5, -0.5) * ROOM_M
    x = np.where(wall < 2, along, across)
    z = np.where(wall < 2, across, along)
    height = rng.uniform(-0.5, 0.5, landmarks) * HEIGHT_M
    middles = np.column_stack([middle[:, 0], np.zeros(landmarks), middle[:, 1]])
    return middles + np.column_stack([x, height, z]), middles


def saved_map(landmarks: int) -> SavedMap:
    """The building as a map: each landmark seen from the middle of its room, at SIFT's scales."""
    rng = np.random.default_rng(landmarks)
    ids = np.arange(landmarks)
    positions, middles = building(landmarks, rng)
    directions = positions - middles
    scale = np.exp(rng.uniform(np.log(1.2), np.log(6.0), landmarks))
    return SavedMap(
        rig=RIG,
        landmarks=LandmarkMap(ids, positions, np.tile(1e-4 * np.eye(3), (landmarks, 1, 1))),
        appearances=LandmarkAppearances(
            ids,
            rng.integers(0, 120, (landmarks, 128)).astype(np.uint8),
            scale * np.linalg.norm(directions, axis=1),
            rng.uniform(0.0, 2.0 * np.pi, landmarks),
            directions / np.linalg.norm(directions, axis=1, keepdims=True),
        ),
        hits=np.full(landmarks, 8),
        misses=np.full(landmarks, 4),
        farthest=np.full(landmarks, np.inf),
        permanent=np.arange(landmarks) % 2 == 0,
        colour=np.zeros(landmarks, np.uint8),
        trajectory=Trajectory(np.zeros(1), np.eye(4)[None]),
        about={},
        evidence=np.empty(0, np.int64),
    )


@dataclass(eq=False)
class Walk:
    """The robot looking around in one map."""

    saved: SavedMap
    frame_s: list[float] = field(default_factory=list)
    expected_s: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        """The tracker begins in the map."""
        self.tracker: LandmarkTracker = make_tracker(RIG, FRONTEND)
        self.database.load(self.saved)
        self.map = self.saved.landmarks

    @property
    def database(self) -> LandmarkDatabase:
        """The tracker's."""
        return self.tracker.database

    def step(self, k: int) -> None:
        """One frame, timed."""
        wTc = g.se3_exp(np.array([0.0, 0.05 * k, 0.0, 0.0, 0.0, 0.0]))
        features = self._features(wTc, np.random.default_rng(k))
        start = time.process_time()
        self.database.expected(self.map, wTc)
        middle = time.process_time()
        tracked = self.tracker.track(Prediction(wTc, VAGUE), self.map, features)
        association = self.tracker.associate(tracked, features, IMAGE)
        self.frame_s.append(time.process_time() - middle)
        self.expected_s.append(middle - start)
        self._take(association.observations.select(association.observations.is_new), wTc)
        gone = np.isin(self.map.ids, association.pruned_ids)
        self.map = LandmarkMap(
            self.map.ids[~gone], self.map.positions[~gone], self.map.covariances[~gone]
        )
        if not tracked.ego_motion.status.measured:
            raise RuntimeError(f"frame {k}: {tracked.ego_motion.status.value}; nothing to time")

    def _features(self, wTc: FloatArray, rng: np.random.Generator) -> StereoFeatures:
        """Half of the room's landmarks in view, and as many unmapped features as a frame brings."""
        seen = self.database.expected(self.map, wTc)
        own = np.flatnonzero(seen.certain & (seen.rows < PER_ROOM) & (rng.random(len(seen)) < 0.5))
        unmapped = np.column_stack(
            [
                rng.uniform(20.0, 280.0, NEW_A_FRAME),
                rng.uniform(40.0, 230.0, NEW_A_FRAME),
                rng.uniform(6.0, 14.0, NEW_A_FRAME),
            ]
        )
        measured = seen.measurement[own] + SIGMA_PX * rng.standard_normal((len(own), 3))
        measured = np.concatenate([measured, unmapped])
        covariance = np.tile(SIGMA_PX**2 * np.eye(3), (len(measured), 1, 1))
        new = (NEW_A_FRAME, 128)
        return StereoFeatures(
            measurement=measured,
            measurement_covariance=covariance,
            scale=np.concatenate([seen.scale[own], rng.uniform(1.2, 6.0, NEW_A_FRAME)]),
            orientation=np.concatenate([seen.orientation[own], rng.uniform(0, 6, NEW_A_FRAME)]),
            descriptors=np.concatenate(
                [seen.descriptors[own], rng.integers(130, 255, new).astype(np.uint8)]
            ),
            position=RIG.triangulate(measured),
            position_covariance=RIG.triangulation_covariance(measured, covariance),
            pixels=np.full((len(measured), 3, 2), np.nan),
        )

    def _take(self, new: Observations, wTc: FloatArray) -> None:
        """New landmarks enter the map where they were measured."""
        points = g.transform_to_world(wTc, RIG.triangulate(new.measurement))
        self.map = LandmarkMap(
            np.concatenate([self.map.ids, new.ids]),
            np.concatenate([self.map.positions, points]),
            np.concatenate([self.map.covariances, np.tile(1e-4 * np.eye(3), (len(points), 1, 1))]),
        )


@one_blas_thread()
def ratios_of_maps() -> dict[str, float]:
    """Milliseconds of the processor a frame, by the size of the map, and how they grow."""
    walks = {size: Walk(saved_map(size)) for size in SIZES}
    for k in range(FRAMES):
        for walk in walks.values():
            walk.step(k)
    frame = {size: 1e3 * statistics.median(walk.frame_s[1:]) for size, walk in walks.items()}
    expected = {size: 1e3 * statistics.median(walk.expected_s[1:]) for size, walk in walks.items()}
    found = {f"map_frame_{size // 1000}k_ms": frame[size] for size in SIZES}
    found |= {f"map_expected_{size // 1000}k_ms": expected[size] for size in SIZES}
    return found | {"map_frame_100k_over_1k": frame[SIZES[-1]] / frame[SIZES[0]]}
