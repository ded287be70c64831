"""Bearing logs of a run folder, and what an estimator makes of one of them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.backend.homing.factory import make_homing_estimator
from fgslam.backend.homing.settings import HomingEstimatorSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.bearing_log import BearingLog
from fgslam.core.errors import DatasetError, EstimatorError
from fgslam.core.files import make_subfolder
from fgslam.core.homing import HomingEstimate, HomingStart, TrackedBearings

LOG_FOLDER = "logs"


def save_bearing_logs(run: Path, logs: Mapping[str, BearingLog]) -> None:
    """Writes logs by their names, each atomically. Raises OutputError."""
    if logs:
        folder = make_subfolder(run, LOG_FOLDER)
        for name, log in logs.items():
            log.save(folder / f"{name}.npz")


def load_bearing_logs(run: Path) -> dict[str, BearingLog]:
    """All logs of a run folder by their names, in order.

    Raises:
        DatasetError: there are none.
        MeasurementLogError: one is damaged.
    """
    files = sorted((run / LOG_FOLDER).glob("*.npz"))
    if not files:
        raise DatasetError(
            f"{run}: has no bearing logs ({LOG_FOLDER}/*.npz) to compare estimators on; run a "
            "homing, path_following or homing_trials experiment with output.logs above 0"
        )
    return {file.stem: BearingLog.load(file) for file in files}


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedHoming:
    """What one estimator made of one homing.

    Attributes:
        title, kind: which estimator.
        estimates: one after each image.
        update_ms: (k,) processor time of each update, and of the estimate that a robot drives by:
            without covariances of landmarks; milliseconds.
        failure: why it ended early; empty where it did not.
    """

    title: str
    kind: str
    estimates: tuple[HomingEstimate, ...]
    update_ms: FloatArray
    failure: str = ""


def replay_homing(
    start: HomingStart,
    tracks: Sequence[TrackedBearings],
    settings: HomingEstimatorSettings,
    landmarks: bool = False,
) -> ReplayedHoming:
    """Runs one estimator over all images; an error ends it, with what it had until then.

    ``landmarks``: their covariances are kept, too; asked for apart from what is timed.
    """
    estimates: list[HomingEstimate] = []
    times: list[float] = []
    failure = ""
    try:
        estimator = make_homing_estimator(start, settings)
        for tracked in tracks:
            began = time.process_time()
            estimator.update(tracked)
            estimate = estimator.estimate(landmarks=False)
            times.append(1e3 * (time.process_time() - began))
            estimates.append(estimator.estimate() if landmarks else estimate)
    except EstimatorError as error:
        failure = f"image {len(estimates)}: {error}"
    return ReplayedHoming(settings.title, settings.kind, tuple(estimates), np.array(times), failure)
