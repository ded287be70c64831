"""Frames that a guess alone places next to the first map are reported, with their share."""

from __future__ import annotations

import numpy as np
from simulated import RIG

from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.types import StereoFeatures
from fgslam.frontend.tracking.landmarks import MapParts
from fgslam.slam.results import FrameRow, RunRecorder, in_first_map, part_remarks

NONE = np.empty(0, np.int64)


class Apart(MapParts):
    """Parts as given."""

    def __init__(self, connected: list[bool]) -> None:
        super().__init__()
        self._frames = [int(not one) for one in connected]


def recorded(statuses: list[str], step: Odometry | None = None) -> RunRecorder:
    recorder = RunRecorder(MeasurementLog(RIG, {}))
    nothing = StereoFeatures.empty().observations(NONE, NONE, is_new=False)
    for i, status in enumerate(statuses):
        recorder.log.append(
            Increment(10 * i, float(i), step, nothing, np.empty(0, np.bool_), NONE, NONE)
        )
        recorder.rows.append(FrameRow(status, 0, 0, 0, 0, 0, 0.0, 0.0, 0, 0.0, ""))
    return recorder


STATUSES = ["first", "ok", "too_few_matches", "relocalised", "ok"]


def test_nothing_is_reported_of_one_map() -> None:
    assert part_remarks(recorded(STATUSES), Apart([True] * 5)) == ()
    assert in_first_map(recorded(STATUSES), Apart([True] * 5)).sum() == 4


def test_frames_that_are_interpolated_are_reported() -> None:
    parts = Apart([True, True, False, True, True])
    (remark,) = part_remarks(recorded(STATUSES), parts)
    assert (remark.code, remark.frames) == ("bridged", (20,))
    assert in_first_map(recorded(STATUSES), parts).sum() == 4


def test_frames_beyond_a_gap_are_reported() -> None:
    parts = Apart([True, True, False, False, False])
    (remark,) = part_remarks(recorded(STATUSES), parts)
    assert (remark.code, remark.frames) == ("unconnected", (30, 40))
    assert remark.values == {"known": 2, "all": 5, "percent": 40.0}


def test_a_frame_that_failed_is_not_counted() -> None:
    parts = Apart([True, True, False, True, True, True])
    assert in_first_map(recorded(STATUSES), parts).sum() == 4
