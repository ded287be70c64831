"""Landmarks that last, through the tracker: viewpoints, permanence, demotion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG, FeatureWorld
from test_tracker import CERTAIN, IMAGE, SETTINGS

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.store import state_of
from fgslam.core.types import LandmarkMap, Prediction
from fgslam.frontend.settings import (
    DatabaseSettings,
    FrontendSettings,
    PermanenceSettings,
)
from fgslam.frontend.stereo import StereoMatcher
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.frontend.tracking.tracker import Association
from fgslam.slam.build import make_tracker

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
    """A tracker that looks at points around the middle; its map is the truth."""

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
        found = g.transform_to_world(wTc, g.triangulate(RIG, new.measurement))
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
    # What it looked like is forgotten only where it was seen anew from the same direction.
    assert (before.size[0] in after.size) is (views == 2 or not matched)
    np.testing.assert_allclose(np.linalg.norm(after.direction, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(after.direction[0], before.direction[0], atol=1e-6)


def test_without_viewpoints_a_failure_from_elsewhere_is_a_miss() -> None:
    things = Things(cloud(), settings())
    things.step(from_angle(HERE))
    landmark = things.id_of(7)
    things.step(from_angle(24.0), np.array([7]))
    assert things.entry(landmark) == {
        "hits": 1, "misses": 1, "missed": 1, "contradicted": 0, "permanent": 0, "views": 1,
    }  # fmt: skip


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


def test_a_blocked_camera_empties_the_map_of_what_it_should_see() -> None:
    things = settled(None)
    assert len(things.map) > 30
    for _ in range(30):
        things.step(from_angle(HERE), NOTHING)
    assert len(things.map) < 3  # at most what lies at the images' edge


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


def test_landmarks_not_yet_permanent_survive_a_blocked_view() -> None:
    things = Things(cloud(), settings(permanence=dataclasses.replace(LASTING, blind_below=0.05)))
    things.step(from_angle(HERE))
    ids = things.map.ids.copy()
    for _ in range(30):
        things.step(from_angle(HERE), NOTHING)
    assert not things.database.permanent.any()
    np.testing.assert_array_equal(things.map.ids, ids)


def beside_a_wall(permanence: PermanenceSettings) -> Things:
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
    things = beside_a_wall(dataclasses.replace(LASTING, contradicted_after=after))
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
    things = beside_a_wall(LASTING)
    ids = np.array([things.id_of(k) for k in THING])
    for _ in range(40):
        association = things.step(from_angle(HERE), THING)
        assert not np.isin(ids, association.pruned_ids).any()
    rows = things.database.rows(ids)
    assert (things.database.missed[rows] == 40).all()
    assert (state_of(things.database)["columns/contradicted"][rows] == 0).all()
    assert things.database.permanent[rows].all()


def test_a_hit_in_between_clears_a_landmark() -> None:
    things = beside_a_wall(LASTING)
    ids = np.array([things.id_of(k) for k in THING])
    for k in range(30):
        there = k % 6 == 5
        things.step(from_angle(HERE), PERSON if there else np.concatenate([THING, PERSON]))
    assert things.database.permanent[things.database.rows(ids)].all()


def test_a_landmark_rejected_again_and_again_is_demoted() -> None:
    """It has been moved a little: what looks like it is found beside its place."""
    things = beside_a_wall(LASTING)
    landmark = things.id_of(20)
    row = int(things.map.rows(np.array([landmark]))[0])
    things.map.positions[row, 0] += 2.4 * things.map.positions[row, 2] / RIG.fx
    fate = []
    for _ in range(8):
        association = things.step(from_angle(HERE), PERSON)
        fate.append(landmark in association.pruned_ids)
    assert fate.index(True) + 1 == LASTING.contradicted_after


def test_made_permanent_only_when_the_map_is_saved() -> None:
    things = settled(dataclasses.replace(LASTING, when="saved"))
    assert not things.database.permanent.any()
    assert things.database.lasting.all()
