"""The fixed vocabulary: 256 cells of the space of SIFT descriptors.

It does not depend on what a map holds, so a descriptor's cell, its *word*, is found once in its
life: :mod:`fgslam.frontend.tracking.views` keeps it beside the descriptor, and
:mod:`fgslam.frontend.places.relocalisation.appearance_index` sorts by it. Made by
scripts/make_vocabulary.py.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import ByteArray, IntArray
from fgslam.core.features import Words

VOCABULARY_FILE = Path(__file__).with_name("vocabulary.npz")

_CHUNK = 4096  # descriptors compared at a time; their distances stay in the cache


@lru_cache(maxsize=1)
def vocabulary() -> ByteArray:
    """(w, 128) the cells' centres."""
    with np.load(VOCABULARY_FILE, allow_pickle=False) as stored:
        return np.asarray(stored["words"], np.uint8)


def words_of(descriptors: ByteArray) -> Words:
    """The word (m,) of each descriptor (m, 128): the cell whose centre is nearest."""
    out = np.empty(len(descriptors), np.int16)
    for start in range(0, len(descriptors), _CHUNK):
        part = slice(start, start + _CHUNK)
        out[part] = np.argmin(_to_centres(descriptors[part]), axis=1)
    return out


def nearest_words(descriptors: ByteArray, count: int) -> IntArray:
    """The ``count`` nearest cells (m, count) of each of a frame's descriptors, nearest first."""
    order = np.argsort(_to_centres(descriptors), axis=1, kind="stable")
    return np.asarray(order[:, :count])


def _to_centres(descriptors: ByteArray) -> npt.NDArray[np.float32]:
    """Squared distances (m, w) to the centres, each row less the descriptor's own square.

    Exact in float32: all sums of 128 products of bytes, and their doubles, are below 2^24.
    """
    centres, squares = _centres()
    products = np.asarray(descriptors.astype(np.float32) @ centres, np.float32)
    return np.subtract(squares, products, out=products)


@lru_cache(maxsize=1)
def _centres() -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Twice the centres (128, w), and their squares (w,)."""
    values = vocabulary().astype(np.float32)
    return np.ascontiguousarray(2.0 * values.T), np.einsum("ij,ij->i", values, values)
