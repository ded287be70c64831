"""Place recognition next to the loop: the return to a mapped place, and oneself when lost.

Parts of the map between which nothing is measured are joined by it, too: a frame of one that is
recognised in another is a closure between them.
"""

from __future__ import annotations

import itertools
from bisect import bisect_right
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.sparse import lil_array
from scipy.sparse.csgraph import dijkstra

from fgslam.core.arrays import BoolArray, FloatArray, GrowingColumns, IntArray
from fgslam.core.geometry import adjoint, congruence, inverse, se3_log
from fgslam.core.sensors import Increment, LoopClosure, Observations
from fgslam.core.store import Kept
from fgslam.core.types import (
    EgoMotion,
    LandmarkAppearances,
    LandmarkMap,
    Prediction,
    Relocalisation,
    StereoFeatures,
    UpdateStats,
)
from fgslam.frontend.features.matching import choose
from fgslam.frontend.places.relocalisation import Relocaliser
from fgslam.frontend.settings import AppearanceSettings
from fgslam.frontend.tracking.ego_motion import PoseProblem, Resection
from fgslam.frontend.tracking.tracker import Association, LandmarkTracker, Tracked

# ------------------------------------------------------------------------------------------
# Who saw what, frame by frame: what a return is recognised against

_RETURN_FRAMES = 30  # unseen for so long: tracking them again ties the frame to an older one
_RETURN_MATCHES = 10  # of them, as for the ties of the filter's backward correction; so many of a
# given map's landmarks, whenever seen last, tie a frame to that map
_LEAST_M = 1e-6  # of an edge: none at all is no edge


