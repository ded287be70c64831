"""Smooth planar paths and the time law that keeps a robot within its speed limits.

Paths are functions of arc length in the room's frame: x east, y north, metres from the room's
centre; the heading is counter-clockwise from x, in radians.
"""

from __future__ import annotations

from collections.abc import Sequence as Seq
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import ConfigError
from fgslam.worlds.settings import DriveLimits

_STEP_M = 0.004
# Waypoints must not ask for tighter turns: the curve's heading would jump between its samples.
_LEAST_RADIUS_M = 0.08
# Part of a turn over which its curvature rises, and again falls.
_RAMP = 0.3
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
class TimeLaw:
    """Arc length as a function of time: the pairs (seconds, metres), both increasing."""

    seconds: FloatArray
    arc: FloatArray

    @property
    def duration(self) -> float:
        """Seconds."""
        return float(self.seconds[-1])


class PosesInTime(Protocol):
    """Where a robot is when: a drive, or poses without one.

    Attributes:
        timestamps: (n,) seconds of the frames, from 0.
    """

    timestamps: FloatArray

    @property
    def driven(self) -> BoolArray:
        """(n - 1,) whether the robot drove from a frame to the next."""
        ...

    def body_poses(self, seconds: FloatArray) -> FloatArray:
        """(n, 4, 4) ``wTb`` in the room's frame: body x forward, y left, z up, on the floor."""
        ...


class Drive:
    """A path driven by a time law, asked for poses at any time."""

    def __init__(self, path: PlanarPath, law: TimeLaw, timestamps: FloatArray) -> None:
        self.path = path
        self.law = law
        self.timestamps = timestamps
        tangent = np.column_stack([np.cos(path.heading), np.sin(path.heading)])
        self._xy = CubicHermiteSpline(path.arc, path.xy, tangent)
        self._heading = CubicHermiteSpline(path.arc, path.heading, path.curvature)

    def planar(self, seconds: FloatArray) -> FloatArray:
        """(n, 3) x, y, heading at the given times; outside the drive the robot stands still."""
        arc = np.interp(seconds, self.law.seconds, self.law.arc)
        out = np.column_stack([self._xy(arc), self._heading(arc)])
        if self.path.closed:
            at_end = arc >= self.path.length
            out[at_end] = [*self.path.xy[0], self.path.heading[0]]
        return out

    def body_poses(self, seconds: FloatArray) -> FloatArray:
        """(n, 4, 4) ``wTb`` in the room's frame: body x forward, y left, z up, on the floor."""
        return planar_poses(self.planar(seconds))

    @property
    def driven(self) -> BoolArray:
        """(n - 1,) whether the robot drove from a frame to the next: always."""
        return np.ones(len(self.timestamps) - 1, np.bool_)


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
    start: tuple[float, float, float], segments: Seq[tuple[float, float]], closed: bool
) -> PlanarPath:
    """A curve of straights and turns whose curvature rises and falls smoothly.

    Args:
        start: x, y, heading.
        segments: (length in metres, turn in radians, counter-clockwise) of each.
        closed: whether the segments return to the start; the rounding error of the numerical
            integration is then spread over the curve.
    """
    arcs, turned, curvature = _integrate_heading(segments)
    heading = start[2] + turned
    middle = 0.5 * (heading[1:] + heading[:-1])
    step = np.diff(arcs)[:, None] * np.column_stack([np.cos(middle), np.sin(middle)])
    xy = np.vstack([[start[:2]], np.asarray(start[:2]) + np.cumsum(step, axis=0)])
    if closed:
        xy = xy - (arcs / arcs[-1])[:, None] * (xy[-1] - xy[0])
    return PlanarPath(arcs, xy, heading, curvature, closed)


