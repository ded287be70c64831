"""Batch smoothing: all poses and landmarks at once, the reference of every comparison."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import gtsam

from fgslam.backend.graph_solution import (
    Solution,
    joint_of,
    points_of,
    poses_of,
    solution,
)
from fgslam.backend.outliers import graduated, observed_variables, solver_parameters, trimmed
from fgslam.backend.segments import TrackedFrame
from fgslam.backend.smoother import Smoother
from fgslam.errors import EstimatorError
from fgslam.factors.keys import landmark_key
from fgslam.floor import Floor
from fgslam.settings.backend import BatchSettings, KernelSettings
from fgslam.types import FloatArray, Prediction, Sensor

_RELATIVE_TOLERANCE = 1e-9  # of the cost; the estimate then moves by less than a micrometre
_ROUNDS = 5  # solutions until no landmark lies behind a camera any more
_BEHIND = "came out behind a camera"
_UNSEEN = "has no observation that fits the others"


class BatchSmoother(Smoother):
    """Estimator of kind ``batch``, on :class:`fgslam.backend.protocol.Estimator`."""

    kind: ClassVar[str] = "batch"

    def __init__(
        self, sensor: Sensor, settings: BatchSettings, floor: Floor, prior: Prediction
    ) -> None:
        """Starts at the prior pose with an empty map."""
        if settings.method == "gnc":
            # GNC is its own kernel; the graph's factors must be plain.
            settings = dataclasses.replace(settings, kernel=KernelSettings("none"))
        super().__init__(sensor, settings, floor, prior)
        self._settings = settings
        self._values = gtsam.Values()
        self._optimised: Any = None

    def _absorb(self, tracked: TrackedFrame) -> None:
        new = self._enter(tracked)
        self._values.insert(new.values)
        self._optimised = None
        every = self._settings.solve_every
        if every and (new.frame + 1) % every == 0:
            answer = self._solve()
            last = Prediction(answer.poses[-1], answer.pose_covariances[-1])
            self._take_over(self._values, last)

    def _solve(self) -> Solution:
        graph = self._optimise()
        return solution(graph, self._values, self._builder.frames, self._variables(), self._floor)

    def _joint(self, variables: list[int]) -> FloatArray:
        graph = self._optimise()
        return joint_of(graph, self._values, self._floor, self._builder.frames[-1], variables)

    def _variables(self) -> list[int]:
        return [v for v in range(self._builder.variables) if self._builder.in_graph(v)]

    def _optimise(self) -> Any:
        """Solves; returns the graph as solved, without what turned out to be wrong."""
        if self._optimised is not None:
            return self._optimised
        for _ in range(_ROUNDS):
            self._values, graph = self._minimise(self._builder.kept_factors())
            lost = dict.fromkeys(self._behind(), _BEHIND) | dict.fromkeys(
                self._unseen(graph), _UNSEEN
            )
            if not lost:
                break
            for variable, why in lost.items():
                self._remarks.append(f"{self._builder.take_out(variable)} {why}: taken out")
                self._values.erase(landmark_key(variable))
        else:
            self._values, graph = self._minimise(self._builder.kept_factors())
        self._optimised = graph
        return graph

    def _behind(self) -> list[int]:
        poses = poses_of(self._values, self._builder.frames)
        return self._builder.behind(poses, points_of(self._values, self._variables()))

    def _unseen(self, graph: Any) -> list[int]:
        """Variables of which no observation fits the others."""
        return sorted(set(self._variables()) - observed_variables(graph))

    def _minimise(self, graph: Any) -> tuple[Any, Any]:
        """Values at the minimum, and the factors that have a say in it."""
        params = solver_parameters(self._settings.max_iterations, _RELATIVE_TOLERANCE)
        try:
            if self._settings.method == "gnc":
                return graduated(graph, self._values, params)
            if self._settings.trim:
                return trimmed(graph, self._values, params)
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, self._values, params)
            return optimizer.optimize(), graph
        except RuntimeError as error:
            raise EstimatorError(
                f"batch: the solver failed after frame {self._builder.frames[-1]} "
                f"({' '.join(str(error).split())}); look at that frame with fgslam inspect"
            ) from None
