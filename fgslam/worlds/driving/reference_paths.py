"""Reference paths: targets one after another, each in straight reach of the one before.

A tour of the house's rooms gives the direction; a depth-first search lays targets a fixed distance
apart so that each leg's straight line is free for the wheelchair, and steps back where it gets
stuck. Ways around corners are measured on a grid by Dijkstra's algorithm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.planar import unit, wrap
from fgslam.worlds.buildings.floor_plan import Room
from fgslam.worlds.buildings.house import ROOMS
from fgslam.worlds.driving.floor_space import FloorSpace

# A closed walk through the house: every room, and the corridor twice.
_TOUR = ("hall", "office", "corridor", "studio", "workshop", "library", "corridor")
_DIRECTIONS = 72
_CHILDREN = 4
_MOST_STEPS = 4000
_STARTS = 12
_ROOMY = 0.75
# Costs in metres of detour: of a sharp turn, of coming back to an old target, of chance.
_TURN_COST, _REVISIT_COST, _CHANCE = 2.0, 4.0, 0.5
_SHARP = np.deg2rad(45.0)


class PathPlanner:
    """Lays reference paths in one house."""

    def __init__(self, space: FloorSpace, clearance: float) -> None:
        """For paths that keep ``clearance`` metres from everything."""
        self._space, self._clearance = space, clearance
        self._grid = _Grid(space, clearance)

    def reference_path(
        self,
        spacing: float,
        legs: int,
        rng: np.random.Generator,
        within: str | None = None,
    ) -> FloatArray:
        """(legs + 1, 3) poses, start first, each headed to the next one.

        Args:
            spacing: straight distance from each to the next, metres.
            legs: number of targets after the start.
            rng: chooses the tour and the targets.
            within: name of the room to stay in; None tours the house.

        Raises:
            DatasetError: no such path is found.
        """
        for _ in range(_STARTS):
            tour = self._tour(rng, within)
            points = self._searched(tour, spacing, legs, rng, within)
            if points is not None:
                return _with_headings(points)
        where = "the house" if within is None else f"the {within}"
        raise DatasetError(
            f"no path of {legs} legs of {spacing} m with {self._clearance} m of clearance is found "
            f"in {where}; lower path.spacing_m or path.legs"
        )

    def crossing_routes(
        self, spacing: float, rng: np.random.Generator, crossing: str = "corridor"
    ) -> tuple[FloatArray, FloatArray]:
        """Poses (n, 3) and (m, 3) of two routes, each from one room to another, that meet between.

        Args:
            spacing: between poses, metres; the last ones lie about as far from the routes' ends.
            rng: chooses rooms and places.
            crossing: name of the room that they meet in: both lead by one place of it.

        Raises:
            DatasetError: no such routes are found.
        """
        rooms = [room.name for room in ROOMS if room.name != crossing]
        for _ in range(_STARTS):
            a, b, c, d = (self._spot(_room(str(name)), rng) for name in rng.permutation(rooms)[:4])
            middle = self._spot(_room(crossing), rng)
            one, other = (
                self._searched(tour, spacing, None, rng, None)
                for tour in ((a, middle, b), (c, middle, d))
            )
            if one is not None and other is not None:
                return _with_headings(one), _with_headings(other)
        raise DatasetError(
            f"no two routes of legs of {spacing} m meet in the {crossing}; lower path.spacing_m"
        )

    def walk(
        self, places: Sequence[FloatArray], spacing: float, steps: int, rng: np.random.Generator
    ) -> FloatArray | None:
        """(steps + 1, 2) places of a walk from the first of some free places (2,) by the others.

        None where no such walk is found; whether it gets to the last place depends on ``steps``.
        """
        return self._searched(places, spacing, steps, rng, None)

    def _searched(
        self,
        tour: Sequence[FloatArray],
        spacing: float,
        legs: int | None,
        rng: np.random.Generator,
        within: str | None,
    ) -> FloatArray | None:
        search = _Search(self._space, self._grid, tour, spacing, self._clearance)
        return search.run(legs, rng, None if within is None else _room(within))

    def _tour(self, rng: np.random.Generator, within: str | None) -> list[FloatArray]:
        """Places to head for in turn; the first is the start."""
        if within is not None:
            return [self._spot(_room(within), rng) for _ in range(24)]
        first = int(rng.integers(0, len(_TOUR)))
        names = [_TOUR[(first + k) % len(_TOUR)] for k in range(3 * len(_TOUR))]
        if rng.random() < 0.5:
            names = names[::-1]
        return [self._spot(_room(name), rng) for name in names]

    def _spot(self, room: Room, rng: np.random.Generator) -> FloatArray:
        """A roomy place drawn within a room."""
        low, high = np.array([room.west, room.south]), np.array([room.east, room.north])
        for bound in (_ROOMY, self._clearance):
            for _ in range(200):
                place = rng.uniform(low, high)
                if self._grid.reached(place) and self._space.clearance(place)[0] >= bound:
                    return np.asarray(place)
        raise DatasetError(f"no free place in the {room.name} with {self._clearance} m around it")


class _Grid:
    """Ways over free cells, measured around corners."""

    def __init__(self, space: FloorSpace, clearance: float) -> None:
        skip = 2
        self._low, self._cell = space.low, space.cell * skip
        free = space.clearances[::skip, ::skip] >= clearance
        self._shape = free.shape
        self._graph = _graph(free, self._cell)
        parts = sparse.csgraph.connected_components(self._graph, directed=False)[1]
        largest = np.argmax(np.bincount(parts[free.ravel()]))
        self._inside = free.ravel() & (parts == largest)

    def cells(self, points: FloatArray) -> IntArray:
        """(n,) numbers of the cells that hold points (n, 2), -1 outside the free floor."""
        column, row = np.floor((points - self._low) / self._cell).astype(int).T
        rows, columns = self._shape
        valid = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        number = np.where(valid, row * columns + column, 0)
        return np.where(valid & self._inside[number], number, -1)

    def reached(self, place: FloatArray) -> bool:
        """Whether a place is part of the connected free floor."""
        return bool(self.cells(place[None])[0] >= 0)

    def ways_to(self, goal: FloatArray) -> FloatArray:
        """(cells,) metres to drive from each cell to a free place."""
        number = int(self.cells(goal[None])[0])
        return np.asarray(dijkstra(self._graph, directed=False, indices=number))


def _graph(free: np.typing.NDArray[np.bool_], cell: float) -> sparse.csr_matrix:
    """Edges between free neighbours, straight and diagonal."""
    number = np.arange(free.size).reshape(free.shape)
    pairs, weights = [], []
    everything, ahead, behind = slice(None), slice(1, None), slice(None, -1)
    for first, second, length in (
        ((everything, behind), (everything, ahead), 1.0),
        ((behind, everything), (ahead, everything), 1.0),
        ((behind, behind), (ahead, ahead), np.sqrt(2.0)),
        ((behind, ahead), (ahead, behind), np.sqrt(2.0)),
    ):
        both = free[first] & free[second]
        pairs.append(np.stack([number[first][both], number[second][both]]))
        weights.append(np.full(int(both.sum()), length * cell))
    i, j = np.hstack(pairs)
    return sparse.csr_matrix((np.concatenate(weights), (i, j)), shape=(free.size, free.size))


@dataclass(slots=True)
class _Node:
    """A laid target: where, which goal of the tour it heads for, and what to try next."""

    place: FloatArray
    goal: int
    children: list[FloatArray]


class _Search:
    """Depth-first search for one path."""

    def __init__(
        self,
        space: FloorSpace,
        grid: _Grid,
        tour: Sequence[FloatArray],
        spacing: float,
        clearance: float,
    ) -> None:
        self._space, self._grid, self._tour = space, grid, tour
        self._spacing, self._clearance = spacing, clearance
        self._ways: dict[int, FloatArray] = {}

    def run(
        self, legs: int | None, rng: np.random.Generator, room: Room | None
    ) -> FloatArray | None:
        """(legs + 1, 2) targets, or None where nothing is found; legs None: to the last place."""
        path = [_Node(self._tour[0], 1, [])]
        path[0].children = self._candidates(path, rng, room)
        for _ in range(_MOST_STEPS):
            if len(path) - 1 == legs or (legs is None and self._ends(path[-1])):
                return np.array([node.place for node in path])
            if not path[-1].children:
                path.pop()
                if not path:
                    return None
                continue
            place = path[-1].children.pop()
            path.append(_Node(place, self._next_goal(path[-1].goal, place), []))
            path[-1].children = self._candidates(path, rng, room)
        return None

    def _ends(self, node: _Node) -> bool:
        """Whether the tour's last place is within a leg."""
        last = len(self._tour) - 1
        return node.goal == last and bool(self._way(last, node.place[None])[0] < self._spacing)

    def _next_goal(self, goal: int, place: FloatArray) -> int:
        """The goal after a place: the next one of the tour as soon as this one is near."""
        while self._way(goal, place[None])[0] < self._spacing and goal < len(self._tour) - 1:
            goal += 1
        return goal

    def _way(self, goal: int, places: FloatArray) -> FloatArray:
        if goal not in self._ways:
            self._ways[goal] = self._grid.ways_to(self._tour[goal])
        cells = self._grid.cells(places)
        return np.where(cells >= 0, self._ways[goal][cells], np.inf)

    def _candidates(
        self, path: list[_Node], rng: np.random.Generator, room: Room | None
    ) -> list[FloatArray]:
        """The best next places, best last."""
        here = path[-1]
        angles = 2.0 * np.pi * (np.arange(_DIRECTIONS) + rng.random()) / _DIRECTIONS
        places = here.place + self._spacing * unit(angles)
        cost = self._way(here.goal, places) + _CHANCE * rng.random(_DIRECTIONS)
        cost[~self._space.line_is_free(here.place, places, self._clearance)] = np.inf
        if room is not None:
            cost[[not room.holds(float(x), float(y)) for x, y in places]] = np.inf
        if len(path) > 1:
            step = here.place - path[-2].place
            turn = np.abs(wrap(angles - np.arctan2(step[1], step[0])))
            cost += _TURN_COST * np.maximum(turn - _SHARP, 0.0)
        old = np.array([node.place for node in path[:-1]]).reshape(-1, 2)
        near = np.linalg.norm(places[:, None] - old[None], axis=2).min(axis=1, initial=np.inf)
        cost += _REVISIT_COST * np.maximum(1.0 - near, 0.0)
        order = np.argsort(cost)[:_CHILDREN]
        return [places[k] for k in order[::-1] if np.isfinite(cost[k])]


def _room(name: str) -> Room:
    return next(room for room in ROOMS if room.name == name)


def _with_headings(points: FloatArray) -> FloatArray:
    step = np.diff(points, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.column_stack([points, np.append(heading, heading[-1])])
