"""Normal equations of the homing graph in plain arrays, and their exact solution.

The chain of images (pose and velocity, six numbers each) is a block-tridiagonal matrix A, target
and landmarks are its border C, with what each image sees of them, B, between::

    [A  B] [chain ]     [a]
    [B' C] [border] = - [b]

A is factored as a band, then the Schur complement C - B' A^-1 B. Everything is linearised anew
each time, and one covariance costs a few columns. Derivation: docs/derivations/homing_graph.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_factor, cho_solve, lapack

from fgslam.core.arrays import FloatArray, IntArray

STATE = 6  # numbers of an image: pose and velocity
_ROWS, _COLUMNS = np.indices((STATE, STATE))
_LOWER = np.tril_indices(STATE)


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Half the Hessian of the cost, and its gradient.

    Attributes:
        diagonal: (n, 6, 6) of the chain.
        below: (n - 1, 6, 6) rows of the later image, columns of the earlier.
        cross: (n, 6, m) chain and border.
        border: (m, m) target and landmarks.
        chain_gradient, border_gradient: (n, 6) and (m,).
    """

    diagonal: FloatArray
    below: FloatArray
    cross: FloatArray
    border: FloatArray
    chain_gradient: FloatArray
    border_gradient: FloatArray


class Factored:
    """Normal equations factored once: the step to the minimum, and covariances.

    Raises:
        numpy.linalg.LinAlgError: they do not determine every variable.
    """

    def __init__(self, equations: NormalEquations, damping: float = 0.0) -> None:
        """``damping`` adds so many times the diagonal to itself (Marquardt)."""
        e = equations
        count, m = len(e.diagonal), len(e.border)
        self._size = m
        band, info = lapack.dpbtrf(_band(e, damping), lower=1, overwrite_ab=1)
        if info != 0:
            raise LinAlgError("the chain of images is not determined")
        right = np.zeros((STATE * count, m + 4), order="F")
        right[:, :m] = e.cross.reshape(-1, m)
        right[:, m] = e.chain_gradient.ravel()
        last = np.arange(3)
        right[STATE * (count - 1) + last, m + 1 + last] = 1.0
        solved, _ = lapack.dtbtrs(band, right, uplo="L", overwrite_b=1)
        crossed, gradient, self._end = np.split(solved, [m, m + 1], axis=1)
        reduced = e.border - crossed.T @ crossed
        if damping > 0.0:
            reduced[np.diag_indices(m)] += damping * np.diagonal(e.border)
        self._reduced = cho_factor(reduced, lower=True, check_finite=False)
        self.border = -cho_solve(
            self._reduced, e.border_gradient - crossed.T @ gradient[:, 0], check_finite=False
        )
        left = gradient[:, 0] + crossed @ self.border
        chain, _ = lapack.dtbtrs(band, left[:, None], uplo="L", trans="T")
        self.chain = -chain.reshape(count, STATE)
        fall = e.chain_gradient.ravel() @ chain[:, 0] - e.border_gradient @ self.border
        self.decrement = float(np.sqrt(max(fall, 0.0)))
        """Length of the step in its own deviations."""
        self._carried = self._end.T @ crossed

    def border_covariance(self) -> FloatArray:
        """(m, m) of target and landmarks."""
        return np.asarray(cho_solve(self._reduced, np.eye(self._size), check_finite=False))

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance (3 + k) of the last image's pose and numbers (k,) of the border."""
        k = len(columns)
        chosen = np.zeros((self._size, k + 3))
        chosen[columns, np.arange(k)] = 1.0
        chosen[:, k:] = self._carried.T
        solved = cho_solve(self._reduced, chosen, check_finite=False)
        out = np.empty((3 + k, 3 + k))
        out[:3, :3] = self._end.T @ self._end + self._carried @ solved[:, k:]
        out[3:, :3] = -solved[columns, k:]
        out[:3, 3:] = out[3:, :3].T
        out[3:, 3:] = solved[columns, :k]
        return np.asarray(0.5 * (out + out.T))


def _band(e: NormalEquations, damping: float) -> FloatArray:
    """(12, 6 n) lower band of the chain, column by column, as LAPACK wants it."""
    count = len(e.diagonal)
    band = np.zeros((2 * STATE, count * STATE), order="F")
    blocks = band.T.reshape(count, STATE, 2 * STATE)
    i, j = _LOWER
    blocks[:, j, i - j] = e.diagonal[:, i, j]
    blocks[:-1, _COLUMNS, STATE + _ROWS - _COLUMNS] = e.below
    if damping > 0.0:
        band[0] *= 1.0 + damping
    return band
