"""The free floor of a scene, random poses all over it, and reference paths through the house.

Obstacles are all patches that reach into the robot's band of heights, seen from above: their edges
as line segments. A closed outline is all that is needed, as the robot starts outside and does not
jump.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from skimage.graph import MCP_Geometric

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.geometry import unit, wrap
from fgslam.worlds.driving import FRAME_RATE_HZ, Drive
from fgslam.worlds.patches import PatchArrays
from fgslam.worlds.places import HOUSE
from fgslam.worlds.settings import LabDriveSettings

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
        outlines: (n, 2, 2) edges of all obstacles, from above: ends, then x and y in metres.
    """

    def __init__(self, patches: PatchArrays, low: FloatArray, high: FloatArray) -> None:
        """Takes the obstacles between two corners (2,) of the floor."""
        c, u, v = patches.corner, patches.edge_u, patches.edge_v
        corners = np.stack([c, c + u, c + u + v, c + v], axis=1)
        z = corners[..., 2]
        start = corners[(z.max(axis=1) > BAND[0]) & (z.min(axis=1) < BAND[1])][..., :2]
        start, end = start.reshape(-1, 2), np.roll(start, -1, axis=1).reshape(-1, 2)
        both = np.round(np.hstack([np.minimum(start, end), np.maximum(start, end)]), 6)
        once = np.sort(np.unique(both, axis=0, return_index=True)[1])
        length = np.linalg.norm(end[once] - start[once], axis=1)
        once, length = once[length > 1e-6], length[length > 1e-6]
        start, end = self._start, self._end = start[once], end[once]
        self.outlines: FloatArray = np.stack([start, end], axis=1)
        self.low, self.cell = np.asarray(low, dtype=np.float64), _CELL
        columns, rows = np.ceil((np.asarray(high) - self.low) / _CELL).astype(int)
        count = np.ceil(length / (0.4 * _CELL)).astype(int) + 1  # of the points on each outline
        which = np.repeat(np.arange(len(count)), count)
        first = np.repeat(np.cumsum(count) - count, count)
        part = (np.arange(len(which)) - first) / np.maximum(count[which] - 1, 1)
        points = start[which] + part[:, None] * (end - start)[which]
        j, i = ((points - self.low) / _CELL).astype(int).T
        inside = (i >= 0) & (i < rows) & (j >= 0) & (j < columns)
        free = np.ones((rows, columns), dtype=np.bool_)
        free[i[inside], j[inside]] = False
        self.clearances = ndimage.distance_transform_edt(free) * _CELL

    def clearance(self, points: FloatArray) -> FloatArray:
        """(n,) exact distance in metres of points (n, 2) to the nearest obstacle.

        Farther than a metre from anything the grid answers, to half a cell.
        """
        points = np.atleast_2d(np.asarray(points, dtype=np.float64))
        out = self._coarse(points)
        for k in np.flatnonzero(out < _NEAR):
            out[k] = self._exact(points[k])
        return out

    def touches(self, place: FloatArray, radius: float, margin: float) -> bool:
        """Whether a disc at a place (2,) meets an obstacle; exact within ``margin`` of contact.

        The margin must exceed the grid's error, a cell.
        """
        coarse = float(self._coarse(place[None])[0])
        return (coarse if abs(coarse - radius) > margin else self._exact(place)) < radius

    def line_is_free(self, start: FloatArray, ends: FloatArray, radius: float) -> BoolArray:
        """(n,) whether a disc can go straight from ``start`` (2,) to each of ``ends`` (n, 2).

        Tested at every tenth of a metre on the grid, whose error of half a cell is added.
        """
        steps = max(int(np.ceil(np.linalg.norm(ends - start, axis=1).max(initial=0.1) / 0.1)), 1)
        part = np.linspace(0.0, 1.0, steps + 1)[:, None, None]
        along = start + part * (ends - start)
        free = self._coarse(along.reshape(-1, 2)).reshape(along.shape[:2])
        return np.asarray((free > radius + 0.5 * _CELL).all(axis=0))

    def values(self, grid: npt.NDArray[np.generic], points: FloatArray) -> npt.NDArray[np.generic]:
        """(n,) values of a grid (rows, columns) at points (n, 2); 0 outside."""
        cell = np.floor((points - self.low) / _CELL).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < np.array(grid.shape)[::-1]), axis=1)
        column, row = np.where(inside[:, None], cell, 0).T
        return np.where(inside, grid[row, column], 0)

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
        offset = self._start + part[:, None] * edge - point
        return float(np.sqrt(np.min(np.sum(offset * offset, axis=1))))


