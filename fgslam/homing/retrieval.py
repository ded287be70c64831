"""Image retrieval by visual words: candidates for links, before anything is matched.

A vocabulary of SIFT descriptors by k-means; an image is the vector of its words' counts, weighted
by how rare they are (tf-idf, Sivic and Zisserman 2003) and with repeated ones damped by the square
root; likeness is the cosine.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from scipy.cluster.vq import kmeans2

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.homing import OmniFeatures

_WORDS = 400  # in the vocabulary
_ITERATIONS = 6  # of k-means
_SAMPLE = 10_000  # descriptors that the vocabulary is made of, at most


class VisualWords:
    """The vocabulary of a set of images, and the images in it."""

    def __init__(
        self,
        images: Sequence[OmniFeatures],
        rng: np.random.Generator,
    ) -> None:
        """Learns the words from the images themselves.

        Args:
            images: any number; those without SIFT features are like no other.
            rng: chooses the sample and the first words.
        """
        self._words = _vocabulary(images, rng)
        counts = np.array([self._counts(i) for i in images]).reshape(len(images), -1)
        seen = np.count_nonzero(counts, axis=0)
        self._rarity = np.log((1.0 + len(images)) / (1.0 + seen))
        vectors = [self._weighted(c) for c in counts]
        self._vectors: FloatArray = np.array(vectors).reshape(len(images), -1)

    def likeness(self, image: OmniFeatures) -> FloatArray:
        """(n,) cosines in [0, 1] of one image with all."""
        return np.asarray(self._vectors @ self._weighted(self._counts(image)))

    def likenesses(self) -> FloatArray:
        """(n, n) of all images among each other."""
        return np.asarray(self._vectors @ self._vectors.T)

    def _weighted(self, counts: FloatArray) -> FloatArray:
        vector = np.sqrt(counts) * self._rarity
        length = float(np.linalg.norm(vector))
        return np.asarray(vector / length if length > 0.0 else vector)

    def _counts(self, image: OmniFeatures) -> FloatArray:
        if not len(self._words):
            return np.zeros(0)
        descriptors = _rooted(image)
        # Nearest word: the squared distance without the descriptor's own length.
        score = descriptors @ self._words.T - 0.5 * np.sum(self._words**2, axis=1)
        words = np.argmax(score, axis=1) if len(descriptors) else np.zeros(0, dtype=np.int64)
        return np.bincount(words, minlength=len(self._words)).astype(np.float64)


def _vocabulary(images: Sequence[OmniFeatures], rng: np.random.Generator) -> FloatArray:
    everything = np.vstack([np.empty((0, 128)), *(_rooted(i) for i in images)])
    if len(everything) > _SAMPLE:
        everything = everything[np.sort(rng.choice(len(everything), _SAMPLE, False))]
    words = min(_WORDS, len(everything))
    if words < 2:
        return np.empty((0, 128))
    first = everything[np.sort(rng.choice(len(everything), words, replace=False))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a word that nothing is nearest to is kept
        centres, _ = kmeans2(everything, first, iter=_ITERATIONS, minit="matrix")
    return np.asarray(centres)


def _rooted(image: OmniFeatures) -> FloatArray:
    """(n, 128) square roots of the descriptors divided by their sums (Arandjelovic 2012)."""
    descriptors = image.sift.descriptors.astype(np.float64)
    total = descriptors.sum(axis=1, keepdims=True)
    return np.asarray(np.sqrt(descriptors / np.maximum(total, 1.0)))


def candidate_pairs(likenesses: FloatArray, each: int) -> IntArray:
    """(m, 2) pairs i < j of which one is among the ``each`` most alike of the other; 0: all."""
    n = len(likenesses)
    if each == 0 or each >= n - 1:
        return np.argwhere(np.triu(np.ones((n, n), dtype=np.bool_), 1))
    others = likenesses - 2.0 * np.eye(n)  # no image is a candidate of its own
    nearest = np.argsort(-others, axis=1, kind="stable")[:, :each]
    chosen = np.zeros((n, n), dtype=np.bool_)
    chosen[np.arange(n)[:, None], nearest] = True
    return np.argwhere(np.triu(chosen | chosen.T, 1))
