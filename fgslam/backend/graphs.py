"""Helpers on GTSAM's graphs, values and optimizers that filters and smoothers share."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.factors.keys import pose_key


def without_gaps(graph: Any) -> Any:
    """A nonlinear graph without its empty slots."""
    kept = gtsam.NonlinearFactorGraph()
    for row in range(graph.size()):
        if graph.exists(row):
            kept.add(graph.at(row))
    return kept


def poses_of_frame(values: Any, frame: int) -> FloatArray:
    """The pose ``wTc`` (4, 4) of one frame in GTSAM values."""
    return np.asarray(values.atPose3(pose_key(frame)).matrix())


def solver_parameters(max_iterations: int, relative_tolerance: float) -> Any:
    """Parameters of Levenberg-Marquardt that stop by the relative change of the cost alone."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(relative_tolerance)
    params.setAbsoluteErrorTol(0.0)
    return params
