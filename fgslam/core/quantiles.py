"""Quantiles of the distributions that bounds and gates come from.

The same bits as ``scipy.stats`` gives, whose import takes longer than that of all of fgslam.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv, stdtrit

from fgslam.core.arrays import FloatArray


def chi_square_quantile(probability: ArrayLike, dof: ArrayLike) -> FloatArray:
    """Values that a chi-square variable of ``dof`` degrees stays below with that probability."""
    return np.asarray(2.0 * gammaincinv(np.asarray(dof) / 2.0, probability))


def middle(values: FloatArray) -> float:
    """The median of some numbers (n,), to the bit that of NumPy in a fifth of its time."""
    n = len(values)
    if not n:
        return math.nan
    ordered = np.partition(values, ((n - 1) // 2, n // 2, n - 1))
    if math.isnan(ordered[-1]):
        return math.nan
    return float((ordered[(n - 1) // 2] + ordered[n // 2]) / 2.0)


def student_quantile(probability: ArrayLike, dof: ArrayLike) -> FloatArray:
    """Values that a Student's t variable of ``dof`` degrees stays below with that probability."""
    return np.asarray(stdtrit(dof, probability))
