"""The index of descriptors: exact where small, near to it where large, the same for the same."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.frontend.relocalisation import appearance_index
from fgslam.frontend.relocalisation.appearance_index import AppearanceIndex
from fgslam.types import ByteArray, IntArray
from tests.known_places import blurred, looks


def _index(owners: IntArray, descriptors: ByteArray) -> AppearanceIndex:
    made = AppearanceIndex()
    made.add(owners, descriptors)
    return made


def _truth(asked: ByteArray, held: ByteArray) -> np.ndarray:
    return np.linalg.norm(asked[:, None].astype(float) - held[None].astype(float), axis=2)


def test_small_contents_are_answered_exactly(rng: np.random.Generator) -> None:
    held, asked = looks(rng, 300), looks(rng, 20)
    owners = rng.permutation(300) + 1000
    found = _index(owners, held).query(asked, 5)
    exact = _truth(asked, held)
    order = np.argsort(exact, axis=1)[:, :5]
    assert np.allclose(found.distances, np.take_along_axis(exact, order, axis=1), atol=1e-3)
    assert np.array_equal(found.owners, owners[order])


def test_large_contents_are_answered_nearly(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(appearance_index, "_EXACT", 100)
    held = looks(rng, 4000)
    asked = blurred(held[:200], rng)
    found = _index(np.arange(4000), held).query(asked, 3)
    assert np.mean(found.owners[:, 0] == np.arange(200)) > 0.9
    right = found.owners[:, 0] == np.arange(200)
    exact = np.linalg.norm(asked.astype(float) - held[:200].astype(float), axis=1)
    assert np.allclose(found.distances[right, 0], exact[right], atol=1e-3)
    assert (np.diff(found.distances, axis=1) >= 0.0).all()


@pytest.mark.parametrize("exact", [0, 10_000])
def test_the_answer_depends_on_the_content_alone(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, exact: int
) -> None:
    monkeypatch.setattr(appearance_index, "_EXACT", exact)
    held, strangers, asked = looks(rng, 500), looks(rng, 100), looks(rng, 30)
    held[7] = held[300]  # twins, told apart by their owners
    at_once = _index(np.arange(500), held)
    shuffled = rng.permutation(500)
    underway = AppearanceIndex()
    underway.add(shuffled[:200], held[shuffled[:200]])
    underway.query(asked, 4)
    underway.add(np.arange(900, 1000), strangers)
    underway.add(shuffled[200:], held[shuffled[200:]])
    underway.remove(np.arange(900, 1000))
    a, b = at_once.query(asked, 8), underway.query(asked, 8)
    assert np.array_equal(a.owners, b.owners)
    assert np.array_equal(a.distances, b.distances)


def test_twins_come_in_the_order_of_their_owners(rng: np.random.Generator) -> None:
    look = looks(rng, 1)
    made = _index(np.array([9, 4, 6]), np.repeat(look, 3, axis=0))
    assert made.query(look, 3).owners.tolist() == [[4, 6, 9]]


@pytest.mark.parametrize("exact", [0, 10_000])
def test_what_is_not_held_is_marked(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, exact: int
) -> None:
    monkeypatch.setattr(appearance_index, "_EXACT", exact)
    made = _index(np.array([3, 3]), looks(rng, 2))
    found = made.query(looks(rng, 4), 6)
    empty = found.owners == -1
    assert (empty == np.isinf(found.distances)).all()
    assert empty[:, 2:].all()
    made.remove(np.array([3, 77]))
    assert len(made) == 0
    assert (made.query(looks(rng, 4), 2).owners == -1).all()
    assert made.query(looks(rng, 0), 2).owners.shape == (0, 2)
