"""Where on the floor a round robot can stand, and how far it is from the nearest obstacle.

Obstacles are all patches that reach into the robot's band of heights, seen from above: their edges
as line segments. A closed outline is all that is needed, as the robot starts outside and does not
jump.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.worlds.rendering.patches import PatchArrays

# What is lower is driven over (rugs), what is higher driven under (lintels, lamps); metres.
BAND = (0.03, 1.35)
_CELL = 0.05
_NEAR = 1.0


class FloorSpace:
    """The free floor of a scene; immutable.

    Attributes:
        low: (2,) corner of the grid, metres.
        cell: side of its cells, metres.
        clearances: (rows, columns) distance of each cell's middle to the nearest obstacle; rows
            go along y.
    """

    def __init__(self, patches: PatchArrays, low: FloatArray, high: FloatArray) -> None:
        """Takes the obstacles between two corners (2,) of the floor."""
        self._start, self._end = _segments(patches)
        self.low, self.cell = np.asarray(low, dtype=np.float64), _CELL
        columns, rows = np.ceil((np.asarray(high) - self.low) / _CELL).astype(int)
        blocked = np.zeros((rows, columns), dtype=np.bool_)
        i, j = self._marks(rows, columns)
        blocked[i, j] = True
        self.clearances = ndimage.distance_transform_edt(~blocked) * _CELL

    @property
    def outlines(self) -> FloatArray:
        """(n, 2, 2) edges of all obstacles, from above: ends, then x and y in metres."""
        return np.stack([self._start, self._end], axis=1)

    def clearance(self, points: FloatArray) -> FloatArray:
        """(n,) exact distance in metres of points (n, 2) to the nearest obstacle.

        Farther than a metre from anything the grid answers, to half a cell.
        """
        points = np.atleast_2d(np.asarray(points, dtype=np.float64))
        coarse = self._coarse(points)
        out = coarse.copy()
        for k in np.flatnonzero(coarse < _NEAR):
            out[k] = self._exact(points[k])
        return out

    def touches(self, place: FloatArray, radius: float, margin: float) -> bool:
        """Whether a disc at a place (2,) meets an obstacle; exact within ``margin`` of contact.

        The margin must exceed the grid's error, a cell.
        """
        coarse = float(self._coarse(place[None])[0])
        if abs(coarse - radius) > margin:
            return coarse < radius
        return self._exact(place) < radius

    def line_is_free(self, start: FloatArray, ends: FloatArray, radius: float) -> BoolArray:
        """(n,) whether a disc can go straight from ``start`` (2,) to each of ``ends`` (n, 2).

        Tested at every tenth of a metre on the grid, whose error of half a cell is added.
        """
        steps = max(int(np.ceil(np.linalg.norm(ends - start, axis=1).max(initial=0.1) / 0.1)), 1)
        part = np.linspace(0.0, 1.0, steps + 1)[:, None, None]
        along = start + part * (ends - start)
        free = self._coarse(along.reshape(-1, 2)).reshape(along.shape[:2])
        return np.asarray((free > radius + 0.5 * _CELL).all(axis=0))

    def _coarse(self, points: FloatArray) -> FloatArray:
        place = (points - self.low) / _CELL - 0.5
        inside = [place[:, 1], place[:, 0]]
        return np.asarray(
            ndimage.map_coordinates(self.clearances, inside, order=1, mode="constant", cval=0.0)
        )

    def _exact(self, point: FloatArray) -> float:
        edge = self._end - self._start
        length2 = np.maximum(np.sum(edge * edge, axis=1), 1e-18)
        part = np.clip(np.sum((point - self._start) * edge, axis=1) / length2, 0.0, 1.0)
        away = self._start + part[:, None] * edge - point
        return float(np.sqrt(np.min(np.sum(away * away, axis=1))))

    def _marks(self, rows: int, columns: int) -> tuple[FloatArray, FloatArray]:
        """Cells that the outlines go through."""
        length = np.linalg.norm(self._end - self._start, axis=1)
        count = np.ceil(length / (0.4 * _CELL)).astype(int) + 1
        which = np.repeat(np.arange(len(count)), count)
        first = np.repeat(np.cumsum(count) - count, count)
        part = (np.arange(len(which)) - first) / np.maximum(count[which] - 1, 1)
        points = self._start[which] + part[:, None] * (self._end - self._start)[which]
        j, i = ((points - self.low) / _CELL).astype(int).T
        inside = (i >= 0) & (i < rows) & (j >= 0) & (j < columns)
        return i[inside], j[inside]


def _segments(patches: PatchArrays) -> tuple[FloatArray, FloatArray]:
    """Start and end (n, 2) of the outlines, seen from above, of what reaches into the band."""
    c, u, v = patches.corner, patches.edge_u, patches.edge_v
    corners = np.stack([c, c + u, c + u + v, c + v], axis=1)
    z = corners[..., 2]
    inside = (z.max(axis=1) > BAND[0]) & (z.min(axis=1) < BAND[1])
    start = corners[inside][..., :2]
    end = np.roll(start, -1, axis=1)
    start, end = start.reshape(-1, 2), end.reshape(-1, 2)
    both = np.round(np.hstack([np.minimum(start, end), np.maximum(start, end)]), 6)
    _, first = np.unique(both, axis=0, return_index=True)
    keep = np.sort(first)
    long = np.linalg.norm(end[keep] - start[keep], axis=1) > 1e-6
    return start[keep][long], end[keep][long]
