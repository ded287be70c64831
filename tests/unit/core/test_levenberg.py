"""Damping: none where none is needed, more until the cost falls, less from step to step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.linalg import LinAlgError

from fgslam.core.least_squares import Damping


def tried(needed: float, dampings: list[float]) -> Callable[[float], tuple[float, str]]:
    """An attempt that lowers the cost by one where it is damped by what is needed."""

    def attempt(damping: float) -> tuple[float, str]:
        dampings.append(damping)
        return (9.0, "lower") if damping >= needed else (11.0, "higher")

    return attempt


def test_a_step_that_lowers_the_cost_is_not_damped() -> None:
    dampings: list[float] = []
    assert Damping().step(10.0, tried(0.0, dampings)) == (9.0, "lower")
    assert dampings == [0.0]


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
