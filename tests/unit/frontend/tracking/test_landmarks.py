"""The landmark database (Se et al. 4 and 6)."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
from simulated import RIG, assert_same_bits

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import MapError
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig, Increment, LoopClosure, Observations, Odometry
from fgslam.core.store import restore, state_of
from fgslam.core.types import (
    CUT_PIXELS,
    LandmarkAppearances,
    LandmarkMap,
    LandmarkPatches,
    Prediction,
    StereoFeatures,
    Trajectory,
)
from fgslam.frontend.settings import (
    DatabaseSettings,
    PermanenceSettings,
)
from fgslam.frontend.tracking import landmarks as database_module
from fgslam.frontend.tracking.landmarks import (
    LandmarkDatabase,
    MapParts,
    Places,
    ViewPool,
    Views,
    is_blind,
    reliable,
    seen_past,
)
from fgslam.frontend.tracking.map_matching import ExpectedLandmarks, predicted_covariance

# ------------------------------------------------------------------------------------------
# The landmark database (Se et al. 4 and 6.1)


SETTINGS = DatabaseSettings()
CONE = DatabaseSettings(field_of_view="cone")
TWO_CAMERAS = dataclasses.replace(RIG, vertical_baseline=None)


def stereo_features(points: FloatArray, scale: float = 3.0) -> StereoFeatures:
    """Exact features of points (n, 3) in the camera's frame, each with its own descriptor."""
    count = len(points)
    measured = RIG.predict(points)
    covariance = np.tile(0.09 * np.eye(3), (count, 1, 1))
    descriptors = np.random.default_rng(1).integers(0, 256, (count, 128)).astype(np.uint8)
    return StereoFeatures(
        measurement=measured,
        measurement_covariance=covariance,
        scale=np.full(count, scale),
        orientation=np.linspace(0.1, 6.0, count),
        descriptors=descriptors,
        position=points.copy(),
        position_covariance=RIG.triangulation_covariance(measured, covariance),
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
    return RIG.triangulate(np.array(rows, np.float64))


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
    """What hid it when the drive came hides it again; a single sighting gives no such distance."""
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
    ids, none, searches = np.array([0]), np.empty(0, np.int64), 0
    database.prune()
    while len(database):
        for _ in range(30):
            database.record_carried(none, ids)
        database.record_misses(ids)
        database.prune()
        searches += 1
    assert searches == 4


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
        RIG.predict(
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


# ------------------------------------------------------------------------------------------
# The database's lasting side: permanence, merging, saved maps, several views kept and restored


PLACES = at_pixels([(80, 60, 8), (100, 110, 12), (120, 90, 10), (150, 100, 9)])
LASTING = DatabaseSettings(
    prune_after_misses=3, permanence=PermanenceSettings(ratio=0.5, hits=3, contradicted_after=4)
)
VIEWS = DatabaseSettings(viewpoints=True)


@pytest.fixture(autouse=True)
def _few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database_module, "MAX_VIEWS", 3)


def hit(database: LandmarkDatabase, *ids: int, directions: FloatArray | None = None) -> None:
    """Those landmarks are matched by the features that they have in PLACES."""
    which = np.array(ids)
    database.record_hits(which, stereo_features(PLACES), which % len(PLACES), directions)


def end_frame(database: LandmarkDatabase, *missed: int) -> IntArray:
    database.record_misses(np.array(missed, np.int64))
    return database.prune()


def towards(*degrees: float) -> FloatArray:
    angles = np.deg2rad(degrees)
    return np.column_stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)])


# --------------------------------------------------------------------------------------------
# Permanence


def test_a_permanent_landmark_is_not_forgotten_when_seldom_seen() -> None:
    settings = DatabaseSettings(
        valid_hits=2,
        forget_unconfirmed_after=2,
        permanence=PermanenceSettings(ratio=0.0, hits=1),
    )
    database = database_of(PLACES, settings)
    hit(database, 1)
    gone = [end_frame(database).tolist() for _ in range(6)]
    assert [i for ids in gone for i in ids] == [0, 2, 3]
    assert database.permanent.tolist() == [True]


