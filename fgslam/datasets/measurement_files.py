"""Measurements as recordings: a folder with a log, and what all of them share.

Landmark identities and the motion model of logs. docs/datasets/measurements.md.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import ConfigError
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment, Observations, Odometry
from fgslam.core.recordings import (
    LANDMARK_TRUTH_FILE,
    MeasurementRecording,
    read_landmark_truth,
)
from fgslam.core.sensors import CameraRig
from fgslam.core.trajectories import Trajectory
from fgslam.datasets.images import require_folder
from fgslam.datasets.recording import select_of
from fgslam.datasets.settings import (
    ConstantVelocitySettings,
    MeasurementFilesSettings,
    OdometrySettings,
    RecordedOdometrySettings,
    SyntheticOdometrySettings,
)

LOG_FILE, GROUND_TRUTH_FILE = "measurements.npz", "ground_truth.tum"
_STAMP_STEP_S = 1e-9  # of a trajectory's file
_NONE: IntArray = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredFrame:
    """One frame of a recording whose landmarks are known by number.

    Attributes:
        index: the recording's frame number.
        timestamp: seconds.
        odometry: motion of the camera or sensor since the last frame of the selection, or None.
        ids: (k,) landmark numbers, unique.
        measurement: (k, 3).
        covariance: (k, 3, 3).
        pixels: (k, 3, 2) raw pixels, NaN where there are none.
    """

    index: int
    timestamp: float
    odometry: Odometry | None
    ids: IntArray
    measurement: FloatArray
    covariance: FloatArray
    pixels: FloatArray


def open_measurement_files(
    settings: MeasurementFilesSettings, odometry: OdometrySettings
) -> MeasurementRecording:
    """Opens a folder with a log: a run folder, or what `scripts/convert` wrote.

    Raises:
        DatasetError: the folder is missing, or a file of it is damaged.
        MeasurementLogError: the log is.
        ConfigError: synthetic odometry is asked for, or other frames than the first ones.
    """
    if settings.start or settings.stride != 1:
        raise ConfigError(
            "measurements build upon those of earlier frames: set dataset.stop alone, without "
            "dataset.start and dataset.stride"
        )
    root = Path(settings.path)
    require_folder(root, "the recording")
    path, truth, landmarks = (
        root / name for name in (LOG_FILE, GROUND_TRUTH_FILE, LANDMARK_TRUTH_FILE)
    )
    log = MeasurementLog.load(path)
    count = len(select_of(len(log), settings, str(path)))
    log = make_log(log.rig, list(log)[:count], odometry)
    poses = Trajectory.load(truth) if truth.is_file() else None
    if poses is not None:
        within = poses.timestamps < log.timestamps[-1] + _STAMP_STEP_S
        poses = Trajectory(poses.timestamps[within], poses.poses[within])
    return MeasurementRecording(
        name=root.resolve().name,
        identity=files_identity(
            [one for one in (path, truth, landmarks) if one.is_file()], asdict(settings)
        ),
        log=log,
        ground_truth=poses,
        landmark_truth=read_landmark_truth(landmarks)[0] if landmarks.is_file() else None,
        notes=(),
    )


def make_increments(frames: Iterable[MeasuredFrame]) -> list[Increment]:
    """Increments in which a landmark is new when first seen, never missed and never pruned.

    Matched landmarks come first, then the new ones, each by ascending number.
    """
    known: set[int] = set()
    out = []
    for frame in frames:
        is_new = np.array([i not in known for i in frame.ids.tolist()], np.bool_)
        order = np.lexsort((frame.ids, is_new))
        everything = Observations(
            frame.ids, frame.measurement, frame.covariance, frame.pixels, is_new
        )
        known.update(frame.ids.tolist())
        out.append(
            Increment(
                index=frame.index,
                timestamp=frame.timestamp,
                odometry=frame.odometry,
                observations=everything.select(order),
                rejected=np.zeros(len(order), np.bool_),
                missed_ids=_NONE,
                pruned_ids=_NONE,
            )
        )
    return out


def files_identity(files: Iterable[Path], settings: Mapping[str, Any]) -> str:
    """SHA-256 of files by their content, and of what the settings (as values) make of them."""
    values = {k: v for k, v in settings.items() if k not in ("path", "file")}
    digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode())
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def make_log(
    sensor: CameraRig, increments: list[Increment], odometry: OdometrySettings
) -> MeasurementLog:
    """A log whose motion model is what the settings of odometry ask for.

    Under ``constant_velocity`` the recording's own odometry is left out. A recording without any
    is predicted by constant velocity, whatever the kind: nothing else could be.

    Raises:
        ConfigError: synthetic odometry is asked for.
    """
    if isinstance(odometry, SyntheticOdometrySettings):
        raise ConfigError(
            "odometry.kind synthetic needs a recording of images; measurements bring their own "
            "odometry: choose recorded or constant_velocity"
        )
    if isinstance(odometry, ConstantVelocitySettings):
        log = MeasurementLog(sensor, asdict(odometry))
        increments = [_without_odometry(increment) for increment in increments]
    else:
        log = MeasurementLog(sensor, _recorded(increments, odometry))
    for increment in increments:
        log.append(increment)
    return log


def _recorded(increments: list[Increment], odometry: RecordedOdometrySettings) -> dict[str, Any]:
    stand_in = asdict(odometry.gap)
    measured = any(increment.odometry is not None for increment in increments)
    return {"kind": "recorded", "stand_in": stand_in} if measured else stand_in


def _without_odometry(increment: Increment) -> Increment:
    return dataclasses.replace(increment, odometry=None)