class SightingMemory:
    """Observations of all frames so far, and when each landmark was last seen.

    A closure that the estimator refused is none: neither a return nor a sighting of the
    landmarks that it names.

    A run may begin in a map. That map is one place, whatever of it the run has seen: frames tied to
    it do not drift apart, and what the run has yet to see of it was "seen" where the run entered.

    Attributes:
        frames: what was measured, which the log of the run holds.
        taken: whether the estimator took the log's closures, in their order.
    """

    _given: Kept[int]
    _seen: Kept[GrowingColumns]
    _starts: Kept[list[int]]
    _way: Kept[list[float]]
    _newest: Kept[list[int]]
    _returns: Kept[list[tuple[int, int]]]
    _ties: Kept[list[int]]
    _on_map: Kept[bool]
    _last_seen: Kept[IntArray]
    taken: Kept[list[bool]]

    def __init__(self, given: int = -1) -> None:
        """Nothing was seen yet; ``given`` is the last identity of the map it all begins in."""
        self._given = given
        self.frames: list[Increment] = []
        self._seen = GrowingColumns(ids=np.empty(0, np.int32))
        self._starts = []
        self._way = []
        self._newest = []
        self._returns = []
        self._ties = []
        self._on_map = False
        self._last_seen = np.full(given + 1, -1)
        self.taken = []

    def __len__(self) -> int:
        return len(self._starts)

    def add(self, increment: Increment, step: FloatArray, closed: tuple[bool, ...] = ()) -> None:
        """Books a frame.

        Args:
            increment: its measurements.
            step: (4, 4) the camera's motion since the frame before, as estimated.
            closed: for each of its loops, whether the estimator took it.
        """
        way = self._way[-1] if self._way else 0.0
        self._book(increment, closed)
        held = self._ties[-2:] == [len(self) - 2, len(self) - 1]  # both by the map, not by the step
        self._way.append(way if held else way + float(np.linalg.norm(step[:3, 3])))

    def way_since(self, frame: int) -> float:
        """Metres along which the estimate can have drifted away from a frame's surroundings.

        The way driven since, but cut short where a place was seen again in between: what was tied
        there has drifted no farther apart than the rest of the way allows. Nor does a way count
        along which a given map was in view.
        """
        nodes = sorted({frame, len(self._way) - 1, *itertools.chain(*self._returns)})
        at = {node: i for i, node in enumerate(nodes)}
        way = np.array([self._way[node] for node in nodes])
        lengths = lil_array((len(nodes), len(nodes)))
        for i, step in enumerate(np.diff(way).tolist()):
            lengths[i, i + 1] = max(step, _LEAST_M)
        for a, b in self._returns:
            lengths[at[b], at[a]] = _LEAST_M
        found = dijkstra(lengths.tocsr(), directed=False, indices=at[frame])
        return float(found[-1])

    def unseen_for(self, frames: int, ids: IntArray) -> IntArray:
        """Those of the landmarks that the last ``frames`` frames did not see.

        Those that no frame saw are among them if they are of the map that the run began in, some
        frame shows where in that map it was, and the last one was not placed by that map anyway:
        what does not lie where it should then shows how the map is bent, not a drift.
        """
        known = ids[ids < len(self._last_seen)]
        last = self._last_seen[known]
        wanted = (last >= 0) & (last < len(self) - frames)
        if self._ties and not self._on_map:
            wanted |= (last < 0) & self.of_given(known)
        return known[wanted]

    def of_given(self, ids: IntArray) -> BoolArray:
        """Which of the landmarks (k,) are of the map that the run began in."""
        return np.asarray(ids <= self._given)

    def made_after(self, frame: int, ids: IntArray) -> BoolArray:
        """Which of the landmarks (k,) were new only after a frame."""
        return np.asarray(ids > self._newest[frame])

    def last_seen(self, ids: IntArray) -> int:
        """The last frame that saw any of the landmarks; -1 where none did.

        Where some are of the given map and were never seen, it is not later than the frame that
        saw the last of this map before it was left: what was made since may be one of them.
        """
        last = self._last_seen[ids]
        seen = int(last.max(initial=-1))
        if not self._ties or not self._never_seen(ids):
            return seen
        # Frames that see the map again are those of the return; the one before them is meant.
        before = bisect_right(self._ties, len(self) - 1 - _RETURN_FRAMES)
        left = self._ties[max(before - 1, 0)]
        return left if seen < 0 else min(seen, left)

    def best_view_of(self, ids: IntArray, landmarks: LandmarkMap) -> int:
        """The frame that saw most of the landmarks; the latest of several. -1 where none did.

        What no frame saw of the given map counts as seen by the one that shows best where the run
        entered it: the earliest that saw enough landmarks of it that are still in ``landmarks``.
        """
        wanted = np.zeros(len(self._last_seen), np.bool_)
        wanted[ids] = True
        counts = self._counts(wanted)
        unseen = self._never_seen(ids)
        if unseen and (entry := self._entry(landmarks)) >= 0:
            counts[entry] += unseen
        if counts.max(initial=0) == 0:
            return -1
        return len(counts) - 1 - int(np.argmax(counts[::-1]))

    def view(self, frame: int, ids: IntArray, landmarks: LandmarkMap) -> Observations:
        """What a frame saw of landmarks still in the map, to be located relative to some.

        Args:
            frame: the earlier one.
            ids: those relative to which it is located. Where most are of the given map and no
                frame saw them, only that map places the frame relative to them.
            landmarks: the map.
        """
        seen = self.frames[frame].kept
        keep = np.isin(seen.ids, landmarks.ids)
        if self._never_seen(ids) > int(np.isin(seen.ids, ids).sum()):
            keep &= self.of_given(seen.ids)
        return seen.select(keep)

    def _book(self, increment: Increment, closed: tuple[bool, ...]) -> None:
        seen = increment.observations.select(~increment.rejected)
        loops = [loop for loop, taken in zip(increment.loops, closed, strict=True) if taken]
        ids = np.concatenate([seen.ids, *(loop.observations.ids for loop in loops)])
        self.taken += closed
        self._grow(int(ids.max(initial=-1)) + 1)
        here = len(self)
        before = np.sort(self._last_seen[seen.ids])
        old = before[(before >= 0) & (before < here - _RETURN_FRAMES)]
        if len(old) >= _RETURN_MATCHES:
            self._returns.append((here, int(old[len(old) // 2])))
        by_map = int(self.of_given(seen.ids).sum())
        self._on_map = by_map >= _RETURN_MATCHES and 2 * by_map >= int((~seen.is_new).sum())
        if by_map >= _RETURN_MATCHES:
            self._tie(here)
        self._last_seen[ids] = here
        self.frames.append(increment)
        self._starts.append(len(self._seen))
        self._seen.append({"ids": seen.ids.astype(np.int32)})
        self._returns += [(here, loop.frame) for loop in loops]
        newest = self._newest[-1] if self._newest else self._given
        self._newest.append(int(increment.observations.ids.max(initial=newest)))

    def _tie(self, here: int) -> None:
        """Books that a frame saw the given map, which makes it a return to where that was entered.

        One return serves a row of frames: within it no way counts.
        """
        if self._ties and self._ties[-1] < here - 1:
            self._returns.append((here, self._ties[0]))
        self._ties.append(here)

    def _never_seen(self, ids: IntArray) -> int:
        """How many of the landmarks are of the given map, and were never seen."""
        return int((self._last_seen[ids[self.of_given(ids)]] < 0).sum())

    def _entry(self, landmarks: LandmarkMap) -> int:
        """The first frame tied to the given map by what is still there of it; -1 for none."""
        still = np.zeros(len(self._last_seen), np.bool_)
        given = landmarks.ids[self.of_given(landmarks.ids)]
        still[given] = True
        enough = self._counts(still)[self._ties] >= _RETURN_MATCHES
        return self._ties[int(np.argmax(enough))] if enough.any() else -1

    def _counts(self, wanted: BoolArray) -> IntArray:
        """(n,) how many of the landmarks that are marked each frame saw."""
        found = np.cumsum(np.r_[0, wanted[self._seen["ids"]]])
        return np.diff(found[[*self._starts, len(self._seen)]])

    def _grow(self, count: int) -> None:
        lacking = count - len(self._last_seen)
        if lacking > 0:
            # Twice what is needed: identities only grow, and copies shall not come every frame.
            more = np.full(max(lacking, len(self._last_seen)), -1, np.int64)
            self._last_seen = np.concatenate([self._last_seen, more])


# ------------------------------------------------------------------------------------------
# A return to a mapped place: confirmed over several frames, measured, and landmarks fused

_AGREEMENT = 0.15, 2.0  # metres and degrees by which the offsets of two frames may differ
_WORTH = 0.03, 0.3  # metres and degrees: below both the tracker finds the old landmarks by itself
_DRIFT_M = 0.5  # drift of position that needs no way to have come about
_DRIFT_DEG = 10.0  # and of heading
_DRIFT_DEG_PER_M = 0.25  # of heading, by wheels without a gyro
_FUSED_M = 0.10  # after a closure, landmarks that look alike and lie this near become one


@dataclass(frozen=True, slots=True)
class LoopGates:
    """When a return is looked for, and what it takes to be a closure.

    Attributes:
        every: frames between searches; after a place was recognised, every frame.
        forgotten_after: frames unseen until a landmark counts as old.
        confirm: frames in a row that find the same offset.
        max_drift_share: largest drift as a share of the path since; poor wheels drift by 0.05.
        min_matches: old landmarks that must agree on the closure in the end.
        max_sigma_m: largest standard deviation of a closure's position.
        max_sigma_deg: and of its heading.
        rest: frames after a closure in which no other is looked for.
    """

    every: int = 4
    forgotten_after: int = 60
    confirm: int = 3
    max_drift_share: float = 0.08
    min_matches: int = 12
    max_sigma_m: float = 0.10
    max_sigma_deg: float = 1.0
    rest: int = 15


class Confirmation:
    """Counts frames in a row that find the same offset."""

    count: Kept[int]
    offset: Kept[FloatArray]

    def __init__(self, gates: LoopGates) -> None:
        """Has seen nothing yet."""
        self._gates = gates
        self.count = 0
        self.offset = np.eye(4)

    @property
    def begun(self) -> bool:
        """Whether a place was recognised by the last look: the next frame shall look again."""
        return self.count > 0

    def offer(self, recognised: FloatArray, estimated: FloatArray) -> bool:
        """Takes a look's result; whether enough of them agree by now.

        Args:
            recognised: (4, 4) ``wTc`` by the landmarks of the place.
            estimated: (4, 4) ``wTc`` as estimated along the way.
        """
        if self.begun and self._agrees(recognised, estimated):
            self.count += 1
        else:
            self.count = 1
        self.offset = recognised @ inverse(estimated)
        return self.count >= self._gates.confirm

    def forget(self) -> None:
        """Begins again: a search that found nothing, or a closure."""
        self.count, self.offset = 0, np.eye(4)

    def _agrees(self, recognised: FloatArray, estimated: FloatArray) -> bool:
        """Whether the last offset leads to this pose, too."""
        expected = self.offset @ estimated
        metres, degrees = difference(expected, recognised)
        return metres <= _AGREEMENT[0] and degrees <= _AGREEMENT[1]


def difference(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses (4, 4)."""
    apart = se3_log(inverse(a) @ b)
    return (
        float(np.linalg.norm(b[:3, 3] - a[:3, 3])),
        float(np.rad2deg(np.linalg.norm(apart[:3]))),
    )


def drift_allows(
    recognised: FloatArray, estimated: FloatArray, way_m: float, gates: LoopGates
) -> bool:
    """True if the offset is worth a correction, and a drift that ``way_m`` metres allow."""
    metres, degrees = difference(estimated, recognised)
    worth = metres > _WORTH[0] or degrees > _WORTH[1]
    return worth and (
        metres <= _DRIFT_M + gates.max_drift_share * way_m
        and degrees <= _DRIFT_DEG + _DRIFT_DEG_PER_M * way_m
    )


def close_loop(
    memory: SightingMemory,
    landmarks: LandmarkMap,
    features: StereoFeatures,
    found: Relocalisation,
    partners: IntArray,
    resection: Resection,
) -> LoopClosure | None:
    """The closure that a frame's sighting of old landmarks means; None where it is too weak.

    Both frames are located by the same old landmarks, each alone, so that neither the drift between
    them nor any estimator's past has a say in what is measured. Of a map that the run began in, the
    two may see different parts: it is held still, and the earlier frame is where it was entered.

    Args:
        memory: who saw what.
        landmarks: the map.
        features: the present frame's.
        found: which of them are which old landmarks.
        partners: (n,) the identity that each feature has got since the drift, -1 for none.
        resection: locates a frame by known landmarks.
    """
    earlier = memory.best_view_of(found.ids, landmarks)
    if earlier < 0:
        return None
    seen = features.observations(found.features, found.ids, is_new=False)
    there = resection.solve(PoseProblem.of(landmarks, memory.view(earlier, found.ids, landmarks)))
    here = resection.solve(PoseProblem.of(landmarks, seen))
    if not (there.status.measured and here.status.measured):
        return None
    taken_for = partners[found.features[here.inliers]]
    kept = seen.select(here.inliers)
    # A landmark of the given map ends as no other's double: it has not been made by the drift.
    twice = (taken_for >= 0) & (taken_for != kept.ids) & ~memory.of_given(taken_for)
    return LoopClosure(
        frame=earlier,
        oTc=inverse(there.wTc) @ here.wTc,
        covariance=_relative_covariance(there, here),
        observations=kept,
        merged=np.column_stack([taken_for, kept.ids])[twice],
    )


def is_sharp(closure: LoopClosure, gates: LoopGates) -> bool:
    """Whether a closure rests on enough landmarks, and determines where the frame is."""
    sigma = np.sqrt(np.diagonal(closure.covariance))
    return bool(
        len(closure.observations) >= gates.min_matches
        and sigma[3:].max() <= gates.max_sigma_m
        and np.rad2deg(sigma[:3].max()) <= gates.max_sigma_deg
    )


def _relative_covariance(there: EgoMotion, here: EgoMotion) -> FloatArray:
    """Of ``oTc`` in the tangent space at it: both poses' own, as if independent."""
    carried = adjoint(inverse(inverse(there.wTc) @ here.wTc))
    return np.asarray(here.covariance + congruence(carried, there.covariance))


def duplicates(
    landmarks: LandmarkMap,
    appearances: LandmarkAppearances,
    sides: tuple[IntArray, IntArray],
    appearance: AppearanceSettings,
) -> IntArray:
    """Pairs (m, 2) of identities (that ends, that stays) near each other that look alike.

    Args:
        landmarks: the map, corrected: what is one lies in one place.
        appearances: stored views of the landmarks on both sides.
        sides: (a,) identities that may end, (b,) identities that may stay; none in both.
        appearance: how alike; each must be the other's closest, clearly.
    """
    (new, new_at), (old, old_at) = (_one_view_each(appearances, ids) for ids in sides)
    if not len(new) or not len(old):
        return np.empty((0, 2), np.int64)
    i, j = _near(_positions(landmarks, new), _positions(landmarks, old), _FUSED_M)
    i, j = choose(
        i, j, (appearances.descriptors[new_at], appearances.descriptors[old_at]), appearance
    )
    return np.column_stack([new[i], old[j]]).astype(np.int64)


def _one_view_each(appearances: LandmarkAppearances, ids: IntArray) -> tuple[IntArray, IntArray]:
    """Identities with a stored view, and the row of the first one of each."""
    known, first = np.unique(appearances.ids, return_index=True)
    chosen = np.isin(known, ids)
    return known[chosen], first[chosen]


def _positions(landmarks: LandmarkMap, ids: IntArray) -> FloatArray:
    return np.asarray(landmarks.positions[landmarks.rows(ids)])


def _near(a: FloatArray, b: FloatArray, within_m: float) -> tuple[IntArray, IntArray]:
    """All pairs (k,), (k,) of rows within a distance, ascending in the first."""
    from scipy.spatial import cKDTree  # slow to load, and few runs see a place again

    found = cKDTree(b).query_ball_point(a, within_m, return_sorted=True)
    counts = np.array([len(near) for near in found])
    j = np.concatenate([np.array(near, np.int64) for near in found])
    return np.repeat(np.arange(len(a)), counts), j


_STREAM = 11  # of random numbers, next to those of the recording
_ONE_PLACE_M, _ONE_PLACE_DEG = 0.3, 5.0
"""What matching around a pose found in the whole map may change of it: several times what such a
pose may be off (frontend.relocalisation.max_sigma_*)."""
_WORDS_EVERY = 16
"""Frames after which the words of new and renewed views are found, half a millisecond's work: the
first look after a long time would find them all at once."""
_Views: TypeAlias = tuple[int, IntArray, LandmarkAppearances | None]
"""State of the database's views, landmarks (n,), and their appearances then."""
_JOINT = LoopGates()  # how sharp a closure between parts of the map must be
_NO_IDS: IntArray = np.empty(0, np.int64)
_NO_PAIRS: IntArray = np.empty((0, 2), np.int64)


@dataclass(frozen=True, slots=True)
class LostRules:
    """Unlocated frames in a row until the whole map is searched, and until mapping goes on."""

    after: int = 2
    give_up_after: int = 10


class PlaceRecognition:
    """Remembers who saw what, searches for returns, and finds the camera when it is lost.

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

    def __init__(
        self,
        tracker: LandmarkTracker,
        relocaliser: Relocaliser,
        appearance: AppearanceSettings,
        seed: int,
        loops: LoopGates | None = None,
        lost: LostRules | None = None,
        joins: bool = False,
    ) -> None:
        """Nothing is remembered yet; the tracker is the run's own, with the map it begins in.

        ``loops`` or ``lost`` None: not wanted. ``joins``: the estimator takes closures, so that
        parts of the map may be joined.
        """
        self._tracker, self._relocaliser = tracker, relocaliser
        self._appearance, self._seed = appearance, seed
        self._loops, self._lost_rules, self._joins = loops, lost, joins
        self.memory = SightingMemory(int(tracker.database.ids.max(initial=-1)))
        self._confirmation = None if loops is None else Confirmation(loops)
        self._lost = 0
        self._offered = -1  # frame of the last closure, taken or not
        self.merging = _NO_PAIRS  # landmarks that are one, by the closure just taken
        self.fuse_since = -1  # a frame: landmarks made after it may be older ones' doubles
        self._pose = np.eye(4)
        self._views: _Views = (-1, _NO_IDS, None)
        self._find_words()

    @property
    def maps_on(self) -> bool:
        """Whether new landmarks may enter the map: not while it is unknown where they are.

        From the first frame on: with landmarks of its own a robot carried off would not know it.
        """
        lost = self._lost_rules
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
        loops, confirmation = self._loops, self._confirmation
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
        lost = self._lost_rules
        # Without any landmark yet there is nothing to be lost in.
        located = tracked.ego_motion.status.measured or not len(landmarks)
        self._lost = 0 if located else self._lost + 1
        if self._untracked and self._confirmation is not None:
            self._confirmation.forget()  # its frames are to be in a row
        after = 1 if guessed and self._joins else None
        if lost is not None:
            after = lost.after
        if after is None or self._lost < after or not len(features):
            return tracked, False
        found = self._locate(landmarks, self._trusted(), features)
        if not found.found:
            return tracked, False
        around = Prediction(found.wTc, found.covariance)
        again = self._tracker.track_around(around, landmarks, features)
        if not again.ego_motion.status.measured or not _one_place(found.wTc, again.ego_motion.wTc):
            return tracked, False
        self._lost = 0
        return again, True

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
        matched next to recent ones and contradict them. Until a closure has corrected the map the
        frame is placed by the recent ones: between both it would fit neither, and the landmarks
        that it starts would be misplaced.

        Args:
            tracked: the frame, placed by all landmarks.
            prediction: where it was expected.
            landmarks: the map.
            features: the frame's.
        """
        loops = self._loops
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
        loops, confirmation = self._loops, self._confirmation
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
            return _NO_IDS
        ended = self._tracker.merge(self.merging)
        self.merging, self.fuse_since = _NO_PAIRS, -1
        left = landmarks.ids[~np.isin(landmarks.ids, ended)]
        new = self.memory.made_after(since, left)
        appearances = self._tracker.database.appearances()
        sides = left[new], left[~new]
        pairs = duplicates(landmarks, appearances, sides, self._appearance)
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
        if self._loops is not None or self._lost_rules is not None or self._apart:
            self._tracker.database.find_words()

    @property
    def _apart(self) -> bool:
        return self._joins and self._tracker.parts.several

    def find_join(
        self,
        landmarks: LandmarkMap,
        features: StereoFeatures,
        association: Association,
    ) -> LoopClosure | None:
        """The closure between two parts of the map that a located frame sees; None without one.

        Looked for where the frame was found in another part than the last one, else at every few.
        What places the frame in each is strict enough for a lost one; no drift could
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
    def _untracked(self) -> bool:
        """Whether it is unknown where the frame is, so that no return would be accepted.

        Outside a map that is left as it is, nothing but the odometry ever shows it; where no pose
        searches the whole map for the lost, the return to it is a loop like any other.
        """
        outside = self._tracker.keeps_map and self._lost_rules is None
        return self._lost > 0 and not outside

    def _time_to_look(self, loops: LoopGates, confirmation: Confirmation) -> bool:
        frame = len(self.memory)
        if self._untracked or (self._offered >= 0 and frame - self._offered <= loops.rest):
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
        rng = np.random.default_rng([self._seed, _STREAM, len(self.memory)])
        self._learn(landmarks, among)
        return self._relocaliser.locate(features, rng)

    def _learn(self, landmarks: LandmarkMap, among: IntArray) -> None:
        """Hands the map to the relocaliser; views that it has seen keep their index."""
        database = self._tracker.database
        named = np.isin(landmarks.ids, among)
        chosen = landmarks if named.all() else landmarks.select(np.flatnonzero(named))
        changes, ids, appearances = self._views
        if (
            appearances is None
            or changes != database.changes
            or not np.array_equal(ids, chosen.ids)
        ):
            appearances = database.appearances(chosen.ids, with_words=True)
            self._views = database.changes, chosen.ids, appearances
        self._relocaliser.learn(chosen, appearances)


def _one_place(a: FloatArray, b: FloatArray) -> bool:
    metres, degrees = difference(a, b)
    return metres <= _ONE_PLACE_M and degrees <= _ONE_PLACE_DEG
