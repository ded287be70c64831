"""SIFT features of an image."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import ndimage
from scipy.spatial.distance import cdist
from simulated import assert_same_bits

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import ConfigError, FrameError
from fgslam.core.geometry import wrap
from fgslam.core.types import Features
from fgslam.frontend.features import sift
from fgslam.frontend.features.matching import descriptor_distance
from fgslam.frontend.features.sift import (
    EDGE_THRESHOLD,
    OCTAVE_LAYERS,
    SiftExtractor,
    as_bytes,
    grey_image,
)
from fgslam.frontend.settings import SiftSettings

# ------------------------------------------------------------------------------------------
# SIFT extraction (Se et al. 2.1)


SETTINGS = SiftSettings()


def extract(image: Image, levels: int = sift.SCALE_LEVELS, **changes: object) -> Features:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sift, "SCALE_LEVELS", levels)
        extractor = SiftExtractor(dataclasses.replace(SETTINGS, **changes), "descriptor")
        return extractor.extract(image)


def texture(shape: tuple[int, int] = (240, 320), seed: int = 0) -> FloatArray:
    """Smooth noise with blobs of many sizes, grey values 0 to 255."""
    rng = np.random.default_rng(seed)
    total = np.zeros(shape)
    for sigma in (1.5, 3.0, 6.0, 12.0):
        layer = ndimage.gaussian_filter(rng.standard_normal(shape), sigma, mode="wrap")
        total += layer / layer.std()
    return np.clip(128 + 30 * total, 0, 255)


def as_image(grey: FloatArray) -> Image:
    return np.rint(grey).astype(np.uint8)


def blobs(centres: FloatArray, sigma: float, shape: tuple[int, int] = (240, 320)) -> Image:
    """Bright Gaussian blobs at sub-pixel (column, row), on grey."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    out = np.full(shape, 60.0)
    for column, row in centres:
        squared = (columns - column) ** 2 + (rows - row) ** 2
        out += 150.0 * np.exp(-0.5 * squared / sigma**2)
    return as_image(np.clip(out, 0, 255))


def grid_centres(rng: np.random.Generator) -> FloatArray:
    columns, rows = np.meshgrid(np.arange(40, 300, 40), np.arange(40, 220, 40))
    grid = np.column_stack([columns.ravel(), rows.ravel()])
    return grid + rng.uniform(-0.5, 0.5, grid.shape)


def nearest(centres: FloatArray, xy: FloatArray) -> tuple[np.ndarray, FloatArray]:
    distance = np.linalg.norm(centres[:, None] - xy[None], axis=2)
    return distance.argmin(axis=1), distance.min(axis=1)


@pytest.mark.parametrize("sigma", [2.0, 3.0, 5.0])
def test_blobs_are_found_without_bias(sigma: float) -> None:
    """Fails by 0.25 px without OpenCV's precise up-scaling."""
    centres = grid_centres(np.random.default_rng(int(sigma)))
    found = extract(blobs(centres, sigma), levels=64)
    which, distance = nearest(centres, found.xy)
    assert distance.max() < 0.3
    error = found.xy[which] - centres
    assert np.abs(error.mean(axis=0)).max() < 0.05
    assert error.std(axis=0).max() < 0.15


@pytest.mark.parametrize("sigma", [2.0, 3.0, 5.0, 6.0])
def test_scale_is_the_blobs_own(sigma: float) -> None:
    """A Gaussian blob of variance t answers most at t / k, k the ratio of levels (2^(1/2))."""
    centres = grid_centres(np.random.default_rng(1))
    found = extract(blobs(centres, sigma), levels=64)
    which, _ = nearest(centres, found.xy)
    k = 2.0 ** (1.0 / OCTAVE_LAYERS)
    # OpenCV takes the image to be blurred by 0.5 px already.
    expected = np.sqrt((sigma**2 - 0.25) / k)
    assert np.median(found.scale[which]) == pytest.approx(expected, rel=0.08)


