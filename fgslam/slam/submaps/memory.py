"""Which landmarks are in memory: those around the robot. The others wait on disk, in sub-maps.

A landmark's *place* is where it stands; that of a distant one lies on the ray from where it was
first seen, at half the radius, so that the places of all it can be seen from are near. Places fall
into cubes of half the radius. A cube that is far from the robot and in which nothing was seen
lately becomes a sub-map, a file; it comes back when the robot comes near, or recognises it. What is
not in memory is measured by nobody: nothing of it changes but the frame that it lies in, when a
closure moves the poses at which it was first seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from fgslam.backend.filters.set_aside import SetsAside
from fgslam.backend.protocol import Estimator
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, StateArrays
from fgslam.core.errors import ConfigError, OutputError
from fgslam.core.estimates import LandmarkMap
from fgslam.core.features import StereoFeatures
from fgslam.core.files import make_subfolder
from fgslam.core.geometry import inverse
from fgslam.core.sensors import CameraRig
from fgslam.frontend.places.word_index import WordIndex, pair_words
from fgslam.frontend.tracking.database import LandmarkDatabase
from fgslam.slam.submaps.files import FILES, SubMap, file_of, read_submap, write_submap
from fgslam.slam.submaps.whole import WholeMap

if TYPE_CHECKING:  # loads what only recognition needs
    from fgslam.frontend.places.recognition import Locator, PlaceRecognition

_CUBE = 0.5  # side, of the radius
_FAR = 1.6  # distance of a cube's middle, of the radius: 0.17 beyond where it would come back
_STEP = 0.125  # of the radius: way between two looks at what is far
_LATELY = 30  # frames: what was matched in them stays; as long counts as a return to a place
_GUEST_FRAMES = 60  # in which a place that was recognised stays, though the robot seems elsewhere
_TRIED, _TRIED_LOST = 1, 3  # sub-maps that a frame is compared with by geometry
_DRIFT_M = 0.5  # that needs no way to have come about, as for closures
_STREAM = 13  # of random numbers, beside those of the recording
_STAYS = -1


class MapEstimator(Estimator, SetsAside, Protocol):
    """An estimator whose landmarks may leave its memory."""


@dataclass(frozen=True, slots=True)
class ActiveArea:
    """What is kept in memory, and where the rest goes.

    Attributes:
        radius_m: landmarks farther from the robot may leave.
        folder: of the sub-maps; it is made when the first is written.
        resumable: files that are done with stay until :meth:`SubMaps.tidy`: a checkpoint may need
            them.
    """

    radius_m: float
    folder: Path
    resumable: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Stored:
    """What stays in memory of a sub-map, beside its words.

    Attributes:
        number: of its file.
        landmarks: how many.
        anchor: frame beside which it lies; -1 where no closure moves it.
        centre: (3,) of its places, in that frame's camera, or in the world.
        reach_m: of its places from there.
        way_m: that had been driven when it was written.
    """

    number: int
    landmarks: int
    anchor: int
    centre: FloatArray
    reach_m: float
    way_m: float


@dataclass(frozen=True)
class SubMapParts:
    """The parts of a session that sub-maps are cut from and come back to.

    ``settling``: frames in which all stays in memory, as a new calibration may move the map.
    """

    rig: CameraRig
    database: LandmarkDatabase
    estimator: MapEstimator
    places: PlaceRecognition | None
    relocaliser: Locator
    max_drift_share: float
    seed: int
    settling: int = 0


class SubMaps:
    """Landmarks far from the robot, on disk."""

    def __init__(self, area: ActiveArea, parts: SubMapParts) -> None:
        """All landmarks are in memory yet.

        How many sub-maps came back is counted in ``came_near`` and ``recognised``.
        """
        self._area = area
        self._parts = parts
        self._stored: dict[int, _Stored] = {}
        self._index = WordIndex()
        self._next = 0
        self._stale: list[int] = []
        self._frame = 0
        self._way = 0.0
        self._here = np.full(3, np.nan)
        self._looked = np.full(3, np.nan)
        self._guest = np.full(3, np.nan)
        self._guest_until = -1
        self.came_near = 0
        self.recognised = 0
        self._whole: WholeMap | None = None
        self._refresh()

    def __len__(self) -> int:
        """Sub-maps on disk."""
        return len(self._stored)

    @property
    def landmarks(self) -> int:
        """Landmarks on disk."""
        return sum(one.landmarks for one in self._stored.values())

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is to be said of them; nothing while all landmarks are in memory."""
        if not self._next:
            return ()
        return (
            f"{self.landmarks} landmarks are on disk, in {len(self)} sub-maps; {self.came_near} "
            f"sub-maps came back when the robot came near, {self.recognised} by recognition",
        )

    # -- the loop ----------------------------------------------------------------------------

    def before(self, wTc: FloatArray) -> None:
        """Brings in what lies near the pose (4, 4) that the next frame is expected at.

        Raises:
            MapError: a sub-map is missing or damaged.
        """
        self._whole = None
        near = self._within(wTc[:3, 3], self._area.radius_m)
        self.came_near += len(near)
        self._bring(near)

    def after(self, wTc: FloatArray, features: StereoFeatures | None, corrected: bool) -> None:
        """Ends a frame: what is far goes to disk; what is recognised among it comes back.

        Args:
            wTc: (4, 4) the frame's pose.
            features: the frame's, with descriptors; None where they were not found.
            corrected: a closure has moved earlier poses.

        Raises:
            OutputError: a sub-map cannot be written.
            MapError: one is missing or damaged.
        """
        here = wTc[:3, 3]
        if self._frame:
            self._way += float(np.linalg.norm(here - self._here))
        self._here = here
        self._frame += 1
        if corrected:
            self._refresh()
        settled = self._frame > self._parts.settling
        if settled and not np.linalg.norm(here - self._looked) < _STEP * self._area.radius_m:
            self._looked = here
            self._put_away()
        if features is not None and len(features):
            self._recall(features)

    # -- results and resuming ----------------------------------------------------------------

    def whole(self) -> WholeMap:
        """All landmarks, in memory and on disk, until the next frame."""
        if self._whole is None:
            folder = make_subfolder(self._area.folder.parent, self._area.folder.name)
            self._whole = WholeMap.of(self._pieces, self._parts.database, folder)
        return self._whole

    def state(self) -> StateArrays:
        """What the files do not tell."""
        stored = list(self._stored.values())
        words = [self._index.words(one.number) for one in stored]
        return {
            "numbers": np.array([(s.number, s.landmarks, s.anchor) for s in stored], np.int64),
            "centres": np.array([s.centre for s in stored]).reshape(-1, 3),
            "extents": np.array([(s.reach_m, s.way_m) for s in stored]).reshape(-1, 2),
            "words": np.concatenate([np.empty(0, np.int32), *words]),
            "word_counts": np.array([len(one) for one in words], np.int64),
            "counts": np.array([self._next, self._frame, self._guest_until]),
            "came_back": np.array([self.came_near, self.recognised]),
            "way": np.array(self._way),
            "positions": np.array([self._here, self._looked, self._guest]),
        }

    def restore(self, state: StateArrays) -> None:
        """Continues from :meth:`state` and the files; the estimator has been restored before.

        Raises:
            OutputError: a file is missing.
        """
        self._stored, self._index, self._whole = {}, WordIndex(), None
        words = np.split(state["words"], np.cumsum(state["word_counts"])[:-1])
        rows = zip(
            state["numbers"].reshape(-1, 3).tolist(),
            state["centres"],
            state["extents"].tolist(),
            strict=True,
        )
        for k, ((number, landmarks, anchor), centre, (reach, way)) in enumerate(rows):
            one = _Stored(number, landmarks, anchor, centre, reach, way)
            self._stored[one.number] = one
            self._index.add(one.number, words[k])
        self._next, self._frame, self._guest_until = state["counts"].tolist()
        self.came_near, self.recognised = state["came_back"].tolist()
        self._way = float(state["way"])
        self._here, self._looked, self._guest = state["positions"]
        self._match_files()
        self._stale = []
        self._refresh()

    def tidy(self) -> None:
        """Removes the files of sub-maps that have come back: no state needs them any more."""
        for number in self._stale:
            file_of(self._area.folder, number).unlink(missing_ok=True)
        self._stale = []

    # ----------------------------------------------------------------------------------------

    def _put_away(self) -> None:
        """Writes the cubes that are far from all that is kept, and forgets their landmarks."""
        ids = np.intersect1d(
            self._parts.estimator.landmarks().ids, self._parts.database.ids, assume_unique=True
        )
        if not len(ids):
            return
        places, side = self._places(ids), _CUBE * self._area.radius_m
        cubes, cube = np.unique(np.floor(places / side), axis=0, return_inverse=True)
        cube = cube.reshape(-1)
        far = self._far((cubes + 0.5) * side)
        seen = ~self._parts.database.unseen_for(_LATELY)[self._parts.database.rows(ids)]
        far[cube[seen | ~self._parts.estimator.settled(ids)]] = False
        for k in np.flatnonzero(far).tolist():
            self._store(ids[cube == k], places[cube == k])
        if far.any():
            self._refresh()

    def _far(self, centres: FloatArray) -> BoolArray:
        """Which middles (n, 3) of cubes are far from the robot, and from a place recognised."""
        kept = [self._here]
        if self._frame < self._guest_until:
            kept.append(self._guest)
        apart = [np.linalg.norm(centres - one, axis=1) for one in kept]
        return np.asarray(np.min(apart, axis=0) >= _FAR * self._area.radius_m)

    def _places(self, ids: IntArray) -> FloatArray:
        """Places (n, 3) of landmarks in memory."""
        estimator = self._parts.estimator
        landmarks = estimator.landmarks()
        rows = landmarks.rows(ids)
        positions, homes = landmarks.positions[rows], estimator.homes[rows]
        frames, which = np.unique(np.maximum(homes, 0), return_inverse=True)
        rays = positions - estimator.poses_of(frames)[which.reshape(-1), :3, 3]
        beyond = np.linalg.norm(rays, axis=1) - _CUBE * self._area.radius_m
        beyond[homes < 0] = 0.0
        share = np.maximum(beyond, 0.0) / np.maximum(beyond + _CUBE * self._area.radius_m, 1e-9)
        return np.asarray(positions - share[:, None] * rays)

    def _store(self, ids: IntArray, places: FloatArray) -> None:
        """Makes landmarks (ascending) a sub-map."""
        parts, number = self._parts, self._next
        submap = SubMap(parts.estimator.held_aside(ids), parts.database.held_aside(ids))
        make_subfolder(self._area.folder.parent, self._area.folder.name)
        write_submap(submap, parts.rig, file_of(self._area.folder, number))
        parts.estimator.give_up(ids)
        parts.database.give_up(ids)
        self._next += 1
        middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
        reach = float(np.linalg.norm(places - middle, axis=1).max())
        anchor = int(np.sort(submap.geometry.homes)[len(ids) // 2])
        if anchor != _STAYS:
            middle = _moved(inverse(parts.estimator.poses_of(np.array([anchor]))[0]), middle)
        self._stored[number] = _Stored(number, len(ids), anchor, middle, reach, self._way)
        self._index.add(number, pair_words(submap.entries["descriptors"]))

    def _bring(self, numbers: IntArray) -> None:
        """Sub-maps come back."""
        for number in numbers.tolist():
            submap = self._read(number)
            self._parts.estimator.take_back(submap.geometry)
            self._parts.database.take_back(submap.entries)
            del self._stored[number]
            self._index.remove(number)
            self._stale.append(number)
        if len(numbers):
            self._refresh()
            if not self._area.resumable:
                self.tidy()

    def _recall(self, features: StereoFeatures) -> None:
        """Brings in what lies around the frame's place among the sub-maps, if it has one there."""
        places = self._parts.places
        if places is None or not self._stored or not (places.lost or places.wants_features):
            return
        number, found = self.recognise(features, places.lost)
        if number >= 0:
            self._guest, self._guest_until = found, self._frame + _GUEST_FRAMES
            around = np.union1d(self._within(found, self._area.radius_m), [number])
            self.recognised += len(around)
            self._bring(around)

    def recognise(self, features: StereoFeatures, lost: bool) -> tuple[int, FloatArray]:
        """The sub-map on disk that a frame sees, and where the frame is; nothing is changed.

        Args:
            features: the frame's, with descriptors.
            lost: whether it may be anywhere, or only as far off as a drift takes it.

        Returns:
            Number of the sub-map and position (3,) in the world; -1 and NaN where there is none.
        """
        among = self._numbers if lost else self._within_drift()
        ranked = self._index.rank(features.descriptors, among, surely=not lost)
        for number in ranked[: _TRIED_LOST if lost else _TRIED].tolist():
            found = self._place_in(self._read(number), features)
            if found is not None:
                return int(number), found
        return -1, np.full(3, np.nan)

    def _place_in(self, submap: SubMap, features: StereoFeatures) -> FloatArray | None:
        """Where (3,) a sub-map's landmarks place the frame without a prior; None if nowhere."""
        parts, held = self._parts, submap.entries
        landmarks = self._now(submap)
        sure = landmarks.select(held["permanent"] | parts.database.are_valid(held["hits"]))
        parts.relocaliser.learn(sure, submap.appearances.of(sure.ids))
        rng = np.random.default_rng([parts.seed, _STREAM, self._frame])
        found = parts.relocaliser.locate(features, rng)
        return found.wTc[:3, 3] if found.found else None

    def _within(self, position: FloatArray, metres: float) -> IntArray:
        """Sub-maps with a place so near to a position (3,)."""
        apart = np.linalg.norm(self._centres - position, axis=1) - self._reach
        return np.asarray(self._numbers[apart <= metres])

    def _within_drift(self) -> IntArray:
        """Sub-maps in which the robot may be: no closure would be believed of a larger drift."""
        apart = np.linalg.norm(self._centres - self._here, axis=1) - self._reach
        drift = _DRIFT_M + self._parts.max_drift_share * (self._way - self._written_at)
        return np.asarray(self._numbers[apart <= self._area.radius_m + drift])

    def _refresh(self) -> None:
        """Where all sub-maps are now."""
        stored = list(self._stored.values())
        anchors = np.array([one.anchor for one in stored], np.int64)
        poses = np.tile(np.eye(4), (len(stored), 1, 1))
        moving = anchors != _STAYS
        poses[moving] = self._parts.estimator.poses_of(anchors[moving])
        centres = np.array([one.centre for one in stored]).reshape(-1, 3)
        self._centres = np.einsum("nij,nj->ni", poses[:, :3, :3], centres) + poses[:, :3, 3]
        self._numbers = np.array([one.number for one in stored], np.int64)
        self._reach = np.array([one.reach_m for one in stored])
        self._written_at = np.array([one.way_m for one in stored])

    def _read(self, number: int) -> SubMap:
        return read_submap(file_of(self._area.folder, number), self._stored[number].landmarks)

    def _now(self, submap: SubMap) -> LandmarkMap:
        poses = self._parts.estimator.poses_of(submap.geometry.frames)
        return submap.geometry.moved(poses).landmarks

    def _pieces(self) -> Iterator[tuple[LandmarkMap, SubMap]]:
        """What is in memory and has not ended, then each sub-map."""
        parts = self._parts
        landmarks = parts.estimator.estimate().landmarks
        landmarks = landmarks.select(np.isin(landmarks.ids, parts.database.ids))
        ids = landmarks.ids
        yield landmarks, SubMap(parts.estimator.held_aside(ids), parts.database.held_aside(ids))
        for number in self._stored:
            submap = self._read(number)
            yield parts.estimator.reported(submap.geometry), submap

    def _match_files(self) -> None:
        """All files are there; those of later frames than the state's go: these come again."""
        folder = self._area.folder
        for number in self._stored:
            if not file_of(folder, number).is_file():
                raise OutputError(
                    f"{file_of(folder, number)}: this sub-map of the run is missing; restore the "
                    "file, or run again with --overwrite"
                )
        for path in folder.glob(FILES):
            if int(path.stem) not in self._stored:
                path.unlink(missing_ok=True)


def _moved(transform: FloatArray, point: FloatArray) -> FloatArray:
    return np.asarray(transform[:3, :3] @ point + transform[:3, 3])


def require_sets_aside(estimator: Estimator) -> MapEstimator:
    """The estimator, if its landmarks may leave its memory. Raises ConfigError where not."""
    if not isinstance(estimator, SetsAside):
        raise ConfigError(
            f"map.active_radius_m: estimator {estimator.kind} keeps every landmark in memory; use "
            "landmark_kalman, landmark_kalman_graph or fixed_lag, or leave the radius out"
        )
    return cast("MapEstimator", estimator)
