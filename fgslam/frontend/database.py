"""The landmark database: identity, appearance and bookkeeping (Se et al. 4 and 6).

Geometry (positions and covariances) belongs to the estimator; the two are joined by landmark ids.
Each entry is [s, o, m, n, l] with a descriptor; the scale is kept as the physical size
``s * Z``, because the image scale is inversely proportional to the depth (3.1; design E-S7). An
entry may be permanent (6.2), and have several views (6.3).
"""

from __future__ import annotations

import numpy as np

from fgslam.frontend.columns import GrowingColumns
from fgslam.frontend.permanence import clearly_absent, is_blind, reliable
from fgslam.frontend.views import Places, ViewPool, Views
from fgslam.frontend.visibility import ExpectedLandmarks, FieldOfView, directions_to
from fgslam.map_file import SavedMap
from fgslam.map_types import LandmarkAppearances
from fgslam.settings.frontend import DatabaseSettings, PermanenceSettings
from fgslam.types import (
    BoolArray,
    ByteArray,
    CameraRig,
    FloatArray,
    IntArray,
    LandmarkMap,
    StateArrays,
    StereoFeatures,
)

_COUNTS = ("hits", "misses", "missed", "seen", "contradicted")
_PLACES = "places"
_VIEWS = ("size", "orientation", "descriptors", "direction", "used")