def test_a_demoted_landmark_is_pruned_like_any_other_and_a_hit_makes_it_permanent_again() -> None:
    database = database_of(PLACES, LASTING)
    for _ in range(2):
        hit(database, 0, 1)
        end_frame(database)
    for _ in range(5):
        end_frame(database, 0)
    database.demote(np.array([0, 1]))
    assert not database.permanent.any()
    hit(database, 1)
    assert database.permanent[1]
    assert end_frame(database, 0).tolist() == [0]


# --------------------------------------------------------------------------------------------
# Merging


def test_merging_adds_counts_and_keeps_the_later_look() -> None:
    database = database_of(PLACES, LASTING)
    end_frame(database, 0)
    hit(database, 0)
    end_frame(database)
    for _ in range(2):
        hit(database, 2)
    end_frame(database, 3)
    views = {i: database.appearances(np.array([i])).descriptors[0] for i in (0, 2, 3)}
    seen = state_of(database)["columns/seen"][[0, 2, 3]].copy()
    assert seen.tolist() == [1, 2, 0]
    database.merge(np.array([[2, 0], [3, 1]]))
    assert database.ids.tolist() == [0, 1]
    assert database.hits.tolist() == [5, 2]
    assert database.misses.tolist() == [1, 1]
    assert database.missed.tolist() == [0, 0]
    assert state_of(database)["columns/seen"].tolist() == [2, 0]
    assert database.permanent.tolist() == [True, False]
    np.testing.assert_array_equal(database.appearances(np.array([0])).descriptors[0], views[2])
    # What ends is never named again.
    assert database.next_id == 4


def test_several_landmarks_are_merged_into_one() -> None:
    database = database_of(PLACES, VIEWS)
    for i in range(4):
        hit(database, i, directions=towards(50.0 * i))
    # Views from an unknown direction learn it: one view each, 50 degrees apart.
    database.merge(np.array([[1, 0], [2, 0], [3, 0]]))
    assert database.ids.tolist() == [0]
    assert database.hits.tolist() == [8]
    found = database.appearances()
    assert len(found) == 3  # as many as it may have


@pytest.mark.parametrize(
    ("pairs", "why"),
    [
        ([[9, 0]], r"\[9\] are not in the database"),
        ([[0, 7]], r"\[7\] are not in the database"),
        ([[1, 0], [1, 2]], "only once"),
        ([[1, 0], [2, 1]], "not stay as well"),
        ([[1, 1]], "not stay as well"),
    ],
)
def test_what_cannot_be_merged_is_refused_and_nothing_done(pairs, why) -> None:
    database = database_of(PLACES, LASTING)
    before = copy.deepcopy(state_of(database))
    with pytest.raises(ValueError, match=why):
        database.merge(np.array(pairs))
    assert_same_bits(state_of(database), before)


# --------------------------------------------------------------------------------------------
# Views kept, saved, restored


def seen_around() -> LandmarkDatabase:
    """Landmark 0 with three views, 1 with two, 2 with one, 3 as it was added."""
    database = LandmarkDatabase(RIG, VIEWS, 40.0)
    features = stereo_features(PLACES)
    database.add(features, np.arange(4), np.arange(4, dtype=np.uint8), towards(0, 0, 0, 0))
    for k in (1, 2):
        hit(database, *range(3 - k), directions=towards(*[40.0 * k] * (3 - k)))
        end_frame(database)
    return database


