"""The landmark database: identity, appearance and bookkeeping (Se et al. 4 and 6).

Geometry (positions and covariances) belongs to the estimator; the two are joined by landmark ids.
Each entry is [s, o, m, n, l] with a descriptor; the scale is kept as the physical size
``s * Z``, because the image scale is inversely proportional to the depth (3.1). An
entry may be permanent (6.2), and have several views (6.3).
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.features import StereoFeatures
from fgslam.core.sensors import CameraRig
from fgslam.frontend.features.matching import pairs_within
from fgslam.frontend.settings import DatabaseSettings, PermanenceSettings
from fgslam.frontend.tracking.landmark_table import LandmarkTable
from fgslam.frontend.tracking.map_matching import (
    ExpectedLandmarks,
    FieldOfView,
    Wanted,
    directions_to,
    lean,
)
from fgslam.frontend.tracking.views import Views

MAX_VIEWS = 8  # of a landmark; a further one replaces that matched longest ago
_VIEW_ANGLE_DEG = 20.0
"""A direction farther than this from every view becomes a view of its own: SIFT descriptors match
up to about this angle (docs/concepts/maps.md)."""

_LEAST_LOOKS = 4
"""Of key frames, until what they miss is gone."""


class LandmarkDatabase(LandmarkTable):
    """Landmark table updated frame by frame: hits n, misses m, consecutive misses l."""

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
        if settings.viewpoints:
            super().__init__(MAX_VIEWS, float(np.deg2rad(_VIEW_ANGLE_DEG)), patch_pixels)
        else:
            super().__init__(1, 0.0, patch_pixels)
        self._settings = settings
        self._rig = rig
        self._field_of_view = FieldOfView(rig, settings, max_disparity_px)

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

    def expected(self, landmarks: LandmarkMap, wTc: FloatArray) -> ExpectedLandmarks:
        """Landmarks of the map that should or may be in view from ``wTc`` (4.4)."""
        least = self._settings.least_scale_px
        wanted = None if least is None else self._larger_than(least, landmarks.ids)
        found = self._field_of_view.select(wTc, landmarks.positions, wanted)
        rows = self.rows(landmarks.ids[found.rows])
        directions = directions_to(wTc, found.points) if self._pool.several else None
        views, known = self._views_from(rows, directions)
        return ExpectedLandmarks(
            ids=landmarks.ids[found.rows],
            rows=found.rows,
            measurement=found.measurement,
            scale=views.size / found.points[:, 2],
            orientation=views.orientation + lean(self._rig, wTc, found.points),
            descriptors=views.descriptors,
            certain=found.certain & known,
        )

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
        rows = self._hit(ids)
        self._refresh(rows, Views.of(features, which, directions, self._frame))
        permanence = self._settings.permanence
        if permanence is not None and permanence.when == "running":
            counts = self.hits[rows], self.misses[rows]
            self.permanent[rows] |= self._reliable(*counts, permanence)

    def record_carried(self, ids: IntArray, not_carried: IntArray) -> None:
        """A whole frame between key frames.

        Args:
            ids: landmarks hit, whose looks nobody has described anew.
            not_carried: those expected well in view that nobody looked for.
        """
        self._hit(ids)
        self._columns["unlooked"][self.rows(not_carried)] += 1
        self._frame += 1

    def record_misses(self, ids: IntArray) -> None:
        """Type II: expected in view and not matched, in this frame and those that it stands for."""
        rows = self.rows(ids)
        frames = self._stood_for(rows, self._settings.prune_after_misses)
        self.missed[rows] += frames
        self.misses[rows] += frames

    def weigh(
        self,
        expected: ExpectedLandmarks,
        missing: IntArray,
        rejected: IntArray,
        seen: FloatArray,
    ) -> None:
        """Counts contradictions of permanent landmarks by a located frame; too many demote one.

        It contradicts those missing whose match was rejected as an outlier, and those whose place
        it sees past (``permanence.seen_past``). What hides them says nothing.

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
        self._append(ids, views, colour)
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

    # ----------------------------------------------------------------------------------------

    def _stood_for(self, rows: IntArray, enough: int) -> IntArray:
        """(k,) frames that a miss in this one counts: this, and those before that did not look.

        One where every frame looks for landmarks. Several looks must decide, whatever the gap
        between key frames: one adds at most a part of the frames that are ``enough``.
        """
        most = -(-enough // _LEAST_LOOKS)
        return np.asarray(np.minimum(1 + self._columns["unlooked"][rows], most))

    def _hit(self, ids: IntArray) -> IntArray:
        """Counts a hit; returns the rows."""
        rows = self.rows(ids)
        self.missed[rows] = 0
        self._columns["contradicted"][rows] = 0
        self._columns["seen"][rows] = self._frame
        self._columns["unlooked"][rows] = 0
        self.hits[rows] += 1
        return rows

    def _larger_than(self, least: float, ids: IntArray) -> Wanted:
        """Predicate on landmarks, by rows and distances: expected scale at least that large."""

        def wanted(rows: IntArray, distance: FloatArray) -> BoolArray:
            return np.asarray(self._largest_sizes(self.rows(ids[rows])) >= least * distance)

        return wanted

    def _reliable(
        self, hits: IntArray, misses: IntArray, permanence: PermanenceSettings
    ) -> BoolArray:
        valid = hits >= self._settings.valid_hits
        return valid & reliable(hits, misses, permanence)


NEAR_PX = 40.0  # what is seen past a place is this near to it in the image
_APART_PX = 2.0
"""What lies before or behind a place has a disparity that differs by more."""


def reliable(hits: IntArray, misses: IntArray, settings: PermanenceSettings) -> BoolArray:
    """Landmarks (n,) seen often enough, at a share of the frames in which they were expected."""
    enough = hits >= settings.hits
    return np.asarray(enough & (hits > settings.ratio * (hits + misses)))


def is_blind(expected: ExpectedLandmarks, hit: BoolArray, settings: PermanenceSettings) -> bool:
    """True if so few of the landmarks well in view were matched (v,) that the view is blocked."""
    certain = int(expected.certain.sum())
    return int((hit & expected.certain).sum()) < settings.blind_below * certain


def seen_past(places: FloatArray, seen: FloatArray) -> BoolArray:
    """Places (m,) that the cameras see past, so that what is missed there is not there.

    Near the place in the image something lies behind it, and nothing before it that might hide it.
    That what surrounds a missed landmark is recognised says nothing: true landmarks are missed in
    many frames in a row for their scale or direction, while others beside them are not
    (docs/concepts/maps.md has the numbers).

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
