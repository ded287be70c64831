"""Tracking a frame against the map (Se et al. 3 and 4.1)."""

from __future__ import annotations

import copy
import dataclasses
import math
import time
from typing import Any

import numpy as np
import pytest
from passing import PASSING_RIG, SCENE, pair_of
from simulated import RIG, FeatureWorld, assert_same_bits, points_in_view

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.store import restore, state_of
from fgslam.core.types import EgoMotionStatus, LandmarkMap, Prediction
from fgslam.frontend.settings import (
    AppearanceSettings,
    DatabaseSettings,
    EgoMotionSettings,
    FrontendSettings,
    MapMatchingSettings,
    PermanenceSettings,
    StereoSettings,
)
from fgslam.frontend.stereo import StereoMatcher
from fgslam.frontend.tracking import map_matching, tracker as regaining
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.frontend.tracking.tracker import (
    Association,
    LandmarkTracker,
    OtherMotion,
    Tracked,
    log_false_poses,
    places,
)
from fgslam.slam.build import make_tracker
from fgslam.slam.results import STAGES
from fgslam.slam.session import Session

# ------------------------------------------------------------------------------------------
# Tracking a frame and deciding each landmark's type (Se et al. 3 and 4)


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
        points = g.transform_to_world(wTc, RIG.triangulate(new.measurement))
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
    found = g.transform_to_world(moved, RIG.triangulate(matched.measurement))
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
    measured = RIG.predict(scene.map.positions)
    assert (measured[:, :2].min(axis=1) < 8.0).any()
    for _ in range(5):
        _, association = scene.step(np.eye(4))
        assert not association.observations.is_new.any()
        assert len(association.missed_ids) == 0
    assert len(scene.map) == count


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


@pytest.mark.parametrize("camera", range(RIG.cameras))
@pytest.mark.parametrize("moved", [0.05, 0.8])  # within the windows, and beyond them
def test_one_image_alone_locates_a_frame(camera: int, moved: float) -> None:
    rescues = MapMatchingSettings(widen_sigmas=0.0, refine=False, rescue=True)
    scene = Scene(dataclasses.replace(SETTINGS, matching=rescues))
    scene.step(np.eye(4))
    wTc = g.se3_exp(np.array([0.0, 0.01, 0.0, moved / 4.0, 0.0, moved]))
    found = scene.stereo.alone(camera, scene.world.features(wTc)[camera])
    prediction = Prediction(np.eye(4), np.diag([0.1] * 3 + [0.5] * 3) ** 2)
    tracked, features = scene.tracker.track_alone(camera, prediction, scene.map, found)
    pose = tracked.ego_motion
    assert pose.status is EgoMotionStatus.ONE_IMAGE
    error = g.se3_log(g.inverse(wTc) @ pose.wTc)
    assert error @ np.linalg.solve(pose.covariance, error) < 22.5  # 1 in 1,000, six degrees
    assert np.linalg.norm(error[3:]) < 0.02
    # The same frame by what the log holds of it: another camera's features are the rig's now.
    association = scene.tracker.associate_carried(tracked, features)
    seen = association.observations.select(~association.rejected)
    again = EgoMotionSolver(RIG, SETTINGS.ego_motion).solve(
        Prediction(pose.wTc, np.diag([0.1] * 3 + [0.5] * 3) ** 2), PoseProblem.of(scene.map, seen)
    )
    np.testing.assert_allclose(again.wTc, pose.wTc, rtol=0.0, atol=2e-3)
    assert not seen.is_new.any()


# ------------------------------------------------------------------------------------------
# Landmarks that last, through the tracker: viewpoints, permanence, demotion


DISTANCE = 3.0  # metres, from the camera to the middle of the things
HERE = 0.0
PRUNE_AFTER = 4


def from_angle(degrees: float) -> FloatArray:
    """The camera on a circle around the middle, looking at it; 0 is the world's origin."""
    turn = g.se3_exp(np.array([0.0, np.deg2rad(degrees), 0.0, 0.0, 0.0, 0.0]))
    middle = np.eye(4)
    middle[2, 3] = DISTANCE
    return np.asarray(middle @ turn @ np.linalg.inv(middle))


