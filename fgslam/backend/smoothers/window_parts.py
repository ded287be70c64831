"""What a window of poses and landmarks is made of, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from fgslam.backend.smoothers.dense_cholesky import UndeterminedError
from fgslam.backend.smoothers.landmark_elimination import Eliminated
from fgslam.core.arrays import FloatArray, IntArray, Rows
from fgslam.factors.graphs import landmark_key
from fgslam.factors.landmark import LinearRows


@dataclass(frozen=True, slots=True, eq=False)
class Observed(Rows):
    """Observations of the window (k, ...): frame, landmark variable, numbers and whitening."""

    frame: IntArray
    variable: IntArray
    measurement: FloatArray
    root: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks(Rows):
    """Landmarks of the window (m, ...): variables ascending, places, what was known beforehand.

    That is a mean and its information (3, 3), zero where nothing was known.
    """

    variables: IntArray
    points: FloatArray
    mean: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """Observations (k,) as they are linearised now: rows of their poses and landmarks, and theirs.

    Residuals are those of the estimate, weights (in the rows) those of where it is linearised.
    """

    pose: IntArray
    point: IntArray
    rows: LinearRows


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """The window's normal equations at its solution, and what their rows are."""

    eliminated: Eliminated
    frames: list[int]
    variables: IntArray

    def rows(self, variables: list[int]) -> IntArray:
        """Rows of landmark variables."""
        return np.searchsorted(self.variables, variables).astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """How a place that has left a window is off: by a motion in the axes of the first pose.

    Attributes:
        follows: another place by which it is known; None: the first pose.
        gain: (6, 6) by how much it is off where the other is, in the same axes.
        information: (6, 6) inverse covariance of the rest.
    """

    follows: int | None
    gain: FloatArray
    information: FloatArray


class LandmarkUndeterminedError(UndeterminedError):
    """``variable`` is not determined by its observations."""

    def __init__(self, variable: int, message: str) -> None:
        """The landmark's variable, and why."""
        super().__init__(variable, message)
        self.variable = variable


@dataclass(frozen=True, slots=True, eq=False)
class WindowValues:
    """What is asked of GTSAM's values between two frames, by key: poses (4, 4) and points (3,)."""

    poses: dict[int, FloatArray]
    points: dict[int, FloatArray]

    def exists(self, key: int) -> bool:
        """Whether the window holds a variable."""
        return key in self.points or key in self.poses

    def landmarks(self) -> tuple[IntArray, FloatArray]:
        """As :func:`fgslam.factors.graphs.landmarks_in`."""
        keys = np.fromiter(self.points, np.int64, len(self.points))
        places = np.array(list(self.points.values())).reshape(-1, 3)
        order = np.argsort(keys)
        return keys[order] - landmark_key(0), places[order]

    def atPose3(self, key: int) -> Any:
        """A pose."""
        return gtsam.Pose3(self.poses[key])
