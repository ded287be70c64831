"""What one image adds to the homing graph, as plain numbers, and as GTSAM's factors.

Views are numbered: the start is 0, images count from 1, :data:`TARGET` is the target. Landmarks
are rows of the homing's matches.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gtsam
import numpy as np

from fgslam.backend.homing.settings import GraphMotionSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.homing import TwoViewVector
from fgslam.factors.bearing import (
    BearingFactors,
    leg_factor,
    motion_factor,
    start_prior,
    vector_factor,
    velocity_prior,
    weak_height_prior,
    weak_landmark_prior,
)
from fgslam.factors.keys import height_key, landmark_key, pose_key, target_key, velocity_key

_INITIAL_TURNING_DEG = 30.0  # of the turning rate at the start, degrees/s
_INITIAL_SPEED = 0.5  # deviation of the speed at the start, around 0, legs/s
TARGET = -1


class Sight(NamedTuple):
    """A bearing or an elevation of a landmark, and its deviation; radians."""

    view: int
    row: int
    measured: float
    sigma: float


class Pair(NamedTuple):
    """Elevations (2,) of a landmark from start and target, and their deviations (2,); radians.

    ``first``: (5,) target and landmark where the deviations are brought together.
    """

    row: int
    measured: FloatArray
    sigmas: FloatArray
    first: FloatArray


class Beginning(NamedTuple):
    """Start and target.

    First guess (3,) of the target, the initialisation's vector, and its covariance (2, 2) as the
    graph takes it.
    """

    target: FloatArray
    vector: TwoViewVector
    covariance: FloatArray


@dataclass
class NewPart:
    """What one image adds: its state, how it came there, and what it sees.

    Attributes:
        image: its number; 0 for start and target together.
        pose, velocity: (3,) first guesses.
        times: of the image before and of this one, seconds.
        beginning: with the start alone.
        points, heights: first guess and deviation of the weak prior, of landmarks that enter.
        bearings, elevations, pairs: what is measured.
    """

    image: int
    pose: FloatArray
    velocity: FloatArray
    times: tuple[float, float]
    beginning: Beginning | None = None
    points: dict[int, tuple[FloatArray, float]] = field(default_factory=dict)
    heights: dict[int, tuple[float, float]] = field(default_factory=dict)
    bearings: list[Sight] = field(default_factory=list)
    elevations: list[Sight] = field(default_factory=list)
    pairs: list[Pair] = field(default_factory=list)


def motion_densities(motion: GraphMotionSettings) -> FloatArray:
    """(3,) of the accelerations' noise: forward, left, turning."""
    return np.array([motion.forward, motion.sideways, np.deg2rad(motion.turning_deg)]) ** 2


def first_speeds(motion: GraphMotionSettings) -> FloatArray:
    """(3,) deviations of the velocity at the start."""
    turning = float(np.deg2rad(_INITIAL_TURNING_DEG))
    return np.array([_INITIAL_SPEED, motion.sideways, turning])


class GtsamParts:
    """Makes GTSAM's factors and values of parts."""

    def __init__(self, robust: BearingFactors, motion: GraphMotionSettings) -> None:
        self._robust, self._motion = robust, motion

    def of(self, new: NewPart) -> tuple[Any, Any, set[int]]:
        """Factors, first guesses, and keys of what the image touches."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose, velocity = pose_key(new.image), velocity_key(new.image)
        values.insert(pose, gtsam.Pose2(*new.pose))
        values.insert(velocity, new.velocity)
        if new.beginning is not None:
            self._begin(graph, values, new.beginning)
        else:
            earlier = (pose_key(new.image - 1), velocity_key(new.image - 1), new.times[0])
            now = (pose, velocity, new.times[1])
            graph.add(motion_factor(earlier, now, motion_densities(self._motion)))
        for row, (point, spread) in new.points.items():
            values.insert(landmark_key(row), point)
            graph.add(weak_landmark_prior(landmark_key(row), point, spread))
        for row, (height, spread) in new.heights.items():
            values.insert(height_key(row), height)
            graph.add(weak_height_prior(height_key(row), height, spread))
        return graph, values, self._see(graph, new) | {pose, velocity}

    def _begin(self, graph: Any, values: Any, beginning: Beginning) -> None:
        target, vector, covariance = beginning
        values.insert(target_key(), gtsam.Pose2(*target))
        graph.add(start_prior(pose_key(0)))
        graph.add(velocity_prior(velocity_key(0), np.zeros(3), first_speeds(self._motion)))
        graph.add(leg_factor(pose_key(0), target_key()))
        graph.add(vector_factor(target_key(), vector.direction, vector.rotation, covariance))

    def _see(self, graph: Any, new: NewPart) -> set[int]:
        """All that is measured; keys of the landmarks and heights in it."""
        robust, keys = self._robust, set[int]()
        for sight in new.bearings:
            landmark = landmark_key(sight.row)
            graph.add(robust.bearing(_view(sight), landmark, sight.measured, sight.sigma))
            keys.add(landmark)
        for sight in new.elevations:
            landmark, height = landmark_key(sight.row), height_key(sight.row)
            at = (_view(sight), landmark, height)
            graph.add(robust.elevation(*at, sight.measured, sight.sigma))
            keys |= {landmark, height}
        for pair in new.pairs:
            graph.add(robust.elevation_pair(target_key(), landmark_key(pair.row), *pair[1:]))
        return keys


def _view(sight: Sight) -> int:
    return target_key() if sight.view == TARGET else pose_key(sight.view)
