"""Judges the loops that a run closed: were they returns, and what did closing them mend?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.evaluation.trajectory import position_errors, rotation_angles, to_estimate_world
from fgslam.geometry import inverse
from fgslam.types import FloatArray, LoopClosure, Trajectory

FALSE_M = 0.5
"""A closure that is farther from the true relative pose was none."""
FALSE_DEG = 10.0


@dataclass(frozen=True, slots=True)
class JudgedClosure:
    """One loop closed, beside the truth; NaN and None where nothing is known.

    Attributes:
        at, to: positions in the log of the frame that closed it and the one it returned to.
        matches: old landmarks seen again.
        merged: landmarks found to be one.
        correction_m: how far the closure moved the pose, metres.
        error_m: of the relative pose that it measured, metres; error_deg: degrees.
        before_m: error of the last pose before, in the world of the first pose, metres.
        after_m: of the pose once corrected.
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

    @property
    def false(self) -> bool | None:
        """Whether it closed a loop that is none; None where that is not known."""
        if not np.isfinite(self.error_m):
            return None
        return self.error_m > FALSE_M or self.error_deg > FALSE_DEG


def judge_closures(
    closures: list[tuple[int, LoopClosure]],
    tracked: FloatArray,
    online: Trajectory,
    truth: Trajectory | None,
) -> list[JudgedClosure]:
    """All closures of a run, in their order.

    Args:
        closures: with the position in the log of the frame that each belongs to.
        tracked: (n, 4, 4) poses ``wTc`` before their frame's closures.
        online: poses after them.
        truth: true poses, in any world.
    """
    true_poses = _true_poses(online, truth)
    errors = position_errors(online.poses, true_poses)
    tracked_errors = position_errors(tracked, true_poses)
    out = []
    for at, closure in closures:
        true = inverse(true_poses[closure.frame]) @ true_poses[at]
        off = inverse(true) @ closure.oTc
        out.append(
            JudgedClosure(
                at=at,
                to=closure.frame,
                matches=len(closure.observations),
                merged=len(closure.merged),
                correction_m=float(np.linalg.norm(online.poses[at, :3, 3] - tracked[at, :3, 3])),
                error_m=float(np.linalg.norm(off[:3, 3])),
                error_deg=_degrees(off),
                before_m=float(tracked_errors[at]),
                after_m=float(errors[at]),
            )
        )
    return out


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
