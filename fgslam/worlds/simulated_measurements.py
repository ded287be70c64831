"""A simulated drive without images: exact poses, noisy measurements with identities.

What the front-end would hand to the estimators, with noise of exactly the covariance that it
states: independent noise on the pixels of all images, fused as
docs/derivations/measurements.md derives. Everything follows from two seeds: the world's
(where landmarks are) and the run's (noise, detections, wrong matches).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import ConfigError
from fgslam.core.sensors import (
    CameraRig,
    Increment,
    Observations,
    Odometry,
    measurement_map,
    pixel_model,
    vertical_to_horizontal,
)
from fgslam.core.types import Trajectory
from fgslam.worlds.buildings.lab import build_lab
from fgslam.worlds.driving import (
    PlanarPath,
    drive_along,
    paper_loop,
    planar_poses,
    room_laps,
    simulate_wheels,
    straights_and_turns,
)
from fgslam.worlds.lab import make_rig
from fgslam.worlds.patches import stack
from fgslam.worlds.settings import (
    MeasurementDriveSettings,
    MeasurementWorldSettings,
    SimulatedMeasurementsSettings,
)

# Streams of random numbers, apart so that one imperfection does not redraw another's.
_DETECTION, _PIXELS, _ODOMETRY, _WRONG = 1, 2, 3, 4
_MOVED = 5
_BORDER_PX = 8.0  # nearer to the edge a landmark may be seen, but is not missed
_STRENGTH_JITTER = 0.1
_LEAST_DISPARITY_PX = 0.5  # a fainter one cannot be triangulated
PIXEL_SIGMA = 0.2  # of a coordinate in each image: that of SIFT in rendered ones
LEAST_RANGE_M = 0.4  # nearer ones are in one image only, or out of focus
MOST_RANGE_M = 8.0  # farther ones are not in view
_MOVED_M = 0.5  # landmarks move so far, level, in any direction
OBLIQUE_DEG = 75.0  # off its surface's normal a landmark is foreshortened beyond recognition
PRUNE_AFTER = 20  # consecutive misses in view until an identity is dropped, as in Se et al. 4.3


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedMeasurements:
    """The measurements and the truth, in the frame of the reference camera's first pose.

    Attributes:
        rig: the cameras.
        increments: one a selected frame.
        truth: exact poses of the reference camera.
        landmark_ids: (n,) identities whose landmark stood still, ascending.
        landmark_positions: (n, 3) where they are, metres.
        wrong_matches: how many matched observations are wrong.
    """

    rig: CameraRig
    increments: tuple[Increment, ...]
    truth: Trajectory
    landmark_ids: IntArray
    landmark_positions: FloatArray
    wrong_matches: int


def simulate_measurements(
    settings: SimulatedMeasurementsSettings, seed: int
) -> SimulatedMeasurements:
    """Drives, measures, and keeps the books; the selected frames only.

    Raises:
        ConfigError: the drive does not exist in the place, or not in so few frames, the selection
            leaves none of them, or an imperfection would begin after the last.
    """
    drive = plan_measured_drive(settings.drive, settings.world.place)
    _require_effect(settings, len(drive.timestamps))
    rig = make_rig(settings.rig)
    world = build_world(settings.world, drive.corners)
    chosen = _selection(len(drive.timestamps), settings)
    steps = simulate_odometry(settings, drive.body, np.random.default_rng([seed, _ODOMETRY]))
    wTc = drive.body @ rig.bTc
    camera = _Camera(settings, rig, world, seed)
    increments = []
    for k, index in enumerate(chosen):
        since = steps[chosen[k - 1] : index] if k else []
        odometry = g.odometry_of_camera(g.compose_odometry(since), rig.bTc) if k else None
        stamp = float(drive.timestamps[index])
        increments.append(camera.increment(int(index), stamp, odometry, wTc[index]))
    first = g.inverse(wTc[chosen[0]])
    ids, positions = camera.landmark_truth(int(chosen[-1]))
    return SimulatedMeasurements(
        rig=rig,
        increments=tuple(increments),
        truth=Trajectory(drive.timestamps[chosen], first @ wTc[chosen]),
        landmark_ids=ids,
        landmark_positions=g.transform_to_world(first, positions),
        wrong_matches=camera.wrong_matches,
    )


def _selection(count: int, settings: SimulatedMeasurementsSettings) -> IntArray:
    chosen = np.arange(count)[settings.start : settings.stop : settings.stride]
    if not len(chosen):
        raise ConfigError(
            f"dataset.start {settings.start}, stop {settings.stop} leave none of the drive's "
            f"{count} frames; lower dataset.start or raise dataset.stop"
        )
    return chosen


def _require_effect(settings: SimulatedMeasurementsSettings, frames: int) -> None:
    """Refuses keys that would do nothing."""
    fault, blackout, moved = settings.odometry_fault, settings.blackout, settings.moved
    starts = {
        "odometry_fault.start": None if fault is None else fault.start,
        "blackout.start": None if blackout is None else blackout.start,
        "moved.frame": None if moved is None else moved.frame,
    }
    for key, start in starts.items():
        if start is not None and start >= frames:
            raise ConfigError(
                f"dataset.{key} is {start}, but the drive has the frames 0 to {frames - 1}; "
                "choose an earlier one"
            )


class _Camera:
    """The rig in the world: what it sees in a frame, and under which identities."""

    def __init__(
        self,
        settings: SimulatedMeasurementsSettings,
        rig: CameraRig,
        world: LandmarkWorld,
        seed: int,
    ) -> None:
        self._settings = settings
        self._rig = rig
        self._world = world
        self._detection = np.random.default_rng([seed, _DETECTION])
        self._pixel_noise = np.random.default_rng([seed, _PIXELS])
        self._wrong = np.random.default_rng([seed, _WRONG])
        self._after = _moved_points(settings, world)
        self._book = IdentityBook(len(world), PRUNE_AFTER)
        self._index_of_birth: list[int] = []
        ratio = vertical_to_horizontal(rig)
        self._model = pixel_model(rig.cameras, ratio)
        self._fuse = measurement_map("fused", rig.cameras, ratio)
        self._covariance = PIXEL_SIGMA**2 * (self._fuse @ self._fuse.T)
        self.wrong_matches = 0

    def increment(
        self, index: int, timestamp: float, odometry: Odometry | None, wTc: FloatArray
    ) -> Increment:
        """One frame at a true pose in the room."""
        if self._blocked(index):
            sightings = Sightings.nothing()
            pixels = np.empty((0, 2 * self._rig.cameras))
        else:
            sightings, pixels = self._look(wTc, g.transform_to_camera(wTc, self._points(index)))
        self._index_of_birth += [index] * len(sightings.new)
        observations = self._observe(sightings, pixels)
        return Increment(
            index=index,
            timestamp=timestamp,
            odometry=odometry,
            observations=observations,
            rejected=np.zeros(len(observations), np.bool_),
            missed_ids=sightings.missed_ids,
            pruned_ids=sightings.pruned_ids,
        )

    def landmark_truth(self, last_index: int) -> tuple[IntArray, FloatArray]:
        """Identities whose point has not moved since they were given, and where it is."""
        points = self._book.point_of_id
        final = self._points(last_index)[points]
        born = np.array(self._index_of_birth, np.int64)
        moved = self._settings.moved
        still = np.ones(len(points), np.bool_)
        if moved is not None and last_index >= moved.frame:
            still = (final == self._world.points[points]).all(axis=1) | (born >= moved.frame)
        return np.flatnonzero(still), final[still]

    # ----------------------------------------------------------------------------------------

    def _points(self, index: int) -> FloatArray:
        moved = self._settings.moved
        return self._world.points if moved is None or index < moved.frame else self._after

    def _blocked(self, index: int) -> bool:
        blackout = self._settings.blackout
        return blackout is not None and 0 <= index - blackout.start < blackout.frames

    def _look(self, wTc: FloatArray, local: FloatArray) -> tuple[Sightings, FloatArray]:
        """Who is seen, and the noisy pixels (k, 2 * cameras) of the matched, then the new."""
        view, exact, inner = self._in_view(wTc, local)
        detection = self._settings.detection
        sigma = PIXEL_SIGMA * detection.noise_scale
        noise = sigma * self._pixel_noise.standard_normal(exact.shape)
        found = self._detect(view, self._measurable(exact + noise))
        seen, expected = np.zeros((2, len(local)), np.bool_)
        seen[view[found]] = expected[view[inner]] = True
        sightings = self._book.take(seen, expected)
        rows = np.searchsorted(view, np.concatenate([sightings.matched, sightings.new]))
        pixels = exact[rows] + noise[rows]
        self._confuse(pixels[: len(sightings.matched)], exact, noise[rows])
        return sightings, pixels

    def _in_view(
        self, wTc: FloatArray, local: FloatArray
    ) -> tuple[IntArray, FloatArray, BoolArray]:
        """Points in view (v,) ascending, their exact pixels (v, 2 * cameras), and which are inner.

        Inner ones keep off the edges of all images.
        """
        rig = self._rig
        view = self._world.in_sight(wTc[:3, 3])
        seen_from = local[view]
        distance = np.linalg.norm(seen_from, axis=1)
        ray = seen_from @ wTc[:3, :3].T
        facing = -np.einsum("ni,ni->n", ray, self._world.normals[view])
        ok = (distance >= LEAST_RANGE_M) & (distance <= MOST_RANGE_M)
        ok &= facing >= np.cos(np.deg2rad(OBLIQUE_DEG)) * distance
        view = view[ok & g.in_front(seen_from, LEAST_RANGE_M)]
        pixels = g.project(rig, local[view]) @ self._model.T
        margin = np.min(
            [pixels, np.tile([rig.width - 1.0, rig.height - 1.0], rig.cameras) - pixels], axis=0
        ).min(axis=1)
        inside = margin >= 0.0
        return view[inside], pixels[inside], margin[inside] >= _BORDER_PX

    def _measurable(self, pixels: FloatArray) -> BoolArray:
        return np.asarray((pixels @ self._fuse.T)[:, 2] >= _LEAST_DISPARITY_PX)

    def _detect(self, view: IntArray, measurable: BoolArray) -> BoolArray:
        """Which of the points in view are found: by chance, and the strongest of too many."""
        detection = self._settings.detection
        lucky, jitter = self._detection.uniform(size=(2, len(view)))
        found: BoolArray = measurable & (lucky < detection.probability)
        if found.sum() > detection.features:
            strength = self._world.strength[view] + _STRENGTH_JITTER * jitter
            weakest = np.argsort(np.where(found, -strength, np.inf), kind="stable")
            found[weakest[detection.features :]] = False
        return found

    def _confuse(self, matched: FloatArray, in_view: FloatArray, noise: FloatArray) -> None:
        """Replaces some rows by another landmark's pixels or by anything in the image."""
        fraction, count = self._settings.outlier_fraction, len(matched)
        if fraction == 0.0 or not count:
            return
        draw = self._wrong.uniform(size=(count, 2))
        other = in_view[self._wrong.integers(len(in_view), size=count)]
        shown = np.where(draw[:, 1:] < 0.5, other, self._anywhere(count)) + noise[:count]
        wrong = (draw[:, 0] < fraction) & self._measurable(shown)
        matched[wrong] = shown[wrong]
        self.wrong_matches += int(wrong.sum())

    def _anywhere(self, count: int) -> FloatArray:
        """Pixels (count, 2 * cameras) of points anywhere in the reference image."""
        rig = self._rig
        size = np.array([rig.width - 1.0, rig.height - 1.0])
        least = rig.fx * rig.baseline / MOST_RANGE_M
        most = min(rig.fx * rig.baseline / LEAST_RANGE_M, rig.width / 2)
        uniform = self._wrong.uniform(size=(count, 3))
        measurement = np.column_stack(
            [uniform[:, :2] * size, least + uniform[:, 2] * (most - least)]
        )
        return np.asarray(measurement @ self._model.T)

    def _observe(self, sightings: Sightings, pixels: FloatArray) -> Observations:
        count = len(pixels)
        raw = np.full((count, 3, 2), np.nan)
        raw[:, : self._rig.cameras] = pixels.reshape(count, self._rig.cameras, 2)
        return Observations(
            ids=np.concatenate([sightings.matched_ids, sightings.new_ids]),
            measurement=pixels @ self._fuse.T,
            covariance=np.tile(self._covariance, (count, 1, 1)),
            pixels=raw,
            is_new=np.arange(count) >= len(sightings.matched),
        )


