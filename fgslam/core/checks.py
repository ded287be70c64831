"""Checks of values that callers of the library give: numbers, times, seeds."""

from __future__ import annotations

import math
from numbers import Integral

import numpy as np

from fgslam.core.errors import ConfigError, FgslamError

_LATEST_S = 1e11  # three thousand years: of a clock since 1970 in seconds, but not in milliseconds


def is_finite_number(value: object) -> bool:
    """Whether a value is a finite real number; truth values are none."""
    number = isinstance(value, int | float | np.integer | np.floating)
    return number and not isinstance(value, bool) and math.isfinite(float(value))  # type: ignore[arg-type]


def later_time(time: object, last: float | None, what: str, error: type[FgslamError]) -> float:
    """The time in seconds; raises ``error`` where it is none, or not after ``last`` (None: any).

    Nanoseconds and milliseconds of a clock since 1970 are none.
    """
    try:
        if isinstance(time, str):
            raise TypeError("text")
        seconds = float(time)  # type: ignore[arg-type]  # what is no number raises
    except (TypeError, ValueError, OverflowError):
        large = hasattr(time, "__len__") and not isinstance(time, str)  # an image, say
        given = f"of type {type(time).__name__}" if large else repr(time)
        raise error(f"{what}: the time stamp {given} is not a number; give seconds") from None
    if not math.isfinite(seconds):
        raise error(f"{what}: the time stamp {seconds} is not finite; give seconds")
    if abs(seconds) > _LATEST_S:
        raise error(
            f"{what}: the time stamp {seconds:.0f} is no time in seconds; divide nanoseconds by "
            "1e9, milliseconds by 1e3"
        )
    if last is not None and not seconds > last:
        raise error(
            f"{what}: the time stamp {seconds:.9f} s does not come after {last:.9f} s; give images "
            "in the order of their times, each once"
        )
    return seconds


def require_flag(value: object, what: str) -> None:
    """Raises ConfigError for what is neither true nor false."""
    if not isinstance(value, bool | np.bool_):
        given = f"a {type(value).__name__}" if hasattr(value, "__len__") else repr(value)
        raise ConfigError(f"{what} is {given}; give True or False")


def require_seed(seed: object, where: str) -> None:
    """Raises ConfigError where a random generator cannot begin with it."""
    if not isinstance(seed, Integral) or isinstance(seed, bool) or seed < 0:
        raise ConfigError(f"{where}: seed is {seed!r}; give a whole number, 0 or larger")
