"""Places recognised again."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rings import (
    LOOPS,
    ROUND,
    SETTINGS,
    RingMotion,
    assert_same_increments,
    closings,
    drive,
    error_m,
    on_ring,
    pipeline_of,
    seen,
)
from simulated import RIG, assert_same_bits

from fgslam.backend import loops
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray, StateArrays
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
from fgslam.frontend.places.known_map import Tentative
from fgslam.frontend.places.recognition import (
    Confirmation,
    LoopGates,
    LostRules,
    PlaceRecognition,
    SightingMemory,
    close_loop,
    difference,
    drift_allows,
    duplicates,
)
from fgslam.frontend.places.relocalisation import (
    ENOUGH_INLIERS,
    MAX_MISFIT,
    Refined,
    accept,
)
from fgslam.frontend.settings import AppearanceSettings, EgoMotionSettings, RelocalisationSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem, Resection
from fgslam.slam.build import make_estimator
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import ConstantVelocityMotion
from fgslam.slam.pipeline import FrameReport, SlamPipeline, observe
from fgslam.slam.replay import replay_frame

# ------------------------------------------------------------------------------------------
# The whole loop on ideal features: drifting round a ring and back, carried off, in the dark


# -- the return ------------------------------------------------------------------------------

RING = [on_ring(k) for k in range(ROUND + 16)]
DARK = range(30, 42)  # in the dark the heading drifts by what no search window bridges


def round_the_ring(path: list[FloatArray] = RING) -> SlamPipeline:
    return pipeline_of(path, 0.9, lost=None)


def refuse_closures(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(loops, "GATE_SIGMAS", 1e-6)


@dataclasses.dataclass(frozen=True)
class State:
    """What a drive goes on from."""

    database: StateArrays
    parts: StateArrays
    estimator: StateArrays
    places: StateArrays
    taken: tuple[bool, ...]


def states_of(pipeline: SlamPipeline) -> State:
    assert pipeline.places is not None
    tracker = pipeline.tracker
    held = (tracker.database, tracker.parts, pipeline.estimator, pipeline.places)
    return State(*(state_of(one) for one in held), taken=pipeline.places.taken)


@cache
def frames_of_ring() -> list[FeatureFrame]:
    return list(seen(RING, DARK))


@cache
def ring_and_states(refusing: bool) -> tuple[SlamPipeline, list[FrameReport], list[State]]:
    """Once round and past the start, a part of it in the dark; the state before each frame.

    A drive whose closures are refused is the other one up to the first of them.
    """
    pipeline, reports, states = round_the_ring(), list[FrameReport](), list[State]()
    with pytest.MonkeyPatch.context() as patch:
        if refusing:
            _, reports, states = ring_and_states(False)
            first = closings(reports)[0]
            pipeline, reports, states = gone_on(False, first), reports[:first], states[:first]
            refuse_closures(patch)
        for frame in frames_of_ring()[len(reports) :]:
            states.append(states_of(pipeline))
            reports += drive(pipeline, [frame])
    return pipeline, reports, states


def ring(refusing: bool = False) -> tuple[SlamPipeline, list[FrameReport]]:
    pipeline, reports, _ = ring_and_states(refusing)
    return pipeline, reports


def gone_on(refusing: bool, stop: int, path: list[FloatArray] = RING) -> SlamPipeline:
    """The drive as it was before a frame, restored; it may go on along a longer path."""
    _, reports, states = ring_and_states(refusing)
    log = MeasurementLog(RIG, {})
    for report in reports[:stop]:
        log.append(report.increment)
    again, state = round_the_ring(path), states[stop]
    assert again.places is not None
    restore(again.tracker.database, state.database)
    restore(again.tracker.parts, state.parts)
    restore(again.estimator, state.estimator)
    restore(again.places, state.places)
    again.places.memory.frames[:] = log
    return again


def test_return_is_recognised_and_the_drift_corrected() -> None:
    _, reports = ring()
    closed = closings(reports)
    assert closed
    first = closed[0]
    assert first >= ROUND - 16
    assert error_m(reports[first - 1], RING[first - 1]) > 0.5
    assert error_m(reports[first], RING[first]) < 0.15
    assert max(error_m(reports[k], RING[k]) for k in range(first, len(RING))) < 0.15
    for k in closed:
        for loop in reports[k].increment.loops:
            metres, degrees = difference(g.inverse(RING[loop.frame]) @ RING[k], loop.oTc)
            assert metres < 0.1
            assert degrees < 1.0


@pytest.mark.slow
def test_frame_with_two_hypotheses_is_placed_by_recent_landmarks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Back near the start, 0.24 m off: old landmarks and new ones, found in the same frames."""
    late = dataclasses.replace(LOOPS, confirm=18)  # long after old landmarks are found
    once = dataclasses.replace(SETTINGS.matching, refine=False)  # a second matching helps as well
    settings = dataclasses.replace(SETTINGS, matching=once)

    def driven() -> tuple[list[int], list[int]]:
        reports = drive(pipeline_of(RING, 0.2, settings, loops=late, lost=None), seen(RING, DARK))
        apart = [k for k, report in enumerate(reports) if not report.tracking.coherent]
        return apart, closings(reports)

    apart, closed = driven()
    assert apart == []
    assert closed
    monkeypatch.setattr(PlaceRecognition, "placed_by_recent", lambda self, tracked, *_: tracked)
    apart, closed = driven()
    assert len(apart) > 5
    assert not closed  # nor do such frames agree on where the place lies


