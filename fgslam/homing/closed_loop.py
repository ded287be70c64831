"""The loop: image, homing, steering, avoidance, motion; and the record of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import numpy as np

from fgslam.core.arrays import ByteArray, FloatArray
from fgslam.core.homing import HomingEstimate
from fgslam.homing.active_homing import ActiveHoming
from fgslam.homing.command import Command, Drive
from fgslam.homing.drive_record import STAGES, DriveRecord, HomingLog
from fgslam.homing.path_following import HomingChain
from fgslam.homing.settings import ClosedLoopSettings
from fgslam.homing.steering import ObstacleAvoider, RangeScan, Steering


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


@dataclass(frozen=True, slots=True)
class Driver:
    """Steering and avoidance, which turn commands into motion."""

    steering: Steering
    avoider: ObstacleAvoider

    def drive(self, command: Command, world: World, dt: float) -> Drive:
        """Speed and turning rate for the next ``dt`` seconds."""
        wanted = self.steering.step(command, dt)
        if command.stop:
            return wanted
        driven = self.avoider.override(wanted, command.heading, RangeScan(*world.scan()))
        if driven.overridden:
            self.steering.driven(driven)
        return driven


def follow(
    world: World,
    follower: HomingChain,
    driver: Driver,
    settings: ClosedLoopSettings,
    targets: FloatArray | None = None,
    watch: Watcher | None = None,
) -> DriveRecord:
    """Drives until the path ends, or for the longest time.

    Args:
        world: where the robot stands at the path's start.
        follower: fresh.
        driver: fresh, too.
        settings: rate and longest time.
        targets: (m, 3) true poses of the targets, for the record alone.
        watch: called with every command and its image, for pictures of the drive.

    Raises:
        FgslamError: what the world, the front-end and the estimator raise.
    """
    dt = 1.0 / settings.images_per_s
    steps = max(1, int(np.ceil(settings.longest_s * settings.images_per_s)))
    recorder = _Recorder()
    for k in range(steps):
        clock = _Clock()
        time, pose = k * dt, np.array(world.true_pose, dtype=np.float64)
        image = world.image(time)
        clock.lap()
        command = follower.step(image, time)
        clock.lap()
        drive = driver.drive(command, world, dt)
        if drive.overridden:
            follower.held_up(dt)
        clock.lap()
        world.drive(drive.speed, drive.turn_rate, dt)
        clock.lap()
        recorder.note(pose, command, drive, follower.controller.active, clock.laps)
        if watch is not None:
            watch(command, image)
        # The record ends with the robot at a stand: brakes need a few steps.
        if follower.finished and drive.speed == drive.turn_rate == 0.0:
            break
    else:
        follower.interrupt((steps - 1) * dt, f"not finished after {settings.longest_s:g} s")
    return recorder.record(np.array(world.true_pose), follower, targets)


class _Clock:
    """Wall times between laps, seconds."""

    def __init__(self) -> None:
        self.laps: list[float] = []
        self._last = perf_counter()

    def lap(self) -> None:
        now = perf_counter()
        self.laps.append(now - self._last)
        self._last = now


class _Recorder:
    """Rows of a drive, gathered into a record."""

    def __init__(self) -> None:
        self._poses: list[FloatArray] = []
        self._commands: list[Command] = []
        self._drives: list[Drive] = []
        self._rows: list[int] = []
        self._estimates: list[HomingEstimate | None] = []
        self._laps: list[list[float]] = []
        self._logs: list[tuple[int, ActiveHoming, int]] = []

    def note(
        self,
        pose: FloatArray,
        command: Command,
        drive: Drive,
        homing: ActiveHoming | None,
        laps: list[float],
    ) -> None:
        """Adds the row of one step."""
        self._poses.append(pose)
        self._drives.append(drive)
        self._laps.append(laps)
        self._estimates.append(None if homing is None else homing.estimate)
        self._rows.append(-1 if homing is None else self._log(command, homing))
        self._commands.append(command)

    def _log(self, command: Command, homing: ActiveHoming) -> int:
        if not self._logs or self._logs[-1][1] is not homing:
            self._logs.append((command.target, homing, len(self._commands)))
        return len(self._logs) - 1

    def _closed(self, target: int, homing: ActiveHoming, first_step: int) -> HomingLog:
        times = np.array([c.time for c in self._commands])
        return HomingLog(
            target=target,
            start=homing.start,
            tracks=tuple(homing.history),
            estimate=homing.estimate,
            unit=homing.unit,
            first_step=first_step,
            steps=np.searchsorted(times, [t.time for t in homing.history]),
        )

    def record(
        self, end: FloatArray, follower: HomingChain, targets: FloatArray | None
    ) -> DriveRecord:
        """The record of all steps."""
        commands, drives, known = self._commands, self._drives, self._estimates
        unknown, blank = np.full(3, np.nan), np.full((6, 6), np.nan)
        laps = np.array(self._laps)
        return DriveRecord(
            time=np.array([c.time for c in commands]),
            truth=np.array(self._poses),
            end=end,
            targets=np.empty((0, 3)) if targets is None else np.array(targets),
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
            homing=np.array(self._rows, dtype=np.int64),
            robot=np.array([unknown if e is None else e.robot for e in known]),
            aim=np.array([unknown if e is None else e.target for e in known]),
            joint=np.array([blank if e is None else e.covariance for e in known]),
            homings=tuple(self._closed(*log) for log in self._logs),
            legs=tuple(follower.outcomes),
            seconds={name: laps[:, i] for i, name in enumerate(STAGES)},
            finished=follower.finished,
        )
