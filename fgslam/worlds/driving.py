"""How robots move: smooth paths, a time law within limits, wheel odometry, and a wheelchair.

Paths are functions of arc length in the room's frame: x east, y north, metres from the room's
centre; the heading is counter-clockwise from x, in radians.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from fgslam.core import geometry
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import ConfigError
from fgslam.core.geometry import unit, wrap
from fgslam.core.sensors import Odometry
from fgslam.worlds.patches import RayCaster
from fgslam.worlds.settings import DriveLimits, WheelOdometrySettings

_STEP_M = 0.004
# Waypoints must not ask for tighter turns: the curve's heading would jump between its samples.
_LEAST_RADIUS_M = 0.08
# Part of a turn over which its curvature rises, and again falls.
_RAMP = 0.3
FRAME_RATE_HZ = 2.0  # of images
# Speed used, as a fraction of the limits, where the number of frames is free.
_CRUISE = 0.9
MAX_ACCELERATION_M_S2 = 0.30  # along the path; gentle for a robot of the paper's size


@dataclass(frozen=True, slots=True, eq=False)
class PlanarPath:
    """A curve sampled every few millimetres.

    Attributes:
        arc: (n,) arc length from the start, metres, increasing.
        xy: (n, 2) position, metres.
        heading: (n,) unwrapped tangent direction, radians.
        curvature: (n,) d heading / d arc, radians a metre.
        closed: whether the end repeats the start, position and heading.
    """

    arc: FloatArray
    xy: FloatArray
    heading: FloatArray
    curvature: FloatArray
    closed: bool

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.arc[-1])


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Where a robot is when.

    Attributes:
        timestamps: (n,) seconds of the frames, from 0.
        planar: (k, 3) x, y, heading at times (k,); outside the drive the robot stands still.
        driven: (n - 1,) whether the robot drove from a frame to the next, or was carried.
    """

    timestamps: FloatArray
    planar: Callable[[FloatArray], FloatArray]
    driven: BoolArray

    def body_poses(self, seconds: FloatArray) -> FloatArray:
        """(k, 4, 4) ``wTb`` in the room's frame: body x forward, y left, z up, on the floor."""
        return planar_poses(self.planar(seconds))


def planar_poses(planar: FloatArray) -> FloatArray:
    """(n, 4, 4) poses on the floor from (n, 3) x, y, heading."""
    out = np.zeros((len(planar), 4, 4))
    cosine, sine = np.cos(planar[:, 2]), np.sin(planar[:, 2])
    out[:, 0, 0] = out[:, 1, 1] = cosine
    out[:, 0, 1], out[:, 1, 0] = -sine, sine
    out[:, 2, 2] = out[:, 3, 3] = 1.0
    out[:, :2, 3] = planar[:, :2]
    return out


# --------------------------------------------------------------------------------------------
# Curves


