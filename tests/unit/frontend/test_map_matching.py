"""Matching features to predicted landmarks (Se et al. 3.1)."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.types import StereoFeatures
from fgslam.frontend.features.settings import AppearanceSettings
from fgslam.frontend.settings import MapMatchingSettings
from fgslam.frontend.tracking import map_matching
from fgslam.frontend.tracking.map_matching import ExpectedLandmarks, MapMatcher, MapMatches

PAPER = AppearanceSettings(mode="paper")
DESCRIPTOR = AppearanceSettings(mode="descriptor")
FIXED = MapMatchingSettings(widen_sigmas=0.0, refine=False, rescue=False)
AT = (100.0, 80.0, 10.0)


@pytest.fixture(autouse=True)
def _limited_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_matching, "MAX_WINDOW_PX", 30.0)


def _columns(rows: object, scale: float, orientation_deg: float, descriptors: FloatArray | None):
    measured = np.asarray(rows, np.float64).reshape(-1, 3)
    count = len(measured)
    if descriptors is None:
        descriptors = np.full((count, 128), 45, np.uint8)
    return (
        measured,
        np.full(count, scale),
        np.full(count, np.deg2rad(orientation_deg)),
        np.asarray(descriptors, np.uint8),
    )


def landmarks(
    rows: object = AT, scale=2.0, orientation_deg=30.0, descriptors=None
) -> ExpectedLandmarks:
    measured, scales, orientations, described = _columns(rows, scale, orientation_deg, descriptors)
    ids = 10 + np.arange(len(measured))
    certain = np.ones(len(ids), np.bool_)
    return ExpectedLandmarks(ids, ids - 10, measured, scales, orientations, described, certain)


def features(rows: object, scale=2.0, orientation_deg=30.0, descriptors=None) -> StereoFeatures:
    measured, scales, orientations, described = _columns(rows, scale, orientation_deg, descriptors)
    count = len(measured)
    return StereoFeatures(
        measured,
        np.tile(np.eye(3), (count, 1, 1)),
        scales,
        orientations,
        described,
        np.ones((count, 3)),
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3, 2)),
    )


def match(
    expected: ExpectedLandmarks,
    found: StereoFeatures,
    appearance: AppearanceSettings = PAPER,
    uncertainty: FloatArray | None = None,
    **changes: object,
) -> MapMatches:
    matcher = MapMatcher(dataclasses.replace(FIXED, **changes), appearance)
    return matcher.match(expected, found, uncertainty)


GATES = {
    "window, right": ((102.49, 80.0, 10.0), (102.51, 80.0, 10.0)),
    "window, left": ((97.51, 80.0, 10.0), (97.49, 80.0, 10.0)),
    "window, down": ((100.0, 82.49, 10.0), (100.0, 82.51, 10.0)),
    "window, up": ((100.0, 77.51, 10.0), (100.0, 77.49, 10.0)),
    "disparity, more": ((100.0, 80.0, 11.99), (100.0, 80.0, 12.01)),
    "disparity, less": ((100.0, 80.0, 8.01), (100.0, 80.0, 7.99)),
}


@pytest.mark.parametrize("appearance", [PAPER, DESCRIPTOR], ids=["paper", "descriptor"])
@pytest.mark.parametrize("gate", GATES)
def test_window_and_disparity(gate: str, appearance: AppearanceSettings) -> None:
    for row, count in zip(GATES[gate], (1, 0), strict=True):
        found = match(landmarks(), features(row), appearance)
        assert len(found.landmarks) == len(found.features) == count
        assert found.had_candidates.tolist() == [bool(count)]


@pytest.mark.parametrize(
    ("scale", "orientation_deg", "count"),
    [
        (2.99, 30.0, 1),
        (3.01, 30.0, 0),
        (1.34, 30.0, 1),
        (1.33, 30.0, 0),
        (2.0, 49.9, 1),
        (2.0, 50.1, 0),
        (2.0, 370.1, 1),
        (2.0, 9.9, 0),
    ],
)
def test_scale_and_orientation(scale: float, orientation_deg: float, count: int) -> None:
    assert len(match(landmarks(), features(AT, scale, orientation_deg)).landmarks) == count


def test_paper_mode_refuses_ambiguity_but_starts_no_new_tracks_there() -> None:
    found = match(landmarks(), features([AT, (101.0, 81.0, 10.5), (200.0, 80.0, 10.0)]))
    assert len(found.landmarks) == 0
    assert found.had_candidates.tolist() == [True, True, False]
    # Two landmarks that want one feature.
    found = match(landmarks([AT, (101.0, 81.0, 10.5)]), features(AT))
    assert len(found.landmarks) == 0
    assert found.had_candidates.tolist() == [True]


def test_descriptors_settle_ambiguity() -> None:
    mine, other = np.zeros((1, 128), np.uint8), np.zeros((1, 128), np.uint8)
    mine[0, 0], other[0, 0] = 10, 120
    found = match(
        landmarks(descriptors=np.zeros((1, 128), np.uint8)),
        features([AT, (101.0, 81.0, 10.5)], descriptors=np.vstack([other, mine])),
        DESCRIPTOR,
    )
    assert found.landmarks.tolist() == [0]
    assert found.features.tolist() == [1]
    assert found.had_candidates.all()


def test_uncertainty_widens_each_gate_by_itself() -> None:
    """Half a window of 2.5 px and 2 px of disparity, and three sigmas of each coordinate."""
    sigma = np.array([[2.0, 1.0, 0.5]])
    inside = [(108.4, 80.0, 10.0), (100.0, 85.4, 10.0), (100.0, 80.0, 13.4)]
    outside = [(108.6, 80.0, 10.0), (100.0, 85.6, 10.0), (100.0, 80.0, 13.6)]
    for row in inside:
        assert len(match(landmarks(), features(row), widen_sigmas=3.0, uncertainty=sigma).features)
    for row in outside:
        found = match(landmarks(), features(row), widen_sigmas=3.0, uncertainty=sigma)
        assert len(found.features) == 0


def test_widening_is_per_landmark() -> None:
    two = landmarks([AT, (200.0, 80.0, 10.0)])
    sigma = np.array([[3.0, 3.0, 3.0], [0.0, 0.0, 0.0]])
    away = features([(106.0, 80.0, 10.0), (206.0, 80.0, 10.0)])
    found = match(two, away, widen_sigmas=3.0, uncertainty=sigma)
    assert found.landmarks.tolist() == [0]


def test_widening_has_a_limit_but_never_narrows(monkeypatch: pytest.MonkeyPatch) -> None:
    vast = np.full((1, 3), 1e3)
    for offset, count in ((14.9, 1), (15.1, 0)):
        row = (100.0 + offset, 80.0, 10.0)
        found = match(landmarks(), features(row), widen_sigmas=3.0, uncertainty=vast)
        assert len(found.features) == count
    # A limit below the paper's window leaves that as it is.
    monkeypatch.setattr(map_matching, "MAX_WINDOW_PX", 2.0)
    row = (102.4, 80.0, 10.0)
    found = match(landmarks(), features(row), widen_sigmas=3.0, uncertainty=vast)
    assert len(found.features) == 1


def test_anywhere_searches_the_largest_window() -> None:
    matcher = MapMatcher(FIXED, DESCRIPTOR)
    for offset, count in ((14.9, 1), (15.1, 0)):
        row = (100.0, 80.0 - offset, 10.0)
        assert len(matcher.match(landmarks(), features(row)).features) == 0
        assert len(matcher.match_anywhere(landmarks(), features(row)).features) == count


def test_recall_falls_beyond_the_window() -> None:
    """All within 2 px of odometry error, none beyond 3, no wrong ones for lack of others."""
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(np.arange(20, 300, 20), np.arange(20, 220, 20)), -1).reshape(-1, 2)
    rows = np.column_stack([grid, rng.uniform(3, 20, len(grid))])
    for shift, low, high in ((0.0, 1.0, 1.0), (2.0, 1.0, 1.0), (3.0, 0.0, 0.0), (8.0, 0.0, 0.0)):
        found = match(landmarks(rows), features(rows + np.array([shift, 0.0, 0.0])))
        assert low <= len(found.features) / len(rows) <= high
        np.testing.assert_array_equal(found.features, found.landmarks)


def test_matching_without_landmarks_or_features_finds_nothing() -> None:
    none, one = np.empty((0, 3)), [AT]
    for rows, seen in ((none, none), (none, one), (one, none)):
        for appearance in (PAPER, DESCRIPTOR):
            found = match(landmarks(rows), features(seen), appearance)
            assert len(found.landmarks) == len(found.features) == 0
            assert found.had_candidates.shape == (len(seen),)
            assert not found.had_candidates.any()


def test_matching_settings_switch_widening_refinement_and_rescue() -> None:
    plain = MapMatcher(FIXED, PAPER)
    assert [plain.widens, plain.refines, plain.rescues] == [False, False, False]
    everything = dataclasses.replace(FIXED, widen_sigmas=1.0, refine=True, rescue=True)
    full = MapMatcher(everything, DESCRIPTOR)
    assert full.widens
    assert full.refines
    assert full.rescues
    # Without descriptors a large window is all ambiguity.
    assert not MapMatcher(everything, PAPER).rescues


def test_a_feature_that_resembles_no_landmark_is_new() -> None:
    other = np.full((1, 128), 200, np.uint8)
    found = match(
        landmarks(descriptors=np.zeros((1, 128), np.uint8)),
        features(AT, descriptors=other),
        DESCRIPTOR,
    )
    assert len(found.features) == 0
    assert not found.had_candidates.any()


def test_incomplete_features_are_matched_where_nothing_complete_resembles() -> None:
    apart = np.zeros((2, 128), np.uint8)
    apart[1, 0] = 200
    expected = landmarks([AT, (200.0, 80.0, 10.0)], descriptors=apart)
    near = (101.0, 80.0, 10.0)
    complete = features([near, AT, (200.0, 80.0, 10.0)], descriptors=apart[[0, 0, 1]])
    found = match(
        expected,
        dataclasses.replace(complete, complete=np.array([True, False, False])),
        DESCRIPTOR,
    )
    # The incomplete one at the very place neither replaces the complete one nor makes it ambiguous.
    assert found.landmarks.tolist() == [0, 1]
    assert found.features.tolist() == [0, 2]


def test_an_ambiguous_landmark_is_not_given_to_an_incomplete_feature() -> None:
    described = np.zeros((3, 128), np.uint8)
    described[:2, 0] = 100
    rows = [(99.0, 80.0, 10.0), (101.0, 80.0, 10.0), AT]
    found = dataclasses.replace(
        features(rows, descriptors=described), complete=np.array([True, True, False])
    )
    assert len(match(landmarks(descriptors=described[2:]), found, DESCRIPTOR).landmarks) == 0
