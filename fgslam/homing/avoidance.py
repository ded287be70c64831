"""The lower layer that may override the steering: obstacles in a range scan (IV).

It is kept apart from homing, as in the paper: homing says where home is, this says how to get past
what stands in the way, and the next image corrects the rest.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import wrap
from fgslam.homing.command import Drive
from fgslam.homing.settings import AvoidanceSettings

_ESCAPE_MPS = 0.25  # speed on the way out
_ESCAPE_M = 1.2  # ways longer than this are equally good ways out
_ESCAPE_STEPS = 20  # steps of driving along it; 2 s at 10 a second
_ESCAPE_AFTER = 20  # steps held up until a way out is taken; 2 s at 10 a second
_GAIN_PER_S = 2.0  # turning rate over the chosen direction
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


class ObstacleAvoider(Protocol):
    """Looks at what the steering wants and at the scan, and has the last word."""

    def override(self, wanted: Drive, heading: float, scan: RangeScan) -> Drive:
        """What is driven in the end.

        Args:
            wanted: by the steering.
            heading: direction of home, radians.
            scan: taken just now.
        """
        ...


class NoAvoidance:
    """For robots without a range sensor: the steering is obeyed."""

    def override(self, wanted: Drive, heading: float, scan: RangeScan) -> Drive:
        """``wanted`` itself."""
        return wanted


class CorridorAvoidance:
    """Drives along the free corridor that is nearest to home's direction.

    A vector field histogram (Borenstein and Koren 1991) with the robot's width taken in exactly: a
    direction's clear way is the distance to the first scan point within a corridor of the
    robot's width, and it is free if that is longer than the look-ahead, which grows with
    speed. Home's own direction is taken whenever it is free: then nothing is overridden except that
    the speed is bounded by the clear way.

    Corridors end in corners. Where the robot has been held up for a while it drives a bit along the
    longest way that its bare body fits through, wherever that leads, and looks for corridors again.
    """

    def __init__(self, settings: AvoidanceSettings) -> None:
        self._settings = settings
        step = 2.0 * np.pi / _DIRECTIONS
        self._directions: FloatArray = -np.pi + step * np.arange(_DIRECTIONS, dtype=float)
        self._chosen: float | None = None
        self._held_up = 0.0  # steps in which the robot was not let drive
        self._escaping = 0  # steps that are left of a way out

    def override(self, wanted: Drive, heading: float, scan: RangeScan) -> Drive:
        """See :class:`ObstacleAvoider`."""
        if self._escaping > 0:
            self._escaping -= 1
            return self._escape(wanted, _points(scan))
        driven = self._in_corridor(wanted, heading, scan)
        stands = driven.overridden and driven.speed < _STANDING
        self._held_up = self._held_up + self._impatience() if stands else 0.0
        if self._held_up >= _ESCAPE_AFTER:
            self._held_up, self._chosen = 0.0, None
            self._escaping = _ESCAPE_STEPS
        return driven

    def _impatience(self) -> float:
        """What a step at a stand counts: turning towards a way takes its time."""
        faces = self._chosen is None or abs(self._chosen) <= _AHEAD
        return 1.0 if faces else _TURNING

    def _escape(self, wanted: Drive, points: FloatArray) -> Drive:
        s = self._settings
        ways = clear_ways(self._directions, points, s.body_m)
        # Of ways that are long enough the one that needs the least turning.
        worth = np.minimum(ways, _ESCAPE_M) - 0.1 * np.abs(self._directions)
        direction = float(self._directions[int(np.argmax(worth))])
        limit = np.deg2rad(s.max_turn_deg_s)
        rate = float(np.clip(_GAIN_PER_S * direction, -limit, limit))
        if abs(direction) > _AHEAD:
            self._escaping += 1  # turning does not count
            return Drive(0.0, rate, True)
        way = float(clear_ways(np.zeros(1), points, s.body_m)[0])
        return Drive(min(_ESCAPE_MPS, _BRAKE * max(way, 0.0)), rate, True)

    def _in_corridor(self, wanted: Drive, heading: float, scan: RangeScan) -> Drive:
        if wanted.speed <= 0.0 and self._chosen is None:
            return wanted  # turning on the spot endangers nobody
        s = self._settings
        points = _points(scan)
        needed = s.look_ahead_m + s.look_ahead_s * max(wanted.speed, 0.0)
        if clear_ways(np.array([heading]), points, s.half_width_m)[0] >= needed:
            self._chosen = None
            return self._slowed(wanted, points)
        self._chosen = self._choose(heading, points, needed)
        return self._drive(wanted, self._chosen, points)

    def _choose(self, heading: float, points: FloatArray, needed: float) -> float:
        """The best free direction; none being free, the one with the longest clear way."""
        ways = clear_ways(self._directions, points, self._settings.half_width_m)
        free = ways >= needed
        if not free.any():
            return float(self._directions[int(np.argmax(ways))])
        cost = np.abs(wrap(self._directions - heading))
        if self._chosen is not None:
            kept = np.abs(wrap(self._directions - self._chosen))
            cost = cost + _KEEP_WEIGHT * kept
        return float(self._directions[int(np.argmin(np.where(free, cost, np.inf)))])

    def _drive(self, wanted: Drive, direction: float, points: FloatArray) -> Drive:
        s = self._settings
        limit = np.deg2rad(s.max_turn_deg_s)
        rate = float(np.clip(_GAIN_PER_S * direction, -limit, limit))
        if abs(direction) > _AHEAD:
            return Drive(0.0, rate, True)
        slowed = self._slowed(Drive(wanted.speed, rate, True), points)
        return Drive(slowed.speed * float(np.cos(direction)), rate, True)

    def _slowed(self, drive: Drive, points: FloatArray) -> Drive:
        """No faster than the clear way straight ahead allows."""
        way = clear_ways(np.zeros(1), points, self._settings.half_width_m)[0]
        most = _BRAKE * max(float(way), 0.0)
        if drive.speed <= most:
            return drive
        return Drive(most, drive.turn_rate, True)


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


def _points(scan: RangeScan) -> FloatArray:
    """(n, 2) of the beams that hit something."""
    hit = np.isfinite(scan.ranges)
    r, a = np.asarray(scan.ranges)[hit], np.asarray(scan.angles)[hit]
    return np.column_stack([r * np.cos(a), r * np.sin(a)])


def make_avoider(settings: AvoidanceSettings) -> ObstacleAvoider:
    """The avoider that the settings name."""
    return NoAvoidance() if settings.method == "none" else CorridorAvoidance(settings)
