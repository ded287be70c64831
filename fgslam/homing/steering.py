"""From the direction of home to the wheels of a unicycle; obstacle avoidance may override it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import Refusal, TwoViewVector
from fgslam.core.geometry import wrap
from fgslam.homing.settings import SteeringSettings

ACCELERATION_MPS2, TURN_ACCELERATION_DEG_S2 = 0.5, 120.0
"""Largest changes of speed and of the turning rate: what a passenger takes without holding on."""

TURN_IN_PLACE_DEG = 60.0
"""Home farther off than this: turn without driving, until it is within half of it."""

_STEERING_GAIN_PER_S = 1.2
"""Turning rate over the direction of home; slow against the delay of 0.1 s between image and
wheels."""

BLIND_SHARE = 0.4  # of the speed, without tracks
PASSING_SHARE = 0.6  # of the speed, at targets on the way
_LEAST_SHARE = 0.25  # of the speed, at the last target
SLOW_FRACTION = 0.3  # part of the leg that is left from which on the robot slows down

_BEHIND = np.deg2rad(150.0)  # from here on both ways round are as long; noise must not choose


class Steering:
    """Proportional steering with limits on rates and on their change.

    Speed follows the cosine of home's direction, so that the robot drives arcs where home is
    nearly ahead and turns on the spot where it is not. It slows down towards the last target;
    between targets less, for a smooth way (IV: "a smooth trajectory").
    """

    def __init__(self, settings: SteeringSettings) -> None:
        self._settings = settings
        self._speed, self._turn_rate = 0.0, 0.0
        self._turning = False

    def step(self, command: Command, dt: float) -> Drive:
        """Speed and turning rate for the next ``dt`` seconds."""
        speed, rate, heading = 0.0, 0.0, command.heading
        if command.stop:
            self._turning = False
        else:
            around = heading
            if abs(heading) > _BEHIND and self._turn_rate != 0.0:
                around = float(np.copysign(heading, self._turn_rate))
            limit = np.deg2rad(self._settings.max_turn_deg_s)
            rate = float(np.clip(_STEERING_GAIN_PER_S * around, -limit, limit))
            # Two thresholds: with one, noise would switch between turning and driving.
            in_place = np.deg2rad(TURN_IN_PLACE_DEG)
            self._turning = abs(heading) > (0.5 * in_place if self._turning else in_place)
            if not self._turning:
                ahead = max(float(np.cos(heading)), 0.0)
                speed = self._settings.max_speed_mps * ahead * _speed_share(command)
        faster = ACCELERATION_MPS2 * dt
        self._speed += float(np.clip(speed - self._speed, -faster, faster))
        most = np.deg2rad(TURN_ACCELERATION_DEG_S2) * dt
        self._turn_rate += float(np.clip(rate - self._turn_rate, -most, most))
        return Drive(self._speed, self._turn_rate)

    def driven(self, drive: Drive) -> None:
        """What was commanded in the end, where avoidance overrode: limits start from there."""
        self._speed, self._turn_rate = drive.speed, drive.turn_rate


def _speed_share(command: Command) -> float:
    """Part of the largest speed that a command's state and its distance to the target allow."""
    if command.state in (HomingState.BLIND, HomingState.SEARCH):
        return BLIND_SHARE
    least = _LEAST_SHARE if command.final else PASSING_SHARE
    return float(np.clip(command.remaining / SLOW_FRACTION, least, 1.0))


# --------------------------------------------------------------------------------------------
# The lower layer that may override the steering: obstacles in a range scan (IV). It is kept apart
# from homing, as in the paper: homing finds where home is, this how to get past what stands in the
# way, and the next image corrects the rest.


_HALF_WIDTH_M = 0.42  # half the corridor needed: the robot's radius and a margin
_BODY_M = 0.37  # half width of the bare robot, for ways out of corners
_ESCAPE_MPS = 0.25  # speed on the way out
_ESCAPE_M = 1.2  # ways longer than this are equally good ways out
_ESCAPE_STEPS = 20  # steps of driving along it; 2 s at 10 a second
ESCAPE_AFTER = 20  # steps held up until a way out is taken; 2 s at 10 a second
_LOOK_AHEAD_M = 0.6  # length of the corridor that must be free, from standing
_LOOK_AHEAD_S = 1.5  # what comes on top at speed, in seconds of driving
_AVOIDING_GAIN_PER_S = 2.0  # turning rate over the chosen direction
_KEEP_WEIGHT = 0.5  # weight of staying with the last choice, against turning towards home
_DIRECTIONS = 72  # corridors that are looked at, all around

_AHEAD = np.deg2rad(45.0)  # farther off than this: turn on the spot
_BRAKE = 0.5  # part of the speed at which the clear way is driven in a second
_TURNING = 1.0 / 3.0  # an about-face of five seconds is a third as bad as being blocked
_STANDING = 0.02  # m/s; slower is no driving


