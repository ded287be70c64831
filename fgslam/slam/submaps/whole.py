"""The whole map of a run whose far landmarks are on disk: one file an array, one sub-map a time.

The arrays lie in files without a name, mapped into memory: what reads them holds what it looks at.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, IntArray, StateArrays
from fgslam.core.estimates import LandmarkMap
from fgslam.core.features import LandmarkAppearances, LandmarkPatches
from fgslam.core.files import clear_output_errors
from fgslam.frontend.tracking.database import LandmarkDatabase

if TYPE_CHECKING:
    from fgslam.slam.submaps.files import SubMap

_VIEWS = ("descriptors", "size", "orientation", "direction")
_COLUMNS = ("hits", "misses", "permanent", "colour", "patch", "patch_distance")


class LandmarkBook(Protocol):
    """What is known of landmarks beside their places: counts, flags, looks; n of them, by identity.

    The database's, or that of the whole map.
    """

    @property
    def ids(self) -> IntArray:
        """(n,) ascending."""
        ...

    @property
    def hits(self) -> IntArray:
        """(n,) frames in which each was matched."""
        ...

    @property
    def misses(self) -> IntArray:
        """(n,) frames in which each was expected and not matched."""
        ...

    @property
    def permanent(self) -> BoolArray:
        """(n,) never pruned."""
        ...

    @property
    def lasting(self) -> BoolArray:
        """(n,) to be saved as permanent."""
        ...

    @property
    def valid(self) -> BoolArray:
        """(n,) to be trusted."""
        ...

    @property
    def colour(self) -> ByteArray:
        """(n,) grey values."""
        ...

    def rows(self, ids: IntArray) -> IntArray:
        """Rows (k,) of known identities, ascending."""
        ...

    def appearances(self, ids: IntArray | None = None) -> LandmarkAppearances:
        """All views, or those of the named landmarks (ascending)."""
        ...

    def patches(self, ids: IntArray) -> LandmarkPatches:
        """Own patches (k,) of the named landmarks (ascending)."""
        ...


Pieces = Callable[[], Iterator[tuple[LandmarkMap, "SubMap"]]]
"""All parts of the map, one after the other: landmarks where they are now, and what they are."""


@dataclass(frozen=True, slots=True, eq=False)
class WholeMap:
    """All landmarks, in memory and on disk, as a book and as a map."""

    landmarks: LandmarkMap
    views: LandmarkAppearances
    columns: StateArrays
    database: LandmarkDatabase

    @staticmethod
    def of(pieces: Pieces, database: LandmarkDatabase, folder: Path) -> WholeMap:
        """Collects the pieces, each of which is read twice; the scratch files are in ``folder``."""
        order, starts = _layout(pieces)
        make = _Scratch(folder)
        n, v = len(order), int(starts[-1])
        ids, owners = order, np.repeat(order, np.diff(starts))
        places, covariances = make((n, 3), np.float64), make((n, 3, 3), np.float64)
        views = {
            "descriptors": make((v, 128), np.uint8),
            "size": make((v,), np.float64),
            "orientation": make((v,), np.float64),
            "direction": make((v, 3), np.float64),
        }
        columns: StateArrays = {name: np.zeros(n, kind) for name, kind in _KINDS.items()}
        columns["patch"] = make((n, database.patch_pixels), np.uint8)
        for landmarks, submap in pieces():
            rows = np.searchsorted(ids, landmarks.ids)
            places[rows], covariances[rows] = landmarks.positions, landmarks.covariances
            for name in _COLUMNS:
                columns[name][rows] = submap.entries[name]
            at, by_age = _view_rows(starts, rows), _by_age(submap)
            for name in _VIEWS:
                views[name][at] = submap.entries[name][by_age]
        return WholeMap(
            LandmarkMap(ids, places, covariances),
            LandmarkAppearances(ids=owners, **views),
            columns,
            database,
        )

    @property
    def ids(self) -> IntArray:
        """(n,) ascending."""
        return self.landmarks.ids

    @property
    def hits(self) -> IntArray:
        """(n,) frames in which each was matched."""
        return self.columns["hits"]

    @property
    def misses(self) -> IntArray:
        """(n,) frames in which each was expected and not matched."""
        return self.columns["misses"]

    @property
    def permanent(self) -> BoolArray:
        """(n,) never pruned."""
        return self.columns["permanent"]

    @property
    def lasting(self) -> BoolArray:
        """(n,) to be saved as permanent."""
        return self.database.would_last(self.permanent, self.hits, self.misses)

    @property
    def valid(self) -> BoolArray:
        """(n,) to be trusted."""
        return self.database.are_valid(self.hits)

    @property
    def colour(self) -> ByteArray:
        """(n,) grey values."""
        return self.columns["colour"]

    def rows(self, ids: IntArray) -> IntArray:
        """Rows (k,) of known identities, ascending."""
        return np.searchsorted(self.ids, ids)

    def appearances(self, ids: IntArray | None = None) -> LandmarkAppearances:
        """All views, or those of the named landmarks (ascending)."""
        whole = ids is None or len(ids) == len(self.ids)
        return self.views if whole or ids is None else self.views.of(ids)

    def patches(self, ids: IntArray) -> LandmarkPatches:
        """Own patches (k,) of the named landmarks (ascending)."""
        patches = LandmarkPatches(self.columns["patch"], self.columns["patch_distance"])
        return patches if len(ids) == len(self.ids) else patches.select(self.rows(ids))


_KINDS = {
    "hits": np.int64,
    "misses": np.int64,
    "permanent": np.bool_,
    "colour": np.uint8,
    "patch_distance": np.float64,
}


class _Scratch:
    """Arrays of zeros in files of their own, which are gone with the last who looks at them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, shape: tuple[int, ...], kind: type) -> np.ndarray[Any, Any]:
        if not np.prod(shape):
            return np.zeros(shape, kind)
        with clear_output_errors(self._folder), tempfile.TemporaryFile(dir=self._folder) as file:
            return np.asarray(np.memmap(file, kind, "w+", shape=shape))


def _layout(pieces: Pieces) -> tuple[IntArray, IntArray]:
    """All identities (n,), ascending, and where the views of each begin (n + 1,)."""
    none = np.empty(0, np.int64)
    parts = [(s.entries["ids"], s.entries["view_counts"]) for _, s in pieces()]
    ids = np.concatenate([none, *(one for one, _ in parts)])
    counts = np.concatenate([none, *(each for _, each in parts)])
    order = np.argsort(ids, kind="stable")
    return ids[order], np.concatenate([[0], np.cumsum(counts[order])]).astype(np.int64)


def _view_rows(starts: IntArray, rows: IntArray) -> IntArray:
    """Rows of the views of some landmarks, one landmark after the other."""
    first, counts = starts[rows], starts[rows + 1] - starts[rows]
    within = np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(np.repeat(first, counts) + within)


def _by_age(submap: SubMap) -> IntArray:
    """The order in which each landmark's views were matched last, longest ago first."""
    held = submap.entries
    owners = np.repeat(held["ids"], held["view_counts"])
    return np.lexsort((held["used"], owners))