def test_appearances_are_all_views_the_latest_last() -> None:
    found = seen_around().appearances()
    assert found.ids.tolist() == [0, 0, 0, 1, 1, 2, 3]
    np.testing.assert_allclose(found.direction[:3], towards(0, 40, 80), atol=1e-7)
    database = seen_around()
    hit(database, 0, directions=towards(3.0))
    np.testing.assert_allclose(
        database.appearances(np.array([0])).direction, towards(40, 80, 0), atol=1e-7
    )
    one = database.appearances(np.array([1, 3]))
    assert one.ids.tolist() == [1, 1, 3]
    assert one.descriptors.dtype == np.uint8
    np.testing.assert_array_equal(one.descriptors[2], stereo_features(PLACES).descriptors[3])


def test_a_restored_database_with_views_continues_exactly() -> None:
    first = seen_around()
    end_frame(first, 1)
    state = state_of(first)
    kept = copy.deepcopy(state)
    second = LandmarkDatabase(RIG, VIEWS, 40.0)
    restore(second, state)
    for database in (first, second):
        hit(database, 0, 2, directions=towards(140.0, 100.0))
        database.add(stereo_features(PLACES), np.array([3]), np.array([9], np.uint8), towards(10))
        end_frame(database, 3)
        hit(database, 0, directions=towards(200.0))
    assert_same_bits(state, kept)
    assert_same_bits(state_of(first), state_of(second))
    map_now = landmark_map(np.concatenate([PLACES, PLACES[:1]]))
    assert_same_bits(first.expected(map_now, np.eye(4)), second.expected(map_now, np.eye(4)))


def saved(database: LandmarkDatabase, positions: FloatArray) -> SavedMap:
    return SavedMap(
        rig=RIG,
        landmarks=landmark_map(positions, database.ids.copy()),
        appearances=database.appearances(),
        hits=database.hits.copy(),
        misses=database.misses.copy(),
        farthest=database.farthest.copy(),
        permanent=database.lasting,
        colour=database.colour.copy(),
        trajectory=Trajectory(np.empty(0), np.empty((0, 4, 4))),
        about={},
        evidence=np.empty(0, np.int64),
    )


def test_a_visit_that_carries_none_keeps_the_patches_of_its_map() -> None:
    first = seen_around()
    given = saved(first, PLACES)
    patches = LandmarkPatches(
        np.tile(np.arange(4, dtype=np.uint8)[:, None], CUT_PIXELS), 1.0 + np.arange(4)
    )
    second = LandmarkDatabase(RIG, VIEWS, 40.0)
    second.load(dataclasses.replace(given, patches=patches))
    assert_same_bits(second.patches(given.landmarks.ids), patches)
    added = second.add(stereo_features(PLACES), np.array([3]), np.array([9], np.uint8), towards(10))
    assert second.patches(added).distances.tolist() == [0.0]
    third = LandmarkDatabase(RIG, VIEWS, 40.0)
    restore(third, state_of(second))
    assert_same_bits(third.patches(given.landmarks.ids), patches)


def test_a_saved_map_s_database() -> None:
    """All but what belongs to the visit: rows of misses, frame numbers."""
    first = seen_around()
    for _ in range(5):
        hit(first, 3, directions=towards(0.0))
        end_frame(first, 2)
    first.merge(np.array([[1, 0]]))
    given = saved(first, PLACES[[0, 2, 3]])
    second = LandmarkDatabase(RIG, VIEWS, 40.0)
    second.load(given)
    for name in ("ids", "hits", "misses", "farthest", "permanent", "colour"):
        np.testing.assert_array_equal(getattr(second, name), getattr(first, name))
    assert_same_bits(second.appearances(), first.appearances())
    assert second.missed.tolist() == state_of(second)["columns/contradicted"].tolist() == [0, 0, 0]
    assert second.next_id == 4
    # Its own columns, not the map's: the map is not touched by the visit.
    kept = copy.deepcopy(given)
    hit(second, 0, directions=towards(130.0))
    second.demote(second.ids)
    assert_same_bits(given, kept)


