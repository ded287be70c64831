"""The kernels of patches against the same in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from textured_room import TEXTURE

from fgslam.core.arrays import FloatArray
from fgslam.frontend.features.alignment import align_patches
from fgslam.frontend.features.anchoring import FLAT, add_up, cut_patches

GREY = np.ascontiguousarray(TEXTURE[:120, :160], np.float32)
SIZE = 15
RNG = np.random.default_rng(0)
PLACES = RNG.uniform([-6.0, -6.0], [86.0, 66.0], (300, 2))  # some on the border and beyond
WEIGHT = RNG.uniform(0.1, 1.0, SIZE**2)
PRIOR = np.repeat([FLAT, 6400.0], 4)


def cut_and_added() -> tuple[FloatArray, ...]:
    """Patches of GREY at half the pixels' distance, their gram matrices and inverses."""
    cut, (gram, inverse) = np.empty((300, 289), np.float32), np.empty((2, 300, 8, 8))
    cut_patches(GREY, 2, PLACES, np.eye(2), SIZE + 2, cut)
    add_up(cut, SIZE, WEIGHT, PRIOR, gram, inverse, np.empty((SIZE**2, 8)))
    return np.asarray(cut), gram, inverse


def test_patches_are_cut_as_numpy_cuts_them() -> None:
    cut, expected = cut_and_added()[0], np.empty((300, 289), np.float32)
    cut_patches.numpy(GREY, 2, PLACES, np.eye(2), SIZE + 2, expected)
    # Its places are in single precision: a hundred grey levels a pixel times 1e-5 of one.
    np.testing.assert_allclose(cut, expected, rtol=0, atol=1e-3)


def test_sums_and_their_inverses_are_those_of_numpy() -> None:
    cut, gram, inverse = cut_and_added()
    sums, inverted = np.empty((2, 300, 8, 8))
    add_up.numpy(cut, SIZE, WEIGHT, PRIOR, sums, inverted, np.empty((SIZE**2, 8)))
    np.testing.assert_allclose(gram, sums, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(inverse, inverted, rtol=0, atol=1e-6 * np.abs(inverted).max())
    product = inverse @ (gram + np.diag(PRIOR))
    np.testing.assert_allclose(product, np.tile(np.eye(8), (300, 1, 1)), rtol=0, atol=1e-5)


@pytest.mark.parametrize("times", [1, 3])
def test_steps_are_those_of_numpy(times: int) -> None:
    patches = cut_and_added()
    view = np.ascontiguousarray(0.7 * GREY + 10.0 + RNG.normal(0.0, 2.0, GREY.shape), np.float32)
    start = PLACES + RNG.uniform(-1.0, 1.0, PLACES.shape)
    found = []
    for work in (align_patches, align_patches.numpy):
        maps, places, alike = np.tile(np.eye(2), (300, 1, 1)), start.copy(), np.empty(300)
        room = np.empty((SIZE**2 + 2, 8)), np.empty(SIZE**2)
        cut, gram, inverse = patches
        work(view, 2, cut, WEIGHT, gram, inverse, times,
             maps, places, alike, *room)  # fmt: skip
        found.append((maps, places, alike))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=2e-4)
    assert (found[0][2] > 0.8).sum() > 200
    assert np.median(np.abs(found[0][1] - PLACES)) < (0.2 if times == 1 else 0.05)


def test_no_patch_is_nothing_to_do_for_either() -> None:
    cut, gram, inverse = (one[:0].copy() for one in cut_and_added())
    places, maps, alike = np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0)
    room = np.empty((SIZE**2 + 2, 8)), np.empty(SIZE**2)
    for cutting, adding, aligning in (
        (cut_patches, add_up, align_patches),
        (cut_patches.numpy, add_up.numpy, align_patches.numpy),
    ):
        cutting(GREY, 2, places, np.eye(2), SIZE + 2, cut)
        adding(cut, SIZE, WEIGHT, PRIOR, gram, inverse, room[0][:-2])
        aligning(GREY, 2, cut, WEIGHT, gram, inverse, 2, maps, places, alike, *room)


def test_places_that_are_no_numbers_are_lost() -> None:
    cut, gram, inverse = (one[:3].copy() for one in cut_and_added())
    places = np.array([[np.nan, 3.0], [np.inf, 3.0], [3.0, -np.inf]])
    maps, alike, given = np.tile(np.eye(2), (3, 1, 1)), np.empty(3), places.copy()
    room = np.empty((SIZE**2 + 2, 8)), np.empty(SIZE**2)
    align_patches(GREY, 2, cut, WEIGHT, gram, inverse, 1, maps, places, alike, *room)
    assert not np.isfinite(places[~np.isfinite(given)]).any()
    assert np.isfinite(maps).all()
