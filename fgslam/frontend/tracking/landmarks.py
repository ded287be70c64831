"""The landmark database: identity, appearance and bookkeeping (Se et al. 4 and 6).

Geometry (positions and covariances) belongs to the estimator; the two are joined by landmark ids.
Each entry is [s, o, m, n, l] with a descriptor; the scale is kept as the physical size
``s * Z``, because the image scale is inversely proportional to the depth (3.1). An
entry may be permanent (6.2), and have several views (6.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import (
    BoolArray,
    ByteArray,
    FloatArray,
    GrowingColumns,
    IntArray,
    Rows,
    StateArrays,
)
from fgslam.core.errors import MapError
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig, Increment
from fgslam.core.store import Kept
from fgslam.core.types import (
    LandmarkAppearances,
    LandmarkMap,
    LandmarkPatches,
    StereoFeatures,
    Words,
)
from fgslam.frontend.features.matching import pairs_within, words_of
from fgslam.frontend.settings import DatabaseSettings, PermanenceSettings
from fgslam.frontend.tracking.map_matching import (
    ExpectedLandmarks,
    FieldOfView,
    Wanted,
    directions_to,
    lean,
)

_COUNTS = ("hits", "misses", "missed", "unlooked", "seen", "contradicted")
_PATCH = ("patch", "patch_distance")
_PLACES = "places"
MAX_VIEWS = 8  # of a landmark; a further one replaces that matched longest ago
_VIEW_ANGLE_DEG = 20.0
"""A direction farther than this from every view becomes a view of its own: SIFT descriptors match
up to about this angle (docs/concepts/maps.md)."""
_LEAST_SEARCHES = 4
"""Of key frames, until what they miss is gone."""


class LandmarkDatabase:
    """One row a landmark, ascending in identity; the views lie in a pool of their own.

    Counted frame by frame: hits n, misses m, consecutive misses l. The arrays over landmarks are
    read only by agreement, and good until the next change.
    """

    _pool: Kept[ViewPool]
    next_id: Kept[int]
    _frame: Kept[int]
    _columns: Kept[GrowingColumns]

    def __init__(
        self,
        rig: CameraRig,
        settings: DatabaseSettings,
        max_disparity_px: float,
        patch_pixels: int = 0,
    ) -> None:
        """Starts empty (4.2); landmarks of more than ``max_disparity_px`` are not expected.

        Landmarks that are carried need ``patch_pixels`` for their own patch.
        """
        self._settings = settings
        self._rig = rig
        self._field_of_view = FieldOfView(rig, settings, max_disparity_px)
        views = MAX_VIEWS if settings.viewpoints else 1
        angle = _VIEW_ANGLE_DEG if settings.viewpoints else 0.0
        self._pool = ViewPool(views, float(np.deg2rad(angle)))
        self.next_id = 0
        self._frame = 0
        self._columns = _no_columns(views, patch_pixels)

    def expected(self, landmarks: LandmarkMap, wTc: FloatArray) -> ExpectedLandmarks:
        """Landmarks of the map that should or may be in view from ``wTc`` (4.4)."""
        least = self._settings.least_scale_px
        wanted = None if least is None else self._larger_than(least, landmarks.ids)
        found = self._field_of_view.select(wTc, landmarks.positions, wanted)
        rows = self.rows(landmarks.ids[found.rows])
        directions = directions_to(wTc, found.points) if self._pool.several else None
        places = self._places[rows]
        if directions is None:  # the first view, as near
            views, known = self._pool.at(places[:, 0]), np.ones(len(rows), np.bool_)
        else:  # that nearest to the direction (6.3)
            column, known = self._pool.nearest(places, directions.astype(np.float32))
            views = self._pool.at(places[np.arange(len(rows)), column])
        return ExpectedLandmarks(
            ids=landmarks.ids[found.rows],
            rows=found.rows,
            measurement=found.measurement,
            scale=views.size / found.points[:, 2],
            orientation=views.orientation + lean(self._rig, wTc, found.points),
            descriptors=views.descriptors,
            certain=found.certain & known & self._in_reach(rows, found.points),
        )

    def _larger_than(self, least: float, ids: IntArray) -> Wanted:
        """Predicate on landmarks, by rows and distances: expected scale at least that large."""

        def wanted(rows: IntArray, distance: FloatArray) -> BoolArray:
            places = self._places[self.rows(ids[rows])]
            return np.asarray(self._pool.largest_sizes(places) >= least * distance)

        return wanted

    def _in_reach(self, rows: IntArray, points: FloatArray) -> BoolArray:
        """Landmarks (k,) whose absence from a frame is evidence, at points of its camera.

        From farther than a valid landmark was ever seen a nearer wall hides it, or it is too small:
        as when the drive first came that way. Pruning it would leave no loop to close there.
        """
        near = np.linalg.norm(points, axis=1) <= self.farthest[rows]
        return np.asarray(near | ~self.valid[rows])

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
            directions: (k, 3) from the camera to each, unit, world; None where the caller has none.
        """
        rows = self._hit(ids)
        distances = np.linalg.norm(features.position[which], axis=1)
        self.farthest[rows] = np.maximum(self.farthest[rows], distances)
        places = self._places[rows]
        self._pool.refresh(places, Views.of(features, which, directions, self._frame))
        self._places[rows] = places
        permanence = self._settings.permanence
        if permanence is not None:
            counts = self.hits[rows], self.misses[rows]
            self.permanent[rows] |= self._reliable(*counts, permanence)

    def _hit(self, ids: IntArray) -> IntArray:
        """Counts a hit; returns the rows."""
        rows = self.rows(ids)
        self.missed[rows] = 0
        self._columns["contradicted"][rows] = 0
        self._columns["seen"][rows] = self._frame
        self._columns["unlooked"][rows] = 0
        self.hits[rows] += 1
        return rows

    def _reliable(
        self, hits: IntArray, misses: IntArray, permanence: PermanenceSettings
    ) -> BoolArray:
        valid = hits >= self._settings.valid_hits
        return valid & reliable(hits, misses, permanence)

    def record_misses(self, ids: IntArray) -> None:
        """Type II: expected in view and not matched, in this frame and those that it stands for."""
        rows = self.rows(ids)
        frames = self._stood_for(rows, self._settings.prune_after_misses)
        self.missed[rows] += frames
        self.misses[rows] += frames

    def _stood_for(self, rows: IntArray, enough: int) -> IntArray:
        """(k,) frames that a miss in this one counts: this, and those before that did not look.

        One where every frame searches for landmarks. Several searches must decide, whatever the gap
        between key frames: one adds at most a part of the frames that are ``enough``.
        """
        most = -(-enough // _LEAST_SEARCHES)
        return np.asarray(np.minimum(1 + self._columns["unlooked"][rows], most))

    def weigh(
        self,
        expected: ExpectedLandmarks,
        missing: IntArray,
        rejected: IntArray,
        seen: FloatArray,
    ) -> None:
        """Counts contradictions of permanent landmarks by a located frame; too many demote one.

        It contradicts those missing whose match was rejected as an outlier, and those whose place
        it sees past (``permanence.seen_past``). What hides them is no evidence.

        Args:
            expected: landmarks expected in view.
            missing: identities of those missed.
            rejected: identities of those matched and rejected.
            seen: (f, 3) the frame's stereo features, (column, row, disparity).
        """
        permanence = self._settings.permanence
        if permanence is None or permanence.contradicted_after is None:
            return
        ids = missing[self.permanent[self.rows(missing)]]
        places = expected.measurement[np.searchsorted(expected.ids, ids)]
        against = seen_past(places, seen) | np.isin(ids, rejected)
        ids = ids[against]
        rows = self.rows(ids)
        enough = permanence.contradicted_after
        self._columns["contradicted"][rows] += self._stood_for(rows, enough)
        self.demote(ids[self._columns["contradicted"][rows] >= enough])

    def demote(self, ids: IntArray) -> None:
        """Permanent landmarks become ordinary ones, which go once they have been missed for long.

        Only a hit can make them permanent again.
        """
        rows = self.rows(ids)
        self.permanent[rows] = False
        self._columns["contradicted"][rows] = 0

    def add(
        self,
        features: StereoFeatures,
        which: IntArray,
        colour: ByteArray,
        directions: FloatArray | None = None,
    ) -> IntArray:
        """Type IV: starts a track for each chosen feature (4.2); returns their identities."""
        ids = np.arange(self.next_id, self.next_id + len(which))
        self.next_id += len(which)
        views = Views.of(features, which, directions, self._frame)
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
                "farthest": np.linalg.norm(features.position[which], axis=1),
                **self._as_columns(None, len(ids)),
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
            gone |= ~self.valid & (self._frame >= self._columns["seen"] + forget_after)
        gone &= ~self.permanent
        self._columns["unlooked"][:] = 0
        self._frame += 1
        pruned = self.ids[gone]
        self._remove(gone)
        return pruned

    def record_carried(self, ids: IntArray, not_carried: IntArray) -> None:
        """A whole frame between key frames.

        Args:
            ids: landmarks hit, whose appearance was not described again.
            not_carried: those expected well in view that were not searched for.
        """
        self._hit(ids)
        self._columns["unlooked"][self.rows(not_carried)] += 1
        self._frame += 1

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
        np.maximum.at(self.farthest, to_rows, self.farthest[from_rows])
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

    def _require_mergeable(self, ends: IntArray, stays: IntArray) -> None:
        unknown = np.setdiff1d(np.concatenate([ends, stays]), self.ids)
        if len(unknown):
            raise ValueError(f"landmarks {unknown[:5].tolist()} are not in the database")
        if len(np.unique(ends)) < len(ends) or np.isin(ends, stays).any():
            raise ValueError("a landmark can end only once, and not stay as well")

    def drop(self, ids: IntArray) -> None:
        """Forgets landmarks (k,); those that it does not hold are none."""
        self._remove(np.isin(self.ids, ids))

    def _remove(self, gone: BoolArray) -> None:
        if gone.any():
            self._pool.release(self._places[gone])
            self._columns.drop(gone)

    # -- what it holds -------------------------------------------------------------------------

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
    def farthest(self) -> FloatArray:
        """(n,) metres, from how far each was ever seen."""
        return self._columns["farthest"]

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
        return self.permanent | self._reliable(self.hits, self.misses, self._settings.permanence)

    def rows(self, ids: IntArray) -> IntArray:
        """Rows of landmarks that are in the database; ids ascending in it."""
        return np.searchsorted(self.ids, ids)

    def appearances(
        self, ids: IntArray | None = None, with_words: bool = False
    ) -> LandmarkAppearances:
        """All views of all landmarks, or of those named (ascending); matched longest ago first.

        ``with_words`` for a search among them: each word is found once in a view's life.
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

    @property
    def _places(self) -> Places:
        return self._columns[_PLACES]

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

    def described_lately(self, frames: int) -> IntArray:
        """Identities (k,) described by the last frame that described any, or ``frames`` before.

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

    # -- from a saved map ----------------------------------------------------------------------

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
                "farthest": saved.farthest,
                **self._as_columns(saved.patches, len(ids)),
            }
        )
        self.next_id = int(ids[-1]) + 1 if len(ids) else 0
        self._frame = 0

    def _clear(self, patch_pixels: int) -> None:
        """No landmark; room for patches of so many pixels, at least, whatever began in them.

        A session that carries none keeps those of its map for the next one.
        """
        self._remove(np.ones(len(self), np.bool_))
        if patch_pixels > self.patch_pixels:
            self._columns = _no_columns(self._places.shape[1], patch_pixels)

    def _as_columns(self, patches: LandmarkPatches | None, count: int) -> StateArrays:
        """Own patches as this table keeps them; none where they are not known, or not kept."""
        pixels = self.patch_pixels
        if patches is None or not (pixels and patches.kept):
            patches = LandmarkPatches.none(count, pixels)
        return {"patch": patches.grey, "patch_distance": patches.distances}