def test_fewer_views_than_the_map_has_are_the_latest() -> None:
    given = saved(seen_around(), PLACES)
    plain = LandmarkDatabase(RIG, DatabaseSettings(), 40.0)
    plain.load(given)
    found = plain.appearances()
    assert found.ids.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(found.direction, towards(80, 40, 0, 0), atol=1e-7)


def test_a_map_with_a_landmark_that_has_no_view_is_refused() -> None:
    given = saved(seen_around(), PLACES)
    object.__setattr__(given, "appearances", given.appearances.of(np.array([0, 1, 3])))
    assert isinstance(given.appearances, LandmarkAppearances)
    with pytest.raises(MapError, match="without a view"):
        LandmarkDatabase(RIG, VIEWS, 40.0).load(given)


def test_memory_a_landmark_is_as_documented() -> None:
    """docs/concepts/maps.md describes it."""
    assert kept_bytes(LandmarkDatabase(RIG, DatabaseSettings(), 40.0)) == 78 + 164
    assert kept_bytes(LandmarkDatabase(RIG, DatabaseSettings(), 40.0, CUT_PIXELS)) == 242 + 289
    assert kept_bytes(LandmarkDatabase(RIG, VIEWS, 40.0)) == 242 + 2 * 4


def kept_bytes(database: LandmarkDatabase) -> float:
    """Bytes of a landmark with one view, but for the view's word (2), which is found again."""
    count = 200
    database.add(
        stereo_features(np.tile(PLACES[:1], (count, 1))),
        np.arange(count),
        np.zeros(count, np.uint8),
    )
    arrays = state_of(database).values()
    return sum(array.nbytes for array in arrays if array.shape[:1] == (count,)) / count


# ------------------------------------------------------------------------------------------
# Several views of a landmark (Se et al. 6.3)


ANGLE = np.deg2rad(20.0)


def direction(degrees: float) -> np.ndarray:
    """A view vector in the plane."""
    a = np.deg2rad(degrees)
    return np.array([[np.sin(a), 0.0, np.cos(a)]], np.float32)


def view(degrees: float, name: int, used: int = 0) -> Views:
    """A view whose numbers all tell its name."""
    vector = np.full((1, 3), np.nan, np.float32) if np.isnan(degrees) else direction(degrees)
    return Views(
        size=np.array([float(name)]),
        orientation=np.array([0.01 * name]),
        descriptors=np.full((1, 128), name, np.uint8),
        direction=vector,
        used=np.array([used]),
    )


def landmark(pool: ViewPool, *views: Views) -> Places:
    """One landmark with these views, added one by one."""
    places = pool.start(views[0])
    for more in views[1:]:
        pool.refresh(places, more)
    return places


def names(pool: ViewPool, places: Places) -> list[int]:
    """Of the landmark's views, in their order; all numbers of each must agree on it."""
    found = pool.at(places[places >= 0])
    np.testing.assert_allclose(found.size, 100.0 * found.orientation)
    np.testing.assert_array_equal(found.size, found.descriptors[:, 0])
    return found.size.astype(int).tolist()


def degrees_of(pool: ViewPool, places: Places) -> IntArray:
    found = pool.at(places[places >= 0]).direction
    return np.rint(np.rad2deg(np.arctan2(found[:, 0], found[:, 2]))).astype(np.int64)


@pytest.mark.parametrize(
    ("seen_from", "nearest", "near"),
    [(0, 1, True), (19.9, 1, True), (25.1, 2, False), (30.1, 2, True), (-20.1, 1, False),
     (70.1, 2, False), (180, 2, False)],
)  # fmt: skip
def test_the_nearest_view_and_whether_it_is_near(seen_from, nearest, near) -> None:
    pool = ViewPool(8, ANGLE)
    places = landmark(pool, view(0, 1), view(50, 2))
    column, inside = pool.nearest(places, direction(seen_from))
    assert pool.at(places[0, column]).size.tolist() == [nearest]
    assert inside.tolist() == [near]


