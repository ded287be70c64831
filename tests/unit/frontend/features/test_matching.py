"""The index of descriptors: exact where small, near to it where large, the same for the same."""

from __future__ import annotations

import math

import numpy as np
import pytest
from known_places import blurred, random_descriptors

from fgslam.core.arrays import ByteArray
from fgslam.frontend.features import matching as descriptor_index
from fgslam.frontend.features.matching import AppearanceIndex, Neighbours, pairs_in_gates
from fgslam.frontend.tracking import landmarks as views_module
from fgslam.frontend.tracking.landmarks import ViewPool, Views


def _truth(asked: ByteArray, held: ByteArray) -> np.ndarray:
    return np.linalg.norm(asked[:, None].astype(float) - held[None].astype(float), axis=2)


def _assert_equal(a: Neighbours, b: Neighbours) -> None:
    assert np.array_equal(a.rows, b.rows)
    assert np.array_equal(a.distances, b.distances)


def test_small_contents_are_answered_exactly(rng: np.random.Generator) -> None:
    held, asked = random_descriptors(rng, 300), random_descriptors(rng, 20)
    found = AppearanceIndex(held).query(asked, 5)
    exact = _truth(asked, held)
    order = np.argsort(exact, axis=1)[:, :5]
    assert np.allclose(found.distances, np.take_along_axis(exact, order, axis=1), rtol=1e-12)
    assert np.array_equal(found.rows, order)


