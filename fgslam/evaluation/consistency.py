"""Consistency: whether an estimator's covariances are as large as its errors (NEES).

The normalised estimation error squared (NEES) of a consistent estimator is chi-square with as
many degrees of freedom as the error has (Bar-Shalom, Li and Kirubarajan 2001, 5.4). Here it is
given per degree of freedom, so that 1 is right, more is overconfident, less is conservative.

Covariances may be singular: the first pose is known exactly, a planar robot has three degrees
of freedom, one of fixed height five. Such errors are evaluated on the subspace that the covariance
supports, and only its dimensions are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.geometry import inverse, se3_log
from fgslam.core.quantiles import chi_square_quantile

ConsistencyVerdict: TypeAlias = Literal["consistent", "overconfident", "conservative"]

# Directions whose variance is this much below the largest one (of radians and metres, which are
# of like size here) are constraints, not knowledge: a ratio of 1e5 in standard deviation.
_RELATIVE_RANK_TOLERANCE = 1e-10
_LEAST_SHARE = 1e-3  # of an axis that lies in that subspace: two degrees out of what is excluded


@dataclass(frozen=True, slots=True, eq=False)
class Nees:
    """Normalised errors squared of many items.

    Attributes:
        values: (n,) NEES, not divided by the degrees of freedom.
        dof: (n,) rank of each covariance; 0 where nothing was uncertain.
    """

    values: FloatArray
    dof: IntArray

    def __len__(self) -> int:
        return len(self.values)

    @property
    def per_dof(self) -> float | None:
        """Mean NEES per degree of freedom; None where there is none."""
        total = int(self.dof.sum())
        return float(self.values.sum() / total) if total else None


@dataclass(frozen=True, slots=True)
class Consistency:
    """NEES per degree of freedom beside the band in which a consistent one would lie.

    Attributes:
        per_dof: mean NEES per degree of freedom.
        lower, upper: the chi-square band, per degree of freedom.
        probability: of the band.
        items: how many errors were averaged.
        independent: how many of them the band took as independent.
        verdict: `consistent`, `overconfident` or `conservative`.
    """

    per_dof: float
    lower: float
    upper: float
    probability: float
    items: int
    independent: int
    verdict: ConsistencyVerdict


def nees(errors: FloatArray, covariances: FloatArray) -> Nees:
    """NEES of errors (n, d) with covariances (n, d, d), by pseudo-inverse on their support.

    Items with a value that is not finite are left out (0 degrees of freedom).
    """
    known = np.isfinite(errors).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    finite = np.asarray(known)
    symmetric = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    variances, directions = np.linalg.eigh(np.where(finite[:, None, None], symmetric, 0.0))
    largest = variances[:, -1:]
    supported = (variances > _RELATIVE_RANK_TOLERANCE * largest) & (largest > 0.0)
    components = np.einsum("nji,nj->ni", directions, np.where(finite[:, None], errors, 0.0))
    terms = np.divide(components**2, variances, out=np.zeros_like(variances), where=supported)
    return Nees(terms.sum(axis=1), supported.sum(axis=1))


def within(errors: FloatArray, covariances: FloatArray, sigmas: float = 2.0) -> FloatArray:
    """Shares (d,) of errors (n, d) within so many reported standard deviations, axis by axis.

    Of two, 95 % lie within where the errors are normal and the covariances right. Items with a
    value that is not finite are left out; NaN along an axis that was never uncertain, or leans
    towards an uncertain one by rounding alone, as on a floor that holds stiffly.
    """
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    largest = variances.max(axis=1, initial=0.0, keepdims=True)
    known = np.isfinite(errors).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    counted = np.asarray(known)[:, None] & (variances > _RELATIVE_RANK_TOLERANCE * largest)
    counted &= _in_support(np.where(counted.any(axis=1)[:, None, None], covariances, 0.0))
    held = counted & (errors**2 <= sigmas**2 * np.where(counted, variances, 0.0))
    number = counted.sum(axis=0)
    shares = np.full(len(number), np.nan)
    return np.asarray(np.divide(held.sum(axis=0), number, out=shares, where=number > 0))


def _in_support(covariances: FloatArray) -> BoolArray:
    """(n, d) axes that lie in the subspace of covariances (n, d, d), and not just beside it."""
    variances, directions = np.linalg.eigh(0.5 * (covariances + np.swapaxes(covariances, 1, 2)))
    supported = variances > _RELATIVE_RANK_TOLERANCE * variances[:, -1:]
    return np.asarray(np.einsum("nij,nj->ni", directions**2, supported) > _LEAST_SHARE)


def pose_errors(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Tangent vectors (n, 6) ``Log(estimate^-1 truth)``, [rotation, translation], radians, metres.

    Args:
        estimate: (n, 4, 4) poses ``wTc``.
        truth: (n, 4, 4) true poses in the *same* world (align the first pose before).
    """
    relative = inverse(estimate) @ truth
    return np.array([se3_log(motion) for motion in relative]).reshape(-1, 6)


def pose_nees(estimate: FloatArray, covariances: FloatArray, truth: FloatArray) -> Nees:
    """NEES of poses.

    Args:
        estimate: (n, 4, 4) poses ``wTc``.
        covariances: (n, 6, 6) in the tangent space at the estimate, [rotation, translation].
        truth: (n, 4, 4) true poses in the same world.
    """
    return nees(pose_errors(estimate, truth), covariances)


def landmark_nees(
    positions: FloatArray, covariances: FloatArray, true_positions: FloatArray
) -> Nees:
    """NEES of landmarks, all in the same world.

    Args:
        positions: (n, 3) metres.
        covariances: (n, 3, 3) metres squared.
        true_positions: (n, 3) metres; NaN where the truth is unknown (left out).
    """
    return nees(true_positions - positions, covariances)


def chi_square_band(dof: float, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band of a chi-square variable per degree of freedom: its quantiles over ``dof``."""
    tail = 0.5 * (1.0 - probability)
    lower, upper = chi_square_quantile([tail, 1.0 - tail], dof) / dof
    return float(lower), float(upper)


def judge(
    runs: Sequence[Nees], probability: float = 0.95, *, items_independent: bool = False
) -> Consistency | None:
    """NEES of one or more runs beside its chi-square band, and whether it lies inside.

    The errors within one run are correlated (each pose starts from the one before, all landmarks
    are seen from the same poses), so their mean scatters far more than that many independent
    ones would. By default each *run* counts as a single independent item of average dimension,
    which calls no consistent estimator inconsistent more often than the band says; many runs make
    the band narrow.

    Args:
        runs: NEES of independent runs (different seeds).
        probability: of the band.
        items_independent: count every item as independent, for errors that are (innovations,
            one frame of many runs).

    Returns:
        The comparison, or None when no run has a degree of freedom.
    """
    values = np.concatenate([run.values for run in runs]) if runs else np.empty(0)
    dof = np.concatenate([run.dof for run in runs]) if runs else np.empty(0, np.int64)
    items = int((dof > 0).sum())
    if items == 0:
        return None
    total = float(dof.sum())
    informative_runs = sum(bool(run.dof.any()) for run in runs)
    independent = items if items_independent else informative_runs
    lower, upper = chi_square_band(total * independent / items, probability)
    per_dof = float(values.sum()) / total
    return Consistency(
        per_dof, lower, upper, probability, items, independent, _verdict(per_dof, lower, upper)
    )


def _verdict(per_dof: float, lower: float, upper: float) -> ConsistencyVerdict:
    if per_dof > upper:
        return "overconfident"
    return "conservative" if per_dof < lower else "consistent"
