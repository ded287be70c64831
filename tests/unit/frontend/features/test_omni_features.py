"""Upright SIFT of panoramas and mirrors, and the matching of two views."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fgslam.cameras.omni import Cylinder, Equirectangular, HyperbolicMirror, unwrap_maps
from fgslam.core.arrays import Image
from fgslam.core.bearings import FeatureKind, OmniFeatures, UprightFeatures
from fgslam.core.errors import FrameError
from fgslam.core.geometry import wrap
from fgslam.frontend.features import omni as colour_sift
from fgslam.frontend.features.omni import (
    SIGMA_PX,
    SIGMA_SCALES,
    OmniFeatureExtractor,
    View,
    up_in_image,
    wrapping_period,
)
from fgslam.frontend.features.settings import (
    OmniFeatureSettings,
    OmniMatchingSettings,
)
from fgslam.frontend.homing.two_view import PLAIN_MATCHING, match_features, match_sift, plain_sift

PANORAMA = Equirectangular(513, 257)
MIRROR = HyperbolicMirror.with_view((400, 400), 0.96, (np.radians(-55), np.radians(30)))


def picture(seed: int = 2, turn: int = 0) -> Image:
    """A panorama of coloured blots that closes at its seam; ``turn`` shifts it by columns."""
    rng = np.random.default_rng(seed)
    image = rng.uniform(0, 255, (257, 512, 3))
    tiled = np.hstack([image] * 3)
    soft = sum(w * cv2.GaussianBlur(tiled, (0, 0), s) for w, s in ((3.0, 2.0), (9.0, 5.0)))
    soft = np.asarray(soft)[:, 512:1024]
    soft = 127.0 + 45.0 * (soft - soft.mean()) / soft.std()
    out = np.roll(np.clip(np.round(soft), 0, 255).astype(np.uint8), turn, axis=1)
    return np.hstack([out, out[:, :1]])


def extractor() -> OmniFeatureExtractor:
    return OmniFeatureExtractor(PANORAMA, OmniFeatureSettings())


def test_wrapping_period_is_the_width_of_a_full_circle_and_none_for_a_mirror() -> None:
    assert wrapping_period(PANORAMA) == 512
    assert wrapping_period(Cylinder(301, 100, -1.0, 1.0)) == 300
    assert wrapping_period(MIRROR) is None


def test_up_is_up_in_panoramas_and_radial_in_mirrors() -> None:
    pixels = np.array([[0.0, 100.0], [511.0, 120.0], [200.0, 200.0]])
    up = up_in_image(PANORAMA, pixels)
    np.testing.assert_allclose(up, np.tile([0.0, -256 / np.pi], (3, 1)), atol=1e-4)
    around = np.linspace(0, 2 * np.pi, 9)[:-1]
    direction = np.column_stack([np.cos(around), np.sin(around)])
    up = up_in_image(MIRROR, 199.5 + 120.0 * direction)
    lengths = np.linalg.norm(up, axis=1)
    np.testing.assert_allclose(up / lengths[:, None], direction, atol=1e-3)
    assert np.isnan(up_in_image(MIRROR, np.array([[1.0, 1.0]]))).all()


def test_a_turn_shifts_all_features_and_doubles_none() -> None:
    turn = 137
    before, after = (extractor().extract(picture(turn=t)).sift for t in (0, turn))
    assert len(before) > 200
    assert abs(len(before) - len(after)) <= 0.02 * len(before)
    expected = wrap(before.bearing - turn * 2 * np.pi / 512)
    gap = np.hypot(
        wrap(expected[:, None] - after.bearing), before.elevation[:, None] - after.elevation
    )
    # The pyramid's phase differs, so a weak feature may come or go; none moves.
    assert np.mean(gap.min(axis=1) < 0.3 * 2 * np.pi / 512) > 0.95
    for features in (before, after):
        columns, rows = features.pixels.T
        assert columns.min() >= 0.0
        assert columns.max() < 512.0
        gap = (columns[:, None] - columns + 256.0) % 512.0 - 256.0
        near = np.hypot(gap, rows[:, None] - rows) < 0.5
        same_size = np.abs(np.log(features.scale[:, None] / features.scale)) < 0.1
        seam = np.minimum(columns, 512.0 - columns) < 20.0
        assert np.count_nonzero(seam) > 20
        assert np.count_nonzero((near & same_size)[seam]) == np.count_nonzero(seam)


def test_orientations_are_merged_and_the_strongest_are_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = extractor().extract(picture()).sift
    monkeypatch.setattr(colour_sift, "MAX_FEATURES", 50)
    some = extractor().extract(picture()).sift
    assert len(np.unique(np.column_stack([whole.pixels, whole.scale]), axis=0)) == len(whole)
    np.testing.assert_array_equal(some.pixels, whole.pixels[:50])
    # OpenCV doubles the image only where a fine feature asks for it: nearly the same numbers.
    gap = some.descriptors.astype(np.int64) - whole.descriptors[:50]
    assert np.abs(gap).max() <= 8


def test_elevations_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colour_sift, "MIN_ELEVATION_DEG", -20.0)
    monkeypatch.setattr(colour_sift, "MAX_ELEVATION_DEG", 10.0)
    found = extractor().extract(picture()).sift
    assert len(found) > 20
    assert np.rad2deg(found.elevation.min()) >= -20.5
    assert np.rad2deg(found.elevation.max()) <= 10.5


def test_sigmas_grow_with_scale() -> None:
    found = extractor().extract(picture()).sift
    pixel = np.pi / 256
    expected = pixel * np.hypot(SIGMA_PX, SIGMA_SCALES * found.scale / pixel)
    np.testing.assert_allclose(np.sqrt(found.covariance[:, 1, 1]), expected, rtol=1e-3)


@pytest.mark.parametrize("camera", [PANORAMA, MIRROR])
def test_dark_and_blank_images_have_no_features(camera: object) -> None:
    each = OmniFeatureExtractor(camera, OmniFeatureSettings())  # type: ignore[arg-type]
    for grey in (0, 90):
        shape = (camera.height, camera.width, 3)  # type: ignore[attr-defined]
        found = each.extract(np.full(shape, grey, np.uint8))
        assert (len(found.sift), len(found.columns)) == (0, 0)
        assert len(match_features(found, found, OmniMatchingSettings())) == 0


def test_a_cropped_panorama_leaves_unseen_rows_black() -> None:
    whole = Equirectangular(257, 129)
    cropped = Equirectangular(257, 65, np.pi / 4, -np.pi / 4)
    view = View(cropped, whole)
    shown = view.of(np.full((65, 257, 3), 200, np.uint8))
    assert view.seen is not None
    assert not shown[~view.seen].any()
    assert np.all(shown[33:96] == 200)


def test_another_size_is_refused() -> None:
    with pytest.raises(FrameError, match="camera's are uint8"):
        extractor().extract(np.zeros((256, 512, 3), np.uint8))
    with pytest.raises(FrameError, match="camera's are uint8"):
        extractor().extract(np.zeros((257, 513), np.uint8))
    each = extractor()
    for extract in (each.extract_sift, each.extract_columns):
        with pytest.raises(FrameError, match="camera's are uint8"):
            extract(np.zeros((512, 1024, 3), np.uint8))


def test_a_turned_mirror_image_matches_itself() -> None:
    each = OmniFeatureExtractor(MIRROR, OmniFeatureSettings())
    maps = unwrap_maps(PANORAMA, MIRROR)
    turn = 100
    a, b = (
        each.extract(np.asarray(cv2.remap(picture(turn=t), *maps, cv2.INTER_LINEAR)))
        for t in (0, turn)
    )
    matches = match_sift(a.sift, b.sift, OmniMatchingSettings())
    assert len(matches) > 60
    error = wrap(matches.bearing_b - matches.bearing_a + turn * 2 * np.pi / 512)
    right = np.hypot(error, matches.elevation_a - matches.elevation_b) < np.deg2rad(1.0)
    assert right.mean() > 0.95
    np.testing.assert_allclose(MIRROR.pixels(rays_of(a.sift)), a.sift.pixels, atol=1e-6)


def rays_of(features: UprightFeatures) -> np.ndarray:  # type: ignore[type-arg]
    level = np.cos(features.elevation)
    return np.column_stack(
        [
            level * np.cos(features.bearing),
            level * np.sin(features.bearing),
            np.sin(features.elevation),
        ]
    )


# --------------------------------------------------------------------------------------------
# Matching


def made(n: int = 40, seed: int = 5) -> UprightFeatures:
    rng = np.random.default_rng(seed)
    return UprightFeatures(
        pixels=rng.uniform(0, 200, (n, 2)),
        bearing=rng.uniform(-3, 3, n),
        elevation=rng.choice([-1.0, 1.0], n) * rng.uniform(0.1, 0.6, n),
        covariance=np.tile(np.diag([1e-4, 4e-4]), (n, 1, 1)),
        scale=rng.uniform(0.01, 0.02, n),
        descriptors=rng.integers(0, 120, (n, 128)).astype(np.uint8),
        colour=rng.uniform(1.0, 1.3, (n, 3)),
    )


def test_equal_features_match_themselves() -> None:
    features = made()
    matches = match_sift(features, features, OmniMatchingSettings())
    np.testing.assert_array_equal(matches.index_a, np.arange(40))
    np.testing.assert_array_equal(matches.index_b, np.arange(40))
    np.testing.assert_allclose(matches.quality, 1.0, atol=0.01)
    np.testing.assert_allclose(matches.sigma, np.tile([0.01, 0.02, 0.01, 0.02], (40, 1)))
    assert np.all(matches.kind == FeatureKind.SIFT)


def test_decoys_of_another_colour_are_discarded() -> None:
    a = made()
    colour = a.colour.copy()
    colour[::4] += 0.3
    b = replace(a, colour=colour)
    kept = match_sift(a, b, OmniMatchingSettings()).index_a
    np.testing.assert_array_equal(kept, np.flatnonzero(np.arange(40) % 4))
    blind = OmniMatchingSettings(max_colour_distance=10.0)
    assert len(match_sift(a, b, blind)) == 40


def test_competing_matches_that_no_planar_motion_explains_do_not_count() -> None:
    a = made()
    # The target shows each thing twice: at its place, and mirrored in the floor.
    image = replace(a, elevation=-a.elevation)
    b = stacked(a, image)
    settings = OmniMatchingSettings()
    assert len(match_sift(a, b, replace(settings, planar_gates=False))) == 0
    matches = match_sift(a, b, settings)
    np.testing.assert_array_equal(matches.index_b, np.arange(40))
    # Nor do copies of another size at the same elevation.
    matches = match_sift(a, stacked(replace(a, scale=3.0 * a.scale), a), settings)
    np.testing.assert_array_equal(matches.index_b, 40 + np.arange(40))


def test_the_gates_keep_what_distance_does() -> None:
    a = made()
    ratio = np.linspace(0.3, 3.0, 40)  # of distances, along the rays' heights
    height, level = np.sin(a.elevation), np.cos(a.elevation)
    b = replace(
        a,
        elevation=np.arctan2(height, level * ratio),
        scale=a.scale / np.hypot(height, level * ratio),
    )
    assert len(match_sift(a, b, OmniMatchingSettings())) == 40


def stacked(a: UprightFeatures, b: UprightFeatures) -> UprightFeatures:
    names = ("pixels", "bearing", "elevation", "covariance", "scale", "descriptors", "colour")
    return UprightFeatures(*(np.concatenate([getattr(a, n), getattr(b, n)]) for n in names))


def test_both_kinds_come_one_after_the_other() -> None:
    found = extractor().extract(picture())
    matches = match_features(found, found, OmniMatchingSettings())
    assert np.all(np.diff(matches.kind) >= 0)
    assert {0, 1} == set(matches.kind.tolist())
    only = match_features(OmniFeatures(found.sift, empty_columns()), found, OmniMatchingSettings())
    assert set(only.kind.tolist()) == {0}


def empty_columns():  # type: ignore[no-untyped-def]
    return extractor().extract(np.zeros((257, 513, 3), np.uint8)).columns


def test_extraction_repeats_itself_and_leaves_the_image() -> None:
    image = picture()
    copy = image.copy()
    one, two = extractor().extract(image), extractor().extract(image)
    np.testing.assert_array_equal(image, copy)
    for name in ("pixels", "descriptors", "colour", "covariance"):
        np.testing.assert_array_equal(getattr(one.sift, name), getattr(two.sift, name))
    np.testing.assert_array_equal(one.columns.descriptors, two.columns.descriptors)


def test_the_plain_baseline_finds_and_matches() -> None:
    a, b = (plain_sift(PANORAMA, picture(turn=t)) for t in (0, 40))
    matches = match_sift(a, b, PLAIN_MATCHING)
    error = np.abs(wrap(matches.bearing_b - matches.bearing_a + 40 * 2 * np.pi / 512))
    assert len(matches) > 50
    assert np.mean(error < 0.02) > 0.95
