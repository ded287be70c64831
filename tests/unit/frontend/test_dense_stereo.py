"""Dense matching before a wall whose disparity is known exactly."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from textured_wall import RIG, WALL_M, pictures

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.correction import term_names
from fgslam.frontend.dense_stereo import DenseStereo

# Of which the fractions of the disparity, 13.6 to 14.2 px, are a sixteenth apart.
PLACES = [np.array([0.0, 0.0, WALL_M - 26.0 / d]) for d in np.arange(13.6, 14.6, 0.0625)]


@cache
def frames() -> list[tuple[Image, ...]]:
    rng = np.random.default_rng(3)
    return [pictures(place, rng) for place in PLACES]


def errors(stereo: DenseStereo, seen: list[tuple[Image, ...]]) -> tuple[FloatArray, FloatArray]:
    """Errors of the disparities and their stated deviations, frame by frame."""
    out = []
    for images, place in zip(seen, PLACES, strict=True):
        disparity, sigma = stereo.measure(images)
        known = disparity > 0.0
        assert known.mean() > 0.75
        true = RIG.fx * RIG.baseline / (WALL_M - place[2])
        out.append((disparity[known] - true, sigma[known]))
    error, sigma = zip(*out, strict=True)
    return np.array([np.median(e) for e in error]), np.concatenate(
        [np.abs(e) / s for e, s in zip(error, sigma, strict=True)]
    )


@pytest.mark.parametrize("cameras", [2, 3])
def test_disparities_are_those_of_the_wall_whatever_their_fraction(cameras: int) -> None:
    stereo = DenseStereo(RIG, cameras)
    disparity, sigma = stereo.measure(frames()[4])
    true = RIG.fx * RIG.baseline / (WALL_M - PLACES[4][2])
    known = disparity > 0.0
    assert known.mean() > 0.75
    error = disparity[known] - true
    assert abs(np.median(error)) < 0.02
    assert (np.abs(error) < 2.0 * sigma[known]).mean() > 0.9
    assert disparity.dtype == sigma.dtype == np.float32
    assert not sigma[~known].any()


@pytest.mark.slow
def test_whatever_the_fraction_there_is_neither_bias_nor_lock_to_whole_pixels() -> None:
    found, normalised = errors(DenseStereo(RIG), frames())
    assert np.abs(found).max() < 0.04
    assert abs(found.mean()) < 0.01
    assert (normalised < 1.0).mean() > 0.6


def test_a_correction_of_the_rig_is_taken_off_the_images() -> None:
    """The left image shifted by one pixel, as a term that says so."""
    right, left, top = pictures(PLACES[0])
    moved = np.roll(left, 1, axis=1)
    correction = np.zeros(len(term_names(RIG)))
    correction[term_names(RIG).index("left.column")] = 1.0 / RIG.fx
    plain, corrected = DenseStereo(RIG), DenseStereo(RIG, correction=correction)
    expected, _ = plain.measure((right, left, top))
    found, _ = corrected.measure(corrected.corrected((right, moved, top)))
    both = (expected > 0.0) & (found > 0.0)
    assert both.mean() > 0.7
    assert np.median(np.abs(found - expected)[both]) < 0.01


def test_images_in_colour_are_matched_by_their_grey() -> None:
    grey = pictures(PLACES[2])
    colour = tuple(np.repeat(image[:, :, None], 3, axis=2) for image in grey)
    for a, b in zip(*(DenseStereo(RIG).measure(i) for i in (grey, colour)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_images_without_texture_have_no_depth() -> None:
    flat = np.full((RIG.height, RIG.width), 90, np.uint8)
    disparity, sigma = DenseStereo(RIG).measure((flat, flat, flat))
    assert not disparity.any()
    assert not sigma.any()
