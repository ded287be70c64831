"""Files of odometry in a recording's folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fgslam.core.errors import DatasetError
from fgslam.datasets.gyroscope import checked_rates, read_rates
from fgslam.datasets.odometry import (
    AnyLog,
    read_pose_log,
    read_speed_log,
    recorded_motions,
)
from fgslam.datasets.odometry_columns import has_named_columns, read_named_columns
from fgslam.datasets.recording import OdometrySource
from fgslam.datasets.settings import RecordedOdometrySettings


def find_odometry(root: Path, name: str | None) -> Path | None:
    """The file of odometry in a recording's folder: the named one, else the only one there is.

    Without any, the only file of a gyroscope, imu*.csv or gyro*.csv.

    Raises:
        DatasetError: it is not there, or there are several.
    """
    if name is not None:
        if not (root / name).is_file():
            raise DatasetError(
                f"dataset.odometry_file {root / name} does not exist; correct the name, or leave "
                "it out"
            )
        return root / name
    found: Iterable[Path] = (*(root / name for name in _POSES), *sorted(root.glob("odom*.csv")))
    candidates = [path for path in found if path.is_file()]
    if not candidates:  # wheels say more than a gyroscope
        candidates = [path for path in sorted(root.glob("*.csv")) if is_of_gyroscope(path)]
    if len(candidates) > 1:
        raise DatasetError(
            f"{root} has several odometry files ({', '.join(p.name for p in candidates)}); name "
            "one in dataset.odometry_file"
        )
    return candidates[0] if candidates else None


_POSES = ("odometry.txt", "odom.txt")  # the second of OpenLORIS


def file_odometry(path: Path | None, settings: RecordedOdometrySettings) -> OdometrySource | None:
    """Body motions by a file, which is read when they are first needed; None without a file."""
    if path is None:
        return None

    return recorded_motions(str(path), lambda: _read(path, settings), settings)


def is_of_gyroscope(path: Path) -> bool:
    """Whether a file is that of a gyroscope, by its name."""
    return path.is_file() and path.name.lower().startswith(("imu", "gyro"))


def _read(path: Path, settings: RecordedOdometrySettings) -> AnyLog:
    if has_named_columns(path):
        return read_named_columns(path, settings)
    if is_of_gyroscope(path):
        return checked_rates(read_rates(path), settings)
    if path.suffix == ".csv":
        return read_speed_log(path, settings)
    return read_pose_log(path, settings)
