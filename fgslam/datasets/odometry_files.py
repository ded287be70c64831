"""Files of odometry in a recording's folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError, OdometryError
from fgslam.core.measurements import Odometry
from fgslam.datasets.odometry import (
    motions_from_poses,
    motions_from_speed,
    read_pose_log,
    read_speed_log,
)
from fgslam.datasets.recording import OdometrySource
from fgslam.datasets.settings import RecordedOdometrySettings


def find_odometry(root: Path, name: str | None) -> Path | None:
    """The file of odometry in a recording's folder: the named one, else the only one there is.

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
    found: Iterable[Path] = [root / "odometry.txt", *sorted(root.glob("odom*.csv"))]
    candidates = [path for path in found if path.is_file()]
    if len(candidates) > 1:
        raise DatasetError(
            f"{root} has several odometry files ({', '.join(p.name for p in candidates)}); name "
            "one in dataset.odometry_file"
        )
    return candidates[0] if candidates else None


def file_odometry(path: Path | None, settings: RecordedOdometrySettings) -> OdometrySource | None:
    """Body motions by a file, which is read when they are first needed; None without a file."""
    if path is None:
        return None

    def source(frames: FloatArray) -> tuple[Odometry | None, ...]:
        if path.suffix == ".csv":
            steps = motions_from_speed(read_speed_log(path, settings), frames, settings)
        else:
            steps = motions_from_poses(read_pose_log(path, settings), frames, settings)
        if len(frames) > 1 and all(step is None for step in steps):
            raise OdometryError(
                f"{path} covers none of the frames ({frames[0]:.3f} to {frames[-1]:.3f} s); check "
                "that both use one clock, or set odometry.time_offset_s"
            )
        return steps

    return source
