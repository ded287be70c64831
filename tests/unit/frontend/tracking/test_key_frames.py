"""Landmarks tracked by patches between key frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from textured_wall import HERE, RIG, WALL_M, pictures

from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.store import restore, state_of
from fgslam.core.types import (
    CUT_PIXELS,
    PATCH_PX,
    EgoMotion,
    EgoMotionStatus,
    LandmarkPatches,
    StereoFeatures,
)
from fgslam.frontend.features.patches import ReferencePatches, crowding
from fgslam.frontend.features.sift import FineImage
from fgslam.frontend.settings import AppearanceSettings, DatabaseSettings, StereoSettings
from fgslam.frontend.stereo import StereoMatcher
from fgslam.frontend.tracking.key_frames import (
    NOISE_SHARE,
    Begun,
    Carried,
    CarriedFrame,
    KeyFrameTracker,
    LandmarkCarrier,
    Points,
    spread,
)
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.frontend.tracking.map_matching import ExpectedLandmarks, MapMatches
from fgslam.frontend.tracking.tracker import Association, Tracked

# ------------------------------------------------------------------------------------------
# Landmarks carried over the images of a textured wall, whose projections are known exactly


GRID = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.5, 0.5, 6)), -1).reshape(
    -1, 2
)


def measurements(place: FloatArray) -> FloatArray:
    """(n, 3) of the grid's points, exact."""
    points = np.column_stack([GRID, np.full(len(GRID), WALL_M)]) - place
    return RIG.predict(points)


def expected(place: FloatArray, off: float = 0.0) -> ExpectedLandmarks:
    """The grid as expected from a place, ``off`` pixels wrong in the image."""
    n = len(GRID)
    measurement = measurements(place)
    measurement[:, :2] += off
    return ExpectedLandmarks(
        ids=10 + np.arange(n),
        rows=np.arange(n),
        measurement=measurement,
        scale=np.full(n, 2.0),
        orientation=np.full(n, 1.0),
        descriptors=np.full((n, 128), 7, np.uint8),
        certain=np.ones(n, np.bool_),
    )


def begun(images: tuple[Image, ...], place: FloatArray) -> LandmarkCarrier:
    stereo = StereoMatcher(RIG, StereoSettings(), AppearanceSettings())
    carrier = LandmarkCarrier(RIG, stereo)
    seen = measurements(place)
    carrier.begin(images[0], Begun.new(FineImage(images[0]), points(seen[:, :2], place)))
    return carrier


def points(places: FloatArray, place: FloatArray) -> Points:
    """The grid at places of an image taken from a place."""
    return Points(10 + np.arange(len(GRID)), places, np.full(len(GRID), WALL_M - place[2]))


def found_again(place: FloatArray, off: FloatArray) -> tuple[ReferencePatches, Points]:
    """What was first seen from here, as SIFT finds it again elsewhere, off (n, 2) pixels."""
    here, now = pictures(HERE)[0], pictures(place)
    first = Begun.new(FineImage(here), points(measurements(HERE)[:, :2], HERE))
    again = points(measurements(place)[:, :2] + off, place)
    carrier = begun(now, place)
    return carrier.find_again(FineImage(now[0]), Begun.again(again, first.patches(here)))


def followed(carrier: LandmarkCarrier, place: FloatArray, off: float = 0.0) -> Carried:
    found = carrier.follow(pictures(place), expected(place, off))
    assert found is not None
    return found


