"""Arrays that grow and shrink together."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fgslam.core.growing_arrays import GrowingColumns

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
    assert columns.bytes_per_row() == 16


def test_a_snapshot_is_not_touched_by_what_follows() -> None:
    columns = GrowingColumns(name=np.empty(0, np.int64))
    columns.append({"name": np.arange(5)})
    state = columns.state()
    columns["name"][:] = 7
    columns.drop(np.array([True, False, False, False, False]))
    assert state["name"].tolist() == [0, 1, 2, 3, 4]
    columns.restore(state)
    assert columns["name"].tolist() == [0, 1, 2, 3, 4]
    columns["name"][0] = 9
    assert state["name"][0] == 0
