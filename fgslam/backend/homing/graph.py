"""Homing as one bearing-only factor graph, solved with every image."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from fgslam.backend.homing.graph_problem import HomingProblem, Motion
from fgslam.backend.homing.graph_solvers import make_solver
from fgslam.backend.homing.inputs import TrackedFeatures
from fgslam.backend.homing.settings import HomingGraphSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.homing import HomingEstimate, HomingStart, TrackedBearings


class HomingGraph:
    """Estimator of kind ``homing_graph``.

    On :class:`fgslam.backend.homing.protocol.HomingEstimator`. Lost features simply get no more
    factors; what they taught stays.
    """

    kind: ClassVar[str] = "homing_graph"

    def __init__(self, start: HomingStart, settings: HomingGraphSettings) -> None:
        """Solves start and target alone.

        Raises:
            EstimatorError: they cannot be solved.
        """
        self._features = TrackedFeatures(start)
        self._problem = HomingProblem(start, settings)
        self._solver = make_solver(settings)
        self._image = 0
        self._covariance: FloatArray | None = None
        self._solver.add(self._problem.first(), start.time)

    def update(self, tracked: TrackedBearings) -> None:
        """Takes in one image; see the protocol."""
        before = self._motion()
        _, taken = self._features.take(tracked)
        points = self._solver.points(self._entered())
        new = self._problem.image(tracked, taken, before, points)
        self._covariance = None
        self._image += 1
        self._solver.add(new, tracked.time)
        collapsed = self._problem.collapsed(self._solver.points(self._entered()))
        if collapsed:
            self._solver.move(collapsed, tracked.time)

    def estimate(self, landmarks: bool = True) -> HomingEstimate:
        """The present state; see the protocol."""
        ids, rows = self._alive()
        covariance = self._joint(rows if landmarks else [])
        return HomingEstimate(
            time=self._features.time,
            robot=self._solver.pose(self._image),
            target=self._solver.target(),
            covariance=covariance[:6, :6],
            ids=ids,
            landmarks=self._solver.points(rows),
            landmark_covariances=_blocks(covariance[6:, 6:], len(ids)),
        )

    def _alive(self) -> tuple[Any, list[int]]:
        """Identities of landmarks that are tracked still, and their variables' numbers."""
        ids = self._features.alive
        ids = ids[np.isin(ids, self._problem.entered)]
        return ids, self._problem.variables(ids).tolist()

    def _entered(self) -> list[int]:
        numbers: list[int] = self._problem.variables(self._problem.entered).tolist()
        return numbers

    def _joint(self, rows: list[int]) -> FloatArray:
        """Covariance of robot, target and landmarks."""
        size = 6 + 2 * len(rows)
        if self._covariance is None or len(self._covariance) < size:
            self._covariance = self._solver.covariance(rows)
        return self._covariance[:size, :size]

    def _motion(self) -> Motion:
        pose, velocity = self._solver.pose(self._image), self._solver.velocity(self._image)
        return Motion(self._image, self._features.time, pose, velocity, self._variances)

    def _variances(self) -> FloatArray:
        """Of the robot's (x, y, psi) at the last image that the solver knows."""
        return np.asarray(np.diagonal(self._joint([]))[:3])


def _blocks(covariance: FloatArray, count: int) -> FloatArray:
    """(count, 2, 2) diagonal blocks; NaN where there is no covariance."""
    if len(covariance) < 2 * count:
        return np.full((count, 2, 2), np.nan)
    every = np.arange(count)
    return np.asarray(covariance.reshape(count, 2, count, 2)[every, :, every, :])
