"""Homing estimators by their kind, and the two that average bearings."""

from __future__ import annotations

from difflib import get_close_matches
from typing import ClassVar

import numpy as np

from fgslam.backend.homing.ekf import HomingEkf
from fgslam.backend.homing.graph import HomingGraph
from fgslam.backend.homing.paper_ekf import PaperEkf
from fgslam.backend.homing.parts import HomingEstimator, TrackedFeatures
from fgslam.backend.settings import (
    AverageLandmarkVectorSettings,
    HomingEkfSettings,
    HomingEstimatorKind,
    HomingGraphSettings,
    PaperEkfSettings,
    SnapshotSettings,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import HomingEstimate, HomingStart, TrackedBearings
from fgslam.core.errors import ConfigError, EstimatorError
from fgslam.core.geometry import unit, wrap

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


# --------------------------------------------------------------------------------------------
# Homing by averages of bearings: no map, no distance, no covariance
#
# Both compare the bearings of now with those from the target, feature by feature, once the target's
# have been turned by the heading of the target relative to the present one. The methods take that
# from a compass. Without one (*compass-free*) it is the circular mean of the differences of both
# bearings: exact where features lie all around at equal distances, biased elsewhere, which is part
# of what the methods assume and what the comparison shows.


class BearingAverage:
    """What both methods share.

    On :class:`fgslam.backend.homing.parts.HomingEstimator`; the frame of its estimates is not
    the start's but the present robot's own, at the origin, with the target at distance 1 in the
    home direction: where the robot is, neither method knows. Covariances are NaN.
    """

    kind: ClassVar[str]

    def __init__(self, start: HomingStart) -> None:
        """Until the first image the start's own view is compared with the target's.

        Raises:
            EstimatorError: there is not one feature.
        """
        self._features = TrackedFeatures(start)
        if len(start.matches) == 0:
            raise EstimatorError("homing start: no features to average; match again")
        self._ids = start.local_map.ids
        self._target = start.matches.bearing_b
        self._turn, self._direction = 0.0, 0.0
        self._compare(start.matches.bearing_a, self._target, None)

    def update(self, tracked: TrackedBearings, compass: float | None = None) -> None:
        """Takes in one image; see the protocol.

        Args:
            tracked: the image; without any feature left the last direction stays.
            compass: heading of the target minus the present one, radians, if a compass measures it.
        """
        _, taken = self._features.take(tracked)
        if taken.any():
            rows = np.searchsorted(self._ids, tracked.ids[taken])
            self._compare(tracked.bearing[taken], self._target[rows], compass)

    def _compare(self, now: FloatArray, target: FloatArray, compass: float | None) -> None:
        turn = _mean_angle(now - target) if compass is None else compass
        home = self._home(now, wrap(target + turn))
        self._turn = float(wrap(np.array(turn)))
        if np.hypot(*home) > 0.0:
            self._direction = float(np.arctan2(home[1], home[0]))

    def _home(self, now: FloatArray, target: FloatArray) -> FloatArray:
        """(2,) vector towards home, of any length, in the robot's axes.

        Args:
            now: (n,) bearings.
            target: (n,) those from the target, turned to the present heading.
        """
        raise NotImplementedError

    def estimate(self, landmarks: bool = True) -> HomingEstimate:
        """The home direction as an estimate; see the class."""
        ids = self._features.alive
        return HomingEstimate(
            time=self._features.time,
            robot=np.zeros(3),
            target=np.append(unit(np.array(self._direction)), self._turn),
            covariance=np.full((6, 6), np.nan),
            ids=ids,
            landmarks=np.full((len(ids), 2), np.nan),
            landmark_covariances=np.full((len(ids), 2, 2), np.nan),
        )


class AverageLandmarkVector(BearingAverage):
    """Estimator of kind ``alv`` (Lambrinos et al. 2000).

    Home is where the mean unit vector to the landmarks now exceeds that of the target.
    """

    kind: ClassVar[str] = "alv"

    def _home(self, now: FloatArray, target: FloatArray) -> FloatArray:
        return np.asarray((unit(now) - unit(target)).mean(axis=0))


class AverageDisplacement(BearingAverage):
    """Estimator of kind ``snapshot`` (after Cartwright and Collett 1983).

    A step h moves the bearing phi of a feature at distance d by ``h . (sin phi, -cos phi) / d``.
    Of features all around at one distance the displacements' average along these directions is h,
    up to its length.
    """

    kind: ClassVar[str] = "snapshot"

    def _home(self, now: FloatArray, target: FloatArray) -> FloatArray:
        across = np.column_stack([np.sin(now), -np.cos(now)])
        return np.asarray((wrap(target - now)[:, None] * across).mean(axis=0))


def _mean_angle(angles: FloatArray) -> float:
    x, y = unit(angles).mean(axis=0)
    return float(np.arctan2(y, x))
