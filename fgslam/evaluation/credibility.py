"""Whether stated covariances are credible: their tangent space, NEES, coverage and what mends them.

The error of a pose is, by tangent space (Jung and Weiss 2022 call them types 1, 2, 5 and 6):

* ``local``: ``T = T_est Exp(xi)``, as in GTSAM and here; ``global``: ``T = Exp(xi) T_est``;
* ``split_local``: ``R = R_est Exp(theta)``, ``t = t_est + dt`` along the world's axes, as in
  OpenVINS; ``split_global``: the same with ``R = Exp(theta) R_est``, as ROS defines its messages.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import adjoint, inverse, se3_log, so3_log
from fgslam.core.types import LAGS, Trajectory
from fgslam.evaluation.statistics import (
    Consistency,
    Nees,
    associate,
    judge,
    nees,
    pose_errors,
    to_estimate_world,
    within,
)

_LIKELIER = 6.0
"""Log likelihood ratio from which the data decide, 400 to 1: of a few slow errors, as a drift has,
20 to 1 came about by chance in one of eight simulated drives."""
_GROWN = 0.9  # share of steps
_FEWEST = 10  # poses: fewer decide nothing
_EXCLUDED = 1e-4  # of the mean variance of all axes: what lies below is no uncertainty
_CLEARLY = 0.25  # of the misfit of motions, below which turned axes are taken
_STRAIGHT = 0.1  # radians
_OFF = 3.0  # deviation of the logarithm of the variance by which estimators are off
_PER_RADIAN = np.degrees(1.0)


@dataclass(frozen=True, slots=True)
class Tangent:
    """What the numbers of a pose's covariance are of: order, space, unit of rotations."""

    order: str = "rotation_first"
    space: str = "local"
    unit: str = "radians"

    def __str__(self) -> str:
        degrees = ", degrees" if self.unit == "degrees" else ""
        return f"{self.order}, {self.space}{degrees}"

    def ordered(self, covariances: FloatArray) -> FloatArray:
        """(n, 6, 6) [rotation, translation] in radians and metres, still in its own space."""
        at = np.arange(6) if self.order == "rotation_first" else np.array([3, 4, 5, 0, 1, 2])
        scale = np.repeat([1.0 / _PER_RADIAN if self.unit == "degrees" else 1.0, 1.0], 3)
        return covariances[:, at[:, None], at] * np.outer(scale, scale)

    def errors(self, estimate: FloatArray, truth: FloatArray) -> FloatArray:
        """(n, 6) errors [rotation, translation] in its space, of poses (n, 4, 4) in one world."""
        split, world = self.space.startswith("split"), self.space.endswith("global")
        off = truth @ inverse(estimate) if world else inverse(estimate) @ truth
        if not split:
            return np.array([se3_log(motion) for motion in off]).reshape(-1, 6)
        turns = np.array([so3_log(motion[:3, :3]) for motion in off]).reshape(-1, 3)
        return np.hstack([turns, truth[:, :3, 3] - estimate[:, :3, 3]])

    def to_local(self, poses: FloatArray, covariances: FloatArray) -> FloatArray:
        """Stated covariances (n, 6, 6) in the tangent space at poses, [rotation, translation]."""
        change = np.tile(np.eye(6), (len(poses), 1, 1))
        bRw = np.swapaxes(poses[:, :3, :3], 1, 2)
        if self.space == "global":
            change = adjoint(inverse(poses))
        elif self.space != "local":
            change[:, 3:, 3:] = bRw
            if self.space == "split_global":
                change[:, :3, :3] = bRw
        return np.asarray(change @ self.ordered(covariances) @ np.swapaxes(change, 1, 2))


@dataclass(frozen=True, slots=True)
class Guess:
    """A tangent space and how it is known.

    Attributes:
        tangent: which is taken.
        how: in words.
        guessed: whether a part of it is stated nowhere.
        fitting: one that fits the errors decisively better; None: there is none.
    """

    tangent: Tangent
    how: str
    guessed: bool
    fitting: Tangent | None = None