@pytest.mark.parametrize("levels", [1, 3, 6])
def test_the_finest_levels_are_kept(levels: int) -> None:
    image, layers = as_image(texture()), OCTAVE_LAYERS
    full, kept = extract(image, levels=64), extract(image, levels=levels)
    # Recomputed from OpenCV's own packed octaves, one key point after the other.
    detector = cv2.SIFT_create(
        nOctaveLayers=layers,
        contrastThreshold=SETTINGS.contrast_threshold,
        edgeThreshold=EDGE_THRESHOLD,
        sigma=SETTINGS.base_sigma_px,
        enable_precise_upscale=True,
    )
    expected = []
    for point in detector.detect(image, None):
        octave, layer = point.octave & 255, (point.octave >> 8) & 255
        octave = octave - 256 if octave > 127 else octave
        if octave == -1 or octave >= 0:
            level = (octave + 1) * layers + layer
            if level <= levels:
                expected.append(point.pt)
    np.testing.assert_array_equal(kept.xy, np.array(expected).reshape(-1, 2))
    assert 0 < len(kept) < len(full)
    # A level is a factor 2^(1/layers); the last one searched bounds the scale.
    step = 2.0 ** (1.0 / layers)
    largest = 0.5 * SETTINGS.base_sigma_px * step ** (levels + 0.6)
    assert kept.scale.max() < largest
    assert full.scale.max() > largest


def test_paper_mode_finds_the_same_without_descriptors() -> None:
    image = as_image(texture())
    described = SiftExtractor(SETTINGS, "descriptor").extract(image)
    bare = SiftExtractor(SETTINGS, "paper").extract(image)
    np.testing.assert_array_equal(bare.xy, described.xy)
    np.testing.assert_array_equal(bare.orientation, described.orientation)
    assert bare.descriptors.shape == described.descriptors.shape
    assert not bare.descriptors.any()


def test_parallel_extraction_gives_the_same_features() -> None:
    images = [as_image(texture()), lit(1 / 8, seed=1)]
    extractor = SiftExtractor(SETTINGS, "descriptor")
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(extractor.extract, images * 2))
    for k, found in enumerate(together):
        assert_same_bits(found, extractor.extract(images[k % 2]))


@pytest.mark.parametrize("grey", [0, 128, 255])
@pytest.mark.parametrize("appearance", ["descriptor", "paper"])
def test_an_even_image_has_no_features(grey: int, appearance: str) -> None:
    found = SiftExtractor(SETTINGS, appearance).extract(np.full((240, 320), grey, np.uint8))
    assert len(found) == 0
    assert found.xy.shape == (0, 2)
    assert found.descriptors.shape == (0, 128)


def test_at_most_the_strongest_are_kept() -> None:
    image = as_image(texture())
    few = extract(image, max_features=20)
    assert 0 < len(few) <= 21  # OpenCV keeps ties
    everything = {tuple(at) for at in extract(image).xy}
    assert {tuple(at) for at in few.xy} <= everything


# --------------------------------------------------------------------------------------------
# Exposure


def lit(gain: float, sigma: float = 0.3, seed: int = 0) -> Image:
    """The texture in other light, with the noise of reading and the rounding of a camera."""
    rng = np.random.default_rng([seed, 9])
    grey = gain * texture(seed=seed)
    return as_image(np.clip(grey + sigma * rng.standard_normal(grey.shape), 0, 255))


@pytest.mark.parametrize("gain", [1 / 4, 1 / 20])
def test_a_dark_image_has_the_features_of_the_bright_one(gain: float) -> None:
    bright, dark = extract(lit(1.0)), extract(lit(gain))
    assert 0.75 * len(bright) < len(dark) < 1.5 * len(bright)
    _, distance = nearest(bright.xy, dark.xy)
    assert (distance < 1.0).mean() > 0.65  # at 1/20 the last levels are those of rounding
    assert len(extract(lit(gain), contrast="absolute")) < 0.5 * len(bright)


def test_a_well_exposed_image_is_taken_as_it_is() -> None:
    image = as_image(texture())
    assert_same_bits(extract(image), extract(image, contrast="absolute"))


