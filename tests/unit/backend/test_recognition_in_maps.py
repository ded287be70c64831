"""A run in a map of half a ring leaves it, drifts, and comes back to a part it has yet to see."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
from rings import (
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

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import (
    EstimatorSettings,
    Isam2Settings,
    LandmarkKalmanSettings,
)
from fgslam.core import geometry as g
from fgslam.core.arrays import StateArrays
from fgslam.core.log import MeasurementLog
from fgslam.core.saved_map import SavedMap
from fgslam.core.store import restore, state_of
from fgslam.core.types import EgoMotionStatus, Prediction
from fgslam.frontend.places.recognition import difference
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.slam.build import Arrival, make_estimator, take_over
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.replay import replay_frame

MAPPED = ROUND // 2  # frames of the drive that makes the map
BEGIN = 22  # of it, where the second drive begins
PATH = [on_ring(k) for k in range(BEGIN, ROUND + 14)]
DARK = range(26, 38)  # outside the map


@cache
def half_a_ring() -> SavedMap:
    """The map of the first half, by the paper's filter."""
    poses = [on_ring(k) for k in range(MAPPED)]
    pipeline = pipeline_of(poses, 0.1, lost=None)
    drive(pipeline, seen(poses))
    database, estimate = pipeline.tracker.database, pipeline.estimator.estimate()
    rows = database.rows(estimate.landmarks.ids)
    return SavedMap(
        rig=RIG,
        landmarks=estimate.landmarks,
        appearances=database.appearances(estimate.landmarks.ids),
        hits=database.hits[rows],
        misses=database.misses[rows],
        farthest=database.farthest[rows],
        permanent=database.lasting[rows],
        colour=database.colour[rows],
        trajectory=estimate.trajectory,
        about={},
        evidence=np.empty(0, np.int64),
    )


def arrival(extends: bool) -> Arrival:
    prior = Prediction(PATH[0], np.diag(np.repeat([0.02, 0.05], 3) ** 2))
    return Arrival(half_a_ring(), prior, relocalised=True, extends=extends)


def drift_deg(extends: bool) -> float:
    """A frame: who maps on drifts in the dark alone, the other one as long as it is outside."""
    return 0.9 if extends else 0.5


def in_map(extends: bool) -> SlamPipeline:
    return pipeline_of(PATH, drift_deg(extends), arrival=arrival(extends), lost=None)


States = tuple[StateArrays, ...]


def held_by(pipeline: SlamPipeline) -> tuple[Any, ...]:
    """All that a drive goes on from; places last, which are restored with the log."""
    tracker = pipeline.tracker
    return (tracker.database, tracker.parts, pipeline.estimator, pipeline.places)


@cache
def returned_with_states(extends: bool, /) -> tuple[SlamPipeline, list[FrameReport], list[States]]:
    """The whole drive; the state before each frame."""
    pipeline, reports, states = in_map(extends), list[FrameReport](), list[States]()
    for frame in seen(PATH, DARK):
        states.append(tuple(state_of(one) for one in held_by(pipeline)))
        reports += drive(pipeline, [frame])
    return pipeline, reports, states


def returned(extends: bool) -> tuple[SlamPipeline, list[FrameReport]]:
    pipeline, reports, _ = returned_with_states(extends)
    return pipeline, reports


def landmarks_of_map(estimator: Estimator) -> np.ndarray:
    """Positions now of the map's landmarks, NaN where one has left."""
    given, held = half_a_ring().landmarks.ids, estimator.landmarks()
    out = np.full((len(given), 3), np.nan)
    kept = np.isin(given, held.ids)
    out[kept] = held.positions[held.rows(given[kept])]
    return out


@pytest.mark.parametrize("extends", [True, False])
def test_the_return_to_another_part_of_the_map_is_a_loop(extends: bool) -> None:
    _, reports = returned(extends)
    closed = closings(reports)
    assert closed
    first = closed[0]
    assert BEGIN + first >= ROUND - 16, "the map's beginning is in view"
    assert error_m(reports[first - 1], PATH[first - 1]) > 0.3
    assert max(error_m(reports[k], PATH[k]) for k in range(first, len(PATH))) < 0.15
    for k in closed:
        assert reports[k].stats.closed == (True,)
        for loop in reports[k].increment.loops:
            metres, degrees = difference(g.inverse(PATH[loop.frame]) @ PATH[k], loop.oTc)
            assert metres < 0.1
            assert degrees < 1.0
    loop = reports[first].increment.loops[0]
    assert loop.frame == 0, "where the run entered the map"
    before = np.concatenate([r.increment.observations.ids for r in reports[:first]])
    assert not np.isin(loop.observations.ids, before).any(), "never seen in this run"
    assert reports[first + 1].tracking.status is EgoMotionStatus.OK


