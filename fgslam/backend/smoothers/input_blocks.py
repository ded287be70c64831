"""Where blocks of what a smoother was given are on disk: in files, or in one without a name."""

from __future__ import annotations

import io
import tempfile
import weakref
from pathlib import Path

import numpy as np

from fgslam.core.array_files import load_arrays, write_arrays
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import OutputError
from fgslam.core.files import make_subfolder

_NUMBER = "block"


class BlockFiles:
    """A file for each block: a run can be resumed from them."""

    def __init__(self, folder: Path) -> None:
        """The folder is made for the first block."""
        self._folder = folder

    def write(self, block: int, arrays: StateArrays) -> None:
        """Puts a block away. Raises OutputError when it cannot be written."""
        make_subfolder(self._folder.parent, self._folder.name)
        write_arrays(self._path(block), arrays | {_NUMBER: np.array(block)})

    def read(self, block: int, names: tuple[str, ...] | None = None) -> StateArrays:
        """The arrays of a block of these names, or all.

        Raises:
            OutputError: its file is missing or another's.
            MeasurementLogError: it is damaged.
        """
        path, wanted = self._path(block), None if names is None else (*names, _NUMBER)
        arrays = load_arrays(path, wanted) if path.is_file() else {}
        if int(arrays.get(_NUMBER, -1)) != block:
            what = "holds other frames than its name says" if arrays else "is missing"
            raise OutputError(
                f"{path}: this file of the run {what}; restore the file, or start again with "
                "--overwrite"
            )
        return arrays

    def name_of(self, block: int) -> str:
        """For messages."""
        return str(self._path(block))

    def _path(self, block: int) -> Path:
        return self._folder / f"{block:06d}.npz"


class UnnamedBlocks:
    """A file without a name, one block after the other: it goes with the process in any case."""

    def __init__(self) -> None:
        """The file is made for the first block, where the system keeps its temporary files."""
        self._ends = [0]

    def write(self, block: int, arrays: StateArrays) -> None:
        """Puts the next block away. Raises OSError when it cannot be written."""
        if not block:
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
            weakref.finalize(self, self._file.close)  # a smoother has no end of its own
        packed = io.BytesIO()
        np.savez(packed, allow_pickle=False, **arrays)
        self._file.seek(self._ends[block])
        left = packed.getbuffer()
        while left:
            left = left[self._file.write(left) :]
        self._ends.append(self._file.tell())

    def read(self, block: int, names: tuple[str, ...] | None = None) -> StateArrays:
        """The arrays of a block of these names, or all."""
        self._file.seek(self._ends[block])
        packed = io.BytesIO(self._file.read(self._ends[block + 1] - self._ends[block]))
        with np.load(packed, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in (arrays.files if names is None else names)}

    def name_of(self, block: int) -> str:
        """For messages."""
        return f"block {block} of a temporary file"
