"""Patches aligned to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from textured_room import TEXTURE

from fgslam.core.arrays import FloatArray, Image
from fgslam.frontend.features.patches import View, align, anchor, crowding
from fgslam.frontend.features.sift import FineImage

# ------------------------------------------------------------------------------------------
# Values between pixels, and how exactly patches are aligned by them


ROWS, COLUMNS = np.mgrid[0:60, 0:80]
INSIDE = slice(10, -10)


def test_pixels_stay_and_what_is_straight_stays_straight() -> None:
    noise = np.random.default_rng(0).integers(0, 8, ROWS.shape).astype(np.uint8)
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


# ------------------------------------------------------------------------------------------
# Alignment of patches with what they looked like at first


PLACES = np.array([[60.0, 60.0], [100.0, 60.0], [60.0, 100.0], [90.0, 90.0]])
GREY = np.asarray(np.round(TEXTURE[:160, :160]), dtype=np.uint8)


def deformed(linear: FloatArray, shift: FloatArray) -> tuple[Image, FloatArray]:
    """The picture under an affine map about its middle, and where the places go."""
    middle = np.array([80.0, 80.0])
    affine = np.column_stack([linear, middle - linear @ middle + shift])
    image = cv2.warpAffine(GREY, affine, (160, 160), flags=cv2.INTER_CUBIC)
    return np.asarray(image, dtype=np.uint8), (PLACES - middle) @ linear.T + middle + shift


@pytest.mark.parametrize(
    "linear", [np.eye(2), 1.06 * np.eye(2), np.array([[1.0, 0.05], [0.0, 0.96]])]
)
def test_affine_maps_are_found(linear: FloatArray) -> None:
    patches = anchor(GREY, PLACES, 13, 4.0, 0.05)
    image, truth = deformed(linear, np.array([1.3, -0.7]))
    places = truth + np.array([[0.8, -0.5], [-0.6, 0.6], [0.5, 0.5], [-0.9, 0.2]])
    for _ in range(6):
        patches, places, correlation = align(patches, image, places)
    np.testing.assert_allclose(places, truth, atol=0.1)
    np.testing.assert_allclose(patches.maps, np.broadcast_to(linear, (4, 2, 2)), atol=0.03)
    assert correlation.min() > 0.98


def test_one_step_is_most_of_the_way_and_light_does_not_matter() -> None:
    patches = anchor(GREY, PLACES, 13, 4.0, 0.05)
    image, truth = deformed(1.02 * np.eye(2), np.array([2.0, 1.0]))
    dim = np.asarray(np.round(0.6 * image + 20.0), dtype=np.uint8)
    wrong = truth + np.array([0.6, -0.4])
    for seen in (image, dim):
        _, places, correlation = align(patches, seen, wrong)
        assert np.hypot(*(places - truth).T).max() < 0.25
        assert correlation.min() > 0.8


def test_something_else_does_not_correlate() -> None:
    patches = anchor(GREY, PLACES, 13, 4.0, 0.05)
    other = np.asarray(np.round(TEXTURE[200:360, 500:660]), dtype=np.uint8)
    negative = np.asarray(255 - GREY, dtype=np.uint8)
    for image in (other, negative, np.zeros_like(GREY)):
        kept, places, correlation = align(patches, image, PLACES)
        assert correlation.max() < 0.7
        assert np.isfinite(places).all()
        assert np.isfinite(kept.maps).all()
    for image in (negative, np.zeros_like(GREY)):  # refused outright: nothing has moved
        _, places, correlation = align(patches, image, PLACES)
        np.testing.assert_array_equal(places, PLACES)
        np.testing.assert_array_equal(correlation, -1.0)


def test_a_patch_that_one_step_crushes_to_nothing_is_lost_and_no_error() -> None:
    patches = anchor(GREY, PLACES, 13, 4.0, 0.05)
    inverse = patches.inverse.copy()
    inverse[:, [4, 7]] = 1e300  # by whatever remains each map changes without bound
    at = PLACES + 0.5
    kept, places, correlation = align(replace(patches, inverse=inverse), GREY, at, 2)
    np.testing.assert_array_equal(places, at)
    np.testing.assert_array_equal(correlation, -1.0)
    assert np.isfinite(kept.maps).all()


def test_taken_joined_and_none() -> None:
    patches = anchor(GREY, PLACES, 13, 4.0, 0.05)
    some = patches.select(np.array([True, False, True, False]))
    both = some.join(patches.select(np.array([False, True, False, True])))
    assert len(both) == 4
    np.testing.assert_array_equal(both.cut, patches.cut[[0, 2, 1, 3]])
    none = anchor(GREY, np.empty((0, 2)), 13, 4.0, 0.05)
    aligned, places, correlation = align(none, GREY, np.empty((0, 2)))
    assert len(aligned) == len(places) == len(correlation) == 0
    assert len(none.join(some)) == 2


# --------------------------------------------------------------------------------------------
# Patches that overlap


def test_patches_apart_are_independent_and_those_in_one_place_are_one() -> None:
    places = np.array([[20.0, 20.0], [80.0, 20.0], [80.0, 20.0], [80.0, 20.0]])
    np.testing.assert_allclose(crowding(places, 15), [1.0, 3.0, 3.0, 3.0], rtol=0, atol=1e-12)
    assert crowding(np.empty((0, 2)), 15).shape == (0,)


@pytest.mark.parametrize("apart", [3.0, 5.0, 8.0])
def test_errors_of_overlapping_patches_correlate_as_stated(apart: float) -> None:
    """The same image with other noise of the pixels: 400 pairs of patches on smooth texture."""
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.normal(size=(440, 440)), (0, 0), 1.5)
    clean = 128.0 + 40.0 * texture / texture.std()
    grid = np.stack(np.meshgrid(np.arange(20, 420, 20.0), np.arange(20, 420, 20.0)), axis=-1)
    first = grid.reshape(-1, 2)
    places = np.concatenate([first, first + np.array([apart, 0.0])])
    noisy = clean + rng.normal(0.0, 6.0, clean.shape)
    patches = anchor(_as_image(clean), places, 15, 4.0, 0.05)
    found = places
    for _ in range(3):
        patches, found, _ = align(patches, _as_image(noisy), found)
    errors = (found - places).reshape(2, -1)
    measured = float((errors[0] * errors[1]).sum() / np.sqrt((errors**2).sum(axis=1).prod()))
    stated = crowding(places[[0, len(first)]], 15)[0] - 1.0
    assert measured == pytest.approx(stated, rel=0, abs=0.12)


def _as_image(grey: FloatArray) -> Image:
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)