def test_a_match_renews_the_nearest_view_and_no_other() -> None:
    pool = ViewPool(8, ANGLE)
    places = landmark(pool, view(0, 1), view(50, 2))
    pool.refresh(places, view(35, 3))
    assert names(pool, places) == [1, 3]
    # The view vector stays: another match 15 degrees on would else be near to the first's.
    assert degrees_of(pool, places).tolist() == [0, 50]


def test_a_full_landmark_loses_the_view_matched_longest_ago() -> None:
    pool = ViewPool(3, ANGLE)
    places = landmark(pool, view(0, 1, 0), view(30, 2, 1), view(60, 3, 2))
    pool.refresh(places, view(2, 4, 3))
    pool.refresh(places, view(90, 5, 4))
    assert names(pool, places) == [4, 5, 3]
    assert degrees_of(pool, places).tolist() == [0, 90, 60]


def test_one_view_alone_is_renewed_altogether() -> None:
    pool = ViewPool(1, 0.0)
    places = landmark(pool, view(0, 1), view(90, 2, 5))
    assert names(pool, places) == [2]
    assert degrees_of(pool, places).tolist() == [90]
    assert pool.at(places[:, 0]).used.tolist() == [5]


def test_an_unknown_direction_is_near_to_all_and_learns() -> None:
    pool = ViewPool(8, ANGLE)
    places = landmark(pool, view(np.nan, 1))
    column, inside = pool.nearest(places, direction(120))
    assert column.tolist() == [0]
    assert inside.all()
    pool.refresh(places, view(120, 2))
    assert names(pool, places) == [2]
    assert degrees_of(pool, places).tolist() == [120]
    # A known view that is near is preferred, and an unknown one seen keeps what was known.
    pool.refresh(places, view(np.nan, 3))
    assert degrees_of(pool, places).tolist() == [120]


def test_views_of_landmarks_that_leave_are_used_again() -> None:
    pool = ViewPool(2, ANGLE)
    kept = landmark(pool, view(0, 1), view(90, 2))
    for k in range(300):
        gone = landmark(pool, view(0, 3), view(90, 4 + k % 100))
        assert gone.max() < 4
        assert names(pool, gone) == [3, 4 + k % 100]
        pool.release(gone)
    assert names(pool, kept) == [1, 2]


def test_many_landmarks_at_once() -> None:
    """Each gets its own views, whatever became of the places before."""
    rng = np.random.default_rng(3)
    pool = ViewPool(4, ANGLE)
    pool.release(pool.start(several(rng, 50)))
    first = several(rng, 200)
    places = pool.start(first)
    assert len(np.unique(places[places >= 0])) == 200
    np.testing.assert_array_equal(pool.at(places[:, 0]).size, first.size)
    opposite = several(rng, 200)
    opposite = Views(
        opposite.size, opposite.orientation, opposite.descriptors, -first.direction, opposite.used
    )
    pool.refresh(places, opposite)
    assert ((places >= 0).sum(axis=1) == 2).all()
    column, inside = pool.nearest(places, -first.direction)
    assert (column == 1).all()
    assert inside.all()
    np.testing.assert_array_equal(pool.at(places[:, 1]).descriptors, opposite.descriptors)