def faint(amplitude: float) -> Image:
    """A wall with hardly any texture between a window and a black cupboard, noise 0.5."""
    grey = 130.0 + amplitude * (texture() - 128.0) / 52.0
    grey[:, :16], grey[:, -16:] = 20.0, 235.0
    return as_image(grey + 0.5 * np.random.default_rng(4).standard_normal(grey.shape))


def test_where_features_are_few_the_strongest_are_taken() -> None:
    image = faint(6.0)
    plain, found = extract(image, contrast="absolute"), extract(image)
    assert len(plain) < 100
    assert 300 < len(found) <= 320 * 240 // 15**2
    assert nearest(plain.xy, found.xy)[1].max() < 0.1
    assert len(extract(faint(0.0))) < 15  # the noise is no feature, nor are straight edges
    assert len(extract(image, max_features=50)) == 50


@pytest.mark.parametrize(("grey", "sigma"), [(0.0, 4.0), (20.0, 0.3), (200.0, 1.5)])
def test_noise_alone_is_hardly_ever_a_feature(grey: float, sigma: float) -> None:
    """Under a lens cap, or before a white wall: 1 in 100 of what the noise alone would give."""
    noise = sigma * np.random.default_rng(3).standard_normal((240, 320))
    image = as_image(np.clip(grey + noise, 0, 255))
    assert len(extract(image)) <= 8


def test_more_features_are_recognised_in_a_noisy_image() -> None:
    """Than without smoothing it first: by their descriptors alone, and in their place."""
    clean, noisy = extract(lit(1.0)), lit(1.0, 20.0)

    def recognised(**how: object) -> int:
        found = extract(noisy, **how)
        distance = cdist(clean.descriptors, found.descriptors)
        best = distance.argmin(axis=1)
        mutual = distance.argmin(axis=0)[best] == np.arange(len(best))
        near = np.linalg.norm(found.xy[best] - clean.xy, axis=1) < 1.0
        return int((mutual & near).sum())

    assert recognised() > 1.3 * recognised(contrast="absolute")


@pytest.mark.parametrize("sigma", [5.0, 10.0, 20.0])
def test_smoothing_brings_a_noisy_image_nearer_to_the_clean_one(sigma: float) -> None:
    clean, noisy = texture(), lit(1.0, sigma)
    off = float(np.mean((sift.smoothed(noisy, sigma) - clean) ** 2))
    others = [ndimage.gaussian_filter(noisy.astype(float), s) for s in (0.35, 0.5, 0.7, 1.0, 1.4)]
    assert off < min(float(np.mean((other - clean) ** 2)) for other in others) + 0.05 * sigma**2
    assert off < 0.7 * sigma**2


@pytest.mark.filterwarnings("error")
def test_a_black_image_is_taken_without_a_warning() -> None:
    assert len(extract(np.zeros((240, 320), np.uint8))) == 0
    assert len(extract(np.zeros((2, 2), np.uint8))) == 0


# --------------------------------------------------------------------------------------------
# Equivariance: the features move, grow and turn with the texture


def similarity(angle_deg: float, scale: float, shift: tuple[float, float]) -> FloatArray:
    """Map (2, 3) of (column, row): turn clockwise and grow about the centre, then shift."""
    a, centre = np.deg2rad(angle_deg), np.array([159.5, 119.5])
    linear = scale * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return np.column_stack([linear, centre - linear @ centre + np.array(shift)])


def warped(grey: FloatArray, mapping: FloatArray) -> Image:
    """Spline-interpolated image whose content has moved by the mapping."""
    inverse = np.linalg.inv(mapping[:, :2])
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])  # scipy counts (row, column)
    matrix = swap @ inverse @ swap
    offset = -matrix @ (swap @ mapping[:, 2])
    return as_image(
        np.clip(ndimage.affine_transform(grey, matrix, offset, order=3, mode="wrap"), 0, 255)
    )


