"""Tracking a frame and deciding each landmark's type (Se et al. 3 and 4)."""

from __future__ import annotations

import copy
import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from simulated import RIG, FeatureWorld, assert_same_bits, points_in_view

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.store import TREE, restore, state_of
from fgslam.core.types import EgoMotionStatus, LandmarkMap, Prediction
from fgslam.frontend.features.settings import AppearanceSettings
from fgslam.frontend.settings import (
    DatabaseSettings,
    EgoMotionSettings,
    FrontendSettings,
    MapMatchingSettings,
    StereoSettings,
)
from fgslam.frontend.stereo import StereoMatcher
from fgslam.frontend.tracking import map_matching
from fgslam.frontend.tracking.tracker import Association, LandmarkTracker, Tracked
from fgslam.slam.build import make_tracker

COUNT = 60
IMAGE = np.tile(np.arange(240, dtype=np.uint8)[:, None], (1, 320))  # grey value is the row
CERTAIN = np.diag([0.002] * 3 + [0.005] * 3) ** 2
SETTINGS = FrontendSettings(
    stereo=StereoSettings(),
    appearance=AppearanceSettings(mode="descriptor"),
    matching=MapMatchingSettings(widen_sigmas=0.0, refine=False, rescue=False),
    database=DatabaseSettings(prune_after_misses=3, field_of_view="image"),
    ego_motion=EgoMotionSettings(min_matches=6),
)


class Scene:
    """A tracker with a map that is the truth itself."""

    def __init__(self, settings: FrontendSettings = SETTINGS, count: int = COUNT) -> None:
        rng = np.random.default_rng(12)
        self.world = FeatureWorld(points_in_view(RIG, count, (1.5, 5.0), rng), rng)
        self.tracker: LandmarkTracker = make_tracker(RIG, settings)
        self.stereo = StereoMatcher(RIG, settings.stereo, settings.appearance)
        self.settings = settings
        self.map = LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))

    def step(self, wTc: FloatArray, hidden: IntArray | None = None, predicted=None):
        """One frame; new landmarks enter the map where they were measured."""
        stereo = self.stereo.match(self.world.features(wTc, hidden=hidden))
        prediction = Prediction(wTc if predicted is None else predicted, CERTAIN)
        tracked = self.tracker.track(prediction, self.map, stereo)
        association = self.tracker.associate(tracked, stereo, IMAGE)
        self._update(association, wTc)
        return tracked, association

    def _update(self, association: Association, wTc: FloatArray) -> None:
        new = association.observations.select(association.observations.is_new)
        points = g.transform_to_world(wTc, g.triangulate(RIG, new.measurement))
        ids = np.concatenate([self.map.ids, new.ids])
        positions = np.concatenate([self.map.positions, points])
        keep = ~np.isin(ids, association.pruned_ids)
        covariances = np.tile(1e-6 * np.eye(3), (int(keep.sum()), 1, 1))
        self.map = LandmarkMap(ids[keep], positions[keep], covariances)

    def ids_at(self, points: IntArray) -> IntArray:
        """Identities of the world's points."""
        gap = np.linalg.norm(self.map.positions[:, None] - self.world.points[points], axis=2)
        assert (gap.min(axis=0) < 1e-6).all()
        return self.map.ids[gap.argmin(axis=0)]


def test_the_first_frame_starts_a_track_for_each_feature() -> None:
    scene = Scene()
    tracked, association = scene.step(np.eye(4))
    count = len(association.observations)
    assert count > 40
    assert association.observations.is_new.all()
    assert association.observations.ids.tolist() == list(range(count))
    assert tracked.ego_motion.status is EgoMotionStatus.TOO_FEW_MATCHES
    assert len(association.missed_ids) == len(association.pruned_ids) == 0
    assert scene.tracker.database.ids.tolist() == list(range(count))
    # The map's grey value is that of the image where the feature is.
    rows = np.rint(association.observations.measurement[:, 1]).astype(np.uint8)
    np.testing.assert_array_equal(scene.tracker.database.colour, rows)


