"""Values of arrays: brief texts, rows, columns that grow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import stats

from fgslam.core.arrays import (
    FloatArray,
    GrowingColumns,
    IntArray,
    Rows,
    chi_square_quantile,
    student_quantile,
)
from fgslam.core.store import pack, unpack
from fgslam.core.types import Trajectory


def test_arrays_are_shown_by_their_shapes() -> None:
    trajectory = Trajectory(np.arange(51.0), np.tile(np.eye(4), (51, 1, 1)))
    shapes = "timestamps=array(51), poses=array(51, 4, 4), frame='right'"
    assert repr(trajectory) == f"Trajectory({shapes})"


# --------------------------------------------------------------------------------------------
# Rows: choice, concatenation, shared and unknown fields


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


# --------------------------------------------------------------------------------------------
# Columns that grow


STEPS = st.lists(st.tuples(st.integers(0, 90), st.floats(0.0, 1.0)), max_size=12)


@given(STEPS)
def test_growing_columns_equal_plain_arrays(steps) -> None:
    columns = GrowingColumns(name=np.empty(0, np.int64), pair=np.empty((0, 2), np.float32))
    names, pairs = np.empty(0, np.int64), np.empty((0, 2), np.float32)
    rng = np.random.default_rng(0)
    for count, share in steps:
        new = rng.integers(0, 1000, count)
        more = rng.random((count, 2)).astype(np.float32)
        columns.append({"name": new, "pair": more})
        names, pairs = np.concatenate([names, new]), np.concatenate([pairs, more])
        gone = rng.random(len(names)) < share
        columns.drop(gone)
        names, pairs = names[~gone], pairs[~gone]
        assert len(columns) == len(names)
        np.testing.assert_array_equal(columns["name"], names)
        np.testing.assert_array_equal(columns["pair"], pairs)
    assert columns["pair"].dtype == np.float32
    assert sum(column.nbytes for column in columns.packed().values()) == 16 * len(columns)


def test_a_snapshot_is_not_touched_by_what_follows() -> None:
    columns = GrowingColumns(name=np.empty(0, np.int64))
    columns.append({"name": np.arange(5)})
    state = pack(columns)
    columns["name"][:] = 7
    columns.drop(np.array([True, False, False, False, False]))
    assert state["name"].tolist() == [0, 1, 2, 3, 4]
    back = unpack(state, GrowingColumns)
    assert back["name"].tolist() == [0, 1, 2, 3, 4]
    back["name"][0] = 9
    assert state["name"][0] == 0


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