def _no_columns(max_views: int, patch_pixels: int) -> GrowingColumns:
    count = np.empty(0, np.int64)
    return GrowingColumns(
        ids=count,
        colour=np.empty(0, np.uint8),
        permanent=np.empty(0, np.bool_),
        places=np.empty((0, max_views), np.int32),
        patch=np.empty((0, patch_pixels), np.uint8),
        patch_distance=np.empty(0),
        farthest=np.empty(0),
        **dict.fromkeys(_COUNTS, count),
    )


def reliable(hits: IntArray, misses: IntArray, settings: PermanenceSettings) -> BoolArray:
    """Landmarks (n,) seen often enough, at a share of the frames in which they were expected."""
    enough = hits >= settings.hits
    return np.asarray(enough & (hits > settings.ratio * (hits + misses)))


def is_blind(expected: ExpectedLandmarks, hit: BoolArray, settings: PermanenceSettings) -> bool:
    """True if so few of the landmarks well in view were matched (v,) that the view is blocked."""
    certain = int(expected.certain.sum())
    return int((hit & expected.certain).sum()) < settings.blind_below * certain


NEAR_PX = 40.0  # what is seen past a place is this near to it in the image
_APART_PX = 2.0
"""What lies before or behind a place has a disparity that differs by more."""


def seen_past(places: FloatArray, seen: FloatArray) -> BoolArray:
    """Places (m,) that the cameras see past, so that what is missed there is not there.

    Near the place in the image something lies behind it, and nothing before it that might hide it.
    That what surrounds a missed landmark is recognised is no evidence: true landmarks are missed in
    many frames in a row for their scale or direction, while others next to them are not.

    Args:
        places: (m, 3) predicted (column, row, disparity) of missed landmarks.
        seen: (f, 3) the frame's stereo features.
    """
    reach = NEAR_PX
    i, j = pairs_within(places[:, 1], reach, seen[:, 1])
    near = np.hypot(*(seen[j, :2] - places[i, :2]).T) <= reach
    i, j = i[near], j[near]
    nearer_by = seen[j, 2] - places[i, 2]
    hidden, past = np.zeros(len(places), np.bool_), np.zeros(len(places), np.bool_)
    hidden[i[nearer_by > _APART_PX]] = True
    past[i[nearer_by < -_APART_PX]] = True
    return past & ~hidden


