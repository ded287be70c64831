"""A world of landmarks without images, and a front-end that sees them: behaviour is tested on it.

Matching, tracking and their faults are simulated; homing vector, local map and estimators are the
program's own.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

import numpy as np

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.backend.settings import HomingEkfSettings, HomingEstimatorSettings
from fgslam.core.arrays import ByteArray, FloatArray, IntArray
from fgslam.core.bearings import (
    BearingMatches,
    ColumnSegments,
    HomingStart,
    OmniFeatures,
    Refusal,
    RefusalReason,
    TrackedBearings,
    UprightFeatures,
)
from fgslam.core.geometry import bearings, compose, wrap
from fgslam.frontend.settings import HomingVectorSettings
from fgslam.homing.active import Sighting
from fgslam.homing.closed_loop import DriveRecord, follow
from fgslam.homing.controller import HomingChain
from fgslam.homing.front_end import ImageFrontEnd
from fgslam.homing.settings import HomingBehaviourSettings
from fgslam.homing.steering import CorridorAvoidance, Steering
from fgslam.runs.tasks.homing_replay import start_from_matches

DARK = np.zeros((1, 1, 3), dtype=np.uint8)


@dataclass
class LandmarkWorld:
    """Points around a way; a robot that slips.

    Attributes:
        points: (n, 3) metres.
        true_pose: (3,).
        slip: deviation of speed and turning rate, as part of them.
        discs: (m, 3) round obstacles: x, y, radius.
    """

    points: FloatArray
    true_pose: FloatArray
    rng: np.random.Generator
    slip: float = 0.05
    discs: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    def image(self, time: float) -> ByteArray:
        """Nothing: the simulated front-end looks at the world itself."""
        return DARK

    def scan(self) -> tuple[FloatArray, FloatArray]:
        """A hundred and eighty beams of 5 m."""
        angles = np.deg2rad(np.arange(-180.0, 180.0, 2.0))
        return angles, ray_ranges(self.true_pose, angles, self.discs, 5.0)

    def drive(self, speed: float, turn_rate: float, dt: float) -> None:
        """Exact arcs, disturbed."""
        speed *= 1.0 + self.slip * self.rng.standard_normal()
        turn_rate *= 1.0 + self.slip * self.rng.standard_normal()
        for _ in range(4):
            middle = turn_rate * dt / 8.0
            step = speed * dt / 4.0 * np.array([np.cos(middle), np.sin(middle)])
            self.true_pose = compose(self.true_pose, np.array([*step, turn_rate * dt / 4.0]))


def ray_ranges(
    pose: FloatArray, angles: FloatArray, discs: FloatArray, farthest: float
) -> FloatArray:
    """(n,) distances along beams to the first disc, ``farthest`` where there is none."""
    ranges = np.full(len(angles), farthest)
    way = np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])])
    for x, y, radius in discs:
        offset = np.array([x - pose[0], y - pose[1]])
        along = offset @ way
        across = offset[0] * way[1] - offset[1] * way[0]
        hit = (along > 0.0) & (np.abs(across) < radius)
        near = along - np.sqrt(np.maximum(radius**2 - across**2, 0.0))
        ranges = np.where(hit, np.minimum(ranges, near), ranges)
    return ranges


@dataclass
class SimulatedFrontEnd:
    """Sees landmarks within reach; matches some wrongly; loses tracks.

    Attributes:
        sigma: of all angles, radians.
        wrong: part of the matches that are wrong.
        lost: part of the tracks that are lost with every image.
        dark: tells at which times nothing is seen.
        turned: angle by which the image is turned, by time.
    """

    world: LandmarkWorld
    rng: np.random.Generator
    sigma: float = np.deg2rad(0.5)
    reach: float = 6.0
    wrong: float = 0.1
    lost: float = 0.01
    dark: Callable[[float], bool] = lambda _: False
    turned: Callable[[float], float] = lambda _: 0.0
    settings: HomingVectorSettings = field(default_factory=HomingVectorSettings)
    _points: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    _ids: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    begun: int = 0
    look_rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(5))

    def describe(self, image: ByteArray) -> OmniFeatures:
        """Of the robot's true pose."""
        return self.features_at(self.world.true_pose)

    def features_at(self, pose: FloatArray) -> OmniFeatures:
        """As if the image had been taken there."""
        return landmark_features(self.world.points, pose, self.reach, self.sigma, self.rng)

    def begin(self, image: ByteArray, target: OmniFeatures, time: float) -> HomingStart | Refusal:
        """Matches by identity, some wrongly."""
        self.begun += 1
        if self.dark(time):
            return Refusal(RefusalReason.TOO_DARK, "nothing to see")
        matches, points = match_landmarks(self.describe(image), target, self.wrong, self.rng)
        begun = start_from_matches(time, matches, self.settings, self.rng)
        if isinstance(begun, Refusal):
            return begun
        start, rows = begun
        self._points, self._ids = points[rows], start.local_map.ids
        return start

    def look(self, image: ByteArray, target: OmniFeatures) -> Sighting | Refusal:
        """Matches in the same way, by a chance of its own."""
        pose, rng = self.world.true_pose, self.look_rng
        seen = landmark_features(self.world.points, pose, self.reach, self.sigma, rng)
        matches, _ = match_landmarks(seen, target, self.wrong, rng)
        begun = start_from_matches(0.0, matches, self.settings, rng)
        if isinstance(begun, Refusal):
            return begun
        start, _ = begun
        return Sighting(start.vector, start.matches)

    def track(self, image: ByteArray, time: float) -> TrackedBearings:
        """True bearings with noise; what is beyond reach is lost."""
        pose, points = self.world.true_pose, self.world.points[self._points]
        distance = np.hypot(*(points[:, :2] - pose[:2]).T)
        kept = (self.rng.random(len(points)) >= self.lost) & (distance < self.reach)
        if self.dark(time):
            kept[:] = False
        self._points, self._ids = self._points[kept], self._ids[kept]
        seen = bearings(pose, points[kept, :2]) + self.turned(time)
        n = len(seen)
        noisy = wrap(seen + self.sigma * self.rng.standard_normal(n))
        nan = np.full(n, np.nan)
        return TrackedBearings(time, self._ids, noisy, np.full(n, self.sigma), nan, nan)