def settings(prune_after: int = PRUNE_AFTER, **database: object) -> FrontendSettings:
    made = DatabaseSettings(prune_after_misses=prune_after, **database)  # type: ignore[arg-type]
    return dataclasses.replace(SETTINGS, database=made)


def box(rng: np.random.Generator, count: int, half: float, depth: float) -> FloatArray:
    """Points (count, 3) in a cube before the first camera."""
    return np.asarray(rng.uniform(-half, half, (count, 3)) + np.array([0.0, 0.0, depth]))


class Things:
    """A tracker that observes points around the middle; its map is the truth."""

    def __init__(self, points: FloatArray, frontend: FrontendSettings) -> None:
        self.world = FeatureWorld(points, np.random.default_rng(5))
        self._tracker = make_tracker(RIG, frontend)
        self.stereo = StereoMatcher(RIG, frontend.stereo, frontend.appearance)
        self.map = LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))

    @property
    def database(self) -> LandmarkDatabase:
        return self._tracker.database

    def step(self, wTc: FloatArray, hidden: IntArray | None = None) -> Association:
        stereo = self.stereo.match(self.world.features(wTc, hidden=hidden))
        tracked = self._tracker.track(Prediction(wTc, CERTAIN), self.map, stereo)
        association = self._tracker.associate(tracked, stereo, IMAGE)
        new = association.observations.select(association.observations.is_new)
        found = g.transform_to_world(wTc, RIG.triangulate(new.measurement))
        ids = np.concatenate([self.map.ids, new.ids])
        positions = np.concatenate([self.map.positions, found])
        keep = ~np.isin(ids, association.pruned_ids)
        covariances = np.tile(1e-6 * np.eye(3), (int(keep.sum()), 1, 1))
        self.map = LandmarkMap(ids[keep], positions[keep], covariances)
        return association

    def id_of(self, point: int) -> int:
        gap = np.linalg.norm(self.map.positions - self.world.points[point], axis=1)
        assert gap.min() < 1e-6
        return int(self.map.ids[gap.argmin()])

    def entry(self, landmark: int) -> dict[str, int]:
        row = int(self.database.rows(np.array([landmark]))[0])
        names = ("hits", "misses", "missed", "contradicted", "permanent")
        state = state_of(self.database)
        entry = {name: int(state[f"columns/{name}"][row]) for name in names}
        return entry | {"views": int(views_of(self.database)[row])}


def views_of(database: LandmarkDatabase) -> IntArray:
    return np.asarray((state_of(database)["columns/places"] >= 0).sum(axis=1))


def cloud(count: int = 40, spread: float = 0.5) -> FloatArray:
    """Points around the middle, which all cameras on the circle see."""
    return box(np.random.default_rng(8), count, spread, DISTANCE)


# --------------------------------------------------------------------------------------------
# Viewpoints

BRANCHES = {
    # angle from the only view, matched: views, misses afterwards
    "inside, matched: the view is renewed": (14.0, True, 1, 0),
    "inside, not matched: a miss": (14.0, False, 1, 1),
    "outside, matched: another view": (24.0, True, 2, 0),
    "outside, not matched: no miss": (24.0, False, 1, 0),
}


