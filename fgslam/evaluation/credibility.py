"""Whether stated covariances are credible: their tangent space, NEES, coverage and what mends them.

The error of a pose is, by tangent space (Jung and Weiss 2022 call them types 1, 2, 5 and 6):

* ``local``: ``T = T_est Exp(xi)``, as in GTSAM and here; ``global``: ``T = Exp(xi) T_est``;
* ``split_local``: ``R = R_est Exp(theta)``, ``t = t_est + dt`` along the world's axes, as in
  OpenVINS; ``split_global``: the same with ``R = Exp(theta) R_est``, as ROS defines its messages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    adjoint,
    change_tangent_frame,
    inverse,
)
from fgslam.core.types import Trajectory
from fgslam.evaluation.statistics import (
    Consistency,
    associate,
    judge,
    nees,
    pose_errors,
    to_estimate_world,
    within,
)

_SPACES = ("local", "global", "split_local", "split_global")
_LIKELIER = 6.0
"""Log likelihood ratio from which the data decide, 400 to 1: of a few slow errors, as a drift has,
20 to 1 came about by chance in one of eight simulated drives."""
_OFF = 3.0  # deviation of the logarithm of the variance by which estimators are off
_FEWEST = 10  # poses: fewer decide nothing
_EXCLUDED = 1e-4  # of the mean variance of all axes: what lies below is no uncertainty
_GROWN = 0.9  # share of steps
_TURNED = 0.25  # of the misfit of the paths, below which turned axes are taken
_PER_RADIAN = np.degrees(1.0)


@dataclass(frozen=True, slots=True)
class Tangent:
    """What the numbers of a pose's covariance are of: order, space, unit of rotations."""

    order: str = "rotation_first"
    space: str = "local"
    unit: str = "radians"

    def __str__(self) -> str:
        return f"{self.order},{self.space}" + ",degrees" * (self.unit == "degrees")

    @property
    def split(self) -> bool:
        """Whether rotation and position err apart."""
        return self.space.startswith("split")

    def to_local(self, poses: FloatArray, covariances: FloatArray) -> FloatArray:
        """Stated covariances (n, 6, 6) in the tangent space at poses, [rotation, translation]."""
        swap = [3, 4, 5, 0, 1, 2] if self.order == "translation_first" else list(range(6))
        change = np.tile(np.eye(6), (len(poses), 1, 1))
        bRw = np.swapaxes(poses[:, :3, :3], 1, 2)
        if self.space == "global":
            change = adjoint(inverse(poses))
        elif self.split:
            change[:, 3:, 3:] = bRw
            if self.space == "split_global":
                change[:, :3, :3] = bRw
        if self.unit == "degrees":
            change[:, :, :3] /= _PER_RADIAN
        ordered = covariances[:, swap][:, :, swap]
        return np.asarray(change @ ordered @ np.swapaxes(change, 1, 2))