def test_landmarks_found_twice_become_one() -> None:
    pipeline, reports = ring()
    first = closings(reports)[0]
    closing, after = reports[first].increment, reports[first + 1].increment
    merged, ended = closing.loops[0].merged, after.pruned_ids
    assert reports[first].stats.closed == (True,)
    assert len(merged) >= 5
    assert np.isin(merged[:, 0], closing.observations.ids).all()
    assert not np.isin(merged[:, 0], closing.pruned_ids).any(), "not before it is taken"
    assert np.isin(merged[:, 0], ended).all()
    assert len(ended) > len(merged), "and those that look alike in the corrected map"
    assert not np.isin(after.observations.ids, ended).any(), "it is tracked on the map as fused"
    assert reports[first + 1].tracking.status is EgoMotionStatus.OK
    held = pipeline.estimator.landmarks().ids
    assert not np.isin(ended, held).any()
    assert np.isin(held, pipeline.tracker.database.ids).all()
    later = [r.increment.observations for r in reports[first + 1 : first + 6]]
    old = [
        int((~o.is_new & (o.ids < reports[20].increment.observations.ids.max())).sum())
        for o in later
    ]
    assert min(old) >= 5, "the old landmarks are tracked again"


def test_a_map_saved_right_after_a_closure_has_each_landmark_once() -> None:
    """The next frame would make them one; who saves the map now leaves out those that end."""
    first = closings(ring()[1])[0]
    pipeline, frames = gone_on(False, first), frames_of_ring()
    drive(pipeline, [frames[first]])
    assert pipeline.places is not None
    ending, held = pipeline.places.ending, pipeline.estimator.landmarks().ids
    assert len(ending) > 5
    assert np.isin(ending, held).all()
    (after,) = drive(pipeline, [frames[first + 1]])
    assert np.isin(ending, after.increment.pruned_ids).all()
    assert not len(pipeline.places.ending)


def test_a_refused_closure_changes_nothing_but_that_a_rest_follows() -> None:
    pipeline, reports = ring(refusing=True)
    offered = closings(reports)
    assert offered[0] == closings(ring()[1])[0]
    assert all(reports[k].stats.closed == (False,) for k in offered)
    assert pipeline.places.taken == (False,) * len(offered)
    rest = LOOPS.rest
    assert (np.diff(offered) > rest).all()
    without = pipeline_of(RING, 0.9, loops=None, lost=None)
    for report, expected in zip(reports, drive(without, frames_of_ring()), strict=True):
        np.testing.assert_array_equal(report.stats.wTc, expected.stats.wTc)
        assert_same_bits(report.increment.observations, expected.increment.observations)
        np.testing.assert_array_equal(report.increment.pruned_ids, expected.increment.pruned_ids)
    assert_same_bits(state_of(pipeline.tracker.database), state_of(without.tracker.database))


