"""A simulated homing of bearings alone: matches, tracked bearings, and the ground truth.

Everything follows from the settings and the generator that is handed in. Outliers come in three
ways: matches between start and target that are wrong (before any RANSAC; some of them survive
it), tracks that jump to another point and stay with it, and single bearings that point anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.homing import BearingMatches, FeatureKind, HomingTruth, TrackedBearings
from fgslam.core.planar import bearings, rotation, wrap
from fgslam.worlds.simulated.settings import SimulatedBearingsSettings

_CORRELATION_S = 0.5  # of the disturbances of the drive
_NEAREST_M, _FARTHEST_M = 0.8, 2.5  # of points from the way: a furnished room
_LOWEST_M, _HIGHEST_M = 0.2, 1.5  # of points above or below the camera: furniture and ceiling
_DIRECTION_DEG, _ROTATION_DEG = 20.0, 30.0  # the target's, at most, against the start
_SPEED_MPS = 0.3  # the paper's wheelchair while homing
# Deviations of the turning rate, degrees/s, and of the sideways speed, as part of the speed, come
# on top of the steering: the way is curved.
_WANDER_DEG, _SLIP = 10.0, 0.05
_STEERING = 2.0  # 1/s: turning rate over the bearing of the target
_FASTEST_TURN = np.deg2rad(60.0)  # radians a second
_NEAR_SIDE, _NEAR_REACH = 0.8, 0.35  # anisotropic: part of the points, and of the range
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
            tracks.append(kept.renumbered(number[kept.ids]))
        truth = HomingTruth(self.truth.target, self.truth.robots, self.truth.landmarks[rows])
        return tuple(tracks), truth


def simulate_homing(
    settings: SimulatedBearingsSettings,
    rng: np.random.Generator,
    outliers: HomingOutliers = NO_OUTLIERS,
) -> SimulatedHoming:
    """Places points and target, matches the two views, drives and tracks."""
    target = _target(settings, rng)
    wrong = round(settings.features * outliers.wrong_matches / (1.0 - outliers.wrong_matches))
    n = settings.features + wrong
    points, decoys = np.split(_points(settings, target, 2 * n, rng), 2)
    heights = rng.uniform(_LOWEST_M, _HIGHEST_M, n) * rng.choice([-1.0, 1.0], n)
    matches, correct = _matches(settings, target, (points, heights), wrong, rng)
    robots = _drive(settings, target, rng)
    tracks = _Tracks(settings, outliers, (points, decoys), heights, rng).images(robots)
    landmarks = np.where(correct[:, None], points, np.nan)
    return SimulatedHoming(0.0, matches, correct, tracks, HomingTruth(target, robots, landmarks))


def _target(settings: SimulatedBearingsSettings, rng: np.random.Generator) -> FloatArray:
    reach = np.deg2rad([_DIRECTION_DEG, _ROTATION_DEG])
    direction, turn = rng.uniform(-reach, reach)
    return np.array([*(settings.leg_m * np.array([np.cos(direction), np.sin(direction)])), turn])


def _points(
    settings: SimulatedBearingsSettings, target: FloatArray, count: int, rng: np.random.Generator
) -> FloatArray:
    """(count, 2) points around the middle of the way, none too near to it."""
    drawn = _CANDIDATES * count
    angle = rng.uniform(-np.pi, np.pi, drawn)
    low, high = _NEAREST_M, _FARTHEST_M + 0.5 * settings.leg_m
    distance = rng.uniform(low, high, drawn)
    if settings.surrounding == "anisotropic":
        near = rng.random(drawn) < _NEAR_SIDE
        angle = np.abs(angle) * np.where(near, 1.0, -1.0) + np.arctan2(target[1], target[0])
        reach = low + _NEAR_REACH * (high - low)
        distance = np.where(near, rng.uniform(low, reach, drawn), rng.uniform(reach, high, drawn))
    points = 0.5 * target[:2] + distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(points[_from_way(points, target) >= low][:count])


def _from_way(points: FloatArray, target: FloatArray) -> FloatArray:
    """Distances (n,) of points from the straight way between start and target."""
    along = np.clip(points @ target[:2] / (target[:2] @ target[:2]), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - along[:, None] * target[:2], axis=1))


def _matches(
    settings: SimulatedBearingsSettings,
    target: FloatArray,
    world: tuple[FloatArray, FloatArray],
    wrong: int,
    rng: np.random.Generator,
) -> tuple[BearingMatches, BoolArray]:
    points, heights = world
    n = len(points)
    end = np.arange(n)
    swapped = np.sort(rng.permutation(n)[:wrong])
    end[swapped] = np.roll(swapped, 1) if wrong > 1 else (swapped + 1) % n
    seen_a = _seen(settings, np.zeros(3), points, heights, rng)
    seen_b = _seen(settings, target, points, heights, rng)[:, end]
    sigma = np.deg2rad([settings.bearing_sigma_deg, settings.elevation_sigma_deg] * 2)
    matches = BearingMatches(
        kind=np.full(n, int(FeatureKind.SIFT)),
        index_a=np.arange(n),
        index_b=end,
        bearing_a=seen_a[0],
        elevation_a=seen_a[1],
        bearing_b=seen_b[0],
        elevation_b=seen_b[1],
        sigma=np.tile(sigma, (n, 1)),
        quality=rng.random(n),
    )
    return matches, end == np.arange(n)


def _seen(
    settings: SimulatedBearingsSettings,
    pose: FloatArray,
    points: FloatArray,
    heights: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """(2, n) noisy bearings and elevations, radians."""
    sigma = np.deg2rad([settings.bearing_sigma_deg, settings.elevation_sigma_deg])
    distance = np.linalg.norm(points - pose[:2], axis=1)
    exact = np.stack([bearings(pose, points), np.arctan2(heights, distance)])
    noisy = exact + sigma[:, None] * rng.standard_normal(exact.shape)
    noisy[0] = wrap(noisy[0])
    return np.asarray(noisy)


# --------------------------------------------------------------------------------------------
# The drive


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
    left = settings.leg_m
    longest = _LONGEST * settings.leg_m / (_SPEED_MPS * step)
    while left > (1.0 - settings.part) * settings.leg_m and len(poses) < longest:
        disturbance = keep * disturbance + spread * rng.standard_normal(2)
        aim = bearings(pose, target[None, :2])[0]
        rate = np.clip(_STEERING * aim, -_FASTEST_TURN, _FASTEST_TURN) + disturbance[0]
        middle = pose[2] + 0.5 * step * rate
        moved = rotation(middle) @ np.array([_SPEED_MPS, disturbance[1]]) * step
        pose = np.array([*(pose[:2] + moved), wrap(pose[2] + step * rate)])
        poses.append(pose)
        left = float(np.hypot(*(target[:2] - pose[:2])))
    return np.array(poses)


class _Tracks:
    """Tracks of all points along the drive, with what goes wrong."""

    def __init__(
        self,
        settings: SimulatedBearingsSettings,
        outliers: HomingOutliers,
        points_and_decoys: tuple[FloatArray, FloatArray],
        heights: FloatArray,
        rng: np.random.Generator,
    ) -> None:
        self._settings, self._outliers = settings, outliers
        self._places = np.stack(points_and_decoys)
        self._heights = heights
        self._rng = rng

    def images(self, robots: FloatArray) -> tuple[TrackedBearings, ...]:
        """One a pose (k, 3)."""
        settings, rng = self._settings, self._rng
        n, images = len(self._heights), len(robots)
        jumps = rng.random(n) < self._outliers.jumping_tracks
        jump_at = np.where(jumps, rng.integers(0, images, n), images)
        with np.errstate(divide="ignore"):
            seconds = rng.standard_exponential(n) / settings.lost_per_s
        lost_at = seconds * settings.images_per_s
        return tuple(
            self._image(k, robot, (jump_at <= k).astype(np.int64), lost_at > k)
            for k, robot in enumerate(robots)
        )

    def _image(
        self, index: int, robot: FloatArray, jumped: IntArray, alive: BoolArray
    ) -> TrackedBearings:
        settings, rng = self._settings, self._rng
        every = np.arange(len(alive))
        points = self._places[jumped, every]
        bearing, elevation = _seen(settings, robot, points, self._heights, rng)
        gross = rng.random(len(alive)) < self._outliers.gross_bearings
        bearing = np.where(gross, rng.uniform(-np.pi, np.pi, len(alive)), bearing)
        if not settings.tracked_elevations:
            elevation = np.full(len(alive), np.nan)
        sigma = np.full(len(alive), np.deg2rad(settings.bearing_sigma_deg))
        tall = np.full(len(alive), np.deg2rad(settings.elevation_sigma_deg))
        everything = TrackedBearings(
            time=(index + 1) / settings.images_per_s,
            ids=every,
            bearing=bearing,
            sigma_bearing=sigma,
            elevation=elevation,
            sigma_elevation=np.where(np.isnan(elevation), np.nan, tall),
        )
        return everything.select(alive)