def several(rng: np.random.Generator, count: int) -> Views:
    vectors = rng.standard_normal((count, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return Views(
        rng.uniform(1, 9, count),
        rng.uniform(0, 6, count),
        rng.integers(0, 256, (count, 128)).astype(np.uint8),
        vectors.astype(np.float32),
        np.zeros(count, np.int64),
    )


def test_merging_keeps_the_later_of_two_alike_and_adds_the_others() -> None:
    pool = ViewPool(8, ANGLE)
    stays = landmark(pool, view(0, 1, 4), view(40, 2, 9))
    ends = landmark(pool, view(5, 3, 7), view(45, 4, 8), view(90, 5, 6))
    pool.merge(stays, ends)
    assert sorted(names(pool, stays)) == [2, 3, 5]
    assert degrees_of(pool, stays).tolist() == [0, 40, 90]


def test_loading_keeps_the_last_views_of_a_landmark_that_has_too_many() -> None:
    pool = ViewPool(2, ANGLE)
    rng = np.random.default_rng(1)
    given = several(rng, 6)
    places = pool.load(np.array([1, 3, 2]), given)
    assert [np.flatnonzero(row >= 0).tolist() for row in places] == [[0], [0, 1], [0, 1]]
    kept = pool.at(places[places >= 0])
    np.testing.assert_array_equal(kept.size, given.size[[0, 2, 3, 4, 5]])
    np.testing.assert_array_equal(kept.descriptors, given.descriptors[[0, 2, 3, 4, 5]])


# ------------------------------------------------------------------------------------------
# Landmarks and frames are connected by measurements, or lie next to each other by a guess


GUESS = Odometry(np.eye(4), np.eye(6), measured=False)
WHEELS = Odometry(np.eye(4), np.eye(6))


def observed(old: range, new: range) -> Observations:
    ids = np.array([*old, *new], np.int64)
    n = len(ids)
    is_new = np.arange(n) >= len(old)
    return Observations(ids, np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 2)), is_new)


def frame(
    old: range = range(0),
    new: range = range(0),
    odometry: Odometry | None = GUESS,
    rejected: range = range(0),
    loops: tuple[LoopClosure, ...] = (),
) -> Increment:
    seen = observed(old, new)
    none = np.empty(0, np.int64)
    return Increment(
        0, 0.0, odometry, seen, np.isin(seen.ids, list(rejected)), none, none, loops=loops
    )


def parts_of(*frames: Increment) -> MapParts:
    parts = MapParts()
    for one in frames:
        parts.record(one, (True,) * len(one.loops))
    return parts


BEFORE = (frame(new=range(20), odometry=None), frame(range(10), range(20, 30)))
GAP = frame(new=range(30, 50))


@pytest.mark.parametrize("odometry", [GUESS, None], ids=["live", "in a log"])
def test_a_frame_that_nothing_places_begins_a_part(odometry: Odometry | None) -> None:
    gap = frame(new=range(30, 50), odometry=odometry)
    parts = parts_of(*BEFORE, gap, frame(range(30, 45), range(50, 55), odometry))
    assert parts.connected.tolist() == [True, True, False, False]
    assert parts.of(np.array([5, 25, 31, 52])).tolist() == [0, 0, 1, 1]
    assert parts.placed_by(np.array([1, 30, 31])) == 1


def test_what_was_rejected_places_nothing() -> None:
    parts = parts_of(*BEFORE, frame(range(20), range(30, 50), rejected=range(20)))
    assert parts.connected.tolist() == [True, True, False]


def test_odometry_bridges_a_gap() -> None:
    assert parts_of(*BEFORE, frame(new=range(30, 50), odometry=WHEELS)).connected.all()


def test_a_frame_that_sees_two_parts_makes_them_one() -> None:
    parts = parts_of(*BEFORE, GAP, frame(range(24, 36)))
    assert parts.connected.all()
    assert not parts.several


def test_a_few_agreeing_landmarks_do_not_join_parts() -> None:
    parts = parts_of(*BEFORE, GAP, frame(range(28, 48)))
    assert parts.connected.tolist() == [True, True, False, False]


@pytest.mark.parametrize("taken", [True, False])
def test_a_closure_joins_where_it_is_taken(taken: bool) -> None:
    loop = LoopClosure(0, np.eye(4), np.eye(6), observed(range(5), range(0)), np.empty((0, 2)))
    parts = parts_of(*BEFORE, GAP)
    parts.record(frame(range(30, 50), loops=(loop,)), (taken,))
    assert bool(parts.connected.all()) is taken