def test_seen_again_is_type_III() -> None:
    scene = Scene()
    scene.step(np.eye(4))
    before = len(scene.map)
    moved = g.se3_exp(np.array([0.005, -0.01, 0.0, 0.01, 0.0, 0.02]))
    tracked, association = scene.step(moved)
    assert tracked.ego_motion.status is EgoMotionStatus.OK
    np.testing.assert_allclose(tracked.ego_motion.wTc, moved, atol=1e-6)
    matched = association.observations.select(~association.observations.is_new)
    assert len(matched) >= 0.9 * before
    assert not association.rejected.any()
    # They are the same points: back-projected to where the map has them.
    found = g.transform_to_world(moved, g.triangulate(RIG, matched.measurement))
    np.testing.assert_allclose(found, scene.map.positions[scene.map.rows(matched.ids)], atol=1e-6)
    rows = scene.tracker.database.rows(matched.ids)
    assert (scene.tracker.database.hits[rows] == 2).all()
    assert (scene.tracker.database.missed[rows] == 0).all()


def test_what_two_images_show_is_matched_but_starts_no_landmark() -> None:
    scene = Scene()
    _, association = scene.step(np.eye(4))
    first = len(association.observations)
    right, left, top = scene.world.features(np.eye(4))
    stereo = scene.stereo.match_all((right, left, top.select(np.arange(0))))
    assert stereo.complete is not None
    assert not stereo.complete.any()
    fresh = Scene()
    tracked = fresh.tracker.track(Prediction(np.eye(4), CERTAIN), fresh.map, stereo)
    assert len(fresh.tracker.associate(tracked, stereo, IMAGE).observations) == 0
    tracked = scene.tracker.track(Prediction(np.eye(4), CERTAIN), scene.map, stereo)
    association = scene.tracker.associate(tracked, stereo, IMAGE)
    assert not association.observations.is_new.any()
    assert len(association.observations) > 0.8 * first
    assert (association.partners(0) == -1).all()


def test_types_partition_map_and_features() -> None:
    """Each landmark is out of view, missed or matched; each feature matched, new or held."""
    scene = Scene()
    rng = np.random.default_rng(3)
    scene.step(np.eye(4))
    for _ in range(12):
        wTc = g.se3_exp(np.array([0.02, 0.12, 0.01, 0.1, 0.05, 0.15]) * rng.standard_normal(6))
        known = set(scene.map.ids.tolist())
        hidden = rng.choice(COUNT, 12, replace=False)
        tracked, association = scene.step(wTc, hidden)
        seen = association.observations
        matched = set(seen.ids[~seen.is_new & ~association.rejected].tolist())
        missed = set(association.missed_ids.tolist())
        new = set(seen.ids[seen.is_new].tolist())
        possible = set(tracked.expected.ids.tolist())
        certain = set(tracked.expected.ids[tracked.expected.certain].tolist())
        assert certain <= matched | missed <= possible <= known
        assert not matched & missed
        assert not new & known
        assert set(scene.map.ids.tolist()) == (known | new) - set(association.pruned_ids.tolist())
        np.testing.assert_array_equal(scene.tracker.database.ids, scene.map.ids)
        assert int(seen.is_new.sum()) == int((~tracked.matches.had_candidates).sum())


def test_missed_landmarks_die_on_the_last_miss_in_a_row() -> None:
    """Through the tracker: hidden objects are gone after N frames, not before."""
    scene = Scene()
    scene.step(np.eye(4))
    gone = scene.ids_at(np.array([3, 7, 20]))
    expected = scene.tracker.database.expected(scene.map, np.eye(4))
    expected = expected.ids[expected.certain]
    gone = np.sort(gone[np.isin(gone, expected)])
    assert len(gone) == 3
    hide = np.array([3, 7, 20])
    for k in range(3):
        _, association = scene.step(np.eye(4), hide)
        assert set(gone.tolist()) <= set(association.missed_ids.tolist())
        assert association.pruned_ids.tolist() == (gone.tolist() if k == 2 else [])
    # Seen again they are new ones.
    _, association = scene.step(np.eye(4))
    assert int(association.observations.is_new.sum()) == len(hide)
    assert association.observations.ids[association.observations.is_new].min() > gone.max()


