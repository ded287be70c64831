"""Where on the floor a round robot can stand, and how far it is from the nearest obstacle.

Obstacles are all patches that reach into the robot's band of heights, seen from above: their edges
as line segments. A closed outline is all that is needed, as the robot starts outside and does not
jump.

Random poses all over the free floor are the views of a robot that was carried somewhere else. Each
has random numbers of its own, so that the k-th depends neither on how many there are nor on the
others. A burst of frames may go straight ahead from each.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import ConfigError
from fgslam.worlds.driving.paths import planar_poses
from fgslam.worlds.rendering.patches import PatchArrays
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


# --------------------------------------------------------------------------------------------
# Random poses


_STREAM = 31  # of random numbers, apart from the world's
_BLOCK, _BLOCKS = 64, 200
_POSES = 200
RANDOM_CLEARANCE_M = 0.4  # of robot and camera from walls and furniture
BURST_STEP_M = 0.1  # between the frames of a burst: about that of the lab's drives


class RandomPoses:
    """Where the robot is at each frame; between poses it is carried, and stands still at each."""

    def __init__(self, planar: FloatArray, burst: int, frame_rate_hz: float) -> None:
        self._planar = planar
        self.timestamps = np.asarray(np.arange(len(planar)) / frame_rate_hz)
        self._burst = burst

    @property
    def driven(self) -> BoolArray:
        """(n - 1,) whether the robot drove from a frame to the next: wheels know of no carrying."""
        return np.asarray(np.arange(1, len(self._planar)) % self._burst != 0)

    def body_poses(self, seconds: FloatArray) -> FloatArray:
        """(n, 4, 4) ``wTb`` in the room's frame at the nearest frames' times."""
        rate = 1.0 / self.timestamps[1]
        frame = np.rint(np.asarray(seconds) * rate).astype(np.int64)
        return planar_poses(self._planar[np.clip(frame, 0, len(self._planar) - 1)])


def draw_poses(
    settings: LabDriveSettings, space: FloorSpace, start: FloatArray, camera: FloatArray
) -> RandomPoses:
    """Draws the poses that the settings ask for.

    Args:
        settings: how many frames and bursts.
        space: the free floor.
        start: (2,) a place that can be driven to: only places connected with it are drawn.
        camera: (2,) of the camera ahead and left of the robot's centre, metres.

    Raises:
        ConfigError: the frames are no whole number of bursts, or no place has room for one.
    """
    burst, seed = settings.random_poses.burst, settings.random_poses.seed
    frames = _POSES * burst if settings.frames is None else settings.frames
    if frames % burst:
        raise ConfigError(
            f"dataset.drive.frames is {frames}, no multiple of random_poses.burst {burst}; make it "
            "one"
        )
    robot = np.column_stack([BURST_STEP_M * np.arange(burst), np.zeros(burst)])
    offsets = np.vstack([robot, robot + camera])
    parts, _ = ndimage.label(space.clearances >= RANDOM_CLEARANCE_M)
    here = _cells(space, parts, np.asarray(start, dtype=np.float64)[None])[0]
    poses = [
        _draw(space, parts == here, offsets, np.random.default_rng([seed, _STREAM, k]))
        for k in range(frames // burst)
    ]
    planar = np.concatenate([_moved(pose, offsets[:burst]) for pose in poses])
    return RandomPoses(planar, burst, settings.frame_rate_hz)


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
        probably = _cells(space, reached, places.reshape(-1, 2)).reshape(places.shape[:-1])
        for k in np.flatnonzero(probably.all(axis=1)):
            if (space.clearance(places[k]) >= RANDOM_CLEARANCE_M).all():
                return np.asarray(drawn[k])
    raise ConfigError(
        f"no place with room for dataset.drive.random_poses.burst {len(offsets) // 2} is found; "
        "lower it"
    )


def _cells(
    space: FloorSpace, grid: npt.NDArray[np.generic], points: FloatArray
) -> npt.NDArray[np.generic]:
    """Values (n,) of a grid (rows, columns) at points (n, 2); 0 outside."""
    cell = np.floor((points - space.low) / space.cell).astype(np.int64)
    inside = np.all((cell >= 0) & (cell < np.array(grid.shape)[::-1]), axis=1)
    column, row = np.where(inside[:, None], cell, 0).T
    return np.where(inside, grid[row, column], 0)


def _moved(pose: FloatArray, offsets: FloatArray) -> FloatArray:
    """(n, 3) planar poses at offsets (n, 2) ahead and left of a pose (3,)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    xy = pose[:2] + offsets @ np.array([[c, s], [-s, c]])
    return np.column_stack([xy, np.full(len(offsets), pose[2])])
