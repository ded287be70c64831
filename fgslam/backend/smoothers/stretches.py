"""Stretches of a long chain of poses, each eliminated by a banded Cholesky decomposition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_matrix

from fgslam.backend.smoothers.dense_cholesky import UNDETERMINED
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Neighbouring poses, eliminated together: they hang on what they see and on their ends.

    Attributes:
        rows: (6k,) of the system's poses.
        columns: (c,) of what is kept that they hang on.
        own: (k, 6, 6) their covariances if those are held.
        gain: (6k, c) how their mean follows those, negated.
        factor, size: of their information, scaled: Cholesky's band (12, 6k) and the scale (6k,).
    """

    rows: IntArray
    columns: IntArray
    own: FloatArray
    gain: FloatArray
    factor: FloatArray
    size: FloatArray

    @staticmethod
    def of(rows: IntArray, chain: csr_matrix, coupling: csr_matrix) -> tuple[Stretch, FloatArray]:
        """Of rows of the poses' block, and their coupling with all that is kept.

        Returns:
            The stretch, and the information (c, c) that it takes from its columns.

        Raises:
            EstimatorError: the poses are not determined.
        """
        band, size = _scaled_band(chain)
        try:
            factor = cholesky_banded(band, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            raise EstimatorError(UNDETERMINED) from None
        columns = np.unique(coupling.indices).astype(np.int64)
        scaled = coupling[:, columns].toarray() / size[:, None]
        gain = cho_solve_banded((factor, True), scaled, check_finite=False)
        blocks = size.reshape(-1, 6)
        own = _inverse_blocks(factor) / (blocks[:, :, None] * blocks[:, None, :])
        return Stretch(rows, columns, own, gain / size[:, None], factor, size), scaled.T @ gain

    def alone(self, gradients: FloatArray) -> FloatArray:
        """(6k, c) their steps for gradients (6k, c) if what they hang on is held."""
        scaled = gradients / self.size[:, None]
        found = cho_solve_banded((self.factor, True), scaled, check_finite=False)
        return np.asarray(-found / self.size[:, None])


def _scaled_band(matrix: csr_matrix) -> tuple[FloatArray, FloatArray]:
    """Lower band (12, 6n) of a chain's information, scaled to a unit diagonal, and the scale."""
    entries = matrix.tocoo()
    distance = entries.row - entries.col
    size = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
    if not (size > 0.0).all():
        raise EstimatorError(UNDETERMINED)
    band = np.zeros((12, len(size)))
    lower = distance >= 0
    row, column = entries.row[lower], entries.col[lower]
    band[distance[lower], column] = entries.data[lower] / (size[row] * size[column])
    return band, size


def _inverse_blocks(factor: FloatArray) -> FloatArray:
    """(n, 6, 6) diagonal blocks of the inverse of a matrix with banded Cholesky factor (12, 6n)."""
    n = factor.shape[1] // 6
    row, column = np.tril_indices(6)
    below, beside = np.indices((6, 6)).reshape(2, -1)
    starts = 6 * np.arange(n)[:, None]
    own, next_to = np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
    own[:, row, column] = factor[row - column, starts + column]
    next_to[:, below, beside] = factor[6 + below - beside, starts + beside]
    inverse = np.linalg.inv(own)
    carried = next_to @ inverse
    out = np.swapaxes(inverse, 1, 2) @ inverse
    for k in range(n - 2, -1, -1):
        out[k] += carried[k].T @ out[k + 1] @ carried[k]
    return out
