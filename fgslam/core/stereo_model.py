"""The rig's linear model: raw pixels of its images and (column, row, disparity).

Derived in docs/derivations/stereo_measurement.md. Front-end and simulation share it, so that both
mean the same by a measurement and its covariance.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import CameraRig


def vertical_to_horizontal(rig: CameraRig) -> float:
    """What vertical disparity is multiplied by to give horizontal; 1 for the paper's rig."""
    if rig.vertical_baseline is None:
        return 1.0
    return rig.fx * rig.baseline / (rig.fy * rig.vertical_baseline)


def pixel_model(cameras: int, ratio: float) -> FloatArray:
    """Linear map (2 * cameras, 3) from (column, row, disparity) to pixels (c, r) per camera.

    ``ratio`` is :func:`vertical_to_horizontal`.
    """
    model = np.zeros((2 * cameras, 3))
    model[0::2, 0] = 1.0  # columns of right, left, top
    model[1::2, 1] = 1.0  # rows
    model[2, 2] = 1.0  # the left camera's column grows by the disparity
    if cameras == 3:
        model[5, 2] = 1.0 / ratio  # and the top camera's row
    return model


def measurement_map(kind: str, cameras: int, ratio: float) -> FloatArray:
    """Linear map (3, 2 * cameras) from pixels (c, r) per camera to (column, row, disparity).

    The covariance of the measurement follows as ``sigma^2 M M^T`` for equal independent noise on
    all coordinates. For `paper`, d is the mean of both disparities, which correlates with row and
    column; `fused` is the least-squares solution of the rig's linear model, which
    for three cameras has variances 5/12, 5/12 and 3/4 against the paper's 1, 1 and 1.
    """
    if kind == "fused":
        return np.asarray(np.linalg.pinv(pixel_model(cameras, ratio)), np.float64)
    out = np.zeros((3, 2 * cameras))
    out[0, 0] = out[1, 1] = 1.0
    # Weights inverse to the variances; one half each where both baselines are equal.
    weight = 1.0 if cameras == 2 else _horizontal_weight(ratio)
    out[2, 2], out[2, 0] = weight, -weight
    if cameras == 3:
        out[2, 5] = (1.0 - weight) * ratio
        out[2, 1] = -out[2, 5]
    return out


def _horizontal_weight(ratio: float) -> float:
    squared = ratio**2
    return squared / (1.0 + squared)
