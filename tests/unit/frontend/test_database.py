"""The landmark database (Se et al. 4 and 6.1)."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
from simulated import RIG, assert_same_bits

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.sensors import CameraRig
from fgslam.core.store import restore, state_of
from fgslam.core.types import LandmarkMap, LandmarkPatches, Prediction, StereoFeatures
from fgslam.frontend.settings import DatabaseSettings
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.frontend.tracking.map_matching import predicted_covariance

SETTINGS = DatabaseSettings()
CONE = DatabaseSettings(field_of_view="cone")
TWO_CAMERAS = dataclasses.replace(RIG, vertical_baseline=None)


def stereo_features(points: FloatArray, scale: float = 3.0) -> StereoFeatures:
    """Exact features of points (n, 3) in the camera's frame, each with its own descriptor."""
    count = len(points)
    measured = g.project(RIG, points)
    covariance = np.tile(0.09 * np.eye(3), (count, 1, 1))
    descriptors = np.random.default_rng(1).integers(0, 256, (count, 128)).astype(np.uint8)
    return StereoFeatures(
        measurement=measured,
        measurement_covariance=covariance,
        scale=np.full(count, scale),
        orientation=np.linspace(0.1, 6.0, count),
        descriptors=descriptors,
        position=points.copy(),
        position_covariance=g.triangulation_covariance(RIG, measured, covariance),
        pixels=np.full((count, 3, 2), np.nan),
    )


def database_of(
    points: FloatArray, settings: DatabaseSettings = SETTINGS, rig: CameraRig = RIG
) -> LandmarkDatabase:
    database = LandmarkDatabase(rig, settings, 40.0)
    count = len(points)
    database.add(stereo_features(points), np.arange(count), np.zeros(count, np.uint8))
    return database


def landmark_map(points: FloatArray, ids: IntArray | None = None) -> LandmarkMap:
    ids = np.arange(len(points)) if ids is None else ids
    return LandmarkMap(ids, points, np.tile(1e-4 * np.eye(3), (len(points), 1, 1)))


def at_pixels(rows: list[tuple[float, float, float]]) -> FloatArray:
    """Points whose (column, row, disparity) are those given."""
    return g.triangulate(RIG, np.array(rows, np.float64))


def expected_ids(points: FloatArray, settings: DatabaseSettings, rig: CameraRig = RIG) -> list[int]:
    database = database_of(points, settings, rig)
    expected = database.expected(landmark_map(points), np.eye(4))
    return expected.ids[expected.certain].tolist()


# --------------------------------------------------------------------------------------------
# Field of view


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_cone_ends_at_30_degrees_on_both_axes(axis: int, sign: float) -> None:
    angles = np.deg2rad([29.99, 30.01])
    points = np.tile([0.0, 0.0, 3.0], (2, 1))
    points[:, axis] = sign * 3.0 * np.tan(angles)
    assert expected_ids(points, CONE) == [0]


def test_the_cone_is_one_of_the_axes_not_of_the_ray() -> None:
    """At 29 degrees on both axes at once the ray itself is beyond 30."""
    corner = 3.0 * np.tan(np.deg2rad(29.0))
    assert expected_ids(np.array([[corner, corner, 3.0]]), CONE) == [0]


def test_the_cone_expects_what_the_image_cannot_show() -> None:
    """320x240 with 60 degrees across sees 23.4 degrees up and down."""
    point = np.array([[0.0, 3.0 * np.tan(np.deg2rad(27.0)), 3.0]])
    assert g.project(RIG, point)[0, 1] > RIG.height
    assert expected_ids(point, CONE) == [0]
    assert expected_ids(point, SETTINGS) == []


@pytest.mark.parametrize("settings", [SETTINGS, CONE])
def test_nothing_behind_the_camera_is_expected(settings: DatabaseSettings) -> None:
    points = np.array([[0.1, 0.0, -3.0], [0.0, 0.0, 0.0], [0.0, 0.0, -1e-9], [0.1, 0.0, 3.0]])
    database = database_of(np.tile([0.0, 0.0, 3.0], (4, 1)), settings)
    assert database.expected(landmark_map(points), np.eye(4)).ids.tolist() == [3]


