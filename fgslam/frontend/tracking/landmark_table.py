"""Landmark table: identity, counts and views of each landmark (Se et al. 6.1 to 6.3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import (
    BoolArray,
    ByteArray,
    FloatArray,
    GrowingColumns,
    IntArray,
    StateArrays,
)
from fgslam.core.errors import MapError
from fgslam.core.features import LandmarkAppearances, LandmarkPatches
from fgslam.core.saved_map import SavedMap
from fgslam.core.store import Kept
from fgslam.frontend.tracking.views import Places, ViewPool, Views

_COUNTS = ("hits", "misses", "missed", "unlooked", "seen", "contradicted")
_PATCH = ("patch", "patch_distance")
_PLACES = "places"
_VIEWS = ("size", "orientation", "descriptors", "direction", "used")


def _no_columns(max_views: int, patch_pixels: int) -> GrowingColumns:
    count = np.empty(0, np.int64)
    return GrowingColumns(
        ids=count,
        colour=np.empty(0, np.uint8),
        permanent=np.empty(0, np.bool_),
        places=np.empty((0, max_views), np.int32),
        patch=np.empty((0, patch_pixels), np.uint8),
        patch_distance=np.empty(0),
        **dict.fromkeys(_COUNTS, count),
    )


class LandmarkTable:
    """One row a landmark, ascending in identity; the views lie in a pool of their own.

    The arrays over landmarks are read only by agreement, and good until the next change.
    """

    _pool: Kept[ViewPool]
    next_id: Kept[int]
    _frame: Kept[int]
    _columns: Kept[GrowingColumns]

    def __init__(self, max_views: int, view_angle: float, patch_pixels: int = 0) -> None:
        """Starts empty; see ``views.ViewPool`` for the views (radians).

        With ``patch_pixels`` there is room for each landmark's own patch of so many grey values.
        """
        self._pool = ViewPool(max_views, view_angle)
        self.next_id = 0
        self._frame = 0
        self._columns = _no_columns(max_views, patch_pixels)

    def __len__(self) -> int:
        return len(self._columns)

    @property
    def ids(self) -> IntArray:
        """(n,) identities, ascending."""
        return self._columns["ids"]

    @property
    def hits(self) -> IntArray:
        """(n,) frames in which each was matched, the first included."""
        return self._columns["hits"]

    @property
    def misses(self) -> IntArray:
        """(n,) frames in which each was expected and not matched."""
        return self._columns["misses"]

    @property
    def missed(self) -> IntArray:
        """(n,) such frames since the last hit."""
        return self._columns["missed"]

    @property
    def colour(self) -> ByteArray:
        """(n,) grey values."""
        return self._columns["colour"]

    @property
    def permanent(self) -> BoolArray:
        """(n,) never pruned for being missed (6.2)."""
        return self._columns["permanent"]

    @property
    def patch_pixels(self) -> int:
        """Grey values of an own patch; 0 where none are kept."""
        return int(self._columns["patch"].shape[1])

    def patches(self, ids: IntArray) -> LandmarkPatches:
        """Landmarks' own patches (k,)."""
        rows = self.rows(ids)
        return LandmarkPatches(*(self._columns[name][rows] for name in _PATCH))

    def keep_patches(self, ids: IntArray, patches: LandmarkPatches) -> None:
        """Landmarks (k,) get their own patches."""
        rows = self.rows(ids)
        self._columns["patch"][rows] = patches.grey
        self._columns["patch_distance"][rows] = patches.distances

    def appearances(
        self, ids: IntArray | None = None, with_words: bool = False
    ) -> LandmarkAppearances:
        """All views of all landmarks, or of those named (ascending); matched longest ago first.

        ``with_words`` for whoever searches among them: each word is found once in a view's life.
        """
        if ids is not None and len(ids) == len(self):
            ids = None  # to search for all of them would take as long as copying their views
        rows = np.arange(len(self)) if ids is None else self.rows(ids)
        owner, places = self._places_of(rows, by_age=True)
        views = self._pool.at(places)
        return LandmarkAppearances(
            ids=self.ids[rows[owner]],
            descriptors=views.descriptors,
            size=views.size,
            orientation=views.orientation,
            direction=views.direction.astype(np.float64),
            words=self._pool.words(places) if with_words else None,
        )

    def described_lately(self, frames: int) -> IntArray:
        """Identities (k,) whose looks are of the last frame that described any, or ``frames`` less.

        Those of a saved map that this run has not seen yet are older.
        """
        owner, places = self._places_of(np.arange(len(self)))
        used = self._pool.last_use(places)
        lately = used >= max(int(used.max(initial=0)) - frames, 0)
        return self.ids[np.unique(owner[lately])]

    @property
    def changes(self) -> int:
        """Grows with every change of a view: of the same landmarks the appearances are the same."""
        return self._pool.changes

    def find_words(self) -> None:
        """Computes the visual words of all views in advance, so that a search need not wait."""
        self._pool.find_words()

    def rows(self, ids: IntArray) -> IntArray:
        """Rows of landmarks that are in the database; ids ascending in it."""
        return np.searchsorted(self.ids, ids)

    def merge(self, pairs: IntArray) -> None:
        """Merges two identities of one landmark: views and counts go to the one that stays.

        Args:
            pairs: (m, 2) (identity that ends, identity that stays); several may end in one.

        Raises:
            ValueError: an identity is not in the database, ends twice, or ends and stays.
        """
        ends, stays = pairs[:, 0], pairs[:, 1]
        self._require_mergeable(ends, stays)
        from_rows, to_rows = self.rows(ends), self.rows(stays)
        for name in ("hits", "misses"):
            np.add.at(self._columns[name], to_rows, self._columns[name][from_rows])
        seen = self._columns["seen"]
        np.maximum.at(seen, to_rows, seen[from_rows])
        lacking = self._columns["patch_distance"][to_rows] == 0.0
        for name in _PATCH:
            column = self._columns[name]
            column[to_rows[lacking]] = column[from_rows[lacking]]
        for name in ("missed", "unlooked", "contradicted"):
            np.minimum.at(self._columns[name], to_rows, self._columns[name][from_rows])
        np.logical_or.at(self.permanent, to_rows, self.permanent[from_rows])
        for row, into in zip(from_rows.tolist(), to_rows.tolist(), strict=True):
            self._pool.merge(self._places[into : into + 1], self._places[row : row + 1])
            self._places[row] = -1
        gone = np.zeros(len(self), np.bool_)
        gone[from_rows] = True
        self._remove(gone)

    def load(self, saved: SavedMap) -> None:
        """Becomes the database of a saved map, at the beginning of another visit.

        Misses in a row and contradictions start at zero; new identities follow the map's last. A
        landmark with more views than the settings allow keeps those matched last.

        Raises:
            MapError: a landmark of the map has no view.
        """
        appearances, ids = saved.appearances, saved.landmarks.ids
        owners, counts = np.unique(appearances.ids, return_counts=True)
        if not np.array_equal(owners, ids):
            raise MapError("the map has landmarks without a view; make the map again")
        zeros = np.zeros(len(ids), np.int64)
        # The order of a landmark's views is that of their last use; they are older than any now.
        last = np.repeat(np.cumsum(counts), counts)
        views = Views(
            size=appearances.size,
            orientation=appearances.orientation,
            descriptors=appearances.descriptors,
            direction=appearances.direction.astype(np.float32),
            used=np.arange(len(appearances)) - last,
        )
        self._clear(0 if saved.patches is None else saved.patches.grey.shape[1])
        self._columns.append(
            {
                "ids": ids,
                "colour": saved.colour,
                "permanent": saved.permanent,
                "places": self._pool.load(counts, views),
                "hits": saved.hits,
                "misses": saved.misses,
                "missed": zeros,
                "unlooked": zeros,
                "seen": zeros,
                "contradicted": zeros,
                **self._as_columns(saved.patches, len(ids)),
            }
        )
        self.next_id = int(ids[-1]) + 1 if len(ids) else 0
        self._frame = 0

    def _append(self, ids: IntArray, views: Views, colour: ByteArray) -> None:
        """New landmarks (k,), seen once, in this frame."""
        zeros = np.zeros(len(ids), np.int64)
        self._columns.append(
            {
                "ids": ids,
                "colour": colour,
                "permanent": np.zeros(len(ids), np.bool_),
                _PLACES: self._pool.start(views),
                "hits": zeros + 1,
                "misses": zeros,
                "missed": zeros,
                "unlooked": zeros,
                "seen": zeros + self._frame,
                "contradicted": zeros,
                **self._as_columns(None, len(ids)),
            }
        )

    def _as_columns(self, patches: LandmarkPatches | None, count: int) -> StateArrays:
        """Own patches as this table keeps them; none where they are not known, or not kept."""
        pixels = self.patch_pixels
        if patches is None or not (pixels and patches.kept):
            patches = LandmarkPatches.none(count, pixels)
        return {"patch": patches.grey, "patch_distance": patches.distances}

    @property
    def _places(self) -> Places:
        return self._columns[_PLACES]

    def _views_from(self, rows: IntArray, directions: FloatArray | None) -> tuple[Views, BoolArray]:
        """The view of each row (k,) nearest to a direction (k, 3), and whether it is near (6.3).

        Without directions the first view, as near.
        """
        places = self._places[rows]
        if directions is None:
            return self._pool.at(places[:, 0]), np.ones(len(rows), np.bool_)
        column, known = self._pool.nearest(places, directions.astype(np.float32))
        return self._pool.at(places[np.arange(len(rows)), column]), known

    def _largest_sizes(self, rows: IntArray) -> FloatArray:
        """Largest size (k,) of any view of each row."""
        return self._pool.largest_sizes(self._places[rows])

    def _refresh(self, rows: IntArray, seen: Views) -> None:
        """Updates the nearest view of matched rows (k,), or adds a further one."""
        places = self._places[rows]
        self._pool.refresh(places, seen)
        self._places[rows] = places

    def _places_of(
        self, rows: IntArray, by_age: bool = False
    ) -> tuple[IntArray, npt.NDArray[np.int32]]:
        """To which of the rows (k,) each of their views belongs, as kept or by last use; places."""
        places = self._places[rows]
        owner, column = np.nonzero(places >= 0)
        flat = places[owner, column]
        if by_age and len(owner) > len(rows):
            flat = flat[np.lexsort((self._pool.last_use(flat), owner))]
        return owner, flat

    def _require_mergeable(self, ends: IntArray, stays: IntArray) -> None:
        unknown = np.setdiff1d(np.concatenate([ends, stays]), self.ids)
        if len(unknown):
            raise ValueError(f"landmarks {unknown[:5].tolist()} are not in the database")
        if len(np.unique(ends)) < len(ends) or np.isin(ends, stays).any():
            raise ValueError("a landmark can end only once, and not stay as well")

    def _remove(self, gone: BoolArray) -> None:
        if gone.any():
            self._pool.release(self._places[gone])
            self._columns.drop(gone)

    def _clear(self, patch_pixels: int) -> None:
        """No landmark; room for patches of so many pixels, at least, whoever began in them.

        A session that carries none keeps those of its map for the next one.
        """
        self._remove(np.ones(len(self), np.bool_))
        if patch_pixels > self.patch_pixels:
            self._columns = _no_columns(self._places.shape[1], patch_pixels)
