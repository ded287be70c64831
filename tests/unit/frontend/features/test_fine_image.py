"""Values between pixels, and how exactly patches are aligned by them."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray, Image
from fgslam.frontend.features.patches import View, align, anchor
from fgslam.frontend.features.sift import FineImage

ROWS, COLUMNS = np.mgrid[0:60, 0:80]
INSIDE = slice(10, -10)


def test_pixels_stay_and_what_is_straight_stays_straight() -> None:
    noise = np.random.default_rng(0).integers(0, 256, ROWS.shape).astype(np.uint8)
    np.testing.assert_array_equal(FineImage(noise).grey[::2, ::2], noise)
    ramp = np.asarray(2 * COLUMNS + ROWS, dtype=np.uint8)
    rows, columns = np.mgrid[0:119, 0:159] / 2.0
    expected = 2.0 * columns + rows
    np.testing.assert_allclose(
        FineImage(ramp).grey[INSIDE, INSIDE], expected[INSIDE, INSIDE], atol=1e-3
    )


@pytest.mark.parametrize("degree", range(6))
def test_the_weights_are_exact_to_the_fifth_degree(degree: int) -> None:
    """Of a line of pixels that is zero but for one each: the weights themselves."""
    size = 20
    lines = np.zeros((size, size), np.uint8)
    np.fill_diagonal(lines, 200)
    weights = FineImage(lines).grey[::2, 1::2] / 200.0  # of pixel (row) in the value (column)
    place = 9
    powers = (np.arange(size) - 9.5) ** degree
    assert weights[:, place] @ powers == pytest.approx(0.0 if degree else 1.0, abs=1e-4)


def waves(shift: FloatArray, seed: int) -> Image:
    """Waves of 4.5 pixels and more in all directions, displaced (column, row)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:120, 0:160].astype(float)
    grey = np.full(x.shape, 128.0)
    for _ in range(60):
        frequency, angle = rng.uniform(0.04, 0.22), rng.uniform(0.0, np.pi)
        along = (x - shift[0]) * np.cos(angle) + (y - shift[1]) * np.sin(angle)
        grey += 12.0 * np.cos(2.0 * np.pi * (frequency * along + rng.uniform()))
    return np.asarray(np.clip(np.rint(grey), 0, 255), dtype=np.uint8)


def alignment_error(kind: type[FineImage] | None) -> float:
    """Root mean square over six displacements, pixels."""
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        shift, places = rng.uniform(-0.5, 0.5, 2), rng.uniform([20, 20], [140, 100], (60, 2))
        views: list[View] = [waves(np.zeros(2), seed), waves(shift, seed)]
        if kind is not None:
            views = [kind(view) for view in views if isinstance(view, np.ndarray)]
        patches, found = anchor(views[0], places, 15, 4.0, 0.05), places
        for _ in range(4):
            patches, found, _ = align(patches, views[1], found)
        errors.append(found - places - shift)
    return float(np.sqrt(np.mean(np.square(errors))))


def test_patches_are_aligned_more_exactly_than_on_straight_lines() -> None:
    straight, fine = alignment_error(None), alignment_error(FineImage)
    assert fine < 0.5 * straight
    assert fine < 0.006


def test_a_dark_image_is_not_rounded() -> None:
    """Grey values of 1 to 5: halfway between them is a value of its own."""
    image = np.asarray(3 + np.rint(2 * np.sin(COLUMNS / 3.0)), dtype=np.uint8)
    between = FineImage(image).grey[::2, 1::2]
    assert np.abs(between - np.rint(between)).max() > 0.2
