"""The final solution of a graph: what does not fit is left out, the rest solved once more.

It changes neither the builder nor the solver that it starts from, so that asking for an estimate
in the middle of a run leaves the run as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import gtsam
import numpy as np

from fgslam.backend.graphs import poses_of_frame
from fgslam.backend.smoothers.graph_builder import GraphBuilder
from fgslam.backend.smoothers.graph_solution import (
    Solution,
    allowed_joint,
    allowed_parts,
    points_of,
    poses_of,
)
from fgslam.backend.smoothers.marginals import marginals_of
from fgslam.backend.smoothers.outliers import observed_variables
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.floor import Floor
from fgslam.factors.keys import is_pose, landmark_key, number, pose_key

_ROUNDS = 5  # solutions until no landmark lies behind a camera any more
_BEHIND = "came out behind a camera"
_UNSEEN = "has no observation that fits the others"

Minimise: TypeAlias = Callable[[Any, Any], tuple[Any, Any]]
"""From a graph and initial values to values at the minimum and the factors that count there."""


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
    for _ in range(_ROUNDS):
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


class WholeGraphAnswer:
    """Final answers of a graph that keeps every pose, refined once until it changes."""

    def __init__(self, builder: GraphBuilder, floor: Floor, refined: Callable[[], Refined]) -> None:
        """``refined`` gives the graph, solved anew."""
        self._builder = builder
        self._floor = floor
        self._refine = refined
        self._refined: Refined | None = None

    def changed(self) -> None:
        """Forgets the last answer."""
        self._refined = None

    def refined(self) -> Refined:
        """The graph's last solution."""
        if self._refined is None:
            self._refined = self._refine()
        return self._refined

    def solution(self) -> Solution:
        """All poses and landmarks with their marginals."""
        return solution(self.refined(), self._builder.frames, self._floor)

    def joint(self, variables: list[int]) -> FloatArray:
        """Joint covariance of the graph's last pose and landmark variables.

        Raises:
            EstimatorError: a landmark was left out of the last solution.
        """
        refined = self.refined()
        lost = set(variables) - set(refined.variables)
        if lost:
            raise EstimatorError(f"{self._builder.describe(min(lost))} was left out of the graph")
        last = self._builder.frames[-1]
        return joint_of(refined.graph, refined.values, self._floor, last, variables)


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
