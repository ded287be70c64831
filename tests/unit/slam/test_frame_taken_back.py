"""A frame without features right after a closure: what that ended stays ended in all records."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from rings import assert_same_increments, on_ring, pipeline_of, seen
from simulated import RIG, assert_same_bits

from fgslam.core.log import MeasurementLog
from fgslam.runs.tasks.slam import restore, state_of
from fgslam.slam.build import saved_map
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import ConstantVelocityMotion
from fgslam.slam.pipeline import SlamPipeline
from fgslam.slam.results import RunRecorder

POSES = [on_ring(k) for k in range(6)]
MOTION = ConstantVelocityMotion().description()


def new() -> tuple[SlamPipeline, RunRecorder]:
    return pipeline_of(POSES, 0.0), RunRecorder(MeasurementLog(RIG, MOTION))


def out_of_order(_: FeatureFrame) -> FeatureFrame:
    raise ZeroDivisionError


def test_what_a_closure_ended_is_in_no_book_when_the_next_frame_is_taken_back() -> None:
    pipeline, recorder = new()
    *frames, last = list(seen(POSES))
    for frame in frames:
        report = pipeline.process(frame, frame.i, float(frame.i))
        recorder.add(report, 0.0, float("nan"))
    assert pipeline.places is not None
    older, ended = pipeline.tracker.database.ids[[0, -1]].tolist()
    pipeline.places.merging = np.array([[ended, older]])  # as a closure leaves it
    pipeline.places.fuse_since = len(frames) - 1
    pipeline.describe = out_of_order
    with pytest.raises(ZeroDivisionError):
        pipeline.process(dataclasses.replace(last, features=()), last.i, float(last.i))
    assert pipeline.rewound
    pipeline.describe = None

    saved = saved_map(pipeline, RIG, pipeline.estimate(), {}, evidence=np.empty(0, np.int64))
    np.testing.assert_array_equal(saved.landmarks.ids, pipeline.tracker.database.ids)
    assert ended not in saved.landmarks.ids
    assert len(saved) > 100

    again, resumed = new()
    restore(state_of(pipeline, recorder), recorder.log, again, resumed)
    reports = [each.process(last, last.i, float(last.i)) for each in (pipeline, again)]
    assert ended in reports[0].increment.pruned_ids
    assert_same_increments(reports[0].increment, reports[1].increment)
    assert_same_bits(pipeline.estimate(), again.estimate())
