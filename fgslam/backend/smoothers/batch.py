"""Batch smoothing: all poses and landmarks at once, the reference of every comparison."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import gtsam
import numpy as np

from fgslam.backend.common_settings import KernelSettings
from fgslam.backend.filters.submaps import Constraint
from fgslam.backend.smoothers.graph_solution import (
    Solution,
    allowed_parts,
    poses_of_frame,
    solution,
)
from fgslam.backend.smoothers.loop_closing import solved
from fgslam.backend.smoothers.outliers import graduated, solver_parameters, trimmed, with_kernel
from fgslam.backend.smoothers.refinement import Refined, refine
from fgslam.backend.smoothers.segments import TrackedFrame
from fgslam.backend.smoothers.settings import BatchSettings
from fgslam.backend.smoothers.whole_graph import WholeGraphSmoother
from fgslam.core.estimates import Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import reorthonormalise
from fgslam.core.sensors import Sensor
from fgslam.factors.keys import pose_key

_RELATIVE_TOLERANCE = 1e-9  # of the cost; the estimate then moves by less than a micrometre


class BatchSmoother(WholeGraphSmoother):
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

    def _loop_graph(self) -> Any:
        graph = super()._loop_graph()
        return with_kernel(graph) if self._settings.method == "gnc" else graph

    def _values_now(self) -> Any:
        return self._values

    def _solved_before(self, graph: Any) -> Any:
        return solved(graph, self._values)

    def _join(self, known: Constraint, found: Any | None) -> None:
        """Tracks on from the solution; where nothing moves, the next one takes the loop in."""
        if found is None:
            return
        self._values = found
        last, graph = self._builder.frames[-1], self._loop_graph()
        here = reorthonormalise(poses_of_frame(found, last))
        covariance = np.asarray(gtsam.Marginals(graph, found).marginalCovariance(pose_key(last)))
        covariance = allowed_parts(self._floor, here[None], covariance[None])[0]
        self._take_over(found, Prediction(here, covariance), whole=True)

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
