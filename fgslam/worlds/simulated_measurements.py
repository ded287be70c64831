"""A simulated drive without images: exact poses, noisy measurements with identities.

What the front-end would hand to the estimators, with noise of exactly the covariance that it
states: independent noise on the pixels of all images, fused as
docs/derivations/measurements.md derives. Everything follows from two seeds: the world's
(where landmarks are) and the run's (noise, detections, wrong matches).
"""

from __future__ import annotations

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
    compose_odometry,
    measurement_map,
    odometry_of_camera,
    pixel_model,
    vertical_to_horizontal,
)
from fgslam.core.types import Trajectory
from fgslam.worlds.driving import (
    FRAME_RATE_HZ,
    drive_along,
    paper_loop,
    planar_poses,
    room_laps,
    simulate_wheels,
    straights_and_turns,
)
from fgslam.worlds.lab import make_rig
from fgslam.worlds.patches import stack
from fgslam.worlds.places import build_lab
from fgslam.worlds.settings import (
    MeasurementDriveSettings,
    MeasurementWorldSettings,
    SimulatedMeasurementsSettings,
)

# Streams of random numbers, apart so that one imperfection does not redraw another's.
_DETECTION, _PIXELS, _ODOMETRY, _WRONG = 1, 2, 3, 4
_BORDER_PX = 8.0  # nearer to the edge a landmark may be seen, but is not missed
_STRENGTH_JITTER = 0.1
_LEAST_DISPARITY_PX = 0.5  # a fainter one cannot be triangulated
PIXEL_SIGMA = 0.2  # of a coordinate in each image: that of SIFT in rendered ones
LEAST_RANGE_M = 0.4  # nearer ones are in one image only, or out of focus
MOST_RANGE_M = 8.0  # farther ones are not in view
OBLIQUE_DEG = 75.0  # off its surface's normal a landmark is foreshortened beyond recognition
PRUNE_AFTER = 20  # consecutive misses in view until an identity is dropped, as in Se et al. 4.3


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedMeasurements:
    """The measurements and the truth, in the frame of the reference camera's first pose.

    Attributes:
        rig: the cameras.
        increments: one a selected frame.
        truth: exact poses of the reference camera.
        landmark_ids: (n,) all identities, ascending.
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
    """Drives and measures the selected frames.

    Raises:
        ConfigError: the drive does not exist in the place, or not in so few frames, the selection
            leaves none of them, or an imperfection would begin after the last.
    """
    timestamps, body, corners = plan_measured_drive(settings.drive, settings.world.place)
    frames = len(timestamps)
    for key, fault in (
        ("odometry_fault", settings.odometry_fault),
        ("blackout", settings.blackout),
    ):
        if fault is not None and fault.start >= frames:
            raise ConfigError(
                f"dataset.{key}.start is {fault.start}, but the drive has the frames 0 to "
                f"{frames - 1}; choose an earlier one"
            )
    chosen = np.arange(frames)[settings.start : settings.stop : settings.stride]
    if not len(chosen):
        raise ConfigError(
            f"dataset.start {settings.start}, stop {settings.stop} leave none of the drive's "
            f"{frames} frames; lower dataset.start or raise dataset.stop"
        )
    rig = make_rig(settings.rig)
    world = build_world(settings.world, corners)
    steps = simulate_odometry(settings, body, np.random.default_rng([seed, _ODOMETRY]))
    wTc = body @ rig.bTc
    camera = _Camera(settings, rig, world, seed)
    increments = []
    for k, index in enumerate(chosen):
        since = steps[chosen[k - 1] : index] if k else []
        odometry = odometry_of_camera(compose_odometry(since), rig.bTc) if k else None
        stamp = float(timestamps[index])
        increments.append(camera.increment(int(index), stamp, odometry, wTc[index]))
    first = g.inverse(wTc[chosen[0]])
    positions = world.points[camera.point_of_id]
    return SimulatedMeasurements(
        rig=rig,
        increments=tuple(increments),
        truth=Trajectory(timestamps[chosen], first @ wTc[chosen]),
        landmark_ids=np.arange(len(positions)),
        landmark_positions=g.transform_to_world(first, positions),
        wrong_matches=camera.wrong_matches,
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
        self._book = IdentityBook(len(world), PRUNE_AFTER)
        ratio = vertical_to_horizontal(rig)
        self._model = pixel_model(rig.cameras, ratio)
        self._fuse = measurement_map("fused", rig.cameras, ratio)
        self._covariance = PIXEL_SIGMA**2 * (self._fuse @ self._fuse.T)
        self.wrong_matches = 0

    def increment(
        self, index: int, timestamp: float, odometry: Odometry | None, wTc: FloatArray
    ) -> Increment:
        """One frame at a true pose in the room."""
        blackout = self._settings.blackout
        if blackout is not None and 0 <= index - blackout.start < blackout.frames:
            sightings, pixels = Sightings.nothing(), np.empty((0, 2 * self._rig.cameras))
        else:
            sightings, pixels = self._look(wTc, g.transform_to_camera(wTc, self._world.points))
        count = len(pixels)
        raw = np.full((count, 3, 2), np.nan)
        raw[:, : self._rig.cameras] = pixels.reshape(count, self._rig.cameras, 2)
        return Increment(
            index=index,
            timestamp=timestamp,
            odometry=odometry,
            observations=Observations(
                ids=np.concatenate([sightings.matched_ids, sightings.new_ids]),
                measurement=pixels @ self._fuse.T,
                covariance=np.tile(self._covariance, (count, 1, 1)),
                pixels=raw,
                is_new=np.arange(count) >= len(sightings.matched),
            ),
            rejected=np.zeros(count, np.bool_),
            missed_ids=sightings.missed_ids,
            pruned_ids=sightings.pruned_ids,
        )

    @property
    def point_of_id(self) -> IntArray:
        """(n,) point behind each identity given so far."""
        return self._book.point_of_id

    def _look(self, wTc: FloatArray, local: FloatArray) -> tuple[Sightings, FloatArray]:
        """Who is seen, and the noisy pixels (k, 2 * cameras) of the matched, then the new."""
        view, exact, inner = self._in_view(wTc, local)
        detection = self._settings.detection
        sigma = PIXEL_SIGMA * detection.noise_scale
        noise = sigma * self._pixel_noise.standard_normal(exact.shape)
        lucky, jitter = self._detection.uniform(size=(2, len(view)))
        found = self._measurable(exact + noise) & (lucky < detection.probability)
        if found.sum() > detection.features:  # the strongest of too many
            strength = self._world.strength[view] + _STRENGTH_JITTER * jitter
            weakest = np.argsort(np.where(found, -strength, np.inf), kind="stable")
            found[weakest[detection.features :]] = False
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
        pixels = rig.predict(local[view]) @ self._model.T
        margin = np.min(
            [pixels, np.tile([rig.width - 1.0, rig.height - 1.0], rig.cameras) - pixels], axis=0
        ).min(axis=1)
        inside = margin >= 0.0
        return view[inside], pixels[inside], margin[inside] >= _BORDER_PX

    def _measurable(self, pixels: FloatArray) -> BoolArray:
        return np.asarray((pixels @ self._fuse.T)[:, 2] >= _LEAST_DISPARITY_PX)

    def _confuse(self, matched: FloatArray, in_view: FloatArray, noise: FloatArray) -> None:
        """Replaces some rows by another landmark's pixels or by anything in the image."""
        fraction, count, rig = self._settings.outlier_fraction, len(matched), self._rig
        if fraction == 0.0 or not count:
            return
        draw = self._wrong.uniform(size=(count, 2))
        other = in_view[self._wrong.integers(len(in_view), size=count)]
        uniform = self._wrong.uniform(size=(count, 3))
        size = np.array([rig.width - 1.0, rig.height - 1.0])
        least = rig.fx * rig.baseline / MOST_RANGE_M
        most = min(rig.fx * rig.baseline / LEAST_RANGE_M, rig.width / 2)
        anywhere = np.column_stack([uniform[:, :2] * size, least + uniform[:, 2] * (most - least)])
        shown = np.where(draw[:, 1:] < 0.5, other, anywhere @ self._model.T) + noise[:count]
        wrong = (draw[:, 0] < fraction) & self._measurable(shown)
        matched[wrong] = shown[wrong]
        self.wrong_matches += int(wrong.sum())


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
# Drives: the lab's own, rounds of it or of a corridor, and sharp turns
#
# Room frame as in :mod:`fgslam.worlds.driving`: x east, y north, metres; heading counter-clockwise.


