"""Arrays of equal length that grow and shrink together, without being copied whole each time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, IntArray, StateArrays

_GROWTH = 1.5
_LEAST = 64


class GrowingColumns:
    """Named arrays (n, ...) of fixed types; rows are appended at the end and dropped anywhere.

    Appending costs what is appended (the buffers grow by a factor), dropping what lies behind the
    first row dropped. ``columns[name]`` is a view of the present rows: it may be written to, and
    is good until the next change of length.
    """

    def __init__(self, **like: npt.NDArray[Any]) -> None:
        """Starts empty; each column has the type and the trailing shape of the array given."""
        self._length = 0
        self._buffers = {
            name: np.zeros((_LEAST, *array.shape[1:]), array.dtype) for name, array in like.items()
        }

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        return self._buffers[name][: self._length]

    def append(self, values: Mapping[str, npt.NDArray[Any]]) -> None:
        """Adds rows (k, ...): one array for every column."""
        count = len(next(iter(values.values())))
        self._reserve(self._length + count)
        for name, buffer in self._buffers.items():
            buffer[self._length : self._length + count] = values[name]
        self._length += count

    def drop(self, gone: BoolArray) -> None:
        """Removes the rows that are marked (n,); the others keep their order."""
        if not gone.any():
            return
        first = int(np.argmax(gone))
        self.take(first, np.flatnonzero(~gone[first:]) + first)

    def take(self, start: int, rows: IntArray) -> None:
        """Puts these rows, in this order, from row ``start`` on; they are the last ones then."""
        stop = start + len(rows)
        for buffer in self._buffers.values():
            buffer[start:stop] = buffer[rows]
        self._length = stop

    def state(self) -> StateArrays:
        """A snapshot of all columns."""
        return {name: self[name].copy() for name in self._buffers}

    def restore(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continues from :meth:`state`."""
        self._length = 0
        self.append({name: state[name] for name in self._buffers})

    def bytes_per_row(self) -> int:
        """Memory of a row, without the room kept for growth."""
        return sum(b.itemsize * int(np.prod(b.shape[1:])) for b in self._buffers.values())

    def _reserve(self, rows: int) -> None:
        have = len(next(iter(self._buffers.values())))
        if rows <= have:
            return
        room = max(rows, int(_GROWTH * have))
        for name, buffer in self._buffers.items():
            larger = np.zeros((room, *buffer.shape[1:]), buffer.dtype)
            larger[: self._length] = buffer[: self._length]
            self._buffers[name] = larger