def test_a_camera_at_rest_starts_each_track_once() -> None:
    """Also those at the images' borders: the map of a still scene does not grow."""
    scene = Scene()
    scene.step(np.eye(4))
    count = len(scene.map)
    measured = g.project(RIG, scene.map.positions)
    assert (measured[:, :2].min(axis=1) < 8.0).any()
    for _ in range(5):
        _, association = scene.step(np.eye(4))
        assert not association.observations.is_new.any()
        assert len(association.missed_ids) == 0
    assert len(scene.map) == count


def test_a_hit_in_between_saves_a_landmark() -> None:
    scene = Scene()
    scene.step(np.eye(4))
    for k in range(8):
        scene.step(np.eye(4), np.array([3, 7, 20]) if k % 3 else None)
        assert len(scene.map) == len(scene.tracker.database)
    rows = scene.tracker.database.rows(scene.ids_at(np.array([3, 7, 20])))
    assert (scene.tracker.database.missed[rows] <= 2).all()


def test_landmarks_out_of_view_are_left_alone() -> None:
    """Type I: bit-identical, however long nobody looks."""
    scene = Scene()
    scene.step(np.eye(4))
    before = copy.deepcopy(state_of(scene.tracker.database))
    away = g.se3_exp(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    for _ in range(10):
        _, association = scene.step(away)
        assert len(association.missed_ids) == len(association.pruned_ids) == 0
    after = state_of(scene.tracker.database)
    frames = [json.loads(str(state.pop(TREE)))["part"]["_frame"] for state in (before, after)]
    assert frames[1] == frames[0] + 10  # frames counted, no entry
    assert_same_bits(after, before)


def test_outliers_count_as_misses_and_are_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    scene.step(np.eye(4))
    # One landmark of the map is not where it was seen: 4 px off, but inside the window.
    scene.settings = SETTINGS
    monkeypatch.setattr(map_matching, "WINDOW_PX", 20.0)
    state = state_of(scene.tracker.database)
    scene.tracker = make_tracker(RIG, SETTINGS)
    restore(scene.tracker.database, state)
    expected = scene.tracker.database.expected(scene.map, np.eye(4))
    wrong = int(expected.ids[len(expected) // 2])
    row = int(scene.map.rows(np.array([wrong]))[0])
    scene.map.positions[row, 0] += 6.0 * scene.map.positions[row, 2] / RIG.fx
    _, association = scene.step(np.eye(4))
    seen = association.observations
    assert seen.ids[association.rejected].tolist() == [wrong]
    assert wrong in association.missed_ids.tolist()
    database = scene.tracker.database
    at = int(database.rows(np.array([wrong]))[0])
    assert (database.hits[at], database.misses[at], database.missed[at]) == (1, 1, 1)


def test_a_poor_prediction_is_corrected() -> None:
    scene = Scene()
    scene.step(np.eye(4))
    predicted = g.se3_exp(np.array([0.002, -0.003, 0.002, 0.01, -0.005, 0.01]))
    tracked, _ = scene.step(np.eye(4), predicted=predicted)
    assert tracked.ego_motion.status is EgoMotionStatus.OK
    error = np.abs(g.se3_log(tracked.ego_motion.wTc)).max()
    assert error < 0.2 * np.abs(g.se3_log(predicted)).max()


FAR_OFF = g.se3_exp(np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.0]))  # about 8 px, beyond the window


def test_beyond_the_window_all_is_lost() -> None:
    scene = Scene()
    scene.step(np.eye(4))
    tracked, _ = scene.step(np.eye(4), predicted=FAR_OFF)
    assert tracked.ego_motion.status is EgoMotionStatus.TOO_FEW_MATCHES
    np.testing.assert_allclose(tracked.ego_motion.wTc, FAR_OFF, atol=1e-12)


@pytest.mark.parametrize("how", ["rescue", "widen"])
def test_wider_search_finds_it_again(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_matching, "MAX_WINDOW_PX", 60.0)
    changes = {"rescue": True} if how == "rescue" else {"widen_sigmas": 3.0}
    matching = dataclasses.replace(SETTINGS.matching, **changes)
    scene = Scene(dataclasses.replace(SETTINGS, matching=matching))
    scene.step(np.eye(4))
    stereo = scene.stereo.match(scene.world.features(np.eye(4)))
    vague = Prediction(FAR_OFF, np.diag([0.02] * 3 + [0.02] * 3) ** 2)
    tracked = scene.tracker.track(vague, scene.map, stereo)
    assert tracked.ego_motion.status is EgoMotionStatus.OK
    np.testing.assert_allclose(g.se3_log(tracked.ego_motion.wTc), 0.0, atol=2e-3)


def test_refining_matches_again_around_the_pose_found() -> None:
    """Some are within the window of the prediction, the others only of the pose they give."""
    predicted = g.se3_exp(np.array([0.0, 0.0, 0.0, 0.03, 0.0, 0.0]))
    matches = {}
    for refine in (False, True):
        matching = dataclasses.replace(SETTINGS.matching, refine=refine)
        scene = Scene(dataclasses.replace(SETTINGS, matching=matching))
        scene.step(np.eye(4))
        tracked, _ = scene.step(np.eye(4), predicted=predicted)
        assert tracked.ego_motion.status is EgoMotionStatus.OK
        matches[refine] = len(tracked.matches.landmarks)
    assert matches[True] > matches[False] + 5


@pytest.mark.parametrize(("sideways_m", "attempts"), [(0.0, 1), (0.005, 1), (0.03, 2)])
def test_a_frame_is_matched_anew_only_where_the_prediction_was_off(
    sideways_m: float, attempts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    matching = dataclasses.replace(SETTINGS.matching, refine=True)
    scene = Scene(dataclasses.replace(SETTINGS, matching=matching))
    scene.step(np.eye(4))
    made: list[None] = []
    attempt = scene.tracker.match_and_solve

    def counted(*given: Any, **named: Any) -> Tracked:
        made.append(None)
        return attempt(*given, **named)

    monkeypatch.setattr(scene.tracker, "match_and_solve", counted)
    scene.step(np.eye(4), predicted=g.se3_exp(np.array([0.0, 0.0, 0.0, sideways_m, 0.0, 0.0])))
    assert len(made) == attempts


def test_tracking_alone_changes_nothing() -> None:
    scene = Scene()
    scene.step(np.eye(4))
    stereo = scene.stereo.match(scene.world.features(np.eye(4)))
    given = (Prediction(np.eye(4), CERTAIN.copy()), scene.map, stereo)
    kept, state = copy.deepcopy(given), copy.deepcopy(state_of(scene.tracker.database))
    first, second = scene.tracker.track(*given), scene.tracker.track(*given)
    assert_same_bits(first, second)
    assert_same_bits(given, kept)
    assert_same_bits(state_of(scene.tracker.database), state)


def test_nothing_seen_is_a_miss_for_all_in_view() -> None:
    scene = Scene()
    scene.step(np.eye(4))
    tracked, association = scene.step(np.eye(4), np.arange(COUNT))
    assert tracked.ego_motion.status is EgoMotionStatus.TOO_FEW_MATCHES
    assert len(association.observations) == 0
    expected = tracked.expected
    np.testing.assert_array_equal(association.missed_ids, expected.ids[expected.certain])
    assert len(association.missed_ids) > 40


def test_no_image_is_no_miss() -> None:
    nothing = Association.nothing()
    assert len(nothing.observations) == len(nothing.rejected) == 0
    assert len(nothing.missed_ids) == len(nothing.pruned_ids) == 0