@pytest.mark.parametrize("branch", BRANCHES)
def test_the_four_branches(branch: str) -> None:
    """The procedure of 6.3, and 6.3's last sentence: a match measures the position either way."""
    angle, matched, views, misses = BRANCHES[branch]
    things = Things(cloud(), settings(viewpoints=True))
    things.step(from_angle(HERE))
    landmark = things.id_of(7)
    before = things.database.appearances(np.array([landmark]))
    association = things.step(from_angle(angle), None if matched else np.array([7]))
    found = things.entry(landmark)
    assert (found["views"], found["misses"]) == (views, misses)
    assert found["hits"] == (2 if matched else 1)
    assert (landmark in association.observations.ids) is matched
    assert (landmark in association.missed_ids) is (misses == 1)
    after = things.database.appearances(np.array([landmark]))
    # What it looked like is forgotten only where it was seen again from the same direction.
    assert (before.size[0] in after.size) is (views == 2 or not matched)
    np.testing.assert_allclose(np.linalg.norm(after.direction, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(after.direction[0], before.direction[0], atol=1e-6)


class Pillar:
    """Points on a pillar, each seen from before it only: within 60 degrees of its normal."""

    def __init__(self, count: int = 150) -> None:
        rng = np.random.default_rng(2)
        around = rng.uniform(0.0, 2.0 * np.pi, count)
        self._normals = np.column_stack([np.sin(around), np.zeros(count), np.cos(around)])
        height = np.column_stack([np.zeros(count), rng.uniform(-0.6, 0.6, count), np.zeros(count)])
        self.points = 0.4 * self._normals + height + [0.0, 0.0, DISTANCE]

    def behind(self, wTc: FloatArray) -> BoolArray:
        """Which points the camera cannot see."""
        towards = wTc[:3, 3] - self.points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        return np.asarray((towards * self._normals).sum(axis=1) < np.cos(np.deg2rad(60.0)))


@pytest.mark.parametrize("several", [False, True])
def test_an_orbit_around_a_pillar(several: bool) -> None:
    """With viewpoints each landmark survives, and has a view for each 20 degrees.

    At the end of what is seen of it a landmark is still near to its last view for five frames.
    """
    pillar = Pillar()
    viewpoints = several
    things = Things(pillar.points, settings(prune_after=20, viewpoints=viewpoints))
    born: set[int] = set()
    lost = 0
    for angle in np.arange(0.0, 360.0, 4.0):
        wTc = from_angle(float(angle))
        association = things.step(wTc, np.flatnonzero(pillar.behind(wTc)))
        observed = association.observations
        born |= set(observed.ids[observed.is_new].tolist())
        lost += len(association.pruned_ids)
    if not several:  # from behind, the pillar hides them: farther off than they were ever seen
        assert lost <= 0.02 * len(born)
        return
    assert lost == 0
    assert len(things.map) == len(born)
    # Seen over 120 degrees of their own, a little less of the orbit's (the pillar is thick).
    views = views_of(things.database)
    assert 4 <= np.median(views) <= views.max() <= 1 + 120 // 20


# --------------------------------------------------------------------------------------------
# Permanence

LASTING = PermanenceSettings(ratio=0.5, hits=3, blind_below=0.0, contradicted_after=6)
NOTHING = np.arange(40)


def settled(permanence: PermanenceSettings | None) -> Things:
    """Things seen often enough to last."""
    things = Things(cloud(), settings(permanence=permanence))
    for _ in range(4):
        things.step(from_angle(HERE))
    return things


@pytest.mark.parametrize("blind_below", [0.0, 0.05])
def test_a_blocked_camera_takes_nothing_from_a_lasting_map(blind_below: float) -> None:
    """By the flag alone, and by knowing a blocked view."""
    things = settled(dataclasses.replace(LASTING, blind_below=blind_below))
    ids, misses = things.map.ids.copy(), things.database.misses.copy()
    assert things.database.permanent.all()
    for _ in range(30):
        association = things.step(from_angle(HERE), NOTHING)
        assert (len(association.missed_ids) == 0) is (blind_below > 0.0)
    np.testing.assert_array_equal(things.map.ids, ids)
    assert things.database.permanent.all()
    assert (things.database.misses == misses).all() is np.bool_(blind_below > 0.0)
    # And when the view clears, each is found again, under its own name.
    association = things.step(from_angle(HERE))
    assert not association.observations.is_new.any()
    np.testing.assert_array_equal(association.observations.ids, ids)


def next_to_a_wall(permanence: PermanenceSettings) -> Things:
    """A thing of eight points before a wall of many, and what hides it: a thing nearer yet."""
    rng = np.random.default_rng(9)
    thing = box(rng, 8, 0.15, 2.5)
    wall = np.column_stack(
        [rng.uniform(-1.5, 1.5, 60), rng.uniform(-1.2, 1.2, 60), np.full(60, 5.0)]
    )
    person = box(rng, 12, 0.15, 1.6)
    things = Things(np.concatenate([thing, wall, person]), settings(permanence=permanence))
    for _ in range(4):
        things.step(from_angle(HERE), PERSON)
    return things


THING, PERSON = np.arange(8), np.arange(68, 80)


@pytest.mark.parametrize("after", [3, 6, None])
def test_a_thing_that_is_gone_is_demoted_and_goes(after: int | None) -> None:
    """Item 5.5: where it was, the wall behind is seen."""
    things = next_to_a_wall(dataclasses.replace(LASTING, contradicted_after=after))
    ids = np.array([things.id_of(k) for k in THING])
    assert things.database.permanent[things.database.rows(ids)].all()
    gone_at: dict[int, int] = {}
    for k in range(1, 16):
        association = things.step(from_angle(HERE), np.concatenate([THING, PERSON]))
        gone_at |= {int(i): k for i in association.pruned_ids}
    if after is None:
        assert gone_at == {}
    else:
        assert gone_at == {int(i): max(after, PRUNE_AFTER) for i in ids}


def test_a_thing_behind_a_person_stays() -> None:
    things = next_to_a_wall(LASTING)
    ids = np.array([things.id_of(k) for k in THING])
    for _ in range(40):
        association = things.step(from_angle(HERE), THING)
        assert not np.isin(ids, association.pruned_ids).any()
    rows = things.database.rows(ids)
    assert (things.database.missed[rows] == 40).all()
    assert (state_of(things.database)["columns/contradicted"][rows] == 0).all()
    assert things.database.permanent[rows].all()


def test_a_hit_in_between_clears_a_landmark() -> None:
    things = next_to_a_wall(LASTING)
    ids = np.array([things.id_of(k) for k in THING])
    for k in range(30):
        there = k % 6 == 5
        things.step(from_angle(HERE), PERSON if there else np.concatenate([THING, PERSON]))
    assert things.database.permanent[things.database.rows(ids)].all()


def test_a_landmark_rejected_again_and_again_is_demoted() -> None:
    """It has been moved a little: what resembles it is found next to its place."""
    things = next_to_a_wall(LASTING)
    landmark = things.id_of(20)
    row = int(things.map.rows(np.array([landmark]))[0])
    things.map.positions[row, 0] += 2.4 * things.map.positions[row, 2] / RIG.fx
    fate = []
    for _ in range(8):
        association = things.step(from_angle(HERE), PERSON)
        fate.append(landmark in association.pruned_ids)
    assert fate.index(True) + 1 == LASTING.contradicted_after


# ------------------------------------------------------------------------------------------
# Frames whose prediction fails are found by what was seen lately, or not at all


RESCUING = dataclasses.replace(
    SETTINGS, matching=dataclasses.replace(SETTINGS.matching, rescue=True)
)
TURNED = g.se3_exp(np.array([0.05, 0.2, -0.1, 0.2, 0.05, 0.1]))  # 13 degrees, half the image
ABSURD = g.se3_exp(np.array([0.0, 2.5, 0.0, -4.0, 0.0, 1.0]))  # turned away from all landmarks


def tracked_at(scene: Scene, predicted: FloatArray, wTc: FloatArray = TURNED) -> Tracked:
    stereo = scene.stereo.match(scene.world.features(wTc, sigma_px=0.1))
    return scene.tracker.track(Prediction(predicted, CERTAIN), scene.map, stereo)


@pytest.fixture
def scene() -> Scene:
    begun = Scene(RESCUING, 150)
    begun.step(np.eye(4))
    return begun


@pytest.mark.parametrize("predicted", [np.eye(4), ABSURD], ids=["turned", "absurd"])
def test_a_frame_is_found_whatever_was_predicted(scene: Scene, predicted: FloatArray) -> None:
    found = tracked_at(scene, predicted).ego_motion
    assert found.status is EgoMotionStatus.RELOCALISED
    assert found.inliers.sum() > 30
    np.testing.assert_allclose(g.se3_log(g.inverse(TURNED) @ found.wTc), 0.0, atol=4e-3)


def test_no_search_is_made_for_a_frame_that_was_foreseen(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(regaining.Regainer, "find", lambda *_: pytest.fail("looked for"))
    assert tracked_at(scene, TURNED).ego_motion.status is EgoMotionStatus.OK


def test_other_surroundings_are_not_taken_for_known_ones(scene: Scene) -> None:
    rng = np.random.default_rng(5)
    scene.world = FeatureWorld(points_in_view(RIG, 150, (1.5, 5.0), rng), rng)
    found = tracked_at(scene, np.eye(4)).ego_motion
    assert found.status is EgoMotionStatus.TOO_FEW_MATCHES


@pytest.mark.parametrize(("share", "believed"), [(0.25, True), (0.5, False)])
def test_what_moved_together_may_not_rival_the_rest(
    scene: Scene, share: float, believed: bool
) -> None:
    """A part of the view has moved by itself: small it is left out, large it is one of two."""
    moved = g.se3_exp(np.array([0.0, 0.0, 0.1, 0.6, 0.1, -0.3]))
    part = scene.world.points[:, 0] < np.quantile(scene.world.points[:, 0], share)
    scene.world.points[part] = g.transform_to_world(moved, scene.world.points[part])
    found = tracked_at(scene, ABSURD, np.eye(4)).ego_motion
    assert found.status.measured is believed
    if believed:
        np.testing.assert_allclose(g.se3_log(found.wTc), 0.0, atol=4e-3)


def test_a_stiff_wrong_prediction_does_not_win_by_a_handful_of_matches(scene: Scene) -> None:
    """Most far landmarks stay where they were; the near ones tell that the camera moved on."""
    step = g.se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))
    stiff = Prediction(np.eye(4), np.diag([1e-4] * 6) ** 2)
    stereo = scene.stereo.match(scene.world.features(step, sigma_px=0.1))
    found = scene.tracker.track(stiff, scene.map, stereo).ego_motion
    np.testing.assert_allclose(g.se3_log(g.inverse(step) @ found.wTc), 0.0, atol=4e-3)


def test_a_few_matches_where_they_were_predicted_do_not_hide_all_others(scene: Scene) -> None:
    """A tenth of the landmarks, moved with the camera, fit the wrong pose that was predicted."""
    few = scene.world.points[:, 0] < np.quantile(scene.world.points[:, 0], 0.1)
    scene.world.points[few] = g.transform_to_world(TURNED, scene.world.points[few])
    stereo = scene.stereo.match(scene.world.features(TURNED, sigma_px=0.1))
    around = Prediction(np.eye(4), CERTAIN)
    wrong = scene.tracker.match_and_solve(around, around, scene.map, stereo).ego_motion
    assert wrong.status is EgoMotionStatus.OK
    assert wrong.coherent
    found = scene.tracker.track(around, scene.map, stereo).ego_motion
    assert found.status is EgoMotionStatus.RELOCALISED
    np.testing.assert_allclose(g.se3_log(g.inverse(TURNED) @ found.wTc), 0.0, atol=4e-3)


@pytest.mark.parametrize("returns", [False, True])
def test_new_ground_is_no_reason_to_look(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, returns: bool
) -> None:
    """A sound pose that a third of the features agree with, where two thirds are seen first."""
    monkeypatch.setattr(regaining.Regainer, "find", lambda *_: pytest.fail("looked for"))
    scene.tracker.expects_returns = returns
    known = scene.map.without(np.delete(scene.map.ids, np.s_[::3]))
    stereo = scene.stereo.match(scene.world.features(np.eye(4), sigma_px=0.1))
    found = scene.tracker.track(Prediction(np.eye(4), CERTAIN), known, stereo).ego_motion
    assert found.status is EgoMotionStatus.OK
    assert found.inliers.sum() < 0.4 * len(stereo)


@pytest.mark.parametrize("returns", [False, True])
def test_few_matches_are_a_reason_whatever_else_searches(scene: Scene, returns: bool) -> None:
    scene.tracker.expects_returns = returns
    few = scene.world.points[:, 0] < np.quantile(scene.world.points[:, 0], 0.1)
    scene.world.points[few] = g.transform_to_world(TURNED, scene.world.points[few])
    found = tracked_at(scene, np.eye(4)).ego_motion
    assert found.status is EgoMotionStatus.RELOCALISED


def test_only_what_was_seen_lately_is_looked_for(scene: Scene) -> None:
    """A map from which the run has seen nothing for long is the business of place recognition."""
    rng = np.random.default_rng(5)
    old, scene.world = (
        scene.world,
        FeatureWorld(points_in_view(RIG, 80, (1.5, 5.0), rng), rng),
    )
    for _ in range(regaining.LATELY + 1):
        scene.step(np.eye(4))
    scene.world = old
    assert not tracked_at(scene, ABSURD).ego_motion.status.measured


def test_number_of_false_poses_is_that_of_moisan_and_stival() -> None:
    """(10 - 3) C(10, 5) C(5, 3) 0.01^2 = 7 * 252 * 10 * 1e-4."""
    assert math.exp(log_false_poses(10, 5, 3, 0.01)) == pytest.approx(1.764)
    assert log_false_poses(10, 3, 3, 0.01) == math.inf


def test_matches_at_one_place_count_once() -> None:
    assert places(np.array([[10.0, 10.0], [10.5, 10.9], [40.0, 10.0]]), 3.0) == 2


def test_landmarks_described_lately(scene: Scene) -> None:
    database = scene.tracker.database
    first = set(database.ids.tolist())
    for _ in range(2):
        scene.step(np.eye(4), hidden=np.arange(75))
    assert first <= set(database.described_lately(2).tolist())
    left = first & set(database.described_lately(1).tolist())
    assert not left & set(scene.ids_at(np.arange(75)).tolist())
    assert len(left) > 60


def test_doubles_seen_before_do_not_hide_what_the_last_frame_saw(scene: Scene) -> None:
    """Among all of lately each feature has two landmarks that look alike; at last it has one."""
    rng, before = np.random.default_rng(6), scene.world
    scene.world = FeatureWorld(points_in_view(RIG, 150, (1.5, 5.0), rng), rng)
    scene.world.descriptors = before.descriptors
    scene.step(np.eye(4))
    found = tracked_at(scene, ABSURD).ego_motion
    assert found.status is EgoMotionStatus.RELOCALISED
    np.testing.assert_allclose(g.se3_log(g.inverse(TURNED) @ found.wTc), 0.0, atol=4e-3)


# ------------------------------------------------------------------------------------------
# A second rigid motion in the view: something large that passes, or nothing but the scene


BOARD_M = 0.5
FRAMES = 6
_SLOW_S = 0.05


def drive(board_m: float, step_m: float) -> Session:
    """4 cm a frame ahead; a board, at first ``board_m`` away, goes to the right before the camera.

    With a step of none it stands in the room.
    """
    session = Session(PASSING_RIG)
    for k in range(FRAMES):
        ahead, left = 0.04 * k, -0.6 + step_m * k
        depth = board_m + (ahead if step_m else 0.0)
        planes = [*SCENE, (depth, left, left + BOARD_M)]
        session.track(0.1 * k, pair_of(planes, 0.0, ahead))
    return session


def test_something_large_that_passes_is_reported() -> None:
    with drive(1.2, 0.1) as session:
        reported = [note for note in session.result().notes if note.code.startswith("other_motion")]
        assert len(reported) == 1, session.result().notes
        watch = session.pipeline.tracker.other_motion
        other = OtherMotion(PASSING_RIG, EgoMotionSolver(PASSING_RIG, EgoMotionSettings()))
        restore(other, state_of(watch))
        assert other.remarks() == watch.remarks() == (reported[0],)
        for name, array in state_of(watch).items():
            np.testing.assert_array_equal(state_of(other)[name], array)


def test_a_scene_that_stands_has_one_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    look = OtherMotion.look

    def slowly(*arguments: Any) -> None:
        time.sleep(_SLOW_S)
        look(*arguments)

    monkeypatch.setattr(OtherMotion, "look", slowly)
    with drive(1.6, 0.0) as session:
        assert session.result().notes == ()
        assert session.pipeline.tracker.other_motion.remarks() == ()
        watching = session.recorder.stage_ms[0][STAGES.index("watch")]  # a key frame
        assert watching >= 1e3 * _SLOW_S, "the time is not the estimator's"
