"""Places by their words: the right one first, chance refused, a bounded size."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import ByteArray, IntArray
from fgslam.frontend.features.descriptor_index import vocabulary
from fgslam.frontend.places.word_index import MOST_WORDS, WordIndex, pair_words

NOBODY: IntArray = np.empty(0, np.int64)


def looks(rng: np.random.Generator, count: int) -> ByteArray:
    """Around the vocabulary's cells, as SIFT's are."""
    cells = vocabulary()
    i, j = rng.integers(0, len(cells), (2, count))
    mixed = 0.6 * cells[i] + 0.4 * cells[j] + rng.normal(0.0, 6.0, (count, 128))
    return np.clip(mixed, 0, 255).astype(np.uint8)


def again(looks: ByteArray, rng: np.random.Generator) -> ByteArray:
    """The same, as another image shows them."""
    noisy = looks + rng.normal(0.0, 4.0, looks.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_a_place_seen_again_comes_first_and_a_strange_one_not_at_all(
    rng: np.random.Generator,
) -> None:
    index, places = WordIndex(), [looks(rng, 150) for _ in range(6)]
    for number, place in enumerate(places):
        index.add(10 + number, pair_words(place))
    everywhere = np.arange(10, 16)
    seen = again(places[3][:80], rng)
    assert index.rank(seen, everywhere, surely=True).tolist() == [13]
    assert index.rank(seen, everywhere, surely=False)[0] == 13
    assert index.rank(looks(rng, 80), everywhere, surely=True).tolist() == []
    assert index.rank(seen, np.array([11, 14]), surely=True).tolist() == []
    assert index.rank(seen, NOBODY, surely=False).tolist() == []
    index.remove(13)
    assert index.rank(seen, np.setdiff1d(everywhere, 13), surely=True).tolist() == []


def test_a_place_keeps_a_bounded_number_of_words(rng: np.random.Generator) -> None:
    index = WordIndex()
    words = np.sort(rng.choice(65_536, 5 * MOST_WORDS, replace=False))
    index.add(0, words)
    assert len(index.words(0)) == MOST_WORDS
    assert np.isin(index.words(0), words).all()


def test_a_word_does_not_say_which_of_two_cells_is_nearer() -> None:
    rng = np.random.default_rng(0)
    some = looks(rng, 50)
    words = pair_words(some)
    assert (words // 256 <= words % 256).all()
    np.testing.assert_array_equal(words, pair_words(some[::-1]))
