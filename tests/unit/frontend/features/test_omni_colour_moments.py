"""Colour moments: eq. 1 as printed, as corrected, and over rectangles."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray, Image
from fgslam.frontend.features.omni import PAIRS, PatchColours, colour_from_means


def patch(seed: int = 1) -> Image:
    rng = np.random.default_rng(seed)
    common = rng.uniform(30.0, 90.0, (20, 30, 1))
    bands = common + rng.uniform(-20.0, 20.0, (20, 30, 3))
    return (2 * np.round(bands)).astype(np.uint8)


def whole(image: Image) -> FloatArray:
    low, high = np.array([[0, 0]]), np.array([[image.shape[1], image.shape[0]]])
    return PatchColours(image).boxes(low, high)[0]


def test_ratio_is_one_plus_covariance_over_means() -> None:
    image = patch()
    flat = image.reshape(-1, 3).astype(np.float64)
    covariance, mean = np.cov(flat.T, bias=True), flat.mean(axis=0)
    expected = [1.0 + covariance[p, q] / (mean[p] * mean[q]) for p, q in PAIRS]
    np.testing.assert_allclose(whole(image), expected, rtol=1e-12)


def test_gains_cancel_and_an_offset_does_not() -> None:
    image = patch()
    dimmed = image.copy()
    dimmed[..., 2] //= 2  # even values: exact
    raised = (image + np.uint8(20)).astype(np.uint8)
    np.testing.assert_allclose(whole(dimmed), whole(image), rtol=1e-9)
    assert np.abs(whole(raised) - whole(image)).min() > 1e-3


def test_the_printed_form_divides_by_zero() -> None:
    # Centralised bands integrate to nothing, whatever the patch.
    bands = patch().reshape(-1, 3).astype(np.float64)
    bands -= bands.mean(axis=0)
    sums = np.round(bands.sum(axis=0), 6)
    with np.errstate(divide="raise", invalid="raise"), pytest.raises(FloatingPointError):
        np.mean(bands[:, 0] * bands[:, 2]) / (sums[0] * sums[2])


def test_dark_patches_are_grey() -> None:
    image = np.random.default_rng(3).integers(0, 3, (40, 40, 3)).astype(np.uint8)
    np.testing.assert_allclose(whole(image), 1.0, atol=0.02)


def test_patches_are_clipped_at_the_border(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fgslam.frontend.features.omni.PATCH_SIGMAS", 2.0)
    image = patch()
    colours = PatchColours(image)
    found = colours.around(np.array([[0.0, 0.0], [15.0, 10.0]]), np.array([2.0, 2.0]))
    for at, rows, columns in ((0, slice(0, 5), slice(0, 5)), (1, slice(6, 15), slice(11, 20))):
        cut = image[rows, columns].reshape(-1, 3).astype(np.float64)
        products = np.column_stack([cut[:, p] * cut[:, q] for p, q in PAIRS])
        means = np.concatenate([cut.mean(axis=0), products.mean(axis=0)])[None]
        np.testing.assert_allclose(found[at], colour_from_means(means)[0], rtol=1e-9)
