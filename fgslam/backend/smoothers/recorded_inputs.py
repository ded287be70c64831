"""What an estimator was given, frame by frame: the state of those that cannot show their inside.

Of the tracking only what smoothers use is kept: pose, covariance, inliers, residuals, and whether
the landmarks determined it. On a long drive all but the last frames can be on disk.
"""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.backend.smoothers.input_blocks import BlockFiles, UnnamedBlocks
from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import EgoMotion, EgoMotionStatus, Prediction
from fgslam.core.log_arrays import frames_of
from fgslam.core.log_file import BLOCK
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment, Odometry
from fgslam.core.sensors import Sensor

Input: TypeAlias = tuple[Increment, EgoMotion]
_ON_DISK = "blocks"


class RecordedInputs:
    """Arguments of all updates so far."""

    def __init__(self, sensor: Sensor) -> None:
        """None yet; all are kept in memory."""
        self._sensor = sensor
        self._blocks: BlockFiles | UnnamedBlocks | None = None
        self._away = 0  # how many blocks
        self._last: list[Input] = []
        self._timestamps = array("d")

    def __len__(self) -> int:
        return len(self._timestamps)

    def keep_in(self, folder: Path | None) -> None:
        """From now on only the last few hundred frames are in memory, the others in the folder.

        It is made when needed. Files of a run before are written anew as this one gets there.
        None: they are in a file without a name, or in memory where there is no room for it.
        """
        self._blocks = UnnamedBlocks() if folder is None else BlockFiles(folder)

    def append(self, increment: Increment, tracking: EgoMotion) -> None:
        """Keeps one update's arguments.

        Raises:
            OutputError: a block of them cannot be written.
        """
        if len(self._last) >= 2 * BLOCK:
            self._put_away()
        self._timestamps.append(increment.timestamp)
        self._last.append((increment, tracking))

    def __iter__(self) -> Iterator[Input]:
        """Raises OutputError for a block that is missing, MeasurementLogError for a damaged one."""
        yield from self._recalled(self._away)
        yield from self._last

    def _put_away(self) -> None:
        """The oldest block of those in memory, where another place was named."""
        if self._blocks is None:
            return
        try:
            self._blocks.write(self._away, _arrays(self._sensor, self._last[:BLOCK]))
        except OSError:  # of the file without a name, which nobody asked for
            self._last, self._blocks, self._away = list(self), None, 0
        else:
            self._away += 1
            del self._last[:BLOCK]

    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return np.array(self._timestamps)

    def timestamp(self, frame: int) -> float:
        """A frame's, seconds."""
        return self._timestamps[frame]

    def tracked(self, frame: int) -> Prediction:
        """A frame's pose and covariance as tracked.

        Raises:
            OutputError: the file that they are in is missing or another's.
            MeasurementLogError: it is damaged.
        """
        block, row = divmod(frame, BLOCK)
        if self._blocks is not None and block < self._away:
            kept = self._blocks.read(block, ("wTc", "covariance"))
            return Prediction(kept["wTc"][row], kept["covariance"][row])
        tracking = self._last[frame - BLOCK * self._away][1]
        return Prediction(tracking.wTc, tracking.covariance)

    def motions(self) -> list[Odometry | None]:
        """The step to each frame, as it was used."""
        return [increment.odometry for increment, _ in self]

    def state(self) -> StateArrays:
        """All of it as plain arrays; without what is in files, but for how many these are."""
        if isinstance(self._blocks, BlockFiles):
            return _arrays(self._sensor, self._last) | {_ON_DISK: np.array(self._away)}
        return _arrays(self._sensor, list(self))

    def recalled(self, state: StateArrays) -> Iterator[Input]:
        """Everything that :meth:`state` told of, in order, to be put in once more.

        Raises:
            EstimatorError: its folder has not been named.
            OutputError: a file is missing or another's.
            MeasurementLogError: one is damaged.
        """
        blocks = int(state.get(_ON_DISK, 0))
        if blocks and not isinstance(self._blocks, BlockFiles):
            raise EstimatorError(
                "a part of the smoother's state is in files; name their folder with "
                "keep_record_in before restore"
            )
        yield from self._recalled(blocks)
        yield from _inputs(state, "the smoother's saved state", blocks * BLOCK)

    def _recalled(self, blocks: int) -> Iterator[Input]:
        """The inputs of the first blocks."""
        if (kept := self._blocks) is not None:
            for block in range(blocks):
                yield from _inputs(kept.read(block), kept.name_of(block), block * BLOCK)


def _arrays(sensor: Sensor, inputs: Sequence[Input]) -> StateArrays:
    """Inputs as plain arrays."""
    log, trackings = MeasurementLog(sensor, {}), [tracking for _, tracking in inputs]
    for increment, _ in inputs:
        log.append(increment)
    motions = [increment.odometry for increment, _ in inputs]
    n, known = len(trackings), np.array([motion is not None for motion in motions], np.bool_)
    given = [motion for motion in motions if motion is not None]
    return {f"log/{name}": array for name, array in log.to_arrays().items()} | {
        "wTc": np.array([t.wTc for t in trackings]).reshape(n, 4, 4),
        "covariance": np.array([t.covariance for t in trackings]).reshape(n, 6, 6),
        "matches": np.array([len(t.inliers) for t in trackings], np.int64),
        "inliers": np.concatenate([np.empty(0, np.bool_), *(t.inliers for t in trackings)]),
        "residuals": np.concatenate([np.empty(0), *(t.residuals for t in trackings)]),
        "noise": np.array([t.noise for t in trackings]),
        "measured": np.array([t.status.measured for t in trackings], np.bool_),
        "motion_known": known,
        "motion": np.array([m.motion for m in given]).reshape(-1, 4, 4),
        "motion_covariance": np.array([m.covariance for m in given]).reshape(-1, 6, 6),
    }


def _inputs(state: StateArrays, where: str, first: int) -> list[Input]:
    """Inputs back from their arrays, frame ``first`` and those after it."""
    logged = {
        name.removeprefix("log/"): array for name, array in state.items() if name.startswith("log/")
    }
    frames = frames_of(logged, where, first)[2]
    ends = np.cumsum(state["matches"])[:-1]
    inliers = np.split(state["inliers"], ends)
    residuals = np.split(state["residuals"], ends)
    row = np.cumsum(state["motion_known"]) - 1
    out = []
    for k, increment in enumerate(frames):
        tracking = EgoMotion(
            state["wTc"][k],
            state["covariance"][k],
            inliers[k],
            residuals[k],
            EgoMotionStatus.OK if state["measured"][k] else EgoMotionStatus.TOO_FEW_MATCHES,
            0,
            noise=float(state["noise"][k]),
        )
        measured = increment.odometry
        turned = measured is not None and measured.turned
        if (measured is None or turned) and state["motion_known"][k]:
            motion, covariance = state["motion"][row[k]], state["motion_covariance"][row[k]]
            bias = None if measured is None else measured.bias
            stand_in = Odometry(motion, covariance, False, turned, bias)
            increment = dataclasses.replace(increment, odometry=stand_in)
        out.append((increment, tracking))
    return out
