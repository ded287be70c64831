"""The measurement log: everything that estimators consume, replayable without images.

One uncompressed ``.npz`` (:mod:`fgslam.core.log_arrays`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import Brief, FloatArray, IntArray, StateArrays
from fgslam.core.errors import MeasurementLogError
from fgslam.core.files import as_path
from fgslam.core.log_arrays import LOG, SENSOR_ARRAYS, arrays_of, frames_of, sensor_of
from fgslam.core.measurements import Increment, LoopClosure, Odometry
from fgslam.core.sensors import CameraRig
from fgslam.core.store import write_arrays


@dataclass(slots=True, eq=False, repr=False)
class MeasurementLog(Brief):
    """Measurements of a run, frame by frame.

    Attributes:
        rig: the cameras, with the lever arm.
        motion_model: how odometry came about, and the stand-in's numbers where there was none
            (plain JSON values): replays need it to predict as the live run did.
        increments: one a frame, time increasing.
    """

    rig: CameraRig
    motion_model: dict[str, Any]
    increments: list[Increment] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.increments)

    def __iter__(self) -> Iterator[Increment]:
        return iter(self.increments)

    def append(self, increment: Increment) -> None:
        """Adds one frame without a motion model's stand-in: a replay derives its own.

        Raises MeasurementLogError where its time does not come after the last one's.
        """
        if self.increments and not increment.timestamp > self.increments[-1].timestamp:
            raise MeasurementLogError(
                f"frame {increment.index}: time stamp {increment.timestamp:.9f} s does not come "
                f"after {self.increments[-1].timestamp:.9f} s; sort the measurements by time"
            )
        increment = dataclasses.replace(increment, odometry=_without_stand_in(increment.odometry))
        self.increments.append(increment)

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return np.array([s.timestamp for s in self], np.float64)

    @property
    def numbers(self) -> IntArray:
        """(n,) the frames' numbers in their recording."""
        return np.array([s.index for s in self], np.int64)

    @property
    def relocalised(self) -> int:
        """How many frames were placed without a prior."""
        return sum(s.relocalised for s in self)

    @property
    def closures(self) -> list[tuple[int, LoopClosure]]:
        """All loop closures, with the position of the frame that offered each."""
        return [(k, loop) for k, step in enumerate(self) for loop in step.loops]

    def to_arrays(self) -> StateArrays:
        """The log as the arrays of its file."""
        return arrays_of(self.rig, self.motion_model, self.increments)

    @staticmethod
    def from_arrays(arrays: StateArrays, where: str) -> MeasurementLog:
        """The log back from its arrays; ``where`` names the source in messages."""
        sensor, motion_model, frames = frames_of(arrays, where)
        log = MeasurementLog(sensor, motion_model)
        for frame in frames:
            log.append(frame)
        return log

    def save(self, path: str | Path) -> None:
        """Writes the log, whole or not at all. Raises OutputError when it cannot be written."""
        write_arrays(Path(path), self.to_arrays())

    @staticmethod
    def load_sensor(path: Path) -> CameraRig:
        """What a log's file was measured with. Raises MeasurementLogError as :meth:`load` does."""
        return sensor_of(LOG.load(path, SENSOR_ARRAYS), str(path))

    @staticmethod
    def load(path: str | Path) -> MeasurementLog:
        """Reads a log. Raises MeasurementLogError for a missing, truncated or foreign file."""
        return MeasurementLog.from_arrays(LOG.load(as_path(path, MeasurementLogError)), str(path))


def _without_stand_in(odometry: Odometry | None) -> Odometry | None:
    """What of a step was measured: all of it, its turn, or nothing."""
    if odometry is None or odometry.measured:
        return odometry
    if odometry.turned:
        turn = odometry.motion[:3, :3], odometry.covariance[:3, :3]
        return Odometry.turn(*turn, odometry.bias)
    return None
