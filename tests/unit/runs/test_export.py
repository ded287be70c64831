"""What export states of formats that leave something out."""

from __future__ import annotations

import numpy as np

from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import CameraRig, Increment, Observations
from fgslam.core.types import Trajectory
from fgslam.runs.export import line_numbers

RIG = CameraRig(32, 24, 30.0, 30.0, 15.5, 11.5, 0.2, None, np.eye(4))


def log_of_frames(*numbers: int) -> MeasurementLog:
    log = MeasurementLog(RIG, {"kind": "constant_velocity"})
    for number in numbers:
        none, ids = np.zeros(0, np.bool_), np.empty(0, np.int64)
        shapes = ((0, 3), (0, 3, 3), (0, 3, 2))
        seen = Observations(ids, *(np.empty(shape) for shape in shapes), none)
        log.append(Increment(number, 0.1 * number, None, seen, none, ids, ids))
    return log


def poses_of_frames(*numbers: int) -> Trajectory:
    stamps = np.round(0.1 * np.array(numbers), 6)
    return Trajectory(stamps, np.tile(np.eye(4), (len(numbers), 1, 1)))


def test_lines_without_times_state_which_frames_they_are() -> None:
    """evo and KITTI's development kit take line k as frame k."""
    log = log_of_frames(*range(6))
    assert line_numbers(poses_of_frames(*range(6)), log) == ""
    assert "are frames 2, 3, 4, 5 to 5 of" in line_numbers(poses_of_frames(2, 3, 4, 5), log)
    assert "are frames 0, 1, 4 to 4 of" in line_numbers(poses_of_frames(0, 1, 4), log)
    every_other = log_of_frames(0, 2, 4)
    assert "are frames 0, 2, 4 to 4 of" in line_numbers(poses_of_frames(0, 2, 4), every_other)
