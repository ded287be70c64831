"""A simulated homing of bearings alone: matches, tracked bearings, and the ground truth.

Everything follows from the settings and the generator that is handed in. Outliers come in three
ways: matches between start and target that are wrong (before any RANSAC; some of them survive
it), tracks that jump to another point and stay with it, and single bearings that point anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.bearings import BearingMatches, FeatureKind, HomingTruth, TrackedBearings
from fgslam.core.geometry import bearings, rotation, wrap
from fgslam.worlds.settings import SimulatedBearingsSettings

_CORRELATION_S = 0.5  # of the disturbances of the drive
_NEAREST_M, _FARTHEST_M = 0.8, 2.5  # of points from the way: a furnished room
_LOWEST_M, _HIGHEST_M = 0.2, 1.5  # of points above or below the camera: furniture and ceiling
_LEG_M = 2.0  # from start to target: the paper's
_SIGMA = np.deg2rad(1.0)  # of bearings and elevations; 0.5 to 1 degree in the paper
_DIRECTION_DEG, _ROTATION_DEG = 20.0, 30.0  # the target's, at most, against the start
_SPEED_MPS = 0.3  # the paper's wheelchair while homing
# Deviations of the turning rate, degrees/s, and of the sideways speed, as part of the speed, come
# on top of the steering: the way is curved.
_WANDER_DEG, _SLIP = 10.0, 0.05
_STEERING = 2.0  # 1/s: turning rate over the bearing of the target
_FASTEST_TURN = np.deg2rad(60.0)  # radians a second
_CANDIDATES = 40  # points drawn for one that is used
_LONGEST = 10.0  # drives end after so many times the straight one


@dataclass(frozen=True, slots=True)
class HomingOutliers:
    """What is wrong in a trial, as parts of one.

    Attributes:
        wrong_matches: of all matches between start and target; the target's end belongs to another
            point.
        jumping_tracks: of the tracks; they jump to another point of the room once, at any time, and
            follow that one from then on.
        gross_bearings: of the tracked bearings, each for itself, that point anywhere.
    """

    wrong_matches: float = 0.0
    jumping_tracks: float = 0.0
    gross_bearings: float = 0.0

    @classmethod
    def of_all(cls, part: float) -> HomingOutliers:
        """So many of the matches, and of the bearings tracked at the drive's end.

        Half of the latter come from tracks that jumped, half are single gross errors.
        """
        return cls(part, 0.5 * part, 0.5 * part)


NO_OUTLIERS = HomingOutliers()


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedHoming:
    """One trial. Identities of tracks are rows of the matches.

    Attributes:
        time: of the start image, seconds.
        matches: (n) from start (a) to target (b), some of them wrong.
        correct: (n,) which are not.
        tracks: one for each image on the way.
        truth: in the start frame, metres.
    """

    time: float
    matches: BearingMatches
    correct: BoolArray
    tracks: tuple[TrackedBearings, ...]
    truth: HomingTruth

    def followed(self, rows: IntArray) -> tuple[tuple[TrackedBearings, ...], HomingTruth]:
        """Tracks and truth of some matches (k,), renumbered from 0 in their order, ascending."""
        number = np.full(len(self.matches), -1)
        number[rows] = np.arange(len(rows))
        tracks = []
        for image in self.tracks:
            kept = image.select(number[image.ids] >= 0)
            tracks.append(replace(kept, ids=number[kept.ids]))
        truth = HomingTruth(self.truth.target, self.truth.robots, self.truth.landmarks[rows])
        return tuple(tracks), truth


def simulate_homing(
    settings: SimulatedBearingsSettings,
    rng: np.random.Generator,
    outliers: HomingOutliers = NO_OUTLIERS,
) -> SimulatedHoming:
    """Places points and target, matches the two views, drives and tracks."""
    reach = np.deg2rad([_DIRECTION_DEG, _ROTATION_DEG])
    direction, turn = rng.uniform(-reach, reach)
    target = np.array([*(_LEG_M * np.array([np.cos(direction), np.sin(direction)])), turn])
    wrong = round(settings.features * outliers.wrong_matches / (1.0 - outliers.wrong_matches))
    n = settings.features + wrong
    points, decoys = np.split(_points(target, 2 * n, rng), 2)
    heights = rng.uniform(_LOWEST_M, _HIGHEST_M, n) * rng.choice([-1.0, 1.0], n)
    end = np.arange(n)
    swapped = np.sort(rng.permutation(n)[:wrong])
    end[swapped] = np.roll(swapped, 1) if wrong > 1 else (swapped + 1) % n
    seen_a = _measured(np.zeros(3), points, heights, rng)
    seen_b = _measured(target, points, heights, rng)[:, end]
    matches = BearingMatches(
        kind=np.full(n, int(FeatureKind.SIFT)),
        index_a=np.arange(n),
        index_b=end,
        bearing_a=seen_a[0],
        elevation_a=seen_a[1],
        bearing_b=seen_b[0],
        elevation_b=seen_b[1],
        sigma=np.full((n, 4), _SIGMA),
        quality=rng.random(n),
    )
    robots = _drive(settings, target, rng)
    tracks = _tracks(settings, outliers, np.stack([points, decoys]), heights, robots, rng)
    correct = end == np.arange(n)
    landmarks = np.where(correct[:, None], points, np.nan)
    return SimulatedHoming(0.0, matches, correct, tracks, HomingTruth(target, robots, landmarks))


def _points(target: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """(count, 2) points around the middle of the way, none too near to it."""
    drawn = _CANDIDATES * count
    angle = rng.uniform(-np.pi, np.pi, drawn)
    distance = rng.uniform(_NEAREST_M, _FARTHEST_M + 0.5 * _LEG_M, drawn)
    points = 0.5 * target[:2] + distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    along = np.clip(points @ target[:2] / (target[:2] @ target[:2]), 0.0, 1.0)
    from_way = np.linalg.norm(points - along[:, None] * target[:2], axis=1)
    return np.asarray(points[from_way >= _NEAREST_M][:count])


def _measured(
    pose: FloatArray, points: FloatArray, heights: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(2, n) noisy bearings and elevations, radians."""
    distance = np.linalg.norm(points - pose[:2], axis=1)
    exact = np.stack([bearings(pose, points), np.arctan2(heights, distance)])
    noisy = exact + _SIGMA * rng.standard_normal(exact.shape)
    noisy[0] = wrap(noisy[0])
    return np.asarray(noisy)