BOUNDS = {
    # column, row, disparity just inside and just outside of all three images with 8 px left out
    "left edge": ((8.01, 100, 10), (7.99, 100, 10)),
    "right edge, by the left camera": ((300.99, 100, 10), (301.01, 100, 10)),
    "upper edge": ((100, 8.01, 10), (100, 7.99, 10)),
    "lower edge, by the top camera": ((100, 220.99, 10), (100, 221.01, 10)),
    "nearest": ((100, 100, 39.99), (100, 100, 40.01)),
}
POSSIBLE = {
    # the same with 8 px beyond the images
    "left edge": ((-7.99, 100, 10), (-8.01, 100, 10)),
    "right edge, by the left camera": ((316.99, 100, 10), (317.01, 100, 10)),
    "upper edge": ((100, -7.99, 10), (100, -8.01, 10)),
    "lower edge, by the top camera": ((100, 236.99, 10), (100, 237.01, 10)),
}


@pytest.mark.parametrize("edge", BOUNDS)
def test_the_images_bounds(edge: str) -> None:
    assert expected_ids(at_pixels(list(BOUNDS[edge])), SETTINGS) == [0]


@pytest.mark.parametrize("edge", POSSIBLE)
def test_at_the_border_a_landmark_may_be_matched_but_is_not_missed(edge: str) -> None:
    points = at_pixels(list(POSSIBLE[edge]))
    expected = database_of(points, SETTINGS).expected(landmark_map(points), np.eye(4))
    assert expected.ids.tolist() == [0]
    assert expected.certain.tolist() == [False]


def test_without_a_top_camera_the_lower_edge_is_the_images_own() -> None:
    points = at_pixels([(100, 230.99, 10), (100, 231.01, 10)])
    assert expected_ids(points, SETTINGS, TWO_CAMERAS) == [0]


def test_unequal_baselines_move_the_lower_edge() -> None:
    rig = dataclasses.replace(RIG, vertical_baseline=0.3)
    points = at_pixels([(100, 239 - 8 - 30.01, 10), (100, 239 - 8 - 29.99, 10)])
    assert expected_ids(points, SETTINGS, rig) == [0]


# --------------------------------------------------------------------------------------------
# Prediction


@pytest.mark.parametrize("forward", [0.5, 1.0, -2.0])
def test_the_scale_follows_the_depth(forward: float) -> None:
    """s' = s Z / Z', with the depth and not the range."""
    points = np.array([[0.3, 0.2, 4.0], [-0.5, 0.1, 3.0]])
    database = database_of(points)
    wTc = g.pose(np.eye(3), np.array([0.0, 0.0, forward]))
    expected = database.expected(landmark_map(points), wTc)
    np.testing.assert_allclose(expected.scale, 3.0 * points[:, 2] / (points[:, 2] - forward))


def test_perfect_odometry_predicts_perfectly() -> None:
    rng = np.random.default_rng(2)
    local = at_pixels([(80, 60, 8), (200, 110, 12), (150, 150, 20)])
    wTc = g.se3_exp(0.3 * rng.standard_normal(6))
    world = g.transform_to_world(wTc, local)
    expected = database_of(local).expected(landmark_map(world), wTc)
    np.testing.assert_allclose(
        expected.measurement, [(80, 60, 8), (200, 110, 12), (150, 150, 20)], atol=1e-9
    )
    np.testing.assert_allclose(expected.scale, 3.0)


def test_expected_landmarks_carry_their_own_appearance() -> None:
    points = at_pixels([(80, 60, 8), (-50, 110, 12), (150, 150, 20), (200, 100, 5)])
    database = database_of(points)
    features = stereo_features(points)
    expected = database.expected(landmark_map(points), np.eye(4))
    assert expected.ids.tolist() == [0, 2, 3]
    assert expected.rows.tolist() == [0, 2, 3]
    np.testing.assert_array_equal(expected.descriptors, features.descriptors[[0, 2, 3]])
    np.testing.assert_array_equal(expected.orientation, features.orientation[[0, 2, 3]])


