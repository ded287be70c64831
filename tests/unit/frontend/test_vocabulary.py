"""The fixed vocabulary: the nearest cells, and a cell is found once in a view's life."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import ByteArray
from fgslam.frontend.features import vocabulary
from fgslam.frontend.tracking import views as views_module
from fgslam.frontend.tracking.views import ViewPool, Views
from tests.known_places import looks


def _views(descriptors: ByteArray) -> Views:
    n = len(descriptors)
    return Views(
        np.ones(n), np.zeros(n), descriptors, np.zeros((n, 3), np.float32), np.zeros(n, np.int64)
    )


def test_words_are_the_nearest_centres(rng: np.random.Generator) -> None:
    descriptors = looks(rng, 5000)  # more than are compared at once
    extreme = np.array([[255] * 128, [0] * 128], np.uint8)
    descriptors = np.concatenate([descriptors, extreme, vocabulary.vocabulary()])
    centres = vocabulary.vocabulary().astype(np.int64)
    own = descriptors.astype(np.int64)
    squared = (own**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2 * own @ centres.T
    order = np.argsort(squared, axis=1, kind="stable")
    assert np.array_equal(vocabulary.words_of(descriptors), order[:, 0])
    assert np.array_equal(vocabulary.nearest_words(descriptors[:50], 12), order[:50, :12])


def test_a_word_is_found_once_in_a_views_life(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def counted(descriptors: ByteArray) -> np.ndarray:
        asked.append(len(descriptors))
        return vocabulary.words_of(descriptors)

    monkeypatch.setattr(views_module, "words_of", counted)
    pool = ViewPool(max_views=1, angle=0.0)
    first, later = looks(rng, 100), looks(rng, 3)
    places = pool.start(_views(first))
    assert np.array_equal(pool.words(places[:40, 0]), vocabulary.words_of(first[:40]))
    assert np.array_equal(pool.words(places[:, 0]), vocabulary.words_of(first))
    pool.refresh(places[10:13], _views(later))
    pool.release(places[50:52])
    anew = pool.start(_views(later[:2]))  # in the places just released
    first[10:13] = later
    assert np.array_equal(pool.words(places[:50, 0]), vocabulary.words_of(first[:50]))
    assert np.array_equal(pool.words(anew[:, 0]), vocabulary.words_of(later[:2]))
    more = pool.start(_views(first))  # the pool grows; what is known stays known
    assert np.array_equal(pool.words(places[:50, 0]), vocabulary.words_of(first[:50]))
    assert asked == [40, 60, 3, 2, 0]
    pool.find_words()
    pool.find_words()
    assert np.array_equal(pool.words(more[:, 0]), vocabulary.words_of(first))
    assert asked[5:] == [100, 0, 0]
