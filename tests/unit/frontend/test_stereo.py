"""Stereo matching over the rig (Se et al. 2.2)."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
import pytest
from simulated import RIG, assert_same_bits
from textured_wall import HERE, RIG as WALL_RIG, WALL_M, pictures

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.correction import RigCorrection, term_names
from fgslam.core.geometry import wrap
from fgslam.core.log import Frame
from fgslam.core.sensors import SHIFT_SHARE, CameraRig
from fgslam.core.settings import RigPlaces
from fgslam.core.types import Features, StereoFeatures
from fgslam.frontend.features import matching
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.settings import (
    AppearanceSettings,
    FrontendSettings,
    SiftSettings,
    StereoSettings,
)
from fgslam.frontend.stereo import PatchStereo, StereoMatcher, measurement_map
from fgslam.slam.build import as_measured, make_describer, make_stereo

# ------------------------------------------------------------------------------------------
# Matching over the rig (Se et al. 2.2)


PAPER = AppearanceSettings(mode="paper")
DESCRIPTOR = AppearanceSettings(mode="descriptor")
GATES = StereoSettings(
    epipolar_px=1.0,
    min_disparity_px=1.0,
    max_disparity_px=40.0,
)
TWO_CAMERAS = dataclasses.replace(RIG, vertical_baseline=None)
RIGHT = (100.0, 80.0)


def features(
    xy: object,
    scale: object = 2.0,
    orientation_deg: object = 30.0,
    descriptors: FloatArray | None = None,
) -> Features:
    at = np.asarray(xy, np.float64).reshape(-1, 2)
    count = len(at)
    if descriptors is None:
        descriptors = np.full((count, 128), 45, np.uint8)
    return Features(
        at,
        np.broadcast_to(np.asarray(scale, np.float64), count).copy(),
        np.broadcast_to(np.deg2rad(np.asarray(orientation_deg, np.float64)), count).copy(),
        descriptors,
    )


def match(
    *images: Features,
    rig: CameraRig = RIG,
    appearance: AppearanceSettings = PAPER,
    **changes: object,
) -> StereoFeatures:
    settings = dataclasses.replace(GATES, **changes)
    return StereoMatcher(rig, settings, appearance).match(images)


# --------------------------------------------------------------------------------------------
# Gates: each alone, just inside and just outside

INSIDE_AND_OUTSIDE = {
    "epipolar, below": (((110.0, 80.99), 2.0, 30.0), ((110.0, 81.01), 2.0, 30.0)),
    "epipolar, above": (((110.0, 79.01), 2.0, 30.0), ((110.0, 78.99), 2.0, 30.0)),
    "disparity, least": (((101.01, 80.0), 2.0, 30.0), ((100.99, 80.0), 2.0, 30.0)),
    "disparity, negative": (((101.01, 80.0), 2.0, 30.0), ((90.0, 80.0), 2.0, 30.0)),
    "disparity, largest": (((139.99, 80.0), 2.0, 30.0), ((140.01, 80.0), 2.0, 30.0)),
    "scale, larger": (((110.0, 80.0), 2.99, 30.0), ((110.0, 80.0), 3.01, 30.0)),
    "scale, smaller": (((110.0, 80.0), 1.34, 30.0), ((110.0, 80.0), 1.33, 30.0)),
    "orientation, clockwise": (((110.0, 80.0), 2.0, 49.9), ((110.0, 80.0), 2.0, 50.1)),
    "orientation, through 0": (((110.0, 80.0), 2.0, 10.1), ((110.0, 80.0), 2.0, 9.9)),
    "orientation, around the circle": (((110.0, 80.0), 2.0, 390.0), ((110.0, 80.0), 2.0, 210.0)),
}


@pytest.mark.parametrize("appearance", [PAPER, DESCRIPTOR], ids=["paper", "descriptor"])
@pytest.mark.parametrize("gate", INSIDE_AND_OUTSIDE)
def test_each_gate_of_the_left_image(gate: str, appearance: AppearanceSettings) -> None:
    right = features(RIGHT)
    for left, count in zip(INSIDE_AND_OUTSIDE[gate], (1, 0), strict=True):
        found = match(right, features(*left), rig=TWO_CAMERAS, appearance=appearance)
        assert len(found) == count


TOP = {
    "epipolar, right": (((100.99, 90.0), 2.0, 30.0), ((101.01, 90.0), 2.0, 30.0)),
    "epipolar, left": (((99.01, 90.0), 2.0, 30.0), ((98.99, 90.0), 2.0, 30.0)),
    "agreement, more": (((100.0, 90.99), 2.0, 30.0), ((100.0, 91.01), 2.0, 30.0)),
    "agreement, less": (((100.0, 89.01), 2.0, 30.0), ((100.0, 88.99), 2.0, 30.0)),
    "agreement, sign": (((100.0, 90.0), 2.0, 30.0), ((100.0, 70.0), 2.0, 30.0)),
    "scale": (((100.0, 90.0), 2.99, 30.0), ((100.0, 90.0), 3.01, 30.0)),
    "orientation": (((100.0, 90.0), 2.0, 49.9), ((100.0, 90.0), 2.0, 50.1)),
}


@pytest.mark.parametrize("appearance", [PAPER, DESCRIPTOR], ids=["paper", "descriptor"])
@pytest.mark.parametrize("gate", TOP)
def test_each_gate_of_the_top_image(gate: str, appearance: AppearanceSettings) -> None:
    right, left = features(RIGHT), features((110.0, 80.0))
    for top, count in zip(TOP[gate], (1, 0), strict=True):
        found = match(right, left, features(*top), appearance=appearance)
        assert len(found) == count


def test_unequal_baselines_scale_the_agreement() -> None:
    rig = dataclasses.replace(RIG, vertical_baseline=0.2)
    right, left = features(RIGHT), features((110.0, 80.0))
    assert len(match(right, left, features((100.0, 100.0)), rig=rig)) == 1
    assert len(match(right, left, features((100.0, 90.0)), rig=rig)) == 0
    # One pixel of horizontal disparity is two vertical ones here.
    assert len(match(right, left, features((100.0, 101.9)), rig=rig)) == 1
    assert len(match(right, left, features((100.0, 102.1)), rig=rig)) == 0


def test_descriptors_gate_by_distance_and_ratio(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching, "MAX_DISTANCE", 250.0)
    monkeypatch.setattr(matching, "RATIO", 0.8)
    near, far = np.zeros((1, 128), np.uint8), np.zeros((1, 128), np.uint8)
    far[0, 0] = 251
    right = features(RIGHT, descriptors=near)
    appearance = AppearanceSettings(mode="descriptor")
    two = dataclasses.replace(TWO_CAMERAS)
    assert (
        len(match(right, features((110, 80), descriptors=far), rig=two, appearance=appearance)) == 0
    )
    far[0, 0] = 250
    assert (
        len(match(right, features((110, 80), descriptors=far), rig=two, appearance=appearance)) == 1
    )
    # Two candidates at distances 79 and 100 are distinguished, 81 and 100 are not.
    for distance, count in ((79, 1), (81, 0)):
        candidates = np.zeros((2, 128), np.uint8)
        candidates[0, 0], candidates[1, 0] = distance, 100
        left = features([(110, 80), (115, 80)], descriptors=candidates)
        found = match(right, left, rig=two, appearance=appearance)
        assert len(found) == count
        if count:
            assert found.measurement[0, 2] == pytest.approx(10.0)


# --------------------------------------------------------------------------------------------
# Ambiguity


def test_duplicate_texture_matches_nothing() -> None:
    """A row of equal features, as of a grating, has more than one admissible partner each."""
    columns = np.arange(20.0, 300.0, 10.0)
    right = features(np.column_stack([columns, np.full(len(columns), 50.0)]))
    left = features(np.column_stack([columns + 5.0, np.full(len(columns), 50.0)]))
    # The rightmost ones have a single candidate, but that one is wanted by others.
    assert len(match(right, left, rig=TWO_CAMERAS, max_disparity_px=35.0)) == 0
    # The same far enough apart for a single candidate each.
    assert len(match(right, left, rig=TWO_CAMERAS, max_disparity_px=9.0)) == len(columns)


def test_an_ambiguous_top_feature_discards() -> None:
    right, left = features(RIGHT), features((110.0, 80.0))
    assert len(match(right, left, features([(100.0, 90.0), (100.4, 90.3)]))) == 0
    # Two pairs that want the same top feature lose it both.
    right = features([RIGHT, (100.5, 80.0)], scale=[2.0, 3.5])
    left = features([(110.0, 80.0), (110.5, 80.0)], scale=[2.0, 3.5])
    assert len(match(right, left, rig=TWO_CAMERAS)) == 2
    assert len(match(right, left, features((100.0, 90.0), scale=2.6))) == 0


# --------------------------------------------------------------------------------------------
# What two of three images show


def match_all(
    *images: Features, rig: CameraRig = RIG, appearance: AppearanceSettings = DESCRIPTOR
) -> StereoFeatures:
    return StereoMatcher(rig, GATES, appearance).match_all(images)


def test_what_two_of_three_images_show_follows_what_all_show() -> None:
    right = features([RIGHT, (150.0, 120.0), (60.0, 40.0)])
    left = features([(110.0, 80.0), (162.0, 120.0)])
    top = features([(100.0, 90.0), (60.0, 48.0)])
    found = match_all(right, left, top)
    assert found.complete is not None
    assert found.complete.tolist() == [True, False, False]
    disparities = [[100.0, 80.0, 10.0], [150.0, 120.0, 12.0], [60.0, 40.0, 8.0]]
    np.testing.assert_allclose(found.measurement, disparities, rtol=0, atol=1e-9)
    shown = np.isfinite(found.pixels).all(axis=2).tolist()
    assert shown == [[True, True, True], [True, True, False], [True, False, True]]
    whole = match(right, left, top, appearance=DESCRIPTOR)
    assert_same_bits(found.whole, whole)


@pytest.mark.slow
def test_the_covariance_of_two_images_is_that_of_their_noise() -> None:
    """Monte Carlo: 4,000 draws give each entry within 5 % of the largest."""
    rig = dataclasses.replace(RIG, vertical_baseline=0.2)
    matcher = StereoMatcher(rig, GATES, DESCRIPTOR)
    rng = np.random.default_rng(0)
    nowhere = features(np.zeros((0, 2)))
    for camera, other in ((1, (110.0, 80.0)), (2, (100.0, 100.0))):
        measured = []
        for _ in range(4000):
            images = [features(RIGHT + 0.1 * rng.standard_normal(2)), nowhere, nowhere]
            images[camera] = features(other + 0.1 * rng.standard_normal(2))
            found = matcher.match_all(tuple(images))
            measured.append(found.measurement[0])
        scatter = np.cov(np.array(measured).T) / 0.01
        stated = found.measurement_covariance[0] / GATES.pixel_sigma**2
        np.testing.assert_allclose(np.mean(measured, axis=0), [100.0, 80.0, 10.0], atol=0.01)
        np.testing.assert_allclose(scatter, stated, rtol=0, atol=0.05 * stated.max())


def test_two_images_that_contradict_each_other_show_nothing() -> None:
    """Both have a partner of the right feature, but not at one depth."""
    right, left, top = features(RIGHT), features((110.0, 80.0)), features((100.0, 95.0))
    assert len(match_all(right, left, top)) == 0


@pytest.mark.parametrize("appearance", [PAPER, DESCRIPTOR], ids=["paper", "descriptor"])
def test_two_cameras_and_the_paper_have_complete_features_alone(
    appearance: AppearanceSettings,
) -> None:
    right, left, top = features(RIGHT), features((110.0, 80.0)), features((10.0, 10.0))
    two = match_all(right, left, rig=TWO_CAMERAS, appearance=appearance)
    assert len(two) == 1
    assert two.complete is None
    assert len(match_all(right, left, top, appearance=appearance)) == (appearance is DESCRIPTOR)


# --------------------------------------------------------------------------------------------
# The measurement and its covariance


@pytest.mark.parametrize(
    ("angles", "mean"),
    [
        ((350.0, 5.0, 8.0), 1.0),
        ((1.0, 359.0, 0.0), 0.0),
        ((90.0, 100.0, 95.0), 95.0),
        ((181.0, 179.0, 180.0), 180.0),
    ],
)
def test_orientation_is_averaged_around_the_circle(angles: tuple, mean: float) -> None:
    images = [
        features(at, scale=s, orientation_deg=a)
        for at, s, a in zip(
            [RIGHT, (110.0, 80.0), (100.0, 90.0)], (2.0, 2.2, 2.7), angles, strict=True
        )
    ]
    found = match(*images)
    assert found.scale[0] == pytest.approx(2.3)
    difference = np.rad2deg(wrap(found.orientation - np.deg2rad(mean)))
    np.testing.assert_allclose(difference, 0.0, atol=0.05)
    assert 0.0 <= found.orientation[0] < 2 * np.pi


def test_the_papers_measurement() -> None:
    """Reference row and column, mean disparity, (X, Y, Z) from them."""
    images = (features(RIGHT), features((110.2, 80.3)), features((100.4, 89.6)))
    found = match(*images, measurement="paper")
    np.testing.assert_allclose(found.measurement[0], [100.0, 80.0, (10.2 + 9.6) / 2], atol=1e-12)
    np.testing.assert_array_equal(found.pixels[0], [RIGHT, (110.2, 80.3), (100.4, 89.6)])
    depth = 277.0 * 0.1 / 9.9
    expected = [(100.0 - 159.5) * depth / 277.0, (80.0 - 119.5) * depth / 277.0, depth]
    np.testing.assert_allclose(found.position[0], expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["paper", "fused"])
@pytest.mark.parametrize(("ratio", "cameras"), [(1.0, 2), (0.5, 3), (2.5, 3)])
def test_exact_pixels_give_the_exact_measurement(kind: str, ratio: float, cameras: int) -> None:
    m = measurement_map(kind, cameras, ratio)
    column, row, disparity = 123.4, 56.7, 8.9
    pixels = [column, row, column + disparity, row, column, row + disparity / ratio]
    found = m @ np.array(pixels[: 2 * cameras])
    np.testing.assert_allclose(found, [column, row, disparity], atol=1e-12)


@pytest.mark.parametrize("kind", ["paper", "fused"])
@pytest.mark.parametrize("vertical", [0.1, 0.25, None])
def test_covariances_match_monte_carlo(kind: str, vertical: float | None) -> None:
    """Within 3 % of a hundred thousand noisy triples, in the image and in space."""
    rng = np.random.default_rng(10)
    rig = dataclasses.replace(RIG, vertical_baseline=vertical)
    at = [RIGHT, (118.0, 80.0), (100.0, 80.0 + 18.0 * (vertical or 0.0) / 0.1)][: rig.cameras]
    found = match(*[features(xy) for xy in at], rig=rig, measurement=kind, pixel_sigma=0.03)
    assert len(found) == 1
    matcher = StereoMatcher(rig, dataclasses.replace(GATES, measurement=kind), PAPER)
    drawn = np.array(at) + 0.03 * rng.standard_normal((100_000, rig.cameras, 2))
    images = [features(drawn[:, camera]) for camera in range(rig.cameras)]
    noisy, right = matcher.measured(tuple(images), matcher.equally(1.0))
    assert right.all()
    for sample, stated in (
        (noisy.measurement, found.measurement_covariance[0]),
        (noisy.position, found.position_covariance[0]),
    ):
        measured = np.cov(sample.T)
        scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
        np.testing.assert_allclose(measured / scale, stated / scale, rtol=0, atol=0.03)
        np.testing.assert_allclose(np.diag(measured), np.diag(stated), rtol=0.03)


@pytest.mark.parametrize("vertical", [0.25, None])
@pytest.mark.parametrize("places", get_args(RigPlaces))
def test_covariances_of_shifts_match_monte_carlo(places: RigPlaces, vertical: float | None) -> None:
    """The other images' places are off as the first one's is, and by less of their own."""
    rng = np.random.default_rng(12)
    rig = dataclasses.replace(RIG, vertical_baseline=vertical, places=places)
    matcher = StereoMatcher(rig, dataclasses.replace(GATES, pixel_sigma=0.1), PAPER)
    at = np.array([RIGHT, (118.0, 80.0), (100.0, 80.0 + 18.0 * 2.5)][: rig.cameras])
    drawn = at + 0.1 * rng.standard_normal((100_000, 1, 2))
    drawn[:, 1:] += SHIFT_SHARE * 0.1 * rng.standard_normal((len(drawn), rig.cameras - 1, 2))
    images = tuple(features(drawn[:, camera]) for camera in range(rig.cameras))
    linear = matcher.by_reference()
    seen = matcher.measured(images, linear)[0].measurement
    assert len(seen) == len(drawn)
    assert abs(seen.mean(axis=0) - [100.0, 80.0, 18.0]).max() < 0.01
    scale = np.sqrt(np.outer(np.diag(linear[1]), np.diag(linear[1])))
    np.testing.assert_allclose(np.cov(seen.T) / scale, linear[1] / scale, rtol=0, atol=0.02)


def test_empty_images_match_nothing() -> None:
    none = features(np.empty((0, 2)))
    some = features(RIGHT)
    for images in ((none, none, none), (some, none, none), (none, some, some)):
        for appearance in (PAPER, DESCRIPTOR):
            found = match(*images, appearance=appearance)
            assert len(found) == 0
            assert found.measurement.shape == found.position.shape == (0, 3)
            assert found.pixels.shape == (0, 3, 2)
            assert found.descriptors.shape == (0, 128)


@pytest.mark.parametrize("rig", [RIG, TWO_CAMERAS], ids=["three cameras", "two cameras"])
def test_a_correction_of_the_rig_is_taken_off_before_gates_and_fusion(rig: CameraRig) -> None:
    """What a knocked rig sees is measured as an exact one sees it; the raw pixels stay."""
    exact = [features(RIGHT), features((110.0, 80.0)), features((100.0, 90.0))][: rig.cameras]
    values = np.zeros(len(term_names(rig)))
    values[term_names(rig).index("left.row")] = 1.5 / rig.fy  # beyond the epipolar gate
    values[term_names(rig).index("left.column")] = -0.5 / rig.fx
    correction = RigCorrection(rig, values, np.eye(len(values)))
    seen = [exact[0], features((109.5, 81.5)), *exact[2:]]
    matcher = StereoMatcher(rig, GATES, PAPER)
    assert not len(matcher.match(tuple(seen)))
    found = matcher.match(tuple(seen), correction)
    np.testing.assert_allclose(found.measurement, [[100.0, 80.0, 10.0]], rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(found.pixels[0, :2], [RIGHT, (109.5, 81.5)])


# ------------------------------------------------------------------------------------------
# Features of the reference image measured in the others, on the images of a wall known exactly


def measured(images: tuple[Image, ...]) -> tuple[Features, StereoFeatures]:
    """Features of the first image, and those of them that all images show."""
    found = SiftExtractor(SiftSettings(), "descriptor").extract(images[0])
    matcher = StereoMatcher(WALL_RIG, StereoSettings(), AppearanceSettings())
    return found, PatchStereo(WALL_RIG, matcher, np.inf).match(Frame(0, 0.0, images), found)


def in_view(found: Features, disparity: float) -> int:
    """How many features all three images show with a patch around them."""
    size = np.array([WALL_RIG.width, WALL_RIG.height]) - 8.0
    return int(((found.xy > 8.0) & (found.xy + disparity < size)).all(axis=1).sum())


@pytest.mark.parametrize("depth", [0.6, WALL_M])
def test_features_are_measured_wherever_all_images_show_them(depth: float) -> None:
    """To a tenth of a pixel; at the borders, too, and near by (43 px of disparity)."""
    truth = WALL_RIG.fx * WALL_RIG.baseline / depth
    found, seen = measured(pictures(np.array([0.0, 0.0, WALL_M - depth])))
    assert len(seen) >= 0.9 * in_view(found, truth)
    error: FloatArray = seen.measurement[:, 2] - truth
    assert abs(float(np.median(error))) < 1.0 / 16.0
    assert float(1.4826 * np.median(np.abs(error))) < 0.1
    assert (np.abs(error) > 1.0).mean() < 0.02
    assert np.isin(seen.pixels[:, 0], found.xy).all()


def test_light_does_not_matter() -> None:
    images = pictures(HERE)
    dim = tuple(
        np.asarray(share * image, np.uint8)
        for share, image in zip((0.2, 0.15, 0.2), images, strict=True)
    )
    found, seen = measured(dim)
    assert len(seen) >= 0.8 * in_view(found, WALL_RIG.fx * WALL_RIG.baseline / WALL_M)


def test_what_another_image_does_not_show_is_left_out() -> None:
    images = [image.copy() for image in pictures(HERE)]
    images[1] = np.random.default_rng(1).integers(0, 255, images[1].shape, np.uint8)
    found, seen = measured(tuple(images))
    assert len(seen) <= 0.02 * len(found)


def test_what_lies_at_the_rim_of_an_image_is_left_out() -> None:
    """Where it shows nothing within half a patch: a rim is where it is in all images alike."""
    images = pictures(HERE)
    found = SiftExtractor(SiftSettings(), "descriptor").extract(images[0])
    matcher = StereoMatcher(WALL_RIG, StereoSettings(), AppearanceSettings())
    stereo = PatchStereo(WALL_RIG, matcher, np.inf)
    clear = np.full(images[0].shape, 100.0, np.float32)
    rim = clear.copy()
    rim[:, :50] = 0.0
    whole = stereo.match(Frame(0, 0.0, images, (clear,) * 3), found)
    cut = stereo.match(Frame(0, 0.0, images, (clear, rim, clear)), found)
    kept = np.rint(whole.pixels[:, 1, 0]) >= 50
    assert 0 < kept.sum() < len(kept)
    assert np.array_equal(cut.pixels, whole.pixels[kept])
    own = stereo.match(Frame(0, 0.0, images, (rim, clear, clear)), found)
    kept = np.rint(whole.pixels[:, 0, 0]) >= 50
    assert 0 < kept.sum() < len(kept)
    assert np.array_equal(own.pixels, whole.pixels[kept])


@pytest.mark.parametrize(("cameras", "others"), [(2, "auto"), (3, "auto"), (2, "sift")])
def test_two_cameras_need_features_of_one_image(
    cameras: int, others: Literal["auto", "sift"]
) -> None:
    rig = WALL_RIG if cameras == 3 else replace(WALL_RIG, vertical_baseline=None)
    settings = FrontendSettings(stereo=StereoSettings(others=others))
    describer = make_describer(rig, settings)
    frame = Frame(0, 0.0, pictures(HERE)[:cameras])
    found = describer.describe(0, frame)
    describer.close()
    one = cameras == 2 and others == "auto"
    assert len(found.features) == (1 if one else cameras)
    seen = make_stereo(rig, settings).match(frame, found.features)
    truth = WALL_RIG.fx * WALL_RIG.baseline / WALL_M
    assert len(seen) > 100
    assert abs(float(np.median(seen.measurement[:, 2])) - truth) < 0.05
    exact = np.array_equal(seen.measurement[:, :2], seen.pixels[:, 0])
    assert exact == one
    paper = replace(settings, stereo=replace(settings.stereo, measurement="paper"))
    assert not paper.stereo.by_patches(cameras)


def test_a_limit_beyond_half_the_width_is_looked_up_to() -> None:
    rig = replace(WALL_RIG, vertical_baseline=None)
    right, near = pictures(HERE)[0], 200
    left = np.roll(right, near, axis=1)
    left[:, :near] = 0
    found = SiftExtractor(SiftSettings(), "descriptor").extract(right)
    matcher = StereoMatcher(rig, StereoSettings(), AppearanceSettings())
    seen = PatchStereo(rig, matcher, 250.0).match(Frame(0, 0.0, (right, left)), found)
    assert len(seen) > 100
    assert abs(float(np.median(seen.measurement[:, 2])) - near) < 0.01


def test_an_image_may_have_more_features_than_opencv_samples_at_once() -> None:
    rng, n = np.random.default_rng(0), 33_000
    places = rng.uniform((40.0, 20.0), (280.0, 220.0), (n, 2))
    places[0] = np.nan
    found = Features(places, np.ones(n), np.zeros(n), np.zeros((n, 1), np.uint8))
    rig = replace(WALL_RIG, vertical_baseline=None)
    matcher = StereoMatcher(rig, StereoSettings(), AppearanceSettings())
    seen = PatchStereo(rig, matcher, np.inf).match(Frame(0, 0.0, pictures(HERE)[:2]), found)
    assert 0.9 * n < len(seen) < n


def test_rows_that_may_be_far_apart_are_matched_by_sift() -> None:
    assert StereoSettings(epipolar_px=2.0).by_patches(2)
    assert not StereoSettings(epipolar_px=3.0).by_patches(2)
    assert StereoSettings(epipolar_px=3.0, others="patches").by_patches(2)


def test_a_rig_of_a_log_by_patches_may_measure_by_sift() -> None:
    rig = replace(WALL_RIG, vertical_baseline=None, places="reference")
    settings = FrontendSettings(stereo=StereoSettings(others="sift"))
    assert as_measured(rig, settings).places == "all"
