"""What a smoother asks of a solver: the part to write for another way of solving the graph.

A solver is handed each frame's factors as they are made, says when there is a solution to track
on, judges loop closures, and answers for the whole run when asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from fgslam.backend.filters.submaps import Chain, Constraint
from fgslam.backend.smoothers.graph_builder import NewFactors
from fgslam.backend.smoothers.graph_solution import Solution
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import LandmarkMap, Prediction


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A solution between two frames, for the tracker to go on from.

    Attributes:
        values: GTSAM values of the poses and landmarks that the solver holds.
        last: pose ``wTc`` (4, 4) and covariance (6, 6) of the frame that entered last.
        by_loop: a loop moved the map: landmarks that the solver does not hold move with the camera.
    """

    values: Any
    last: Prediction
    by_loop: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoop:
    """A loop closure that was accepted; ``smoothed`` where the tracker is to go on from it."""

    smoothed: Smoothed | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """The drive as it was tracked: its chain of steps, and the present pose ``wTc`` (4, 4)."""

    chain: Chain
    wTc: FloatArray


class GraphSolver(Protocol):
    """Solves the growing graph of a :class:`~fgslam.backend.smoothers.smoother.Smoother`.

    A failure that taking a landmark out does not cure raises EstimatorError in any of these.
    """

    @property
    def kind(self) -> str:
        """Names the estimator in configurations, tables and messages."""
        ...

    @property
    def remarks(self) -> list[str]:
        """What became of loops, and which landmarks were taken out, in words."""
        ...

    def add(self, new: NewFactors, landmarks: LandmarkMap, timestamp: float) -> None:
        """Takes in a frame's factors.

        Args:
            new: of the frame; the builder keeps them, too.
            landmarks: the tracker's map after that frame.
            timestamp: of the frame, seconds.
        """
        ...

    def solve_if_due(self, frame: int, closes_loop: bool) -> Smoothed | None:
        """The solution with all that was added, if it is time for one at this frame.

        ``closes_loop``: :meth:`close` follows, and may take all in at once.
        """
        ...

    def close(self, loop: Constraint, drive: Drive, what: str) -> ClosedLoop | None:
        """Takes in a loop closure of the frame added last; None, and a remark, if it is refused.

        Args:
            loop: between two frames of the graph.
            drive: as tracked, without the loop.
            what: begins the remark.
        """
        ...

    def solution(self) -> Solution:
        """All poses and landmarks of the graph, with marginal covariances; changes nothing."""
        ...

    def joint(self, variables: list[int]) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of the graph's last pose and landmark variables."""
        ...


def solver_failed(kind: str, error: Exception, frame: int, when: str = "at") -> EstimatorError:
    """What to raise where a solver's failure cannot be repaired."""
    return EstimatorError(
        f"{kind}: the solver failed {when} frame {frame} "
        f"({' '.join(str(error).split())}); look at that frame with fgslam inspect"
    )
