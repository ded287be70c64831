"""What a smoother asks of a solver: the part to write for another way of solving the graph.

A solver is handed each frame's factors as they are made, says when there is a solution to track
on, judges loop closures, and answers for the whole run when asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from fgslam.backend.loops import Chain, Constraint
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.smoothers.graph_builder import NewFactors
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import GyroscopeBias, LandmarkMap, Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import congruence
from fgslam.factors.graphs import landmark_key, pose_key


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The graph's answer.

    Attributes:
        poses: (n, 4, 4) by frame; NaN for those between keyframes.
        pose_covariances: (n, 6, 6); NaN where they cannot be had.
        points: positions (3,) of landmark variables.
        point_covariances: (3, 3) of the same.
        remarks: what was left out, why covariances are missing; in words.
        considers_rig: covariances contain what is open of the rig's calibration; else what was
            open when each frame came is added.
        noise_ratio: variance of the measurements over what the builder takes it to be.
        gyroscope: its bias, where it is a variable of the graph.
    """

    poses: FloatArray
    pose_covariances: FloatArray
    points: dict[int, FloatArray]
    point_covariances: dict[int, FloatArray]
    remarks: tuple[str, ...] = ()
    considers_rig: bool = False
    noise_ratio: float = 1.0
    gyroscope: GyroscopeBias | None = None


def poses_of(values: Any, frames: list[int]) -> FloatArray:
    """Poses (n, 4, 4) by frame, up to the last of ``frames``; NaN for those not among them."""
    out = np.full((frames[-1] + 1, 4, 4), np.nan)
    for frame in frames:
        out[frame] = values.atPose3(pose_key(frame)).matrix()
    return out


def points_of(values: Any, variables: list[int]) -> dict[int, FloatArray]:
    """Positions of landmark variables in GTSAM values."""
    return {v: np.asarray(values.atPoint3(landmark_key(v))) for v in variables}


def allowed_parts(floor: Floor, poses: FloatArray, covariances: FloatArray) -> FloatArray:
    """Covariances (n, 6, 6) without what a hard floor excludes, which the graph holds stiffly."""
    if floor.rigid_dof == 6:
        return covariances
    pairs = zip(poses, covariances, strict=True)
    return np.array([floor.allowed_part(pose, covariance) for pose, covariance in pairs])


def allowed_joint(floor: Floor, wTc: FloatArray, joint: FloatArray) -> FloatArray:
    """Joint covariance of a pose ``wTc`` and others without what a hard floor excludes of it."""
    if floor.rigid_dof == 6:
        return joint
    basis = floor.basis(wTc)
    project = np.eye(len(joint))
    project[:6, :6] = basis @ basis.T
    return congruence(project, joint)


def suspect(error: Exception) -> int | None:
    """Key of the variable near which GTSAM says that the system was indeterminate, if it does."""
    words = str(error).split("variable", 1)
    digits = "".join(c for c in words[-1].strip().split(" ")[0] if c.isdigit())
    return int(digits) if len(words) == 2 and digits else None


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A solution between two frames, for the tracker to go on from.

    Attributes:
        values: GTSAM values of the poses and landmarks that the solver holds.
        last: pose ``wTc`` (4, 4) and covariance (6, 6) of the frame that entered last.
        since: frame; the values hold no landmark that was seen last before it.
        by_loop: a loop moved the map: landmarks that the solver does not hold move with the camera.
    """

    values: Any
    last: Prediction
    since: int = 0
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

    def recalibrate(self, change: RigChange) -> None:
        """The builder has corrected its observations anew."""
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
