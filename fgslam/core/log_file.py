"""Frames of a measurement log's file: some hundred of them in memory, the others where they lie."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from fgslam.core.array_files import UNREADABLE
from fgslam.core.array_rows import StoredRows
from fgslam.core.arrays import FloatArray, IntArray, StateArrays
from fgslam.core.errors import MeasurementLogError
from fgslam.core.log_arrays import frames_of
from fgslam.core.log_layout import (
    CORRECTIONS,
    LOOPS,
    PER_FRAME,
    PER_LOOP,
    PER_OBSERVATION,
    PER_TURN,
    SENSOR_POSE,
)
from fgslam.core.measurements import Increment, LoopClosure
from fgslam.core.sensors import Sensor

BLOCK = 256  # frames

# Offsets, and the arrays whose rows they count.
_OF_FRAMES = (
    "relocalised",
    CORRECTIONS,
    "rig_settled",
    "rig_knocks",
    "rig_field_px",
    *PER_FRAME,
    *PER_TURN,
)
_FROM_FRAMES = {
    "observation_start": tuple(PER_OBSERVATION),
    "missed_start": ("missed_id",),
    "pruned_start": ("pruned_id",),
    "loop_start": tuple(PER_LOOP),
}
_FROM_LOOPS = {
    "loop_observation_start": tuple(LOOPS + name for name in PER_OBSERVATION),
    "loop_merged_start": ("loop_merged",),
}


class FramesOnDisk(Sequence[Increment]):
    """Frames in order, most of them in files; what is asked of all frames is known without these.

    A frame that is read has what a loaded log's has.
    """

    @overload
    def __getitem__(self, at: int) -> Increment: ...
    @overload
    def __getitem__(self, at: slice) -> list[Increment]: ...
    def __getitem__(self, at: int | slice) -> Increment | list[Increment]:
        """A frame, or those of a slice.

        Raises:
            MeasurementLogError: a file is missing or damaged.
        """
        if isinstance(at, slice):
            return [self[k] for k in range(*at.indices(len(self)))]
        return self._frame(range(len(self))[at])

    @abstractmethod
    def _frame(self, k: int) -> Increment:
        """The frame at a position that there is."""

    @property
    @abstractmethod
    def numbers(self) -> IntArray:
        """(n,) the frames' numbers in their recording."""

    @property
    @abstractmethod
    def timestamps(self) -> FloatArray:
        """(n,) seconds."""

    @property
    @abstractmethod
    def relocalised(self) -> int:
        """How many frames were placed without a prior."""

    @property
    @abstractmethod
    def closures(self) -> list[tuple[int, LoopClosure]]:
        """All closures, with the position of the frame that offered each."""


class LogFile(FramesOnDisk):
    """Frames of a file that holds all of them.

    Attributes:
        sensor: what they were measured with.
        motion_model: how odometry came about.
    """

    @staticmethod
    def of(path: Path) -> LogFile | None:
        """The frames of a log's file; None where it is read as a whole.

        It is where it is short or of an odd make, and where it is damaged: what is wrong with it is
        then said of the whole.
        """
        if not path.is_file():
            return None
        try:
            found = LogFile(path)
        except (MeasurementLogError, *UNREADABLE):
            return None
        return found if len(found) > BLOCK else None

    def __init__(self, path: Path) -> None:
        """Reads and checks all frames, a block at a time.

        Raises:
            MeasurementLogError: they hold what no run measures.
            Exception: one of ``UNREADABLE``, for a file that cannot be read by rows.
        """
        self._where = str(path)
        self._stored = StoredRows(path)
        self._require_fitting()
        heads = {name: self._stored.whole(name) for name in ("frame_index", "timestamp")}
        self._numbers, self._timestamps = heads["frame_index"], heads["timestamp"]
        if not (np.diff(self._timestamps) > 0.0).all():
            raise ValueError("time stamps do not increase")
        self._read: tuple[int, list[Increment]] = (-1, [])
        self._relocalised, self._closures = 0, list[tuple[int, LoopClosure]]()
        for first in range(0, max(len(self), 1), BLOCK):
            self.sensor, self.motion_model, frames = self._block(first)
            self._relocalised += sum(frame.relocalised for frame in frames)
            self._closures += [(k, one) for k, f in enumerate(frames, first) for one in f.loops]

    def __len__(self) -> int:
        return len(self._numbers)

    def _frame(self, k: int) -> Increment:
        """The block of the frame asked for last stays in memory."""
        block, within = divmod(k, BLOCK)
        if self._read[0] != block:
            self._read = block, self._block(block * BLOCK)[2]
        return self._read[1][within]

    @property
    def numbers(self) -> IntArray:
        """(n,) the frames' numbers in their recording."""
        return self._numbers.copy()

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return self._timestamps.copy()

    @property
    def relocalised(self) -> int:
        """How many frames were placed without a prior."""
        return self._relocalised

    @property
    def closures(self) -> list[tuple[int, LoopClosure]]:
        """All closures, with the position of the frame that offered each."""
        return self._closures

    # ----------------------------------------------------------------------------------------

    def _require_fitting(self) -> None:
        """Raises ValueError unless all arrays have the rows that their offsets run to."""
        frames = len(self._stored.whole("frame_index"))
        self._require_rows(_OF_FRAMES, frames)
        self._require_ends(_FROM_FRAMES, frames)
        if "loop_start" in self._stored:
            self._require_ends(_FROM_LOOPS, int(self._stored.whole("loop_start")[-1]))

    def _require_ends(self, offsets: dict[str, tuple[str, ...]], parts: int) -> None:
        for name, counted in offsets.items():
            if name in self._stored:
                self._require_rows((name,), parts + 1)
                self._require_rows(counted, int(self._stored.whole(name)[-1]))

    def _require_rows(self, names: Iterable[str], rows: int) -> None:
        for name in names:
            if name in self._stored and self._stored.shape(name)[:1] != (rows,):
                raise ValueError(f"array {name} has not {rows} rows")

    def _block(self, first: int) -> tuple[Sensor, dict[str, Any], list[Increment]]:
        """Sensor, motion model and the frames of a block."""
        stop = min(first + BLOCK, len(self))
        arrays = {name: self._stored.whole(name) for name in ("header", SENSOR_POSE)}
        self._cut(arrays, _OF_FRAMES, first, stop)
        loops = (0, 0)
        for name, counted in _FROM_FRAMES.items():
            if name in self._stored:
                rows = self._follow(arrays, name, first, stop)
                self._cut(arrays, counted, *rows)
                loops = rows if name == "loop_start" else loops
        for name, counted in _FROM_LOOPS.items():
            if name in self._stored:
                self._cut(arrays, counted, *self._follow(arrays, name, *loops))
        return frames_of(arrays, self._where, first)

    def _cut(self, arrays: StateArrays, names: Iterable[str], start: int, stop: int) -> None:
        """Adds rows of the arrays that there are."""
        arrays |= {n: self._stored.rows(n, start, stop) for n in names if n in self._stored}

    def _follow(self, arrays: StateArrays, name: str, start: int, stop: int) -> tuple[int, int]:
        """Adds offsets of parts, from 0; returns the rows that the parts have in the whole."""
        found = self._stored.rows(name, start, stop + 1)
        arrays[name] = found - found[0]
        return int(found[0]), int(found[-1])