def test_a_refused_closure_is_offered_again_after_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """The place was not seen, as far as the map is concerned; so it can be recognised again."""
    first = closings(ring(refusing=True)[1])[0]
    longer = [on_ring(k) for k in range(ROUND + 16 + LOOPS.rest)]
    again = gone_on(True, first, longer)
    refuse_closures(monkeypatch)
    offered = closings(drive(again, list(seen(longer, DARK))[first:]))
    assert offered[0] == 0
    assert len(offered) >= 2


def test_only_a_closure_that_was_taken_bounds_later_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    way = {}
    for refusing in (False, True):
        first = closings(ring()[1])[0]
        pipeline = gone_on(refusing, first)
        if refusing:
            refuse_closures(monkeypatch)
        (report,) = drive(pipeline, [frames_of_ring()[first]])
        loop = report.increment.loops[0]
        way[refusing] = pipeline.places.memory.way_since(loop.frame)
    assert way[False] < 0.01
    assert way[True] > 10.0


def test_each_estimator_of_a_comparison_accepts_or_refuses_a_closure_itself() -> None:
    """What the live one refused another one takes; its map keeps both landmarks."""
    _, reports = ring(refusing=True)
    estimator = make_estimator(RIG, LandmarkKalmanSettings(), SETTINGS.ego_motion)
    solver, motion = EgoMotionSolver(RIG, SETTINGS.ego_motion), RingMotion(RING, 0.9)
    first = closings(reports)[0]
    for k, report in enumerate(reports):
        stats = replay_frame(report.increment, estimator, solver, motion, k).stats
        if k >= first:
            assert difference(RING[k], stats.wTc)[0] < 0.15
        assert stats.closed == (() if not report.increment.loops else (True,))
    merged = reports[first].increment.loops[0].merged
    held = estimator.landmarks()
    both = np.isin(merged, held.ids).all(axis=1)
    assert both.sum() >= 5
    new, old = (held.positions[held.rows(ids)] for ids in merged[both].T)
    assert np.median(np.linalg.norm(new - old, axis=1)) < 0.1


