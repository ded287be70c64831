"""The database's lasting side: permanence, merging, saved maps, several views kept and restored."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
from simulated import RIG, assert_same_bits
from test_database import at_pixels, database_of, landmark_map, stereo_features

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import MapError
from fgslam.core.saved_map import SavedMap
from fgslam.core.store import restore, state_of
from fgslam.core.types import CUT_PIXELS, LandmarkAppearances, LandmarkPatches, Trajectory
from fgslam.frontend.settings import (
    DatabaseSettings,
    PermanenceSettings,
)
from fgslam.frontend.tracking import landmarks as database_module
from fgslam.frontend.tracking.landmarks import LandmarkDatabase

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


def test_a_permanent_landmark_is_not_pruned() -> None:
    database = database_of(PLACES, LASTING)
    for k in range(2):
        hit(database, 0, 1)
        assert database.permanent.tolist() == [k == 1, k == 1, False, False]
        assert len(end_frame(database)) == 0
    for _ in range(2):
        assert len(end_frame(database, 0, 2)) == 0
    assert end_frame(database, 0, 2).tolist() == [2]
    for _ in range(50):
        assert len(end_frame(database, 0)) == 0
    assert database.ids.tolist() == [0, 1, 3]
    # The flag does not go with the ratio, which is far below the threshold now.
    assert (database.hits[0], database.misses[0], database.permanent[0]) == (3, 53, True)


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


def test_without_permanence_there_is_none_to_save() -> None:
    database = database_of(PLACES)
    for _ in range(9):
        hit(database, 0)
    assert not database.permanent.any()
    assert not database.lasting.any()


# --------------------------------------------------------------------------------------------
# Merging


def test_merging_adds_counts_and_keeps_the_later_look() -> None:
    database = database_of(PLACES, LASTING)
    end_frame(database, 0)
    hit(database, 0)
    for _ in range(2):
        hit(database, 2)
    end_frame(database, 3)
    looks = {i: database.appearances(np.array([i])).descriptors[0] for i in (0, 2, 3)}
    seen = state_of(database)["columns/seen"][[0, 2, 3]].copy()
    assert seen.tolist() == [1, 1, 0]
    database.merge(np.array([[2, 0], [3, 1]]))
    assert database.ids.tolist() == [0, 1]
    assert database.hits.tolist() == [5, 2]
    assert database.misses.tolist() == [1, 1]
    assert database.missed.tolist() == [0, 0]
    assert state_of(database)["columns/seen"].tolist() == [1, 0]
    assert database.permanent.tolist() == [True, False]
    np.testing.assert_array_equal(database.appearances(np.array([0])).descriptors[0], looks[2])
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


def test_merging_no_pairs_changes_nothing() -> None:
    database = database_of(PLACES, LASTING)
    before = copy.deepcopy(state_of(database))
    database.merge(np.empty((0, 2), np.int64))
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
    for name in ("ids", "hits", "misses", "permanent", "colour"):
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


def test_a_view_of_the_map_goes_before_one_of_this_visit() -> None:
    database = LandmarkDatabase(RIG, VIEWS, 40.0)
    database.load(saved(seen_around(), PLACES))
    for angle in (120.0, 160.0):
        hit(database, 0, directions=towards(angle))
    np.testing.assert_allclose(
        database.appearances(np.array([0])).direction, towards(80, 120, 160), atol=1e-7
    )


def test_a_map_with_a_landmark_that_has_no_view_is_refused() -> None:
    given = saved(seen_around(), PLACES)
    object.__setattr__(given, "appearances", given.appearances.of(np.array([0, 1, 3])))
    assert isinstance(given.appearances, LandmarkAppearances)
    with pytest.raises(MapError, match="without a view"):
        LandmarkDatabase(RIG, VIEWS, 40.0).load(given)


def test_an_empty_map() -> None:
    given = saved(LandmarkDatabase(RIG, VIEWS, 40.0), np.empty((0, 3)))
    database = seen_around()
    database.load(given)
    assert len(database) == len(database.appearances()) == 0
    assert database.next_id == 0


def test_memory_a_landmark_is_as_documented() -> None:
    """docs/concepts/maps.md tells it."""
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
