"""Permanent landmarks, blocked views, and what contradicts a landmark (Se et al. 6.2)."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.frontend.settings import PermanenceSettings
from fgslam.frontend.tracking.landmarks import is_blind, reliable, seen_past
from fgslam.frontend.tracking.map_matching import ExpectedLandmarks


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
    hit[20:40] = True  # what is at the border says nothing about the view
    assert is_blind(expected, hit, PermanenceSettings(blind_below=below)) is blind


def test_a_view_in_which_nothing_is_expected_is_not_blocked() -> None:
    nothing = np.zeros(0, np.bool_)
    assert not is_blind(expected_landmarks([]), nothing, PermanenceSettings())


PLACE = (100.0, 80.0, 10.0)
SEEN = {
    # what the frame shows: (column, row, disparity)
    "nothing": ([], False),
    "the wall behind": ([(105, 85, 5)], True),
    "something before it": ([(105, 85, 15)], False),
    "the wall behind, beside what may hide it": ([(95, 80, 5), (105, 85, 15)], False),
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