# --------------------------------------------------------------------------------------------
# Random poses: the views of a robot that was carried somewhere else
#
# Each has random numbers of its own, so that the k-th depends neither on how many there are nor on
# the others. A burst of frames may go straight ahead from each.


_STREAM = 31  # of random numbers, apart from the world's
_BLOCK, _BLOCKS = 64, 200
_POSES = 200
RANDOM_CLEARANCE_M = 0.4  # of robot and camera from walls and furniture
BURST_STEP_M = 0.1  # between the frames of a burst: about that of the lab's drives


def draw_poses(
    settings: LabDriveSettings, space: FloorSpace, start: FloatArray, camera: FloatArray
) -> Drive:
    """Draws the poses that the settings ask for; between bursts the robot is carried.

    Args:
        settings: how many frames and bursts.
        space: the free floor.
        start: (2,) a place that can be driven to: only places connected with it are drawn.
        camera: (2,) of the camera ahead and left of the robot's centre, metres.

    Raises:
        ConfigError: the frames are no whole number of bursts, or no place has room for one.
    """
    burst = settings.random_poses.burst
    frames = _POSES * burst if settings.frames is None else settings.frames
    if frames % burst:
        raise ConfigError(
            f"dataset.drive.frames is {frames}, no multiple of random_poses.burst {burst}; make it "
            "one"
        )
    robot = np.column_stack([BURST_STEP_M * np.arange(burst), np.zeros(burst)])
    offsets = np.vstack([robot, robot + camera])
    parts, _ = ndimage.label(space.clearances >= RANDOM_CLEARANCE_M)
    reached = parts == space.values(parts, np.asarray(start, dtype=np.float64)[None])[0]
    bursts = []
    for k in range(frames // burst):
        rng = np.random.default_rng([settings.random_poses.seed, _STREAM, k])
        bursts.append(_moved(_draw(space, reached, offsets, rng), robot))
    poses = np.concatenate(bursts)
    timestamps = np.asarray(np.arange(frames) / FRAME_RATE_HZ)

    def planar(seconds: FloatArray) -> FloatArray:
        nearest = np.rint(np.asarray(seconds) * (1.0 / timestamps[1])).astype(np.int64)
        return np.asarray(poses[np.clip(nearest, 0, frames - 1)])

    return Drive(timestamps, planar, np.asarray(np.arange(1, frames) % burst != 0))


def _draw(
    space: FloorSpace, reached: BoolArray, offsets: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(3,) the first of the drawn poses at which robot and cameras are free.

    Places are tested on the grid first, ``reached`` (rows, columns) of it, then exactly.
    """
    rows, columns = reached.shape
    high = space.low + space.cell * np.array([columns, rows])
    for _ in range(_BLOCKS):
        xy = rng.uniform(space.low, high, (_BLOCK, 2))
        drawn = np.column_stack([xy, rng.uniform(-np.pi, np.pi, _BLOCK)])
        places = np.array([_moved(pose, offsets)[:, :2] for pose in drawn])
        probably = space.values(reached, places.reshape(-1, 2)).reshape(places.shape[:-1])
        for k in np.flatnonzero(probably.all(axis=1)):
            if (space.clearance(places[k]) >= RANDOM_CLEARANCE_M).all():
                return np.asarray(drawn[k])
    raise ConfigError(
        f"no place with room for dataset.drive.random_poses.burst {len(offsets) // 2} is found; "
        "lower it"
    )


def _moved(pose: FloatArray, offsets: FloatArray) -> FloatArray:
    """(n, 3) planar poses at offsets (n, 2) ahead and left of a pose (3,)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    xy = pose[:2] + offsets @ np.array([[c, s], [-s, c]])
    return np.column_stack([xy, np.full(len(offsets), pose[2])])


# --------------------------------------------------------------------------------------------
# Reference paths: targets one after another, each in straight reach of the one before
#
# A tour of the house's rooms gives the direction; a depth-first search lays targets a fixed
# distance apart so that each leg's straight line is free for the wheelchair, and steps back where
# it gets stuck. Ways around corners are measured on a grid by Dijkstra's algorithm (scikit-image).


# A closed walk through the house: every room, and the corridor twice.
_TOUR = ("hall", "office", "corridor", "studio", "workshop", "library", "corridor")
_ROOMS = {room.name: room for room in HOUSE.rooms}
_SKIP = 2  # of the floor's cells, for the grid of ways
_DIRECTIONS = 72
_CHILDREN = 4
_MOST_STEPS = 4000
_STARTS = 12
_ROOMY = 0.75
# Costs in metres of detour: of a sharp turn, of coming back to an old target, of chance.
_TURN_COST, _REVISIT_COST, _CHANCE = 2.0, 4.0, 0.5
_SHARP = np.deg2rad(45.0)


class PathPlanner:
    """Lays reference paths in the house."""

    def __init__(self, space: FloorSpace, clearance: float) -> None:
        """For paths that keep ``clearance`` metres from everything."""
        self._space, self._clearance = space, clearance
        free = space.clearances[::_SKIP, ::_SKIP] >= clearance
        self._metres = np.where(free, space.cell * _SKIP, -1.0)  # to a neighbour; below 0: no way
        parts, _ = ndimage.label(free, np.ones((3, 3)))
        self._inside = parts == 1 + np.argmax(np.bincount(parts[free])[1:])

    def reference_path(self, spacing: float, legs: int, rng: np.random.Generator) -> FloatArray:
        """(legs + 1, 3) poses, start first, each headed to the next one.

        Args:
            spacing: straight distance from each to the next, metres.
            legs: number of targets after the start.
            rng: chooses the tour and the targets.

        Raises:
            DatasetError: no such path is found.
        """
        for _ in range(_STARTS):
            first = int(rng.integers(0, len(_TOUR)))
            names = [_TOUR[(first + k) % len(_TOUR)] for k in range(3 * len(_TOUR))]
            if rng.random() < 0.5:
                names = names[::-1]
            tour = [self._spot(name, rng) for name in names]
            points = self.walk(tour, spacing, legs, rng)
            if points is not None:
                return _with_headings(points)
        raise DatasetError(
            f"no path of {legs} legs of {spacing} m with {self._clearance} m of clearance is found "
            "in the house; lower path.spacing_m or path.legs"
        )

    def crossing_routes(
        self, spacing: float, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Poses (n, 3) and (m, 3) of two routes, each from one room to another by the corridor.

        Both lead by one place of it. The last poses lie about ``spacing`` metres from the routes'
        ends.

        Raises:
            DatasetError: no such routes are found.
        """
        rooms = [name for name in _ROOMS if name != "corridor"]
        for _ in range(_STARTS):
            a, b, c, d = (self._spot(str(name), rng) for name in rng.permutation(rooms)[:4])
            middle = self._spot("corridor", rng)
            one = self.walk((a, middle, b), spacing, None, rng)
            other = self.walk((c, middle, d), spacing, None, rng)
            if one is not None and other is not None:
                return _with_headings(one), _with_headings(other)
        raise DatasetError(
            f"no two routes of legs of {spacing} m meet in the corridor; lower path.spacing_m"
        )

    def walk(
        self,
        tour: Sequence[FloatArray],
        spacing: float,
        legs: int | None,
        rng: np.random.Generator,
    ) -> FloatArray | None:
        """(legs + 1, 2) places of a walk from the first of some free places (2,) by the others.

        Searched depth-first; None where no such walk is found. Without ``legs`` it ends a leg
        before the last place.
        """
        ways: dict[int, FloatArray] = {}
        last = len(tour) - 1

        def way(goal: int, places: FloatArray) -> FloatArray:
            """(n,) metres to drive from places (n, 2) to one of the tour's."""
            if goal not in ways:
                start = np.unravel_index(self._cells(tour[goal][None])[0], self._inside.shape)
                ways[goal] = MCP_Geometric(self._metres).find_costs([start])[0].ravel()
            cells = self._cells(places)
            return np.where(cells >= 0, ways[goal][cells], np.inf)

        def next_places() -> list[FloatArray]:
            """The best places to go on to, best last."""
            here = path[-1]
            angles = 2.0 * np.pi * (np.arange(_DIRECTIONS) + rng.random()) / _DIRECTIONS
            places = here + spacing * unit(angles)
            cost = way(goals[-1], places) + _CHANCE * rng.random(_DIRECTIONS)
            cost[~self._space.line_is_free(here, places, self._clearance)] = np.inf
            if len(path) > 1:
                step = here - path[-2]
                turn = np.abs(wrap(angles - np.arctan2(step[1], step[0])))
                cost += _TURN_COST * np.maximum(turn - _SHARP, 0.0)
            old = np.array(path[:-1]).reshape(-1, 2)
            near = np.linalg.norm(places[:, None] - old[None], axis=2).min(axis=1, initial=np.inf)
            cost += _REVISIT_COST * np.maximum(1.0 - near, 0.0)
            order = np.argsort(cost)[:_CHILDREN]
            return [places[k] for k in order[::-1] if np.isfinite(cost[k])]

        # Of each target laid: where, which place of the tour is next, and what to try from it.
        path, goals = [tour[0]], [1]
        untried = [next_places()]
        for _ in range(_MOST_STEPS):
            near_end = legs is None and goals[-1] == last and way(last, path[-1][None])[0] < spacing
            if len(path) - 1 == legs or near_end:
                return np.array(path)
            if not untried[-1]:
                for stack in (path, goals, untried):
                    stack.pop()
                if not path:
                    return None
                continue
            place, goal = untried[-1].pop(), goals[-1]
            while way(goal, place[None])[0] < spacing and goal < last:
                goal += 1
            path.append(place)
            goals.append(goal)
            untried.append(next_places())
        return None

    def _spot(self, name: str, rng: np.random.Generator) -> FloatArray:
        """A roomy place drawn within a room."""
        room = _ROOMS[name]
        low, high = np.array([room.west, room.south]), np.array([room.east, room.north])
        for bound in (_ROOMY, self._clearance):
            for _ in range(200):
                place = rng.uniform(low, high)
                free = self._cells(place[None])[0] >= 0
                if free and self._space.clearance(place)[0] >= bound:
                    return np.asarray(place)
        raise DatasetError(f"no free place in the {name} with {self._clearance} m around it")

    def _cells(self, points: FloatArray) -> IntArray:
        """(n,) numbers of the cells that hold points (n, 2), -1 outside the connected floor."""
        at = (points - self._space.low) / (self._space.cell * _SKIP)
        column, row = np.floor(at).astype(int).T
        rows, columns = self._inside.shape
        valid = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        number = np.where(valid, row * columns + column, 0)
        return np.where(valid & self._inside.ravel()[number], number, -1)


def _with_headings(points: FloatArray) -> FloatArray:
    step = np.diff(points, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.column_stack([points, np.append(heading, heading[-1])])
