"""Factors on poses alone: prior, odometry, floor."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import Odometry
from fgslam.core.types import Floor, Prediction
from fgslam.factors.noise import STIFF_M, STIFF_RAD, positive_definite, robust

_GUESSED_WIDTH = float(np.sqrt(10.0))
"""Kernel of a step that a motion model made: Student's t with ten degrees of freedom, of Cauchy's
shape. A variance known from as many samples foretells so; the model's fading memory is worth twenty
equal ones, and ten allow for starts and turns besides."""


def pose_prior(pose: int, prior: Prediction) -> Any:
    """Prior on a pose ``wTc``; directions without variance are held stiffly."""
    model = gtsam.noiseModel.Gaussian.Covariance(positive_definite(prior.covariance))
    return gtsam.PriorFactorPose3(pose, gtsam.Pose3(prior.wTc), model)


def odometry_factor(before: int, after: int, odometry: Odometry) -> Any:
    """Motion between two poses; its covariance is in the tangent space at the later one.

    GTSAM's residual ``Log(measured^-1 between)`` lives in just that space.
    """
    model = gtsam.noiseModel.Gaussian.Covariance(positive_definite(odometry.covariance))
    return gtsam.BetweenFactorPose3(before, after, gtsam.Pose3(odometry.motion), model)


def step_factor(before: int, after: int, step: Odometry) -> Any:
    """Motion between two poses as measured, or as foretold from the last ones.

    What is foretold fails where a drive starts, stops or turns, by far more than its noise: it has
    a kernel. Where a gyroscope has measured the rotation there is none.
    """
    factor = odometry_factor(before, after, step)
    if step.measured or step.turned:
        return factor
    return robust(factor, "cauchy", _GUESSED_WIDTH)


def floor_factors(pose: int, floor: Floor, wTc: FloatArray) -> list[Any]:
    """Factors that keep a pose on the floor (Se et al. 5): height, and for dof 3 its tilt.

    The height is exact anywhere. The tilt is measured about the rotation nearest to ``wTc``
    that the floor allows: it is zero for all upright poses, and its deviation keeps its meaning
    while the heading stays near (a heading off by a radian counts tilts 4 % too much).

    Args:
        pose: key.
        floor: which directions, hard or soft.
        wTc: (4, 4) initial value of the pose.
    """
    if floor.dof == 6:
        return []
    height_sigma = STIFF_M if floor.hard else floor.height_sigma_m
    origin = np.zeros(3)
    height = gtsam.PoseTranslationPrior3D(
        pose, origin, _one_direction(floor.down[:, None], height_sigma)
    )
    if floor.dof == 5:
        return [height]
    tilt_sigma = STIFF_RAD if floor.hard else floor.tilt_sigma_rad
    upright = floor.constrain(wTc)[:3, :3]
    tilt = gtsam.PoseRotationPrior3D(
        pose, gtsam.Rot3(upright), _one_direction(upright.T @ floor.horizontal, tilt_sigma)
    )
    return [height, tilt]


def _one_direction(directions: FloatArray, sigma: float) -> Any:
    """Noise model that weighs only the components along orthonormal ``directions`` (3, m)."""
    root = np.zeros((3, 3))
    root[: directions.shape[1]] = directions.T / sigma
    # GTSAM's shortcut for diagonal roots checks above the diagonal only; see the derivation.
    return gtsam.noiseModel.Gaussian.SqrtInformation(root, False)


def point_prior(landmark: int, position: FloatArray, covariance: FloatArray) -> Any:
    """Prior on a world point (3,), covariance (3, 3) metres squared."""
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.PriorFactorPoint3(landmark, position, noise)
