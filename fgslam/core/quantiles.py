"""Quantiles of the distributions that bounds and gates come from.

The same bits as ``scipy.stats`` gives, whose import takes longer than that of all of fgslam.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv, stdtrit

from fgslam.core.arrays import FloatArray


def chi_square_quantile(probability: ArrayLike, dof: ArrayLike) -> FloatArray:
    """Values that a chi-square variable of ``dof`` degrees stays below with that probability."""
    return np.asarray(2.0 * gammaincinv(np.asarray(dof) / 2.0, probability))


def student_quantile(probability: ArrayLike, dof: ArrayLike) -> FloatArray:
    """Values that a Student's t variable of ``dof`` degrees stays below with that probability."""
    return np.asarray(stdtrit(dof, probability))
