"""Returns: who saw what, when a place is believed, the closure, and landmarks found twice."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG, assert_same_bits

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Increment, LoopClosure, Observations
from fgslam.core.store import restore, state_of
from fgslam.core.types import (
    EgoMotionStatus,
    LandmarkAppearances,
    LandmarkMap,
    Relocalisation,
    RelocalisationStatus,
    StereoFeatures,
)
from fgslam.frontend.features.settings import AppearanceSettings
from fgslam.frontend.places.recognition import (
    Confirmation,
    LoopGates,
    SightingMemory,
    close_loop,
    difference,
    drift_allows,
    duplicates,
)
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem, Resection

LOOPS = LoopGates()
DOWN = np.array([0.0, 1.0, 0.0])
NOBODY = np.empty(0, np.int64)
NOISE = 0.2**2 * np.eye(3)


def turned(yaw_deg: float, x: float = 0.0, z: float = 0.0) -> FloatArray:
    """A camera on the floor: yaw about the vertical, moved by x and z."""
    return g.pose(g.so3_exp(np.deg2rad(yaw_deg) * DOWN), np.array([x, 0.0, z]))


def sight(
    wTc: FloatArray, points: FloatArray, ids: IntArray, rng: np.random.Generator | None = None
) -> Observations:
    """What a camera measures of points; with a fifth of a pixel of noise where ``rng`` is given."""
    measured = g.project(RIG, g.transform_to_camera(wTc, points))
    if rng is not None:
        measured = measured + 0.2 * rng.standard_normal(measured.shape)
    count = len(ids)
    return Observations(
        ids,
        measured,
        np.tile(NOISE, (count, 1, 1)),
        np.full((count, 3, 2), np.nan),
        np.zeros(count, np.bool_),
    )


def frame(k: int, observed: Observations) -> Increment:
    none = np.empty(0, np.int64)
    return Increment(k, float(k), None, observed, np.zeros(len(observed), np.bool_), none, none)


def cloud(count: int, rng: np.random.Generator) -> FloatArray:
    """Points before a camera at the origin."""
    return rng.uniform([-1.0, -0.6, 2.0], [1.0, 0.6, 5.0], (count, 3))


# -- memory ----------------------------------------------------------------------------------


def remembered(frames: list[list[int]], given: int = -1) -> SightingMemory:
    memory, forward = SightingMemory(given), turned(0.0, z=0.5)
    for k, ids in enumerate(frames):
        known = np.array(ids, np.int64)
        points = np.tile([0.0, 0.0, 3.0], (len(ids), 1))
        memory.add(frame(k, sight(np.eye(4), points, known)), forward)
    return memory


def test_memory_tells_what_was_not_seen_for_long_and_where_it_was_seen_best() -> None:
    memory = remembered([[0, 1, 2], [0, 1, 2, 3], [3, 4], [4, 5], [5, 6], [2, 6]])
    asked = np.arange(9)
    np.testing.assert_array_equal(memory.unseen_for(3, asked), [0, 1, 3])
    np.testing.assert_array_equal(memory.unseen_for(1, asked), [0, 1, 3, 4, 5])
    held = _map(asked, np.zeros((9, 3)))
    assert memory.best_view_of(np.array([0, 1, 3]), held) == 1
    assert memory.best_view_of(np.array([0, 1, 2]), held) == 1, "the later of two equal views"
    assert memory.last_seen(np.array([0, 3])) == 2
    np.testing.assert_array_equal(memory.made_after(1, asked), asked > 3)
    assert memory.way_since(1) == pytest.approx(2.0)
    assert memory.best_view_of(np.array([8]), held) == -1, "never seen"


def test_landmarks_of_the_map_that_a_run_begins_in_are_older_than_all_it_sees() -> None:
    """Seen or not: none of them may end as the duplicate of another."""
    memory = remembered([[3, 4], [4, 5], [5, 21]], given=20)
    asked = np.array([4, 6, 20, 21, 22])
    np.testing.assert_array_equal(memory.made_after(0, asked), asked > 20)
    np.testing.assert_array_equal(memory.made_after(2, asked), asked > 21)


MAP = np.arange(60)
"""Landmarks of a map in which a run begins."""
HERE = list(range(20))
"""Those seen where it begins."""


def left_and_back() -> SightingMemory:
    """In the map for 5 frames, out of it for 40, back in another part of it for 2."""
    outside = [list(range(100 + 10 * k, 110 + 10 * k)) for k in range(40)]
    return remembered([[0, 1]] + 4 * [HERE] + outside + 2 * [list(range(20, 32))], given=59)


def test_landmarks_of_the_map_not_yet_seen_count_as_old() -> None:
    memory = remembered([[0, 1, 60], HERE, [61]], given=59)
    np.testing.assert_array_equal(memory.unseen_for(30, np.arange(70)), range(20, 60))
    mostly = remembered([HERE, [*HERE, *range(60, 90)]], given=59)
    assert len(mostly.unseen_for(30, np.arange(70))) == 40, "the map had the lesser say in its pose"
    tracked = remembered([HERE, [*HERE, 60]], given=59)
    assert not len(tracked.unseen_for(30, np.arange(70))), "it tracks the map already"
    nowhere = remembered([[0, 1, 60], [2, 3, 60]], given=59)
    assert not len(nowhere.unseen_for(30, np.arange(70))), "it may be anywhere in that map"
    np.testing.assert_array_equal(memory.of_given(np.array([59, 60])), [True, False])


def test_unseen_landmarks_of_the_map_count_as_seen_where_the_run_entered_it() -> None:
    memory, unseen = left_and_back(), np.arange(40, 60)
    held = _map(np.arange(600), np.zeros((600, 3)))
    assert memory.best_view_of(unseen, held) == 1, "frame 0 saw too little of the map"
    assert memory.best_view_of(np.arange(0, 22), held) == 4, (
        "most of these were seen, the last in 4"
    )
    assert memory.best_view_of(np.concatenate([unseen, np.arange(20, 28)]), held) == 1
    gone = held.without(np.arange(12))
    assert memory.best_view_of(unseen, gone) == 45, "where so much is left of what it saw"
    assert memory.best_view_of(unseen, held.without(np.arange(36))) == -1


def test_a_frame_is_placed_in_the_map_by_the_map_alone() -> None:
    memory = remembered([[*HERE, 60, 61]], given=59)
    held = _map(np.arange(1, 70), np.zeros((69, 3)))
    beside = memory.view(0, np.array([40]), held)
    np.testing.assert_array_equal(beside.ids, HERE[1:])
    again = memory.view(0, np.array([3, 60, 40]), held)
    np.testing.assert_array_equal(again.ids, [*HERE[1:], 60, 61])


def test_a_map_bounds_the_drift_as_long_as_it_is_seen() -> None:
    """Half a metre a frame: five in the map, forty outside, two in it again."""
    memory = left_and_back()
    assert memory.way_since(1) == pytest.approx(0.0, abs=1e-3)
    assert memory.way_since(4) == pytest.approx(0.0, abs=1e-3), "the map is one place"
    assert memory.way_since(25) == pytest.approx(10.0, abs=1e-3), "the shorter way round"
    out = remembered([HERE, HERE, *[[100 + k] for k in range(8)]], given=59)
    assert out.way_since(0) == pytest.approx(4.0, abs=1e-3), "since the map was left"
    other = remembered([HERE, HERE, *[[100 + k] for k in range(8)]])
    assert other.way_since(0) == pytest.approx(4.5, abs=1e-3), "without a map since that frame"


def test_duplicates_of_map_landmarks_are_those_made_since_it_was_left() -> None:
    memory = left_and_back()
    assert memory.last_seen(np.array([50])) == 4, "not in the frames of the return"
    assert memory.last_seen(np.array([50, 300])) == 4, "nor later, whatever else is seen"
    assert memory.last_seen(np.array([50, 0])) == 4
    assert memory.last_seen(np.array([300])) == 25
    brief = remembered([HERE, HERE, [100]], given=59)
    assert brief.last_seen(np.array([50])) == 0, "just left: all that this run has made"


def test_a_return_in_between_bounds_the_drift() -> None:
    """Half a metre a frame out and back; what was seen again ties the end to the beginning."""
    places = [list(range(20 * k, 20 * k + 20)) for k in range(41)]
    out = remembered(places)
    assert out.way_since(0) == pytest.approx(20.0)
    back = remembered([*places, places[0], [900]])
    assert back.way_since(0) == pytest.approx(0.5, abs=1e-3), (
        "since the return, not since the start"
    )
    assert back.way_since(20) == pytest.approx(10.5, abs=1e-3), "the shorter way round"


def closing(k: int, to: int, again: IntArray) -> Increment:
    """A frame that sees nothing but the landmarks of an earlier one, by a closure."""
    old = sight(np.eye(4), np.tile([0.0, 0.0, 3.0], (len(again), 1)), again)
    loop = LoopClosure(to, np.eye(4), np.eye(6), old, np.empty((0, 2), np.int64))
    nothing = sight(np.eye(4), np.empty((0, 3)), NOBODY)
    return dataclasses.replace(frame(k, nothing), loops=(loop,))


@pytest.mark.parametrize(("taken", "way"), [(True, 0.5), (False, 20.5)])
def test_a_closure_bounds_the_drift_only_if_the_estimator_took_it(taken: bool, way: float) -> None:
    places = [list(range(20 * k, 20 * k + 20)) for k in range(41)]
    memory, again = remembered(places), np.arange(20)
    last = closing(41, to=1, again=again)
    memory.add(last, turned(0.0, z=0.5), (taken,))
    assert memory.way_since(0) == pytest.approx(way, abs=1e-3)
    assert len(memory.unseen_for(30, again)) == (0 if taken else 20), "nor was the place seen"
    assert memory.taken == [taken]
    restored, log = SightingMemory(), MeasurementLog(RIG, {})
    for k, ids in enumerate(places):
        points = np.tile([0.0, 0.0, 3.0], (len(ids), 1))
        log.append(frame(k, sight(np.eye(4), points, np.array(ids))))
    log.append(last)
    restore(restored, state_of(memory))
    restored.frames[:] = log
    assert_same_bits(state_of(restored), state_of(memory))
    assert restored.way_since(0) == memory.way_since(0)
    np.testing.assert_array_equal(restored.unseen_for(30, again), memory.unseen_for(30, again))


def test_memory_of_a_map_restored_from_log_goes_on_the_same() -> None:
    memory, again, log = left_and_back(), SightingMemory(), MeasurementLog(RIG, {})
    held = _map(np.arange(600), np.zeros((600, 3)))
    for k in range(len(memory)):
        log.append(frame(k, memory.view(k, NOBODY, held)))
    restore(again, state_of(memory))
    again.frames[:] = log
    assert_same_bits(state_of(again), state_of(memory))
    unseen = np.arange(32, 60)
    for one in (memory, again):
        new = np.arange(600, 620)
        one.add(frame(47, sight(np.eye(4), np.tile([0.0, 0.0, 3.0], (20, 1)), new)), np.eye(4))
        np.testing.assert_array_equal(one.unseen_for(30, MAP), [*HERE, *unseen])
        assert one.best_view_of(unseen, held) == 1
        assert one.last_seen(unseen) == 4
    assert again.way_since(30) == memory.way_since(30)


@pytest.mark.parametrize("given", [-1, 8])
def test_memory_restored_from_log_goes_on_the_same(given: int) -> None:
    frames = [[0, 1, 2], [1, 2, 3], [3, 4]]
    memory = remembered(frames, given)
    log = MeasurementLog(RIG, {})
    for k in range(3):
        log.append(frame(k, memory.view(k, NOBODY, _map(np.arange(9), np.zeros((9, 3))))))
    again = SightingMemory()
    restore(again, state_of(memory))
    again.frames[:] = log
    assert_same_bits(state_of(again), state_of(memory))
    asked = np.arange(9)
    for frames_ago in range(3):
        np.testing.assert_array_equal(
            again.unseen_for(frames_ago, asked), memory.unseen_for(frames_ago, asked)
        )
    assert again.way_since(0) == memory.way_since(0)
    np.testing.assert_array_equal(again.made_after(1, asked), memory.made_after(1, asked))


def _map(ids: IntArray, positions: FloatArray) -> LandmarkMap:
    return LandmarkMap(ids, positions, np.tile(1e-4 * np.eye(3), (len(ids), 1, 1)))


# -- confirmation ----------------------------------------------------------------------------


def test_a_constant_offset_is_confirmed_after_so_many_frames() -> None:
    confirmation = Confirmation(dataclasses.replace(LOOPS, confirm=3))
    offset = turned(4.0, x=0.8)
    answers = []
    for k in range(3):
        estimated = turned(3.0 * k, z=0.3 * k)
        answers.append(confirmation.offer(offset @ estimated, estimated))
    assert answers == [False, False, True]


def test_an_offset_that_jumps_is_never_confirmed() -> None:
    confirmation = Confirmation(dataclasses.replace(LOOPS, confirm=2))
    for k in range(6):
        estimated = turned(0.0, z=0.3 * k)
        assert not confirmation.offer(turned(0.0, x=0.5 * (k % 2)) @ estimated, estimated)


def test_a_failed_confirmation_restarts_the_count() -> None:
    confirmation = Confirmation(dataclasses.replace(LOOPS, confirm=2))
    assert not confirmation.offer(np.eye(4), np.eye(4))
    confirmation.forget()
    assert not confirmation.begun
    assert not confirmation.offer(np.eye(4), np.eye(4))
    assert confirmation.offer(np.eye(4), np.eye(4))


@pytest.mark.parametrize(
    ("recognised", "way", "allowed"),
    [
        (turned(0.0, x=0.4), 0.0, True),
        (turned(0.2, x=0.02), 50.0, False),
        (turned(0.2, x=0.04), 50.0, True),
        (turned(0.4, x=0.02), 50.0, True),
        (turned(0.0, x=0.6), 0.0, False),
        (turned(0.0, x=4.0), 50.0, True),
        (turned(0.0, x=5.0), 50.0, False),
        (turned(20.0), 0.0, False),
        (turned(20.0), 50.0, True),
    ],
)
def test_drift_is_worth_a_correction_and_bounded_by_the_way(
    recognised: FloatArray, way: float, allowed: bool
) -> None:
    assert drift_allows(recognised, np.eye(4), way, LOOPS) is allowed


def test_difference_in_metres_and_degrees() -> None:
    metres, degrees = difference(turned(10.0, x=1.0), turned(25.0, x=1.0, z=2.0))
    assert metres == pytest.approx(2.0)
    assert degrees == pytest.approx(15.0)


# -- resection -------------- -----------------------------------------------------------------


@pytest.mark.parametrize("dof", [6, 5, 3])
def test_resection_finds_the_pose_among_wrong_matches(dof: int) -> None:
    rng = np.random.default_rng(5)
    points = cloud(60, rng)
    true = turned(-9.0, x=0.3, z=0.4)
    seen = sight(true, points, np.arange(60), rng)
    wrong = rng.choice(60, 24, False)
    seen.measurement[wrong] += rng.uniform(8.0, 60.0, (24, 3))
    resection = Resection(EgoMotionSolver(RIG, EgoMotionSettings(dof=dof)))
    far_away = _map(np.arange(60), points)
    found = resection.solve(PoseProblem.of(far_away, seen))
    assert found.status is EgoMotionStatus.RELOCALISED
    assert not found.inliers[wrong].any()
    assert found.inliers.sum() >= 34
    metres, degrees = difference(true, found.wTc)
    assert metres < 0.02
    assert degrees < 0.3
    again = resection.solve(PoseProblem.of(far_away, seen))
    np.testing.assert_array_equal(again.wTc, found.wTc)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_resection_of_too_few_matches_says_so(count: int) -> None:
    points = cloud(count, np.random.default_rng(0))
    seen = sight(np.eye(4), points, np.arange(count))
    resection = Resection(EgoMotionSolver(RIG, EgoMotionSettings()))
    found = resection.solve(PoseProblem.of(_map(np.arange(count), points), seen))
    assert found.status is EgoMotionStatus.TOO_FEW_MATCHES
    assert len(found.inliers) == count
    assert not found.inliers.any()


# -- closures --------------------------------------------------------------------------------


def features_of(seen: Observations) -> StereoFeatures:
    count = len(seen)
    points = g.triangulate(RIG, seen.measurement)
    return dataclasses.replace(
        StereoFeatures.empty(),
        measurement=seen.measurement,
        measurement_covariance=seen.covariance,
        pixels=seen.pixels,
        position=points,
        scale=np.full(count, 2.0),
        orientation=np.zeros(count),
        descriptors=np.zeros((count, 128), np.uint8),
    )


def test_closure_measures_the_relative_pose_whatever_the_drift() -> None:
    rng = np.random.default_rng(6)
    points, ids = cloud(50, rng), np.arange(50)
    memory = SightingMemory()
    memory.add(frame(0, sight(turned(0.0), points, ids, rng)), np.eye(4))
    for k in range(1, 4):
        nothing = sight(np.eye(4), np.empty((0, 3)), np.empty(0, np.int64))
        memory.add(frame(k, nothing), turned(0.0, z=1.0))
    true = turned(6.0, x=0.2, z=0.3)
    features = features_of(sight(true, points, ids, rng))
    partners = np.where(ids < 20, ids + 100, -1)
    found = Relocalisation(
        RelocalisationStatus.FOUND, true, np.eye(6), ids, ids, 50, 50, 0.3, 0, "for the test"
    )
    drifted = turned(30.0, x=5.0, z=-3.0)  # the map as a whole may lie anywhere on the floor
    landmarks = _map(ids, g.transform_to_world(drifted, points))
    resection = Resection(EgoMotionSolver(RIG, EgoMotionSettings(dof=3)))
    closure = close_loop(memory, landmarks, features, found, partners, resection)
    assert closure is not None
    assert closure.frame == 0
    metres, degrees = difference(true, closure.oTc)
    assert metres < 0.02
    assert degrees < 0.3
    error = g.se3_log(g.inverse(true) @ closure.oTc)
    allowed = np.sqrt(np.diagonal(closure.covariance))
    assert (np.abs(error) <= 4.0 * allowed + 1e-9).all()
    np.testing.assert_array_equal(closure.merged[:, 0], closure.merged[:, 1] + 100)
    assert set(closure.merged[:, 1]) <= set(range(20))
    assert len(closure.merged) >= 15


# -- landmarks found twice -------------------------------------------------------------------


def test_duplicates_are_near_and_look_alike() -> None:
    rng = np.random.default_rng(7)
    looks = rng.integers(0, 90, (4, 128)).astype(np.uint8)
    old = rng.uniform(-5.0, 5.0, (4, 3))
    new = old + np.array([[0.02, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.03], [0.01, 0.0, 0.0]])
    other = rng.integers(0, 255, 128).astype(np.uint8)
    descriptors = np.concatenate([looks, looks[:3], other[None]])
    ids = np.arange(8)
    appearances = LandmarkAppearances(
        ids, descriptors, np.ones(8), np.zeros(8), np.full((8, 3), np.nan)
    )
    landmarks = _map(ids, np.concatenate([old, new]))
    pairs = duplicates(landmarks, appearances, (ids[4:], ids[:4]), AppearanceSettings())
    # the second is too far away, the fourth looks different
    np.testing.assert_array_equal(pairs, [[4, 0], [6, 2]])
    none = duplicates(landmarks, appearances, (ids[:0], ids[:4]), AppearanceSettings())
    assert none.shape == (0, 2)
