"""What a drive leaves behind: arrays and short texts for files and figures (Figs 4 and 6)."""

from __future__ import annotations

from dataclasses import dataclass

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.homing import HomingEstimate, HomingStart, TrackedBearings
from fgslam.homing.path_following import LegOutcome

STAGES = ("image", "homing", "steering", "drive")
"""What a step's seconds are split into: camera; front_end, estimator and command; steering and
avoidance; the world's own motion."""


@dataclass(frozen=True, slots=True, eq=False)
class HomingLog:
    """One homing from matching to its end; a leg has several where it was matched anew.

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
        state: (k,) :class:`fgslam.homing.command.HomingState` values.
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
        finished: the path's end was reached, or given up by the robot itself; else the drive was
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