def landmark_features(
    points: FloatArray, pose: FloatArray, reach: float, sigma: float, rng: np.random.Generator
) -> OmniFeatures:
    """SIFT features whose descriptors hold the landmarks' numbers; no columns."""
    distance = np.hypot(*(points[:, :2] - pose[:2]).T)
    number = np.flatnonzero(distance < reach)
    n = len(number)
    bearing = bearings(pose, points[number, :2]) + sigma * rng.standard_normal(n)
    elevation = np.arctan2(points[number, 2], distance[number]) + sigma * rng.standard_normal(n)
    descriptors = np.zeros((n, 128), dtype=np.uint8)
    descriptors[:, :4] = (number[:, None] >> (8 * np.arange(4))) & 255
    # Words for retrieval: what looks alike differs from landmark to landmark, not from view to view
    descriptors[:, 4:] = appearance(number)
    sift = UprightFeatures(
        pixels=np.full((n, 2), np.nan),
        bearing=wrap(bearing),
        elevation=elevation,
        covariance=np.tile(np.eye(2) * sigma**2, (n, 1, 1)),
        scale=np.full(n, 0.02),
        descriptors=descriptors,
        colour=np.ones((n, 3)),
    )
    return OmniFeatures(sift, no_columns())


def appearance(number: IntArray) -> ByteArray:
    """(n, 124) what descriptors of landmarks look like, the same for every view."""
    rows = [np.random.default_rng(int(k)).integers(0, 120, 124) for k in number]
    return np.array(rows, dtype=np.uint8).reshape(-1, 124)


def no_columns() -> ColumnSegments:
    """None."""
    return ColumnSegments(
        np.empty(0), np.empty(0), np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 11))
    )


def numbers(features: OmniFeatures) -> IntArray:
    """(n,) numbers of the landmarks."""
    digits = features.sift.descriptors[:, :4].astype(np.int64)
    return np.asarray(digits @ (256 ** np.arange(4)))


