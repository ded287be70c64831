"""Paired tests of two estimators over trials with the same noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.quantiles import student_quantile


@dataclass(frozen=True, slots=True)
class MeanInterval:
    """Mean of independent trials and its confidence interval by Student's t.

    Attributes:
        mean: of the values.
        lower, upper: of the interval; None for fewer than two values.
        count: how many values.
        probability: of the interval.
    """

    mean: float
    lower: float | None
    upper: float | None
    count: int
    probability: float


@dataclass(frozen=True, slots=True)
class PairedTest:
    """Values of A minus values of B, pair by pair; smaller is better.

    Attributes:
        difference: mean and interval of A - B: below zero, A is better.
        wins, losses: pairs in which A, B is the smaller; the rest are ties.
        p_value: Wilcoxon's signed-rank test, two-sided; None where all pairs are ties.
        ratio: mean of A over mean of B; None where that is zero.
    """

    difference: MeanInterval
    wins: int
    losses: int
    p_value: float | None
    ratio: float | None


def mean_interval(values: FloatArray, probability: float = 0.95) -> MeanInterval | None:
    """Mean and interval of finite values (n,); None where there is none."""
    known = values[np.isfinite(values)]
    n = len(known)
    if n == 0:
        return None
    mean = float(known.mean())
    if n == 1:
        return MeanInterval(mean, None, None, 1, probability)
    error = float(known.std(ddof=1)) / np.sqrt(n)
    half = float(student_quantile(0.5 + 0.5 * probability, n - 1)) * error
    return MeanInterval(mean, mean - half, mean + half, n, probability)


def paired_test(a: FloatArray, b: FloatArray, probability: float = 0.95) -> PairedTest | None:
    """Compares values (n,) of A and B on the same trials; pairs with an unknown value are left out.

    Returns:
        The comparison, or None where no pair is known.
    """
    known = np.isfinite(a) & np.isfinite(b)
    a, b = a[known], b[known]
    difference = mean_interval(a - b, probability)
    if difference is None:
        return None
    from scipy.stats import wilcoxon  # a second, and only trials need it

    p_value = float(wilcoxon(a, b).pvalue) if np.any(a != b) else None
    ratio = float(a.mean() / b.mean()) if b.mean() != 0.0 else None
    wins, losses = int(np.count_nonzero(a < b)), int(np.count_nonzero(a > b))
    return PairedTest(difference, wins, losses, p_value, ratio)
