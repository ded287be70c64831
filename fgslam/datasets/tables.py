"""Text files of numbers and of stamped poses (TUM), read strictly, and poses at frames' stamps.

Errors name the file, the line and the remedy.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.files import read_lines


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Numbers of a text file: values (n, columns) and the line (n,) each row came from, from 1."""

    path: Path
    values: FloatArray
    lines: IntArray

    def __len__(self) -> int:
        return len(self.lines)

    def column(self, k: int) -> FloatArray:
        """Column ``k`` (n,)."""
        return np.asarray(self.values[:, k])


def read_table(
    path: Path,
    columns: tuple[str, ...],
    delimiter: str | None = None,
    error: type[DatasetError] = DatasetError,
) -> Table:
    """The first ``len(columns)`` numbers of every line; further columns are ignored.

    Args:
        path: the file.
        columns: names of the columns, for the messages.
        delimiter: what separates them; None for white space.
        error: class of the errors to raise.

    Raises:
        DatasetError: (or ``error``) the file is unreadable, or a line has too few columns, a word
            that is no number, or a number that is not finite.
    """
    rows = read_lines(path, error)
    values = np.empty((len(rows), len(columns)))
    for k, (line, text) in enumerate(rows):
        values[k] = _parse_row(path, line, text.split(delimiter), columns, error)
    return Table(path, values, np.array([line for line, _ in rows], np.int64))


def _parse_row(
    path: Path, line: int, words: list[str], columns: tuple[str, ...], error: type[DatasetError]
) -> list[float]:
    if len(words) < len(columns):
        raise error(
            f"{path}, line {line}: {len(words)} columns, expected {len(columns)} "
            f"({', '.join(columns)}); complete or remove the line"
        )
    row = []
    for name, word in zip(columns, words, strict=False):
        try:
            value = float(word)
        except ValueError:
            raise error(
                f"{path}, line {line}: {name} is {word.strip()!r}, not a number; correct the line"
            ) from None
        if not np.isfinite(value):
            raise error(
                f"{path}, line {line}: {name} is {word.strip()}, not finite; correct or remove the "
                "line"
            )
        row.append(value)
    return row


def require_increasing(
    table: Table, stamps: FloatArray, error: type[DatasetError] = DatasetError
) -> None:
    """Raises ``error``, naming the line, unless the time stamps (n,) increase strictly."""
    bad = np.flatnonzero(np.diff(stamps) <= 0.0)
    if len(bad):
        k = int(bad[0])
        raise error(
            f"{table.path}, line {table.lines[k + 1]}: time {stamps[k + 1]:.6f} s does not come "
            f"after {stamps[k]:.6f} s of line {table.lines[k]}; put the lines in time order and "
            "remove duplicates"
        )


# --------------------------------------------------------------------------------------------
# Trajectories


TUM_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_QUATERNION_TOLERANCE = 0.01

AnyStamps = TypeVar("AnyStamps", FloatArray, IntArray)
"""Stamps in seconds, or in whole nanoseconds, which are compared without rounding."""


def poses_from_quaternions(positions: FloatArray, quaternions: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) of positions (n, 3) and quaternions (n, 4) (x, y, z, w)."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    from scipy.spatial.transform import Rotation

    poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = positions
    return poses


def require_unit_quaternions(
    table: Table, quaternions: FloatArray, error: type[DatasetError] = DatasetError
) -> None:
    """Raises ``error``, naming the line, unless all quaternions (n, 4) have length 1."""
    norms = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(np.abs(norms - 1.0) > _QUATERNION_TOLERANCE)
    if len(bad):
        k = int(bad[0])
        raise error(
            f"{table.path}, line {table.lines[k]}: the quaternion has length {norms[k]:.3f}, not 1"
            f"; check the order of the columns ({' '.join(TUM_COLUMNS)})"
        )


def read_tum_table(
    path: Path, error: type[DatasetError] = DatasetError
) -> tuple[Table, Trajectory]:
    """Poses of a TUM file (``t x y z qx qy qz qw``), with the table they came from.

    Raises:
        DatasetError: (or ``error``) a line is malformed, times do not increase, a quaternion is
            not of unit length.
    """
    table = read_table(path, TUM_COLUMNS, error=error)
    return table, trajectory_of(table, error)


def trajectory_of(table: Table, error: type[DatasetError] = DatasetError) -> Trajectory:
    """The poses of a table with the columns of a TUM file; raises as :func:`read_tum_table`."""
    require_increasing(table, table.column(0), error)
    require_unit_quaternions(table, table.values[:, 4:8], error)
    poses = poses_from_quaternions(table.values[:, 1:4], table.values[:, 4:8])
    return Trajectory(table.column(0), poses)


def nearest_rows(stamps: AnyStamps, at: AnyStamps) -> IntArray:
    """Row of the increasing stamps (n,), n >= 1, nearest to each of ``at`` (m,)."""
    after = np.clip(np.searchsorted(stamps, at), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(stamps[before] - at) <= np.abs(stamps[after] - at)
    return np.asarray(np.where(closer, before, after), np.int64)


def rows_at(stamps: FloatArray, at: FloatArray, tolerance: float) -> IntArray:
    """Row of the stamps (n,) within ``tolerance`` seconds of each of ``at`` (m,), or -1."""
    nearest = nearest_rows(stamps, at)
    return np.asarray(np.where(np.abs(stamps[nearest] - at) <= tolerance, nearest, -1))


def covered(stamps: FloatArray, at: FloatArray, max_gap: float, tolerance: float) -> BoolArray:
    """Which times ``at`` (m,) the increasing stamps (n,) cover.

    A time is covered when it lies between two stamps at most ``max_gap`` seconds apart, or within
    ``tolerance`` seconds of one stamp.
    """
    if len(stamps) == 0:
        return np.zeros(len(at), np.bool_)
    after = np.clip(np.searchsorted(stamps, at), 1, max(len(stamps) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    inside = (stamps[before] <= at) & (at <= stamps[after])
    bridged = inside & (stamps[after] - stamps[before] <= max_gap)
    nearest = np.minimum(np.abs(at - stamps[before]), np.abs(at - stamps[after]))
    return np.asarray(bridged | (nearest <= tolerance))


def interpolate_poses(trajectory: Trajectory, at: FloatArray) -> FloatArray:
    """Poses (m, 4, 4) at times (m,): positions linearly, rotations on the shortest arc.

    Times outside the trajectory get its first or last pose.
    """
    stamps = trajectory.timestamps
    if len(at) == 0:
        return np.empty((0, 4, 4))
    if len(stamps) == 1:
        return np.repeat(trajectory.poses, len(at), axis=0)
    clipped = np.clip(at, stamps[0], stamps[-1])
    out = np.tile(np.eye(4), (len(at), 1, 1))
    from scipy.spatial.transform import Rotation, Slerp

    rotations = Rotation.from_matrix(trajectory.poses[:, :3, :3])
    out[:, :3, :3] = Slerp(stamps, rotations)(clipped).as_matrix()
    for axis in range(3):
        out[:, axis, 3] = np.interp(clipped, stamps, trajectory.poses[:, axis, 3])
    return out


def trajectory_at_frames(
    trajectory: Trajectory, frames: FloatArray, max_gap: float = 0.1, tolerance: float = 1e-3
) -> Trajectory:
    """The trajectory at those of the frames' stamps (n,) that it covers (see :func:`covered`)."""
    known = covered(trajectory.timestamps, frames, max_gap, tolerance)
    return Trajectory(frames[known], interpolate_poses(trajectory, frames[known]))