def _moved_points(settings: SimulatedMeasurementsSettings, world: LandmarkWorld) -> FloatArray:
    """Where the points are after some have moved; the world's seed chooses which."""
    moved = settings.moved
    if moved is None:
        return world.points
    rng = np.random.default_rng([settings.world.world_seed, _MOVED])
    gone = rng.uniform(size=len(world)) < moved.fraction
    angle = rng.uniform(0.0, 2.0 * np.pi, size=len(world))
    shift = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(world))])
    return np.asarray(world.points + _MOVED_M * gone[:, None] * shift)


# --------------------------------------------------------------------------------------------
# Wheel odometry


def simulate_odometry(
    settings: SimulatedMeasurementsSettings, body: FloatArray, rng: np.random.Generator
) -> list[Odometry]:
    """Body motions between consecutive true poses (n, 4, 4): n - 1 of them.

    Noise as stated times ``detection.noise_scale``; while ``odometry_fault`` lasts, true motions
    are reported scaled (along their screw) under the same covariance.
    """
    noise_scale, fault = settings.detection.noise_scale, settings.odometry_fault
    true = g.inverse(body[:-1]) @ body[1:]
    out = []
    for i, step in enumerate(simulate_wheels(settings.odometry, body, rng)):
        noise = g.inverse(true[i]) @ step.motion
        if noise_scale != 1.0:
            noise = g.se3_exp(noise_scale * g.se3_log(noise))
        motion = true[i]
        if fault is not None and 0 <= i + 1 - fault.start < fault.frames:
            motion = g.se3_exp(fault.scale * g.se3_log(motion))
        out.append(Odometry(np.asarray(motion @ noise), step.covariance))
    return out


