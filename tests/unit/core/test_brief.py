"""The texts of values that hold large arrays fit on a line."""

from __future__ import annotations

import numpy as np

from fgslam.core.estimates import LandmarkMap
from fgslam.core.trajectories import Trajectory


def test_arrays_are_shown_by_their_shapes() -> None:
    trajectory = Trajectory(np.arange(51.0), np.tile(np.eye(4), (51, 1, 1)))
    assert repr(trajectory) == "Trajectory(timestamps=array(51), poses=array(51, 4, 4))"


def test_rows_are_shown_by_their_shapes() -> None:
    landmarks = LandmarkMap(np.arange(9), np.zeros((9, 3)), np.zeros((9, 3, 3)))
    text = repr(landmarks)
    assert text == "LandmarkMap(ids=array(9), positions=array(9, 3), covariances=array(9, 3, 3))"