def test_continued_from_its_state_it_is_the_same() -> None:
    parts, again = parts_of(*BEFORE, GAP), MapParts()
    restore(again, state_of(parts))
    for one in (parts, again):
        one.record(frame(new=range(50, 60)), ())
    np.testing.assert_array_equal(parts.of(np.arange(60)), again.of(np.arange(60)))
    np.testing.assert_array_equal(parts.connected, again.connected)
    assert parts.of(np.array([55])) == [2]


def test_landmarks_of_a_given_map_are_of_the_first_part() -> None:
    parts = parts_of(frame(range(100, 120), odometry=None), frame(range(100, 110)))
    assert parts.connected.all()


# ------------------------------------------------------------------------------------------
# Permanent landmarks, blocked views, and what contradicts a landmark (Se et al. 6.2)


@pytest.mark.parametrize(
    ("hits", "misses", "expected"),
    [(2, 0, False), (3, 0, True), (3, 2, True), (3, 3, False), (50, 49, True), (50, 50, False)],
)
def test_reliable_from_the_third_hit_and_above_the_ratio(hits, misses, expected) -> None:
    settings = PermanenceSettings(ratio=0.5, hits=3)
    assert reliable(np.array([hits]), np.array([misses]), settings).tolist() == [expected]


def expected_landmarks(certain: list[bool]) -> ExpectedLandmarks:
    count = len(certain)
    return ExpectedLandmarks(
        ids=np.arange(count),
        rows=np.arange(count),
        measurement=np.zeros((count, 3)),
        scale=np.ones(count),
        orientation=np.zeros(count),
        descriptors=np.zeros((count, 128), np.uint8),
        certain=np.array(certain, np.bool_),
    )


@pytest.mark.parametrize(
    ("below", "hits", "blind"),
    [(0.1, 0, True), (0.1, 1, True), (0.1, 2, False), (0.0, 0, False), (1.0, 19, True),
     (1.0, 20, False)],
)  # fmt: skip
def test_a_view_in_which_nearly_nothing_is_matched_is_blocked(below, hits, blind) -> None:
    expected = expected_landmarks([True] * 20 + [False] * 30)
    hit = np.zeros(50, np.bool_)
    hit[:hits] = True
    hit[20:40] = True  # what is at the border is no evidence about the view
    assert is_blind(expected, hit, PermanenceSettings(blind_below=below)) is blind


PLACE = (100.0, 80.0, 10.0)
SEEN = {
    # what the frame shows: (column, row, disparity)
    "nothing": ([], False),
    "the wall behind": ([(105, 85, 5)], True),
    "something before it": ([(105, 85, 15)], False),
    "the wall behind, next to what may hide it": ([(95, 80, 5), (105, 85, 15)], False),
    "something at its own depth": ([(105, 85, 10.5)], False),
    "hardly behind": ([(105, 85, 8.01)], False),
    "just behind": ([(105, 85, 7.99)], True),
    "the wall behind, too far in the image": ([(120.1, 80, 5)], False),
    "too far by both axes together": ([(115, 95, 5)], False),
    "as far as is near": ([(100, 100, 5)], True),
    "behind, and something before it far away": ([(105, 85, 5), (130, 80, 15)], True),
}


@pytest.mark.parametrize("what", SEEN)
def test_a_feature_seen_behind_contradicts_a_missed_landmark(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fgslam.frontend.tracking.landmarks.NEAR_PX", 20.0)
    shown, past = SEEN[what]
    found = seen_past(np.array([PLACE]), np.array(shown, np.float64).reshape(-1, 3))
    assert found.tolist() == [past]


def test_each_place_is_judged_by_what_is_near_to_it() -> None:
    places = np.array([PLACE, (200.0, 80.0, 10.0), (200.0, 82.0, 4.0), (20.0, 20.0, 3.0)])
    seen = np.array([(101.0, 81.0, 4.0), (201.0, 81.0, 14.0), (50.0, 50.0, 1.0)])
    assert seen_past(places, seen).tolist() == [True, False, False, False]
