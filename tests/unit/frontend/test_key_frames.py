"""When carried landmarks place a frame, and when it is left to SIFT."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fgslam.core.arrays import IntArray
from fgslam.core.store import state_of
from fgslam.core.types import CUT_PIXELS, EgoMotion, EgoMotionStatus, StereoFeatures
from fgslam.frontend.features.settings import AppearanceSettings
from fgslam.frontend.settings import DatabaseSettings, StereoSettings
from fgslam.frontend.stereo import StereoMatcher
from fgslam.frontend.tracking.key_frames import (
    Begun,
    Carried,
    CarriedFrame,
    KeyFrameTracker,
    LandmarkCarrier,
    spread,
)
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.frontend.tracking.map_matching import MapMatches
from fgslam.frontend.tracking.tracker import Association, Tracked
from tests.textured_wall import HERE, RIG, pictures

ENOUGH = 40


def frame(inliers: int, outliers: int, status: EgoMotionStatus = EgoMotionStatus.OK) -> Any:
    used = np.arange(inliers + outliers) < inliers
    pose = EgoMotion(np.eye(4), np.eye(6), used, np.zeros(len(used)), status, 1)
    tracked: Any = SimpleNamespace(ego_motion=pose)
    return CarriedFrame(Carried.nothing(), tracked, lasting=True)


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


def test_a_pose_that_was_not_measured_places_nothing() -> None:
    assert not frame(100, 0, EgoMotionStatus.DIVERGED).placed


def test_few_that_are_left_ask_for_a_key_frame_beside_which_they_are_used() -> None:
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


def test_no_feature_begins_nothing() -> None:
    assert starting(features_at([], [])) == []


@pytest.mark.parametrize(("outliers", "lasting"), [(19, True), (21, False)])
def test_many_that_contradict_the_pose_ask_for_a_key_frame(outliers: int, lasting: bool) -> None:
    carried = Carried(
        np.arange(100),
        np.arange(100),
        features_at([(float(k), 50.0) for k in range(100)], [1.0] * 100),
    )
    used = np.arange(100) >= outliers
    pose = EgoMotion(np.eye(4), np.eye(6), used, np.zeros(100), EgoMotionStatus.OK, 1)
    tracked: Any = SimpleNamespace(ego_motion=pose)
    tracker = KeyFrameTracker(SimpleNamespace(), SimpleNamespace())  # type: ignore[arg-type]
    assert tracker.lasts(carried, tracked, np.zeros((100, 100), np.uint8)) is lasting
