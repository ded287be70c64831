"""The loop: image, homing, steering, avoidance, motion; and the record of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol, TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, student_quantile
from fgslam.core.bearings import HomingEstimate, HomingStart, TrackedBearings
from fgslam.core.geometry import wrap
from fgslam.homing.active import ActiveHoming
from fgslam.homing.controller import HomingChain, LegOutcome
from fgslam.homing.settings import ClosedLoopSettings
from fgslam.homing.steering import Command, CorridorAvoidance, Drive, RangeScan, Steering


class World(Protocol):
    """The robot and its surroundings, simulated or real."""

    @property
    def true_pose(self) -> FloatArray:
        """(3,) planar pose; NaN where it is not known."""
        ...

    def image(self, time: float) -> ByteArray:
        """(h, w, 3) what the camera sees now."""
        ...

    def scan(self) -> tuple[FloatArray, FloatArray]:
        """Angles and ranges (n,) of the range sensor, in the robot's axes."""
        ...

    def drive(self, speed: float, turn_rate: float, dt: float) -> object:
        """Drives for ``dt`` seconds; what is returned is ignored."""
        ...


Watcher = Callable[[Command, ByteArray], None]


def follow(
    world: World,
    follower: HomingChain,
    steering: Steering,
    avoider: CorridorAvoidance | None,
    settings: ClosedLoopSettings,
    targets: FloatArray | None = None,
    watch: Watcher | None = None,
) -> DriveRecord:
    """Drives until the path ends, or for the longest time.

    Args:
        world: where the robot stands at the path's start.
        follower: fresh.
        steering: fresh, too.
        avoider: fresh, too; None for a robot without a range sensor.
        settings: rate and longest time.
        targets: (m, 3) true poses of the targets, for the record alone.
        watch: called with every command and its image, for pictures of the drive.

    Raises:
        FgslamError: what the world, the front-end and the estimator raise.
    """
    dt = 1.0 / settings.images_per_s
    steps = max(1, int(np.ceil(settings.longest_s * settings.images_per_s)))
    rows: list[_Row] = []
    homings: list[tuple[int, ActiveHoming, int]] = []  # target, homing, its first step
    for k in range(steps):
        time = k * dt
        pose = np.array(world.true_pose, dtype=np.float64)
        clock = [perf_counter()]
        image = world.image(time)
        clock.append(perf_counter())
        command = follower.step(image, time)
        clock.append(perf_counter())
        drive = steering.step(command, dt)
        if avoider is not None and not command.stop:
            drive = avoider.override(drive, command.heading, RangeScan(*world.scan()))
            if drive.overridden:
                steering.driven(drive)
                follower.held_up(dt)
        clock.append(perf_counter())
        world.drive(drive.speed, drive.turn_rate, dt)
        clock.append(perf_counter())
        homing = follower.controller.active
        if homing is not None and (not homings or homings[-1][1] is not homing):
            homings.append((command.target, homing, k))
        estimate = None if homing is None else homing.estimate
        number = -1 if homing is None else len(homings) - 1
        rows.append((pose, command, drive, number, estimate, np.diff(clock)))
        if watch is not None:
            watch(command, image)
        # The record ends with the robot at a stand: brakes need a few steps.
        if follower.finished and drive.speed == drive.turn_rate == 0.0:
            break
    else:
        follower.interrupt((steps - 1) * dt, f"not finished after {settings.longest_s:g} s")
    known = np.empty((0, 3)) if targets is None else np.array(targets)
    return _recorded(rows, homings, np.array(world.true_pose), follower, known)


_Row: TypeAlias = tuple[FloatArray, Command, Drive, int, HomingEstimate | None, FloatArray]
"""Of one step: true pose, command, drive, number of its homing, its estimate, seconds."""


