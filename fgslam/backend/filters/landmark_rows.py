"""The landmarks of a filter that knows each by itself, as rows of growing arrays."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray, GrowingColumns, IntArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.store import Kept


class LandmarkRows:
    """Identities ascending, with position, covariance, sightings, home frame and last frame.

    An update costs what it touches: new landmarks are appended in place, and those that go are
    mostly young, so that only what lies behind the first of them moves.
    The arrays are views of the room in use: writing to rows of them changes the landmarks.
    """

    _columns: Kept[GrowingColumns]

    def __init__(self) -> None:
        """No landmark."""
        number = np.empty(0, np.int64)
        self._columns = GrowingColumns(
            ids=number,
            positions=np.empty((0, 3)),
            covariances=np.empty((0, 3, 3)),
            counts=number,
            homes=number,
            lasts=number,
        )

    def __len__(self) -> int:
        return len(self._columns)

    @property
    def ids(self) -> IntArray:
        """(n,) ascending."""
        return self._columns["ids"]

    @property
    def positions(self) -> FloatArray:
        """(n, 3) world, metres."""
        return self._columns["positions"]

    @property
    def covariances(self) -> FloatArray:
        """(n, 3, 3) metres squared."""
        return self._columns["covariances"]

    @property
    def counts(self) -> IntArray:
        """(n,) frames in which each was seen."""
        return self._columns["counts"]

    @property
    def homes(self) -> IntArray:
        """(n,) frame with which each moves when a loop is closed; -1 for one that stays."""
        return self._columns["homes"]

    @property
    def lasts(self) -> IntArray:
        """(n,) frame that saw each last; -1 for one that none saw yet."""
        return self._columns["lasts"]

    def map(self) -> LandmarkMap:
        """As a map; only until the next landmark comes or goes."""
        return LandmarkMap(self.ids, self.positions, self.covariances)

    def rows(self, ids: IntArray) -> IntArray:
        """Row of each id. Raises KeyError when one is absent."""
        return self.map().rows(ids)

    def add(self, ids: IntArray, positions: FloatArray, covariances: FloatArray, home: int) -> None:
        """Adds landmarks (k,), seen once; they must be new."""
        ones = np.ones(len(ids), np.int64)
        self.bring(LandmarkMap(ids, positions, covariances), ones, home * ones, home * ones)

    def bring(
        self, landmarks: LandmarkMap, counts: IntArray, homes: IntArray, lasts: IntArray
    ) -> None:
        """Adds landmarks (k,) that are known already; none of them may be there."""
        before = len(self)
        self._columns.append(
            {
                "ids": landmarks.ids,
                "positions": landmarks.positions,
                "covariances": landmarks.covariances,
                "counts": counts,
                "homes": homes,
                "lasts": lasts,
            }
        )
        self._columns.keep_ascending("ids", before)

    def remove(self, ids: IntArray) -> None:
        """Drops landmarks. Raises KeyError when one is absent."""
        if not len(ids):
            return
        gone = np.zeros(len(self), np.bool_)
        gone[self.rows(ids)] = True
        self._columns.drop(gone)

    def load(
        self, landmarks: LandmarkMap, counts: IntArray, homes: IntArray, lasts: IntArray
    ) -> None:
        """Replaces everything; the arrays are copied."""
        self._columns.take(0, np.empty(0, np.int64))
        self.bring(landmarks, counts, homes, lasts)
