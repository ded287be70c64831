"""The odometry of a bag: poses of nav_msgs/Odometry, speeds of a stamped twist, turns of an Imu."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import OdometryError
from fgslam.datasets.bags.files import Topic
from fgslam.datasets.bags.messages import IMU, ODOMETRY
from fgslam.datasets.gyroscope import checked_rates
from fgslam.datasets.odometry import (
    AnyLog,
    checked_poses,
    checked_speeds,
    recorded_motions,
)
from fgslam.datasets.recording import OdometrySource
from fgslam.datasets.settings import RecordedOdometrySettings
from fgslam.datasets.tables import Table


def odometry_source(
    topic: Topic | None,
    recorded: tuple[FloatArray, FloatArray],
    settings: RecordedOdometrySettings,
) -> OdometrySource | None:
    """Body motions by a topic's stamps (n,) in seconds and values; None where there is none."""
    stamps, values = recorded
    if topic is None or len(stamps) == 0:
        return None
    name = topic.name

    def read() -> AnyLog:
        table = _table(name, stamps, values)
        if topic.kind == ODOMETRY:
            return checked_poses(table, settings)
        if topic.kind == IMU:
            return checked_rates(table, settings)
        return checked_speeds(table, settings)

    return recorded_motions(name, read, settings)


def _table(name: str, stamps: FloatArray, values: FloatArray) -> Table:
    """Stamps and values as a table by increasing time; of equal stamps the first counts."""
    order = np.argsort(stamps, kind="stable")
    kept = order[np.concatenate([[True], np.diff(stamps[order]) > 0.0])]
    rows = np.column_stack([stamps, values])[kept]
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise OdometryError(
            f"{name}, message {kept[bad[0]] + 1}: not finite; record it again, or choose another "
            "odometry.kind"
        )
    return Table(Path(name), rows, kept + 1)
