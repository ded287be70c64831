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
from fgslam.worlds.lab_settings import LabDriveSettings
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


# --------------------------------------------------------------------------------------------
# Random poses


_STREAM = 31  # of random numbers, apart from the world's
_BLOCK, _BLOCKS = 64, 200
_POSES = 200
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
        settings: how many frames, bursts, and the least clearance.
        space: the free floor.
        start: (2,) a place that can be driven to: only places connected with it are drawn.
        camera: (2,) of the camera ahead and left of the robot's centre, metres.

    Raises:
        ConfigError: the frames are no whole number of bursts, or no place is so free.
    """
    wanted = settings.random_poses
    frames = _POSES * wanted.burst if settings.frames is None else settings.frames
    if frames % wanted.burst:
        raise ConfigError(
            f"dataset.drive.frames is {frames}, no multiple of random_poses.burst {wanted.burst}; "
            "make it one"
        )
    free = _Free(space, start, wanted.clearance_m)
    ahead = BURST_STEP_M * np.arange(wanted.burst)
    robot = np.column_stack([ahead, np.zeros(wanted.burst)])
    offsets = np.vstack([robot, robot + camera])
    poses = [
        _draw(free, offsets, np.random.default_rng([wanted.seed, _STREAM, k]))
        for k in range(frames // wanted.burst)
    ]
    planar = np.concatenate([_moved(pose, offsets[: wanted.burst]) for pose in poses])
    return RandomPoses(planar, wanted.burst, settings.frame_rate_hz)


class _Free:
    """Places with the clearance asked for that can be driven to."""

    def __init__(self, space: FloorSpace, start: FloatArray, clearance: float) -> None:
        self.space, self.clearance = space, clearance
        parts, _ = ndimage.label(space.clearances >= clearance)
        here = self._at(parts, np.asarray(start, dtype=np.float64)[None])[0]
        if here == 0:
            raise ConfigError(
                f"dataset.drive.random_poses.clearance_m {clearance:g} leaves no room for the "
                "robot where the drive of dataset.drive.world_from starts; lower it"
            )
        self._reached = parts == here
        rows, columns = space.clearances.shape
        self.high = space.low + space.cell * np.array([columns, rows])

    def probably(self, points: FloatArray) -> BoolArray:
        """(...) whether points (..., 2) lie in free cells."""
        flat = self._at(self._reached, points.reshape(-1, 2))
        return np.asarray(flat.reshape(points.shape[:-1]))

    def surely(self, points: FloatArray) -> bool:
        """Whether all points (n, 2) keep their distance, exactly."""
        return bool((self.space.clearance(points) >= self.clearance).all())

    def _at(self, grid: npt.NDArray[np.generic], points: FloatArray) -> npt.NDArray[np.generic]:
        cell = np.floor((points - self.space.low) / self.space.cell).astype(np.int64)
        limit = np.array(grid.shape)[::-1]
        inside = np.all((cell >= 0) & (cell < limit), axis=1)
        column, row = np.where(inside[:, None], cell, 0).T
        return np.where(inside, grid[row, column], 0)


def _draw(free: _Free, offsets: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(3,) the first of the drawn poses at which robot and cameras are free."""
    for _ in range(_BLOCKS):
        xy = rng.uniform(free.space.low, free.high, (_BLOCK, 2))
        heading = rng.uniform(-np.pi, np.pi, _BLOCK)
        drawn = np.column_stack([xy, heading])
        places = np.array([_moved(pose, offsets)[:, :2] for pose in drawn])
        for k in np.flatnonzero(free.probably(places).all(axis=1)):
            if free.surely(places[k]):
                return np.asarray(drawn[k])
    raise ConfigError(
        f"no place with dataset.drive.random_poses.clearance_m {free.clearance:g} around it is "
        "found; lower it"
    )


def _moved(pose: FloatArray, offsets: FloatArray) -> FloatArray:
    """(n, 3) planar poses at offsets (n, 2) ahead and left of a pose (3,)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    xy = pose[:2] + offsets @ np.array([[c, s], [-s, c]])
    return np.column_stack([xy, np.full(len(offsets), pose[2])])