class RangeScan(NamedTuple):
    """A planar scan around the robot.

    Attributes:
        angles: (n,) bearings of the beams, radians.
        ranges: (n,) metres; infinite, or the sensor's range, where there is nothing. NaN where a
            beam failed.
    """

    angles: FloatArray
    ranges: FloatArray


class CorridorAvoidance:
    """Drives along the free corridor that is nearest to home's direction.

    A vector field histogram (Borenstein and Koren 1991) with the robot's width taken in exactly: a
    direction's clear way is the distance to the first scan point within a corridor of the
    robot's width, and it is free if that is longer than the look-ahead, which grows with
    speed. Home's own direction is taken whenever it is free: then nothing is overridden except that
    the speed is bounded by the clear way.

    Corridors end in corners. Where the robot has been held up for a while it drives a bit along the
    longest way that its bare body fits through, wherever that leads, and searches corridors again.
    """

    def __init__(self, max_turn_deg_s: float) -> None:
        """``max_turn_deg_s`` is the robot's largest turning rate."""
        self._limit = np.deg2rad(max_turn_deg_s)
        step = 2.0 * np.pi / _DIRECTIONS
        self._directions: FloatArray = -np.pi + step * np.arange(_DIRECTIONS, dtype=float)
        self._chosen: float | None = None
        self._held_up = 0.0  # steps in which the robot was not let drive
        self._escaping = 0  # steps that are left of a way out

    def override(self, wanted: Drive, heading: float, scan: RangeScan) -> Drive:
        """What is driven in the end.

        Args:
            wanted: by the steering.
            heading: direction of home, radians.
            scan: taken just now.
        """
        hit = np.isfinite(scan.ranges)
        r, a = np.asarray(scan.ranges)[hit], np.asarray(scan.angles)[hit]
        points = np.column_stack([r * np.cos(a), r * np.sin(a)])
        if self._escaping > 0:
            self._escaping -= 1
            return self._escape(points)
        driven = self._in_corridor(wanted, heading, points)
        stands = driven.overridden and driven.speed < _STANDING
        # Turning towards a way takes its time.
        faces = self._chosen is None or abs(self._chosen) <= _AHEAD
        step = 1.0 if faces else _TURNING
        self._held_up = self._held_up + step if stands else 0.0
        if self._held_up >= ESCAPE_AFTER:
            self._held_up, self._chosen = 0.0, None
            self._escaping = _ESCAPE_STEPS
        return driven

    def _escape(self, points: FloatArray) -> Drive:
        ways = clear_ways(self._directions, points, _BODY_M)
        # Of ways that are long enough the one that needs the least turning.
        worth = np.minimum(ways, _ESCAPE_M) - 0.1 * np.abs(self._directions)
        direction = float(self._directions[int(np.argmax(worth))])
        rate = float(np.clip(_AVOIDING_GAIN_PER_S * direction, -self._limit, self._limit))
        if abs(direction) > _AHEAD:
            self._escaping += 1  # turning does not count
            return Drive(0.0, rate, True)
        return Drive(min(_ESCAPE_MPS, _most_speed(points, _BODY_M)), rate, True)

    def _in_corridor(self, wanted: Drive, heading: float, points: FloatArray) -> Drive:
        if wanted.speed <= 0.0 and self._chosen is None:
            return wanted  # turning on the spot is safe
        needed = _LOOK_AHEAD_M + _LOOK_AHEAD_S * max(wanted.speed, 0.0)
        if clear_ways(np.array([heading]), points, _HALF_WIDTH_M)[0] >= needed:
            self._chosen = None
            most = _most_speed(points, _HALF_WIDTH_M)
            return wanted if wanted.speed <= most else Drive(most, wanted.turn_rate, True)
        direction = self._chosen = self._choose(heading, points, needed)
        rate = float(np.clip(_AVOIDING_GAIN_PER_S * direction, -self._limit, self._limit))
        if abs(direction) > _AHEAD:
            return Drive(0.0, rate, True)
        speed = min(wanted.speed, _most_speed(points, _HALF_WIDTH_M))
        return Drive(speed * float(np.cos(direction)), rate, True)

    def _choose(self, heading: float, points: FloatArray, needed: float) -> float:
        """The best free direction; none being free, the one with the longest clear way."""
        ways = clear_ways(self._directions, points, _HALF_WIDTH_M)
        free = ways >= needed
        if not free.any():
            return float(self._directions[int(np.argmax(ways))])
        cost = np.abs(wrap(self._directions - heading))
        if self._chosen is not None:
            kept = np.abs(wrap(self._directions - self._chosen))
            cost = cost + _KEEP_WEIGHT * kept
        return float(self._directions[int(np.argmin(np.where(free, cost, np.inf)))])


def _most_speed(points: FloatArray, half_width: float) -> float:
    """Speed that the clear way straight ahead allows, m/s."""
    way = clear_ways(np.zeros(1), points, half_width)[0]
    return _BRAKE * max(float(way), 0.0)


