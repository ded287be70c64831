"""Several views of a landmark (Se et al. 6.3)."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import IntArray
from fgslam.frontend.tracking.landmarks import Places, ViewPool, Views

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


def test_a_match_from_elsewhere_adds_a_view() -> None:
    pool = ViewPool(8, ANGLE)
    places = landmark(pool, view(0, 1), view(20.5, 2))
    assert names(pool, places) == [1, 2]
    assert degrees_of(pool, places).tolist() == [0, 20]


@pytest.mark.parametrize("step", [1.0, 3.0, 7.0])
@pytest.mark.parametrize("turn", [90.0, 170.0])
def test_an_orbit_adds_a_view_every_20_degrees(step: float, turn: float) -> None:
    """The list grows as angle / 20; steps may jump over the threshold by their own size."""
    pool = ViewPool(32, ANGLE)
    places = pool.start(view(0, 1))
    for k in range(1, int(turn / step) + 1):
        pool.refresh(places, view(k * step, 1))
    count = int((places >= 0).sum())
    assert 1 + int(turn / (20.0 + step)) <= count <= 1 + int(turn / 20.0)


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


@pytest.mark.parametrize(("used", "left"), [(3, [1]), (4, [2]), (5, [2])])
def test_merging_single_views_keeps_the_later(used: int, left: list[int]) -> None:
    pool = ViewPool(1, 0.0)
    stays, ends = pool.start(view(0, 1, 4)), pool.start(view(90, 2, used))
    pool.merge(stays, ends)
    assert names(pool, stays) == left


def test_loading_keeps_the_last_views_of_a_landmark_that_has_too_many() -> None:
    pool = ViewPool(2, ANGLE)
    rng = np.random.default_rng(1)
    given = several(rng, 6)
    places = pool.load(np.array([1, 3, 2]), given)
    assert [np.flatnonzero(row >= 0).tolist() for row in places] == [[0], [0, 1], [0, 1]]
    kept = pool.at(places[places >= 0])
    np.testing.assert_array_equal(kept.size, given.size[[0, 2, 3, 4, 5]])
    np.testing.assert_array_equal(kept.descriptors, given.descriptors[[0, 2, 3, 4, 5]])


def test_no_landmark_at_all() -> None:
    pool = ViewPool(4, ANGLE)
    nothing = several(np.random.default_rng(0), 0)
    places = pool.start(nothing)
    assert places.shape == (0, 4)
    column, inside = pool.nearest(places, np.empty((0, 3), np.float32))
    assert len(column) == len(inside) == 0
    pool.refresh(places, nothing)