@pytest.mark.parametrize(
    ("angle_deg", "scale", "shift"),
    [
        (0.0, 1.0, (0.37, 0.81)),
        (-160.0, 1.0, (2.5, 1.5)),
        (0.0, 0.75, (0.0, 0.0)),
        (15.0, 1.2, (3.3, -2.1)),
    ],
)
def test_features_move_with_the_image(
    angle_deg: float, scale: float, shift: tuple[float, float]
) -> None:
    grey = texture(seed=3)
    mapping = similarity(angle_deg, scale, shift)
    before = extract(as_image(grey), levels=64)
    after = extract(warped(grey, mapping), levels=64)
    moved = before.xy @ mapping[:, :2].T + mapping[:, 2]
    inside = ((before.xy > 25) & (before.xy < [295, 215])).all(axis=1)
    inside &= ((moved > 25) & (moved < [295, 215])).all(axis=1) & (before.scale > 1.6)
    which, distance = nearest(moved[inside], after.xy)
    ratio = after.scale[which] / before.scale[inside] / scale
    same = (distance < 1.5) & (ratio > 0.8) & (ratio < 1.25)
    assert same.sum() > 15
    assert same.mean() > 0.7
    assert np.median(distance[same]) < 0.2
    assert np.median(ratio[same]) == pytest.approx(1.0, abs=0.03)
    offset = (after.xy[which] - moved[inside])[same]
    assert np.abs(np.median(offset, axis=0)).max() < 0.1
    # A key point may have two orientations: two features at one place, the better one counts.
    turned = after.orientation - before.orientation[inside, None] - np.deg2rad(angle_deg)
    here = np.linalg.norm(moved[inside, None] - after.xy, axis=2) < 1.5
    best = np.where(here, np.abs(np.rad2deg(wrap(turned))), np.inf).min(axis=1)[same]
    assert np.median(best) < 5.0
    assert (best < 10.0).mean() > 0.8


# ------------------------------------------------------------------------------------------
# Grey images from what cameras give


GREY = np.random.default_rng(1).integers(0, 256, (12, 17), np.uint8)


def test_grey_bytes_are_handed_on_without_a_copy() -> None:
    assert np.shares_memory(grey_image(GREY), GREY)


@pytest.mark.parametrize(
    "image",
    [
        np.asfortranarray(GREY),
        np.repeat(GREY, 2, axis=1)[:, ::2],
        GREY[::-1][::-1],
        GREY[:, :, None],
        GREY.astype(np.uint16) << 8,
        (GREY.astype(np.uint16) << 8) + 255,
        np.dstack([GREY] * 3),
        np.dstack([GREY] * 4),
        np.dstack([GREY.astype(np.uint16) << 8] * 3),
        GREY.tolist() and np.array(GREY.tolist(), np.uint8),
    ],
    ids=["columns", "view", "flipped", "channel", "16", "16 up", "rgb", "rgba", "rgb 16", "list"],
)
def test_the_same_picture_in_another_form_gives_the_same_bytes(image: np.ndarray) -> None:
    before = image.copy()
    found = grey_image(image)
    np.testing.assert_array_equal(found, GREY)
    assert found.dtype == np.uint8
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(image, before)


def test_colours_are_weighted_as_the_eye_does() -> None:
    """ITU-R BT.601: red 0.299, green 0.587, blue 0.114, in this order of channels."""
    pure = np.zeros((1, 3, 3), np.uint8)
    pure[0, range(3), range(3)] = 200
    np.testing.assert_allclose(grey_image(pure)[0], [59.8, 117.4, 22.8], rtol=0, atol=0.6)


@pytest.mark.parametrize(
    "image",
    [GREY / 255.0, GREY > 3, GREY[0], np.dstack([GREY] * 2), np.zeros((0, 5), np.uint8), "image"],
    ids=["float", "bool", "row", "two channels", "empty", "text"],
)
def test_other_forms_are_refused_with_what_to_give(image: object) -> None:
    with pytest.raises(FrameError, match=r"left image .*give"):
        grey_image(image, "left image")  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------------
# Descriptors of other kinds keep their distances when they become the bytes that are matched


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