def clear_ways(directions: FloatArray, points: FloatArray, half_width: float) -> FloatArray:
    """(k,) metres that a robot of this half width can drive along each direction (k,).

    Args:
        directions: radians from the robot's heading.
        points: (n, 2) obstacles in its axes.
        half_width: metres; the robot's front is a half circle of this radius.

    Returns:
        Up to where the robot would touch a point; infinite where there is none in the corridor,
        0 where a point is inside the robot already and lies ahead.
    """
    along = np.cos(directions)[:, None] * points[:, 0] + np.sin(directions)[:, None] * points[:, 1]
    across = np.cos(directions)[:, None] * points[:, 1] - np.sin(directions)[:, None] * points[:, 0]
    hit = (along > 0.0) & (np.abs(across) < half_width)
    front = np.sqrt(np.maximum(half_width**2 - across**2, 0.0))
    way = np.where(hit, np.maximum(along - front, 0.0), np.inf)
    return np.asarray(way.min(axis=1, initial=np.inf))


# --------------------------------------------------------------------------------------------
# What a homing commands after every image


SURE = 0.9  # probability from which a place on a path counts as known


class HomingState(str, Enum):
    """Where a homing stands; the value is written into files."""

    INITIALISE = "initialise"
    """Standing: the target is not matched yet."""
    DRIVE = "drive"
    CONFIRM = "confirm"
    """Standing: a new homing vector contradicts the estimate."""
    BLIND = "blind"
    """Slowly straight on: there are no tracks, and the target is not matched again yet."""
    WAIT = "wait"
    """Standing: the same, after the longest blind drive."""
    SEARCH = "search"
    """Slowly straight on: where it stood the target was refused, from elsewhere it may not be."""
    ARRIVED = "arrived"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """The interface to what drives the robot.

    Attributes:
        time: of the image, seconds.
        state: of the homing.
        reason: one clause: why the state is what it is.
        heading: direction of home from the robot's heading, radians; 0 where it is not known.
        remaining: part of the leg that is left: 1 where it began; its last known value while
            there is no estimate.
        rotation: heading of the target minus the present one, radians; NaN while not known.
        covariance: (3, 3) of (remaining, heading, rotation); NaN while there is no estimate.
        stop: the robot must stand.
        target: number of the target image.
        final: it is the path's last one.
        refusal: why the homing ended, in state REFUSED.
    """

    time: float
    state: HomingState
    reason: str
    heading: float = 0.0
    remaining: float = 1.0
    rotation: float = math.nan
    covariance: FloatArray = field(default_factory=lambda: np.full((3, 3), np.nan))
    stop: bool = True
    target: int = 0
    final: bool = True
    refusal: Refusal | None = None


@dataclass(frozen=True, slots=True)
class Drive:
    """Speed (m/s) and turning rate (rad/s, counter-clockwise); whether avoidance changed them."""

    speed: float
    turn_rate: float
    overridden: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MetricPlace:
    """Where that is in metres, on a path whose images carry poses.

    Attributes:
        position: (3,) in the world of these poses, on the straight line between two path images.
        sigma: of it along the path and as the poses are known, metres.
        to_target: metres to the next path image.
    """

    position: FloatArray
    sigma: float
    to_target: float


@dataclass(frozen=True, slots=True, eq=False)
class PathPlace:
    """Where on a path one image was taken.

    Attributes:
        nearest: number of the path image that is probably the nearest one.
        probability: that it, or the one before or after it, is.
        target: number of the path image to go to next.
        vector: from the image to the target; None where it is refused.
        refusal: why, in words; empty where there is a vector.
        remaining: part of the way between path images that is left, roughly: by parallax.
        reached: the path's end is.
        metric: the same in metres; None where it is not known.
    """

    nearest: int
    probability: float
    target: int
    vector: TwoViewVector | None
    refusal: str
    remaining: float
    reached: bool
    metric: MetricPlace | None = None

    @property
    def sure(self) -> bool:
        """Whether the place is known."""
        return self.probability >= SURE


@dataclass(frozen=True, slots=True, eq=False)
class DriveCommand:
    """Speed and turning rate commanded after one image.

    Attributes:
        v: speed, m/s, forward.
        omega: turning rate, rad/s, counter-clockwise.
        homing: where home is and how sure that is; the properties below are of it.
        place: where on the path the image was taken; None where that was not looked for.
    """

    v: float
    omega: float
    homing: Command
    place: PathPlace | None = None

    @property
    def time(self) -> float:
        """Of the image, seconds."""
        return self.homing.time

    @property
    def state(self) -> HomingState:
        """Of the homing."""
        return self.homing.state

    @property
    def reason(self) -> str:
        """One clause: why the state is what it is."""
        return self.homing.reason

    @property
    def target(self) -> int:
        """Number of the target image that is aimed at, from 0."""
        return self.homing.target

    @property
    def heading(self) -> float:
        """Direction of home from the robot's heading, radians, counter-clockwise."""
        return self.homing.heading

    @property
    def remaining(self) -> float:
        """Part of the leg that is left: 1 where it began."""
        return self.homing.remaining