@pytest.mark.parametrize(
    "place", [np.array([0.03, 0.01, 0.0]), np.array([0.0, 0.0, 0.25]), np.array([0.02, 0.0, -0.2])]
)
def test_points_are_found_in_all_images_to_a_tenth_of_a_pixel(place: FloatArray) -> None:
    """Sideways, and nearer or farther by more than a tenth, with a prediction 2 px off.

    All of them are off by up to a sixteenth of a pixel: OpenCV rounds what it samples to 1/32,
    here once when the wall is drawn, and once when its patches are.
    """
    found = followed(begun(pictures(HERE), HERE), place, off=2.0)
    assert len(found) >= 45
    assert (np.diff(found.ids) > 0).all()
    truth = measurements(place)[found.ids - 10]
    error = found.features.measurement - truth
    assert np.abs(np.median(error, axis=0)).max() < 1.0 / 16.0
    assert error.std(axis=0).max() < 0.1
    np.testing.assert_allclose(found.features.pixels[:, 0], truth[:, :2], rtol=0, atol=0.4)


def test_errors_do_not_add_up() -> None:
    """Thirty images of a drive forward and sideways, each with its noise."""
    rng = np.random.default_rng(3)
    carrier = begun(pictures(HERE, rng), HERE)
    for k in range(1, 31):
        place = k * np.array([0.004, 0.002, 0.012])
        found = carrier.follow(pictures(place, rng), expected(place))
        assert found is not None
        error = found.features.measurement - measurements(place)[found.ids - 10]
        assert error.std(axis=0).max() < 0.12, k
        assert np.abs(np.median(error, axis=0)).max() < 0.06, k
    assert len(found) >= 25


@pytest.mark.parametrize(("nearer", "least"), [(0.2, 40), (0.9, 10)])
def test_a_landmark_found_again_is_placed_by_its_own_patch(nearer: float, least: int) -> None:
    """Half a pixel off where features found it; larger by a tenth, or nearly twice as large."""
    off = np.random.default_rng(4).normal(0.0, 0.5, (len(GRID), 2))
    place = np.array([0.02, 0.0, nearer])
    patches, at = found_again(place, off)
    error = at.places - measurements(place)[at.ids - 10, :2]
    assert len(at) >= least
    assert error.std(axis=0).max() < 0.12
    assert np.abs(np.median(error, axis=0)).max() < 0.08
    sizes = np.sqrt(np.linalg.det(patches.maps))
    np.testing.assert_allclose(np.median(sizes), WALL_M / (WALL_M - nearer), rtol=0.02)


def test_what_appears_different_by_now_is_not_found_again() -> None:
    """Every second one is taken for what lies ten pixels next to it."""
    off = np.where(np.arange(len(GRID))[:, None] % 2, [9.0, -7.0], 0.0)
    _, at = found_again(np.array([0.02, 0.0, 0.0]), off)
    same = np.isin(at.ids - 10, np.flatnonzero(off[:, 0] == 0.0))
    assert same.sum() >= 25
    assert (~same).sum() <= 2


def test_a_landmark_without_a_patch_is_not_carried() -> None:
    image = pictures(HERE)[0]
    first = Begun.new(FineImage(image), points(measurements(HERE)[:, :2], HERE))
    patches = first.patches(image)
    distances = np.where(np.arange(len(GRID)) < 5, patches.distances, 0.0)
    again = Begun.again(first.points, LandmarkPatches(patches.grey, distances))
    assert again.points.ids.tolist() == [10, 11, 12, 13, 14]


def test_no_patch_is_kept_that_reaches_beyond_the_border() -> None:
    """Its repeated pixels would pull the landmark to the border wherever it is found again."""
    image = pictures(HERE)[0]
    at = np.array([[2.0, 100.0], [6.0, 100.0], [160.0, 4.0], [160.0, 120.0], [315.0, 237.0]])
    begun = Begun.new(FineImage(image), Points(np.arange(5), at, np.full(5, 2.0)))
    assert begun.patches(image).distances.tolist() == [0.0, 2.0, 0.0, 2.0, 0.0]


def test_what_is_covered_in_one_image_is_not_carried() -> None:
    place = np.array([0.01, 0.0, 0.0])
    for camera in range(3):
        images = [image.copy() for image in pictures(place)]
        images[camera][:, :160] = np.random.default_rng(1).integers(0, 255, (240, 160))
        found = begun(pictures(HERE), HERE).follow(tuple(images), expected(place))
        assert found is not None
        covered = found.features.pixels[:, camera, 0] < 150.0
        assert len(found) > 10
        assert covered.sum() <= 1