def straights_and_turns(
    start: tuple[float, float, float], segments: Sequence[tuple[float, float]], closed: bool
) -> PlanarPath:
    """A curve of straights and turns whose curvature rises and falls smoothly.

    Args:
        start: x, y, heading.
        segments: (length in metres, turn in radians, counter-clockwise) of each.
        closed: whether the segments return to the start; the rounding error of the numerical
            integration is then spread over the curve.
    """
    arc, turned, curvature = [np.zeros(1)], [np.zeros(1)], [np.zeros(1)]
    for length, turn in segments:
        s = np.linspace(0.0, 1.0, max(int(np.ceil(length / _STEP_M)), 4) + 1)[1:]
        inward = np.minimum(s, 1.0 - s)
        ramp = np.minimum(inward, _RAMP)
        # The relative curvature, of mean 1, and its integral from the turn's start.
        relative = 0.5 * (1.0 - np.cos(np.pi * np.minimum(inward / _RAMP, 1.0))) / (1.0 - _RAMP)
        area = 0.5 * (ramp - _RAMP / np.pi * np.sin(np.pi * ramp / _RAMP))
        area += np.maximum(inward - _RAMP, 0.0)
        area /= 1.0 - _RAMP
        arc.append(arc[-1][-1] + length * s)
        turned.append(turned[-1][-1] + turn * np.where(s <= 0.5, area, 1.0 - area))
        curvature.append(turn / length * relative)
    arcs, heading = np.concatenate(arc), start[2] + np.concatenate(turned)
    middle = 0.5 * (heading[1:] + heading[:-1])
    step = np.diff(arcs)[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
    xy = np.vstack([[start[:2]], np.asarray(start[:2]) + np.cumsum(step, axis=0)])
    if closed:
        xy = xy - (arcs / arcs[-1])[:, None] * (xy[-1] - xy[0])
    return PlanarPath(arcs, xy, heading, np.concatenate(curvature), closed)


def through_waypoints(points: FloatArray, closed: bool) -> PlanarPath:
    """A twice differentiable curve through points (n, 2): a cubic spline over chord length.

    Raises:
        ConfigError: fewer than two distinct points (three for a closed curve), or points that
            turn back on themselves.
    """
    if closed and len(points):
        points = np.vstack([points, points[:1]])
    chord = np.linalg.norm(np.diff(points, axis=0), axis=1) if len(points) > 1 else np.empty(0)
    if len(points) < (4 if closed else 2) or np.any(chord < 1e-3):
        raise ConfigError(
            "drive.waypoints_m needs two or more points (three where closed), each at least 1 mm "
            "from the one before; add points to dataset.drive.waypoints_m"
        )
    knots = np.concatenate([[0.0], np.cumsum(chord)])
    spline = CubicSpline(knots, points, bc_type="periodic" if closed else "natural")
    t = np.linspace(0.0, knots[-1], max(int(np.ceil(knots[-1] / _STEP_M)), 8) + 1)
    xy, first, second = np.asarray(spline(t)), spline(t, 1), spline(t, 2)
    speed = np.maximum(np.linalg.norm(first, axis=1), 1e-9)
    arc = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))])
    heading = np.unwrap(np.arctan2(first[:, 1], first[:, 0]))
    curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
    # At a cusp the curvature is lost between two samples, but the heading leaps.
    leaps = np.abs(np.diff(heading, prepend=heading[0])) / _STEP_M
    sharpness = np.maximum(leaps, np.abs(curvature))
    tightest = int(np.argmax(sharpness))
    if sharpness[tightest] * _LEAST_RADIUS_M > 1.0:
        x, y = xy[tightest]
        raise ConfigError(
            f"dataset.drive.waypoints_m turn back too sharply near ({x:.2f}, {y:.2f}) m: the curve "
            f"has a radius below {_LEAST_RADIUS_M} m there; add points that lead around the turn"
        )
    return PlanarPath(arc, xy, heading, curvature, closed)


def round_corners(corners: FloatArray, bend_m: float) -> PlanarPath:
    """Straight from corner to corner (n, 2), each but the ends rounded by a smooth turn.

    Closed where the last corner is the first and the drive arrives there in its first heading.

    Args:
        corners: metres; at the ends the path begins and stops.
        bend_m: way over which a quarter turn is driven; other turns in proportion.

    Raises:
        ValueError: two corners are too near to each other for their turns.
    """
    edges = np.diff(corners, axis=0)
    heading = np.arctan2(edges[:, 1], edges[:, 0])
    turns = (np.diff(heading) + np.pi) % (2.0 * np.pi) - np.pi
    way = bend_m * np.abs(turns) / (0.5 * np.pi)
    cut = np.array([_bend_cut(w, t) for w, t in zip(way, turns, strict=True)])
    straight = np.linalg.norm(edges, axis=1)
    straight[1:] -= cut
    straight[:-1] -= cut
    if np.any(straight < 0.0):
        raise ValueError(f"corners {int(np.argmin(straight))} and the next are too near")
    segments = [(float(straight[0]), 0.0)]
    for k in range(len(turns)):
        segments += [(float(way[k]), float(turns[k])), (float(straight[k + 1]), 0.0)]
    back = np.exp(1j * heading[-1]), np.exp(1j * heading[0])
    closed = bool(np.allclose(corners[0], corners[-1]) and np.isclose(*back))
    start = (float(corners[0, 0]), float(corners[0, 1]), float(heading[0]))
    return straights_and_turns(start, [s for s in segments if s[0] > 0.0], closed)