def tangent_errors(estimate: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors (n, 6) of poses, [rotation, translation] along the estimate's axes, whole and split.

    ``Log(T_est^-1 T)``; and ``Log(R_est^T R)`` with ``t - t_est``.
    """
    whole = pose_errors(estimate, truth)
    apart = (inverse(estimate) @ truth)[:, :3, 3]
    return whole, np.hstack([whole[:, :3], apart])


def guess_tangent(
    estimate: Trajectory, stated: FloatArray, truth: Trajectory, words: frozenset[str], usual: str
) -> tuple[Tangent, str, Tangent | None]:
    """The tangent space that fits the errors, of those that the words leave open.

    Errors are taken as normal with the stated covariance times one factor, which is estimated and
    hardly more than 400; a log likelihood counts as many errors as are independent. Of what is not
    far less likely than the best, those are kept in which covariances only grow, as by dead
    reckoning, if there are any; of these the ``usual`` space, else the likeliest. Degrees are taken
    only where they are far likelier.

    Returns:
        It; why, in words, empty where it is stated; and one that fits far better, if there is one.
    """
    orders = ("rotation_first", "translation_first")
    choices = [Tangent(o, s, u) for u in ("radians", "degrees") for o in orders for s in _SPACES]
    found = to_estimate_world(estimate, truth)
    rows, true = (found[0][1:], found[1][1:]) if found else (np.empty(0, int), np.empty((0, 4, 4)))
    errors = tangent_errors(estimate.poses[rows], true)
    local = {one: one.to_local(estimate.poses, stated) for one in choices}
    fits = [_misfit(local[one][rows], errors[one.split]) for one in choices]
    count = min(independent_count(series) for *_, series in fits) if len(rows) >= _FEWEST else 0.0
    # Rounded, so that of equals the first is taken.
    cost = {one: round(count * misfit + 0.5 * (factor / _OFF) ** 2, 9)
            for one, (misfit, factor, _) in zip(choices, fits, strict=True)}  # fmt: skip
    overall = min(choices, key=cost.__getitem__)
    allowed = [one for one in choices if words <= {one.order, one.space, one.unit}]
    radians = [one for one in allowed if one.unit == "radians"]
    least = min((cost[one] for one in radians), default=np.inf)
    if radians and (overall.unit == "radians" or least - cost[overall] <= _LIKELIER):
        allowed = radians
    least = min(cost[one] for one in allowed)
    likely = [one for one in allowed if cost[one] - least <= _LIKELIER]
    grown = [one for one in likely if _grows(estimate.poses, local[one])]
    kept = grown or likely
    taken = min([c for c in kept if c.space == usual] or kept, key=cost.__getitem__)
    fitting = overall if cost[taken] - cost[overall] > _LIKELIER else None
    if len({(one.order, one.space) for one in allowed}) == 1:
        return taken, "", fitting
    others = [str(one) for one in dict.fromkeys((*kept, overall)) if one != taken][:3]
    why = "covariances grow as by dead reckoning, " if 0 < len(grown) < len(likely) else ""
    rivals = f", not surely: perhaps {' or '.join(others)}" if others else ""
    return taken, f"guess: {why}the likeliest given the errors{rivals}", fitting


def _misfit(local: FloatArray, errors: FloatArray) -> tuple[float, float, FloatArray]:
    """Negative log likelihood a pose without what all share, log of the factor, and NEES (n,)."""
    # What a covariance excludes, as motion off a floor, has no say but where it is contradicted.
    usual = np.nanmean(np.diagonal(local, axis1=1, axis2=2), axis=0).reshape(2, 3).mean(axis=1)
    found = nees(errors, local + _EXCLUDED * np.diag(np.repeat(usual, 3)))
    known = found.dof > 0
    if not known.any():
        return 0.0, 0.0, np.zeros(1)
    blocks = np.stack([local[known, :3, :3], local[known, 3:, 3:]])
    spread = np.linalg.eigvalsh(blocks)
    uncertain = spread > _EXCLUDED * spread[..., -1:]
    dof = max(float(uncertain.sum() / known.sum()), 1.0)
    factor = float(np.log(max(found.values[known].mean() / dof, np.finfo(float).tiny)))
    volume = np.log(np.where(uncertain, spread, 1.0)).sum() / known.sum()
    return 0.5 * (dof * factor + volume), factor, found.values[known]


def _grows(poses: FloatArray, local: FloatArray) -> bool:
    """Whether covariances grow as by dead reckoning, by no negative covariance."""
    gained = np.trace(accumulated(poses, local, 1), axis1=1, axis2=2)
    return bool((gained > 1e-6 * np.trace(local[1:], axis1=1, axis2=2)).mean() > _GROWN)


def accumulated(poses: FloatArray, local: FloatArray, lag: int) -> FloatArray:
    """Covariances (n - lag, 6, 6) of motions over so many poses, of those of the poses alone.

    Assumed is what dead reckoning does: what is added on the way is independent of what was before.
    NaN where the covariance does not grow so, and the assumption cannot hold.
    """
    back = inverse(poses[lag:]) @ poses[:-lag]
    added = local[lag:] - change_tangent_frame(back, local[:-lag])
    lowest = np.linalg.eigvalsh(np.nan_to_num(added))[:, 0]
    grows = lowest >= -1e-9 * np.trace(np.nan_to_num(local[lag:]), axis1=1, axis2=2)
    return np.where(grows[:, None, None], added, np.nan)


def turned_axes(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Rotation (3, 3) from the estimate's axes to the truth's, where paths agree only with it.

    One has a camera's axes, the other a robot's (REP 103); else the identity.
    """
    rows, of = associate(estimate.timestamps, truth.timestamps)
    pairs = (estimate.poses[rows], truth.poses[of])
    ours, true = ((inverse(poses[0]) @ poses)[:, :3, 3] for poses in pairs)
    robot = BODY_FORWARD_LEFT_UP_FROM_CAMERA[:3, :3]
    choices = (np.eye(3), robot, robot.T)
    misfits = [float(np.square(ours - true @ axes).sum()) for axes in choices]
    best = int(np.argmin(misfits))
    return choices[best] if misfits[best] < _TURNED * misfits[0] else choices[0]


def independent_count(values: FloatArray) -> float:
    """How many independent values scatter as the mean of a correlated series (n,) does, 1 to n.

    By the sum of its autocorrelations, pair by pair while positive (Geyer 1992, initial positive
    sequence).
    """
    n = len(values)
    centred = values - values.mean() if n else values
    if n < 4 or not (energy := float(centred @ centred)):
        return float(n)
    correlations = np.fft.irfft(np.abs(np.fft.rfft(centred, 2 * n)) ** 2)[: n - n % 2] / energy
    pairs = correlations.reshape(-1, 2).sum(axis=1)
    kept = np.logical_and.accumulate(pairs > 0.0)
    return float(np.clip(n / max(2.0 * pairs[kept].sum() - 1.0, 1.0), 1.0, n))


@dataclass(frozen=True, slots=True)
class Credibility:
    """Stated covariances against errors.

    Attributes:
        nees: of `pose`, `rotation` and `position`: NEES per degree of freedom, and the 95 % band of
            a consistent estimator for as many errors as are independent; None without any.
        sigma_factor: by which the stated deviations of each are to be multiplied.
        within_sigma: shares of errors along all axes within `1`, `2` and `3` stated deviations, of
            which a consistent estimator has 68.3, 95.4 and 99.7 %.
    """

    nees: Mapping[str, Consistency | None]
    sigma_factor: Mapping[str, float | None]
    within_sigma: Mapping[str, float]


def credibility(
    poses: FloatArray, local: FloatArray, truth: FloatArray, split: bool
) -> Credibility:
    """Of poses (n, 4, 4) with covariances (n, 6, 6) along their axes, by true ones of their world.

    ``split``: as :func:`tangent_errors`; rotation and position alone are always judged so.
    """
    whole, apart = tangent_errors(poses, truth)
    errors = apart if split else whole
    found = {
        "pose": nees(errors, local),
        "rotation": nees(apart[:, :3], local[:, :3, :3]),
        "position": nees(apart[:, 3:], local[:, 3:, 3:]),
    }
    judged = {
        name: judge([one], independent=independent_count(one.values[one.dof > 0]))
        for name, one in found.items()
    }
    factor = {name: float(np.sqrt(one.per_dof)) if one else None for name, one in judged.items()}
    shares = {str(k): float(np.nanmean(within(errors, local, k))) for k in (1, 2, 3)}
    return Credibility(judged, factor, shares)
