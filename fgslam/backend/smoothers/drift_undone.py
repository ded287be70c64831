"""A loop closure in a window: what its last pose has drifted by, undone as far as is measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.backend.loops import Constraint, nearest_positive, refusal
from fgslam.core.estimates import Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import adjoint, congruence, inverse, se3_exp, se3_log


@dataclass(frozen=True, slots=True, eq=False)
class Undone:
    """The last pose by a loop; None where that is refused; and what became of it, in words."""

    last: Prediction | None
    remark: str


def drift_undone(
    floor: Floor, before: Prediction, last: Prediction, known: Constraint, what: str
) -> Undone:
    """The last pose moved to where a loop has it.

    The earlier frame's pose is known as it was when it left. What the last pose is less certain
    by than that one is drift, and the loop measures the drift: a Kalman correction of one pose.

    Args:
        floor: on which nothing drifts, and nothing is measured, in the other directions.
        before: the earlier pose.
        last: the last one.
        known: the loop.
        what: begins the remark.
    """
    shared = congruence(adjoint(inverse(known.motion)), before.covariance)
    drift = nearest_positive(last.covariance - shared)
    basis = floor.basis(last.wTc) if floor.rigid_dof < 6 else np.eye(6)
    off = basis.T @ se3_log(inverse(last.wTc) @ before.wTc @ known.motion)
    drift = basis.T @ drift @ basis
    innovation = drift + basis.T @ known.covariance @ basis
    gain = np.linalg.solve(innovation, drift).T
    refused = refusal(what, float(off @ np.linalg.solve(innovation, off)))
    if refused:
        return Undone(None, refused)
    target = last.wTc @ se3_exp(basis @ gain @ off)
    target = floor.constrain(target) if floor.rigid_dof < 6 else target
    covariance = shared + congruence(basis, nearest_positive(drift - gain @ drift))
    shift = float(np.linalg.norm(target[:3, 3] - last.wTc[:3, 3]))
    remark = f"{what}: the camera moved by {shift:.2f} m"
    return Undone(Prediction(target, floor.allowed_part(target, covariance)), remark)
