"""Omnidirectional features."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fgslam.cameras.omni import Cylinder, Equirectangular, HyperbolicMirror, unwrap_maps
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.bearings import FeatureKind, OmniFeatures, UprightFeatures
from fgslam.core.errors import FrameError
from fgslam.core.geometry import wrap
from fgslam.frontend.features import omni as colour_sift
from fgslam.frontend.features.omni import (
    COVARIANCE,
    PAIRS,
    SIGMA_PX,
    SIGMA_SCALES,
    ColumnSegmentFinder,
    OmniFeatureExtractor,
    PatchColours,
    View,
    colour_from_means,
    up_in_image,
    whitened,
    wrapping_period,
)
from fgslam.frontend.homing.two_view import (
    PLAIN_MATCHING,
    consistent_tangents,
    match_columns,
    match_features,
    match_sift,
    nearest_segments,
    plain_sift,
)
from fgslam.frontend.settings import OmniFeatureSettings, OmniMatchingSettings

# ------------------------------------------------------------------------------------------
# Colour moments: eq. 1 as printed, as corrected, and over rectangles


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


# ------------------------------------------------------------------------------------------
# Invariant column segments: geometry, invariances, runs, and their distance


VIEW = Cylinder(401, 401, -1.0, 1.0)
POSTS = 16
POST_WIDTH = 6


def finder() -> ColumnSegmentFinder:
    return ColumnSegmentFinder(VIEW)


def posts(distance: float = 1.0, seed: int = 4, shift: int = 0) -> tuple[Image, FloatArray]:
    """Posts around the camera with a smooth pattern between two edges, and their ends' heights."""
    rng = np.random.default_rng(seed)
    ends = np.column_stack([rng.uniform(-0.48, -0.25, POSTS), rng.uniform(0.25, 0.48, POSTS)])
    height = VIEW.tangents(np.arange(401.0)) * distance
    image = np.full((401, 401, 3), 20.0)
    for k in range(POSTS):
        part = (height - ends[k, 0]) / (ends[k, 1] - ends[k, 0])
        waves = rng.choice([-1.0, 1.0], 4) * rng.uniform(0.4, 1.0, 4) / np.arange(1, 5)
        tone = sum(w * np.cos(np.pi * (m + 1) * part) for m, w in enumerate(waves))
        tint = rng.uniform(0.5, 1.0, 3)
        inside = (part > 0.0) & (part < 1.0)
        colour = 150.0 * tint + 16.0 * tint * np.asarray(tone)[:, None]
        first = 3 + k * 25
        columns = slice(first, first + POST_WIDTH)
        image[:, columns] = np.where(inside[:, None], colour, image[:, first])[:, None]
    image[:, :400] = np.roll(image[:, :400], shift, axis=1)
    image[:, 400] = image[:, 0]
    return np.clip(np.round(image), 0, 255).astype(np.uint8), ends


def test_every_post_is_found_once_at_its_place() -> None:
    image, ends = posts()
    found = finder().extract(image)
    assert len(found) == POSTS
    columns = 3 + 25 * np.arange(POSTS) + (POST_WIDTH - 1) / 2
    order = np.argsort(-found.bearing)
    expected = np.pi - columns * 2 * np.pi / 400
    pixel = 2 * np.pi / 400
    np.testing.assert_allclose(found.bearing[order], expected, atol=1.01 * pixel)
    np.testing.assert_allclose(found.tangents[order], ends, atol=1.5 * 2.0 / 400)
    low, high = found.tangents.T
    np.testing.assert_allclose(found.descriptors[:, 0], -low / (high - low), rtol=1e-12)
    assert found.descriptors.shape == (POSTS, 11)


def test_a_post_across_the_seam_is_one() -> None:
    image, _ = posts(shift=-6)  # the first post now lies on both sides
    assert len(finder().extract(image)) == POSTS


@pytest.mark.parametrize("distance", [0.5, 0.8, 1.4, 2.0])
def test_distance_leaves_descriptors_as_they_are(distance: float) -> None:
    near, far = (finder().extract(posts(d)[0]) for d in (1.0, distance))
    matches = match_columns(near, far, OmniMatchingSettings())
    assert len(matches) >= 0.8 * POSTS
    pixel = 2 * np.pi / 400
    np.testing.assert_allclose(matches.bearing_a, matches.bearing_b, atol=1.01 * pixel)
    ratio = np.tan(matches.elevation_a) / np.tan(matches.elevation_b)
    np.testing.assert_allclose(ratio, distance, rtol=0.08)
    i, j = matches.index_a, matches.index_b
    apart = whitened(near.descriptors[i]) - whitened(far.descriptors[j])
    others = whitened(near.descriptors[i]) - whitened(np.roll(far.descriptors[j], 1, axis=0))
    lengths = np.linalg.norm(apart, axis=1)
    assert np.median(lengths) < 2.0
    assert np.median(lengths) < 0.2 * np.median(np.linalg.norm(others, axis=1))


