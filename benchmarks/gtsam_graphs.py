"""Graphs of GTSAM's own factors in the arrays of this package, to compare the two."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.backend.settings import KernelSettings
from fgslam.backend.smoothers.bundle import PLAIN, Sightings, State, WholeGraph
from fgslam.core.sensors import CameraRig
from fgslam.factors.landmark import FROM_MEASUREMENT
from fgslam.factors.noise import plain


def in_arrays(graph: Any, values: Any, kernel: KernelSettings = PLAIN) -> tuple[WholeGraph, State]:
    """The same graph, without empty slots, and state.

    Its stereo factors must all be of one rig, with poses of its right camera; they get the kernel.
    """
    others, stereo = gtsam.NonlinearFactorGraph(), []
    for row in range(graph.size()):
        factor = graph.at(row)
        if isinstance(factor, gtsam.GenericStereoFactor3D):
            stereo.append(factor)
        else:
            others.add(factor)
    keys = np.array([factor.keys() for factor in stereo], np.int64).reshape(-1, 2)
    seen = np.array([factor.measured().vector() for factor in stereo]).reshape(-1, 3)
    measured = np.column_stack([seen[:, 1], seen[:, 2], seen[:, 0] - seen[:, 1]])
    roots = np.array([plain(factor).noiseModel().R() for factor in stereo]).reshape(-1, 3, 3)
    rig = CameraRig(0, 0, 1.0, 1.0, 0.0, 0.0, 1.0, None, np.eye(4))
    if stereo:
        k = stereo[0].calibration()
        rig = CameraRig(0, 0, k.fx(), k.fy(), k.px(), k.py(), k.baseline(), None, np.eye(4))
    sightings = Sightings(keys[:, 0], keys[:, 1], measured, roots @ FROM_MEASUREMENT, rig)
    return WholeGraph.of(others, values, kernel, sightings)
