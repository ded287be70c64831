"""The robot's pose from bearings to landmarks that are taken as known: robust, and fast.

Gives the graph a first guess of each new pose, and tells bearings that cannot be right from
others before they enter.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.gauss_newton import GaussNewton, Linearised
from fgslam.factors.bearing_residuals import bearing, bearing_jacobians

_WIDTH = 2.0  # of Cauchy's kernel, in deviations
_SEARCH = GaussNewton(iterations=8, converged=1e-6)  # legs and radians


def resected(
    predicted: FloatArray,
    information: FloatArray,
    points: FloatArray,
    measured: FloatArray,
    sigma: FloatArray,
) -> FloatArray:
    """Pose (3,) that fits the bearings best, and the prediction as far as that is known.

    Iteratively reweighted Gauss-Newton with Cauchy's kernel.

    Args:
        predicted: (3,) expected pose.
        information: (3,) inverse variances of it, positive.
        points: (n, 2) landmarks.
        measured: (n,) bearings.
        sigma: (n,) their deviations.
    """

    def linearised(poses: FloatArray, iteration: int) -> Linearised:
        pose = poses[0]
        residual = bearing(pose, points, measured) / sigma
        by_pose = bearing_jacobians(pose, points)[0] / sigma[:, None]
        weighted = by_pose / (1.0 + (residual / _WIDTH) ** 2)[:, None]
        normal = weighted.T @ by_pose + np.diag(information)
        gradient = weighted.T @ residual + information * (pose - predicted)
        return normal[None], gradient[None]

    return np.asarray(_SEARCH.minimise(predicted[None], linearised)[0])