def guess_tangent(
    estimate: Trajectory,
    covariances: FloatArray,
    truth: Trajectory,
    words: frozenset[str],
    usual: str,
) -> Guess:
    """The tangent space in which the errors are likeliest, of those that the words leave open.

    Errors are taken as normal with the stated covariance times one factor, which is estimated and
    hardly more than 400; a log likelihood counts as many errors as are independent. Of what is not
    far less likely than the best, those are kept in which covariances only grow, as by dead
    reckoning, if there are any; of these the ``usual`` space, else the likeliest. Degrees are taken
    only where they are far likelier.
    """
    spaces = ("local", "global", "split_local", "split_global")
    choices = [
        Tangent(order, space, unit)
        for unit in ("radians", "degrees")
        for order in ("rotation_first", "translation_first")
        for space in spaces
    ]
    allowed = [c for c in choices if words <= {c.order, c.space, c.unit}]
    found = to_estimate_world(estimate, truth)
    rows, true = (found[0][1:], found[1][1:]) if found else (np.empty(0, int), np.empty((0, 4, 4)))
    poses, stated = estimate.poses[rows], covariances[rows]
    errors = {space: Tangent(space=space).errors(poses, true) for space in spaces}
    fits = [_misfit(one, errors[one.space], stated) for one in choices]
    many = len(rows) >= _FEWEST
    count = min(independent_count(series) for *_, series in fits) if many else 0.0
    # Rounded, so that of equals the first is taken.
    cost = {
        one: round(count * misfit + 0.5 * (factor / _OFF) ** 2, 9)
        for one, (misfit, factor, _) in zip(choices, fits, strict=True)
    }

    def decides(better: Tangent, other: Tangent) -> bool:
        return cost[other] - cost[better] > _LIKELIER

    overall = min(choices, key=cost.__getitem__)
    radians = [one for one in allowed if one.unit == "radians"]
    if radians and (
        overall.unit == "radians" or not decides(overall, min(radians, key=cost.__getitem__))
    ):
        allowed = radians
    best = min(allowed, key=cost.__getitem__)
    likely = [one for one in allowed if not decides(best, one)]
    grown = [one for one in likely if _grows(one, estimate.poses, covariances)]
    kept = grown or likely
    taken = min([c for c in kept if c.space == usual] or kept, key=cost.__getitem__)
    fitting = overall if decides(overall, taken) else None
    if len({(c.order, c.space) for c in allowed}) == 1:
        return Guess(taken, "stated", False, fitting)
    others = [str(one) for one in dict.fromkeys((*kept, overall)) if one != taken][:3]
    doubt = f", not surely: perhaps {' or '.join(others)}" if others else ""
    why = "covariances grow as those of dead reckoning, " if 0 < len(grown) < len(likely) else ""
    return Guess(taken, f"guess: {why}the likeliest given the errors{doubt}", True, fitting)


def _grows(tangent: Tangent, poses: FloatArray, stated: FloatArray) -> bool:
    """Whether covariances grow as by dead reckoning in this space, by no negative covariance."""
    local = tangent.to_local(poses, stated)
    found = accumulated(poses, local).get(1, np.full((1, 6, 6), np.nan))
    gained, had = (np.trace(c, axis1=1, axis2=2) for c in (found, local[1:]))
    return bool((gained > 1e-6 * had).mean() > _GROWN)


def _misfit(
    tangent: Tangent, errors: FloatArray, stated: FloatArray
) -> tuple[float, float, FloatArray]:
    """Negative log likelihood a pose without what all share, log of the factor, and NEES (n,)."""
    covariances = tangent.ordered(stated)
    # What a covariance excludes, as motion off a floor, has no say but where it is contradicted.
    usual = (
        np.nanmean(np.diagonal(covariances, axis1=1, axis2=2), axis=0).reshape(2, 3).mean(axis=1)
    )
    found = nees(errors, covariances + _EXCLUDED * np.diag(np.repeat(usual, 3)))
    known = found.dof > 0
    if not known.any():
        return 0.0, 0.0, np.zeros(1)
    turns, steps = (  # directions that are uncertain
        float((spread > _EXCLUDED * spread[:, -1:]).sum(axis=1).mean())
        for spread in map(
            np.linalg.eigvalsh, (covariances[known, :3, :3], covariances[known, 3:, 3:])
        )
    )
    dof = turns + steps
    mean = max(float(found.values[known].mean()) / max(dof, 1.0), np.finfo(float).tiny)
    unit = 2.0 * turns * np.log(_PER_RADIAN) if tangent.unit == "degrees" else 0.0
    factor = float(np.log(mean))
    return 0.5 * (dof * factor - unit), factor, found.values[known]


