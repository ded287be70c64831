"""Links between images: homings there and back that agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.homing import Refusal, RefusalReason, TwoViewVector
from fgslam.core.planar import wrap

_MUTUAL_DEG = 5.0  # largest difference between the answers there and back, beyond three deviations
_MIN_SUPPORT = 12  # inliers of an edge, in either answer
_ONE_WAY_SUPPORT = 25
"""Inliers of an edge that is answered in one direction and ambiguous in the other."""

Answer: TypeAlias = TwoViewVector | Refusal
Pair: TypeAlias = tuple[int, int]

_SIGMAS = 3.0
_UNDECIDED = (RefusalReason.AMBIGUOUS, RefusalReason.UNCERTAIN)


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A homing from one image to another that was answered in both directions alike.

    Attributes:
        a, b: numbers of the images.
        direction: of b as seen from a, radians; NaN where both were taken at one place.
        rotation: heading of b minus that of a.
        back: direction of a as seen from b.
        covariance: (2, 2) of (direction, rotation).
        back_covariance: the same of the way back.
        support: inliers, of the answer that has fewer.
    """

    a: int
    b: int
    direction: float
    rotation: float
    back: float
    covariance: FloatArray
    back_covariance: FloatArray
    support: int

    def reversed(self) -> Link:
        """The way back."""
        return Link(
            self.b, self.a, self.back, -self.rotation, self.direction, self.back_covariance,
            self.covariance, self.support,
        )  # fmt: skip


def link_pair(pair: Pair, there: Answer, back: Answer) -> Link | str:
    """The link of two answers, or why there is none.

    Both directions must be answered with enough inliers, and one motion must explain both:
    the rotations are opposite, and back points where there came from:
    theta_ba = theta_ab + pi - psi_ab. Where one direction cannot decide between two solutions, the
    other may, with more inliers.
    """
    if isinstance(there, Refusal) and isinstance(back, Refusal):
        return _same_place(pair, there, back)
    if isinstance(there, Refusal) or isinstance(back, Refusal):
        return _one_way(pair, there, back)
    support = min(there.support, back.support)
    if support < _MIN_SUPPORT:
        return f"{support} inliers, of {_MIN_SUPPORT} needed"
    gap = np.array(
        [
            there.rotation + back.rotation,
            there.direction + np.pi - there.rotation - back.direction,
        ]
    )
    apart = float(np.max(np.abs(wrap(gap))))
    variance = float(np.max(np.diag(there.covariance) + np.diag(back.covariance)))
    if apart > max(np.deg2rad(_MUTUAL_DEG), _SIGMAS * np.sqrt(variance)):
        return f"there and back disagree by {np.rad2deg(apart):.1f} deg"
    return Link(
        *pair, there.direction, there.rotation, back.direction, there.covariance,
        back.covariance, support,
    )  # fmt: skip


def _one_way(pair: Pair, there: Answer, back: Answer) -> Link | str:
    """Link of a pair that is answered in one direction and undecided in the other.

    Which of the two solutions the few decisive features support, or which minimum of a
    valley, may hang on the draw; that is no contradiction. Any other refusal is, as both answers
    come from the same views.
    """
    answer, other = (back, there) if isinstance(there, Refusal) else (there, back)
    if isinstance(answer, Refusal) or not isinstance(other, Refusal):
        raise TypeError("one direction must be answered, the other refused")
    if other.reason not in _UNDECIDED:
        return f"refused in one direction: {other.details}"
    if answer.support < _ONE_WAY_SUPPORT:
        return (
            f"{answer.support} inliers one way, of {_ONE_WAY_SUPPORT} needed; back: {other.details}"
        )
    opposite = _opposite(answer)
    ahead, behind = (opposite, answer) if answer is back else (answer, opposite)
    return Link(
        *pair, ahead.direction, ahead.rotation, behind.direction, ahead.covariance,
        behind.covariance, answer.support,
    )  # fmt: skip


def _opposite(vector: TwoViewVector) -> TwoViewVector:
    """The way back, of the same motion."""
    back = float(wrap(np.array(vector.direction + np.pi - vector.rotation)))
    # (theta + pi - psi, -psi) of (theta, psi)
    jacobian = np.array([[1.0, -1.0], [0.0, -1.0]])
    covariance = jacobian @ vector.covariance @ jacobian.T
    return TwoViewVector(
        back, -vector.rotation, covariance, vector.inliers, vector.competing_support
    )


def _same_place(pair: Pair, there: Refusal, back: Refusal) -> Link | str:
    """Link of two images from one place: a turn without a direction."""
    if RefusalReason.AT_TARGET not in (there.reason, back.reason):
        return there.details
    if there.rotation is None or back.rotation is None:
        return "taken at one place as seen from one of them only"
    apart = abs(float(wrap(np.array(there.rotation + back.rotation))))
    if apart > np.deg2rad(_MUTUAL_DEG):
        return f"there and back disagree by {np.rad2deg(apart):.1f} deg"
    nowhere = np.full((2, 2), np.nan)
    nowhere[1, 1] = np.deg2rad(_MUTUAL_DEG / _SIGMAS) ** 2
    return Link(
        *pair, float("nan"), there.rotation, float("nan"), nowhere, nowhere, _MIN_SUPPORT,
    )  # fmt: skip


def link_pairs(answers: Mapping[Pair, Answer]) -> tuple[list[Link], dict[Pair, str]]:
    """Links of all pairs a < b that were answered in both directions, and why others are none."""
    links: list[Link] = []
    refused: dict[Pair, str] = {}
    for a, b in sorted(answers):
        if a >= b or (b, a) not in answers:
            continue
        made = link_pair((a, b), answers[a, b], answers[b, a])
        if isinstance(made, str):
            refused[a, b] = made
        else:
            links.append(made)
    return links, refused