def test_what_the_map_does_not_expect_is_forgotten() -> None:
    carrier = begun(pictures(HERE), HERE)
    place = np.array([0.01, 0.0, 0.0])
    all_of_them = expected(place)
    half = ExpectedLandmarks(
        **{name: getattr(all_of_them, name)[::2] for name in ExpectedLandmarks.__slots__}
    )
    found = carrier.follow(pictures(place), half)
    assert found is not None
    assert set(found.ids) <= set(half.ids)
    np.testing.assert_array_equal(half.ids[found.rows], found.ids)
    assert set(carrier.ids) == set(found.ids)


def test_a_large_motion_is_left_to_features() -> None:
    """A quarter of the image."""
    place = np.array([0.6, 0.0, 0.0])
    carrier = begun(pictures(HERE), HERE)
    assert carrier.follow(pictures(place), expected(place)) is None
    assert not len(carrier.ids)
    assert carrier.follow(pictures(place), expected(place)) is None


def test_appearances_are_those_expected_and_noise_is_stated() -> None:
    found = followed(begun(pictures(HERE), HERE), HERE)
    features = found.features
    np.testing.assert_allclose(features.scale, 2.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(features.orientation, 1.0, rtol=0, atol=1e-12)
    assert (features.descriptors == 7).all()
    stereo = StereoMatcher(RIG, StereoSettings(pixel_sigma=1.0), AppearanceSettings())
    linear = stereo.equally(1.0)[0]
    one = linear @ linear.T
    share = features.measurement_covariance[0] / one
    sigma = StereoSettings().pixel_sigma * NOISE_SHARE
    crowded = crowding(features.pixels[:, 0], PATCH_PX)[0]
    stated = crowded * sigma**2
    np.testing.assert_allclose(share[[0, 1, 2], [0, 1, 2]], stated, rtol=1e-9, atol=0)


def test_a_restored_carrier_goes_on_to_the_same_bits() -> None:
    places = [k * np.array([0.01, 0.0, 0.02]) for k in range(5)]
    one = begun(pictures(HERE), HERE)
    for k in range(1, 5):
        other = begun(pictures(HERE), np.array([0.3, 0.3, 0.3]))
        restore(other, state_of(one))
        a, b = followed(one, places[k]), followed(other, places[k])
        np.testing.assert_array_equal(a.ids, b.ids)
        np.testing.assert_array_equal(a.features.pixels, b.features.pixels)
        for name, array in state_of(one).items():
            np.testing.assert_array_equal(array, state_of(other)[name])


# ------------------------------------------------------------------------------------------
# When carried landmarks place a frame, and when it is left to SIFT


ENOUGH = 40


def frame(inliers: int, outliers: int, status: EgoMotionStatus = EgoMotionStatus.OK) -> Any:
    used = np.arange(inliers + outliers) < inliers
    pose = EgoMotion(np.eye(4), np.eye(6), used, np.zeros(len(used)), status, 1)
    tracked: Any = SimpleNamespace(ego_motion=pose)
    carried: Any = None
    return CarriedFrame(carried, tracked, lasting=True)


@pytest.mark.parametrize(
    ("inliers", "outliers", "placed"),
    [(ENOUGH, 0, True), (ENOUGH - 1, 0, False), (100, 100, True), (100, 101, False)],
)
def test_enough_landmarks_that_mostly_agree_place_a_frame(
    inliers: int, outliers: int, placed: bool
) -> None:
    found = frame(inliers, outliers)
    assert found.placed is placed
    assert found.suffices is placed


def test_few_that_are_left_ask_for_a_key_frame_next_to_which_they_are_used() -> None:
    found = replace(frame(100, 0), lasting=False)
    assert found.placed
    assert not found.suffices


# --------------------------------------------------------------------------------------------
# Where landmarks begin


def features_at(places: list[tuple[float, float]], scales: list[float]) -> StereoFeatures:
    n = len(places)
    xy = np.array(places, np.float64).reshape(-1, 2)
    return StereoFeatures(
        measurement=np.column_stack([xy, np.full(n, 10.0)]),
        measurement_covariance=np.tile(np.eye(3), (n, 1, 1)),
        scale=np.array(scales),
        orientation=np.zeros(n),
        descriptors=np.zeros((n, 128), np.uint8),
        position=np.ones((n, 3)),
        position_covariance=np.tile(np.eye(3), (n, 1, 1)),
        pixels=np.zeros((n, 3, 2)),
    )


def starting(
    features: StereoFeatures, matched: list[int] | None = None, agreeing: list[bool] | None = None
) -> list[int]:
    """Features that begin a landmark, where ``matched`` are taken for landmarks already."""
    seen = np.array(matched or [], np.int64)
    had = np.isin(np.arange(len(features)), seen)
    inliers = np.array(agreeing or [True] * len(seen), np.bool_)
    pose = EgoMotion(
        np.eye(4), np.eye(6), inliers, np.zeros(len(seen)), EgoMotionStatus.OK, 1
    )  # fmt: skip
    tracked = Tracked(SimpleNamespace(), MapMatches(np.arange(len(seen)), seen, had), pose)  # type: ignore[arg-type]
    return np.flatnonzero(~spread(tracked, features).matches.had_candidates).tolist()


def test_a_landmark_found_again_keeps_the_patch_of_its_first_key_frame() -> None:
    """The second key frame finds it half a pixel off, at half the distance."""
    images = [pictures(HERE)[0], pictures(np.array([0.0, 0.0, 1.0]))[0]]
    database = LandmarkDatabase(RIG, DatabaseSettings(), 40.0, CUT_PIXELS)
    stereo = StereoMatcher(RIG, StereoSettings(), AppearanceSettings())
    tracker: Any = SimpleNamespace(database=database)
    carrier = LandmarkCarrier(RIG, stereo)
    key_frames = KeyFrameTracker(tracker, carrier)
    first = seen_at([(100.0, 90.0), (200.0, 120.0)], 2.0)
    ids = database.add(first, np.arange(2), np.zeros(2, np.uint8))
    key_frames.begin(images[0], first, association(first, ids, is_new=True))
    kept = database.patches(ids)
    assert kept.distances.tolist() == [2.0, 2.0]
    carrier.forget(ids)
    carrier.begin(images[1], Begun.none())
    second = seen_at([(100.5, 90.0), (200.0, 119.5)], 1.0)
    key_frames.begin(images[1], second, association(second, ids, is_new=False))
    again = database.patches(ids)
    np.testing.assert_array_equal(again.grey, kept.grey)
    np.testing.assert_array_equal(again.distances, kept.distances)
    state = state_of(key_frames)
    np.testing.assert_array_equal(state["carrier/fresh/cut"], kept.grey)
    assert state["carrier/fresh/growth"].tolist() == [2.0, 2.0]
    assert state["carrier/fresh/known"].all()


def seen_at(places: list[tuple[float, float]], distance: float) -> StereoFeatures:
    """Features of the reference image at places, so far away."""
    features = features_at(places, [2.0] * len(places))
    pixels = np.repeat(features.measurement[:, None, :2], 3, axis=1)
    away = np.tile([0.0, 0.0, distance], (len(places), 1))
    return replace(features, pixels=pixels, position=away)


def association(features: StereoFeatures, ids: IntArray, is_new: bool) -> Association:
    every, none = np.arange(len(ids)), np.empty(0, np.int64)
    observed = features.observations(every, ids, is_new)
    return Association(observed, np.zeros(len(ids), np.bool_), none, none, every)


def test_of_two_features_in_one_place_the_finer_begins_a_landmark() -> None:
    assert starting(features_at([(12.0, 7.0), (12.0, 7.0), (40.0, 7.0)], [3.0, 2.0, 9.0])) == [1, 2]


@pytest.mark.parametrize(("agrees", "begins"), [(True, []), (False, [1])])
def test_a_square_that_shows_a_landmark_begins_none(agrees: bool, begins: list[int]) -> None:
    """One whose match contradicts the pose shows nothing."""
    features = features_at([(12.0, 7.0), (13.0, 8.0)], [3.0, 2.0])
    assert starting(features, [0], [agrees]) == begins


def test_a_feature_that_not_all_images_show_holds_no_square() -> None:
    features = features_at([(12.0, 7.0), (13.0, 8.0)], [1.0, 2.0])
    partial = replace(features, complete=np.array([False, True]))
    assert 1 in starting(partial)


def test_places_beyond_the_border_have_squares_of_their_own() -> None:
    assert starting(features_at([(-1.0, 7.0), (119.0, 2.0), (2.0, 7.0)], [1.0] * 3)) == [0, 1, 2]


@pytest.mark.parametrize(("outliers", "lasting"), [(19, True), (21, False)])
def test_many_that_contradict_the_pose_ask_for_a_key_frame(outliers: int, lasting: bool) -> None:
    carried = Carried(
        np.arange(100),
        np.arange(100),
        np.zeros((100, 2)),
        features_at([(float(k), 50.0) for k in range(100)], [1.0] * 100),
    )
    used = np.arange(100) >= outliers
    pose = EgoMotion(np.eye(4), np.eye(6), used, np.zeros(100), EgoMotionStatus.OK, 1)
    tracked: Any = SimpleNamespace(ego_motion=pose)
    tracker = KeyFrameTracker(SimpleNamespace(), SimpleNamespace())  # type: ignore[arg-type]
    assert tracker.lasts(carried, tracked, np.zeros((100, 100), np.uint8)) is lasting


@pytest.mark.parametrize(
    ("left", "likely"),
    [([], False), ([90, 70], False), ([70, 52], True), ([60], False), ([52], True)],
)
def test_a_key_frame_is_expected_where_as_large_a_share_is_lost_again(
    left: list[int], likely: bool
) -> None:
    """Of 100 landmarks 40 must be left: 70 and 52 make 39, 90 and 70 make 54.

    Of the first loss the root: 60 make 46, 52 make 37.
    """
    key_frames, key_frame = tracking_of_a_wall()
    key_frame()
    for count in left:
        key_frames.record(
            replace(frame(count, 0), carried=SimpleNamespace(ids=np.arange(count), features=None))
        )
    assert key_frames.nears_end is likely


def test_after_two_key_frames_in_a_row_another_is_expected() -> None:
    key_frames, key_frame = tracking_of_a_wall()
    key_frame()
    key_frame()
    assert key_frames.nears_end


def tracking_of_a_wall() -> tuple[KeyFrameTracker, Callable[[], None]]:
    """A tracker that a frame has left a hundred landmarks, and what makes a key frame of them."""
    image = pictures(HERE)[0]
    database = LandmarkDatabase(RIG, DatabaseSettings(), 40.0, CUT_PIXELS)
    tracker: Any = SimpleNamespace(database=database, associate_carried=lambda *_: None)
    key_frames = KeyFrameTracker(
        tracker, LandmarkCarrier(RIG, StereoMatcher(RIG, StereoSettings(), AppearanceSettings()))
    )
    seen = seen_at([(60.0 + k, 50.0 + k % 60) for k in range(100)], 2.0)
    ids = database.add(seen, np.arange(100), np.zeros(100, np.uint8))
    key_frames.record(replace(frame(100, 0), carried=SimpleNamespace(ids=ids, features=None)))
    return key_frames, lambda: key_frames.begin(image, seen, association(seen, ids, is_new=True))
