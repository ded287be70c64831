"""Descriptors of any kind as the bytes that matching compares, at the distances that they had.

Matching compares Euclidean distances of 128 bytes, as those of SIFT with a norm of 512. Others are
turned by a randomised Hadamard transform (Ailon and Chazelle, STOC 2006), which spreads each over
all 128 places: exact up to 128 values, and beyond by projection, which keeps squared distances to
about a tenth. Bits become signs, so that Hamming distances become squared Euclidean ones.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import hadamard

from fgslam.core.arrays import ByteArray, FloatArray
from fgslam.core.errors import ConfigError

PLACES = 128
_NORM = 512.0 / np.sqrt(2.0)
"""Two unrelated signed vectors of this norm are as far apart as two of SIFT's, about 512."""
_MIDDLE = 128.0


def as_bytes(given: npt.NDArray[Any]) -> ByteArray:
    """Descriptors (n, 128) uint8 of descriptors (n, d).

    Args:
        given: uint8 with d = 128: bytes of a norm of about 512, as they are. Other uint8: packed
            bits, as OpenCV's ORB, BRISK and AKAZE give them; or bool: bits. All other numbers:
            vectors that are compared by their direction.

    Raises:
        ConfigError: there are not n rows of numbers, or one is not finite.
    """
    if given.ndim != 2 or given.shape[1] == 0:
        raise ConfigError(
            f"features: descriptors has shape {given.shape}; give a row for each feature"
        )
    if given.dtype == np.uint8 and given.shape[1] == PLACES:
        return given
    if given.dtype == np.uint8:
        return _spread(_signs(np.unpackbits(given, axis=1)))
    if given.dtype == np.bool_:
        return _spread(_signs(given))
    if given.dtype.kind not in "iuf":
        raise ConfigError(f"features: descriptors are {given.dtype}; give numbers or bits")
    vectors = given.astype(np.float64)
    if not np.isfinite(vectors).all():
        raise ConfigError("features: descriptors are not finite; give numbers")
    norms = np.linalg.norm(vectors, axis=1, keepdims=True)
    return _spread(vectors / np.where(norms > 0.0, norms, 1.0))


def _signs(bits: npt.NDArray[Any]) -> FloatArray:
    """Unit vectors (n, d) of bits (n, d)."""
    return np.asarray((2.0 * bits - 1.0) / np.sqrt(bits.shape[1]))


def _spread(vectors: FloatArray) -> ByteArray:
    turned = vectors @ _transform(vectors.shape[1])
    return np.asarray(np.clip(np.rint(_MIDDLE + _NORM * turned), 0, 255), np.uint8)


@cache
def _transform(width: int) -> FloatArray:
    """(d, 128), which keeps lengths: random signs, then columns of a Hadamard matrix."""
    order = max(PLACES, 1 << (width - 1).bit_length())
    rng = np.random.default_rng(0)
    signs = rng.choice([-1.0, 1.0], width)
    columns = rng.permutation(order)[:PLACES]
    chosen = hadamard(order)[:width, columns] / np.sqrt(PLACES)
    return np.asarray(signs[:, None] * chosen)
