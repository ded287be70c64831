"""Batch smoothing: all poses and landmarks at once, the reference of every comparison."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import gtsam
import numpy as np

from fgslam.backend.filters.loop_correction import Constraint
from fgslam.backend.settings import BatchSettings, KernelSettings
from fgslam.backend.smoothers.graph_builder import NewFactors
from fgslam.backend.smoothers.loop_closing import solved
from fgslam.backend.smoothers.refinement import (
    WholeGraphSolver,
    graduated,
    trimmed,
    with_kernel,
)
from fgslam.backend.smoothers.smoother import GraphProblem, MapSmoother
from fgslam.backend.smoothers.solver import (
    ClosedLoop,
    Drive,
    Smoothed,
    allowed_parts,
)
from fgslam.core.estimates import LandmarkMap, Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import reorthonormalise
from fgslam.core.sensors import Sensor
from fgslam.factors.graphs import pose_key, poses_of_frame, solver_parameters

_MAX_ITERATIONS = 100  # a bound, for graphs that do not settle
_RELATIVE_TOLERANCE = 1e-9  # of the cost; the estimate then moves by less than a micrometre


def batch_smoother(
    sensor: Sensor, settings: BatchSettings, floor: Floor, prior: Prediction
) -> MapSmoother:
    """Estimator of kind ``batch``, at the prior pose with an empty map."""
    if settings.method == "gnc":
        # GNC is its own kernel; the graph's factors must be plain.
        settings = dataclasses.replace(settings, kernel=KernelSettings("none"))
    problem = GraphProblem.of(sensor, settings, floor, prior)
    return MapSmoother(problem, BatchSolver(problem, settings))


class BatchSolver(WholeGraphSolver):
    """Solves the whole graph by Levenberg-Marquardt or graduated non-convexity, when asked to."""

    kind: ClassVar[str] = "batch"

    def __init__(self, problem: GraphProblem, settings: BatchSettings) -> None:
        """Nothing to solve yet."""
        super().__init__(problem.builder, problem.floor)
        self._settings = settings

    def add(self, new: NewFactors, landmarks: LandmarkMap, timestamp: float) -> None:
        """Takes in a frame's initial values; the builder keeps its factors."""
        self._values.insert(new.values)
        self._answer = None

    def solve_if_due(self, frame: int, closes_loop: bool) -> Smoothed | None:
        """The minimum after every `solve_every` frames."""
        every = self._settings.solve_every
        if not every or (frame + 1) % every:
            return None
        answer = self.solution()
        self._values.update(self._refined().values)
        return Smoothed(self._values, Prediction(answer.poses[-1], answer.pose_covariances[-1]))

    def close(self, loop: Constraint, drive: Drive, what: str) -> ClosedLoop | None:
        """Tracks on from the solution; where nothing moves, the next one takes the loop in."""
        found = self._accepted(
            loop, drive, what, self._factors, lambda graph: solved(graph, self._values)
        )
        if found is None:
            return None
        if found.values is None:
            return ClosedLoop()
        self._values = found.values
        last = self._builder.frames[-1]
        here = reorthonormalise(poses_of_frame(self._values, last))
        marginals = gtsam.Marginals(self._factors(), self._values)
        covariance = np.asarray(marginals.marginalCovariance(pose_key(last)))
        return self._after_loop(allowed_parts(self._floor, here[None], covariance[None])[0])

    def _factors(self) -> Any:
        """The graph as it is solved when a loop is judged."""
        graph = self._builder.kept_factors()
        return with_kernel(graph) if self._settings.method == "gnc" else graph

    def _minimise(self, graph: Any, values: Any) -> tuple[Any, Any]:
        """Values at the minimum, and the factors that count there."""
        params = solver_parameters(_MAX_ITERATIONS, _RELATIVE_TOLERANCE)
        if self._settings.method == "gnc":
            return graduated(graph, values, params, self._settings.noise_factor)
        if self._settings.trim:
            return trimmed(graph, values, params, self._settings.noise_factor)
        return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize(), graph