def test_landmark_ids_may_differ_from_row_numbers() -> None:
    points = at_pixels([(80, 60, 8), (100, 110, 12), (150, 150, 20), (200, 100, 5)])
    database = database_of(points, DatabaseSettings(prune_after_misses=1))
    database.record_misses(np.array([1]))
    assert database.prune().tolist() == [1]
    kept = np.array([0, 2, 3])
    expected = database.expected(landmark_map(points[kept], kept), np.eye(4))
    assert expected.ids.tolist() == [0, 2, 3]
    assert expected.rows.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(expected.descriptors, stereo_features(points).descriptors[kept])


def test_a_confirmed_landmark_is_not_missed_from_farther_than_it_was_ever_seen() -> None:
    """What hid it when the drive came hides it again; a single sighting tells no such distance."""
    points = np.array([[0.0, 0.0, 3.0], [0.2, 0.0, 3.0]])
    database = database_of(points)
    for z in (2.0, 1.5):
        seen = stereo_features(points - [0.0, 0.0, 3.0 - z])
        database.record_hits(np.array([0]), seen, np.array([0]))
    for z, certain in ((0.01, [True, True]), (-0.01, [False, True])):
        expected = database.expected(landmark_map(points), g.se3_exp(np.array([0, 0, 0, 0, 0, z])))
        assert expected.ids.tolist() == [0, 1]
        assert expected.certain.tolist() == certain
    database.merge(np.array([[1, 0]]))
    restored = LandmarkDatabase(RIG, SETTINGS, 40.0)
    restore(restored, state_of(database))
    behind = g.se3_exp(np.array([0, 0, 0, 0, 0, -0.01]))
    assert restored.expected(landmark_map(points[:1]), behind).certain.tolist() == [False]


def test_a_miss_on_a_key_frame_counts_the_frames_in_view_that_did_not_look() -> None:
    """Three frames carry the third of four landmarks; the last is not in their view."""
    database = LandmarkDatabase(RIG, DatabaseSettings(), 40.0)
    points = at_pixels([(80, 60, 8), (100, 110, 12), (150, 150, 20), (90, 90, 9)])
    database.add(stereo_features(points), np.arange(4), np.zeros(4, np.uint8))
    database.prune()
    database.record_carried(np.array([1, 2]), np.array([0]))
    database.record_carried(np.array([2]), np.array([0, 1]))
    database.record_carried(np.array([2]), np.array([0, 1]))
    database.record_misses(np.array([0, 1, 2, 3]))
    assert database.missed.tolist() == database.misses.tolist() == [4, 3, 1, 1]
    database.prune()
    database.record_misses(np.array([1, 2]))
    assert database.missed.tolist() == [4, 4, 2, 1]  # one frame later, which looked for all


def test_several_key_frames_decide_whatever_the_gap_between_them() -> None:
    database = LandmarkDatabase(RIG, DatabaseSettings(prune_after_misses=10), 40.0)
    database.add(stereo_features(at_pixels([(80, 60, 8)])), np.arange(1), np.zeros(1, np.uint8))
    ids, none, looks = np.array([0]), np.empty(0, np.int64), 0
    database.prune()
    while len(database):
        for _ in range(30):
            database.record_carried(none, ids)
        database.record_misses(ids)
        database.prune()
        looks += 1
    assert looks == 4


def test_counts_go_on_as_before_after_a_restart_between_key_frames() -> None:
    database = LandmarkDatabase(RIG, DatabaseSettings(), 40.0)
    points = at_pixels([(80, 60, 8), (100, 110, 12)])
    database.add(stereo_features(points), np.arange(2), np.zeros(2, np.uint8))
    database.prune()
    database.record_misses(np.array([0]))
    database.prune()
    database.record_carried(np.array([1]), np.array([0]))
    again = LandmarkDatabase(RIG, DatabaseSettings(), 40.0)
    restore(again, state_of(database))
    for one in (database, again):
        one.record_misses(np.array([0]))
        assert one.missed.tolist() == [3, 0]


def test_own_patches_stay_with_their_landmarks() -> None:
    """Through the end of others, and a restart."""
    database = LandmarkDatabase(RIG, DatabaseSettings(prune_after_misses=1), 40.0, patch_pixels=4)
    points = at_pixels([(80, 60, 8), (100, 110, 12), (150, 150, 20)])
    ids = database.add(stereo_features(points), np.arange(3), np.zeros(3, np.uint8))
    assert database.patches(ids).distances.tolist() == [0.0, 0.0, 0.0]
    own = np.arange(8, dtype=np.uint8).reshape(2, 4)
    database.keep_patches(ids[1:], LandmarkPatches(own, np.array([2.0, 3.0])))
    database.record_misses(ids[:1])
    database.prune()
    again = LandmarkDatabase(RIG, DatabaseSettings(), 40.0, patch_pixels=4)
    restore(again, state_of(database))
    patches = again.patches(ids[1:])
    np.testing.assert_array_equal(patches.grey, own)
    assert patches.distances.tolist() == [2.0, 3.0]