def _drive(
    settings: SimulatedBearingsSettings, target: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(k, 3) true poses at the images: steered to the target, disturbed on the way."""
    step = 1.0 / settings.images_per_s
    keep = np.exp(-step / _CORRELATION_S)
    spread = np.array([np.deg2rad(_WANDER_DEG), _SLIP * _SPEED_MPS])
    spread = spread * np.sqrt(1.0 - keep**2)
    disturbance = np.zeros(2)
    pose, poses = np.zeros(3), list[FloatArray]()
    left = _LEG_M
    longest = _LONGEST * _LEG_M / (_SPEED_MPS * step)
    while left > (1.0 - settings.part) * _LEG_M and len(poses) < longest:
        disturbance = keep * disturbance + spread * rng.standard_normal(2)
        aim = bearings(pose, target[None, :2])[0]
        rate = np.clip(_STEERING * aim, -_FASTEST_TURN, _FASTEST_TURN) + disturbance[0]
        middle = pose[2] + 0.5 * step * rate
        moved = rotation(middle) @ np.array([_SPEED_MPS, disturbance[1]]) * step
        pose = np.array([*(pose[:2] + moved), wrap(pose[2] + step * rate)])
        poses.append(pose)
        left = float(np.hypot(*(target[:2] - pose[:2])))
    return np.array(poses)


def _tracks(
    settings: SimulatedBearingsSettings,
    outliers: HomingOutliers,
    places: FloatArray,
    heights: FloatArray,
    robots: FloatArray,
    rng: np.random.Generator,
) -> tuple[TrackedBearings, ...]:
    """What is tracked at each pose (k, 3), of points or, after a jump, decoys (2, n, 2)."""
    n, images = len(heights), len(robots)
    jumps = rng.random(n) < outliers.jumping_tracks
    jump_at = np.where(jumps, rng.integers(0, images, n), images)
    with np.errstate(divide="ignore"):
        seconds = rng.standard_exponential(n) / settings.lost_per_s
    lost_at = seconds * settings.images_per_s
    out = []
    for k, robot in enumerate(robots):
        points = places[(jump_at <= k).astype(np.int64), np.arange(n)]
        bearing, _ = _measured(robot, points, heights, rng)
        gross = rng.random(n) < outliers.gross_bearings
        bearing = np.where(gross, rng.uniform(-np.pi, np.pi, n), bearing)
        everything = TrackedBearings(
            time=(k + 1) / settings.images_per_s,
            ids=np.arange(n),
            bearing=bearing,
            sigma_bearing=np.full(n, _SIGMA),
            elevation=np.full(n, np.nan),
            sigma_elevation=np.full(n, np.nan),
        )
        out.append(everything.select(lost_at > k))
    return tuple(out)
