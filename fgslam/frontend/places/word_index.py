"""Which of many places a frame may show, by words of its features: an inverted file of places.

A word is the pair of the vocabulary's two nearest cells, whichever of them is nearer: 256 cells
alone are all found in any place of a few hundred landmarks. A place keeps at most ``MOST_WORDS`` of
them, so that it costs a few kilobytes whatever it holds. What is proposed here is to be verified by
geometry (Sivic and Zisserman 2003, Jegou et al. 2011).
"""

from __future__ import annotations

import numpy as np
from scipy.special import pdtrc

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from fgslam.frontend.features.descriptor_index import nearest_words, vocabulary

MOST_WORDS = 1024
_BY_CHANCE = 1e-2  # places proposed by chance that are allowed in a frame


def pair_words(descriptors: ByteArray) -> IntArray:
    """The words (w,) of descriptors (m, 128), ascending, each once."""
    cells = np.sort(nearest_words(descriptors, 2), axis=1)
    return np.unique(cells[:, 0] * len(vocabulary()) + cells[:, 1])


class WordIndex:
    """Words of places, which are numbered by whoever holds them."""

    def __init__(self) -> None:
        """No place."""
        self._words: dict[int, IntArray] = {}
        self._places: dict[int, list[int]] = {}

    def __len__(self) -> int:
        """Places held."""
        return len(self._words)

    def words(self, place: int) -> IntArray:
        """What is kept of a place."""
        return self._words[place]

    def add(self, place: int, words: IntArray) -> None:
        """Takes a place in; of too many words evenly chosen ones."""
        if len(words) > MOST_WORDS:
            words = words[np.linspace(0, len(words) - 1, MOST_WORDS).astype(np.int64)]
        self._words[place] = words.astype(np.int32)
        for word in words.tolist():
            self._places.setdefault(word, []).append(place)

    def remove(self, place: int) -> None:
        """Forgets a place."""
        for word in self._words.pop(place).tolist():
            self._places[word].remove(place)
            if not self._places[word]:
                del self._places[word]

    def rank(self, descriptors: ByteArray, among: IntArray, surely: bool) -> IntArray:
        """Places of ``among`` (k,) by how much better than chance they share a frame's words.

        Args:
            descriptors: (n, 128) of the frame.
            among: the places asked about.
            surely: only those that chance does not explain, by the rate of shared words over all
                others (a-contrario: fewer than 0.01 false ones a frame).
        """
        if not len(among):
            return among
        shared, size = self._shared(descriptors), self._sizes()
        rate = (shared.sum() - shared + 1.0) / (size.sum() - size + 1.0 + size.mean())
        expected = rate * size
        numbers = np.array(sorted(self._words), np.int64)
        chosen = np.isin(numbers, among)
        if surely:
            chosen &= self._beyond_chance(shared, expected)
        excess = (shared - expected) / np.sqrt(expected + 1.0)
        order = np.lexsort((numbers, -excess))
        return numbers[order[chosen[order]]]

    def _beyond_chance(self, shared: FloatArray, expected: FloatArray) -> BoolArray:
        false = len(self) * pdtrc(np.maximum(shared - 1.0, 0.0), expected)
        return np.asarray((shared > 0.0) & (false <= _BY_CHANCE))

    def _shared(self, descriptors: ByteArray) -> FloatArray:
        """How many of a frame's words each place has, by ascending number."""
        lists = [self._places.get(word, []) for word in pair_words(descriptors).tolist()]
        found = np.array([place for one in lists for place in one], np.int64)
        counts = np.bincount(found, minlength=max(self._words) + 1)
        return counts[sorted(self._words)].astype(np.float64)

    def _sizes(self) -> FloatArray:
        return np.array([len(self._words[place]) for place in sorted(self._words)], np.float64)
