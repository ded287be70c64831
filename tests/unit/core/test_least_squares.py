"""Gauss-Newton over many problems: the minimum of each, whatever the others do."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.linalg import LinAlgError
from scipy.optimize import least_squares

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import Damping, GaussNewton, Linearised

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


# --------------------------------------------------------------------------------------------
# Damping: none where none is needed, more until the cost falls, less from step to step


def tried(needed: float, dampings: list[float]) -> Callable[[float], tuple[float, str]]:
    """An attempt that lowers the cost by one where it is damped by what is needed."""

    def attempt(damping: float) -> tuple[float, str]:
        dampings.append(damping)
        return (9.0, "lower") if damping >= needed else (11.0, "higher")

    return attempt


def test_damping_grows_until_the_cost_falls() -> None:
    dampings: list[float] = []
    damping = Damping()
    damping.step(10.0, tried(0.5, dampings))
    np.testing.assert_allclose(dampings, [0.0, 1e-3, 1e-2, 1e-1, 1.0], rtol=0, atol=1e-12)
    assert damping.last == dampings[-1]


def test_damping_falls_from_step_to_step_and_ends_at_none() -> None:
    # Tried undamped in vain at each step and then damped as before, a minimum is crept up to.
    dampings: list[float] = []
    damping = Damping(1e-4)
    damping.step(10.0, tried(1e-3, []))
    for _ in range(3):
        damping.step(10.0, tried(0.0, dampings))
    np.testing.assert_allclose(dampings, [1e-4, 0.0, 0.0], rtol=0, atol=1e-12)


def test_a_system_that_cannot_be_solved_is_damped() -> None:
    def attempt(damping: float) -> tuple[float, str]:
        if damping < 0.05:
            raise LinAlgError("open")
        return 9.0, "lower"

    assert Damping().step(10.0, attempt) == (9.0, "lower")


def test_nothing_comes_of_steps_that_all_raise_the_cost() -> None:
    assert Damping().step(10.0, lambda damping: (11.0, "higher")) is None
