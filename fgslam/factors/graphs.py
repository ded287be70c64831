"""Keys of a graph's variables, and small helpers on GTSAM's graphs and values.

The pose of frame k is ``x k``, the n-th landmark variable ``l n``: numbered by the graph, not by
the landmark's identity. An identity that starts again (it moved, or left a fixed lag and came
back) gets a new variable.
"""

from __future__ import annotations

from typing import Any
from zlib import crc32

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray, IntArray

_POSE, _LANDMARK, _NUISANCE = "x", "l", "n"
_TARGET, _VELOCITY = "t", "v"
_CHARACTER_AT = 56  # bits of a key below its character
_FIRST_LANDMARK = int(gtsam.symbol(_LANDMARK, 0))


def pose_key(frame: int) -> int:
    """Key of the camera pose ``wTc`` of frame ``frame``, counted from 0."""
    return int(gtsam.symbol(_POSE, frame))


def landmark_key(variable: int) -> int:
    """Key of the landmark variable number ``variable``, counted from 0."""
    return _FIRST_LANDMARK + variable


def nuisance_key(kind: str) -> int:
    """Key of the nuisance parameters (3,) of a kind of measurement."""
    return int(gtsam.symbol(_NUISANCE, crc32(kind.encode())))


def is_pose(key: int) -> bool:
    """Whether a key is a pose's."""
    return key >> _CHARACTER_AT == ord(_POSE)


def is_landmark(key: int) -> bool:
    """Whether a key is a landmark's."""
    return key >> _CHARACTER_AT == ord(_LANDMARK)


def number(key: int) -> int:
    """Frame or variable number of a key."""
    return key & ((1 << _CHARACTER_AT) - 1)


# --------------------------------------------------------------------------------------------
# Homing: the start is pose 0, images on the way are poses from 1 on


def target_key() -> int:
    """Key of the target's planar pose."""
    return int(gtsam.symbol(_TARGET, 0))


def velocity_key(image: int) -> int:
    """Key of the velocity at pose ``image``."""
    return int(gtsam.symbol(_VELOCITY, image))


def landmarks_in(values: Any) -> tuple[IntArray, FloatArray]:
    """Numbers (n,) of the landmark variables in GTSAM values, ascending, and positions (n, 3).

    Of all points at once: asked for one by one they take twenty times as long.
    """
    keys = np.array(values.keys(), np.int64)
    variables = keys[keys >> _CHARACTER_AT == ord(_LANDMARK)] - _FIRST_LANDMARK
    points = np.array(gtsam.utilities.extractPoint3(values)).reshape(-1, 3)
    return variables, points[: len(variables)]  # nuisance parameters come after them


def poses_of_frame(values: Any, frame: int) -> FloatArray:
    """The pose ``wTc`` (4, 4) of one frame in GTSAM values."""
    return np.asarray(values.atPose3(pose_key(frame)).matrix())


RELINEARISED = 0.01
"""Radians, and metres or legs: a variable that moves by more is relinearised. 0.1, GTSAM's own,
leaves a drive of 50 m twice as far off."""


def isam2_parameters(method: Any, factorization: str = "CHOLESKY") -> Any:
    """Parameters of iSAM2; every update checks which variables to relinearise.

    Args:
        method: GTSAM's parameters of Gauss-Newton or of the dog leg.
        factorization: ``CHOLESKY``, or ``QR`` for what is known very unevenly.
    """
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(method)
    params.setFactorization(factorization)
    params.setRelinearizeThreshold(RELINEARISED)
    params.relinearizeSkip = 1
    return params


def solver_parameters(max_iterations: int, relative_tolerance: float) -> Any:
    """Parameters of Levenberg-Marquardt that stop by the relative change of the cost alone."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(max_iterations)
    params.setRelativeErrorTol(relative_tolerance)
    params.setAbsoluteErrorTol(0.0)
    return params
