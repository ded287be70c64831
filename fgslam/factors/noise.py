"""Noise models of full covariances, with a robust kernel (M-estimator) around them if asked for.

A kernel sees the norm of the *whole* whitened measurement, three numbers for a landmark
observation, whose square is chi-square with three degrees of freedom where the noise is normal.
Its plain functions are for solvers that linearise many factors at once.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray

KernelName: TypeAlias = Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"]
STIFF_RAD, STIFF_M = 1e-5, 1e-4
"""Deviations of a hard floor. GTSAM's constrained models would be exact, and make every solve
fifteen times slower (they need QR). Its Cholesky calls a pose indeterminate that is known some ten
thousand times worse in one direction than in another, once these are no axes of the camera:
stiffer, and a blind drive with a pitched camera fails (docs/derivations/measurements.md)."""

_EXACT = 1e-6  # radians and metres: the deviation of what has no variance
_RELATIVE = 1e-3  # of the largest deviation of the same covariance, for the same reason
_ROUNDING = 64 * np.finfo(float).eps  # of the largest variance: an eigenvalue's own error, 6 by 6


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


def scaled(factor: Any, variance: float) -> Any:
    """A GTSAM factor whose covariance is multiplied by a number, with the kernel that it has."""
    model = factor.noiseModel()
    kernel = model.robust() if isinstance(model, gtsam.noiseModel.Robust) else None
    covariance = variance * plain(factor).noiseModel().covariance()
    model = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if kernel is not None:
        model = gtsam.noiseModel.Robust.Create(kernel, model)
    return factor.cloneWithNewNoiseModel(model)


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


class Whitening:
    """Makes noise models of covariances; equal covariances share one model.

    One object serves one kind of factor: the mapping from covariance to model is remembered.
    """

    def __init__(self, kernel: KernelName = "none", width: float = 1.0) -> None:
        """``width`` is the kernel's scale in standard deviations of the whole measurement."""
        self._kernel = m_estimator(kernel, width)
        self._known: dict[bytes, Any] = {}

    def model(self, covariance: FloatArray, jacobian: FloatArray | None = None) -> Any:
        """Noise model of a covariance (n, n), positive definite, mapped by ``jacobian``, if any."""
        name = covariance.tobytes()
        found = self._known.get(name)
        if found is None:
            mapped = covariance if jacobian is None else jacobian @ covariance @ jacobian.T
            found = gtsam.noiseModel.Gaussian.Covariance(mapped)
            if self._kernel is not None:
                found = gtsam.noiseModel.Robust.Create(self._kernel, found)
            self._known[name] = found
        return found


def positive_definite(covariance: FloatArray) -> FloatArray:
    """A pose covariance (6, 6) whose exactly known directions are held stiffly.

    Their deviation is a micrometre or a microradian, or a thousandth of the largest one. Known
    exactly is also what has no variance beyond the rounding of the largest one.
    """
    symmetric = 0.5 * (covariance + covariance.T)
    variances, directions = np.linalg.eigh(symmetric)
    if variances[0] >= max(_EXACT**2, _ROUNDING * variances[-1]):
        return np.asarray(symmetric)
    kept = np.maximum(variances, max(_EXACT**2, _RELATIVE**2 * variances[-1]))
    return np.asarray((directions * kept) @ directions.T)
