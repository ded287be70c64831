"""Gives the bearings of one homing to one estimator, and keeps what it says after each image."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.backend.homing.factory import make_homing_estimator
from fgslam.backend.homing.settings import HomingEstimatorSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.homing import HomingEstimate, HomingStart, TrackedBearings


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