# ------------------------------------------------------------------------------------------
# Appearance of landmarks, seen from one or several directions (Se et al. 6.3)

Places = npt.NDArray[np.int32]
"""(n, max_views) places in the pool; -1 where there is no view."""
Directions = npt.NDArray[np.float32]
"""(v, 3) unit vectors, camera to landmark, world; NaN where unknown."""
_LEAST = 64
_GROWTH = 1.5
_UNKNOWN = -1  # word of a view for which none was asked


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
        """Words are found again, of all views that were put back."""
        self._words = np.full(len(self._size), _UNKNOWN, np.int16)
        self.changes += 1

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


# ------------------------------------------------------------------------------------------
# Parts of a map between which nothing is measured: what is begun again after a gap

_HOLD = 6
"""Landmarks of a part that place a frame in it, next to those of another: by chance none agree."""
_FIRST = 0


class MapParts:
    """To which part landmarks and frames belong; the first one holds the world's frame.

    A saved map that a run begins in is of the first part.
    """

    _of: Kept[IntArray]
    _known: Kept[int]
    _several: Kept[bool]
    _frames: Kept[list[int]]
    _newest: Kept[int]

    def __init__(self) -> None:
        """Nothing is there yet."""
        self._of = np.empty(0, np.int64)  # with room for more: identities only grow
        self._known = 0
        self._several = False
        self._frames = []
        self._newest = _FIRST

    def __len__(self) -> int:
        """Frames recorded."""
        return len(self._frames)

    @property
    def several(self) -> bool:
        """Whether landmarks were ever begun at a guess that nothing has confirmed since."""
        return self._several

    @property
    def _landmarks(self) -> IntArray:
        return self._of[: self._known]

    def of(self, ids: IntArray) -> IntArray:
        """The part of each landmark (k,)."""
        out = np.full(len(ids), _FIRST)
        known = ids < len(self._landmarks)
        out[known] = self._landmarks[ids[known]]
        return out

    def of_frame(self, frame: int) -> int:
        """The part of a frame, counted from 0."""
        return self._frames[frame]

    @property
    def connected(self) -> BoolArray:
        """(n,) frames that are connected with the first one by measurements."""
        return np.asarray(np.array(self._frames, np.int64) == _FIRST)

    def placed_by(self, ids: IntArray) -> int:
        """The part that most of the landmarks (k,) belong to, the oldest of several; -1 of none."""
        return int(np.argmax(np.bincount(self.of(ids)))) if len(ids) else -1

    def record(self, increment: Increment, closed: tuple[bool, ...]) -> None:
        """Takes in a frame; ``closed``: which of its loops the estimator took."""
        seen = increment.observations
        held = self._held_by(seen.ids[~seen.is_new & ~increment.rejected], increment)
        if not held:
            self._newest += bool(len(self._landmarks))  # before any landmark, the start moves on
            held = {self._newest if len(self._landmarks) else _FIRST}
        for loop, taken in zip(increment.loops, closed, strict=True):
            held |= {self._frames[loop.frame]} if taken else set()
        part = min(held)
        self._join(held, part)
        self._frames.append(part)
        self._begin(seen.ids[seen.is_new], part)

    def _held_by(self, used: IntArray, increment: Increment) -> set[int]:
        """Parts that place a frame: by landmarks, or by odometry from the frame before."""
        counts = np.bincount(self.of(used), minlength=1)
        held = set(np.flatnonzero(counts >= min(_HOLD, max(int(counts.max()), 1))).tolist())
        odometry = increment.odometry
        if self._frames and odometry is not None and odometry.measured:
            held |= set() if increment.relocalised else {self._frames[-1]}
        return held

    def _join(self, held: set[int], part: int) -> None:
        """Makes these parts one."""
        if len(held) > 1:
            self._landmarks[np.isin(self._landmarks, list(held))] = part
            self._several = bool((self._landmarks != _FIRST).any())
            self._frames = [part if one in held else one for one in self._frames]

    def _begin(self, ids: IntArray, part: int) -> None:
        if not len(ids):
            return
        known = max(int(ids.max()) + 1, self._known)
        if known > len(self._of):
            self._of = np.concatenate([self._of, np.full(known, _FIRST)])
        self._known = known
        self._of[ids] = part
        self._several |= part != _FIRST
