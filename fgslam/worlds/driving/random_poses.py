"""Poses drawn all over the free floor: the views of a robot that was carried somewhere else.

Each pose has random numbers of its own, so that the k-th pose depends neither on how many there are
nor on the others. A burst of frames may go straight ahead from each.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import ConfigError
from fgslam.worlds.driving.floor_space import FloorSpace
from fgslam.worlds.driving.paths import planar_poses
from fgslam.worlds.lab.settings import LabDriveSettings

_STREAM = 31  # of random numbers, apart from the world's
_BLOCK, _BLOCKS = 64, 200
_POSES = 200


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
    ahead = wanted.step_m * np.arange(wanted.burst)
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
