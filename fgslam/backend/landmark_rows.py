"""Landmarks as rows of arrays with room to grow: a hundred thousand of them cost nothing a frame.

New ones are appended in place, and those that go are mostly young: only what lies behind the first
of them moves. So an update costs what it touches, not what the map holds.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from fgslam.types import FloatArray, IntArray, LandmarkMap

_Array = TypeVar("_Array", FloatArray, IntArray)

_ROOM = 1024  # rows to begin with
_GROWTH = 1.5


class LandmarkRows:
    """Identities ascending, with position, covariance, number of sightings and home frame.

    The arrays are views of the room in use: writing to rows of them changes the landmarks.
    """

    def __init__(self) -> None:
        """No landmark."""
        self._count = 0
        self._ids: IntArray = np.empty(_ROOM, np.int64)
        self._positions: FloatArray = np.empty((_ROOM, 3))
        self._covariances: FloatArray = np.empty((_ROOM, 3, 3))
        self._counts: IntArray = np.empty(_ROOM, np.int64)
        self._homes: IntArray = np.empty(_ROOM, np.int64)

    def __len__(self) -> int:
        return self._count

    @property
    def ids(self) -> IntArray:
        """(n,) ascending."""
        return self._ids[: self._count]

    @property
    def positions(self) -> FloatArray:
        """(n, 3) world, metres."""
        return self._positions[: self._count]

    @property
    def covariances(self) -> FloatArray:
        """(n, 3, 3) metres squared."""
        return self._covariances[: self._count]

    @property
    def counts(self) -> IntArray:
        """(n,) frames in which each was seen."""
        return self._counts[: self._count]

    @property
    def homes(self) -> IntArray:
        """(n,) frame with which each moves when a loop is closed; -1 for one that stays."""
        return self._homes[: self._count]

    def map(self) -> LandmarkMap:
        """As a map; only until the next landmark comes or goes."""
        return LandmarkMap(self.ids, self.positions, self.covariances)

    def rows(self, ids: IntArray) -> IntArray:
        """Row of each id. Raises KeyError when one is absent."""
        return self.map().rows(ids)

    def add(self, ids: IntArray, positions: FloatArray, covariances: FloatArray, home: int) -> None:
        """Adds landmarks (k,), seen once; they must be new."""
        start, stop = self._count, self._count + len(ids)
        self._reserve(stop)
        self._ids[start:stop] = ids
        self._positions[start:stop] = positions
        self._covariances[start:stop] = covariances
        self._counts[start:stop] = 1
        self._homes[start:stop] = home
        self._count = stop
        behind = max(start - 1, 0)
        if not (np.diff(self._ids[behind:stop]) > 0).all():
            self._take(0, np.argsort(self.ids, kind="stable"))

    def remove(self, ids: IntArray) -> None:
        """Drops landmarks. Raises KeyError when one is absent."""
        if not len(ids):
            return
        rows = self.rows(ids)
        first = int(rows.min())
        keep = np.ones(self._count - first, np.bool_)
        keep[rows - first] = False
        self._take(first, first + np.flatnonzero(keep))

    def load(self, landmarks: LandmarkMap, counts: IntArray, homes: IntArray) -> None:
        """Replaces everything; the arrays are copied."""
        self._count = 0
        self.add(landmarks.ids, landmarks.positions, landmarks.covariances, 0)
        self.counts[:], self.homes[:] = counts, homes

    # ----------------------------------------------------------------------------------------

    def _reserve(self, needed: int) -> None:
        if needed <= len(self._ids):
            return
        room = int(_GROWTH * needed)
        self._ids = _larger(self._ids, self._count, room)
        self._positions = _larger(self._positions, self._count, room)
        self._covariances = _larger(self._covariances, self._count, room)
        self._counts = _larger(self._counts, self._count, room)
        self._homes = _larger(self._homes, self._count, room)

    def _take(self, start: int, rows: IntArray) -> None:
        """Puts these rows, in this order, from ``start`` on; they are the last ones then."""
        stop = start + len(rows)
        for array in (self._ids, self._positions, self._covariances, self._counts, self._homes):
            array[start:stop] = array[rows]
        self._count = stop


def _larger(array: _Array, count: int, room: int) -> _Array:
    out = np.empty((room, *array.shape[1:]), array.dtype)
    out[:count] = array[:count]
    return out