def _bend_cut(way: float, turn: float) -> float:
    """How far before and after its corner a rounded turn begins and ends, metres."""
    if way == 0.0:
        return 0.0
    curve = straights_and_turns((0.0, 0.0, 0.0), [(way, turn)], closed=False)
    return float(np.linalg.norm(curve.xy[-1]) / (2.0 * np.cos(0.5 * turn)))


def paper_loop() -> PlanarPath:
    """Out along one side of the chair, around it and back to the start pose, 17.6 m.

    The robot gets 5.7 m ahead of its start, and turns through 360 degrees in all.
    """
    out, turn = (3.8, 0.0), (5.0, np.pi)
    return straights_and_turns((-1.9, -1.16, 0.0), [out, turn, out, turn], closed=True)


def room_laps(laps: int) -> PlanarPath:
    """``laps`` times around the room between the islands and the walls, 24.4 m each."""
    straight, turn = (3.6, 0.0), (2.5, np.pi / 2.0)
    lap = [straight, turn] * 4
    return straights_and_turns((-1.8, -3.3, 0.0), lap * laps, closed=True)


# --------------------------------------------------------------------------------------------
# Time


def fastest_times(
    path: PlanarPath, max_speed: float, max_turn: float, max_acceleration: float
) -> FloatArray:
    """(n,) seconds at a path's samples, driven from rest to rest as fast as three limits allow.

    Args:
        path: the curve.
        max_speed: metres a second.
        max_turn: radians a second.
        max_acceleration: metres a second squared, along the path.
    """
    limit = np.minimum(max_speed, max_turn / np.maximum(np.abs(path.curvature), 1e-9))
    squared = limit**2
    squared[0] = squared[-1] = 0.0
    gain = 2.0 * max_acceleration * np.diff(path.arc)
    for i in range(len(gain)):
        squared[i + 1] = min(squared[i + 1], squared[i] + gain[i])
    for i in range(len(gain) - 1, -1, -1):
        squared[i] = min(squared[i], squared[i + 1] + gain[i])
    speed = np.sqrt(squared)
    return np.concatenate([[0.0], np.cumsum(2.0 * np.diff(path.arc) / (speed[1:] + speed[:-1]))])


def drive_along(path: PlanarPath, limits: DriveLimits, frames: int | None) -> Drive:
    """A path, driven within limits in a number of frames; None: as fast as is comfortable.

    Raises:
        ConfigError: the path cannot be driven in so few frames.
    """
    rate, max_turn = FRAME_RATE_HZ, np.deg2rad(limits.max_turn_deg_s)
    fastest = fastest_times(path, limits.max_speed_m_s, max_turn, MAX_ACCELERATION_M_S2)
    least = int(np.ceil(fastest[-1] * rate - 1e-9)) + 1
    if frames is None:
        frames = int(np.ceil(fastest[-1] / _CRUISE * rate)) + 1
    if frames < least:
        raise ConfigError(
            f"dataset.drive.frames is {frames}, but this {path.length:.1f} m path takes at least "
            f"{least} frames within the speed limits; raise frames or leave it null"
        )
    times = fastest * ((frames - 1) / rate / fastest[-1])
    tangent = np.column_stack([np.cos(path.heading), np.sin(path.heading)])
    xy = CubicHermiteSpline(path.arc, path.xy, tangent)
    heading = CubicHermiteSpline(path.arc, path.heading, path.curvature)

    def planar(seconds: FloatArray) -> FloatArray:
        arc = np.interp(seconds, times, path.arc)
        out = np.column_stack([xy(arc), heading(arc)])
        if path.closed:
            out[arc >= path.length] = [*path.xy[0], path.heading[0]]
        return out

    return Drive(np.arange(frames) / rate, planar, np.ones(frames - 1, np.bool_))


