"""Checks of odometry's samples, and which steps between frames they cover."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import OdometryError
from fgslam.datasets.tables import Table


def require_samples(path: Path, count: int) -> None:
    """Raise OdometryError where there are too few samples to integrate."""
    if count < 2:
        raise OdometryError(
            f"{path} holds {count} samples, at least 2 are needed; restore the file, or choose "
            "another odometry.kind (constant_velocity, synthetic)"
        )


def require_sane(table: Table, values: FloatArray, limit: float, what: str, unit: str) -> None:
    """Raise OdometryError, naming the line, if one of the values (n,) exceeds the limit."""
    bad = np.flatnonzero(np.abs(values) > limit)
    if len(bad):
        k = int(bad[0])
        hint = (
            ", radians are expected: are these degrees?"
            if what in ("yaw rate", "angular velocity")
            else ""
        )
        raise OdometryError(
            f"{table.path}, line {table.lines[k]}: {what} of {values[k]:.4g} {unit} is absurd "
            f"(limit {limit:g}){hint}; correct the line, or raise the limit in the odometry "
            "settings"
        )


def steps_covered(stamps: FloatArray, frames: FloatArray, max_gap: float, hold: float) -> BoolArray:
    """Which of the n - 1 steps between frames (n,) the increasing stamps (m,) cover.

    A step is covered unless it overlaps a gap between stamps longer than ``max_gap`` seconds, or
    reaches more than ``hold`` seconds beyond the first or last stamp.
    """
    before, after = frames[:-1], frames[1:]
    long = np.diff(stamps) > max_gap
    starts, ends = stamps[:-1][long], stamps[1:][long]
    overlapped = np.searchsorted(starts, after, "left") - np.searchsorted(ends, before, "right")
    within = (before >= stamps[0] - hold) & (after <= stamps[-1] + hold)
    return np.asarray(within & (overlapped == 0))