def test_where_it_is_not_lost_no_loop_is_closed() -> None:
    """On the map, its landmarks tell; off it, nothing old is seen."""
    path = [on_ring(k) for k in range(6, MAPPED + 8)]
    prior = Prediction(path[0], arrival(True).prior.covariance)
    start = dataclasses.replace(arrival(True), prior=prior)
    pipeline = pipeline_of(path, 0.1, arrival=start, lost=None)
    reports = drive(pipeline, seen(path))
    assert not closings(reports)
    assert error_m(reports[-1], path[-1]) < 0.1


def test_landmarks_made_since_the_map_was_left_end_as_duplicates() -> None:
    pipeline, reports = returned(True)
    first = closings(reports)[0]
    given = int(half_a_ring().landmarks.ids.max())
    ended = reports[first + 1].increment.pruned_ids
    merged = reports[first].increment.loops[0].merged
    assert len(merged) >= 5
    assert (merged[:, 0] > given).all(), "none of the map's own"
    assert np.isin(merged[:, 0], ended).all()
    assert len(ended) > len(merged), "and those that look alike in the corrected map"
    after = reports[first + 1].increment.observations
    assert (~after.is_new & (after.ids <= given)).sum() >= 10, "the map is tracked again"
    assert not np.isin(ended, pipeline.tracker.database.ids).any()


def test_a_map_that_is_left_as_it_is_stays_so_to_the_bit() -> None:
    pipeline, _ = returned(False)
    given = half_a_ring()
    assert_same_bits(pipeline.estimator.landmarks(), given.landmarks)
    np.testing.assert_array_equal(pipeline.tracker.database.ids, given.landmarks.ids)
    np.testing.assert_array_equal(
        pipeline.tracker.database.appearances().descriptors, given.appearances.descriptors
    )


@pytest.mark.parametrize(("extends", "after_closing"), [(True, 1), (False, -12)])
def test_continued_from_its_state_it_goes_on_to_the_bit(extends: bool, after_closing: int) -> None:
    _, reports, states = returned_with_states(extends)
    stop = closings(reports)[0] + after_closing
    again, frames = in_map(extends), list(seen(PATH, DARK))
    log = MeasurementLog(RIG, {})
    for report in reports[:stop]:
        log.append(report.increment)
    *others, places = states[stop]
    for one, state in zip(held_by(again), others, strict=False):
        restore(one, state)
    restore(again.places, places)
    again.places.memory.frames[:] = log
    assert_same_bits(state_of(again.places), places)
    for report, expected in zip(drive(again, frames[stop:]), reports[stop:], strict=True):
        np.testing.assert_array_equal(report.stats.wTc, expected.stats.wTc)
        assert_same_increments(report.increment, expected.increment)


ESTIMATORS: list[tuple[EstimatorSettings, bool]] = [
    (LandmarkKalmanSettings(), True),
    (LandmarkKalmanSettings(), False),
    (Isam2Settings(), True),
]


@pytest.mark.parametrize(
    ("settings", "extends"), ESTIMATORS, ids=[f"{s.kind}-{e}" for s, e in ESTIMATORS]
)
def test_every_estimator_returns_to_the_map(settings: EstimatorSettings, extends: bool) -> None:
    """The closure takes it to its place in the map, whose landmarks stay where they are."""
    _, reports = returned(extends)
    estimator = make_estimator(RIG, settings, SETTINGS.ego_motion, arrival(extends).prior)
    take_over(estimator, arrival(extends))
    solver, motion = EgoMotionSolver(RIG, SETTINGS.ego_motion), RingMotion(PATH, drift_deg(extends))
    first = closings(reports)[0]
    for k, report in enumerate(reports[: first + 3]):
        stats = replay_frame(report.increment, estimator, solver, motion, k).stats
        if report.increment.loops:
            assert stats.closed == (True,)
        if k >= first:
            assert difference(PATH[k], stats.wTc)[0] < 0.15
    moved = np.linalg.norm(landmarks_of_map(estimator) - half_a_ring().landmarks.positions, axis=1)
    if extends:
        assert np.nanmedian(moved) < 0.03
        assert np.isfinite(moved).sum() > 0.5 * len(moved)
    else:
        np.testing.assert_array_equal(moved, 0.0)
