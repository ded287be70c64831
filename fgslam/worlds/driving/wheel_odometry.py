"""Wheel odometry of a planar robot: a stated drift model, sampled, with its exact covariance.

Of a true motion between two frames with way ``l`` and turn ``a`` the wheels report
``motion * Exp(xi)``, where ``xi`` [rotation, translation], tangent at the new body pose, is

* zero-mean noise, independent between frames, whose variances grow with ``l`` and ``|a|``, and
* two scale errors, drawn once a drive: a fraction of the distance and a fraction of the turn.

`noise` of the settings multiplies the noise that the wheels themselves make.

The covariance stated with each increment is that of ``xi`` over all drives (noise and scale
together). Truth has neither height, pitch nor roll; their noise is what an inertial unit would add.
"""

from __future__ import annotations

import numpy as np

from fgslam.core import geometry
from fgslam.core.arrays import FloatArray
from fgslam.core.measurements import Odometry
from fgslam.worlds.settings import WheelOdometrySettings

_YAW, _ALONG = 2, 3
# Of the wheels: along the way, across it, and of the heading, each a root metre driven; and of the
# heading a root radian turned.
ALONG_M_SQRT_M, SIDEWAYS_M_SQRT_M, YAW_DEG_SQRT_M, YAW_DEG_SQRT_RAD = 0.02, 0.01, 0.5, 0.8
# What a planar robot does not drive: height, and pitch and roll, each a root metre; and the least
# noise of an increment, for that of a robot at rest must have a covariance that can be inverted.
HEIGHT_M_SQRT_M, TILT_DEG_SQRT_M = 0.002, 0.1
FLOOR_M, FLOOR_DEG = 1e-4, 0.01


def identity_values(settings: WheelOdometrySettings) -> dict[str, float]:
    """The drift model by the names under which it is part of a recording's identity."""
    return {
        "distance_scale": settings.scale_error,
        "turn_scale": settings.scale_error,
        "distance_m_sqrt_m": settings.noise * ALONG_M_SQRT_M,
        "sideways_m_sqrt_m": settings.noise * SIDEWAYS_M_SQRT_M,
        "yaw_deg_sqrt_m": settings.noise * YAW_DEG_SQRT_M,
        "yaw_deg_sqrt_rad": settings.noise * YAW_DEG_SQRT_RAD,
        "height_m_sqrt_m": HEIGHT_M_SQRT_M,
        "tilt_deg_sqrt_m": TILT_DEG_SQRT_M,
        "floor_m": FLOOR_M,
        "floor_deg": FLOOR_DEG,
    }


def increment_variances(
    settings: WheelOdometrySettings, way: FloatArray, turn: FloatArray
) -> FloatArray:
    """Variances (n, 6) of the noise that is independent between frames.

    Args:
        settings: the drift model.
        way: (n,) metres driven in each increment.
        turn: (n,) radians turned.
    """
    out = np.empty((len(way), 6))
    tilt, yaw_m, yaw_rad = np.deg2rad(
        [TILT_DEG_SQRT_M, settings.noise * YAW_DEG_SQRT_M, settings.noise * YAW_DEG_SQRT_RAD]
    )
    out[:, :2] = (tilt**2 * way)[:, None]
    out[:, _YAW] = yaw_m**2 * way + yaw_rad**2 * np.abs(turn)
    noise = settings.noise
    sides = (noise * ALONG_M_SQRT_M, noise * SIDEWAYS_M_SQRT_M, HEIGHT_M_SQRT_M)
    out[:, 3:] = way[:, None] * np.square(sides)
    out[:, :3] += np.deg2rad(FLOOR_DEG) ** 2
    out[:, 3:] += FLOOR_M**2
    return out


def simulate(
    settings: WheelOdometrySettings, body_poses: FloatArray, rng: np.random.Generator
) -> list[Odometry]:
    """Odometry between consecutive body poses (n, 4, 4): n - 1 increments.

    Args:
        settings: the drift model.
        body_poses: true ``wTb``, planar.
        rng: source of the noise; one drive's worth is drawn.
    """
    motions = geometry.inverse(body_poses[:-1]) @ body_poses[1:]
    scale = rng.standard_normal(2) * settings.scale_error
    noise = rng.standard_normal((len(motions), 6))
    turn = np.arctan2(motions[:, 1, 0], motions[:, 0, 0])
    way = np.linalg.norm(motions[:, :3, 3], axis=1)
    variances = increment_variances(settings, way, turn)
    out = []
    for motion, angle, unit, variance in zip(motions, turn, noise, variances, strict=True):
        by_turn, by_distance = _scale_directions(motion, float(angle))
        xi = unit * np.sqrt(variance) + scale[0] * by_turn + scale[1] * by_distance
        covariance = (
            np.diag(variance)
            + settings.scale_error**2 * np.outer(by_turn, by_turn)
            + settings.scale_error**2 * np.outer(by_distance, by_distance)
        )
        out.append(Odometry(np.asarray(motion @ geometry.se3_exp(xi)), covariance))
    return out


def _scale_directions(motion: FloatArray, turn: float) -> tuple[FloatArray, FloatArray]:
    """Tangent vectors (6,) at the new pose of a unit relative error of turn and of distance."""
    by_turn, by_distance = np.zeros(6), np.zeros(6)
    by_turn[_YAW] = turn
    by_distance[_ALONG:] = motion[:3, :3].T @ motion[:3, 3]
    return by_turn, by_distance