CORRIDOR_WIDTH_M = 2.4

_ROUND_M = (16.0, 10.0)  # centre line of the closed corridor
_BEND_M = 2.5  # way over which a corridor's corner is driven
_PLACES_OF_PATHS = {
    "room": ("lab_loop", "laps", "sharp_turns"),
    "corridor": ("laps",),
}

# Half a round of sharp turns: (metres, degrees). Turned by half a turn, it closes upon itself.
_SHARP_START = (-1.9, -1.16, 0.0)
_SHARP_HALF = ((1.9, 0.0), (0.0, 360.0), (1.9, 0.0), (0.5, 90.0), (1.2, 0.0), (0.0, -270.0))
_CRUISE = 0.9


def plan_measured_drive(
    settings: MeasurementDriveSettings, place: str
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Time stamps (n,), poses (n, 4, 4) ``wTb`` on the floor, and the corridor's centre line.

    Seconds from 0; the corners (k, 2) of the line are None in the room.

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
        stamps = np.arange(len(planar)) / FRAME_RATE_HZ
        return stamps, planar_poses(planar), None
    corners = None
    if place == "room":
        path = paper_loop() if settings.path == "lab_loop" else room_laps(settings.laps)
    else:  # from the middle of a rectangle's first side
        a, b = _ROUND_M
        turn = (_BEND_M, np.pi / 2)
        corner = straights_and_turns((0.0, 0.0, 0.0), [turn], closed=False)
        cut = float(corner.xy[-1, 0])  # before and after a corner the turn begins and ends
        half, long, short = a / 2 - cut, a - 2 * cut, b - 2 * cut
        lap = [(half, 0.0), turn, (short, 0.0), turn, (long, 0.0), turn, (short, 0.0), turn]
        laps = [*lap, (half, 0.0)] * settings.laps
        path = straights_and_turns((a / 2, 0.0, 0.0), laps, closed=True)
        corners = np.array([[0.0, 0.0], [a, 0.0], [a, b], [0.0, b], [0.0, 0.0]])
    drive = drive_along(path, settings, settings.frames)
    return drive.timestamps, drive.body_poses(drive.timestamps), corners


def _sharp_turns(settings: MeasurementDriveSettings) -> FloatArray:
    """(n, 3) x, y, heading: spins on the spot and tight curves, round after round."""
    step = _CRUISE * settings.max_speed_m_s / FRAME_RATE_HZ
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
# Identities are as the landmark database makes them: given in the order of first observation, kept
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
    """The landmarks of a place, the same for every run.

    Args:
        settings: how many, and where. The furniture is that of the rendered lab.
        corners: (k, 2) centre line of the corridors, metres; None for the room.
    """
    rng = np.random.default_rng([0, _STREAM])
    if corners is None:
        points, normals = _lab_points(settings.landmarks, rng)
        boxes = np.array([[points[:, :2].min(axis=0) - 1.0, points[:, :2].max(axis=0) + 1.0]])
    else:
        way = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
        count = int(np.ceil(settings.landmarks * way / 100.0))
        # One rectangle for each leg, the squares at its ends included.
        half, legs = CORRIDOR_WIDTH_M / 2, np.stack([corners[:-1], corners[1:]], axis=1)
        boxes = np.stack([legs.min(axis=1) - half, legs.max(axis=1) + half], axis=1)
        points, normals = _corridor_points(boxes, count, rng)
    strength = rng.uniform(size=len(points))
    return LandmarkWorld(points, normals, strength, boxes, _inside(points, boxes))


def _inside(points: FloatArray, boxes: FloatArray) -> BoolArray:
    """(n, k) which points lie in which box, walls included."""
    xy = points[:, None, :2]
    return np.asarray(
        ((xy >= boxes[:, 0] - _ON_WALL_M) & (xy <= boxes[:, 1] + _ON_WALL_M)).all(axis=2)
    )


def _lab_points(count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Spread over walls, furniture and pictures, by area."""
    things = build_lab(np.random.default_rng([0, 2])).things
    patches = stack(things)
    area = np.linalg.norm(np.cross(patches.edge_u, patches.edge_v), axis=1)
    bare = np.array([thing.name in _BARE for thing in things])
    area[bare[patches.thing]] *= _BARE_SHARE
    which = rng.choice(len(patches), size=count, p=area / area.sum())
    u, v = rng.uniform(size=(2, count, 1))
    points = patches.corner[which] + u * patches.edge_u[which] + v * patches.edge_v[which]
    return points, patches.normal[which]


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

    @property
    def point_of_id(self) -> IntArray:
        """(n,) point behind each identity ever given."""
        return np.concatenate([np.empty(0, np.int64), *self._point_of_id])

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
        gone = (self._id >= 0) & (self._missed >= self._prune_after)
        pruned = np.sort(self._id[gone])
        self._id[gone] = -1
        return Sightings(*out, pruned_ids=pruned)
