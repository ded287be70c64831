"""The whole loop on ideal features: drifting round a ring and back, carried off, in the dark."""

from __future__ import annotations

import dataclasses
from functools import cache, lru_cache

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
from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.log import MeasurementLog
from fgslam.core.store import restore, state_of
from fgslam.core.types import EgoMotionStatus
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.frontend.features.matching import AppearanceIndex
from fgslam.frontend.places import known_map
from fgslam.frontend.places.recognition import LostRules, PlaceRecognition, difference
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.slam.build import make_estimator
from fgslam.slam.motion import ConstantVelocityMotion
from fgslam.slam.pipeline import FrameReport, SlamPipeline, observe
from fgslam.slam.replay import replay_frame

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


@lru_cache(maxsize=2)
def ring_and_states(refusing: bool) -> tuple[SlamPipeline, list[FrameReport], list[State]]:
    """Once round and past the start, a stretch of it in the dark; the state before each frame."""
    pipeline, reports, states = round_the_ring(), list[FrameReport](), list[State]()
    with pytest.MonkeyPatch.context() as patch:
        if refusing:
            refuse_closures(patch)
        for frame in seen(RING, DARK):
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


def test_no_closure_is_false() -> None:
    _, reports = ring()
    for k in closings(reports):
        for loop in reports[k].increment.loops:
            metres, degrees = difference(g.inverse(RING[loop.frame]) @ RING[k], loop.oTc)
            assert metres < 0.1
            assert degrees < 1.0


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
    pipeline, frames = gone_on(False, first), list(seen(RING, DARK))
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
    for report, expected in zip(reports, drive(without, seen(RING, DARK)), strict=True):
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
        (report,) = drive(pipeline, [list(seen(RING, DARK))[first]])
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


@pytest.mark.parametrize("refusing", [False, True])
def test_a_replay_closes_the_same_loops_to_the_bit(
    refusing: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline, reports = ring(refusing)
    if refusing:
        refuse_closures(monkeypatch)
    estimator = make_estimator(RIG, LandmarkKalmanSettings(), SETTINGS.ego_motion)
    solver = EgoMotionSolver(RIG, SETTINGS.ego_motion)
    motion = RingMotion(RING, 0.9)
    for k, report in enumerate(reports):
        replay_frame(report.increment, estimator, solver, motion, k)
    np.testing.assert_array_equal(
        estimator.estimate().trajectory.poses, pipeline.estimator.estimate().trajectory.poses
    )
    np.testing.assert_array_equal(
        estimator.landmarks().positions, pipeline.estimator.landmarks().positions
    )


@pytest.mark.parametrize(
    ("refusing", "after_closing"), [(False, -20), (False, 1), (False, 2), (True, 1), (True, 4)]
)
def test_continued_from_its_state_it_goes_on_to_the_bit(
    refusing: bool, after_closing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, reports, states = ring_and_states(refusing)
    if refusing:
        refuse_closures(monkeypatch)
    stop = closings(reports)[0] + after_closing
    state, frames = states[stop], list(seen(RING, DARK))
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


def test_who_is_lost_indexes_the_same_looks_once_with_the_same_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Frames in unmapped surroundings: each looks at the whole map, and none changes its looks."""
    poses = [on_ring(k) for k in range(12)] + [on_ring(k) for k in range(36, 46)]
    lost = LostRules(after=1, give_up_after=20)
    made = []
    monkeypatch.setattr(
        known_map, "AppearanceIndex", lambda *held: (made.append(1), AppearanceIndex(*held))[1]
    )
    once = drive(pipeline_of(poses, 0.1, loops=None, lost=lost), seen(poses))
    first = len(made)
    monkeypatch.setattr(LandmarkDatabase, "changes", property(lambda self: len(made)))
    every = drive(pipeline_of(poses, 0.1, loops=None, lost=lost), seen(poses))
    assert first < len(made) - first == len(poses) - 12 + 1
    for one, other in zip(once, every, strict=True):
        assert_same_increments(one.increment, other.increment)
        assert_same_bits(one.tracking, other.tracking)


def test_kidnapped_robot_stays_lost_without_relocalisation() -> None:
    poses = carried()
    reports = drive(pipeline_of(poses, 0.1, loops=None, lost=None), seen(poses))
    assert error_m(reports[-1], poses[-1]) > 1.0


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
        steady = ConstantVelocityMotion(ConstantVelocitySettings())
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
