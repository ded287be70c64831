"""Who saw what, frame by frame: what a return is recognised against."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.sparse import lil_array
from scipy.sparse.csgraph import dijkstra

from fgslam.measurement_log import MeasurementLog
from fgslam.types import (
    BoolArray,
    FloatArray,
    Increment,
    IntArray,
    LandmarkMap,
    Observations,
    StateArrays,
)

_RETURN_FRAMES = 30  # unseen for so long: tracking them again ties the frame to an older one
_RETURN_MATCHES = 10  # of them, as for the ties of the filter's backward correction
_LEAST_M = 1e-6  # of an edge: none at all is no edge


class SightingMemory:
    """Observations of all frames so far, and when each landmark was last seen.

    The observations are those of the log; nothing is copied. A closure that the estimator refused
    is none: neither a return nor a sighting of the landmarks that it names.

    Attributes:
        taken: whether the estimator took the log's closures, in their order.
    """

    def __init__(self, given: int = -1) -> None:
        """Nothing was seen yet; ``given`` is the last identity of the map it all begins in."""
        self._given = given
        self._seen: list[Observations] = []
        self._way: list[float] = []
        self._newest: list[int] = []
        self._returns: list[tuple[int, int]] = []
        self._last_seen: IntArray = np.empty(0, np.int64)
        self.taken: list[bool] = []

    def __len__(self) -> int:
        return len(self._seen)

    def add(self, increment: Increment, step: FloatArray, closed: tuple[bool, ...] = ()) -> None:
        """Books a frame.

        Args:
            increment: its measurements.
            step: (4, 4) the camera's motion since the frame before, as estimated.
            closed: for each of its loops, whether the estimator took it.
        """
        way = self._way[-1] if self._way else 0.0
        self._way.append(way + float(np.linalg.norm(step[:3, 3])))
        self._book(increment, closed)

    def way_since(self, frame: int) -> float:
        """Metres along which the estimate can have drifted away from a frame's surroundings.

        The way driven since, but cut short where a place was seen again in between: what was tied
        there has drifted no farther apart than the rest of the way allows.
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
        """Those of the landmarks that the last ``frames`` frames did not see."""
        known = ids[ids < len(self._last_seen)]
        last = self._last_seen[known]
        return known[(last >= 0) & (last < len(self) - frames)]

    def made_after(self, frame: int, ids: IntArray) -> BoolArray:
        """Which of the landmarks (k,) were new only after a frame."""
        return np.asarray(ids > self._newest[frame])

    def last_seen(self, ids: IntArray) -> int:
        """The last frame that saw any of the landmarks; -1 where none did."""
        return int(self._last_seen[ids].max(initial=-1))

    def best_view_of(self, ids: IntArray) -> int:
        """The frame that saw most of the landmarks; the latest of several.

        Raises:
            ValueError: none of them was ever seen.
        """
        wanted = np.zeros(len(self._last_seen), np.bool_)
        wanted[ids] = True
        last = self.last_seen(ids)
        counts = [int(wanted[seen.ids].sum()) for seen in self._seen[: last + 1]]
        if max(counts, default=0) == 0:
            raise ValueError(f"landmarks never seen: {ids[:5].tolist()}")
        return last - int(np.argmax(counts[::-1]))

    def view(self, frame: int, landmarks: LandmarkMap) -> Observations:
        """What a frame saw of the landmarks that are still in the map."""
        seen = self._seen[frame]
        return seen.select(np.isin(seen.ids, landmarks.ids))

    def state(self) -> StateArrays:
        """What the log does not tell."""
        return {
            "way": np.array(self._way),
            "given": np.array(self._given),
            "taken": np.array(self.taken, np.bool_),
        }

    def restore(self, state: StateArrays, log: MeasurementLog) -> None:
        """Continues from :meth:`state` and the log of as many frames."""
        self._seen, self._newest, self._returns = [], [], []
        self._last_seen = np.empty(0, np.int64)
        self._given = int(state["given"])
        verdicts, self.taken = iter(state["taken"].tolist()), []
        for increment in log:
            self._book(increment, tuple(itertools.islice(verdicts, len(increment.loops))))
        self._way = state["way"].tolist()

    def _book(self, increment: Increment, closed: tuple[bool, ...]) -> None:
        seen = increment.observations.select(~increment.rejected)
        loops = [loop for loop, taken in zip(increment.loops, closed, strict=True) if taken]
        ids = np.concatenate([seen.ids, *(loop.observations.ids for loop in loops)])
        self.taken += closed
        self._grow(int(ids.max(initial=-1)) + 1)
        here = len(self._seen)
        before = np.sort(self._last_seen[seen.ids])
        old = before[(before >= 0) & (before < here - _RETURN_FRAMES)]
        if len(old) >= _RETURN_MATCHES:
            self._returns.append((here, int(old[len(old) // 2])))
        self._last_seen[ids] = here
        self._seen.append(seen)
        self._returns += [(here, loop.frame) for loop in loops]
        newest = self._newest[-1] if self._newest else self._given
        self._newest.append(int(increment.observations.ids.max(initial=newest)))

    def _grow(self, count: int) -> None:
        lacking = count - len(self._last_seen)
        if lacking > 0:
            # Twice what is needed: identities only grow, and copies shall not come every frame.
            more = np.full(max(lacking, len(self._last_seen)), -1, np.int64)
            self._last_seen = np.concatenate([self._last_seen, more])
