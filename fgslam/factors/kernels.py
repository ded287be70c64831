"""Robust kernels (M-estimators): GTSAM's, and the same as plain functions of whitened residuals.

A kernel sees the norm of the *whole* whitened measurement, three numbers for a landmark
observation, whose square is chi-square with three degrees of freedom where the noise is normal.
The plain functions are for solvers that linearise many factors at once.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray

KernelName: TypeAlias = Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"]


def m_estimator(name: KernelName, width: float) -> Any:
    """GTSAM's M-estimator of a scale in standard deviations; None for least squares."""
    estimators = gtsam.noiseModel.mEstimator
    match name:
        case "none":
            return None
        case "huber":
            return estimators.Huber.Create(width)
        case "cauchy":
            return estimators.Cauchy.Create(width)
        case "geman_mcclure":
            return estimators.GemanMcClure.Create(width)
        case "tukey":
            return estimators.Tukey.Create(width)


def robust(factor: Any, name: KernelName, width: float) -> Any:
    """A plain GTSAM factor with a kernel around its noise model."""
    kernel = m_estimator(name, width)
    model = gtsam.noiseModel.Robust.Create(kernel, factor.noiseModel())
    return factor.cloneWithNewNoiseModel(model)


def plain(factor: Any) -> Any:
    """A GTSAM factor without its kernel."""
    model = factor.noiseModel()
    if isinstance(model, gtsam.noiseModel.Robust):
        return factor.cloneWithNewNoiseModel(model.noise())
    return factor


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