def test_large_contents_are_answered_nearly(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(descriptor_index, "EXACT", 100)
    held = random_descriptors(rng, 4000)
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
    held, asked = random_descriptors(rng, 900), random_descriptors(rng, 40)
    held[450:600] = held[300:450]  # ties, at the last of the asked neighbours as well
    monkeypatch.setattr(descriptor_index, "CHUNK", chunk)
    in_full = AppearanceIndex(held).query(asked, 7)
    monkeypatch.setattr(descriptor_index, "EXACT", 0)
    monkeypatch.setattr(descriptor_index, "PROBES", 256)
    monkeypatch.setattr(descriptor_index, "LEADING", chunk)
    probed = AppearanceIndex(held).query(asked, 7)
    _assert_equal(in_full, probed)


@pytest.mark.parametrize("exact", [0, 10_000])
def test_words_at_hand_change_nothing(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, exact: int
) -> None:
    monkeypatch.setattr(descriptor_index, "EXACT", exact)
    held, asked = random_descriptors(rng, 500), random_descriptors(rng, 30)
    found = AppearanceIndex(held).query(asked, 8)
    given = AppearanceIndex(held, descriptor_index.words_of(held)).query(asked, 8)
    _assert_equal(found, given)


@pytest.mark.parametrize("exact", [0, 10_000])
def test_ties_come_in_the_order_of_their_rows_and_none_too_many(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, exact: int
) -> None:
    monkeypatch.setattr(descriptor_index, "EXACT", exact)
    look = random_descriptors(rng, 1)
    held = np.concatenate([random_descriptors(rng, 5), np.repeat(look, 6, axis=0)])
    found = AppearanceIndex(held).query(look, 3)
    assert found.rows.tolist() == [[5, 6, 7]]
    assert found.distances.tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("exact", [0, 10_000])
def test_what_is_not_held_is_marked(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, exact: int
) -> None:
    monkeypatch.setattr(descriptor_index, "EXACT", exact)
    made = AppearanceIndex(random_descriptors(rng, 2))
    found = made.query(random_descriptors(rng, 4), 6)
    missing = found.rows == -1
    assert (missing == np.isinf(found.distances)).all()
    assert missing[:, 2:].all()
    assert made.query(random_descriptors(rng, 0), 2).rows.shape == (0, 2)
    nothing = AppearanceIndex(random_descriptors(rng, 0))
    assert len(nothing) == 0
    assert (nothing.query(random_descriptors(rng, 4), 2).rows == -1).all()


def _views(descriptors: ByteArray) -> Views:
    n = len(descriptors)
    return Views(
        np.ones(n), np.zeros(n), descriptors, np.zeros((n, 3), np.float32), np.zeros(n, np.int64)
    )


def test_words_are_the_nearest_centres(rng: np.random.Generator) -> None:
    descriptors = random_descriptors(rng, 5000)  # more than are compared at once
    extreme = np.array([[255] * 128, [0] * 128], np.uint8)
    descriptors = np.concatenate([descriptors, extreme, descriptor_index.vocabulary()])
    centres = descriptor_index.vocabulary().astype(np.int64)
    own = descriptors.astype(np.int64)
    squared = (own**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2 * own @ centres.T
    order = np.argsort(squared, axis=1, kind="stable")
    assert np.array_equal(descriptor_index.words_of(descriptors), order[:, 0])
    assert np.array_equal(descriptor_index.nearest_words(descriptors[:50], 12), order[:50, :12])


def test_a_view_is_quantised_to_words_once(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def counted(descriptors: ByteArray) -> np.ndarray:
        asked.append(len(descriptors))
        return descriptor_index.words_of(descriptors)

    monkeypatch.setattr(views_module, "words_of", counted)
    pool = ViewPool(max_views=1, angle=0.0)
    first, later = random_descriptors(rng, 100), random_descriptors(rng, 3)
    places = pool.start(_views(first))
    assert np.array_equal(pool.words(places[:40, 0]), descriptor_index.words_of(first[:40]))
    assert np.array_equal(pool.words(places[:, 0]), descriptor_index.words_of(first))
    pool.refresh(places[10:13], _views(later))
    pool.release(places[50:52])
    again = pool.start(_views(later[:2]))  # in the places just released
    first[10:13] = later
    assert np.array_equal(pool.words(places[:50, 0]), descriptor_index.words_of(first[:50]))
    assert np.array_equal(pool.words(again[:, 0]), descriptor_index.words_of(later[:2]))
    more = pool.start(_views(first))  # the pool grows; what is known stays known
    assert np.array_equal(pool.words(places[:50, 0]), descriptor_index.words_of(first[:50]))
    assert asked == [40, 60, 3, 2, 0]
    pool.find_words()
    pool.find_words()
    assert np.array_equal(pool.words(more[:, 0]), descriptor_index.words_of(first))
    assert asked[5:] == [100, 0, 0]


@pytest.mark.parametrize("find", [pairs_in_gates, pairs_in_gates.numpy], ids=["kernel", "numpy"])
def test_pairs_in_gates_are_those_of_every_pair_asked_one_by_one(
    find: object, rng: np.random.Generator
) -> None:
    n, m, ratio, angle = 30, 40, 1.5, 0.6
    first = rng.integers(0, m, n)
    last = np.minimum(first + rng.integers(0, 20, n), m)
    looks = rng.uniform(1.0, 2.0, n), rng.uniform(-9.0, 9.0, n)
    wanted = np.column_stack(
        [*rng.uniform(0.0, 9.0, (2, n)), *rng.uniform(2.0, 6.0, (2, n)), *looks]
    )
    looks = rng.uniform(1.0, 2.0, m), rng.uniform(-9.0, 9.0, m), rng.uniform(size=m) < 0.3
    seen = np.column_stack([*rng.uniform(0.0, 9.0, (2, m)), *looks])
    wanted[0, 5] = seen[-1, 3] = math.nan
    expected = []
    for i, w in enumerate(wanted):
        for j in range(first[i], last[i]):
            s = seen[j]
            near = abs(w[0] - s[0]) <= w[2] and (abs(w[1] - s[1]) <= w[3] or s[4] == 1.0)
            same_size = max(w[4] / s[2], s[2] / w[4]) <= ratio
            turned = w[5] - s[3]
            alike = math.isfinite(turned) and math.cos(turned) >= math.cos(angle)
            if near and same_size and alike:
                expected.append((i, j))
    assert len(expected) > 10
    for room in (len(expected) + 3, 5):
        found, count = np.zeros((2, room), np.int64), np.zeros(1, np.int64)
        find(first, last, wanted, seen, ratio, angle, found, count)  # type: ignore[operator]
        assert count[0] == len(expected)
        assert found.T[: count[0]].tolist() == [list(pair) for pair in expected[:room]]
