"""Place recognition beside the loop: the return to a mapped place, and oneself when lost.

Parts of the map between which nothing is measured are joined by it, too: a frame of one that is
recognised in another is a closure between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap, Prediction, Relocalisation, UpdateStats
from fgslam.core.features import LandmarkAppearances, StereoFeatures
from fgslam.core.geometry import inverse
from fgslam.core.measurements import Increment, LoopClosure
from fgslam.core.store import Kept
from fgslam.frontend.features.settings import AppearanceSettings
from fgslam.frontend.places.closures import (
    Confirmation,
    LoopGates,
    close_loop,
    difference,
    drift_allows,
    duplicates,
    is_sharp,
)
from fgslam.frontend.places.sightings import SightingMemory
from fgslam.frontend.tracking.tracker import Association, LandmarkTracker, Tracked

_STREAM = 11  # of random numbers, beside those of the recording
_ONE_PLACE_M, _ONE_PLACE_DEG = 0.3, 5.0
"""What matching around a pose found in the whole map may change of it: several times what such a
pose may be off (frontend.relocalisation.max_sigma_*)."""
_WORDS_EVERY = 16
"""Frames after which the words of new and renewed views are found, half a millisecond's work: the
first look after a long time would find them all at once."""
_Looks: TypeAlias = tuple[int, IntArray, LandmarkAppearances | None]
"""State of the database's views, landmarks (n,), and their appearances then."""
_JOINT = LoopGates()  # how sharp a closure between parts of the map must be
_NOBODY: IntArray = np.empty(0, np.int64)
_NO_PAIRS: IntArray = np.empty((0, 2), np.int64)


class Locator(Protocol):
    """Finds a frame in a map without a prior, as ``frontend.places.relocalisation`` does."""

    def learn(self, landmarks: LandmarkMap, appearances: LandmarkAppearances) -> None:
        """Makes these landmarks the ones to be found."""
        ...

    def locate(self, features: StereoFeatures, rng: np.random.Generator) -> Relocalisation:
        """The frame's pose among them, or why there is none to be believed."""
        ...


@dataclass(frozen=True, slots=True)
class LostRules:
    """Unlocated frames in a row until the whole map is searched, and until mapping goes on."""

    after: int = 2
    give_up_after: int = 10


@dataclass(frozen=True, slots=True, eq=False)
class RecognitionParts:
    """What place recognition works with; loops or lost None where it is not wanted.

    ``joins``: whether the estimator takes closures, so that parts of the map may be joined.
    """

    joins: bool
    loops: LoopGates | None
    lost: LostRules | None
    appearance: AppearanceSettings
    relocaliser: Locator
    seed: int


