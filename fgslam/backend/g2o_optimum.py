"""The least-squares answer of a .g2o file as GTSAM reads it."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray

_TOLERANCE = 1e-12  # relative change of the cost: the optimum, not its neighbourhood
_MOST_STEPS = 100
_HELD_SIGMA = 1e-6  # m and rad, of the first pose, which FIX holds for g2o and GTSAM does not read


def g2o_optimum(path: Path, poses: int) -> tuple[FloatArray, FloatArray] | None:
    """Poses (n, 4, 4) and landmarks (m, 3) at the minimum of the file's squared errors.

    Vertices are numbered as :func:`fgslam.report.graph_file.write_g2o` does: ``poses`` of them
    first, then landmarks. None where the measurements do not determine them all.
    """
    graph, values = gtsam.readG2o(str(path), True)
    if not poses:
        return None
    held = gtsam.noiseModel.Isotropic.Sigma(6, _HELD_SIGMA)
    graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), held))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(_TOLERANCE)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setMaxIterations(_MOST_STEPS)
    try:
        found = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    except RuntimeError:  # GTSAM's, of a system that is singular
        return None
    count = values.size() - poses
    landmarks = [found.atPoint3(gtsam.symbol("l", poses + k)) for k in range(count)]
    return (
        np.array([found.atPose3(k).matrix() for k in range(poses)]),
        np.array(landmarks).reshape(-1, 3),
    )