# --------------------------------------------------------------------------------------------
# Wheel odometry: a stated drift model, sampled, with its exact covariance
#
# Of a true motion between two frames with way ``l`` and turn ``a`` the wheels report ``motion *
# Exp(xi)``, where ``xi`` [rotation, translation], tangent at the new body pose, is zero-mean noise,
# independent between frames, whose variances grow with ``l`` and ``|a|``, and two scale errors,
# drawn once a drive: a fraction of the distance and a fraction of the turn. The covariance stated
# with each increment is that of ``xi`` over all drives (noise and scale together). Truth has
# neither height, pitch nor roll; their noise is what an inertial unit would add.


_YAW, _ALONG = 2, 3
# Of the wheels: along the way, across it, and of the heading, each a root metre driven; and of the
# heading a root radian turned.
ALONG_M_SQRT_M, SIDEWAYS_M_SQRT_M, YAW_DEG_SQRT_M, YAW_DEG_SQRT_RAD = 0.02, 0.01, 0.5, 0.8
# What a planar robot does not drive: height, and pitch and roll, each a root metre; and the least
# noise of an increment, for that of a robot at rest must have a covariance that can be inverted.
HEIGHT_M_SQRT_M, TILT_DEG_SQRT_M = 0.002, 0.1
FLOOR_M, FLOOR_DEG = 1e-4, 0.01


def increment_variances(
    settings: WheelOdometrySettings, way: FloatArray, turn: FloatArray
) -> FloatArray:
    """Variances (n, 6) of the noise that is independent between frames.

    Args:
        settings: the drift model.
        way: (n,) metres driven in each increment.
        turn: (n,) radians turned.
    """
    out = np.empty((len(way), 6))
    tilt, yaw_m, yaw_rad = np.deg2rad(
        [TILT_DEG_SQRT_M, settings.noise * YAW_DEG_SQRT_M, settings.noise * YAW_DEG_SQRT_RAD]
    )
    out[:, :2] = (tilt**2 * way)[:, None]
    out[:, _YAW] = yaw_m**2 * way + yaw_rad**2 * np.abs(turn)
    noise = settings.noise
    sides = (noise * ALONG_M_SQRT_M, noise * SIDEWAYS_M_SQRT_M, HEIGHT_M_SQRT_M)
    out[:, 3:] = way[:, None] * np.square(sides)
    out[:, :3] += np.deg2rad(FLOOR_DEG) ** 2
    out[:, 3:] += FLOOR_M**2
    return out


def simulate_wheels(
    settings: WheelOdometrySettings, body_poses: FloatArray, rng: np.random.Generator
) -> list[Odometry]:
    """Odometry between consecutive body poses (n, 4, 4): n - 1 increments.

    Args:
        settings: the drift model.
        body_poses: true ``wTb``, planar.
        rng: source of the noise; one drive's worth is drawn.
    """
    motions = geometry.inverse(body_poses[:-1]) @ body_poses[1:]
    scale = rng.standard_normal(2) * settings.scale_error
    noise = rng.standard_normal((len(motions), 6))
    turn = np.arctan2(motions[:, 1, 0], motions[:, 0, 0])
    way = np.linalg.norm(motions[:, :3, 3], axis=1)
    variances = increment_variances(settings, way, turn)
    out = []
    for motion, angle, drawn, variance in zip(motions, turn, noise, variances, strict=True):
        # Tangent vectors at the new pose of a unit relative error of turn and of distance.
        by_turn, by_distance = np.zeros(6), np.zeros(6)
        by_turn[_YAW] = angle
        by_distance[_ALONG:] = motion[:3, :3].T @ motion[:3, 3]
        xi = drawn * np.sqrt(variance) + scale[0] * by_turn + scale[1] * by_distance
        covariance = (
            np.diag(variance)
            + settings.scale_error**2 * np.outer(by_turn, by_turn)
            + settings.scale_error**2 * np.outer(by_distance, by_distance)
        )
        out.append(Odometry(np.asarray(motion @ geometry.se3_exp(xi)), covariance))
    return out


