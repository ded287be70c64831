"""Contrast and noise of an image, which detection is relative to."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from fgslam.core.arrays import FloatArray, Image
from fgslam.frontend.features.sift import contrast_share, noise_sigma


def as_image(grey: FloatArray) -> Image:
    return np.rint(np.clip(grey, 0, 255)).astype(np.uint8)


def ramp(low: float, high: float) -> FloatArray:
    return np.tile(np.linspace(low, high, 320), (240, 1))


@pytest.mark.parametrize("gain", [1.0, 0.5, 0.25, 0.1])
def test_contrast_falls_with_the_light(gain: float) -> None:
    # 98 % of a ramp lie in 98 % of its range; two thirds of the scale are a share of one.
    expected = min(1.0, gain * 0.98 * 160 / 170)
    assert contrast_share(as_image(ramp(0, 160 * gain))) == pytest.approx(expected, abs=0.01)


def test_brightness_alone_is_no_contrast() -> None:
    assert contrast_share(as_image(ramp(0, 50))) == contrast_share(as_image(ramp(200, 250)))
    assert contrast_share(np.full((240, 320), 90, np.uint8)) == 0.0


def test_a_lamp_is_not_what_an_image_is_exposed_for() -> None:
    dark = as_image(ramp(0, 16))
    lamp = dark.copy()
    lamp[100:120, 100:130] = 255  # less than a hundredth of the pixels
    assert contrast_share(lamp) == pytest.approx(contrast_share(dark), abs=0.01)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0, 5.0])
@pytest.mark.parametrize("structure", ["even", "ramp", "blobs"])
def test_noise_is_measured_whatever_the_image_shows(sigma: float, structure: str) -> None:
    rng = np.random.default_rng(1)
    blobs = 128 + 900 * ndimage.gaussian_filter(rng.standard_normal((240, 320)), 8.0)
    grey = {"even": np.full((240, 320), 128.0), "ramp": ramp(40, 210), "blobs": blobs}[structure]
    image = as_image(grey + sigma * rng.standard_normal(grey.shape))
    # Rounding adds 1/12; the median of whole numbers is one, a sixth of 0.67 wide at most.
    assert noise_sigma(image) == pytest.approx(np.hypot(sigma, 12**-0.5), abs=0.15)


@pytest.mark.parametrize("size", [(3, 3), (4, 5), (31, 17)])
@pytest.mark.parametrize("levels", [2, 256])
def test_noise_is_the_median_of_the_answers(size: tuple[int, int], levels: int) -> None:
    image = np.random.default_rng(2).integers(0, levels, size) * (255 // (levels - 1))
    image[:3, :3] = 255 * (np.indices((3, 3)).sum(axis=0) % 2)  # the largest answer there is
    answers = np.abs(ndimage.convolve(image, [[1, -2, 1], [-2, 4, -2], [1, -2, 1]])[1:-1, 1:-1])
    expected = max(np.median(answers) / (0.6745 * 6.0), 12**-0.5)
    assert noise_sigma(image.astype(np.uint8)[:, ::-1][:, ::-1]) == pytest.approx(expected)


def test_rounding_is_the_least_noise() -> None:
    assert noise_sigma(np.zeros((240, 320), np.uint8)) == pytest.approx(12**-0.5)
    assert noise_sigma(np.zeros((2, 2), np.uint8)) == pytest.approx(12**-0.5)
