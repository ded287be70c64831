"""Builds homing estimators from their settings; the only place where their kinds are told apart."""

from __future__ import annotations

from fgslam.backend.homing.baselines import AverageDisplacement, AverageLandmarkVector
from fgslam.backend.homing.ekf import HomingEkf
from fgslam.backend.homing.graph import HomingGraph
from fgslam.backend.homing.protocol import HomingEstimator
from fgslam.backend.homing.settings import (
    AverageLandmarkVectorSettings,
    HomingEkfSettings,
    HomingEstimatorSettings,
    HomingGraphSettings,
    SnapshotSettings,
)
from fgslam.core.homing import HomingStart


def make_homing_estimator(start: HomingStart, settings: HomingEstimatorSettings) -> HomingEstimator:
    """The estimator, at the start.

    Raises:
        EstimatorError: the start's parts do not belong together, or cannot be solved.
    """
    match settings:
        case HomingEkfSettings():
            return HomingEkf(start, settings)
        case HomingGraphSettings():
            return HomingGraph(start, settings)
        case AverageLandmarkVectorSettings():
            return AverageLandmarkVector(start)
        case SnapshotSettings():
            return AverageDisplacement(start)
