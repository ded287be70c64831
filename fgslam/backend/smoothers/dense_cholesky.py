"""Dense symmetric systems: a scaled Cholesky factor, and the inverse in its place."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve, lapack

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError

UNDETERMINED = "the measurements do not determine all variables; no covariances"
_ROUNDING = 16.0 * np.finfo(np.float64).eps  # a pivot that is nothing but rounding


class UndeterminedError(EstimatorError):
    """The measurements do not determine all variables; ``row`` of the first one's, as ordered."""

    def __init__(self, row: int, message: str) -> None:
        """Row of the information matrix and the message."""
        super().__init__(message)
        self.row = row


class DenseFactor:
    """A positive definite matrix, factored in its own place, and later inverted there.

    It may be the largest thing in memory by far: there is never a second one.
    """

    def __init__(self, matrix: FloatArray) -> None:
        """Takes a matrix (n, n), which is overwritten.

        Raises:
            UndeterminedError: it is not positive definite.
        """
        self._held, self._size = scaled_cholesky(matrix, in_place=True)
        self._inverted = False

    def solve(self, right: FloatArray) -> FloatArray:
        """The matrix' inverse times (n,) or (n, c)."""
        if self._inverted:
            return np.asarray(self._held @ right)
        scale = self._size if right.ndim == 1 else self._size[:, None]
        found = cho_solve((self._held, True), right / scale, check_finite=False)
        return np.asarray(found / scale)

    @property
    def inverse(self) -> FloatArray:
        """(n, n), which takes the factor's place when it is first asked for."""
        if not self._inverted:
            self._held = from_cholesky(self._held, self._size, in_place=True)
            self._inverted = True
        return self._held


def scaled_cholesky(
    information: FloatArray, in_place: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Lower Cholesky factor of a positive definite matrix scaled to a unit diagonal, and the scale.

    Without the scaling, digits would be lost beside poses that are held stiffly. A large matrix is
    better overwritten.
    """
    size = np.sqrt(np.maximum(np.diagonal(information), 0.0))
    if not (size > 0.0).all():
        raise UndeterminedError(int(np.argmin(size > 0.0)), UNDETERMINED)
    scaled = information if in_place else information.copy()
    scaled /= size[:, None]
    scaled /= size
    factor, status = lapack.dpotrf(scaled.T, lower=1, overwrite_a=1)
    if status != 0:
        raise UndeterminedError(int(status) - 1, UNDETERMINED)
    pivots = np.diagonal(factor)
    if len(pivots) and pivots.min() ** 2 < _ROUNDING:
        raise UndeterminedError(int(pivots.argmin()), UNDETERMINED)
    return factor, size


def from_cholesky(factor: FloatArray, size: FloatArray, in_place: bool = False) -> FloatArray:
    """The inverse of the matrix that :func:`scaled_cholesky` took apart; in place of the factor."""
    if not len(size):  # LAPACK would complain on the terminal
        return np.zeros((0, 0))
    inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=in_place)
    for row in range(len(size)):  # in place: it may be large
        inverse[row, row + 1 :] = inverse[row + 1 :, row]
    inverse /= size[:, None]
    inverse /= size
    return np.asarray(inverse)
