"""Robust kernels as plain functions of whitened residuals, the same as GTSAM's M-estimators.

For solvers that linearise many factors at once; :mod:`fgslam.factors.noise` makes GTSAM's models.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.factors.noise import KernelName


def kernel_weights(name: KernelName, width: float, squared: FloatArray) -> FloatArray:
    """Weights of squared whitened residuals, any shape, of iteratively reweighted least squares.

    ``width`` is the kernel's scale in standard deviations.
    """
    ratio = squared / width**2
    match name:
        case "none":
            return np.ones_like(ratio)
        case "huber":
            return np.asarray(1.0 / np.sqrt(np.maximum(ratio, 1.0)))
        case "cauchy":
            return np.asarray(1.0 / (1.0 + ratio))
        case "geman_mcclure":
            return np.asarray(1.0 / (1.0 + ratio) ** 2)
        case "tukey":
            return np.asarray(np.maximum(1.0 - ratio, 0.0) ** 2)


def kernel_losses(name: KernelName, width: float, squared: FloatArray) -> FloatArray:
    """Losses of squared whitened residuals: half the square where there is no kernel."""
    ratio, half = squared / width**2, 0.5 * width**2
    match name:
        case "none":
            return np.asarray(0.5 * squared)
        case "huber":
            far = 2.0 * np.sqrt(np.maximum(ratio, 1.0)) - 1.0
            return np.asarray(half * np.where(ratio > 1.0, far, ratio))
        case "cauchy":
            return np.asarray(half * np.log1p(ratio))
        case "geman_mcclure":
            return np.asarray(half * ratio / (1.0 + ratio))
        case "tukey":
            return np.asarray(half / 3.0 * (1.0 - np.maximum(1.0 - ratio, 0.0) ** 3))