class LandmarkDatabase:
    """Landmarks' appearance and counts: hits n, misses m, consecutive misses l.

    The arrays over landmarks are read only by agreement, and good until the next change.
    """

    def __init__(self, rig: CameraRig, settings: DatabaseSettings, max_disparity_px: float) -> None:
        """Starts empty (4.2); landmarks of more than ``max_disparity_px`` are not expected."""
        self._settings = settings
        self._field_of_view = FieldOfView(rig, settings, max_disparity_px)
        viewpoints = settings.viewpoints
        several, angle = (
            (1, 0.0) if viewpoints is None else (viewpoints.max_views, viewpoints.view_angle_deg)
        )
        self._pool = ViewPool(several, float(np.deg2rad(angle)))
        self._next_id = 0
        self._frame = 0
        count = np.empty(0, np.int64)
        self._columns = GrowingColumns(
            ids=count,
            colour=np.empty(0, np.uint8),
            permanent=np.empty(0, np.bool_),
            places=np.empty((0, several), np.int32),
            **dict.fromkeys(_COUNTS, count),
        )

    def __len__(self) -> int:
        return len(self._columns)

    # ----------------------------------------------------------------------------------------
    # What is known

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
    def seen(self) -> IntArray:
        """(n,) frame of the last hit."""
        return self._columns["seen"]

    @property
    def contradicted(self) -> IntArray:
        """(n,) frames since the last hit that speak against a permanent landmark."""
        return self._columns["contradicted"]

    @property
    def colour(self) -> ByteArray:
        """(n,) grey values."""
        return self._columns["colour"]

    @property
    def permanent(self) -> BoolArray:
        """(n,) never pruned for being missed (6.2)."""
        return self._columns["permanent"]

    @property
    def valid(self) -> BoolArray:
        """(n,) landmarks seen often enough to be trusted (6.1)."""
        return np.asarray(self.hits >= self._settings.valid_hits)

    @property
    def lasting(self) -> BoolArray:
        """(n,) landmarks that a map saved now should hold as permanent ones."""
        if self._settings.permanence is None:
            return self.permanent.copy()
        return self.permanent | self._reliable(np.arange(len(self)), self._settings.permanence)

    @property
    def size(self) -> FloatArray:
        """(n,) physical size, pixels times metres, of the first view."""
        return self._first_views().size

    @property
    def orientation(self) -> FloatArray:
        """(n,) radians, of the first view."""
        return self._first_views().orientation

    @property
    def descriptors(self) -> ByteArray:
        """(n, 128) of the first view."""
        return self._first_views().descriptors

    @property
    def view_counts(self) -> IntArray:
        """(n,) views of each."""
        return np.asarray((self._places >= 0).sum(axis=1))

    @property
    def bytes_per_landmark(self) -> int:
        """Memory of a landmark with one view, without the room kept for growth."""
        return self._columns.bytes_per_row() + self._pool.bytes_per_view()

    @property
    def bytes_per_view(self) -> int:
        """Memory of each further view."""
        return self._pool.bytes_per_view()

    def appearances(self, ids: IntArray | None = None) -> LandmarkAppearances:
        """All views of all landmarks, or of those named (ascending); matched longest ago first."""
        rows = np.arange(len(self)) if ids is None else self.rows(ids)
        owner, views = self._views_of(rows)
        order = np.lexsort((views.used, owner))
        owner, views = owner[order], views.select(order)
        return LandmarkAppearances(
            ids=self.ids[rows[owner]],
            descriptors=views.descriptors,
            size=views.size,
            orientation=views.orientation,
            direction=views.direction.astype(np.float64),
        )

    def expected(self, landmarks: LandmarkMap, wTc: FloatArray) -> ExpectedLandmarks:
        """Landmarks of the map that should or may be in view from ``wTc`` (4.4)."""
        found = self._field_of_view.select(wTc, landmarks.positions)
        ids = landmarks.ids[found.rows]
        places = self._places[self.rows(ids)]
        certain = found.certain
        place = places[:, 0]
        if self._pool.several:
            column, known = self._pool.nearest(
                places, directions_to(wTc, found.points).astype(np.float32)
            )
            place = places[np.arange(len(places)), column]
            certain = certain & known
        views = self._pool.at(place)
        return ExpectedLandmarks(
            ids=ids,
            rows=found.rows,
            measurement=found.measurement,
            scale=views.size / found.points[:, 2],
            orientation=views.orientation,
            descriptors=views.descriptors,
            certain=certain,
        )

    def rows(self, ids: IntArray) -> IntArray:
        """Rows of landmarks that are in the database; ids ascending in it."""
        return np.searchsorted(self.ids, ids)

    def new_ids(self, count: int) -> IntArray:
        """The identities that the next ``count`` landmarks will get."""
        return np.arange(self._next_id, self._next_id + count)

    # ----------------------------------------------------------------------------------------
    # A frame

    def missing(self, expected: ExpectedLandmarks, hit: BoolArray) -> IntArray:
        """Type II: identities expected well in view and not hit (v,); none in a blocked view."""
        permanence = self._settings.permanence
        if permanence is not None and is_blind(expected, hit, permanence):
            return np.empty(0, np.int64)
        return expected.ids[expected.certain & ~hit]

    def record_hits(
        self,
        ids: IntArray,
        features: StereoFeatures,
        which: IntArray,
        directions: FloatArray | None = None,
    ) -> None:
        """Type III: a match resets l and refreshes the appearance.

        Args:
            ids: (k,) landmarks.
            features: the frame's.
            which: (k,) the features that they match.
            directions: (k, 3) from the camera to each, unit, world; None where nobody asks.
        """
        rows = self.rows(ids)
        self.missed[rows] = 0
        self.contradicted[rows] = 0
        self.seen[rows] = self._frame
        self.hits[rows] += 1
        places = self._places[rows]
        self._pool.refresh(places, Views.of(features, which, directions, self._frame))
        self._places[rows] = places
        permanence = self._settings.permanence
        if permanence is not None and permanence.when == "running":
            self.permanent[rows] |= self._reliable(rows, permanence)

    def record_misses(self, ids: IntArray) -> None:
        """Type II: expected in view and not matched."""
        rows = self.rows(ids)
        self.missed[rows] += 1
        self.misses[rows] += 1

    def weigh(
        self,
        expected: ExpectedLandmarks,
        missing: IntArray,
        rejected: IntArray,
        seen: tuple[FloatArray, BoolArray],
    ) -> None:
        """What a located frame says against permanent landmarks: too often, and one is demoted.

        It contradicts those missing whose match was rejected as an outlier, and those whose place
        it sees clearly (:func:`fgslam.frontend.permanence.clearly_absent`). What merely hides
        them says nothing.

        Args:
            expected: landmarks expected in view.
            missing: identities of those missed.
            rejected: identities of those matched and rejected.
            seen: the frame's (column, row, disparity) (f, 3), and which of them (f,) are hits.
        """
        permanence = self._settings.permanence
        if permanence is None or permanence.contradicted_after is None:
            return
        ids = missing[self.permanent[self.rows(missing)]]
        places = expected.measurement[np.searchsorted(expected.ids, ids)]
        against = clearly_absent(places, *seen, permanence.near_px)
        ids = ids[against | np.isin(ids, rejected)]
        rows = self.rows(ids)
        self.contradicted[rows] += 1
        self.demote(ids[self.contradicted[rows] >= permanence.contradicted_after])

    def demote(self, ids: IntArray) -> None:
        """Permanent landmarks become ordinary ones, which go once they have been missed for long.

        Only a hit can make them permanent again.
        """
        rows = self.rows(ids)
        self.permanent[rows] = False
        self.contradicted[rows] = 0

    def add(
        self,
        features: StereoFeatures,
        which: IntArray,
        colour: ByteArray,
        directions: FloatArray | None = None,
    ) -> IntArray:
        """Type IV: starts a track for each chosen feature (4.2); returns their identities."""
        ids = self.new_ids(len(which))
        self._next_id += len(which)
        zeros = np.zeros(len(which), np.int64)
        self._columns.append(
            {
                "ids": ids,
                "colour": colour,
                "permanent": np.zeros(len(which), np.bool_),
                "places": self._pool.start(Views.of(features, which, directions, self._frame)),
                "hits": zeros + 1,
                "misses": zeros,
                "missed": zeros,
                "seen": zeros + self._frame,
                "contradicted": zeros,
            }
        )
        return ids

    def prune(self) -> IntArray:
        """Ends a frame: drops landmarks missed N times in a row (4.3); returns their identities.

        On request also those that were never confirmed and not seen for long, in view or not.
        Permanent ones stay (6.2).
        """
        gone = self.missed >= self._settings.prune_after_misses
        forget_after = self._settings.forget_unconfirmed_after
        if forget_after is not None:
            gone |= ~self.valid & (self._frame >= self.seen + forget_after)
        gone &= ~self.permanent
        self._frame += 1
        pruned = self.ids[gone]
        self._remove(gone)
        return pruned

    def merge(self, pairs: IntArray) -> None:
        """Two identities of one landmark become one: looks and counts go to the one that stays.

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
        np.maximum.at(self.seen, to_rows, self.seen[from_rows])
        for name in ("missed", "contradicted"):
            np.minimum.at(self._columns[name], to_rows, self._columns[name][from_rows])
        np.logical_or.at(self.permanent, to_rows, self.permanent[from_rows])
        for row, into in zip(from_rows.tolist(), to_rows.tolist(), strict=True):
            self._pool.merge(self._places[into : into + 1], self._places[row : row + 1])
            self._places[row] = -1
        gone = np.zeros(len(self), np.bool_)
        gone[from_rows] = True
        self._remove(gone)

    # ----------------------------------------------------------------------------------------
    # Kept

    def load(self, saved: SavedMap) -> None:
        """Becomes the database of a saved map, at the beginning of another visit.

        Misses in a row and contradictions start at zero; new identities follow the map's last. A
        landmark with more views than the settings allow keeps those matched last.
        """
        appearances, ids = saved.appearances, saved.landmarks.ids
        counts = np.diff(np.searchsorted(appearances.ids, np.append(ids, np.iinfo(np.int64).max)))
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
        self._clear()
        self._columns.append(
            {
                "ids": ids,
                "colour": saved.colour,
                "permanent": saved.permanent,
                "places": self._pool.load(counts, views),
                "hits": saved.hits,
                "misses": saved.misses,
                "missed": zeros,
                "seen": zeros,
                "contradicted": zeros,
            }
        )
        self._next_id = int(ids[-1]) + 1 if len(ids) else 0
        self._frame = 0

    def state(self) -> StateArrays:
        """All entries, as arrays; a snapshot."""
        out = self._columns.state()
        del out[_PLACES]
        _, views = self._views_of(np.arange(len(self)))
        out |= {name: getattr(views, name) for name in _VIEWS}
        out["next_id"] = np.array(self._next_id)
        out["frame"] = np.array(self._frame)
        if self._pool.several:
            out["view_counts"] = self.view_counts
        return out

    def restore(self, state: StateArrays) -> None:
        """Continues from :meth:`state`."""
        counts = state["view_counts"] if self._pool.several else np.ones(len(state["ids"]), int)
        self._clear()
        places = self._pool.load(counts, Views(**{name: state[name] for name in _VIEWS}))
        self._columns.restore(state | {_PLACES: places})
        self._next_id = int(state["next_id"])
        self._frame = int(state["frame"])

    # ----------------------------------------------------------------------------------------

    @property
    def _places(self) -> Places:
        return self._columns[_PLACES]

    def _first_views(self) -> Views:
        return self._pool.at(self._places[:, 0])

    def _views_of(self, rows: IntArray) -> tuple[IntArray, Views]:
        """All views of the rows (k,), and to which of them each belongs."""
        places = self._places[rows]
        owner, column = np.nonzero(places >= 0)
        return owner, self._pool.at(places[owner, column])

    def _reliable(self, rows: IntArray, permanence: PermanenceSettings) -> BoolArray:
        trusted = self.hits[rows] >= self._settings.valid_hits
        return trusted & reliable(self.hits[rows], self.misses[rows], permanence)

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

    def _clear(self) -> None:
        self._remove(np.ones(len(self), np.bool_))
