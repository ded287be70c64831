"""Batch smoothing: all poses and landmarks at once, the reference of every comparison."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from fgslam.backend.loops import Chain, Constraint
from fgslam.backend.settings import BatchSettings, KernelSettings
from fgslam.backend.smoothers.bundle import State, WholeGraph
from fgslam.backend.smoothers.elimination import reduced
from fgslam.backend.smoothers.final import (
    ITERATIONS,
    TOLERANCE,
    WholeGraphSolver,
    graduated,
    trimmed,
)
from fgslam.backend.smoothers.graph import (
    NewFactors,
    Smoothed,
    allowed_parts,
    solved,
)
from fgslam.backend.smoothers.smoother import GraphProblem, MapSmoother
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import reorthonormalise
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Floor, LandmarkMap, Prediction
from fgslam.frontend.settings import EgoMotionSettings


def batch_smoother(
    sensor: CameraRig,
    settings: BatchSettings,
    floor: Floor,
    prior: Prediction,
    ego_motion: EgoMotionSettings,
) -> MapSmoother:
    """Estimator of kind ``batch``, at the prior pose with an empty map.

    Poses on the way are the tracker's: their covariances are of its errors, by ``ego_motion``.
    """
    if settings.method == "gnc":
        # GNC is its own kernel; the graph's factors must be plain.
        settings = dataclasses.replace(settings, kernel=KernelSettings("none"))
    problem = GraphProblem.of(sensor, settings, floor, prior, ego_motion=ego_motion)
    return MapSmoother(problem, BatchSolver(problem, settings))


class BatchSolver(WholeGraphSolver):
    """Solves the whole graph by Levenberg-Marquardt or graduated non-convexity, when asked to."""

    kind: ClassVar[str] = "batch"

    def __init__(self, problem: GraphProblem, settings: BatchSettings) -> None:
        """Nothing to solve yet."""
        kernel = KernelSettings() if settings.method == "gnc" else None
        super().__init__(problem.builder, problem.floor, kernel)
        self._settings = settings

    def add(self, new: NewFactors, landmarks: LandmarkMap) -> None:
        """Takes in a frame's initial values; the builder keeps its factors."""
        self.values.insert(new.values)
        self._answer = None

    def solve_if_due(self, frame: int, closes_loop: bool) -> Smoothed | None:
        """Never: the minimum is found at loops, and for the answer."""
        return None

    def close(self, loop: Constraint, chain: Chain, wTc: FloatArray, what: str) -> Smoothed | bool:
        """Tracks on from the solution; where nothing moves, the next one takes the loop in."""
        accepted, values = self._judge(loop, chain, wTc, what, solved)
        if values is None:
            return accepted
        self.values = values
        graph, state = self.builder.whole_graph(self.values)
        covariance = reduced(graph.linear(state)).poses()[-1]
        here = reorthonormalise(state.poses[-1])
        return self._after_loop(allowed_parts(self._floor, here[None], covariance[None])[0])

    def _minimise(self, graph: WholeGraph, state: State) -> tuple[State, WholeGraph]:
        """Values at the minimum, and the factors that count there."""
        if self._settings.method == "gnc":
            return graduated(graph, state, self.builder.noise_factor)
        if self._settings.trim:
            return trimmed(graph, state, self.builder.noise_factor)
        return graph.minimum(state, ITERATIONS, TOLERANCE), graph