def test_a_landmark_that_stays_takes_the_patch_that_it_lacks() -> None:
    database = LandmarkDatabase(RIG, DatabaseSettings(), 40.0, patch_pixels=4)
    points = at_pixels([(80, 60, 8), (100, 110, 12), (150, 150, 20), (90, 90, 9)])
    ids = database.add(stereo_features(points), np.arange(4), np.zeros(4, np.uint8))
    own = np.arange(12, dtype=np.uint8).reshape(3, 4)
    database.keep_patches(ids[1:], LandmarkPatches(own, np.array([2.0, 3.0, 4.0])))
    database.merge(np.array([[1, 0], [3, 2]]))
    kept = database.patches(np.array([0, 2]))
    assert kept.distances.tolist() == [2.0, 3.0]
    np.testing.assert_array_equal(kept.grey, own[:2])


def test_predicted_covariance_matches_monte_carlo() -> None:
    rng = np.random.default_rng(3)
    point = np.array([[0.4, -0.3, 3.0]])
    root = np.array([[0.02, 0.0, 0.0], [0.005, 0.015, 0.0], [0.01, -0.01, 0.04]])
    pose_sigma = np.array([0.004, 0.006, 0.003, 0.01, 0.02, 0.015])
    wTc = g.se3_exp(np.array([0.05, -0.1, 0.02, 0.2, 0.1, -0.3]))
    prediction = Prediction(wTc, np.diag(pose_sigma**2))
    stated = predicted_covariance(RIG, prediction, point, (root @ root.T)[None])[0]
    drawn = [
        g.project(
            RIG,
            g.transform_to_camera(
                wTc @ g.se3_exp(pose_sigma * rng.standard_normal(6)),
                point + (root @ rng.standard_normal(3))[None],
            ),
        )[0]
        for _ in range(8000)
    ]
    measured = np.cov(np.array(drawn).T)
    scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    np.testing.assert_allclose(measured / scale, stated / scale, rtol=0, atol=0.06)


# --------------------------------------------------------------------------------------------
# Life and death


def test_new_landmarks_count_one_hit_and_get_ascending_ids() -> None:
    """Every feature of the first frame becomes a track."""
    points = at_pixels([(80, 60, 8), (100, 110, 12), (150, 150, 20)])
    database = LandmarkDatabase(RIG, SETTINGS, 40.0)
    features = stereo_features(points)
    assert database.next_id == 0
    first = database.add(features, np.array([0, 2]), np.array([7, 9], np.uint8))
    second = database.add(features, np.array([1]), np.array([8], np.uint8))
    assert first.tolist() == [0, 1]
    assert second.tolist() == [2]
    assert database.ids.tolist() == [0, 1, 2]
    assert database.hits.tolist() == [1, 1, 1]
    assert database.misses.tolist() == database.missed.tolist() == [0, 0, 0]
    assert database.colour.tolist() == [7, 9, 8]
    np.testing.assert_allclose(database.appearances().size, 3.0 * points[[0, 2, 1], 2])


@pytest.mark.parametrize("limit", [1, 3, 20])
def test_pruned_exactly_at_the_last_miss_in_a_row(limit: int) -> None:
    """N = 20 in the paper."""
    points = at_pixels([(80, 60, 8), (100, 110, 12)])
    database = database_of(points, DatabaseSettings(prune_after_misses=limit))
    for _ in range(limit - 1):
        database.record_misses(np.array([1]))
        assert len(database.prune()) == 0
    database.record_misses(np.array([1]))
    assert database.prune().tolist() == [1]
    assert database.ids.tolist() == [0]
    assert len(database.appearances()) == len(database.hits) == len(database.colour) == 1
    # Never again: neither the entry nor its name.
    assert len(database.prune()) == 0
    assert database.next_id == 2


