"""Errors and consistency of homing: home direction and distance, robot, target, home vector.

Truth is in metres and estimates in legs: truth is divided by the true leg. The leg itself is a
convention, not knowledge: where an estimator holds the target's distance at 1, that is no degree
of freedom, and its NEES counts direction and rotation alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import HomingEstimate, HomingTruth, home_vector_jacobian
from fgslam.core.geometry import wrap
from fgslam.evaluation.statistics import Nees, judge, nees

DIVERGED_DEG = 30.0
"""A home direction further off than this leads away, not home."""

_HELD = 1e-3  # legs: a smaller deviation of the target's distance is a convention


@dataclass(frozen=True, slots=True, eq=False)
class HomingErrors:
    """Errors of one homing, image by image (k,), estimate minus truth.

    Attributes:
        direction: of the target from the robot, radians.
        rotation: of the target against the robot, radians.
        distance: to the target, legs; NaN where the estimator knows none.
        robot, target, joint, home: NEES; without degrees of freedom where there is no covariance.
            The target is judged as (distance, direction, rotation) from the start, home as the
            same from the robot.
    """

    direction: FloatArray
    rotation: FloatArray
    distance: FloatArray
    robot: Nees
    target: Nees
    joint: Nees
    home: Nees

    def last(self) -> HomingErrors:
        """Those of the last image alone."""
        nees = (self.robot, self.target, self.joint, self.home)
        parts = [Nees(n.values[-1:], n.dof[-1:]) for n in nees]
        return HomingErrors(self.direction[-1:], self.rotation[-1:], self.distance[-1:], *parts)


def homing_errors(estimates: Sequence[HomingEstimate], truth: HomingTruth) -> HomingErrors:
    """Compares an estimate for each image with the truth.

    Args:
        estimates: (k) one for each row of ``truth.robots``.
        truth: of the same homing, in the same start frame, metres.

    Raises:
        ValueError: there are not as many estimates as true poses.
    """
    scale = np.array([1.0 / truth.leg_m, 1.0 / truth.leg_m, 1.0])
    target = truth.target * scale
    pairs = zip(estimates, truth.robots * scale, strict=True)
    rows = [_row(estimate, robot, target) for estimate, robot in pairs]
    homes, states, home_spreads, spreads = (np.array(part) for part in zip(*rows, strict=True))
    distance = np.where(np.isfinite(home_spreads[:, 0, 0]), homes[:, 0], np.nan)
    return HomingErrors(
        direction=homes[:, 1],
        rotation=homes[:, 2],
        distance=distance,
        robot=nees(states[:, :3], spreads[:, :3, :3]),
        target=nees(states[:, 3:], spreads[:, 3:, 3:]),
        joint=nees(states, spreads),
        home=nees(homes, home_spreads),
    )


def _row(
    estimate: HomingEstimate, robot: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Errors (3,) of home and (6,) of robot and target, and the covariances of both."""
    home = estimate.home()
    exact = _home(robot, target)
    error = np.array([home.distance, home.direction, home.rotation]) - exact
    error[1:] = wrap(error[1:])
    # The target as (distance, direction, rotation) from the start, jointly with the robot.
    start, change = np.zeros(3), np.eye(6)
    change[3:, 3:] = home_vector_jacobian(start, estimate.target)[:, 3:]
    spread = change @ estimate.covariance @ change.T
    off = _home(start, estimate.target) - _home(start, target)
    state = np.concatenate([estimate.robot - robot, off])
    state[[2, 4, 5]] = wrap(state[[2, 4, 5]])
    if spread[3, 3] < _HELD**2:
        state[3] = 0.0
        spread[3, :] = spread[:, 3] = 0.0
    return error, state, home.covariance, spread


def _home(robot: FloatArray, target: FloatArray) -> FloatArray:
    offset = target[:2] - robot[:2]
    direction = np.arctan2(offset[1], offset[0]) - robot[2]
    return np.array([np.hypot(*offset), direction, target[2] - robot[2]])


# --------------------------------------------------------------------------------------------
# Many trials


NEES_NAMES = ("robot", "target", "joint", "home")


def summarise_homings(errors: Sequence[HomingErrors]) -> dict[str, Any]:
    """What many independent homings, each with its last image, say together: for metrics.json.

    Returns:
        ``trials``; median and 95th percentile of the absolute errors, ``direction_median_deg``,
        ``rotation_p95_deg`` and so on, ``distance_median`` in legs, None where unknown;
        ``diverged``, those whose direction is off by more than :data:`DIVERGED_DEG`, or no number;
        ``unjudged``, those without a covariance of the home vector, which no NEES counts. NEES of
        `robot`, `target`, `joint` and `home` with its band, ``nees_robot`` and so on, and per
        degree of freedom, ``nees_robot_per_dof``; None without.

    Raises:
        ValueError: there is no trial.
    """
    last = [one.last() for one in errors]
    direction, rotation = (
        np.abs(np.rad2deg(np.concatenate([getattr(one, name) for one in last])))
        for name in ("direction", "rotation")
    )
    distance = np.abs(np.concatenate([one.distance for one in last]))
    known = distance[np.isfinite(distance)]
    numbers: dict[str, Any] = {
        "trials": len(last),
        "direction_median_deg": float(np.median(direction)),
        "direction_p95_deg": float(np.quantile(direction, 0.95)),
        "rotation_median_deg": float(np.median(rotation)),
        "rotation_p95_deg": float(np.quantile(rotation, 0.95)),
        "distance_median": float(np.median(known)) if len(known) else None,
        "distance_p95": float(np.quantile(known, 0.95)) if len(known) else None,
        "diverged": int(np.count_nonzero(~(direction <= DIVERGED_DEG))),
        "unjudged": sum(not one.home.dof.any() for one in last),
    }
    for name in NEES_NAMES:
        judged = judge([getattr(one, name) for one in last])
        numbers[f"nees_{name}_per_dof"] = None if judged is None else judged.per_dof
        numbers[f"nees_{name}"] = None if judged is None else asdict(judged)
    return numbers