def turned_axes(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Rotation (3, 3) from the estimate's axes to the truth's: each along one of the others.

    Cameras look along z, robots drive along x. Other than the identity only where the motions of
    both agree far better so.
    """
    rows, of = associate(estimate.timestamps, truth.timestamps)
    ours, true = (
        pose_errors(np.broadcast_to(poses[0], poses.shape), poses)
        for poses in (estimate.poses[rows], truth.poses[of])
    )
    # Of a straight drive the turns are noise.
    turned = float((true[:, :3] ** 2).sum()) + len(rows) * _STRAIGHT**2
    moved = max(float((true[:, 3:] ** 2).sum()), 1e-9)
    signed = (
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    )
    axes: list[FloatArray] = [one for one in signed if np.linalg.det(one) > 0.0]  # identity first
    misfits = [
        float(((ours[:, :3] - true[:, :3] @ one) ** 2).sum() / turned)
        + float(((ours[:, 3:] - true[:, 3:] @ one) ** 2).sum() / moved)
        for one in axes
    ]
    best = int(np.argmin(misfits))
    return axes[best] if misfits[best] < _CLEARLY * misfits[0] else axes[0]


def independent_count(values: FloatArray) -> float:
    """How many independent values scatter as the mean of a correlated series (n,) does, 1 to n.

    By the sum of its autocorrelations, pair by pair while positive (Geyer 1992, initial positive
    sequence).
    """
    n = len(values)
    centred = values - values.mean() if n else values
    if n < 4 or not (energy := float(centred @ centred)):
        return float(n)
    spectrum = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    correlations = np.fft.irfft(spectrum)[: n - n % 2] / energy
    pairs = correlations.reshape(-1, 2).sum(axis=1)
    kept = pairs[: int(np.argmax(pairs <= 0.0)) if (pairs <= 0.0).any() else len(pairs)]
    return float(np.clip(n / max(2.0 * kept.sum() - 1.0, 1.0), 1.0, n))


def accumulated(poses: FloatArray, covariances: FloatArray) -> Mapping[int, FloatArray]:
    """Covariances of motions by :data:`LAGS`, as an Estimate has them, of marginals alone.

    Assumed is what dead reckoning does: what is added on the way is independent of what was before.
    NaN where the covariance does not grow so, and the assumption cannot hold.
    """
    out = {}
    for lag in LAGS:
        if lag >= len(poses):
            break
        carried = adjoint(inverse(poses[lag:]) @ poses[:-lag])
        added = covariances[lag:] - carried @ covariances[:-lag] @ np.swapaxes(carried, 1, 2)
        scale = np.trace(np.nan_to_num(covariances[lag:]), axis1=1, axis2=2)
        lowest = np.linalg.eigvalsh(np.nan_to_num(added))[:, 0]
        grows = np.isfinite(added).all(axis=(1, 2)) & (lowest >= -1e-9 * scale)
        out[lag] = np.where(grows[:, None, None], added, np.nan)
    return out


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
    tangent: Tangent, poses: FloatArray, stated: FloatArray, truth: FloatArray
) -> Credibility:
    """Of poses (n, 4, 4) whose stated covariances (n, 6, 6) are in a tangent space of their own.

    Rotation and position are each judged as OpenVINS does: ``Log(R_est^T R)`` and ``t - t_est``.

    Args:
        tangent: which.
        poses: estimated.
        stated: their covariances, as stated.
        truth: (n, 4, 4) in the same world.
    """
    local = tangent.to_local(poses, stated)
    split = Tangent(space="split_local").errors(poses, truth)
    wRb = poses[:, :3, :3]
    found = {
        "pose": nees(tangent.errors(poses, truth), tangent.ordered(stated)),
        "rotation": nees(split[:, :3], local[:, :3, :3]),
        "position": nees(split[:, 3:], wRb @ local[:, 3:, 3:] @ np.swapaxes(wRb, 1, 2)),
    }
    judged = {name: _judged(one) for name, one in found.items()}
    factor = {name: float(np.sqrt(one.per_dof)) if one else None for name, one in judged.items()}
    errors = pose_errors(poses, truth)
    shares = {str(k): float(np.nanmean(within(errors, local, k))) for k in (1, 2, 3)}
    return Credibility(judged, factor, shares)


def _judged(found: Nees) -> Consistency | None:
    counted = found.dof > 0
    return judge([found], independent=independent_count(found.values[counted]))
