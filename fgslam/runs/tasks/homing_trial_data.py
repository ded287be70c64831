"""What one simulated homing gave."""

from __future__ import annotations

from dataclasses import dataclass

from fgslam.core.arrays import FloatArray
from fgslam.core.bearing_log import BearingLog
from fgslam.evaluation.homing import HomingErrors


@dataclass(frozen=True, slots=True, eq=False)
class TriedEstimator:
    """What one estimator made of one trial.

    Attributes:
        errors: image by image; None where it gave no estimate.
        update_ms: (k,) time of each update.
        failure: why it ended early, else empty.
    """

    errors: HomingErrors | None
    update_ms: FloatArray
    failure: str


@dataclass(frozen=True, slots=True, eq=False)
class HomingTrial:
    """One simulated homing.

    Attributes:
        share: part of outliers.
        trial: its number.
        refused: why there was no homing vector; empty where there was one.
        inliers, wrong_inliers: matches that support the vector; wrong ones among them.
        tried: by title of the estimator.
        log: of the bearings, where it is to be kept.
    """

    share: float
    trial: int
    refused: str
    inliers: int
    wrong_inliers: int
    tried: dict[str, TriedEstimator]
    log: BearingLog | None = None