def _recorded(
    rows: list[_Row],
    started: list[tuple[int, ActiveHoming, int]],
    end: FloatArray,
    follower: HomingChain,
    targets: FloatArray,
) -> DriveRecord:
    poses, commands, drives, numbers, states, laps = zip(*rows, strict=True)
    times = np.array([c.time for c in commands])
    unknown, blank = np.full(3, np.nan), np.full((6, 6), np.nan)
    return DriveRecord(
        time=times,
        truth=np.array(poses),
        end=end,
        targets=targets,
        target=np.array([c.target for c in commands], dtype=np.int64),
        state=tuple(c.state.value for c in commands),
        reason=tuple(c.reason for c in commands),
        heading=np.array([c.heading for c in commands]),
        remaining=np.array([c.remaining for c in commands]),
        rotation=np.array([c.rotation for c in commands]),
        covariance=np.array([c.covariance for c in commands]),
        speed=np.array([d.speed for d in drives]),
        turn_rate=np.array([d.turn_rate for d in drives]),
        overridden=np.array([d.overridden for d in drives]),
        homing=np.array(numbers, dtype=np.int64),
        robot=np.array([unknown if e is None else e.robot for e in states]),
        aim=np.array([unknown if e is None else e.target for e in states]),
        joint=np.array([blank if e is None else e.covariance for e in states]),
        homings=tuple(
            HomingLog(
                target=target,
                start=homing.start,
                tracks=tuple(homing.history),
                estimate=homing.estimate,
                unit=homing.unit,
                first_step=first,
                steps=np.searchsorted(times, [t.time for t in homing.history]),
            )
            for target, homing, first in started
        ),
        legs=tuple(follower.outcomes),
        seconds=dict(zip(STAGES, np.array(laps).T, strict=True)),
        finished=follower.finished,
    )


# --------------------------------------------------------------------------------------------
# What a drive leaves behind (Figs 4 and 6), and how well it kept to its path


STAGES = ("image", "homing", "steering", "drive")
"""What a step's seconds are split into: camera; front_end, estimator and command; steering and
avoidance; the world's own motion."""


@dataclass(frozen=True, slots=True, eq=False)
class HomingLog:
    """One homing from matching to its end; a leg has several where it was matched again.

    Attributes:
        target: number of the target image.
        start: what the estimator began with.
        tracks: what it was given afterwards, image by image.
        estimate: its last state.
        unit: length of its leg in parts of the leg where the robot set out for the target.
        first_step: row of the drive's record at which it started.
        steps: (k,) rows at which the images of ``tracks`` were taken.
    """

    target: int
    start: HomingStart
    tracks: tuple[TrackedBearings, ...]
    estimate: HomingEstimate
    unit: float
    first_step: int
    steps: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class DriveRecord:
    """A drive in closed loop; one row a step (k).

    Attributes:
        time: (k,) seconds.
        truth: (k, 3) true planar poses in the world, before each step's motion; the final pose is
            ``end``.
        end: (3,) where the robot stood when the drive was over.
        targets: (m, 3) true poses of the target images; NaN where unknown.
        target: (k,) number of the target that was aimed at.
        state: (k,) :class:`fgslam.homing.steering.HomingState` values.
        reason: one clause a step.
        heading, remaining, rotation: (k,) the commands.
        covariance: (k, 3, 3) of (remaining, heading, rotation).
        speed, turn_rate: (k,) as driven, m/s and rad/s.
        overridden: (k,) whether avoidance changed them.
        homing: (k,) row of ``homings`` that the estimate belongs to; -1 where there is none.
        robot, aim: (k, 3) estimated robot and target in that homing's start frame, legs.
        joint: (k, 6, 6) their covariance; NaN likewise.
        homings: in order.
        legs: how each leg ended.
        seconds: wall time of each stage of :data:`STAGES`, (k,) each. Not repeatable.
        finished: the path's end was reached, or abandoned by the robot itself; else the drive was
            ended from outside.
    """

    time: FloatArray
    truth: FloatArray
    end: FloatArray
    targets: FloatArray
    target: IntArray
    state: tuple[str, ...]
    reason: tuple[str, ...]
    heading: FloatArray
    remaining: FloatArray
    rotation: FloatArray
    covariance: FloatArray
    speed: FloatArray
    turn_rate: FloatArray
    overridden: BoolArray
    homing: IntArray
    robot: FloatArray
    aim: FloatArray
    joint: FloatArray
    homings: tuple[HomingLog, ...]
    legs: tuple[LegOutcome, ...]
    seconds: dict[str, FloatArray]
    finished: bool

    @property
    def arrived(self) -> bool:
        """Whether the last target was reached."""
        last = self.legs[-1] if self.legs else None
        return last is not None and last.result == "arrived" and self.finished

    def __len__(self) -> int:
        return len(self.time)


# --------------------------------------------------------------------------------------------
# How well a drive kept to its path: distances to targets, and if errors build up


ARRIVED_M = 0.5
"""Metres: a robot that claims an arrival and stands farther from the last target has not arrived.
It stops where the switch fraction of the leg is left, 0.28 m of a leg of 4 m by default."""