# --------------------------------------------------------------------------------------------
# A wheelchair: a unicycle with limits, latency and slip, and a body that walls stop


_STEP_S = 0.01
# Of an electric wheelchair indoors: half a metre a second squared is what its passenger takes
# without holding on.
CHAIR_ACCELERATION_M_S2 = 0.5
CHAIR_TURN_ACCELERATION_DEG_S2 = 120.0
MAX_SPEED_M_S, MAX_TURN_DEG_S = 0.5, 45.0  # one that is driven slowly
# Deviations of what is drawn once a drive: relative errors of speed and of turns, and the turn a
# metre that was not commanded.
SPEED_SCALE, TURN_SCALE, PULL_DEG_M = 0.03, 0.03, 1.0
SLIP_M_SQRT_M, SLIP_DEG_SQRT_M = 0.02, 1.0
"""Noise along the way, metres, and of the heading, degrees, per root metre."""
LATENCY_S = 0.1
"""From a command to its effect."""
RADIUS_M = 0.35
"""Of the disc that must not touch anything; a door is twice as wide and a half."""

Blocked = Callable[[FloatArray], bool]
"""Whether the wheelchair, its middle at a place (2,), would touch something."""


class Wheelchair:
    """True motion under commands.

    Attributes:
        pose: (3,) true planar pose.
        speed, turn_rate: as the wheels turn now, before slip; m/s and rad/s.
        time: seconds since the start.
        collided: whether an obstacle stopped it in the last :meth:`advance`.
    """

    def __init__(
        self, pose: FloatArray, rng: np.random.Generator, blocked: Blocked | None = None
    ) -> None:
        """Stands still at ``pose``; the errors of this drive are drawn from ``rng``."""
        self._rng = rng
        self._blocked: Blocked = blocked or (lambda _place: False)
        self.pose = np.array(pose, dtype=np.float64)
        self.speed, self.turn_rate, self.time = 0.0, 0.0, 0.0
        self.collided = False
        drawn = rng.standard_normal(3)
        self._speed_scale = 1.0 + SPEED_SCALE * drawn[0]
        self._turn_scale = 1.0 + TURN_SCALE * drawn[1]
        self._pull = np.deg2rad(PULL_DEG_M) * drawn[2]
        self._pending: deque[tuple[float, float, float]] = deque()
        self._aim = (0.0, 0.0)
        self._steps, self._asked = 0, 0.0

    def command(self, speed: float, turn_rate: float) -> None:
        """Asks for a speed (m/s) and turn rate (rad/s); it takes effect after the latency.

        Raises:
            ValueError: a number is not finite.
        """
        if not (np.isfinite(speed) and np.isfinite(turn_rate)):
            raise ValueError(f"command ({speed}, {turn_rate}) is not finite")
        top = np.deg2rad(MAX_TURN_DEG_S)
        limited = float(np.clip(speed, -MAX_SPEED_M_S, MAX_SPEED_M_S))
        turn = float(np.clip(turn_rate, -top, top))
        self._pending.append((self.time + LATENCY_S, limited, turn))

    def advance(self, seconds: float) -> None:
        """Moves on, in steps of a hundredth of a second; what is left over is made up for later.

        Raises:
            ValueError: the time does not go forwards.
        """
        if not seconds > 0.0:
            raise ValueError(f"time must go forwards, got a step of {seconds} s")
        touched = False
        self._asked += seconds
        for _ in range(round(self._asked / _STEP_S) - self._steps):
            touched |= self._step()
        self.collided = touched

    def _step(self) -> bool:
        while self._pending and self._pending[0][0] <= self.time + 1e-9:
            self._aim = self._pending.popleft()[1:]
        gain = CHAIR_ACCELERATION_M_S2 * _STEP_S
        turn_gain = np.deg2rad(CHAIR_TURN_ACCELERATION_DEG_S2) * _STEP_S
        self.speed += float(np.clip(self._aim[0] - self.speed, -gain, gain))
        self.turn_rate += float(np.clip(self._aim[1] - self.turn_rate, -turn_gain, turn_gain))
        self._steps += 1
        self.time = self._steps * _STEP_S
        wheels, noise = self.speed * _STEP_S, self._rng.standard_normal(2)
        root = np.sqrt(abs(wheels))  # of the way, which slip and drift grow with
        way = wheels * self._speed_scale + SLIP_M_SQRT_M * root * noise[0]
        drift = self._pull * abs(wheels) + np.deg2rad(SLIP_DEG_SQRT_M) * root * noise[1]
        turn = self.turn_rate * _STEP_S * self._turn_scale + drift
        middle = self.pose[2] + 0.5 * turn
        place = self.pose[:2] + way * np.array([np.cos(middle), np.sin(middle)])
        self.pose[2] = wrap(self.pose[2] + turn)
        if way != 0.0 and self._blocked(place):
            self.speed = 0.0
            return True
        self.pose[:2] = place
        return False


