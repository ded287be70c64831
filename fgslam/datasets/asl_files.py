"""Files of the ASL layout (EuRoC): sensor.yaml, data.csv of a camera, data.csv of the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.cameras.calibration_formats import read_asl_mounting
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.files import read_lines
from fgslam.core.geometry import inverse
from fgslam.datasets.tables import Table, read_table, require_increasing
from fgslam.datasets.trajectories import (
    nearest_rows,
    poses_from_quaternions,
    require_unit_quaternions,
)

NANOSECONDS = 1e-9
_TRUTH_COLUMNS = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrames:
    """Images listed in a camera's data.csv: stamps (n,) in nanoseconds, increasing, and files."""

    stamps: IntArray
    paths: tuple[Path, ...]


def read_camera_frames(folder: Path) -> CameraFrames:
    """Images that a camera's data.csv lists (``stamp in ns, file name``), under data/.

    Raises:
        DatasetError: the file is missing, empty or malformed, or stamps do not increase.
    """
    path = folder / "data.csv"
    stamps: list[int] = []
    paths: list[Path] = []
    for line, text in read_lines(path):
        words = [word.strip() for word in text.split(",")]
        if len(words) < 2 or not words[0].isdecimal() or not words[1]:
            raise DatasetError(
                f"{path}, line {line}: expected a stamp in nanoseconds and a file name; correct "
                "the line"
            )
        if stamps and int(words[0]) <= stamps[-1]:
            raise DatasetError(
                f"{path}, line {line}: stamp {words[0]} does not come after {stamps[-1]}; put the "
                "lines in time order and remove duplicates"
            )
        stamps.append(int(words[0]))
        paths.append(folder / "data" / words[1])
    if not stamps:
        raise DatasetError(f"{path} lists no image; restore the file")
    return CameraFrames(np.array(stamps, np.int64), tuple(paths))


def pair_frames(
    right: CameraFrames, left: CameraFrames, tolerance: float
) -> tuple[tuple[IntArray, IntArray], tuple[str, ...]]:
    """Rows of the right and the left images that are each other's nearest in time.

    Args:
        right: images of the right camera.
        left: images of the left camera.
        tolerance: largest difference in seconds.

    Returns:
        The paired rows, and notes on images left without a partner.

    Raises:
        DatasetError: no pair is left.
    """
    partner = nearest_rows(left.stamps, right.stamps)
    rows = np.arange(len(right.stamps))
    mutual = nearest_rows(right.stamps, left.stamps)[partner] == rows
    close = np.abs(left.stamps[partner] - right.stamps) <= round(tolerance / NANOSECONDS)
    kept = rows[mutual & close]
    if len(kept) == 0:
        raise DatasetError(
            f"no image of {right.paths[0].parent} has a partner in {left.paths[0].parent} within "
            f"{1e3 * tolerance:g} ms; raise dataset.pairing_tolerance_ms or restore the stamps"
        )
    alone = (("right", len(rows) - len(kept)), ("left", len(left.stamps) - len(kept)))
    notes = tuple(
        f"{n} {camera} images have no partner within {1e3 * tolerance:g} ms and are left out"
        for camera, n in alone
        if n
    )
    return (kept, partner[kept]), notes


def read_body_truth(folder: Path) -> Trajectory | None:
    """Body poses of ``state_groundtruth_estimate0``, stamps in seconds; None where it is absent.

    The file gives the pose of its own sensor; sensor.yaml says where that sits on the body.

    Raises:
        DatasetError: the file is malformed, or its stamps do not increase.
        CalibrationError: its sensor.yaml is malformed.
    """
    path = folder / "data.csv"
    if not path.is_file():
        return None
    table = read_table(path, _TRUTH_COLUMNS, ",")
    require_increasing(table, table.column(0))
    stamps = table.column(0) * NANOSECONDS
    poses = _sensor_poses(table)
    if (folder / "sensor.yaml").is_file():
        mounting = folder / "sensor.yaml"
        poses = poses @ inverse(read_asl_mounting(mounting))
    return Trajectory(stamps, poses)


def _sensor_poses(table: Table) -> FloatArray:
    quaternions = table.values[:, [5, 6, 7, 4]]
    require_unit_quaternions(table, quaternions)
    return poses_from_quaternions(table.values[:, 1:4], quaternions)
