"""GPS and inertial data of KITTI raw, oxts/: odometry and true poses of the inertial unit.

Format and projection: Geiger et al. 2013, "Vision meets robotics", and its development kit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.files import read_text, shown_in
from fgslam.datasets.loose_files import natural
from fgslam.datasets.odometry import checked_speeds, recorded_motions
from fgslam.datasets.recording import OdometrySource
from fgslam.datasets.settings import RecordedOdometrySettings
from fgslam.datasets.stamps import written_stamps
from fgslam.datasets.tables import Table

_LATITUDE, _LONGITUDE, _ALTITUDE, _ROLL, _PITCH, _YAW = range(6)
_FORWARD_SPEED, _YAW_RATE = 8, 22
_COLUMNS = 23  # of those that are used; a file has 30
_EARTH_RADIUS_M = 6_378_137.0


@dataclass(frozen=True, slots=True, eq=False)
class Oxts:
    """Rows (n, k) of the files' numbers at stamps (n,) in seconds."""

    folder: Path
    stamps: FloatArray
    rows: FloatArray

    def odometry(self, settings: RecordedOdometrySettings) -> OdometrySource:
        """Motions of the unit by its forward speed and yaw rate."""
        values = np.column_stack([self.stamps, self.rows[:, [_FORWARD_SPEED, _YAW_RATE]]])
        table = Table(self.folder, values, np.arange(1, len(values) + 1))
        return recorded_motions(
            str(self.folder), partial(checked_speeds, table, settings), settings
        )

    def poses(self) -> Trajectory:
        """Poses of the unit (x ahead, y left, z up) in a world with x east, z up."""
        from scipy.spatial.transform import Rotation

        latitude, longitude = np.radians(self.rows[:, [_LATITUDE, _LONGITUDE]]).T
        scale = np.cos(latitude[0]) * _EARTH_RADIUS_M  # of the Mercator projection
        poses = np.tile(np.eye(4), (len(self.rows), 1, 1))
        north = np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
        where = np.column_stack([scale * longitude, scale * north, self.rows[:, _ALTITUDE]])
        poses[:, :3, 3] = where - where[0]
        angles = self.rows[:, [_YAW, _PITCH, _ROLL]]
        poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
        return Trajectory(self.stamps, poses)


def read_oxts(drive: Path) -> Oxts | None:
    """The inertial data of a drive; None where it has none.

    Raises:
        DatasetError: a file or the list of times is malformed.
    """
    folder = drive / "oxts"
    data = folder / "data"
    files = (
        sorted((p for p in shown_in(data) if p.suffix == ".txt"), key=natural)
        if data.is_dir()
        else []
    )
    if not files:
        return None
    found = written_stamps(files, (folder,)) if (folder / "timestamps.txt").is_file() else None
    if found is None:
        raise DatasetError(f"{folder} has no timestamps.txt; restore it, or remove the folder")
    return Oxts(folder, found[0], np.array([_row(path) for path in files]))


def _row(path: Path) -> list[float]:
    try:
        values = [float(word) for word in read_text(path, DatasetError).split()[:_COLUMNS]]
    except ValueError:
        values = []
    if len(values) < _COLUMNS or not np.isfinite(values).all():
        raise DatasetError(f"{path}: expected 30 numbers; restore the file")
    return values