# --------------------------------------------------------------------------------------------
# Drives: the lab's own, rounds, sharp turns, and long corridors
#
# Room frame as in :mod:`fgslam.worlds.driving`: x east, y north, metres; heading counter-clockwise.


CORRIDOR_WIDTH_M = 2.4

_ROUND_M = (16.0, 10.0)  # centre line of the closed corridor
_LEGS_M = (12.0, 8.0, 15.0, 7.0)  # of the long one, over and over
_LEAST_WAY_M = 200.0  # in the long one
_BEND_M = 2.5  # way over which a corridor's corner is driven
_PLACES_OF_PATHS = {
    "room": ("lab_loop", "laps", "sharp_turns"),
    "corridor": ("laps", "exploring"),
}

# Half a round of sharp turns: (metres, degrees). Turned by half a turn, it closes upon itself.
_SHARP_START = (-1.9, -1.16, 0.0)
_SHARP_HALF = ((1.9, 0.0), (0.0, 360.0), (1.9, 0.0), (0.5, 90.0), (1.2, 0.0), (0.0, -270.0))
_CRUISE = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class PlannedDrive:
    """Where the robot is when.

    Attributes:
        timestamps: (n,) seconds from 0.
        body: (n, 4, 4) ``wTb`` in the room's frame, on the floor.
        corners: (k, 2) centre line of the corridor, metres; None in the room.
    """

    timestamps: FloatArray
    body: FloatArray
    corners: FloatArray | None


