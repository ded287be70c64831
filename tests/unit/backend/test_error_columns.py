"""Columns of errors: whatever comes and goes, each landmark has its own, and where it was."""

from __future__ import annotations

import numpy as np

from fgslam.backend.considered import ErrorColumns
from fgslam.core.store import restore, state_of

_COUNT = 4


def test_columns_are_their_landmarks_whatever_comes_and_goes() -> None:
    rng = np.random.default_rng(3)
    columns, expected = ErrorColumns(_COUNT), dict[int, np.ndarray]()
    for _ in range(60):
        gone = rng.permutation(sorted(expected))[: rng.integers(0, 9)]
        columns.forget(np.sort(gone).astype(np.int64))
        for identity in gone.tolist():
            del expected[identity]
        ids = np.setdiff1d(rng.integers(0, 200, rng.integers(0, 12)), sorted(expected))
        gain = rng.standard_normal((len(ids), 3, _COUNT))
        columns.append({"ids": ids, "gain": gain})
        expected |= dict(zip(ids.tolist(), gain, strict=True))
        state = state_of(columns)
        assert state["order/ids"].tolist() == sorted(expected)
        kept = state["map/gain"][state["order/row"]]
        assert np.array_equal(kept, [expected[i] for i in sorted(expected)])
    again = ErrorColumns(_COUNT)
    again.append({"ids": np.array([7]), "gain": np.ones((1, 3, _COUNT))})
    restore(again, state)
    asked = np.array([*sorted(expected), 999])
    found = [*(expected[i] for i in sorted(expected)), np.zeros((3, _COUNT))]
    assert np.array_equal(again.kept("gain", asked), found)


def test_what_comes_and_goes_moves_no_other_landmark_and_takes_the_room_that_is_free() -> None:
    """So a frame costs what it sees, not what the map holds."""
    columns = ErrorColumns(_COUNT)
    columns.append({"ids": np.arange(100), "gain": np.zeros((100, 3, _COUNT))})
    kept = np.arange(50, 100)
    before = columns.rows(kept)[0]
    columns.forget(np.arange(0, 50, 2))
    columns.append({"ids": np.arange(100, 125), "gain": np.ones((25, 3, _COUNT))})
    columns.append({"ids": np.array([0]), "gain": np.ones((1, 3, _COUNT))})
    assert np.array_equal(columns.rows(kept)[0], before)
    assert len(state_of(columns)["map/gain"]) == 101
