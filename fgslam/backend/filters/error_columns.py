"""Errors that the newest pose and the landmarks have in common, as columns; one column a cause.

A cause is a term of the rig's calibration, or one drawn sample of all noise. What a filter does to
its estimates, to first order it does to each column; covariances are products of columns, and so
hold the correlations that no filter of single landmarks keeps.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, GrowingColumns, IntArray, StateArrays

_PREFIX = "doubt_"  # of names in a state


def under(prefix: str, state: StateArrays) -> StateArrays:
    """A part's state, its names prefixed so that they differ from those of other parts."""
    return {prefix + name: array for name, array in state.items()}


def found_under(prefix: str, state: StateArrays) -> StateArrays:
    """The part of a state that :func:`under` has named."""
    return {n.removeprefix(prefix): a for n, a in state.items() if n.startswith(prefix)}


class ErrorColumns:
    """Columns (6, m) of the newest pose and (n, 3, m) of landmarks, by ascending identity."""

    def __init__(self, count: int, kind: type = np.float64, **more: FloatArray) -> None:
        """All zero, the map empty.

        Args:
            count: of columns.
            kind: of number in which those of landmarks are kept.
            more: what else is kept by landmark, arrays (0, ...).
        """
        self._held = False
        self._gain = np.zeros((6, count))
        self._map = GrowingColumns(
            ids=np.empty(0, np.int64), gain=np.empty((0, 3, count), kind), **more
        )

    def hold_map(self) -> None:
        """The map is a saved one that nothing changes: it is as well known as it was then."""
        self._held = True

    def forget(self, ids: IntArray) -> None:
        """Landmarks that somebody else holds now, or nobody."""
        rows, known = self._rows(ids)
        gone = np.zeros(len(self._map), np.bool_)
        gone[rows[known]] = True
        self._map.drop(gone)

    def state(self) -> StateArrays:
        """Everything needed to continue."""
        return under(_PREFIX, self._state())

    def restore(self, state: StateArrays) -> None:
        """Continues from :meth:`state`."""
        self._restore(found_under(_PREFIX, state))

    # ----------------------------------------------------------------------------------------

    def _state(self) -> StateArrays:
        return {"pose_gain": self._gain, **self._map.state()}

    def _restore(self, state: StateArrays) -> None:
        self._gain = state["pose_gain"]
        self._map.restore(state)

    def _append(self, values: StateArrays) -> None:
        """Landmarks (k,) that are not there yet; their identities ascend."""
        if len(values["ids"]):
            before = len(self._map)
            self._map.append(values)
            self._map.keep_ascending("ids", before)

    def _rows(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """(k,) rows of landmarks in the map, and which of them are there."""
        have = self._map["ids"]
        if not len(have):
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), np.bool_)
        rows = np.minimum(np.searchsorted(have, ids), len(have) - 1)
        return rows, np.asarray(have[rows] == ids)

    def _of_map(self, ids: IntArray) -> FloatArray:
        """(k, 3, m) columns of landmarks, as far as they are reported."""
        if self._held:
            return np.zeros((len(ids), *self._map["gain"].shape[1:]))
        return self._of("gain", ids)

    def _of(self, name: str, ids: IntArray) -> FloatArray:
        """(k, ...) what is kept of landmarks under a name; zero of unknown ones."""
        rows, known = self._rows(ids)
        kept = self._map[name]
        out = np.zeros((len(ids), *kept.shape[1:]))
        out[known] = kept[rows[known]]
        return out