def plan_measured_drive(settings: MeasurementDriveSettings, place: str) -> PlannedDrive:
    """The drive that the settings name, in a place.

    Raises:
        ConfigError: the path does not exist in the place, or not in so few frames.
    """
    if settings.path not in _PLACES_OF_PATHS[place]:
        raise ConfigError(
            f"dataset.drive.path {settings.path} does not exist in a {place}; choose one of "
            f"{', '.join(_PLACES_OF_PATHS[place])}, or another dataset.world.place"
        )
    if settings.path == "sharp_turns":
        planar = _sharp_turns(settings)
        stamps = np.arange(len(planar)) / settings.frame_rate_hz
        return PlannedDrive(stamps, planar_poses(planar), None)
    corners = None
    if place == "room":
        path = paper_loop() if settings.path == "lab_loop" else room_laps(settings.laps)
    elif settings.path == "laps":
        path, corners = _closed_corridor(settings.laps)
    else:
        path, corners = _long_corridor()
    drive = drive_along(path, settings, settings.frames)
    return PlannedDrive(drive.timestamps, drive.body_poses(drive.timestamps), corners)


# --------------------------------------------------------------------------------------------
# Corridors


def _closed_corridor(laps: int) -> tuple[PlanarPath, FloatArray]:
    """``laps`` rounds of a rectangle, from the middle of its first side."""
    a, b = _ROUND_M
    cut = _bend_cut()
    half, long, short = a / 2 - cut, a - 2 * cut, b - 2 * cut
    turn = (_BEND_M, np.pi / 2)
    lap = [(half, 0.0), turn, (short, 0.0), turn, (long, 0.0), turn, (short, 0.0), turn]
    path = straights_and_turns((a / 2, 0.0, 0.0), [*lap, (half, 0.0)] * laps, closed=True)
    return path, np.array([[0.0, 0.0], [a, 0.0], [a, b], [0.0, b], [0.0, 0.0]])


