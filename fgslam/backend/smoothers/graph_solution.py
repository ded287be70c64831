"""Poses, landmarks and their marginals out of a solved graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from fgslam.backend.graphs import poses_of_frame
from fgslam.backend.smoothers.marginals import marginals_of
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.floor import Floor
from fgslam.core.geometry import congruence
from fgslam.factors.keys import landmark_key, pose_key


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The graph's answer.

    Attributes:
        poses: (n, 4, 4) by frame; NaN for those between keyframes.
        pose_covariances: (n, 6, 6); NaN where they cannot be had.
        points: positions (3,) of landmark variables.
        point_covariances: (3, 3) of the same.
        remarks: what was left out, why covariances are missing; in words.
    """

    poses: FloatArray
    pose_covariances: FloatArray
    points: dict[int, FloatArray]
    point_covariances: dict[int, FloatArray]
    remarks: tuple[str, ...] = ()


class SolvedGraph(Protocol):
    """Factors, values of all variables, and what was left out."""

    @property
    def graph(self) -> Any:
        """The factors that count."""
        ...

    @property
    def values(self) -> Any:
        """Values of all variables."""
        ...

    @property
    def variables(self) -> list[int]:
        """Landmark variables, ascending."""
        ...

    @property
    def remarks(self) -> tuple[str, ...]:
        """In words."""
        ...


def poses_of(values: Any, frames: list[int]) -> FloatArray:
    """Poses (n, 4, 4) by frame, up to the last of ``frames``; NaN for those not among them."""
    out = np.full((frames[-1] + 1, 4, 4), np.nan)
    for frame in frames:
        out[frame] = values.atPose3(pose_key(frame)).matrix()
    return out


def points_of(values: Any, variables: list[int]) -> dict[int, FloatArray]:
    """Positions of landmark variables in GTSAM values."""
    return {v: np.asarray(values.atPoint3(landmark_key(v))) for v in variables}


def solution(refined: SolvedGraph, frames: list[int], floor: Floor) -> Solution:
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


def allowed_parts(floor: Floor, poses: FloatArray, covariances: FloatArray) -> FloatArray:
    """Covariances (n, 6, 6) without what a hard floor excludes, which the graph holds stiffly."""
    if floor.rigid_dof == 6:
        return covariances
    pairs = zip(poses, covariances, strict=True)
    return np.array([floor.allowed_part(pose, covariance) for pose, covariance in pairs])


def joint_of(graph: Any, values: Any, floor: Floor, frame: int, variables: list[int]) -> FloatArray:
    """Joint covariance (6 + 3k, 6 + 3k) of a frame's pose and landmark variables."""
    marginals = marginals_of(graph, values)
    pose = int(np.searchsorted(marginals.pose_keys, pose_key(frame)))
    keys = np.array([landmark_key(v) for v in variables], np.int64)
    rows: IntArray = np.searchsorted(marginals.landmark_keys, keys).astype(np.int64)
    return allowed_joint(floor, poses_of_frame(values, frame), marginals.joint(pose, rows))


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
