"""Appearance of landmarks, seen from one or several directions (Se et al. 6.3).

A landmark has up to ``max_views`` views: SIFT scale (kept as the physical size, scale times depth),
orientation, descriptor and view vector, the unit vector from the camera to the landmark. The views
of all landmarks lie in one pool; a landmark names its own by their places in it, the first ones
first, and -1 for none. So it costs only the views it has, and nothing moves when one leaves.
A view's word (``frontend.features.vocabulary``) is found when somebody asks for it, and kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.features import StereoFeatures, Words
from fgslam.core.store import Kept
from fgslam.frontend.features.descriptor_index import words_of

Places = npt.NDArray[np.int32]
"""(n, max_views) places in the pool; -1 where there is no view."""
Directions = npt.NDArray[np.float32]
"""(v, 3) unit vectors, camera to landmark, world; NaN where unknown."""
_LEAST = 64
_GROWTH = 1.5
_UNKNOWN = -1  # word of a view for which nobody has asked


@dataclass(frozen=True, slots=True, eq=False)
class Views(Rows):
    """Views, one a row.

    Attributes:
        size: (v,) scale times depth, pixels times metres.
        orientation: (v,) radians.
        descriptors: (v, 128) uint8.
        direction: (v, 3) view vector.
        used: (v,) frame in which it was last matched.
    """

    size: FloatArray
    orientation: FloatArray
    descriptors: ByteArray
    direction: Directions
    used: IntArray

    @staticmethod
    def of(
        features: StereoFeatures, which: IntArray, directions: FloatArray | None, frame: int
    ) -> Views:
        """The chosen features, as views had from ``directions`` (k, 3) in ``frame``."""
        if directions is None:
            directions = np.full((len(which), 3), np.nan)
        return Views(
            size=features.scale[which] * features.position[which, 2],
            orientation=features.orientation[which],
            descriptors=features.descriptors[which],
            direction=directions.astype(np.float32),
            used=np.full(len(which), frame),
        )


class ViewPool:
    """The views of all landmarks."""

    _free: Kept[list[int]]
    _size: Kept[FloatArray]
    _orientation: Kept[FloatArray]
    _descriptors: Kept[ByteArray]
    _direction: Kept[Directions]
    _used: Kept[IntArray]

    def __init__(self, max_views: int, angle: float) -> None:
        """Takes how many views a landmark may have, and the angle that makes another (radians)."""
        self.max_views = max_views
        self._nearest_cosine = np.float32(np.cos(angle))
        self._free = []
        self._size = np.zeros(0)
        self._orientation = np.zeros(0)
        self._descriptors = np.zeros((0, 128), np.uint8)
        self._direction = np.zeros((0, 3), np.float32)
        self._used = np.zeros(0, np.int64)
        self._words: Words = np.zeros(0, np.int16)
        self.changes = 0
        """Counts what was stored or renewed: while it stands, all views are as they were."""

    @property
    def several(self) -> bool:
        """True if a landmark may have more than one view."""
        return self.max_views > 1

    def start(self, views: Views) -> Places:
        """The first view of as many new landmarks; returns their places (k, max_views)."""
        places = np.full((len(views), self.max_views), -1, np.int32)
        places[:, 0] = self._store(views)
        return places

    def load(self, counts: IntArray, views: Views) -> Places:
        """Views of landmarks, ``counts`` (n,) of each in a row: places (n, max_views).

        Of a landmark that has more views than it may, the last ones stay.
        """
        column = np.arange(len(views)) - np.repeat(np.cumsum(counts) - counts, counts)
        column -= np.repeat(np.maximum(counts - self.max_views, 0), counts)
        kept = column >= 0
        places = np.full((len(counts), self.max_views), -1, np.int32)
        row = np.repeat(np.arange(len(counts)), counts)
        places[row[kept], column[kept]] = self._store(views.select(kept))
        return places

    def release(self, places: Places) -> None:
        """Forgets the views at these places."""
        self._free.extend(places[places >= 0].tolist())

    def at(self, places: npt.NDArray[np.int32]) -> Views:
        """The views at places (v,)."""
        return Views(
            self._size[places],
            self._orientation[places],
            self._descriptors.take(places, axis=0),  # long rows: a quarter of indexing's time
            self._direction[places],
            self._used[places],
        )

    def words(self, places: npt.NDArray[np.int32]) -> Words:
        """Words (v,) of the views at places; those that were not asked for before are found now."""
        self._find_words(places[self._words[places] == _UNKNOWN])
        return self._words[places]

    def find_words(self) -> None:
        """Computes the visual words of all views in advance."""
        self._find_words(np.flatnonzero(self._words == _UNKNOWN))

    def last_use(self, places: npt.NDArray[np.int32]) -> IntArray:
        """Frame (v,) in which each of the views was last matched."""
        return self._used[places]

    def largest_sizes(self, places: Places) -> FloatArray:
        """Largest size (v,) of the views of each landmark."""
        sizes = self._size[places[:, 0]]
        for column in range(1, self.max_views):
            more = np.flatnonzero(places[:, column] >= 0)
            if not len(more):
                break
            sizes[more] = np.maximum(sizes[more], self._size[places[more, column]])
        return sizes

    def nearest(self, places: Places, directions: Directions) -> tuple[IntArray, BoolArray]:
        """The view of each landmark nearest to a direction, and whether it is near enough.

        Args:
            places: (v, max_views) of the landmarks.
            directions: (v, 3) from which it is seen now.

        Returns:
            Column (v,) of the nearest view in ``places``, and True (v,) where its angle is below
            the threshold. A view from an unknown direction is taken to be just near enough.
        """
        cosine = np.full(places.shape, -np.inf, np.float32)
        row, column = np.nonzero(places >= 0)
        each = (self._direction[places[row, column]] * directions[row]).sum(axis=1)
        cosine[row, column] = np.where(np.isnan(each), self._nearest_cosine, each)
        column = np.argmax(cosine, axis=1)
        return column, cosine[np.arange(len(column)), column] >= self._nearest_cosine

    def refresh(self, places: Places, seen: Views) -> None:
        """Landmarks were matched: renews their nearest view or adds one (6.3), in ``places``.

        The view vector of a renewed view stays: a slow orbit would drag it along and the landmark
        would end with a single view. One view alone (``max_views`` 1) is renewed altogether.
        """
        if not self.several:
            self._write(places[:, 0], seen)
            return
        column, inside = self.nearest(places, seen.direction)
        rows = np.flatnonzero(inside)
        at = places[rows, column[rows]]
        known = self._direction[at]
        self._write(at, seen.select(rows))
        anchored = ~np.isnan(known).any(axis=1)
        self._direction[at[anchored]] = known[anchored]
        for row in np.flatnonzero(~inside).tolist():
            self._add(places, row, seen.select(np.array([row])))

    def merge(self, stays: Places, ends: Places) -> None:
        """Hands the views of one landmark to another (1, max_views); of two alike the later stays.

        The places of the landmark that ends are released.
        """
        given = self.at(ends[ends >= 0])
        for k in np.argsort(given.used, kind="stable").tolist():
            view = given.select(np.array([k]))
            column, inside = self.nearest(stays, view.direction)
            place = stays[0, column]
            if self.several and not inside[0]:
                self._add(stays, 0, view)
            elif self._used[place[0]] <= view.used[0]:
                self.refresh(stays, view)
        self.release(ends)

    def remake(self) -> None:
        """Words are found anew, of all views that were put back."""
        self._words = np.full(len(self._size), _UNKNOWN, np.int16)
        self.changes += 1

    def bytes_per_view(self) -> int:
        """Memory of one view, without the room kept for growth."""
        columns: tuple[npt.NDArray[Any], ...] = (
            self._size,
            self._orientation,
            self._descriptors,
            self._direction,
            self._used,
            self._words,
        )
        return sum(c.dtype.itemsize * int(np.prod(c.shape[1:])) for c in columns)

    def _find_words(self, places: npt.NDArray[np.integer[Any]]) -> None:
        self._words[places] = words_of(self._descriptors[places])

    def _add(self, places: Places, row: int, view: Views) -> None:
        """One more view of a landmark; when it is full, in place of that matched longest ago."""
        empty = np.flatnonzero(places[row] < 0)
        if len(empty):
            places[row, empty[0]] = self._store(view)[0]
        else:
            oldest = int(np.argmin(self._used[places[row]]))
            self._write(places[row, [oldest]], view)

    def _store(self, views: Views) -> npt.NDArray[np.int32]:
        """Puts views into free places, which are returned (k,)."""
        lacking = len(views) - len(self._free)
        if lacking > 0:
            self._grow(lacking)
        taken = [self._free.pop() for _ in range(len(views))]
        places = np.array(taken, np.int32)
        self._write(places, views)
        return places

    def _write(self, places: npt.NDArray[np.int32], views: Views) -> None:
        self.changes += len(places)
        self._size[places] = views.size
        self._orientation[places] = views.orientation
        self._descriptors[places] = views.descriptors
        self._direction[places] = views.direction
        self._used[places] = views.used
        self._words[places] = _UNKNOWN

    def _grow(self, lacking: int) -> None:
        have = len(self._size)
        room = max(have + lacking, int(_GROWTH * have), _LEAST)
        for name in ("_size", "_orientation", "_descriptors", "_direction", "_used", "_words"):
            old = getattr(self, name)
            larger = np.zeros((room, *old.shape[1:]), old.dtype)
            larger[:have] = old
            setattr(self, name, larger)
        self._free = list(range(room - 1, have - 1, -1)) + self._free
