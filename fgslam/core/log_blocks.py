"""Frames of a long log: the last ones in memory, those before them in files of 256 frames each.

A block is a measurement log of its own. The file of the whole log is joined from the blocks, array
by array, to the same bytes as from frames in memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.array_files import OFFSETS, Pieces, continued, write_arrays, write_pieces
from fgslam.core.arrays import FloatArray, GrowingColumns, IntArray
from fgslam.core.files import make_subfolder, remove_files
from fgslam.core.log_arrays import arrays_of, frames_of, version_of
from fgslam.core.log_file import BLOCK, FramesOnDisk, LogFile
from fgslam.core.log_layout import CORRECTIONS, LOG, SENSOR_POSE, WITH_EVERYTHING
from fgslam.core.measurements import Increment, LoopClosure
from fgslam.core.sensors import Sensor

FILES = "[0-9]" * 6 + ".npz"


class LogBlocks(FramesOnDisk):
    """Frames in order; only the last one or two blocks of them are in memory.

    A frame that is read back has what its file keeps: a loaded log's.

    Attributes:
        folder: of the blocks.
    """

    def __init__(self, sensor: Sensor, motion_model: dict[str, Any], folder: Path) -> None:
        """No frame yet; the folder is made for the first block, blocks of a run before go.

        Raises:
            OutputError: such a block cannot be removed.
        """
        self._about = sensor, motion_model
        self.folder = folder
        self._blocks: list[Path] = []
        self._rows: list[dict[str, int]] = []  # of the arrays of each block
        self._last: list[Increment] = []
        self._heads = GrowingColumns(
            number=np.empty(0, np.int64),
            timestamp=np.empty(0),
            relocalised=np.empty(0, np.bool_),
        )
        self._closures: list[tuple[int, LoopClosure]] = []
        self._version, self._calibrated = version_of(()), False
        self._read: tuple[int, list[Increment]] = (-1, [])
        self._whole: Path | None = None
        self._resting: LogFile | None = None
        remove_files(self.folder, FILES)

    def __len__(self) -> int:
        return len(self._heads)

    def _frame(self, k: int) -> Increment:
        if self._whole is not None and not self._last:
            self._resting = self._resting or LogFile.of(self._whole)
            if self._resting is not None:
                return self._resting[k]
            self._recall()
        block, within = divmod(k, BLOCK)
        if block < len(self._blocks):
            return self._frames(block)[within]
        return self._last[k - BLOCK * len(self._blocks)]

    def append(self, frame: Increment) -> None:
        """Adds a frame; of two blocks in memory the older one is written first.

        Raises:
            OutputError: it cannot be written.
        """
        self._recall()
        if self._whole is None and len(self._last) == 2 * BLOCK:
            self._put_away()
        self._heads.append(
            {
                "number": np.array([frame.index]),
                "timestamp": np.array([frame.timestamp]),
                "relocalised": np.array([frame.relocalised]),
            }
        )
        self._closures += [(len(self) - 1, loop) for loop in frame.loops]
        self._version = max(self._version, version_of((frame,)))
        self._calibrated |= frame.rig_correction is not None
        self._last.append(frame)

    # -- what is asked of all frames ---------------------------------------------------------

    @property
    def numbers(self) -> IntArray:
        """(n,) the frames' numbers in their recording."""
        return self._heads["number"].copy()

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return self._heads["timestamp"].copy()

    @property
    def relocalised(self) -> int:
        """How many frames were placed without a prior."""
        return int(self._heads["relocalised"].sum())

    @property
    def closures(self) -> list[tuple[int, LoopClosure]]:
        """All closures, with the position of the frame that offered each."""
        return self._closures

    # -- files -------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """Writes the file of the whole log, with one array of one block in memory at a time.

        Raises:
            OutputError: it cannot be written.
            MeasurementLogError: a block is missing or damaged.
        """
        self._recall()
        last = arrays_of(*self._about, self._last, self._version)
        write_pieces(path, {name: self._joined(name, array) for name, array in last.items()})

    def rest_in(self, path: Path) -> None:
        """Frames are read from the file that :meth:`save` wrote from now on; the blocks go."""
        self._whole, self._resting, self._read = path, None, (-1, [])
        self._blocks, self._rows, self._last = [], [], []
        remove_files(self.folder, FILES)

    def _put_away(self) -> None:
        make_subfolder(self.folder.parent, self.folder.name)
        path = self.folder / f"{len(self._blocks):06d}.npz"
        arrays = arrays_of(*self._about, self._last[:BLOCK], WITH_EVERYTHING)
        write_arrays(path, arrays)
        self._blocks.append(path)
        self._rows.append({name: array.shape[0] for name, array in arrays.items() if array.ndim})
        del self._last[:BLOCK]

    def _frames(self, block: int) -> list[Increment]:
        """The frames of a block; those of the last one asked for are kept."""
        if self._read[0] != block:
            path = self._blocks[block]
            self._read = block, frames_of(LOG.load(path), str(path), BLOCK * block)[2]
        return self._read[1]

    def _recall(self) -> None:
        """All frames, once more in memory, where they rest in the file of the whole log."""
        if self._whole is not None and not self._last:
            self._last = frames_of(LOG.load(self._whole), str(self._whole))[2]
            self._resting = None

    def _joined(self, name: str, last: np.ndarray[Any, Any]) -> Pieces:
        """One array of all frames, ``last`` being that of the last ones."""
        if not last.ndim or name == SENSOR_POSE:
            return Pieces.of(last)
        if name.endswith(OFFSETS):
            parts = [_array(path, name) for path in self._blocks]
            return Pieces.of(continued([*parts, last]))
        rows = sum(of[name] for of in self._rows) + len(last)
        return Pieces(last.dtype, (rows, *last.shape[1:]), lambda: self._parts(name, last))

    def _parts(self, name: str, last: np.ndarray[Any, Any]) -> Iterator[np.ndarray[Any, Any]]:
        for part in itertools.chain((_array(p, name) for p in self._blocks), (last,)):
            # A frame before the first correction has none, which is written as zero.
            known = name == CORRECTIONS and self._calibrated
            yield np.nan_to_num(part, nan=0.0) if known else part


def _array(path: Path, name: str) -> np.ndarray[Any, Any]:
    return LOG.load(path, (name,))[name]