def test_gain_and_offset_leave_the_profile() -> None:
    image, _ = posts()
    changed = np.round(0.75 * image + 30.0).astype(np.uint8)
    gained = np.round(0.75 * image).astype(np.uint8)
    before = finder().extract(image)
    spread = np.sqrt(np.diag(COVARIANCE))
    for other, elements in ((changed, slice(4, 11)), (gained, slice(1, 11))):
        after = finder().extract(other)
        gap = np.abs(wrap(before.bearing[:, None] - after.bearing)) + np.abs(
            before.tangents[:, None] - after.tangents
        ).sum(axis=2)
        same = gap.min(axis=1) < 0.02
        assert same.sum() >= POSTS - 3
        now = after.descriptors[gap.argmin(axis=1)]
        change = (before.descriptors[same] - now[same])[:, elements] / spread[elements]
        assert np.sqrt(np.mean(change**2, axis=1)).max() < 0.5, "against the spread of two views"


def test_blank_and_wide_things_are_no_segments() -> None:
    assert len(finder().extract(np.zeros((401, 401, 3), np.uint8))) == 0
    table = np.full((401, 401, 3), 40, np.uint8)
    table[180:260] = np.linspace(90, 200, 80)[:, None, None].astype(np.uint8)
    assert len(finder().extract(table)) == 0, "a band all around has no bearing"


def test_unseen_parts_hold_no_segments() -> None:
    image, _ = posts()
    seen = np.ones((401, 401), np.bool_)
    seen[:, 200:] = False
    image[:, 200:] = 0
    found = ColumnSegmentFinder(VIEW, seen).extract(image)
    assert 0 < len(found) <= POSTS // 2
    assert np.all(found.bearing > 0.0)


def test_kd_tree_equals_brute_force() -> None:
    rng = np.random.default_rng(8)
    a, b = rng.normal(size=(60, 11)), rng.normal(size=(50, 11))
    i, j, distance, ratio = nearest_segments(a, b)
    every = np.linalg.norm(a[:, None] - b[None], axis=2)
    nearest = every.argmin(axis=1)
    mutual = every.argmin(axis=0)[nearest] == np.arange(60)
    np.testing.assert_array_equal(i, np.flatnonzero(mutual))
    np.testing.assert_array_equal(j, nearest[mutual])
    two = np.sort(every, axis=1)[mutual, :2]
    np.testing.assert_allclose(distance, two[:, 0], rtol=1e-12)
    np.testing.assert_allclose(ratio, two[:, 0] / two[:, 1], rtol=1e-12)


def test_whitened_distance_is_mahalanobis() -> None:
    assert np.linalg.eigvalsh(COVARIANCE).min() > 0.0
    rng = np.random.default_rng(9)
    d = rng.normal(size=(2, 11))
    even = d.copy()
    even[:, 0] = np.arcsinh(d[:, 0] - 0.5)
    gap = even[0] - even[1]
    expected = np.sqrt(gap @ np.linalg.solve(COVARIANCE, gap))
    white = whitened(d)
    assert np.linalg.norm(white[0] - white[1]) == pytest.approx(expected, rel=1e-9)


def test_tangents_of_both_ends_give_one_ratio() -> None:
    a = np.array([[-0.4, 0.3], [0.0, 0.5], [-0.6, 0.01], [0.2, 0.7]])
    rho = np.array([0.5, 0.8, 1.3, 2.0])
    one, two, factor = consistent_tangents(a, a / rho[:, None])
    np.testing.assert_allclose(one / two, rho, rtol=1e-12)
    np.testing.assert_allclose(one, a[np.arange(4), np.abs(a).argmax(axis=1)], rtol=1e-12)
    assert np.all((factor > 1 / np.sqrt(2) - 1e-12) & (factor <= 1.0))


def test_two_equal_segments_compete_for_a_third_equal_one() -> None:
    one = np.array([[1.0, 2.0], [5.0, 5.0]])
    i, j, distance, ratio = nearest_segments(one, np.array([[1.0, 2.0], [1.0, 2.0], [5.0, 6.0]]))
    assert i.tolist() == [0, 1]
    assert distance.tolist() == [0.0, 1.0]
    assert ratio[0] == 1.0
    assert ratio[1] == pytest.approx(0.2)
    assert j[1] == 2


# ------------------------------------------------------------------------------------------
# Upright SIFT of panoramas and mirrors, and the matching of two views


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
    b = replace(a, colour=a.colour + 0.1)
    assert len(match_sift(a, b, OmniMatchingSettings())) == 40


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


def test_the_plain_baseline_finds_and_matches() -> None:
    a, b = (plain_sift(PANORAMA, picture(turn=t)) for t in (0, 40))
    matches = match_sift(a, b, PLAIN_MATCHING)
    error = np.abs(wrap(matches.bearing_b - matches.bearing_a + 40 * 2 * np.pi / 512))
    assert len(matches) > 50
    assert np.mean(error < 0.02) > 0.95
