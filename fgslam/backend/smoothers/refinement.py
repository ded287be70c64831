"""The final solution of a graph: what does not fit is left out, the rest solved once more.

Wrong matches go by a kernel and then a trim, or by graduated non-convexity. Either way the last
solution is plain least squares over the observations that fit, so that its covariances mean what
they say. Neither the builder nor the solver that it starts from is changed, so that asking for an
estimate in the middle of a run leaves the run as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import gtsam
import numpy as np

from fgslam.backend.filters.loop_correction import Constraint
from fgslam.backend.smoothers.graph_builder import GraphBuilder
from fgslam.backend.smoothers.loop_closing import Acceptance, GraphLoops
from fgslam.backend.smoothers.marginals import marginals_of
from fgslam.backend.smoothers.solver import (
    ClosedLoop,
    Drive,
    Smoothed,
    Solution,
    allowed_joint,
    allowed_parts,
    points_of,
    poses_of,
    solver_failed,
)
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import reorthonormalise
from fgslam.core.quantiles import chi_square_quantile
from fgslam.factors.graphs import (
    is_pose,
    landmark_key,
    number,
    pose_key,
    poses_of_frame,
    solver_parameters,
)
from fgslam.factors.noise import plain, robust

_GATE = float(chi_square_quantile(0.999, 3))  # 16.3, of a landmark observation's three numbers
_KEPT = 0.5  # weights end at 0 or 1
_ROUNDS = 10  # trims until the observations that fit do not change any more
_QUICK_WIDTH = 3.0  # deviations, as the kernels' default
_ROUGH = 1e-4  # of the cost: the minimum with the kernel only chooses what fits
_SOLUTIONS = 5  # solutions until no landmark lies behind a camera any more
_BEHIND = "came out behind a camera"
_UNSEEN = "has no observation that fits the others"

Minimise: TypeAlias = Callable[[Any, Any], tuple[Any, Any]]
"""From a graph and initial values to values at the minimum and the factors that count there."""


def graduated(graph: Any, values: Any, inner: Any, noise_factor: float = 1.0) -> tuple[Any, Any]:
    """Graduated non-convexity (Yang et al. 2020) with truncated least squares, by GTSAM.

    Landmark observations are the possible outliers.

    Args:
        graph: factors without kernels.
        values: initial values.
        inner: parameters of the Levenberg-Marquardt steps.
        noise_factor: by which the factors' deviations exceed the stated ones.

    Returns:
        Values at the minimum, and the graph without the observations that were rejected.
    """
    factors = [graph.at(row) for row in range(graph.size())]
    observed = [_landmark(factor) is not None for factor in factors]
    params = gtsam.GncLMParams(inner)
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([row for row, is_one in enumerate(observed) if not is_one])
    optimizer = gtsam.GncLMOptimizer(graph, values, params)
    # GTSAM's threshold is on the cost, half of the squared residual.
    optimizer.setInlierCostThresholds(0.5 * _GATE / noise_factor**2)
    found = optimizer.optimize()
    weights = optimizer.getWeights()
    kept = gtsam.NonlinearFactorGraph()
    for factor, weight, is_one in zip(factors, weights, observed, strict=True):
        if weight > _KEPT or not is_one:
            kept.add(factor)
    return found, kept


def trimmed(graph: Any, values: Any, params: Any, noise_factor: float = 1.0) -> tuple[Any, Any]:
    """Minimises with the factors' own kernels, then without them over what fits.

    Args:
        graph: factors, landmark observations with a kernel.
        values: initial values.
        params: of Levenberg-Marquardt.
        noise_factor: by which the factors' deviations exceed the stated ones, which judge.

    Returns:
        Values at the minimum, and the plain factors that were kept.
    """
    rough = solver_parameters(params.getMaxIterations(), _ROUGH)
    values = gtsam.LevenbergMarquardtOptimizer(graph, values, rough).optimize()
    factors = [graph.at(row) for row in range(graph.size())]
    observed = [_landmark(factor) is not None for factor in factors]
    # A robust factor whitens with its kernel's weight, after which everything would seem to fit.
    # Loops keep their kernels: they are too few to be separated by a trim.
    factors = [plain(f) if is_one else f for f, is_one in zip(factors, observed, strict=True)]
    gate = _GATE / noise_factor**2
    fits: list[bool] = []
    for _ in range(_ROUNDS):
        before = fits
        pairs = zip(factors, observed, strict=True)
        fits = [not is_one or _squared(factor, values) <= gate for factor, is_one in pairs]
        if fits == before:
            break
        kept = gtsam.NonlinearFactorGraph()
        for factor, fit in zip(factors, fits, strict=True):
            if fit:
                kept.add(factor)
        values = gtsam.LevenbergMarquardtOptimizer(kept, values, rough).optimize()
    return gtsam.LevenbergMarquardtOptimizer(kept, values, params).optimize(), kept


def with_kernel(graph: Any) -> Any:
    """The graph with Cauchy's kernel around its landmark observations, for a quick solution."""
    out = gtsam.NonlinearFactorGraph()
    for row in range(graph.size()):
        factor = graph.at(row)
        observed = _landmark(factor) is not None
        out.add(robust(factor, "cauchy", _QUICK_WIDTH) if observed else factor)
    return out


