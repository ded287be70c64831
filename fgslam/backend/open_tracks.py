"""Landmark tracks that go on: their sightings in arrays, until they have ended and are judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, GrowingColumns, IntArray, StateArrays
from fgslam.core.sensors import Observations

LEAST_SIGHTINGS = 4  # of a track that is judged: a place and a slope take two
LONGEST = 30  # sightings of a track, at which it is judged although it goes on
ENDED_AFTER = 5  # frames without a sighting


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Sightings (n) of m tracks, one track after the other; ``start`` (m,): each one's first."""

    start: IntArray
    sightings: int

    @property
    def counts(self) -> IntArray:
        """(m,) sightings of each track."""
        return np.diff(np.append(self.start, self.sightings))

    @property
    def track(self) -> IntArray:
        """(n,) which track each sighting belongs to."""
        return np.repeat(np.arange(len(self.start)), self.counts)

    def select(self, kept: BoolArray) -> Tracks:
        """Those of a mask (m,)."""
        return tracks_of(self.counts[kept])


def tracks_of(counts: IntArray) -> Tracks:
    """Tracks of so many sightings (m,)."""
    ends = np.cumsum(counts)
    return Tracks(ends - counts, int(counts.sum()))


class OpenTracks(GrowingColumns):
    """Sightings of tracks that go on, in order of time."""

    ids: IntArray
    frame: IntArray

    def __init__(self) -> None:
        """None yet."""
        number = np.empty(0, np.int64)
        measurement, covariance = np.empty((0, 3)), np.empty((0, 3, 3))
        super().__init__(ids=number, frame=number, measurement=measurement, covariance=covariance)

    def add(self, frame: int, seen: Observations) -> None:
        """Takes in a frame's observations."""
        self.append(
            {
                "ids": seen.ids,
                "frame": np.full(len(seen), frame, np.int64),
                "measurement": seen.measurement,
                "covariance": seen.covariance,
            }
        )

    def first_frame(self, default: int) -> int:
        """The first one that any track was seen in."""
        return int(self.frame.min(initial=default))

    def take_ended(self, frame: int) -> tuple[StateArrays, IntArray]:
        """Takes out the tracks that have ended before a frame; those of a length to be judged.

        Returns:
            Their sightings as columns, one track after the other in order of their first ones, and
            the counts (m,).
        """
        track, counts = self._numbered()
        last = np.zeros(len(counts), np.int64)
        np.maximum.at(last, track, self.frame)
        return self._take((counts >= LONGEST) | (frame - last > ENDED_AFTER), track, counts)

    def take_all(self) -> tuple[StateArrays, IntArray]:
        """Takes out all tracks, as :meth:`take_ended`."""
        track, counts = self._numbered()
        return self._take(np.ones(len(counts), np.bool_), track, counts)

    def _numbered(self) -> tuple[IntArray, IntArray]:
        """(n,) which track each sighting is of, in order of the tracks' first ones; counts (m,)."""
        _, first, track, counts = np.unique(
            self.ids, return_index=True, return_inverse=True, return_counts=True
        )
        order = np.argsort(first)
        number = np.empty(len(order), np.int64)
        number[order] = np.arange(len(order))
        return number[track], counts[order]

    def _take(
        self, ended: BoolArray, track: IntArray, counts: IntArray
    ) -> tuple[StateArrays, IntArray]:
        judged = ended & (counts >= LEAST_SIGHTINGS)
        rows = np.flatnonzero(judged[track])
        rows = rows[np.argsort(track[rows], kind="stable")]
        out = {name: of[rows] for name, of in self.packed().items()}
        self.drop(ended[track])
        return out, counts[judged]