def match_landmarks(
    a: OmniFeatures, b: OmniFeatures, wrong: float, rng: np.random.Generator
) -> tuple[BearingMatches, IntArray]:
    """Common landmarks; ``wrong`` of them are given another one's end in ``b``."""
    points, row_a, row_b = np.intersect1d(numbers(a), numbers(b), return_indices=True)
    n = len(points)
    swapped = rng.permutation(n)[: int(wrong * n)]
    row_b[swapped] = row_b[np.roll(swapped, 1)]
    sigma = np.sqrt(
        np.column_stack(
            [
                a.sift.covariance[row_a][:, [0, 1], [0, 1]],
                b.sift.covariance[row_b][:, [0, 1], [0, 1]],
            ]
        )
    )
    matches = BearingMatches(
        np.zeros(n, dtype=np.int64), row_a, row_b, a.sift.bearing[row_a], a.sift.elevation[row_a],
        b.sift.bearing[row_b], b.sift.elevation[row_b], sigma, np.ones(n),
    )  # fmt: skip
    return matches, points


def points_along(way: FloatArray, per_metre: float, rng: np.random.Generator) -> FloatArray:
    """(n, 3) landmarks 1 to 4 m beside a way of planar positions (k, 2), none nearer to it."""
    steps = np.diff(way, axis=0)
    lengths = np.hypot(*steps.T)
    count = int(per_metre * lengths.sum())
    leg = rng.choice(len(steps), count, p=lengths / lengths.sum())
    base = way[leg] + rng.uniform(-0.5, 1.5, (count, 1)) * steps[leg]
    base = base + rng.uniform(-4.0, 4.0, (count, 2))
    height = rng.uniform(0.2, 1.5, count) * rng.choice([-1.0, 1.0], count)
    near = np.min([_distance(base, a, b) for a, b in itertools.pairwise(way)], axis=0)
    return np.asarray(np.column_stack([base, height])[near > 1.0])


def _distance(points: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - along[:, None] * (b - a), axis=1))


@dataclass(frozen=True)
class Setting:
    """World, front-end and target poses of a path."""

    world: LandmarkWorld
    front_end: SimulatedFrontEnd
    targets: FloatArray

    def path(self) -> list[OmniFeatures]:
        """Target images, taken beforehand."""
        return [self.front_end.features_at(pose) for pose in self.targets]


def winding_path(seed: int, legs: int, spacing: float, offset: float = 0.2) -> Setting:
    """Targets on a winding way; the robot starts one leg before the first, somewhat beside it."""
    rng = np.random.default_rng(seed)
    turns = np.cumsum(rng.uniform(-0.5, 0.5, legs))
    steps = spacing * np.column_stack([np.cos(turns), np.sin(turns)])
    places = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    targets = np.column_stack([places[1:], turns])
    points = points_along(places, 14.0, rng)
    start = np.array([*rng.uniform(-offset, offset, 2), rng.uniform(-0.3, 0.3)])
    world = LandmarkWorld(points, start, rng)
    return Setting(world, SimulatedFrontEnd(world, rng), targets)


def make_follower(
    setting: Setting, estimator: HomingEstimatorSettings | None = None
) -> HomingChain:
    """Over the whole path."""
    kind = HomingEkfSettings() if estimator is None else estimator
    front_end = cast("ImageFrontEnd", setting.front_end)  # it has all that a chain calls
    return HomingChain(front_end, setting.path(), lambda start: make_homing_estimator(start, kind))


def drive_path(
    setting: Setting,
    settings: HomingBehaviourSettings | None = None,
    estimator: HomingEstimatorSettings | None = None,
    avoider: CorridorAvoidance | None = None,
) -> DriveRecord:
    """The whole path in closed loop."""
    behaviour = HomingBehaviourSettings() if settings is None else settings
    follower = make_follower(setting, estimator)
    return follow(
        setting.world,
        follower,
        Steering(behaviour.steering),
        avoider,
        behaviour.loop,
        setting.targets,
    )
