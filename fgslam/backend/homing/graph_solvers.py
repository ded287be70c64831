"""Solvers of the homing graph: incremental, over a fixed lag, and batch.

All keep the values of every variable that they still have, and answer joint covariances.
"""

from __future__ import annotations

from typing import Any, Protocol

import gtsam
import numpy as np

from fgslam.backend.graph_builder import without_gaps
from fgslam.backend.homing.graph_problem import NewPart
from fgslam.errors import EstimatorError
from fgslam.factors.keys import is_pose, target_key
from fgslam.settings.homing_estimators import HomingGraphSettings
from fgslam.types import FloatArray

_RELATIVE_TOLERANCE = 1e-5  # of the cost: the estimate then moves by far less than its deviation


class Solver(Protocol):
    """Takes the graph in, part by part."""

    values: Any

    def add(self, new: NewPart, time: float) -> None:
        """Brings an image in. Raises EstimatorError where the graph cannot be solved."""
        ...

    def move(self, points: dict[int, FloatArray], time: float) -> None:
        """Puts landmarks, by key, back to places (2,) and goes on from there."""
        ...

    def joint_covariance(self, keys: list[int]) -> FloatArray:
        """Joint covariance of variables in the order given, in GTSAM's tangent spaces.

        NaN where the linearised graph does not determine them.
        """
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
            self._isam.update(new.graph, new.values, [], _last(new))
            self.values = self._isam.calculateEstimate()
        except RuntimeError:
            self.values.insert(new.values)
            self._rebuild()

    def move(self, points: dict[int, FloatArray], time: float) -> None:
        """See :class:`Solver`."""
        put_back(self.values, points)
        self._restart()

    def _rebuild(self) -> None:
        self.values = minimised(self._graph, self.values, self._settings.max_iterations)
        self._restart()

    def _restart(self) -> None:
        self._isam = gtsam.ISAM2(isam2_parameters(self._settings))
        try:
            self._isam.update(self._graph, self.values)
            self.values = self._isam.calculateEstimate()
        except RuntimeError as error:
            raise _failed(error) from None

    def joint_covariance(self, keys: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        return joint_of(self._isam, keys)


class FixedLagSolver:
    """iSAM2 over the last seconds: older poses are marginalised, start, target and map stay."""

    def __init__(self, settings: HomingGraphSettings) -> None:
        """Empty."""
        self._settings = settings
        self._stamps: dict[int, float] = {}
        self._smoother = self._new()
        self.values = gtsam.Values()

    def _new(self) -> Any:
        params = isam2_parameters(self._settings)
        params.findUnusedFactorSlots = True  # without it the smoother grows
        return gtsam.IncrementalFixedLagSmoother(self._settings.lag_s, params)

    def add(self, new: NewPart, time: float) -> None:
        """See :class:`Solver`."""
        self._stamps |= dict.fromkeys(list(new.values.keys()), time)
        self._stamps |= {key: time for key in self._stamps if not is_passing(key)}
        before = self._smoother.getFactors()
        try:
            self._smoother.update(new.graph, new.values, self._recent(time))
            self.values = self._smoother.calculateEstimate()
        except RuntimeError:
            self._rebuild(before, new, time)

    def move(self, points: dict[int, FloatArray], time: float) -> None:
        """See :class:`Solver`."""
        put_back(self.values, points)
        self._restart(without_gaps(self._smoother.getFactors()), time)

    def _recent(self, time: float) -> dict[int, float]:
        """Times of variables, those forgotten that leave with this update."""
        stamps = self._stamps
        self._stamps = {k: t for k, t in stamps.items() if t >= time - self._settings.lag_s}
        return stamps

    def _rebuild(self, before: Any, new: NewPart, time: float) -> None:
        graph = without_gaps(before)
        graph.push_back(new.graph)
        self.values.insert(new.values)
        self.values = minimised(graph, self.values, self._settings.max_iterations)
        self._restart(graph, time)

    def _restart(self, graph: Any, time: float) -> None:
        self._smoother = self._new()
        try:
            stamps = {key: self._stamps.get(key, time) for key in list(self.values.keys())}
            self._smoother.update(graph, self.values, stamps)
            self.values = self._smoother.calculateEstimate()
        except RuntimeError as error:
            raise _failed(error) from None

    def joint_covariance(self, keys: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        return joint_of(self._smoother.getISAM2(), keys)


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

    def move(self, points: dict[int, FloatArray], time: float) -> None:
        """See :class:`Solver`."""
        put_back(self.values, points)

    def joint_covariance(self, keys: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        try:
            marginals = gtsam.Marginals(self._graph, self.values)
        except RuntimeError:
            return undetermined(keys)
        return joint_of(marginals, keys)


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


def _last(new: NewPart) -> Any:
    """Elimination order: what the image sees and the target go last, to the root of the tree.

    There their joint covariance is had at once; from elsewhere it costs more than the update.
    """
    groups = gtsam.KeyGroupMap()
    for key in new.keys | {target_key()}:
        groups.insert2(key, 1)
    return groups


def is_passing(key: int) -> bool:
    """Whether a variable belongs to an image on the way, a pose or a velocity."""
    symbol = gtsam.Symbol(key)
    return symbol.index() > 0 and (is_pose(key) or symbol.chr() == ord("v"))


def put_back(values: Any, points: dict[int, FloatArray]) -> None:
    """Gives landmarks, by key, other values (2,)."""
    for key, point in points.items():
        values.update(key, point)


def joint_of(source: Any, keys: list[int]) -> FloatArray:
    """Joint covariance of keys from whatever has marginals; NaN where it fails."""
    try:
        covariance = source.jointMarginalCovariance(keys).fullMatrix()
    except RuntimeError:
        return undetermined(keys)
    return np.asarray(0.5 * (covariance + covariance.T))


def undetermined(keys: list[int]) -> FloatArray:
    """A covariance of NaN: three numbers a pose, two a landmark."""
    poses = sum(is_pose(key) or key == target_key() for key in keys)
    size = 2 * len(keys) + poses
    return np.full((size, size), np.nan)


def _failed(error: Exception) -> EstimatorError:
    cause = " ".join(str(error).split())[:200]
    return EstimatorError(f"the homing graph cannot be solved ({cause}); start the homing anew")
