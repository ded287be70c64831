"""Landmarks and frames hang together by measurements, or lie beside each other by a guess."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.sensors import Increment, LoopClosure, Observations, Odometry
from fgslam.core.store import restore, state_of
from fgslam.frontend.tracking.landmarks import MapParts

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


def booked(*frames: Increment) -> MapParts:
    parts = MapParts()
    for one in frames:
        parts.record(one, (True,) * len(one.loops))
    return parts


BEFORE = (frame(new=range(20), odometry=None), frame(range(10), range(20, 30)))
GAP = frame(new=range(30, 50))


def test_what_is_tracked_is_one_part() -> None:
    parts = booked(*BEFORE)
    assert not parts.several
    assert parts.connected.all()


@pytest.mark.parametrize("odometry", [GUESS, None], ids=["live", "in a log"])
def test_a_frame_that_nothing_places_founds_a_part(odometry: Odometry | None) -> None:
    gap = frame(new=range(30, 50), odometry=odometry)
    parts = booked(*BEFORE, gap, frame(range(30, 45), range(50, 55), odometry))
    assert parts.connected.tolist() == [True, True, False, False]
    assert parts.of(np.array([5, 25, 31, 52])).tolist() == [0, 0, 1, 1]
    assert parts.placed_by(np.array([1, 30, 31])) == 1


def test_what_was_rejected_places_nothing() -> None:
    parts = booked(*BEFORE, frame(range(20), range(30, 50), rejected=range(20)))
    assert parts.connected.tolist() == [True, True, False]


def test_odometry_bridges_a_gap() -> None:
    assert booked(*BEFORE, frame(new=range(30, 50), odometry=WHEELS)).connected.all()


def test_a_frame_that_sees_two_parts_makes_them_one() -> None:
    parts = booked(*BEFORE, GAP, frame(range(24, 36)))
    assert parts.connected.all()
    assert not parts.several


def test_a_few_agreeing_landmarks_do_not_join_parts() -> None:
    parts = booked(*BEFORE, GAP, frame(range(28, 48)))
    assert parts.connected.tolist() == [True, True, False, False]


def test_frames_before_the_first_landmark_are_the_beginning() -> None:
    dark = frame(odometry=None), frame()
    assert booked(*dark, frame(new=range(10)), frame(range(10))).connected.all()


@pytest.mark.parametrize("taken", [True, False])
def test_a_closure_joins_where_it_is_taken(taken: bool) -> None:
    loop = LoopClosure(0, np.eye(4), np.eye(6), observed(range(5), range(0)), np.empty((0, 2)))
    parts = booked(*BEFORE, GAP)
    parts.record(frame(range(30, 50), loops=(loop,)), (taken,))
    assert bool(parts.connected.all()) is taken


def test_continued_from_its_state_it_is_the_same() -> None:
    parts, again = booked(*BEFORE, GAP), MapParts()
    restore(again, state_of(parts))
    for one in (parts, again):
        one.record(frame(new=range(50, 60)), ())
    np.testing.assert_array_equal(parts.of(np.arange(60)), again.of(np.arange(60)))
    np.testing.assert_array_equal(parts.connected, again.connected)
    assert parts.of(np.array([55])) == [2]


def test_landmarks_of_a_given_map_are_of_the_first_part() -> None:
    parts = booked(frame(range(100, 120), odometry=None), frame(range(100, 110)))
    assert parts.connected.all()
