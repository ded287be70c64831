"""Descriptors of other kinds keep their distances when they become the bytes that are matched."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fgslam.core.errors import ConfigError
from fgslam.frontend.features.matching import descriptor_distance
from fgslam.frontend.features.sift import as_bytes

FAR = 512.0
"""How far apart two unrelated SIFT descriptors are, about."""


def test_bytes_of_sift_are_taken_as_they_are() -> None:
    given = np.random.default_rng(0).integers(0, 256, (5, 128), np.uint8)
    assert as_bytes(given) is given


@pytest.mark.parametrize("width", [32, 61, 64])  # ORB; AKAZE; BRISK
def test_packed_bits_keep_their_hamming_distance(width: int) -> None:
    """L2 of the bytes is 512 sqrt(2 h / d); a projection of 256 places or more keeps a tenth."""
    rng = np.random.default_rng(width)
    a = rng.integers(0, 256, (400, width), np.uint8)
    flipped = rng.random((400, 8 * width)) < np.linspace(0.02, 0.5, 400)[:, None]
    b = a ^ np.packbits(flipped, axis=1)
    expected = FAR * np.sqrt(2.0 * flipped.mean(axis=1))
    ratio = descriptor_distance(as_bytes(a), as_bytes(b)) / expected
    assert abs(np.median(ratio) - 1.0) < 0.02
    assert ratio.min() > 0.8
    assert ratio.max() < 1.2


@pytest.mark.parametrize("width", [2, 36, 64, 100, 128])
def test_vectors_keep_the_angle_between_them(width: int) -> None:
    """Whatever their scale and type; to the rounding of 128 bytes, a third of a step each."""
    rng = np.random.default_rng(width)
    a, b = rng.normal(size=(2, 300, width))
    unit = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b)]
    expected = FAR / np.sqrt(2.0) * np.linalg.norm(unit[0] - unit[1], axis=1)
    found = descriptor_distance(as_bytes(a), as_bytes((7.0 * b).astype(np.float32)))
    assert_allclose(found, expected, rtol=0, atol=10.0)


def test_bits_packed_or_not_are_the_same() -> None:
    bits = np.random.default_rng(1).random((20, 256)) < 0.5
    assert np.array_equal(as_bytes(bits), as_bytes(np.packbits(bits, axis=1)))


@pytest.mark.parametrize("dtype", [np.uint8, np.bool_, np.float32, np.int16])
def test_no_features_have_no_descriptors(dtype: Any) -> None:
    assert as_bytes(np.zeros((0, 32), dtype)).shape == (0, 128)


def test_a_vector_without_direction_stays_in_the_middle() -> None:
    assert np.array_equal(as_bytes(np.zeros((1, 64))), np.full((1, 128), 128))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (np.zeros((3, 64), complex), "complex128; give numbers or bits"),
        (np.full((3, 64), "a"), "give numbers or bits"),
        (np.full((3, 64), np.nan), "not finite"),
        (np.zeros(64), "give a row for each feature"),
        (np.zeros((3, 0)), "give a row for each feature"),
    ],
)
def test_what_is_no_descriptor_is_refused(given: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        as_bytes(given)
