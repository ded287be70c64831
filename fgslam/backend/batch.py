"""Batch smoothing: all poses and landmarks at once, the reference of every comparison."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import gtsam

from fgslam.backend.graph_solution import Solution, solution
from fgslam.backend.outliers import graduated, solver_parameters, trimmed
from fgslam.backend.refinement import Refined, refine
from fgslam.backend.segments import TrackedFrame
from fgslam.backend.smoother import Smoother
from fgslam.floor import Floor
from fgslam.settings.backend import BatchSettings, KernelSettings
from fgslam.types import Prediction, Sensor

_RELATIVE_TOLERANCE = 1e-9  # of the cost; the estimate then moves by less than a micrometre


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

    def _absorb(self, tracked: TrackedFrame) -> None:
        new = self._enter(tracked)
        self._values.insert(new.values)
        every = self._settings.solve_every
        if every and (new.frame + 1) % every == 0:
            answer = self._solve()
            self._values.update(self._refined_graph().values)
            last = Prediction(answer.poses[-1], answer.pose_covariances[-1])
            self._take_over(self._values, last)

    def _solve(self) -> Solution:
        return solution(self._refined_graph(), self._builder.frames, self._floor)

    def _refine(self) -> Refined:
        try:
            return refine(self._builder, self._values, self._minimise)
        except RuntimeError as error:
            raise self._failed(error, "after") from None

    def _minimise(self, graph: Any, values: Any) -> tuple[Any, Any]:
        """Values at the minimum, and the factors that have a say in it."""
        params = solver_parameters(self._settings.max_iterations, _RELATIVE_TOLERANCE)
        if self._settings.method == "gnc":
            return graduated(graph, values, params, self._settings.noise_factor)
        if self._settings.trim:
            return trimmed(graph, values, params, self._settings.noise_factor)
        return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize(), graph