def _squared(factor: Any, values: Any) -> float:
    """Whitened residual squared of a plain factor."""
    residual = factor.whitenedError(values)
    return float(residual @ residual)


def observed_variables(graph: Any) -> set[int]:
    """Landmark variables that some pose observes."""
    found = {_landmark(graph.at(row)) for row in range(graph.size())}
    return {variable for variable in found if variable is not None}


def _landmark(factor: Any) -> int | None:
    """The landmark variable of an observation; None for other factors."""
    keys = list(factor.keys())
    if len(keys) != 2 or not is_pose(keys[0]) or is_pose(keys[1]):
        return None
    return number(keys[1])


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A solved graph.

    Attributes:
        graph: the factors that count.
        values: of all variables that are left.
        remarks: what was left out, in words.
    """

    graph: Any
    values: Any
    remarks: tuple[str, ...] = ()

    @property
    def variables(self) -> list[int]:
        """Landmark variables that are left, ascending."""
        return landmark_variables(self.values)


def refine(builder: GraphBuilder, values: Any, minimise: Minimise) -> Refined:
    """Solves, without landmarks that come out behind a camera or that nothing supports."""
    graph = builder.kept_factors()
    remarks: list[str] = []
    for _ in range(_SOLUTIONS):
        found, kept = minimise(graph, values)
        lost = _lost(builder, found, kept)
        if not lost:
            return Refined(kept, found, tuple(remarks))
        remarks += [f"{builder.describe(v)} {why}: left out" for v, why in lost.items()]
        graph = _without(graph, {landmark_key(v) for v in lost})
        values = gtsam.Values(found)
        for variable in lost:
            values.erase(landmark_key(variable))
    found, kept = minimise(graph, values)
    return Refined(kept, found, tuple(remarks))


class WholeGraphSolver:
    """What solvers of a graph that keeps every pose share: loops, and the answer for the whole run.

    The answer is solved for once, until the graph changes.
    """

    kind: ClassVar[str]

    def __init__(self, builder: GraphBuilder, floor: Floor) -> None:
        """Nothing to solve yet."""
        self._builder, self._floor = builder, floor
        self._loops = GraphLoops(builder)
        self._values = gtsam.Values()
        self._answer: Refined | None = None
        self.remarks: list[str] = []

    def solution(self) -> Solution:
        """All poses and landmarks at the minimum over all that was measured, with marginals."""
        return solution(self._refined(), self._builder.frames, self._floor)

    def joint(self, variables: list[int]) -> FloatArray:
        """Joint covariance of the graph's last pose and landmark variables.

        Raises:
            EstimatorError: a landmark was left out of the last solution.
        """
        refined = self._refined()
        lost = set(variables) - set(refined.variables)
        if lost:
            raise EstimatorError(f"{self._builder.describe(min(lost))} was left out of the graph")
        last = self._builder.frames[-1]
        return joint_of(refined.graph, refined.values, self._floor, last, variables)

    def _refined(self) -> Refined:
        """The graph's last solution."""
        if self._answer is None:
            try:
                self._answer = self._refine()
            except RuntimeError as error:
                raise self._failed(error, "after") from None
        return self._answer

    def _refine(self) -> Refined:
        return refine(self._builder, self._values, self._minimise)

    def _minimise(self, graph: Any, values: Any) -> tuple[Any, Any]:
        """Values at the minimum, and the factors that count there."""
        raise NotImplementedError

    def _accepted(
        self,
        loop: Constraint,
        drive: Drive,
        what: str,
        graph: Callable[[], Any],
        minimum: Callable[[Any], Any],
    ) -> Acceptance | None:
        """The loop in the graph; None, and a remark, if it is refused. See GraphLoops.judge."""
        try:
            found = self._loops.judge(loop, drive, self._values, graph, minimum, what)
        except RuntimeError as error:
            raise self._failed(error) from None
        self.remarks.append(found.remark)
        if not found.closed:
            return None
        self._answer = None  # it may have been solved in this very frame, without the loop
        return found

    def _after_loop(self, covariance: FloatArray) -> ClosedLoop:
        """The values that a loop has moved, and the covariance (6, 6) of their last pose."""
        here = reorthonormalise(poses_of_frame(self._values, self._builder.frames[-1]))
        return ClosedLoop(Smoothed(self._values, Prediction(here, covariance), by_loop=True))

    def _failed(self, error: Exception, when: str = "at") -> Exception:
        return solver_failed(self.kind, error, self._builder.frames[-1], when)


