"""Answers for pairs of views, judged by the true poses where they are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.homing import Refusal, RefusalReason, TwoViewVector
from fgslam.core.planar import wrap
from fgslam.core.quantiles import chi_square_quantile
from fgslam.evaluation.metrics import JsonValue
from fgslam.report.tables import Cell, write_csv

PAIR_COLUMNS = (
    "from",
    "to",
    "answered",
    "direction_deg",
    "sigma_direction_deg",
    "rotation_deg",
    "sigma_rotation_deg",
    "inliers",
    "reason",
)
WRONG_DEG = 10.0
"""An answer whose direction or rotation is off by more is a wrong one (issue 4, 5.3)."""

_JOINT_PROBABILITY = 0.95
_SIGMAS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class PairAnswer:
    """What was found about one pair.

    Attributes:
        a, b: numbers of the views; b is the target.
        found: the homing vector, or why there is none.
        matches: tentative ones.
        rows: (k, 2) SIFT features of both views that are inliers; None where they were not kept.
    """

    a: int
    b: int
    found: TwoViewVector | Refusal
    matches: int
    rows: IntArray | None = None

    @property
    def answered(self) -> bool:
        """Whether there is a homing vector."""
        return isinstance(self.found, TwoViewVector)

    @property
    def inliers(self) -> int:
        """Of the answer; 0 where there is none."""
        return self.found.support if isinstance(self.found, TwoViewVector) else 0


@dataclass(frozen=True, slots=True, eq=False)
class PairErrors:
    """Errors of the answered pairs, degrees.

    Attributes:
        direction, rotation: (n,) estimate minus truth, wrapped.
        sigma_direction, sigma_rotation: (n,) as stated.
        mahalanobis2: (n,) squared error in units of the stated joint covariance.
        same_room: (n,) whether both views are of one room; None where rooms are not known.
    """

    direction: FloatArray
    rotation: FloatArray
    sigma_direction: FloatArray
    sigma_rotation: FloatArray
    mahalanobis2: FloatArray
    same_room: BoolArray | None

    def __len__(self) -> int:
        return len(self.direction)

    @property
    def worst(self) -> FloatArray:
        """(n,) larger of both errors' sizes."""
        return np.asarray(np.maximum(np.abs(self.direction), np.abs(self.rotation)))


def with_support(answer: PairAnswer, inliers: int) -> PairAnswer:
    """The same, refused where fewer inliers support it."""
    if not answer.answered or answer.inliers >= inliers:
        return answer
    why = Refusal(RefusalReason.TOO_FEW_INLIERS, f"{answer.inliers} inliers of {inliers} needed")
    return PairAnswer(answer.a, answer.b, why, answer.matches)


def true_pair(wTa: FloatArray, wTb: FloatArray) -> tuple[float, float]:
    """Direction of b seen from a against a's heading, and b's heading minus a's; radians."""
    offset = wTb[:2] - wTa[:2]
    direction = np.arctan2(offset[1], offset[0]) - wTa[2]
    return float(wrap(direction)), float(wrap(wTb[2] - wTa[2]))


def pair_errors(
    answers: Sequence[PairAnswer], poses: FloatArray, rooms: Sequence[str] | None = None
) -> PairErrors:
    """Errors of the answered pairs.

    Args:
        answers: of any pairs; those without an answer are passed over.
        poses: (m, 3) true planar poses of all views, metres and radians.
        rooms: of all views; None where they are not known.
    """
    found = [(p, p.found) for p in answers if isinstance(p.found, TwoViewVector)]
    errors = np.zeros((len(found), 2))
    covariances = np.zeros((len(found), 2, 2))
    for k, (pair, vector) in enumerate(found):
        truth = true_pair(poses[pair.a], poses[pair.b])
        errors[k] = wrap(np.array([vector.direction, vector.rotation]) - truth)
        covariances[k] = vector.covariance
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    sigmas = np.rad2deg(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))
    same = None if rooms is None else np.array([rooms[p.a] == rooms[p.b] for p, _ in found], bool)
    degrees = np.rad2deg(errors)
    distance = np.sum(errors * solved, axis=1)
    return PairErrors(degrees[:, 0], degrees[:, 1], sigmas[:, 0], sigmas[:, 1], distance, same)


def error_numbers(errors: PairErrors) -> dict[str, JsonValue]:
    """The metrics of answered pairs: errors, the worst, and whether the stated sigmas hold."""
    numbers = _numbers(errors)
    if errors.same_room is not None:
        numbers["same_room"] = _numbers(_taken(errors, errors.same_room))
        numbers["different_rooms"] = _numbers(_taken(errors, ~errors.same_room))
    return numbers


def answer_numbers(answers: Sequence[PairAnswer]) -> dict[str, JsonValue]:
    """How many pairs were answered, and why the others were not."""
    reasons: dict[str, int] = {}
    for pair in answers:
        if isinstance(pair.found, Refusal):
            name = pair.found.reason.value
            reasons[name] = reasons.get(name, 0) + 1
    inliers = [pair.inliers for pair in answers if pair.answered]
    return {
        "pairs": len(answers),
        "answered": len(inliers),
        "refused": dict(sorted(reasons.items())),
        "inliers_median": float(np.median(inliers)) if inliers else None,
    }


def write_pairs(path: Path, answers: Sequence[PairAnswer], names: Sequence[str]) -> None:
    """pairs.csv: a row for each pair, degrees, counter-clockwise positive. Raises OutputError."""
    write_csv(path, PAIR_COLUMNS, (_row(pair, names) for pair in answers))


def _row(pair: PairAnswer, names: Sequence[str]) -> list[Cell]:
    start: list[Cell] = [names[pair.a], names[pair.b], pair.answered]
    found = pair.found
    if isinstance(found, TwoViewVector):
        sigma = np.rad2deg(np.sqrt(np.diagonal(found.covariance)))
        direction, rotation = np.rad2deg([found.direction, found.rotation])
        return [*start, direction, sigma[0], rotation, sigma[1], found.support, ""]
    turn = None if found.rotation is None else float(np.rad2deg(found.rotation))
    return [*start, None, None, turn, None, 0, found.reason.value]


def _numbers(errors: PairErrors) -> dict[str, JsonValue]:
    if not len(errors):
        return {"answered": 0}
    limit = chi_square_quantile(_JOINT_PROBABILITY, 2)
    direction, rotation = np.abs(errors.direction), np.abs(errors.rotation)
    return {
        "answered": len(errors),
        "direction_median_deg": float(np.median(direction)),
        "direction_p95_deg": float(np.percentile(direction, 95)),
        "direction_worst_deg": float(direction.max()),
        "rotation_median_deg": float(np.median(rotation)),
        "rotation_p95_deg": float(np.percentile(rotation, 95)),
        "rotation_worst_deg": float(rotation.max()),
        "worse_than_10_deg": int(np.count_nonzero(errors.worst > WRONG_DEG)),
        "covered_joint_95": float(np.mean(errors.mahalanobis2 <= limit)),
        "covered_direction_2_sigma": float(np.mean(direction <= _SIGMAS * errors.sigma_direction)),
        "covered_rotation_2_sigma": float(np.mean(rotation <= _SIGMAS * errors.sigma_rotation)),
        "nees_per_dof": float(np.mean(errors.mahalanobis2) / 2.0),
    }


def _taken(errors: PairErrors, which: BoolArray) -> PairErrors:
    same = errors.same_room
    return PairErrors(
        errors.direction[which],
        errors.rotation[which],
        errors.sigma_direction[which],
        errors.sigma_rotation[which],
        errors.mahalanobis2[which],
        None if same is None else same[which],
    )