def _integrate_heading(
    segments: Seq[tuple[float, float]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Arc length, angle turned and curvature along the segments, in closed form."""
    arcs, turned, curvature = [np.zeros(1)], [np.zeros(1)], [np.zeros(1)]
    for length, turn in segments:
        s = np.linspace(0.0, 1.0, max(int(np.ceil(length / _STEP_M)), 4) + 1)[1:]
        arcs.append(arcs[-1][-1] + length * s)
        turned.append(turned[-1][-1] + turn * _turned_fraction(s))
        curvature.append(turn / length * _relative_curvature(s))
    return np.concatenate(arcs), np.concatenate(turned), np.concatenate(curvature)


def _relative_curvature(s: FloatArray) -> FloatArray:
    """Curvature at the fraction ``s`` of a turn, its mean being 1: rises, stays, and falls."""
    inward = np.minimum(s, 1.0 - s)
    ramp = 0.5 * (1.0 - np.cos(np.pi * np.minimum(inward / _RAMP, 1.0)))
    return np.asarray(ramp / (1.0 - _RAMP))


def _turned_fraction(s: FloatArray) -> FloatArray:
    """Integral of the relative curvature from 0 to ``s``."""
    inward = np.minimum(s, 1.0 - s)
    ramp = np.minimum(inward, _RAMP)
    area = 0.5 * (ramp - _RAMP / np.pi * np.sin(np.pi * ramp / _RAMP))
    area += np.maximum(inward - _RAMP, 0.0)
    area /= 1.0 - _RAMP
    return np.asarray(np.where(s <= 0.5, area, 1.0 - area))


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
    first, second = spline(t, 1), spline(t, 2)
    speed = np.maximum(np.linalg.norm(first, axis=1), 1e-9)
    arc = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))])
    heading = np.unwrap(np.arctan2(first[:, 1], first[:, 0]))
    curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
    _refuse_tight_turns(np.asarray(spline(t)), heading, curvature)
    return PlanarPath(arc, np.asarray(spline(t)), heading, curvature, closed)


def _refuse_tight_turns(xy: FloatArray, heading: FloatArray, curvature: FloatArray) -> None:
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


def round_corners(corners: FloatArray, bend_m: float) -> PlanarPath:
    """Straight from corner to corner (n, 2), each but the ends rounded by a smooth bend.

    Closed where the last corner is the first and the drive arrives there in its first heading.

    Args:
        corners: metres; at the ends the path begins and stops.
        bend_m: way over which a quarter turn is driven; other turns in proportion.

    Raises:
        ValueError: two corners are too near to each other for their bends.
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
        bend = [(float(way[k]), float(turns[k]))] if way[k] > 0.0 else []
        segments += [*bend, (float(straight[k + 1]), 0.0)]
    back = np.exp(1j * heading[-1]), np.exp(1j * heading[0])
    closed = bool(np.allclose(corners[0], corners[-1]) and np.isclose(*back))
    start = (float(corners[0, 0]), float(corners[0, 1]), float(heading[0]))
    return straights_and_turns(start, [s for s in segments if s[0] > 0.0], closed)


def _bend_cut(way: float, turn: float) -> float:
    """How far before and after its corner a bend begins and ends, metres."""
    if way == 0.0:
        return 0.0
    bend = straights_and_turns((0.0, 0.0, 0.0), [(way, turn)], closed=False)
    return float(np.linalg.norm(bend.xy[-1]) / (2.0 * np.cos(0.5 * turn)))


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


def fastest_law(
    path: PlanarPath, max_speed: float, max_turn: float, max_acceleration: float
) -> TimeLaw:
    """The quickest way along a path from rest to rest within three limits.

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
    seconds = 2.0 * np.diff(path.arc) / (speed[1:] + speed[:-1])
    return TimeLaw(np.concatenate([[0.0], np.cumsum(seconds)]), path.arc)


def drive_along(path: PlanarPath, limits: DriveLimits, frames: int | None) -> Drive:
    """A path, driven within limits in a number of frames; None: as fast as is comfortable.

    Raises:
        ConfigError: the path cannot be driven in so few frames.
    """
    law = fastest_law(
        path,
        limits.max_speed_m_s,
        np.deg2rad(limits.max_turn_deg_s),
        MAX_ACCELERATION_M_S2,
    )
    rate = limits.frame_rate_hz
    least = int(np.ceil(law.duration * rate - 1e-9)) + 1
    if frames is None:
        frames = int(np.ceil(law.duration / _CRUISE * rate)) + 1
    if frames < least:
        raise ConfigError(
            f"dataset.drive.frames is {frames}, but this {path.length:.1f} m path takes at least "
            f"{least} frames within the speed limits; raise frames or leave it null"
        )
    duration = (frames - 1) / rate
    slower = TimeLaw(law.seconds * (duration / law.duration), law.arc)
    return Drive(path, slower, np.arange(frames) / rate)