def _long_corridor() -> tuple[PlanarPath, FloatArray]:
    """Stairs seen from above, left and right in turns: it never meets itself."""
    legs: list[float] = []
    while sum(legs) < _LEAST_WAY_M:
        legs.append(_LEGS_M[len(legs) % len(_LEGS_M)])
    cut = _bend_cut()
    segments: list[tuple[float, float]] = []
    for i, leg in enumerate(legs):
        inner = 0 < i < len(legs) - 1
        segments.append((leg - cut - (cut if inner else 1.0), 0.0))
        segments.append((_BEND_M, np.pi / 2 if i % 2 == 0 else -np.pi / 2))
    along = np.array([[1.0, 0.0] if i % 2 == 0 else [0.0, 1.0] for i in range(len(legs))])
    corners = np.vstack([[0.0, 0.0], np.cumsum(along * np.array(legs)[:, None], axis=0)])
    return straights_and_turns((1.0, 0.0, 0.0), segments[:-1], closed=False), corners


def _bend_cut() -> float:
    """How far before and after a corner a bend of 90 degrees begins and ends, metres."""
    bend = straights_and_turns((0.0, 0.0, 0.0), [(_BEND_M, np.pi / 2)], closed=False)
    return float(bend.xy[-1, 0])


# --------------------------------------------------------------------------------------------
# Sharp turns


