"""Landmark identities as the landmark database makes them, for worlds without appearance.

Given in the order of first sight, kept through misses, dropped after too many in a row, and new
when the point is seen again (Se et al. 4.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """One frame's points by what they are to the database.

    Attributes:
        matched: (k,) points seen whose identity is known, by ascending identity (Type III).
        matched_ids: (k,) theirs.
        new: (m,) points seen for the first time, or again after they were dropped (Type IV).
        new_ids: (m,) the identities they got, ascending.
        missed_ids: identities expected in view and not seen, ascending (Type II).
        pruned_ids: identities dropped after this frame, ascending.
    """

    matched: IntArray
    matched_ids: IntArray
    new: IntArray
    new_ids: IntArray
    missed_ids: IntArray
    pruned_ids: IntArray

    @staticmethod
    def nothing() -> Sightings:
        """Of a frame in which the cameras saw nothing at all, and nothing was expected."""
        none = np.empty(0, np.int64)
        return Sightings(none, none, none, none, none, none)


class IdentityBook:
    """Who is known, missed and dropped, frame after frame."""

    def __init__(self, points: int, prune_after: int) -> None:
        """Knows none of the points; ``prune_after`` consecutive misses drop an identity."""
        self._prune_after = prune_after
        self._id = np.full(points, -1, np.int64)
        self._missed = np.zeros(points, np.int64)
        self._point_of_id: list[IntArray] = []
        self._count = 0

    def __len__(self) -> int:
        """Identities given so far."""
        return self._count

    @property
    def point_of_id(self) -> IntArray:
        """(n,) point behind each identity ever given."""
        return np.concatenate([np.empty(0, np.int64), *self._point_of_id])

    def known(self) -> BoolArray:
        """Which points have an identity now."""
        return np.asarray(self._id >= 0)

    def take(self, seen: BoolArray, expected: BoolArray) -> Sightings:
        """One frame.

        Args:
            seen: (points,) which were measured.
            expected: (points,) which should have been; those known and not seen are missed.
        """
        known = self._id >= 0
        matched = np.flatnonzero(seen & known)
        matched = matched[np.argsort(self._id[matched])]
        new = np.flatnonzero(seen & ~known)
        missed = expected & ~seen & known
        new_ids = self._count + np.arange(len(new))
        out = (matched, self._id[matched], new, new_ids, np.sort(self._id[missed]))
        self._missed[matched] = 0
        self._missed[missed] += 1
        self._id[new], self._missed[new] = new_ids, 0
        self._count += len(new)
        self._point_of_id.append(new)
        return Sightings(*out, pruned_ids=self._prune())

    def _prune(self) -> IntArray:
        gone = (self._id >= 0) & (self._missed >= self._prune_after)
        pruned = np.sort(self._id[gone])
        self._id[gone] = -1
        return pruned
