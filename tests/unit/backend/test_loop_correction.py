"""What a filter keeps of its drive: which steps were measured, and what ties a frame to a place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgslam.backend.loops import DriveRecord
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import pose
from fgslam.core.sensors import LoopClosure, Observations, Odometry
from fgslam.core.store import restore, state_of
from fgslam.core.types import EgoMotion, EgoMotionStatus

_TRACKED = np.diag([1e-6] * 6)
_WHEELS = np.diag([1e-4] * 6)


def _forward(metres: float) -> FloatArray:
    return pose(np.eye(3), np.array([0.0, 0.0, metres]))


def _tracking(wTc: FloatArray, used: int, matched: int) -> EgoMotion:
    return EgoMotion(
        wTc=wTc,
        covariance=_TRACKED,
        inliers=np.arange(matched) < used,
        residuals=np.zeros(matched),
        status=EgoMotionStatus.OK,
        iterations=3,
    )


def _add_frame(record: DriveRecord, metres: float, used: int = 80, matched: int = 100) -> None:
    """A frame tracked so far on from the last one, where the wheels say 0.1 m."""
    here = _forward(metres) if not len(record.chain) else record.chain.poses[-1] @ _forward(metres)
    odometry = Odometry(_forward(0.1), _WHEELS)
    record.step(_forward(metres), _tracking(here, used, matched), odometry, free=False)


def _closure(frame: int, oTc: FloatArray) -> LoopClosure:
    nothing = Observations(
        np.empty(0, np.int64),
        np.empty((0, 3)),
        np.empty((0, 3, 3)),
        np.empty((0, 3, 2)),
        np.empty(0, np.bool_),
    )
    return LoopClosure(frame, oTc, _TRACKED, nothing, np.empty((0, 2), np.int64))


def test_a_frame_most_of_whose_matches_contradict_it_measured_no_step() -> None:
    """Nor is the step back from it one: both are the odometry's."""
    record = DriveRecord()
    for metres, used in ((0.0, 80), (0.1, 80), (0.9, 49), (-0.7, 80), (0.1, 50)):
        _add_frame(record, metres, used)
    chain = record.chain
    assert [p[2, 3] for p in chain.poses] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    for step, expected in zip(
        chain.steps, (_TRACKED, _TRACKED, _WHEELS, _WHEELS, _TRACKED), strict=True
    ):
        np.testing.assert_array_equal(step, expected)


def test_without_odometry_the_tracked_step_is_all_there_is() -> None:
    """A chain needs its steps."""
    record = DriveRecord()
    record.step(np.eye(4), _tracking(np.eye(4), 80, 100), None, free=False)
    record.step(_forward(0.9), _tracking(_forward(0.9), 10, 100), None, free=False)
    assert record.chain.poses[-1][2, 3] == 0.9


def test_a_jump_of_the_tracking_does_not_make_a_true_closure_impossible() -> None:
    """0.8 m in one frame are 800 deviations of a tracked step; the closure knows better."""
    for used, taken in ((80, False), (30, True)):
        record = DriveRecord()
        _add_frame(record, 0.0)
        for k in range(1, 40):
            _add_frame(record, 0.9 if k == 20 else 0.1, used if k == 20 else 80)
        found = record.close(_closure(0, _forward(3.9)), record.chain.poses[-1], "frame 39")
        assert (found is not None) is taken, record.remarks


def test_a_few_old_landmarks_among_many_new_ones_tie_a_frame_to_nothing() -> None:
    """They are far away as a rule, and do not say where the frame is."""
    record = DriveRecord()
    poses = []
    for k in range(120):
        _add_frame(record, 0.1 if k else 0.0)
        poses.append(record.chain.poses[-1])
    tracking = _tracking(poses[-1], 80, 100)
    new = np.full(30, 110)
    record.tie(np.concatenate([np.full(20, 3), new]), poses, tracking, free=False)
    assert not record.chain.constraints
    record.tie(np.concatenate([np.full(31, 3), new]), poses, tracking, free=False)
    (tie,) = record.chain.constraints
    assert (tie.before, tie.after) == (3, 119)


def test_incoherent_frame_is_not_tied_to_old_landmarks() -> None:
    """Wherever its landmarks come from."""
    record = DriveRecord()
    poses = []
    for k in range(120):
        _add_frame(record, 0.1 if k else 0.0, 80 if k < 119 else 40)
        poses.append(record.chain.poses[-1])
    record.tie(np.full(40, 3), poses, _tracking(poses[-1], 40, 100), free=False)
    assert not record.chain.constraints


def test_restored_record_continues_after_an_incoherent_frame() -> None:
    """The step back is the odometry's, also after a restart."""
    one, other = (DriveRecord() for _ in range(2))
    for metres, used in ((0.0, 80), (0.1, 80), (0.9, 20)):
        _add_frame(one, metres, used)
    restore(other, state_of(one))
    for record in (one, other):
        _add_frame(record, -0.7)
    np.testing.assert_array_equal(one.chain.poses, other.chain.poses)
    np.testing.assert_array_equal(one.chain.steps, other.chain.steps)


@pytest.mark.parametrize("matched", [0, 1, 5])
def test_the_step_from_a_frame_without_a_pose_of_its_own_was_measured(matched: int) -> None:
    """It began the landmarks that the next one was tracked by; stray matches change nothing."""
    record = DriveRecord()
    _add_frame(record, 0.0)
    odometry, here = Odometry(_forward(0.1), _WHEELS), _forward(0.1)
    failed = replace(_tracking(here, 0, matched), status=EgoMotionStatus.TOO_FEW_MATCHES)
    record.step(_forward(0.1), failed, odometry, free=False)
    _add_frame(record, 0.13)
    assert record.chain.poses[-1][2, 3] == pytest.approx(0.23)
    np.testing.assert_array_equal(record.chain.steps[-1], _TRACKED)
