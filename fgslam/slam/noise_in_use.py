"""The noise that each frame was estimated with, where the drive itself shows how large it is.

Of the motion model (:mod:`fgslam.slam.motion_noise`), of matches
(:mod:`fgslam.frontend.tracking.ego_motion`) and of a graph's measurements
(:mod:`fgslam.backend.persistence`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fgslam.backend.protocol import Estimator, NoiseEstimating
from fgslam.core.measurements import Odometry
from fgslam.frontend.tracking.ego_motion import MatchNoise
from fgslam.slam.motion import ConstantVelocityMotion, MotionModel, OdometryMotion


class FrameNoise(NamedTuple):
    """Noise in use in one frame; NaN where the frame had no noise of the kind.

    Attributes:
        rotation_sigma_dps2, translation_sigma_mps2: deviation of the random acceleration by which
            the velocity is taken to change, root mean square of the three axes; of frames that no
            odometry measured, the translation also where a gyroscope measured the rotation.
        gyroscope_factor: on the stated deviation of a gyroscope's turn.
        match_factor: on the stated deviations of measurements, where the frame's pose was found.
        single_factor: on the same, as an estimator's graph judges single measurements by.
        correlated_factor: on the same, as the graph weighs measurements by: errors that persist
            from frame to frame count for more than independent ones.
    """

    rotation_sigma_dps2: float = math.nan
    translation_sigma_mps2: float = math.nan
    gyroscope_factor: float = math.nan
    match_factor: float = math.nan
    single_factor: float = math.nan
    correlated_factor: float = math.nan


def noise_in_use(
    motion: MotionModel, odometry: Odometry | None, matches: MatchNoise, estimator: Estimator
) -> FrameNoise:
    """The noise of a frame that the estimator has taken in, and that nothing has learnt from yet.

    Args:
        motion: the model that gave ``odometry``; one that is not of this package has no noise here.
        odometry: what the frame was predicted with.
        matches: what the ego-motion takes the noise of matches to be.
        estimator: after its update.
    """
    rotation, translation = _of_motion(motion, odometry)
    single, correlated = (
        estimator.noise_factors if isinstance(estimator, NoiseEstimating) else (math.nan, math.nan)
    )
    turned = odometry is not None and odometry.turned
    return FrameNoise(
        rotation_sigma_dps2=rotation,
        translation_sigma_mps2=translation,
        gyroscope_factor=(
            motion.gyroscope_factor if turned and isinstance(motion, OdometryMotion) else math.nan
        ),
        match_factor=math.sqrt(matches.variance),
        single_factor=single,
        correlated_factor=correlated,
    )


def _of_motion(motion: MotionModel, odometry: Odometry | None) -> tuple[float, float]:
    """Deviations of the acceleration, degrees/s^2 and m/s^2, where the step stands on it."""
    if odometry is None or odometry.measured:
        return math.nan, math.nan
    if not isinstance(motion, ConstantVelocityMotion | OdometryMotion):
        return math.nan, math.nan
    rotation, translation = np.sqrt(motion.acceleration_variance.reshape(2, 3).mean(axis=1))
    return math.nan if odometry.turned else math.degrees(rotation), float(translation)