# --------------------------------------------------------------------------------------------
# Range finders


BEAMS = 32
"""Evenly spread, the first ahead: as many as the sonars below the paper's obstacle avoidance."""
MAX_RANGE_M = 5.0
NOISE_M = 0.02
_HEIGHTS_M = (0.15, 0.45, 0.72, 1.0)  # of chair legs, seats, table tops and shelves


class RangeSensor:
    """Measures how far things are, from the wheelchair's middle.

    A beam reports the nearest of what it meets at several heights, so that table tops are seen.
    """

    def __init__(self, caster: RayCaster, noise_m: float = NOISE_M) -> None:
        """Scans the scene of ``caster``; ``noise_m`` is the standard deviation of a range."""
        self._caster, self._noise_m = caster, noise_m
        angle = 2.0 * np.pi * np.arange(BEAMS) / BEAMS
        self.angles: FloatArray = wrap(angle)

    def scan(
        self, pose: FloatArray, discs: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Angles (n,) in the robot's axes, radians, and ranges (n,), metres.

        A range of ``MAX_RANGE_M`` means that nothing was seen.

        Args:
            pose: (3,) true pose.
            discs: (k, 3) x, y and radius of people.
            rng: of the noise.
        """
        direction = unit(self.angles + pose[2])
        rays = np.column_stack([direction, np.zeros(BEAMS)]).astype(np.float32)
        ranges = np.full(BEAMS, np.inf)
        for height in _HEIGHTS_M:
            _, distance = self._caster.cast(np.array([pose[0], pose[1], height]), rays)
            ranges = np.minimum(ranges, distance)
        for x, y, radius in discs:  # upright cylinders; 0 inside one
            offset = np.array([x, y]) - pose[:2]
            along = direction @ offset
            aside2 = np.sum(offset * offset) - along**2
            hit = (aside2 < radius**2) & (along > 0.0)
            distance = np.maximum(along - np.sqrt(np.maximum(radius**2 - aside2, 0.0)), 0.0)
            ranges = np.where(hit, np.minimum(ranges, distance), ranges)
        seen = ranges < MAX_RANGE_M
        noise = self._noise_m * rng.standard_normal(BEAMS)
        noisy = np.clip(ranges + noise, 0.0, MAX_RANGE_M)
        return self.angles.copy(), np.where(seen, noisy, MAX_RANGE_M)
