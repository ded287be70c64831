"""Errors, counts and consistency of poses found in a map without a prior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows, chi_square_quantile
from fgslam.core.geometry import inverse
from fgslam.evaluation.statistics import pose_nees, rotation_angles, spread

_HELD = 0.95


@dataclass(frozen=True, slots=True)
class Bounds:
    """What counts as right, and what as false: metres and radians.

    Attributes:
        within_m, within_rad: largest errors of a right pose.
        wrong_m, wrong_rad: a pose farther off than either is false.
        least_visible: poses from which fewer landmarks are visible are counted apart.
    """

    within_m: float
    within_rad: float
    wrong_m: float
    wrong_rad: float
    least_visible: int


@dataclass(frozen=True, slots=True, eq=False)
class Answers(Rows):
    """What was asked and answered, row by row.

    Attributes:
        accepted: (n,) whether the pose was accepted.
        poses: (n, 4, 4) ``wTc`` found; anything where it is not accepted.
        covariances: (n, 6, 6) in the tangent space at them.
        truth: (n, 4, 4) true poses in the map's world; NaN where unknown.
        visible: (n,) landmarks truly visible; -1 where unknown.
        familiar: (n,) of these, those seen before from about there; -1 where unknown.
    """

    accepted: BoolArray
    poses: FloatArray
    covariances: FloatArray
    truth: FloatArray
    visible: IntArray
    familiar: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LocalisationErrors:
    """Errors of the accepted poses; NaN where one is refused or its truth unknown.

    Attributes:
        metres, radians: (n,) distance and angle from the truth.
        nees: (n,) normalised error squared.
        dof: (n,) its degrees of freedom, 0 where unknown.
    """

    metres: FloatArray
    radians: FloatArray
    nees: FloatArray
    dof: IntArray


def localisation_errors(answers: Answers) -> LocalisationErrors:
    """Errors of the accepted poses against the truth."""
    known = answers.accepted & np.isfinite(answers.truth).all(axis=(1, 2))
    metres, radians, nees = (np.full(len(answers), np.nan) for _ in range(3))
    dof = np.zeros(len(answers), np.int64)
    if known.any():
        poses, truth = answers.poses[known], answers.truth[known]
        difference = inverse(poses) @ truth
        metres[known] = np.linalg.norm(difference[:, :3, 3], axis=1)
        radians[known] = rotation_angles(difference[:, :3, :3])
        found = pose_nees(poses, answers.covariances[known], truth)
        nees[known], dof[known] = found.values, found.dof
    return LocalisationErrors(metres, radians, nees, dof)


def score(answers: Answers, bounds: Bounds) -> dict[str, Any]:
    """Counts over some queries, and their errors, as metrics.json has them.

    Returns:
        Queries ``asked``; ``accepted``, poses that were trusted; ``with_truth``, how many have a
        truth: the rest is over these. Of the accepted ``right``, within the bounds, ``false``,
        somewhere else, and ``inexact``, neither; ``share_right``. The spread of ``error_m`` and
        ``error_deg`` of those accepted; the mean ``nees_per_dof``, and ``share_in_95_percent`` of
        the true poses in that region of the covariance. None where unknown.
    """
    errors = localisation_errors(answers)
    judged = np.isfinite(errors.metres)
    right = judged & (errors.metres <= bounds.within_m) & (errors.radians <= bounds.within_rad)
    false = judged & ((errors.metres > bounds.wrong_m) | (errors.radians > bounds.wrong_rad))
    sure = judged & (errors.dof > 0)
    held = errors.nees[sure] <= chi_square_quantile(_HELD, errors.dof[sure])
    known = int(np.isfinite(answers.truth).all(axis=(1, 2)).sum())
    return {
        "asked": len(answers),
        "accepted": int(answers.accepted.sum()),
        "with_truth": known,
        "right": int(right.sum()),
        "inexact": int((judged & ~right & ~false).sum()),
        "false": int(false.sum()),
        "share_right": int(right.sum()) / known if known else None,
        "error_m": spread(errors.metres),
        "error_deg": spread(np.rad2deg(errors.radians)),
        "nees_per_dof": errors.nees[sure].sum() / errors.dof[sure].sum() if sure.any() else None,
        "share_in_95_percent": float(np.mean(held)) if sure.any() else None,
    }


def enough(in_view: IntArray, bounds: Bounds) -> BoolArray:
    """(n,) where enough landmarks are in view (n,), or their number is unknown."""
    return np.asarray((in_view < 0) | (in_view >= bounds.least_visible))
