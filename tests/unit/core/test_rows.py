"""Values of rows: choice, concatenation, shared and unknown fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.rows import Rows


@dataclass(frozen=True, slots=True, eq=False)
class Points(Rows):
    SHARED: ClassVar[frozenset[str]] = frozenset({"time"})

    time: float
    ids: IntArray
    xy: FloatArray
    colour: IntArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Pairs(Rows):
    first: Points
    weight: FloatArray


def points(n: int, colour: bool = True) -> Points:
    colours = np.arange(n) * 10 if colour else None
    return Points(3.5, np.arange(n), np.arange(2.0 * n).reshape(n, 2), colours)


@pytest.mark.parametrize("keep", [np.array([True, False, True]), np.array([0, 2])])
def test_select_takes_the_same_rows_of_every_array(keep: np.ndarray) -> None:
    some = points(3).select(keep)
    assert len(some) == 2
    assert some.ids.tolist() == [0, 2]
    assert some.xy.tolist() == [[0.0, 1.0], [4.0, 5.0]]
    assert some.colour is not None
    assert some.colour.tolist() == [0, 20]


def test_shared_fields_hold_for_all_rows_and_unknown_ones_stay_unknown() -> None:
    some = points(3, colour=False).select(np.array([1]))
    assert some.time == 3.5
    assert some.colour is None
    assert points(2).join(points(1, colour=False)).colour is None


def test_select_keeps_the_given_order() -> None:
    assert points(3).select(np.array([2, 0, 2])).ids.tolist() == [2, 0, 2]


def test_join_appends_rows_and_leaves_its_parts_alone() -> None:
    a, b = points(2), points(1)
    both = a.join(b)
    assert both.ids.tolist() == [0, 1, 0]
    assert both.xy.shape == (3, 2)
    assert (len(a), len(b)) == (2, 1)


def test_rows_of_rows_are_chosen_and_joined_with_them() -> None:
    pairs = Pairs(points(3), np.array([1.0, 2.0, 3.0]))
    assert pairs.select(np.array([2])).first.ids.tolist() == [2]
    assert len(pairs.join(pairs).first) == 6