@pytest.mark.parametrize(("refusing", "after_closing"), [(False, 1), (True, 4)])
def test_continued_from_its_state_it_goes_on_to_the_bit(
    refusing: bool, after_closing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, reports, states = ring_and_states(refusing)
    if refusing:
        refuse_closures(monkeypatch)
    stop = closings(reports)[0] + after_closing
    state, frames = states[stop], frames_of_ring()
    again = gone_on(refusing, stop)
    assert_same_bits(state_of(again.places), state.places)
    assert again.places.taken == state.taken
    for report, expected in zip(drive(again, frames[stop:]), reports[stop:], strict=True):
        np.testing.assert_array_equal(report.stats.wTc, expected.stats.wTc)
        assert_same_increments(report.increment, expected.increment)


# -- lost ------------------------------------------------------------------------------------


def carried() -> list[FloatArray]:
    """Half round, then lifted back to where the drive was after ten frames."""
    return [on_ring(k) for k in range(40)] + [on_ring(k) for k in range(10, 25)]


@cache
def found_again() -> list[FrameReport]:
    poses = carried()
    return drive(pipeline_of(poses, 0.1), seen(poses))


def test_kidnapped_robot_is_relocalised_in_its_own_map() -> None:
    poses, reports = carried(), found_again()
    found = [k for k, r in enumerate(reports) if r.increment.relocalised]
    assert found
    assert 40 <= found[0] <= 44
    assert reports[found[0]].tracking.status is EgoMotionStatus.RELOCALISED
    assert error_m(reports[-1], poses[-1]) < 0.1
    lost = reports[41 : found[0]]
    assert sum(int(r.increment.observations.is_new.sum()) for r in lost) == 0, "not while lost"


def test_a_relocalised_frame_is_replayed_to_the_bit() -> None:
    poses, reports = carried(), found_again()
    estimator = make_estimator(RIG, LandmarkKalmanSettings(), SETTINGS.ego_motion)
    solver, motion = EgoMotionSolver(RIG, SETTINGS.ego_motion), RingMotion(poses, 0.1)
    for k, report in enumerate(reports):
        stats = replay_frame(report.increment, estimator, solver, motion, k).stats
        np.testing.assert_array_equal(stats.wTc, report.stats.wTc)


def test_robot_lost_in_unmapped_surroundings_gives_up_and_maps_on() -> None:
    poses = [on_ring(k) for k in range(12)] + [on_ring(k) for k in range(36, 64)]
    lost = LostRules(after=2, give_up_after=6)
    reports = drive(pipeline_of(poses, 0.1, loops=None, lost=lost), seen(poses))
    new = [int(r.increment.observations.is_new.sum()) for r in reports]
    assert sum(new[14:17]) == 0
    assert sum(new[17:]) > 50
    assert reports[-1].tracking.status is EgoMotionStatus.OK


def test_a_run_that_begins_in_the_dark_maps_as_soon_as_there_is_light() -> None:
    """Without a landmark there is nothing to be lost in, and nothing to wait for."""
    poses = RING[:6]
    reports = drive(pipeline_of(poses, 0.1), seen(poses, range(2)))
    new = [int(r.increment.observations.is_new.sum()) for r in reports]
    assert new[:2] == [0, 0]
    assert new[2] > 50
    assert all(r.tracking.status is EgoMotionStatus.OK for r in reports[3:])


def test_a_correction_is_no_motion() -> None:
    """Nor is being found elsewhere: without wheels, the next frames are expected where they are."""
    for reports in (found_again(), ring()[1]):
        steady = ConstantVelocityMotion()
        jumps = []
        for k, report in enumerate(reports):
            expected = steady.between(float(k))
            observe(steady, report.increment, report.tracking, report.stats)
            after = steady.between(k + 1.0)
            if report.increment.loops or report.increment.relocalised:
                assert expected is not None
                jumps.append(float(np.linalg.norm(after.motion[:3, 3])))
        assert jumps
        assert max(jumps) < 0.5, "a frame's step is a quarter of a metre"


# ------------------------------------------------------------------------------------------
# Returns: who saw what, when a place is believed, the closure, and landmarks found twice


RETURN_LOOPS = LoopGates()
DOWN = np.array([0.0, 1.0, 0.0])
NO_IDS = np.empty(0, np.int64)
NOISE = 0.2**2 * np.eye(3)


def turned(yaw_deg: float, x: float = 0.0, z: float = 0.0) -> FloatArray:
    """A camera on the floor: yaw about the vertical, moved by x and z."""
    return g.pose(g.so3_exp(np.deg2rad(yaw_deg) * DOWN), np.array([x, 0.0, z]))


def seen_from(
    wTc: FloatArray, points: FloatArray, ids: IntArray, rng: np.random.Generator | None = None
) -> Observations:
    """What a camera measures of points; with a fifth of a pixel of noise where ``rng`` is given."""
    measured = RIG.predict(g.transform_to_camera(wTc, points))
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
        memory.add(frame(k, seen_from(np.eye(4), points, known)), forward)
    return memory


def test_memory_holds_what_was_not_seen_for_long_and_where_it_was_seen_best() -> None:
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
    located = memory.view(0, np.array([40]), held)
    np.testing.assert_array_equal(located.ids, HERE[1:])
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
    old = seen_from(np.eye(4), np.tile([0.0, 0.0, 3.0], (len(again), 1)), again)
    loop = LoopClosure(to, np.eye(4), np.eye(6), old, np.empty((0, 2), np.int64))
    nothing = seen_from(np.eye(4), np.empty((0, 3)), NO_IDS)
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
        log.append(frame(k, seen_from(np.eye(4), points, np.array(ids))))
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
        log.append(frame(k, memory.view(k, NO_IDS, held)))
    restore(again, state_of(memory))
    again.frames[:] = log
    assert_same_bits(state_of(again), state_of(memory))
    unseen = np.arange(32, 60)
    for one in (memory, again):
        new = np.arange(600, 620)
        one.add(frame(47, seen_from(np.eye(4), np.tile([0.0, 0.0, 3.0], (20, 1)), new)), np.eye(4))
        np.testing.assert_array_equal(one.unseen_for(30, MAP), [*HERE, *unseen])
        assert one.best_view_of(unseen, held) == 1
        assert one.last_seen(unseen) == 4
    assert again.way_since(30) == memory.way_since(30)


def _map(ids: IntArray, positions: FloatArray) -> LandmarkMap:
    return LandmarkMap(ids, positions, np.tile(1e-4 * np.eye(3), (len(ids), 1, 1)))


# -- confirmation ----------------------------------------------------------------------------


def test_a_constant_offset_is_confirmed_after_so_many_frames() -> None:
    confirmation = Confirmation(dataclasses.replace(RETURN_LOOPS, confirm=3))
    offset = turned(4.0, x=0.8)
    answers = []
    for k in range(3):
        estimated = turned(3.0 * k, z=0.3 * k)
        answers.append(confirmation.offer(offset @ estimated, estimated))
    assert answers == [False, False, True]


def test_an_offset_that_jumps_is_never_confirmed() -> None:
    confirmation = Confirmation(dataclasses.replace(RETURN_LOOPS, confirm=2))
    for k in range(6):
        estimated = turned(0.0, z=0.3 * k)
        assert not confirmation.offer(turned(0.0, x=0.5 * (k % 2)) @ estimated, estimated)


def test_a_failed_confirmation_restarts_the_count() -> None:
    confirmation = Confirmation(dataclasses.replace(RETURN_LOOPS, confirm=2))
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
    assert drift_allows(recognised, np.eye(4), way, RETURN_LOOPS) is allowed


# -- resection -------------- -----------------------------------------------------------------


@pytest.mark.parametrize("dof", [6, 5, 3])
def test_resection_finds_the_pose_among_wrong_matches(dof: int) -> None:
    rng = np.random.default_rng(5)
    points = cloud(60, rng)
    true = turned(-9.0, x=0.3, z=0.4)
    seen = seen_from(true, points, np.arange(60), rng)
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
def test_resection_of_too_few_matches_is_refused(count: int) -> None:
    points = cloud(count, np.random.default_rng(0))
    seen = seen_from(np.eye(4), points, np.arange(count))
    resection = Resection(EgoMotionSolver(RIG, EgoMotionSettings()))
    found = resection.solve(PoseProblem.of(_map(np.arange(count), points), seen))
    assert found.status is EgoMotionStatus.TOO_FEW_MATCHES
    assert len(found.inliers) == count
    assert not found.inliers.any()


# -- closures --------------------------------------------------------------------------------


def features_of(seen: Observations) -> StereoFeatures:
    count = len(seen)
    points = RIG.triangulate(seen.measurement)
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
    memory.add(frame(0, seen_from(turned(0.0), points, ids, rng)), np.eye(4))
    for k in range(1, 4):
        nothing = seen_from(np.eye(4), np.empty((0, 3)), np.empty(0, np.int64))
        memory.add(frame(k, nothing), turned(0.0, z=1.0))
    true = turned(6.0, x=0.2, z=0.3)
    features = features_of(seen_from(true, points, ids, rng))
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
    signatures = rng.integers(0, 90, (4, 128)).astype(np.uint8)
    old = rng.uniform(-5.0, 5.0, (4, 3))
    new = old + np.array([[0.02, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.03], [0.01, 0.0, 0.0]])
    other = rng.integers(0, 255, 128).astype(np.uint8)
    descriptors = np.concatenate([signatures, signatures[:3], other[None]])
    ids = np.arange(8)
    appearances = LandmarkAppearances(
        ids, descriptors, np.ones(8), np.zeros(8), np.full((8, 3), np.nan)
    )
    landmarks = _map(ids, np.concatenate([old, new]))
    pairs = duplicates(landmarks, appearances, (ids[4:], ids[:4]), AppearanceSettings())
    # the second is too far away, the fourth appears different
    np.testing.assert_array_equal(pairs, [[4, 0], [6, 2]])
    none = duplicates(landmarks, appearances, (ids[:0], ids[:4]), AppearanceSettings())
    assert none.shape == (0, 2)


# ------------------------------------------------------------------------------------------
# Acceptance of a pose found without a prior: its inliers, and competing hypotheses


ACCEPTANCE = RelocalisationSettings()
# A metre apart: each is an independent inlier. The first hundred stand at one place, and so on.
PLACES = LandmarkMap(
    np.arange(300),
    np.arange(300)[:, None] * [1.0, 0.0, 0.0],
    np.tile(1e-6 * np.eye(3), (300, 1, 1)),
)


def _tentative(matched: int) -> Tentative:
    every = np.arange(matched)
    return Tentative(every, every, np.zeros(matched), np.ones(matched, np.int64))


def _pose(features: IntArray, place: int = 0, covered: float = 1.0, misfit: float = 0.6) -> Refined:
    """A pose that explains some features by landmarks of its own place."""
    return Refined(
        wTc=np.eye(4),
        covariance=1e-6 * np.eye(6),
        features=features,
        landmarks=features + 100 * place,
        residual_px=0.5,
        misfit=misfit,
        proposed=len(features),
        expected=np.arange(50),
        independent=len(features),
        covered=covered,
        explained=1.0,
    )


def _status(matched: int, *poses: Refined) -> RelocalisationStatus:
    return accept(_tentative(matched), list(poses), PLACES, ACCEPTANCE).status


def test_few_inliers_among_many_outliers_are_refused() -> None:
    """Twenty of a hundred fit anywhere in a building whose walls are alike."""
    assert _status(100, _pose(np.arange(20))) is RelocalisationStatus.CONTRADICTED
    assert _status(100, _pose(np.arange(ENOUGH_INLIERS))) is RelocalisationStatus.FOUND


@pytest.mark.parametrize(
    ("agreeing", "covered", "status"),
    [
        # What should be seen is hidden, yet all that is seen agrees.
        (28, 0.0, RelocalisationStatus.FOUND),
        (22, 0.0, RelocalisationStatus.CONTRADICTED),
        (22, 0.5, RelocalisationStatus.FOUND),
        (12, 1.0, RelocalisationStatus.FOUND),
        (12, 0.5, RelocalisationStatus.CONTRADICTED),
    ],
)
def test_inlier_ratio_and_landmarks_seen_are_weighed_together(
    agreeing: int, covered: float, status: RelocalisationStatus
) -> None:
    assert _status(30, _pose(np.arange(agreeing), covered=covered)) is status


def test_few_inliers_with_a_large_residual_are_refused() -> None:
    badly = _pose(np.arange(20), misfit=MAX_MISFIT + 0.1)
    assert _status(20, badly) is RelocalisationStatus.CONTRADICTED
    assert _status(20, replace(badly, misfit=MAX_MISFIT)) is RelocalisationStatus.FOUND


@pytest.mark.parametrize("missing", [0, 10])
def test_an_aliased_place_with_missing_landmarks_still_makes_it_ambiguous(missing: int) -> None:
    """Which of two alike places the map knows better does not say where the robot is."""
    best, other = _pose(np.arange(20)), _pose(np.arange(missing, 20), place=1)
    assert _status(24, best, other) is RelocalisationStatus.AMBIGUOUS


def test_a_place_that_explains_less_than_half_does_not_compete() -> None:
    """Were it the right one, what stands next to the objects that both have would be explained."""
    best = _pose(np.arange(24))
    assert _status(30, best, _pose(np.arange(12, 24), place=1)) is RelocalisationStatus.AMBIGUOUS
    best = _pose(np.arange(25))
    assert _status(30, best, _pose(np.arange(13, 25), place=1)) is RelocalisationStatus.FOUND
    # Three features of its own, against thirteen that only the best explains.
    assert _status(30, best, _pose(np.arange(13, 28), place=1)) is RelocalisationStatus.AMBIGUOUS


def test_an_object_carried_off_is_refused() -> None:
    """All that resembles a landmark agrees; but it hung on a wall that is not there."""
    carried = replace(_pose(np.arange(20), covered=0.3), explained=0.3)
    assert _status(21, carried) is RelocalisationStatus.CONTRADICTED
    assert _status(21, replace(carried, explained=0.6)) is RelocalisationStatus.FOUND
    assert _status(21, replace(carried, covered=0.6)) is RelocalisationStatus.FOUND


def test_hypotheses_that_share_their_inliers_do_not_compete() -> None:
    """Two poses by the same landmarks are one, known badly; the covariance shows how."""
    assert _status(24, _pose(np.arange(20)), _pose(np.arange(2, 20))) is RelocalisationStatus.FOUND


@pytest.mark.parametrize("change", [{"covered": 0.4}, {"misfit": 1.5}])
def test_a_hypothesis_that_fits_badly_does_not_compete(change: dict[str, float]) -> None:
    other = _pose(np.arange(2, 22), place=1)
    assert _status(24, _pose(np.arange(20)), other) is RelocalisationStatus.AMBIGUOUS
    refuted = replace(other, **change)  # type: ignore[arg-type]
    assert _status(24, _pose(np.arange(20)), refuted) is RelocalisationStatus.FOUND
