"""Parts of a map between which nothing is measured: what is founded anew after a gap.

A frame that neither landmarks nor odometry place starts its landmarks at a guess. What is then
tracked on them is sound among itself, and lies beside the rest of the map by that guess alone,
until a frame sees both or a loop closure joins them.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import BoolArray, IntArray
from fgslam.core.measurements import Increment
from fgslam.core.store import Kept

_HOLD = 6
"""Landmarks of a part that place a frame in it, beside those of another: by chance none agree."""
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
        """Frames booked."""
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
        """(n,) frames that hang together with the first one by measurements."""
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

    # ----------------------------------------------------------------------------------------

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
