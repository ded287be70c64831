"""Loop closures against the truth: whether the place was the same, and what closing corrected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import inverse
from fgslam.core.measurements import LoopClosure
from fgslam.evaluation.trajectory import position_errors, rotation_angles, to_estimate_world

FALSE_M = 0.5
"""A closure that is farther from the true relative pose was none."""
FALSE_DEG = 10.0


@dataclass(frozen=True, slots=True)
class JudgedClosure:
    """One closure beside the truth; NaN and None where nothing is known.

    Attributes:
        at, to: positions in the log of the frame that closed it and the one it returned to.
        matches: old landmarks seen again.
        merged: landmarks found to be one; 0 for a closure that was refused.
        correction_m: how far the closure moved the pose, metres; NaN where it was refused.
        error_m: of the relative pose that it measured, metres; error_deg: degrees.
        before_m: error of the last pose before, in the world of the first pose, metres.
        after_m: of the pose once corrected; NaN where nothing was.
        taken: whether the run's estimator took it, or refused it.
    """

    at: int
    to: int
    matches: int
    merged: int
    correction_m: float
    error_m: float
    error_deg: float
    before_m: float
    after_m: float
    taken: bool

    @property
    def false(self) -> bool | None:
        """Whether the return that it claims is none; None where that is not known."""
        if not np.isfinite(self.error_m):
            return None
        return self.error_m > FALSE_M or self.error_deg > FALSE_DEG


def judge_closures(
    closures: list[tuple[int, LoopClosure, bool]],
    tracked: FloatArray,
    online: Trajectory,
    truth: Trajectory | None,
) -> list[JudgedClosure]:
    """All closures of a run, in their order.

    Args:
        closures: each with the position in the log of the frame that it belongs to, and whether
            it was taken.
        tracked: (n, 4, 4) poses ``wTc`` before their frame's closures.
        online: poses after them.
        truth: true poses, in any world.
    """
    true_poses = _true_poses(online, truth)
    errors = position_errors(online.poses, true_poses)
    tracked_errors = position_errors(tracked, true_poses)
    out = []
    for at, closure, taken in closures:
        true = inverse(true_poses[closure.frame]) @ true_poses[at]
        off = inverse(true) @ closure.oTc
        out.append(
            JudgedClosure(
                at=at,
                to=closure.frame,
                matches=len(closure.observations),
                merged=len(closure.merged) if taken else 0,
                correction_m=_distance(online.poses[at], tracked[at]) if taken else np.nan,
                error_m=float(np.linalg.norm(off[:3, 3])),
                error_deg=_degrees(off),
                before_m=float(tracked_errors[at]),
                after_m=float(errors[at]) if taken else np.nan,
                taken=taken,
            )
        )
    return out


def _distance(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def _true_poses(online: Trajectory, truth: Trajectory | None) -> FloatArray:
    """(n, 4, 4) true poses in the estimate's world; NaN where unknown."""
    out = np.full((len(online), 4, 4), np.nan)
    found = None if truth is None else to_estimate_world(online, truth)
    if found is not None:
        out[found[0]] = found[1]
    return out


def _degrees(aTb: FloatArray) -> float:
    if not np.isfinite(aTb).all():
        return float("nan")
    return float(np.rad2deg(rotation_angles(aTb[None, :3, :3])[0]))
