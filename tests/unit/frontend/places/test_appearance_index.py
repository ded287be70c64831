"""The index of descriptors: exact where small, near to it where large, the same for the same."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import ByteArray
from fgslam.frontend.features import vocabulary
from fgslam.frontend.places.relocalisation import appearance_index
from fgslam.frontend.places.relocalisation.appearance_index import AppearanceIndex, Neighbours
from tests.known_places import blurred, looks


def _truth(asked: ByteArray, held: ByteArray) -> np.ndarray:
    return np.linalg.norm(asked[:, None].astype(float) - held[None].astype(float), axis=2)


def _assert_equal(a: Neighbours, b: Neighbours) -> None:
    assert np.array_equal(a.rows, b.rows)
    assert np.array_equal(a.distances, b.distances)


def test_small_contents_are_answered_exactly(rng: np.random.Generator) -> None:
    held, asked = looks(rng, 300), looks(rng, 20)
    found = AppearanceIndex(held).query(asked, 5)
    exact = _truth(asked, held)
    order = np.argsort(exact, axis=1)[:, :5]
    assert np.allclose(found.distances, np.take_along_axis(exact, order, axis=1), rtol=1e-12)
    assert np.array_equal(found.rows, order)


def test_large_contents_are_answered_nearly(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(appearance_index, "_EXACT", 100)
    held = looks(rng, 4000)
    asked = blurred(held[:200], rng)
    found = AppearanceIndex(held).query(asked, 3)
    assert np.mean(found.rows[:, 0] == np.arange(200)) > 0.9
    exact = np.linalg.norm(asked[:, None].astype(float) - held[found.rows], axis=2)
    assert np.allclose(found.distances, exact, rtol=1e-12)
    assert (np.diff(found.distances, axis=1) >= 0.0).all()


@pytest.mark.parametrize("chunk", [64, 4096])
def test_every_cell_searched_finds_what_a_full_search_does(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, chunk: int
) -> None:
    held, asked = looks(rng, 900), looks(rng, 40)
    held[450:600] = held[300:450]  # ties, at the last of the asked neighbours as well
    monkeypatch.setattr(appearance_index, "_CHUNK", chunk)
    in_full = AppearanceIndex(held).query(asked, 7)
    monkeypatch.setattr(appearance_index, "_EXACT", 0)
    monkeypatch.setattr(appearance_index, "_PROBES", 256)
    monkeypatch.setattr(appearance_index, "_LEADING", chunk)
    probed = AppearanceIndex(held).query(asked, 7)
    _assert_equal(in_full, probed)


@pytest.mark.parametrize("exact", [0, 10_000])
def test_words_at_hand_change_nothing(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, exact: int
) -> None:
    monkeypatch.setattr(appearance_index, "_EXACT", exact)
    held, asked = looks(rng, 500), looks(rng, 30)
    found = AppearanceIndex(held).query(asked, 8)
    given = AppearanceIndex(held, vocabulary.words_of(held)).query(asked, 8)
    _assert_equal(found, given)


@pytest.mark.parametrize("exact", [0, 10_000])
def test_queries_are_answered_one_by_one(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, exact: int
) -> None:
    monkeypatch.setattr(appearance_index, "_EXACT", exact)
    held, asked = looks(rng, 500), looks(rng, 30)
    together = AppearanceIndex(held).query(asked, 4)
    monkeypatch.setattr(appearance_index, "_AT_ONCE", 7)
    apart = AppearanceIndex(held).query(asked, 4)
    _assert_equal(together, apart)


@pytest.mark.parametrize("exact", [0, 10_000])
def test_ties_come_in_the_order_of_their_rows_and_none_too_many(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, exact: int
) -> None:
    monkeypatch.setattr(appearance_index, "_EXACT", exact)
    look = looks(rng, 1)
    held = np.concatenate([looks(rng, 5), np.repeat(look, 6, axis=0)])
    found = AppearanceIndex(held).query(look, 3)
    assert found.rows.tolist() == [[5, 6, 7]]
    assert found.distances.tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("exact", [0, 10_000])
def test_what_is_not_held_is_marked(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, exact: int
) -> None:
    monkeypatch.setattr(appearance_index, "_EXACT", exact)
    made = AppearanceIndex(looks(rng, 2))
    found = made.query(looks(rng, 4), 6)
    missing = found.rows == -1
    assert (missing == np.isinf(found.distances)).all()
    assert missing[:, 2:].all()
    assert made.query(looks(rng, 0), 2).rows.shape == (0, 2)
    nothing = AppearanceIndex(looks(rng, 0))
    assert len(nothing) == 0
    assert (nothing.query(looks(rng, 4), 2).rows == -1).all()
