"""Quantiles have the bits of scipy.stats."""

from __future__ import annotations

import numpy as np
from scipy import stats

from fgslam.core.arrays import chi_square_quantile, student_quantile


def test_quantiles_are_those_of_scipy_to_the_bit() -> None:
    probabilities = np.array([1e-6, 0.0005, 0.025, 0.5, 0.6827, 0.975, 0.99, 0.999])
    for dof in (1, 2, 3, 6, 7.5, 150, 2880):
        np.testing.assert_array_equal(
            chi_square_quantile(probabilities, dof), stats.chi2.ppf(probabilities, dof)
        )
        np.testing.assert_array_equal(
            student_quantile(probabilities, dof), stats.t.ppf(probabilities, dof)
        )
    dofs = np.array([3, 6, 12])
    np.testing.assert_array_equal(chi_square_quantile(0.99, dofs), stats.chi2.ppf(0.99, dofs))
