"""What every homing estimator offers and checks, and the parts of the homing graph.

An estimator is made from one start, updated with each image, and asked at any time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.bearings import HomingEstimate, HomingStart, TrackedBearings, TwoViewVector, among
from fgslam.core.checks import later_time
from fgslam.core.errors import EstimatorError
from fgslam.factors.noise import KernelName


class HomingEstimator(Protocol):
    """Estimates robot, target and local map from bearings alone; made from one HomingStart.

    A time that does not increase, or an identity that the map never had, raises EstimatorError
    and leaves the state as it was. Arguments are never mutated.
    """

    kind: ClassVar[str]

    def update(self, tracked: TrackedBearings) -> None:
        """Takes in one image; features that are absent are deleted from the map."""
        ...

    def estimate(self, landmarks: bool = True) -> HomingEstimate:
        """The present state; changes nothing.

        Args:
            landmarks: whether their covariances are wanted, too; they may be NaN where not. For a
                graph they cost more than all the rest of an image.
        """
        ...


class TrackedFeatures:
    """Time and identities of a homing: which features were known, which are lost."""

    def __init__(self, start: HomingStart) -> None:
        """All features of the start's local map are alive.

        Raises:
            EstimatorError: the start's parts do not belong together.
        """
        ids = start.local_map.ids
        if len(start.matches) != len(ids) or not _ascend(ids):
            raise EstimatorError(
                f"homing start: {len(start.matches)} matches for {len(ids)} features of the local "
                "map; give one match a feature, identities ascending"
            )
        self._known = ids
        self.alive = ids
        self.time = start.time

    def take(self, tracked: TrackedBearings) -> tuple[float, BoolArray]:
        """Notes one image: seconds since the last, and which of its rows are features alive.

        Features absent from it are lost from now on; one that comes back later is not taken up.

        Raises:
            EstimatorError: time does not increase, an identity the map never had, or a value
                that is no number. Nothing is noted then.
        """
        step = later_time(tracked.time, self.time, "homing", EstimatorError) - self.time
        self._require_sound(tracked)
        self.time = tracked.time
        self.alive = self.alive[among(self.alive, tracked.ids)]
        return float(step), among(tracked.ids, self.alive)

    def _require_sound(self, tracked: TrackedBearings) -> None:
        unknown = tracked.ids[~among(tracked.ids, self._known)]
        if len(unknown):
            raise EstimatorError(
                f"image at {tracked.time:.3f} s: feature {unknown.min()} is not in the local map; "
                "track the map's features only"
            )
        if not _ascend(tracked.ids):
            raise EstimatorError(
                f"image at {tracked.time:.3f} s: identities do not ascend; sort them, each once"
            )
        sound = np.isfinite(tracked.bearing) & (tracked.sigma_bearing > 0.0)
        if not sound.all():
            raise EstimatorError(
                f"image at {tracked.time:.3f} s: feature {tracked.ids[~sound][0]} has no finite "
                "bearing with a positive deviation; leave it out"
            )


def _ascend(ids: IntArray) -> bool:
    return bool((np.diff(ids) > 0).all())


# --------------------------------------------------------------------------------------------
# What one image adds to the homing graph, as plain numbers, and what solvers of the graph offer
#
# Views are numbered: the start is 0, images count from 1, :data:`TARGET` is the target. Landmarks
# are rows of the homing's matches.


# Lengths are in legs, the distance from start to target, so that speeds are in legs a second: a
# wheelchair at 0.4 m/s on a leg of 2 m drives 0.2 legs a second.
_INITIAL_TURNING_DEG = 30.0  # of the turning rate at the start, degrees/s
_INITIAL_SPEED = 0.5  # deviation of the speed at the start, around 0, legs/s
# Deviations after a second, by white noise on the acceleration: of the speed forward and sideways
# (slip), legs/s, and of the turning rate, radians/s.
FORWARD, SIDEWAYS, TURNING = 0.1, 0.03, float(np.deg2rad(60.0))
MOTION_DENSITIES = np.array([FORWARD, SIDEWAYS, TURNING]) ** 2
"""(3,) of the accelerations' noise: forward, left, turning."""
FIRST_SPEEDS = np.array([_INITIAL_SPEED, SIDEWAYS, float(np.deg2rad(_INITIAL_TURNING_DEG))])
"""(3,) deviations of the velocity at the start."""
KERNEL: KernelName = "cauchy"
KERNEL_WIDTH = 2.0  # in deviations
TARGET = -1


class BearingSeen(NamedTuple):
    """A bearing of a landmark, and its deviation; radians."""

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


@dataclass
class NewPart:
    """What one image adds: its state, how it came there, and what it sees.

    Attributes:
        image: its number; 0 for start and target together.
        pose, velocity: (3,) first guesses.
        times: of the image before and of this one, seconds.
        beginning: with the start alone: first guess (3,) of the target, the initialisation's
            vector, and its covariance (2, 2) as the graph takes it.
        points: first guess and deviation of the weak prior, of landmarks that enter.
        bearings, pairs: what is measured.
    """

    image: int
    pose: FloatArray
    velocity: FloatArray
    times: tuple[float, float]
    beginning: tuple[FloatArray, TwoViewVector, FloatArray] | None = None
    points: dict[int, tuple[FloatArray, float]] = field(default_factory=dict)
    bearings: list[BearingSeen] = field(default_factory=list)
    pairs: list[Pair] = field(default_factory=list)


class Solver(Protocol):
    """Takes the graph in, part by part. Poses are (x, y, psi) in the start frame."""

    def add(self, new: NewPart) -> None:
        """Brings an image in. Raises EstimatorError where the graph cannot be solved."""
        ...

    def move(self, points: dict[int, FloatArray]) -> None:
        """Puts landmarks, by row, back to places (2,) and goes on from there."""
        ...

    def pose(self, image: int) -> FloatArray:
        """(3,) the robot at an image."""
        ...

    def velocity(self, image: int) -> FloatArray:
        """(3,) in the robot's axes: forward, left, turning."""
        ...

    def target(self) -> FloatArray:
        """(3,)."""
        ...

    def points(self, rows: list[int]) -> FloatArray:
        """(k, 2) landmarks of rows of the matches."""
        ...

    def covariance(self, rows: list[int]) -> FloatArray:
        """Joint covariance (6 + 2 k) of the robot at the last image, the target, and landmarks.

        NaN where the linearised graph does not determine them.
        """
        ...
