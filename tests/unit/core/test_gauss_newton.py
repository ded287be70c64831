"""Gauss-Newton over many problems: the minimum of each, whatever the others do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from fgslam.core.arrays import FloatArray
from fgslam.core.least_squares import GaussNewton, Linearised

TIMES = np.linspace(0.0, 2.0, 30)
TRUE = np.array([[2.0, 0.7], [0.5, 1.5]])
NOISY = TRUE[:, :1] * np.exp(-TRUE[:, 1:] * TIMES)
NOISY = NOISY + 0.05 * np.random.default_rng(0).standard_normal(NOISY.shape)


def curve(unknowns: FloatArray) -> FloatArray:
    """(c, 30) decaying exponentials of amplitudes and rates (c, 2)."""
    return np.asarray(unknowns[:, :1] * np.exp(-unknowns[:, 1:] * TIMES))


def linearised(unknowns: FloatArray, measured: FloatArray) -> Linearised:
    residual = curve(unknowns) - measured
    by = np.stack([curve(unknowns) / unknowns[:, :1], -TIMES * curve(unknowns)], axis=1)
    return by @ by.transpose(0, 2, 1), (by @ residual[:, :, None])[:, :, 0]


def test_each_problem_reaches_the_minimum_that_scipy_finds() -> None:
    def both(unknowns: FloatArray, iteration: int) -> Linearised:
        return linearised(unknowns, NOISY)

    found = GaussNewton(50, 0.0).minimise(np.ones((2, 2)), both)
    for row, measured in zip(found, NOISY, strict=True):
        wanted = least_squares(
            lambda x, m=measured: curve(x[None])[0] - m,
            np.ones(2),
            ftol=1e-15,
            xtol=1e-15,
            gtol=1e-15,
        )
        np.testing.assert_allclose(row, wanted.x, rtol=0, atol=1e-7)


def test_a_problem_that_is_done_is_left_out() -> None:
    seen: list[int] = []

    def towards_zero(unknowns: FloatArray, iteration: int) -> Linearised:
        seen.append(len(unknowns))
        return np.ones((len(unknowns), 1, 1)), 0.5 * unknowns

    start = np.array([[1e-6], [1.0]])
    found = GaussNewton(100, 1e-3).minimise(start, towards_zero)
    assert seen[:2] == [2, 1]
    assert len(seen) == 10  # 0.5 ** 10 is the first step below 1e-3
    np.testing.assert_allclose(found[:, 0], [0.5e-6, 0.5**10], rtol=1e-12)


@pytest.mark.parametrize(("settling", "calls"), [(0, 1), (3, 4)])
def test_no_problem_ends_during_the_settling_iterations(settling: int, calls: int) -> None:
    seen: list[int] = []

    def at_rest(unknowns: FloatArray, iteration: int) -> Linearised:
        seen.append(iteration)
        return np.ones((1, 1, 1)), np.zeros((1, 1))

    GaussNewton(9, 1e-3, settling=settling).minimise(np.zeros((1, 1)), at_rest)
    assert seen == list(range(calls))


def test_steps_are_limited_and_open_unknowns_stay() -> None:
    def slope(unknowns: FloatArray, iteration: int) -> Linearised:
        hessian = np.diag([1.0, 0.0])[None]
        return hessian, np.column_stack([unknowns[:, 0] - 10.0, np.zeros(1)])

    search = GaussNewton(3, 1e-9, longest=0.5, damping=1e-9)
    np.testing.assert_allclose(search.minimise(np.zeros((1, 2)), slope), [[1.5, 0.0]], atol=1e-12)


def test_the_first_guess_is_left_alone() -> None:
    start = np.ones((1, 1))
    GaussNewton(1, 0.0).minimise(start, lambda x, _: (np.ones((1, 1, 1)), x))
    assert start[0, 0] == 1.0
