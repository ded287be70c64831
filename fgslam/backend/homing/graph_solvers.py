"""Solvers of the homing graph: incremental, over a fixed lag, and batch.

All keep the values of every variable that they still have, and answer joint covariances.
"""

from __future__ import annotations

from typing import Any, Protocol

import gtsam
import numpy as np

from fgslam.backend.homing.graph_problem import NewPart
from fgslam.errors import EstimatorError
from fgslam.factors.keys import is_pose
from fgslam.settings.homing_estimators import HomingGraphSettings
from fgslam.types import FloatArray

_RELATIVE_TOLERANCE = 1e-5  # of the cost: the estimate then moves by far less than its deviation


class Solver(Protocol):
    """Takes the graph in, part by part."""

    values: Any

    def add(self, new: NewPart, time: float) -> None:
        """Brings an image in. Raises EstimatorError where the graph cannot be solved."""
        ...

    def joint_covariance(self, keys: list[int]) -> FloatArray:
        """Joint covariance of variables in the order given, in GTSAM's tangent spaces."""
        ...


class Isam2Solver:
    """iSAM2 with Powell's dog leg over the whole homing.

    After an exception an ISAM2 object is corrupt: it is built anew from the solver's own graph,
    at the solution of a batch solver.
    """

    def __init__(self, settings: HomingGraphSettings) -> None:
        """Empty."""
        self._settings = settings
        self._graph = gtsam.NonlinearFactorGraph()
        self._isam = gtsam.ISAM2(isam2_parameters(settings))
        self.values = gtsam.Values()

    def add(self, new: NewPart, time: float) -> None:
        """See :class:`Solver`."""
        self._graph.push_back(new.graph)
        try:
            self._isam.update(new.graph, new.values)
            self.values = self._isam.calculateEstimate()
        except RuntimeError:
            self.values.insert(new.values)
            self._rebuild()

    def _rebuild(self) -> None:
        self.values = minimised(self._graph, self.values, self._settings.max_iterations)
        self._isam = gtsam.ISAM2(isam2_parameters(self._settings))
        try:
            self._isam.update(self._graph, self.values)
            self.values = self._isam.calculateEstimate()
        except RuntimeError as error:
            raise _failed(error) from None

    def joint_covariance(self, keys: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        return _checked(self._isam.jointMarginalCovariance(keys).fullMatrix())


class FixedLagSolver:
    """iSAM2 over the last seconds: older poses are marginalised, start, target and map stay."""

    def __init__(self, settings: HomingGraphSettings) -> None:
        """Empty."""
        self._settings = settings
        self._lasting: set[int] = set()
        self._smoother = self._new()
        self.values = gtsam.Values()

    def _new(self) -> Any:
        params = isam2_parameters(self._settings)
        params.findUnusedFactorSlots = True  # without it the smoother grows
        return gtsam.IncrementalFixedLagSmoother(self._settings.lag_s, params)

    def add(self, new: NewPart, time: float) -> None:
        """See :class:`Solver`."""
        stamps = dict.fromkeys(list(new.values.keys()), time)
        self._lasting |= {key for key in stamps if not is_passing(key)}
        stamps |= dict.fromkeys(self._lasting, time)
        before = self._smoother.getFactors()
        try:
            self._smoother.update(new.graph, new.values, stamps)
            self.values = self._smoother.calculateEstimate()
        except RuntimeError:
            self._rebuild(before, new, time)

    def _rebuild(self, before: Any, new: NewPart, time: float) -> None:
        graph = gtsam.NonlinearFactorGraph()
        for source in (before, new.graph):
            for row in range(source.size()):
                if source.at(row) is not None:
                    graph.add(source.at(row))
        self.values.insert(new.values)
        self.values = minimised(graph, self.values, self._settings.max_iterations)
        self._smoother = self._new()
        try:
            self._smoother.update(graph, self.values, dict.fromkeys(list(self.values.keys()), time))
            self.values = self._smoother.calculateEstimate()
        except RuntimeError as error:
            raise _failed(error) from None

    def joint_covariance(self, keys: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        return _checked(self._smoother.getISAM2().jointMarginalCovariance(keys).fullMatrix())


class BatchSolver:
    """Levenberg-Marquardt over the whole graph with every image, from the last solution."""

    def __init__(self, settings: HomingGraphSettings) -> None:
        """Empty."""
        self._settings = settings
        self._graph = gtsam.NonlinearFactorGraph()
        self.values = gtsam.Values()

    def add(self, new: NewPart, time: float) -> None:
        """See :class:`Solver`."""
        self._graph.push_back(new.graph)
        self.values.insert(new.values)
        self.values = minimised(self._graph, self.values, self._settings.max_iterations)

    def joint_covariance(self, keys: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        marginals = gtsam.Marginals(self._graph, self.values)
        return _checked(marginals.jointMarginalCovariance(keys).fullMatrix())


def make_solver(settings: HomingGraphSettings) -> Solver:
    """The one of the settings."""
    match settings.solver:
        case "isam2":
            return Isam2Solver(settings)
        case "fixed_lag":
            return FixedLagSolver(settings)
        case "batch":
            return BatchSolver(settings)


def isam2_parameters(settings: HomingGraphSettings) -> Any:
    """Dog leg, because an undamped step may carry a landmark across a camera's centre."""
    dog_leg = gtsam.ISAM2DoglegParams()
    dog_leg.setInitialDelta(settings.trust_radius)
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(dog_leg)
    params.setFactorization("CHOLESKY")
    params.setRelinearizeThreshold(settings.relinearize_threshold)
    params.relinearizeSkip = 1
    return params


def minimised(graph: Any, values: Any, iterations: int) -> Any:
    """Values at the minimum, by Levenberg-Marquardt."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setRelativeErrorTol(_RELATIVE_TOLERANCE)
    try:
        return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    except RuntimeError as error:
        raise _failed(error) from None


def is_passing(key: int) -> bool:
    """Whether a variable belongs to an image on the way, a pose or a velocity."""
    symbol = gtsam.Symbol(key)
    return symbol.index() > 0 and (is_pose(key) or symbol.chr() == ord("v"))


def _checked(covariance: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (covariance + covariance.T))


def _failed(error: Exception) -> EstimatorError:
    cause = " ".join(str(error).split())[:200]
    return EstimatorError(f"the homing graph cannot be solved ({cause}); start the homing anew")
