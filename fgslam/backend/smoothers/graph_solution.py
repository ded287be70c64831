"""Poses, landmarks and their marginals out of a solved graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray
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