class PlaceRecognition:
    """Remembers who saw what, looks for returns, and finds the camera when it is lost.

    All of it happens at fixed frames and with random numbers of the frame's own: the same recording
    gives the same closures, interrupted or not.
    """

    memory: Kept[SightingMemory]
    _confirmation: Kept[Confirmation | None]
    _lost: Kept[int]
    _offered: Kept[int]
    merging: Kept[IntArray]
    fuse_since: Kept[int]
    _pose: Kept[FloatArray]

    def __init__(self, parts: RecognitionParts, tracker: LandmarkTracker) -> None:
        """Nothing is remembered yet; the tracker is the run's own, with the map it begins in."""
        self._parts = parts
        self._tracker = tracker
        self.memory = SightingMemory(int(tracker.database.ids.max(initial=-1)))
        self._confirmation = None if parts.loops is None else Confirmation(parts.loops)
        self._lost = 0
        self._offered = -1  # frame of the last closure, taken or not
        self.merging = _NO_PAIRS  # landmarks that are one, by the closure just taken
        self.fuse_since = -1  # a frame: landmarks made after it may be older ones' doubles
        self._pose = np.eye(4)
        self._looks: _Looks = (-1, _NOBODY, None)
        self._find_words()

    @property
    def maps_on(self) -> bool:
        """Whether new landmarks may enter the map: not while it is unknown where they are.

        From the first frame on: with landmarks of its own a robot carried off would not know it.
        """
        lost = self._parts.lost
        return lost is None or not 0 < self._lost < lost.give_up_after

    @property
    def taken(self) -> tuple[bool, ...]:
        """Whether the estimator took the closures so far, in the log's order."""
        return tuple(self.memory.taken)

    @property
    def ending(self) -> IntArray:
        """(m,) landmarks that the last frame's closure showed to be older ones: they end next."""
        return np.asarray(self.merging[:, 0])

    @property
    def wants_features(self) -> bool:
        """Whether the next frame is looked at, so that its features must be found."""
        loops, confirmation = self._parts.loops, self._confirmation
        if self._lost > 0 or self._apart:
            return True
        return (
            loops is not None
            and confirmation is not None
            and self._time_to_look(loops, confirmation)
        )

    # -- lost --------------------------------------------------------------------------------

    def recover(
        self,
        tracked: Tracked,
        landmarks: LandmarkMap,
        features: StereoFeatures,
        guessed: bool = False,
    ) -> tuple[Tracked, bool]:
        """The frame as tracked; or, when that failed for long, as found in the whole map.

        A frame whose motion is ``guessed`` has no other place: it is looked for at once.

        Returns:
            The result, and whether it was found without a prior.
        """
        lost = self._parts.lost
        # Without any landmark yet there is nothing to be lost in.
        located = tracked.ego_motion.status.measured or not len(landmarks)
        self._lost = 0 if located else self._lost + 1
        if self._astray and self._confirmation is not None:
            self._confirmation.forget()  # its frames are to be in a row
        after = 1 if guessed and self._parts.joins else None
        if lost is not None:
            after = lost.after
        if after is None or self._lost < after or not len(features):
            return tracked, False
        found = self._locate(landmarks, self._trusted(), features)
        if not found.found:
            return tracked, False
        around = Prediction(found.wTc, found.covariance)
        anew = self._tracker.track_anew(around, landmarks, features)
        if not anew.ego_motion.status.measured or not _one_place(found.wTc, anew.ego_motion.wTc):
            return tracked, False
        self._lost = 0
        return anew, True

    # -- loops -------------------------------------------------------------------------------

    def placed_by_recent(
        self,
        tracked: Tracked,
        prediction: Prediction,
        landmarks: LandmarkMap,
        features: StereoFeatures,
    ) -> Tracked:
        """Tracking of a frame; of two hypotheses with similar support, that of recent landmarks.

        Back at a place from which a drift has moved the estimate a little, old landmarks are
        matched beside recent ones and contradict them. Until a closure has corrected the map the
        frame is placed by the recent ones: between both it would fit neither, and the landmarks
        that it starts would be misplaced.

        Args:
            tracked: the frame, placed by all landmarks.
            prediction: where it was expected.
            landmarks: the map.
            features: the frame's.
        """
        loops = self._parts.loops
        if loops is None or tracked.ego_motion.coherent:
            return tracked
        old = self.memory.unseen_for(loops.forgotten_after, landmarks.ids)
        recent = self._tracker.track(prediction, landmarks.without(old), features)
        found = recent.ego_motion
        return recent if found.status.measured and found.coherent else tracked

    def look(
        self,
        wTc: FloatArray,
        landmarks: LandmarkMap,
        features: StereoFeatures,
        association: Association,
    ) -> tuple[LoopClosure, ...]:
        """Looks for a return, where it is time to; the closure once it is confirmed.

        Whatever the estimator makes of it, a rest follows: the same place would be offered at every
        look. What a closure means for map and memory waits for its acceptance (:meth:`remember`).

        Args:
            wTc: (4, 4) the frame's pose as tracked.
            landmarks: the map before this frame's update.
            features: the frame's.
            association: which landmarks they are taken for.
        """
        joint = self.find_join(landmarks, features, association)
        if joint is not None:
            return (joint,)
        loops, confirmation = self._parts.loops, self._confirmation
        if loops is None or confirmation is None or not self._time_to_look(loops, confirmation):
            return ()
        found = self._old_place(loops, landmarks, features)
        if found is None or not self._plausible(found, wTc, landmarks, loops):
            confirmation.forget()
            return ()
        if not confirmation.offer(found.wTc, wTc):
            return ()
        confirmation.forget()
        partners = association.partners(len(features))
        closure = self._closure(landmarks, features, found, partners)
        if closure is None or not is_sharp(closure, loops):
            return ()
        self._offered = len(self.memory)
        return (closure,)

    def fuse(self, landmarks: LandmarkMap) -> IntArray:
        """After a closure that was taken: makes one what it shows to be one; identities that end.

        Asked before the next frame is tracked: the estimator has moved the map, and with both of
        two landmarks in it that look alike and lie in one place, neither would be matched.

        Args:
            landmarks: the map as corrected.
        """
        since = self.fuse_since
        if since < 0:
            return _NOBODY
        ended = self._tracker.merge(self.merging)
        self.merging, self.fuse_since = _NO_PAIRS, -1
        left = landmarks.ids[~np.isin(landmarks.ids, ended)]
        new = self.memory.made_after(since, left)
        looks = self._tracker.database.appearances()
        sides = left[new], left[~new]
        pairs = duplicates(landmarks, looks, sides, self._parts.appearance)
        return np.union1d(ended, self._tracker.merge(pairs))

    # -- upkeep ------------------------------------------------------------------------------

    def remember(self, increment: Increment, tracked: FloatArray, stats: UpdateStats) -> None:
        """Books a frame, and prepares what the closures mean that the estimator took.

        Args:
            increment: its measurements.
            tracked: (4, 4) its pose before any loop was closed in it.
            stats: the estimator's pose, and which closures it took.
        """
        taken = [loop for loop, so in zip(increment.loops, stats.closed, strict=True) if so]
        if taken:
            self.merging = np.concatenate([loop.merged for loop in taken])
            since = [self.memory.last_seen(loop.observations.ids) for loop in taken]
            self.fuse_since = min(since)
        step = inverse(self._pose) @ tracked if len(self.memory) else np.eye(4)
        self.memory.add(increment, step, stats.closed)
        self._pose = stats.wTc
        if len(self.memory) % _WORDS_EVERY == 0:
            self._find_words()

    def remake(self) -> None:
        """Words are found before the next look."""
        self._find_words()

    # ----------------------------------------------------------------------------------------

    def _find_words(self) -> None:
        if self._parts.loops is not None or self._parts.lost is not None or self._apart:
            self._tracker.database.find_words()

    @property
    def _apart(self) -> bool:
        return self._parts.joins and self._tracker.parts.several

    def find_join(
        self,
        landmarks: LandmarkMap,
        features: StereoFeatures,
        association: Association,
    ) -> LoopClosure | None:
        """The closure between two parts of the map that a located frame sees; None without one.

        Looked for where the frame was found in another part than the last one, else at every few.
        What places the frame in each is strict enough to be believed of a lost one; no drift could
        tell whether the offset is plausible.
        """
        if not self._apart or not len(features):
            return None
        seen, parts = association.observations, self._tracker.parts
        own = parts.placed_by(seen.ids[~seen.is_new & ~association.rejected])
        moved = not len(parts) or own != parts.of_frame(len(parts) - 1)
        if own < 0 or not (moved or len(self.memory) % _JOINT.every == 0):
            return None
        others = landmarks.ids[parts.of(landmarks.ids) != own]
        if len(others) < _JOINT.min_matches:
            return None
        found = self._locate(landmarks, others, features)
        if not found.found:
            return None
        partners = association.partners(len(features))
        closure = self._closure(landmarks, features, found, partners)
        return closure if closure is not None and is_sharp(closure, _JOINT) else None

    def _closure(
        self,
        landmarks: LandmarkMap,
        features: StereoFeatures,
        found: Relocalisation,
        partners: IntArray,
    ) -> LoopClosure | None:
        resection = self._tracker.resection
        return close_loop(self.memory, landmarks, features, found, partners, resection)

    @property
    def _astray(self) -> bool:
        """Whether it is unknown where the frame is, so that no return would be believed.

        Outside a map that is left as it is, nothing but the odometry ever tells; where nobody
        searches the whole map for the lost, the return to it is a loop like any other.
        """
        outside = self._tracker.keeps_map and self._parts.lost is None
        return self._lost > 0 and not outside

    def _time_to_look(self, loops: LoopGates, confirmation: Confirmation) -> bool:
        frame = len(self.memory)
        if self._astray or (self._offered >= 0 and frame - self._offered <= loops.rest):
            return False
        return confirmation.begun or frame % loops.every == 0

    def _old_place(
        self, loops: LoopGates, landmarks: LandmarkMap, features: StereoFeatures
    ) -> Relocalisation | None:
        """The frame located by landmarks not seen for long, or never; None where it is not."""
        trusted = self._trusted()
        known = trusted[np.isin(trusted, landmarks.ids)]
        old = self.memory.unseen_for(loops.forgotten_after, known)
        if not len(old) or not len(features):
            return None
        found = self._locate(landmarks, old, features)
        return found if found.found else None

    def _trusted(self) -> IntArray:
        """Landmarks seen often enough to be there (Se et al. 6.1)."""
        database = self._tracker.database
        return database.ids[database.valid]

    def _plausible(
        self, found: Relocalisation, wTc: FloatArray, landmarks: LandmarkMap, loops: LoopGates
    ) -> bool:
        earlier = self.memory.best_view_of(found.ids, landmarks)
        if earlier < 0:
            return False
        return drift_allows(found.wTc, wTc, self.memory.way_since(earlier), loops)

    def _locate(
        self, landmarks: LandmarkMap, among: IntArray, features: StereoFeatures
    ) -> Relocalisation:
        rng = np.random.default_rng([self._parts.seed, _STREAM, len(self.memory)])
        self._learn(landmarks, among)
        return self._parts.relocaliser.locate(features, rng)

    def _learn(self, landmarks: LandmarkMap, among: IntArray) -> None:
        """Hands the map to the relocaliser; looks that it has seen keep their index."""
        database = self._tracker.database
        named = np.isin(landmarks.ids, among)
        chosen = landmarks if named.all() else landmarks.select(np.flatnonzero(named))
        changes, ids, looks = self._looks
        if looks is None or changes != database.changes or not np.array_equal(ids, chosen.ids):
            looks = database.appearances(chosen.ids, with_words=True)
            self._looks = database.changes, chosen.ids, looks
        self._parts.relocaliser.learn(chosen, looks)


def _one_place(a: FloatArray, b: FloatArray) -> bool:
    metres, degrees = difference(a, b)
    return metres <= _ONE_PLACE_M and degrees <= _ONE_PLACE_DEG
