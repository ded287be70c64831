"""Errors that the newest pose and the landmarks have in common, as columns; one column a cause.

A cause is a term of the rig's calibration, or one drawn sample of all noise. What a filter does to
its estimates, to first order it does to each column; covariances are products of columns, and so
hold the correlations that no filter of single landmarks keeps.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, GrowingColumns, IntArray, StateArrays
from fgslam.core.store import Kept


class ErrorColumns:
    """Columns (6, m) of the newest pose and (n, 3, m) of landmarks.

    Those of a landmark stay in one place while it is there: what comes and goes costs what it is,
    whatever the map.
    """

    _gain: Kept[FloatArray]
    _order: Kept[GrowingColumns]
    _map: Kept[GrowingColumns]
    _free: Kept[IntArray]

    def __init__(self, count: int, kind: type = np.float64, **more: FloatArray) -> None:
        """All zero, the map empty.

        Args:
            count: of columns.
            kind: of number in which those of landmarks are kept.
            more: what else is kept by landmark, arrays (0, ...).
        """
        self._held = False
        self._gain = np.zeros((6, count))
        self._order = GrowingColumns(ids=np.empty(0, np.int64), row=np.empty(0, np.int64))
        """Identities, ascending, and the rows that are theirs in the map; free ones are nobody's"""
        self._map = GrowingColumns(gain=np.empty((0, 3, count), kind), **more)
        self._free = np.empty(0, np.int64)

    def hold_map(self) -> None:
        """The map is a saved one that nothing changes: it is as well known as it was then."""
        self._held = True

    def forget(self, ids: IntArray) -> None:
        """Drops landmarks; those that are unknown are passed over."""
        places, known = self._places(ids)
        if known.any():
            gone = np.zeros(len(self._order), np.bool_)
            gone[places[known]] = True
            self._free = np.concatenate([self._free, self._order["row"][gone]])
            self._order.drop(gone)

    # ----------------------------------------------------------------------------------------

    def _append(self, values: StateArrays) -> None:
        """Landmarks (k,) that are not there yet; their identities ascend."""
        ids = values["ids"]
        if not len(ids):
            return
        again = min(len(ids), len(self._free))
        begun = len(self._map)
        rows = np.concatenate([self._free[:again], np.arange(begun, begun + len(ids) - again)])
        self._free = self._free[again:]
        of_map = {name: values[name] for name in self._map.columns()}
        self._map.append({name: array[again:] for name, array in of_map.items()})
        for name, array in of_map.items():
            self._map[name][rows[:again]] = array[:again]
        before = len(self._order)
        self._order.append({"ids": ids, "row": rows})
        self._order.keep_ascending("ids", before)

    def _places(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """(k,) places of landmarks in the order, and which of them are there."""
        have = self._order["ids"]
        if not len(have):
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), np.bool_)
        places = np.minimum(np.searchsorted(have, ids), len(have) - 1)
        return places, np.asarray(have[places] == ids)

    def _rows(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """(k,) rows of landmarks in the map, and which of them are there."""
        places, known = self._places(ids)
        return (self._order["row"][places] if known.any() else places), known

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