def end_distance(record: DriveRecord) -> float:
    """Metres from where the robot stood at last to the last target; NaN where that is unknown."""
    if len(record.targets) == 0:
        return float("nan")
    return float(np.hypot(*(record.end[:2] - record.targets[-1, :2])))


def truly_arrived(record: DriveRecord) -> bool:
    """Whether the robot reports that it reached the last target, and stands within ARRIVED_M of it.

    Where the truth is not known, its report has to do.
    """
    return record.arrived and not end_distance(record) > ARRIVED_M


def pass_distances(record: DriveRecord) -> FloatArray:
    """(m,) metres to each target where the robot was nearest, on its leg or on the next one.

    Infinite for targets that were never aimed at, NaN where the place is unknown. The next leg
    counts, as the robot turns away from a target shortly before it is there.
    """
    way = np.vstack([record.truth[:, :2], record.end[:2]])
    aimed = np.append(record.target, record.target[-1:])
    out = np.full(len(record.targets), np.inf)
    for k, target in enumerate(record.targets):
        near = way[np.isin(aimed, (k, k + 1))]
        if k in aimed:
            out[k] = np.min(np.hypot(*(near - target[:2]).T))
    return out


def cross_track(record: DriveRecord) -> FloatArray:
    """(m,) root mean square distance (metres) from the straight line of each leg.

    The line runs from the target before (for the first, from where the robot stood) to the leg's
    target; NaN for legs that were not driven, or whose line has no direction: two targets in one
    place.
    """
    ends = np.vstack([record.truth[0, :2], record.targets[:, :2]])
    out = np.full(len(record.targets), np.nan)
    for k in range(len(record.targets)):
        rows = record.target == k
        length = np.hypot(*(ends[k + 1] - ends[k]))
        if rows.any() and length > 0.0:
            offsets = record.truth[rows, :2] - ends[k]
            along = (ends[k + 1] - ends[k]) / length
            across = offsets[:, 1] * along[0] - offsets[:, 0] * along[1]
            out[k] = np.sqrt(np.mean(across**2))
    return out


def corners(record: DriveRecord) -> FloatArray:
    """(m,) how sharply each leg turns off the one before: the angle's sine, 1 beyond 90 degrees.

    The robot turns off where the switch fraction of the leg before is left, and so begins the next
    leg that part times this off its line. The first leg begins on its line: 0. NaN for legs that
    have no direction, two targets in one place, and for those after them.
    """
    ends = np.vstack([record.truth[0, :2], record.targets[:, :2]])
    steps = np.diff(ends, axis=0)
    angle = np.where(steps.any(axis=1), np.arctan2(steps[:, 1], steps[:, 0]), np.nan)
    turns = np.abs(wrap(np.diff(angle, prepend=angle[:1])))
    return np.asarray(np.sin(np.minimum(turns, 0.5 * np.pi)))


@dataclass(frozen=True, slots=True)
class Slope:
    """A straight line's slope with its confidence interval.

    Attributes:
        value: of the least squares line, units of the values a leg.
        low, high: 95 % confidence interval (Student's t).
    """

    value: float
    low: float
    high: float

    @property
    def flat(self) -> bool:
        """Whether zero lies within the interval."""
        return self.low <= 0.0 <= self.high


def slope_by_leg(legs: IntArray, values: FloatArray, known: FloatArray | None = None) -> Slope:
    """Whether values (n,), one a leg and run, grow with the leg's number (n,).

    Values that are not finite are left out; with as few as there are unknowns there is no
    interval: NaN.

    Args:
        legs: numbers.
        values: what may grow.
        known: (n,) another cause, whose share (linear, fitted along) is not counted as growth.
    """
    kept = np.isfinite(values) if known is None else np.isfinite(values) & np.isfinite(known)
    causes = [np.ones(len(legs)), np.asarray(legs, dtype=np.float64)]
    columns = np.column_stack(causes if known is None else [*causes, known])[kept]
    y, free = np.asarray(values)[kept], int(np.count_nonzero(kept)) - columns.shape[1]
    if free < 1 or np.linalg.matrix_rank(columns) < columns.shape[1]:
        return Slope(float("nan"), float("nan"), float("nan"))
    fitted, *_ = np.linalg.lstsq(columns, y, rcond=None)
    residuals = y - columns @ fitted
    spread = np.linalg.inv(columns.T @ columns)[1, 1]
    sigma = float(np.sqrt(residuals @ residuals / free * spread))
    slope, reach = float(fitted[1]), float(student_quantile(0.975, free)) * sigma
    return Slope(slope, slope - reach, slope + reach)