def solution(refined: Refined, frames: list[int], floor: Floor) -> Solution:
    """Everything about frames of a solved graph and its landmark variables."""
    graph, values, variables = refined.graph, refined.values, refined.variables
    poses, points = poses_of(values, frames), points_of(values, variables)
    kept = np.full((len(poses), 6, 6), np.nan)
    try:
        marginals = marginals_of(graph, values)
        by_key = dict(zip(marginals.landmark_keys.tolist(), marginals.landmarks(), strict=True))
        covariances = {v: by_key[landmark_key(v)] for v in variables}
        kept[frames] = allowed_parts(floor, poses[frames], marginals.poses())
    except EstimatorError as error:
        missing = {v: np.full((3, 3), np.nan) for v in variables}
        return Solution(poses, kept, points, missing, (*refined.remarks, str(error)))
    return Solution(poses, kept, points, covariances, refined.remarks)


def joint_of(graph: Any, values: Any, floor: Floor, frame: int, variables: list[int]) -> FloatArray:
    """Joint covariance (6 + 3k, 6 + 3k) of a frame's pose and landmark variables."""
    marginals = marginals_of(graph, values)
    pose = int(np.searchsorted(marginals.pose_keys, pose_key(frame)))
    keys = np.array([landmark_key(v) for v in variables], np.int64)
    rows: IntArray = np.searchsorted(marginals.landmark_keys, keys).astype(np.int64)
    return allowed_joint(floor, poses_of_frame(values, frame), marginals.joint(pose, rows))


def landmark_variables(values: Any) -> list[int]:
    """Landmark variables among GTSAM values, ascending."""
    return [number(key) for key in list(values.keys()) if not is_pose(key)]


def _lost(builder: GraphBuilder, values: Any, kept: Any) -> dict[int, str]:
    variables = landmark_variables(values)
    poses, points = poses_of(values, builder.frames), points_of(values, variables)
    behind = dict.fromkeys(builder.behind(poses, points), _BEHIND)
    unseen = sorted(set(variables) - observed_variables(kept))
    return behind | dict.fromkeys(unseen, _UNSEEN)


def _without(graph: Any, keys: set[int]) -> Any:
    kept = gtsam.NonlinearFactorGraph()
    for row in range(graph.size()):
        factor = graph.at(row)
        if keys.isdisjoint(factor.keys()):
            kept.add(factor)
    return kept
