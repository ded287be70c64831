"""Who saw what, frame by frame: what a return is recognised against."""

from __future__ import annotations

import itertools
from bisect import bisect_right

import numpy as np
from scipy.sparse import lil_array
from scipy.sparse.csgraph import dijkstra

from fgslam.core.arrays import BoolArray, FloatArray, GrowingColumns, IntArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.measurements import Increment, Observations
from fgslam.core.store import Kept

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
        frame tells where in that map it was, and the last one was not placed by that map anyway:
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

        What no frame saw of the given map counts as seen by the one that tells best where the run
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
        """What a frame saw of the landmarks that are still in the map, to be located beside some.

        Args:
            frame: the earlier one.
            ids: those beside which it is located. Where most of them are of the given map and no
                frame saw them, only that map places the frame beside them.
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
