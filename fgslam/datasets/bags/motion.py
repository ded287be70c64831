"""The odometry of a bag: poses of nav_msgs/Odometry, speeds of a stamped twist, turns of an Imu."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import OdometryError
from fgslam.datasets.bags.files import Topic
from fgslam.datasets.bags.messages import IMU, ODOMETRY, TWIST, TWIST_WITH_COVARIANCE
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

MOTIONS = (ODOMETRY, TWIST, TWIST_WITH_COVARIANCE, IMU)
"""The first that a bag has is its odometry."""

FrameOf: TypeAlias = Callable[[Topic], str]

_TRUTH = re.compile(
    r"truth|(?<![a-z])gt(?![a-z])|vicon|mocap|optitrack|qualisys|leica", re.IGNORECASE
)
# Wheel odometry is stated in a frame odom; map and earth are those of localisation (REP 105), world
# is what simulators and trackers call theirs.
_GLOBAL = re.compile(r"(map|earth|world|utm|enu|ned)(_(enu|ned))?", re.IGNORECASE)
_OF_WHEELS = re.compile(r"wheel|encoder", re.IGNORECASE)
# Their odometry is the truth; pictures of each pixel's object are made by simulators.
_SIMULATED = re.compile(r"^/(airsim|carla|tesse)|/segmentation(/|$)|/seg_cam/", re.IGNORECASE)


def motion_of_bag(
    topics: Sequence[Topic], frame_of: FrameOf
) -> tuple[Topic | None, tuple[str, ...]]:
    """Odometry, of the preferred type the topic whose name says so; and what is none, in a note.

    Truth, and others' answers in a global frame, would make the drive look better than it is.
    """
    found = [topic for topic in topics if topic.kind in MOTIONS]
    simulated = next((t.name for t in topics if _SIMULATED.search(t.name)), "")
    reasons = {topic: _why_none(topic, simulated, frame_of) for topic in found}
    left_out = ", ".join(f"{topic.name} ({why})" for topic, why in reasons.items() if why)
    told = f"not taken for odometry: {left_out}; --topics LEFT,RIGHT,ODOMETRY takes one"
    order = {kind: k for k, kind in enumerate(MOTIONS)}
    used = [topic for topic, reason in reasons.items() if not reason]
    rank = lambda t: (order[t.kind], "odom" not in t.name, len(t.name), t.name)  # noqa: E731 - short
    return min(used, key=rank, default=None), (told,) if left_out else ()


def _why_none(topic: Topic, simulated: str, frame_of: FrameOf) -> str:
    """Why a topic is not odometry; empty where it is."""
    if _TRUTH.search(topic.name):
        return "truth by its name"
    if topic.kind != ODOMETRY or _OF_WHEELS.search(topic.name):
        return ""
    if simulated:
        return f"truth of a simulator, which {simulated} tells"
    frame = frame_of(topic)
    return f"in the global frame {frame}" if _GLOBAL.fullmatch(frame.strip("/")) else ""


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