def test_an_unconfirmed_landmark_is_forgotten_in_view_or_not() -> None:
    """Three landmarks: never seen again, confirmed by two more hits, seen again once and late."""
    points = at_pixels([(80, 60, 8), (100, 110, 12), (200, 100, 9)])
    features = stereo_features(points)
    database = database_of(points, DatabaseSettings(forget_unconfirmed_after=4))
    gone: list[tuple[int, int]] = []
    for frame in range(12):
        if frame in (1, 2):
            database.record_hits(np.array([1]), features, np.array([1]))
        if frame == 3:
            database.record_hits(np.array([2]), features, np.array([2]))
        gone += [(frame, int(i)) for i in database.prune()]
    assert gone == [(4, 0), (7, 2)]
    assert database.ids.tolist() == [1]


def test_landmarks_out_of_view_are_kept_by_default() -> None:
    """The paper's Type I: its miss count remains unchanged."""
    database = database_of(at_pixels([(80, 60, 8)]))
    for _ in range(500):
        assert len(database.prune()) == 0
    assert database.ids.tolist() == [0]


def test_the_paper_prunes_after_20() -> None:
    assert DatabaseSettings().prune_after_misses == 20
    assert DatabaseSettings().valid_hits == 3


def test_a_hit_resets_consecutive_misses_only() -> None:
    """L resets on a hit, m and n never."""
    points = at_pixels([(80, 60, 8)])
    database = database_of(points, DatabaseSettings(prune_after_misses=5))
    only = np.array([0])
    for _ in range(3):
        for _ in range(4):
            database.record_misses(only)
        database.record_hits(only, stereo_features(points), only)
        assert len(database.prune()) == 0
    assert (database.hits[0], database.misses[0], database.missed[0]) == (4, 12, 0)


def test_valid_from_the_third_hit_on() -> None:
    points = at_pixels([(80, 60, 8), (100, 110, 12)])
    database = database_of(points)
    features = stereo_features(points)
    for expected in (False, True, True):
        database.record_hits(np.array([1]), features, np.array([1]))
        assert database.valid.tolist() == [False, expected]


def test_a_hit_refreshes_the_appearance() -> None:
    points = at_pixels([(80, 60, 8), (100, 110, 12), (120, 90, 10)])
    database = database_of(points)
    before = copy.deepcopy(state_of(database))
    nearer = at_pixels([(10, 10, 3), (100, 110, 24)])
    seen = stereo_features(nearer, scale=5.0)
    database.record_hits(np.array([1]), seen, np.array([1]))
    assert database.appearances().size[1] == pytest.approx(5.0 * nearer[1, 2])
    assert database.appearances().orientation[1] == seen.orientation[1]
    np.testing.assert_array_equal(database.appearances().descriptors[1], seen.descriptors[1])
    others = np.array([0, 2])
    for name in before:
        if name.startswith("columns/"):
            np.testing.assert_array_equal(state_of(database)[name][others], before[name][others])


def test_a_restored_database_continues_exactly() -> None:
    points = at_pixels([(80, 60, 8), (100, 110, 12), (120, 90, 10)])
    features = stereo_features(points)

    def go_on(database: LandmarkDatabase) -> None:
        database.record_misses(np.array([0, 2]))
        database.record_hits(np.array([1]), features, np.array([2]))
        database.add(features, np.array([0]), np.array([3], np.uint8))
        database.prune()

    settings = DatabaseSettings(prune_after_misses=2)
    first = database_of(points, settings)
    first.record_misses(np.array([2]))
    state = state_of(first)
    kept = copy.deepcopy(state)
    second = LandmarkDatabase(RIG, settings, 40.0)
    restore(second, state)
    go_on(first)
    assert_same_bits(state, kept)
    go_on(second)
    assert_same_bits(state, kept)
    assert_same_bits(state_of(first), state_of(second))
    assert second.ids.tolist() == [0, 1, 3]


def test_an_empty_database_expects_nothing() -> None:
    database = LandmarkDatabase(RIG, SETTINGS, 40.0)
    assert len(database) == 0
    assert len(database.expected(landmark_map(np.empty((0, 3))), np.eye(4))) == 0
    assert len(database.prune()) == 0
    assert database.valid.shape == (0,)
