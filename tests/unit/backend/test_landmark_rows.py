"""Rows of landmarks against a plain dictionary of them."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.backend.filters.kalman import LandmarkRows
from fgslam.core.arrays import IntArray
from fgslam.core.types import LandmarkMap


def fill(rows: LandmarkRows, ids: IntArray, rng: np.random.Generator, home: int) -> None:
    rows.add(ids, rng.standard_normal((len(ids), 3)), rng.standard_normal((len(ids), 3, 3)), home)


def test_rows_hold_the_landmarks_added_and_not_removed(rng: np.random.Generator) -> None:
    rows, known = LandmarkRows(), {}
    for step in range(60):
        some = rng.choice(5000, size=rng.integers(0, 90), replace=False)
        new = np.sort(some[~np.isin(some, list(known))]) if step % 3 else some
        new = new[~np.isin(new, list(known))]
        fill(rows, new, rng, step)
        for i in new.tolist():
            row = rows.rows(np.array([i]))[0]
            known[i] = (rows.positions[row].copy(), rows.covariances[row].copy(), step)
        gone = rng.permutation(list(known))[: rng.integers(0, 40)].astype(np.int64)
        rows.remove(gone)
        for i in gone.tolist():
            del known[i]
        ids = sorted(known)
        assert rows.ids.tolist() == ids
        assert len(rows) == len(ids)
        for array, at in ((rows.positions, 0), (rows.covariances, 1), (rows.homes, 2)):
            expected = np.array([known[i][at] for i in ids])
            np.testing.assert_array_equal(array, expected.reshape(array.shape))
    assert len(rows) > 1024  # it has grown
    assert (rows.counts == 1).all()


def test_an_unknown_landmark_is_a_key_error(rng: np.random.Generator) -> None:
    rows = LandmarkRows()
    fill(rows, np.array([3, 8, 11]), rng, 0)
    with pytest.raises(KeyError):
        rows.remove(np.array([8, 9]))
    with pytest.raises(KeyError):
        rows.rows(np.array([12]))
    assert rows.ids.tolist() == [3, 8, 11]


def test_written_rows_are_the_landmarks(rng: np.random.Generator) -> None:
    rows = LandmarkRows()
    fill(rows, np.array([3, 8, 11]), rng, 0)
    rows.positions[rows.rows(np.array([8]))] = 7.0
    rows.counts[1] += 4
    np.testing.assert_array_equal(rows.map().positions[1], [7.0, 7.0, 7.0])
    assert rows.counts.tolist() == [1, 5, 1]


def test_loading_copies(rng: np.random.Generator) -> None:
    given = LandmarkMap(
        np.array([2, 5]), rng.standard_normal((2, 3)), rng.standard_normal((2, 3, 3))
    )
    before = given.positions.copy()
    rows = LandmarkRows()
    fill(rows, np.array([1, 2, 3]), rng, 0)
    rows.load(given, np.array([4, 6]), np.array([-1, 9]), np.array([3, 9]))
    rows.positions[:] = 0.0
    np.testing.assert_array_equal(given.positions, before)
    assert rows.ids.tolist() == [2, 5]
    assert rows.counts.tolist() == [4, 6]
    assert rows.homes.tolist() == [-1, 9]
