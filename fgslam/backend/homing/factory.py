"""Builds homing estimators from their settings; the only place that tells their kinds apart."""

from __future__ import annotations

from difflib import get_close_matches

from fgslam.backend.homing.baselines import AverageDisplacement, AverageLandmarkVector
from fgslam.backend.homing.ekf import HomingEkf
from fgslam.backend.homing.estimator import HomingEstimator
from fgslam.backend.homing.graph import HomingGraph
from fgslam.backend.homing.paper_ekf import PaperEkf
from fgslam.backend.homing.settings import (
    AverageLandmarkVectorSettings,
    HomingEkfSettings,
    HomingEstimatorKind,
    HomingGraphSettings,
    PaperEkfSettings,
    SnapshotSettings,
)
from fgslam.core.errors import ConfigError
from fgslam.core.homing import HomingStart

_KINDS: dict[str, type[HomingEstimatorKind]] = {
    kind.kind: kind
    for kind in (
        HomingGraphSettings,
        HomingEkfSettings,
        PaperEkfSettings,
        AverageLandmarkVectorSettings,
        SnapshotSettings,
    )
}


def homing_settings_of(estimator: str | HomingEstimatorKind) -> HomingEstimatorKind:
    """Settings of an estimator that is called by its kind; settings are returned as they are.

    Raises:
        ConfigError: there is no such estimator.
    """
    if isinstance(estimator, HomingEstimatorKind):
        return estimator
    kind = _KINDS.get(estimator) if isinstance(estimator, str) else None
    if kind is None:
        close = get_close_matches(str(estimator), _KINDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(_KINDS)}"
        raise ConfigError(f"there is no homing estimator {estimator!r}; {hint}")
    return kind()


def make_homing_estimator(start: HomingStart, settings: HomingEstimatorKind) -> HomingEstimator:
    """The estimator, at the start.

    Raises:
        EstimatorError: the start's parts do not belong together, or cannot be solved.
    """
    match settings:
        case HomingEkfSettings():
            return HomingEkf(start, settings)
        case PaperEkfSettings():
            return PaperEkf(start, settings)
        case HomingGraphSettings():
            return HomingGraph(start, settings)
        case AverageLandmarkVectorSettings():
            return AverageLandmarkVector(start)
        case SnapshotSettings():
            return AverageDisplacement(start)
