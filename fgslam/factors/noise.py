"""Noise models of full covariances, with a robust kernel around them where one is asked for."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.factors.kernels import KernelName, m_estimator

STIFF_RAD, STIFF_M = 1e-5, 1e-4
"""Deviations of a hard floor. GTSAM's constrained models would be exact, and make every solve
fifteen times slower (they need QR). Its Cholesky calls a pose indeterminate that is known some ten
thousand times worse in one direction than in another, once these are no axes of the camera:
stiffer, and a blind drive with a pitched camera fails (docs/derivations/factors.md)."""

_EXACT = 1e-6  # radians and metres: the deviation of what has no variance
_RELATIVE = 1e-3  # of the largest deviation of the same covariance, for the same reason


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

    Their deviation is a micrometre or a microradian, or a thousandth of the largest one.
    """
    symmetric = 0.5 * (covariance + covariance.T)
    variances, directions = np.linalg.eigh(symmetric)
    if variances[0] >= _EXACT**2:
        return np.asarray(symmetric)
    kept = np.maximum(variances, max(_EXACT**2, _RELATIVE**2 * variances[-1]))
    return np.asarray((directions * kept) @ directions.T)
