"""Features of the reference image measured in the others, on the images of a wall known exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.log import Frame
from fgslam.core.types import Features, StereoFeatures
from fgslam.frontend.features.settings import AppearanceSettings, SiftSettings
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.settings import FrontendSettings, StereoSettings
from fgslam.frontend.stereo import PatchStereo, StereoMatcher
from fgslam.slam.build import as_measured, make_describer, make_stereo
from tests.textured_wall import HERE, RIG, WALL_M, pictures


def measured(images: tuple[Image, ...]) -> tuple[Features, StereoFeatures]:
    """Features of the first image, and those of them that all images show."""
    found = SiftExtractor(SiftSettings(), "descriptor").extract(images[0])
    matcher = StereoMatcher(RIG, StereoSettings(), AppearanceSettings())
    return found, PatchStereo(RIG, matcher, np.inf).match(Frame(0, 0.0, images), found)


def in_view(found: Features, disparity: float) -> int:
    """How many features all three images show with a patch around them."""
    size = np.array([RIG.width, RIG.height]) - 8.0
    return int(((found.xy > 8.0) & (found.xy + disparity < size)).all(axis=1).sum())


@pytest.mark.parametrize("depth", [0.6, 1.2, WALL_M])
def test_features_are_measured_wherever_all_images_show_them(depth: float) -> None:
    """To a tenth of a pixel; at the borders, too, and near by (43 px of disparity)."""
    truth = RIG.fx * RIG.baseline / depth
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
    assert len(seen) >= 0.8 * in_view(found, RIG.fx * RIG.baseline / WALL_M)


def test_few_grey_values_are_no_less_exact() -> None:
    """Whole pixels of disparity: rounded between pixels, the deviation was 0.13 px."""
    images = tuple(np.asarray(np.rint(image / 24.0), np.uint8) for image in pictures(HERE))
    found, seen = measured(images)
    truth = RIG.fx * RIG.baseline / WALL_M
    assert len(seen) >= 0.8 * in_view(found, truth)
    assert 1.4826 * np.median(np.abs(seen.measurement[:, 2] - truth)) < 0.01


def test_what_another_image_does_not_show_is_left_out() -> None:
    images = [image.copy() for image in pictures(HERE)]
    images[1] = np.random.default_rng(1).integers(0, 255, images[1].shape, np.uint8)
    found, seen = measured(tuple(images))
    assert len(seen) <= 0.02 * len(found)


def test_what_lies_at_the_rim_of_an_image_is_left_out() -> None:
    """Where it shows nothing within half a patch: a rim is where it is in all images alike."""
    images = pictures(HERE)
    found = SiftExtractor(SiftSettings(), "descriptor").extract(images[0])
    matcher = StereoMatcher(RIG, StereoSettings(), AppearanceSettings())
    stereo = PatchStereo(RIG, matcher, np.inf)
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
    rig = RIG if cameras == 3 else replace(RIG, vertical_baseline=None)
    settings = FrontendSettings(stereo=StereoSettings(others=others))
    describer = make_describer(rig, settings)
    frame = Frame(0, 0.0, pictures(HERE)[:cameras])
    found = describer.describe(0, frame)
    describer.close()
    one = cameras == 2 and others == "auto"
    assert len(found.features) == (1 if one else cameras)
    seen = make_stereo(rig, settings).match(frame, found.features)
    truth = RIG.fx * RIG.baseline / WALL_M
    assert len(seen) > 100
    assert abs(float(np.median(seen.measurement[:, 2])) - truth) < 0.05
    exact = np.array_equal(seen.measurement[:, :2], seen.pixels[:, 0])
    assert exact == one
    paper = replace(settings, stereo=replace(settings.stereo, measurement="paper"))
    assert not paper.stereo.by_patches(cameras)


def test_swapped_cameras_give_next_to_nothing() -> None:
    right, left, top = pictures(np.array([0.0, 0.0, 1.0]))
    found, seen = measured((left, right, top))
    assert len(seen) <= 0.02 * len(found)


def test_a_limit_beyond_half_the_width_is_looked_up_to() -> None:
    rig = replace(RIG, vertical_baseline=None)
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
    rig = replace(RIG, vertical_baseline=None)
    matcher = StereoMatcher(rig, StereoSettings(), AppearanceSettings())
    seen = PatchStereo(rig, matcher, np.inf).match(Frame(0, 0.0, pictures(HERE)[:2]), found)
    assert 0.9 * n < len(seen) < n


def test_images_smaller_than_a_block_are_no_match() -> None:
    rig = replace(RIG, width=16, height=16, vertical_baseline=None)
    found = Features(np.full((1, 2), 8.0), np.ones(1), np.zeros(1), np.zeros((1, 1), np.uint8))
    matcher = StereoMatcher(rig, StereoSettings(), AppearanceSettings())
    images = (np.zeros((16, 16), np.uint8),) * 2
    assert not len(PatchStereo(rig, matcher, np.inf).match(Frame(0, 0.0, images), found))


def test_rows_that_may_be_far_apart_are_matched_by_sift() -> None:
    assert StereoSettings(epipolar_px=2.0).by_patches(2)
    assert not StereoSettings(epipolar_px=3.0).by_patches(2)
    assert StereoSettings(epipolar_px=3.0, others="patches").by_patches(2)


def test_a_rig_of_a_log_by_patches_may_measure_by_sift() -> None:
    rig = replace(RIG, vertical_baseline=None, places="reference")
    settings = FrontendSettings(stereo=StereoSettings(others="sift"))
    assert as_measured(rig, settings).places == "all"


def test_no_features_are_no_match() -> None:
    found = SiftExtractor(SiftSettings(), "descriptor").extract(np.zeros((240, 320), np.uint8))
    matcher = StereoMatcher(RIG, StereoSettings(), AppearanceSettings())
    assert not len(PatchStereo(RIG, matcher, np.inf).match(Frame(0, 0.0, pictures(HERE)), found))
