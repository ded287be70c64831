"""Factors of homing: bearings, elevations, the leg, its measured direction, and motion.

Variables: planar poses of the start, of every image on the way and of the target (``Pose2``),
velocities in the robot's axes, and landmarks in the plane. GTSAM's own factors serve wherever there
is one; residuals are specified in :mod:`fgslam.factors.bearing_residuals`. Derivation:
docs/derivations/homing_graph.md.
"""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import rotation
from fgslam.factors.bearing_residuals import (
    direction_and_turn,
    elevation_pair,
)
from fgslam.factors.noise import KernelName, Whitening

STIFF = 1e-4
"""Deviation, legs and radians, of what defines the frame: the start's pose, and the leg's length.
Constrained models would be exact and make GTSAM fall back to QR, several times slower."""


class BearingFactors:
    """Makes the factors of measured bearings and elevations, robust or not."""

    def __init__(self, kernel: KernelName = "none", width: float = 1.0) -> None:
        """``width`` is the kernel's scale in standard deviations."""
        self._whitening = Whitening(kernel, width)

    def bearing(self, pose: int, landmark: int, measured: float, sigma: float) -> Any:
        """Bearing of a landmark from a pose; radians (eqs 7, 9)."""
        return gtsam.BearingFactor2D(pose, landmark, gtsam.Rot2(measured), self._model(sigma))

    def elevation_pair(
        self,
        target: int,
        landmark: int,
        measured: FloatArray,
        sigmas: FloatArray,
        first: FloatArray,
    ) -> Any:
        """Elevations (2,) of a landmark from start and target without its height; radians.

        Their deviations (2,) are brought together at first guesses of target and landmark, (5,).
        """
        _, _, _, by_elevations = elevation_pair(first[:3], first[3:], measured)
        sigma = float(np.linalg.norm(by_elevations * sigmas))
        tangent, up = math.tan(measured[0]), float(measured[1])

        # As the specification, in plain numbers: five times faster, and called for each landmark
        # in every step of a solver.
        def error(_: Any, values: Any, jacobians: list[FloatArray] | None) -> FloatArray:
            at, (x, y) = values.atPose2(target), values.atPoint2(landmark).tolist()
            dx, dy = x - at.x(), y - at.y()
            near, far = math.hypot(dx, dy), math.hypot(x, y)
            height = tangent * far
            if jacobians is not None:
                squared = near**2 + height**2
                down, raised = height / (squared * near), near / squared * tangent / far
                c, s = math.cos(at.theta()), math.sin(at.theta())
                jacobians[0] = np.array([[down * (c * dx + s * dy), down * (c * dy - s * dx), 0.0]])
                jacobians[1] = np.array([[raised * x - down * dx, raised * y - down * dy]])
            return np.array([math.atan2(height, near) - up])

        return gtsam.CustomFactor(self._model(sigma), [target, landmark], error)

    def _model(self, sigma: float) -> Any:
        return self._whitening.model(np.array([[sigma**2]]))


def start_prior(pose: int) -> Any:
    """The start is the frame's origin."""
    return gtsam.PriorFactorPose2(pose, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, STIFF))


def leg_factor(start: int, target: int) -> Any:
    """The distance from start to target is the unit of length (R = 1, III-B)."""
    return gtsam.RangeFactorPose2(start, target, 1.0, gtsam.noiseModel.Isotropic.Sigma(1, STIFF))


def vector_factor(target: int, direction: float, turn: float, covariance: FloatArray) -> Any:
    """The initialisation's (theta, psi) with its covariance (2, 2), on the target's pose."""

    def error(_: Any, values: Any, jacobians: list[FloatArray] | None) -> FloatArray:
        at = values.atPose2(target)
        place = np.array([at.x(), at.y(), at.theta()])
        residual, derivative = direction_and_turn(place, direction, turn)
        if jacobians is not None:
            jacobians[0] = derivative @ tangent_to_pose(place)
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(covariance), [target], error)


def velocity_prior(velocity: int, mean: FloatArray, sigmas: FloatArray) -> Any:
    """Prior (3,) on a velocity: forward, left, turning."""
    return gtsam.PriorFactorVector(velocity, mean, gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def motion_factor(
    before: tuple[int, int, float], after: tuple[int, int, float], density: FloatArray
) -> Any:
    """Constant velocity up to white noise on the acceleration (eq 4 and 5, corrected).

    Args:
        before: keys of pose and of velocity, and time in seconds.
        after: the same, later.
        density: (3,) of the accelerations' noise, forward, left and turning.
    """
    return gtsam.WnoaMotionFactorPose2(
        gtsam.StateData(*before), gtsam.StateData(*after), np.asarray(density)
    )


def weak_landmark_prior(landmark: int, position: FloatArray, sigma: float) -> Any:
    """Keeps a landmark determined when too few bearings say where it is."""
    return gtsam.PriorFactorPoint2(landmark, position, gtsam.noiseModel.Isotropic.Sigma(2, sigma))


def tangent_to_pose(pose: FloatArray) -> FloatArray:
    """(3, 3) derivative of a pose's (x, y, psi) by GTSAM's tangent, which is in its own axes."""
    out = np.eye(3)
    out[:2, :2] = rotation(float(pose[2]))
    return out