def _sharp_turns(settings: MeasurementDriveSettings) -> FloatArray:
    """(n, 3) x, y, heading: spins on the spot and tight bends, round after round."""
    step = _CRUISE * settings.max_speed_m_s / settings.frame_rate_hz
    turn = np.deg2rad(settings.turn_deg_per_frame)
    segments = []
    for way, degrees in _SHARP_HALF:  # in equal chords and turns, each within step and turn
        angle = np.deg2rad(degrees)
        count = int(np.ceil(max(way / step, abs(angle) / turn) - 1e-9))
        segments.append(np.tile([way / count, angle / count], (count, 1)))
    moves = np.vstack([*segments, *segments])
    wanted = len(moves) + 1 if settings.frames is None else settings.frames
    moves = np.tile(moves, (-(-wanted // len(moves)), 1))[: wanted - 1]
    out = np.zeros((wanted, 3))
    out[:, 2] = _SHARP_START[2] + np.concatenate([[0.0], np.cumsum(moves[:, 1])])
    middle = out[:-1, 2] + 0.5 * moves[:, 1]
    steps = moves[:, :1] * np.column_stack([np.cos(middle), np.sin(middle)])
    out[:, :2] = _SHARP_START[:2]
    out[1:, :2] += np.cumsum(steps, axis=0)
    return out


# --------------------------------------------------------------------------------------------
# Landmarks on the surfaces of a room or of corridors, with the side they are seen from
#
# Identities are as the landmark database makes them: given in the order of first sight, kept
# through misses, dropped after too many in a row, and new when the point is seen again (Se et al.
# 4.3).


_BARE = frozenset({"floor", "ceiling"})
"""Things of the lab with few features; they get this share of what their area would earn."""
_BARE_SHARE = 0.05
_STREAM = 21  # of random numbers, apart from the rendered lab's
_HEIGHTS_M = (0.1, 2.6)
_RELIEF_M = 0.15  # how far things stand out from a corridor's wall
_ON_WALL_M = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkWorld:
    """Points that can be seen.

    Attributes:
        points: (n, 3) metres, room frame.
        normals: (n, 3) unit, towards the side they are seen from.
        strength: (n,) in [0, 1): the stronger are found first where there are too many.
        boxes: (k, 2, 2) least and greatest x, y of the convex parts of the place.
        inside: (n, k) which points lie in which part: what shares a part sees each other.
    """

    points: FloatArray
    normals: FloatArray
    strength: FloatArray
    boxes: FloatArray
    inside: BoolArray

    def __len__(self) -> int:
        return len(self.points)

    def in_sight(self, position: FloatArray) -> IntArray:
        """Points with nothing between them and a camera position (3,), ascending."""
        here = _inside(position[None], self.boxes)[0]
        return np.flatnonzero(self.inside[:, here].any(axis=1))


def build_world(settings: MeasurementWorldSettings, corners: FloatArray | None) -> LandmarkWorld:
    """The landmarks of a place, from its own seed.

    Args:
        settings: how many, and where. The furniture is that of the rendered lab's ``room_seed``.
        corners: (k, 2) centre line of the corridors, metres; None for the room.
    """
    rng = np.random.default_rng([settings.world_seed, _STREAM])
    if corners is None:
        points, normals = _lab_points(settings, rng)
        boxes = np.array([[points[:, :2].min(axis=0) - 1.0, points[:, :2].max(axis=0) + 1.0]])
    else:
        way = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
        count = int(np.ceil(settings.landmarks * way / 100.0))
        boxes = _corridor_boxes(corners)
        points, normals = _corridor_points(boxes, count, rng)
    strength = rng.uniform(size=len(points))
    return LandmarkWorld(points, normals, strength, boxes, _inside(points, boxes))


def _inside(points: FloatArray, boxes: FloatArray) -> BoolArray:
    """(n, k) which points lie in which box, walls included."""
    xy = points[:, None, :2]
    return np.asarray(
        ((xy >= boxes[:, 0] - _ON_WALL_M) & (xy <= boxes[:, 1] + _ON_WALL_M)).all(axis=2)
    )


def _lab_points(
    settings: MeasurementWorldSettings, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Spread over walls, furniture and what hangs on the walls, by area."""
    count = settings.landmarks
    things = build_lab(np.random.default_rng([settings.world_seed, 2]), visit=1)
    patches = stack(things)
    area = np.linalg.norm(np.cross(patches.edge_u, patches.edge_v), axis=1)
    bare = np.array([thing.name in _BARE for thing in things])
    area[bare[patches.thing]] *= _BARE_SHARE
    which = rng.choice(len(patches), size=count, p=area / area.sum())
    u, v = rng.uniform(size=(2, count, 1))
    points = patches.corner[which] + u * patches.edge_u[which] + v * patches.edge_v[which]
    return points, patches.normal[which]


def _corridor_boxes(corners: FloatArray) -> FloatArray:
    """(k, 2, 2) one rectangle for each leg, the squares at its ends included."""
    half = CORRIDOR_WIDTH_M / 2
    pairs = [np.array([a, b]) for a, b in itertools.pairwise(corners)]
    return np.array([[p.min(axis=0) - half, p.max(axis=0) + half] for p in pairs])


def _corridor_points(
    boxes: FloatArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """On the walls, where no other leg opens."""
    corner, edge, normal = _sides(boxes)
    length = np.linalg.norm(edge, axis=1)
    # Openings take some; draw enough at once, keep the first ones.
    which = rng.choice(len(corner), size=2 * count, p=length / length.sum())
    xy = corner[which] + rng.uniform(size=(2 * count, 1)) * edge[which]
    relief = rng.uniform(0.0, _RELIEF_M, size=(2 * count, 1))
    opening = (xy[:, None] > boxes[:, 0] + _ON_WALL_M) & (xy[:, None] < boxes[:, 1] - _ON_WALL_M)
    wall = np.flatnonzero(~opening.all(axis=2).max(axis=1))[:count]
    heights = rng.uniform(*_HEIGHTS_M, size=2 * count)
    points = np.column_stack([xy + relief * normal[which], heights])[wall]
    return points, np.column_stack([normal[which], np.zeros(2 * count)])[wall]


def _sides(boxes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Corner, edge and inward normal (4k, 2) of the boxes' sides."""
    (x0, y0), (x1, y1) = boxes[:, 0].T, boxes[:, 1].T
    zero, one = np.zeros(len(boxes)), np.ones(len(boxes))
    corner = np.array([[x0, y0], [x0, y1], [x0, y0], [x1, y0]])
    edge = np.array([[x1 - x0, zero], [x1 - x0, zero], [zero, y1 - y0], [zero, y1 - y0]])
    normal = np.array([[zero, one], [zero, -one], [one, zero], [-one, zero]])
    flat = [np.swapaxes(part, 1, 2).reshape(-1, 2) for part in (corner, edge, normal)]
    return flat[0], flat[1], flat[2]


# --------------------------------------------------------------------------------------------
# Identities


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """One frame's points by what they are to the database.

    Attributes:
        matched: (k,) points seen whose identity is known, by ascending identity (Type III).
        matched_ids: (k,) theirs.
        new: (m,) points seen for the first time, or again after they were dropped (Type IV).
        new_ids: (m,) the identities they got, ascending.
        missed_ids: identities expected in view and not seen, ascending (Type II).
        pruned_ids: identities dropped after this frame, ascending.
    """

    matched: IntArray
    matched_ids: IntArray
    new: IntArray
    new_ids: IntArray
    missed_ids: IntArray
    pruned_ids: IntArray

    @staticmethod
    def nothing() -> Sightings:
        """Of a frame in which the cameras saw nothing at all, and nothing was expected."""
        none = np.empty(0, np.int64)
        return Sightings(none, none, none, none, none, none)


class IdentityBook:
    """Who is known, missed and dropped, frame after frame."""

    def __init__(self, points: int, prune_after: int) -> None:
        """Knows none of the points; ``prune_after`` consecutive misses drop an identity."""
        self._prune_after = prune_after
        self._id = np.full(points, -1, np.int64)
        self._missed = np.zeros(points, np.int64)
        self._point_of_id: list[IntArray] = []
        self._count = 0

    def __len__(self) -> int:
        """Identities given so far."""
        return self._count

    @property
    def point_of_id(self) -> IntArray:
        """(n,) point behind each identity ever given."""
        return np.concatenate([np.empty(0, np.int64), *self._point_of_id])

    def known(self) -> BoolArray:
        """Which points have an identity now."""
        return np.asarray(self._id >= 0)

    def take(self, seen: BoolArray, expected: BoolArray) -> Sightings:
        """One frame.

        Args:
            seen: (points,) which were measured.
            expected: (points,) which should have been; those known and not seen are missed.
        """
        known = self._id >= 0
        matched = np.flatnonzero(seen & known)
        matched = matched[np.argsort(self._id[matched])]
        new = np.flatnonzero(seen & ~known)
        missed = expected & ~seen & known
        new_ids = self._count + np.arange(len(new))
        out = (matched, self._id[matched], new, new_ids, np.sort(self._id[missed]))
        self._missed[matched] = 0
        self._missed[missed] += 1
        self._id[new], self._missed[new] = new_ids, 0
        self._count += len(new)
        self._point_of_id.append(new)
        return Sightings(*out, pruned_ids=self._prune())

    def _prune(self) -> IntArray:
        gone = (self._id >= 0) & (self._missed >= self._prune_after)
        pruned = np.sort(self._id[gone])
        self._id[gone] = -1
        return pruned
