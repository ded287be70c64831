"""Sparse systems of poses, a band of 6 x 6 blocks: solved, and inverted where poses are linked.

Poses are put into an order that keeps those that are linked near each other (Cuthill and McKee),
so that a drive is a band as wide as a landmark stays in sight, and a loop folds it. The band is cut
into square blocks, of which only neighbours are linked: what is left is dense and small.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.linalg import lapack, solve_triangular
from scipy.sparse import bsr_matrix, csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError

_UNDETERMINED = "the measurements do not determine all variables; no covariances"


class BlockBand:
    """Cholesky factor of a symmetric positive definite matrix, scaled to a unit diagonal.

    Without the scaling, digits would be lost beside poses that are held stiffly.
    """

    def __init__(self, matrix: bsr_matrix) -> None:
        """Takes a matrix (6n, 6n) in blocks of 6 x 6 apart.

        Raises:
            EstimatorError: it is not positive definite.
        """
        n = matrix.shape[0] // 6
        diagonal = matrix.diagonal()
        if not (diagonal > 0.0).all():
            raise EstimatorError(_UNDETERMINED)
        self._scale = np.sqrt(diagonal).reshape(n, 6)
        self._place, width = order(
            csr_matrix((np.ones(len(matrix.indices)), matrix.indices, matrix.indptr), (n, n))
        )
        self._width = n if 2 * width >= n else width
        self._factor, self._below = self._cut(matrix)
        self._factorise()

    def solve(self, right: FloatArray) -> FloatArray:
        """(6n, k) the matrix' inverse times (6n, k)."""
        blocks, last = len(self._factor), len(self._factor) - 1
        n, k = self._scale.shape[0], right.shape[1]
        x = np.zeros((blocks * self._width, 6, k))
        x[self._place] = right.reshape(n, 6, k) / self._scale[:, :, None]
        x = x.reshape(blocks, 6 * self._width, k)
        for i in range(blocks):
            if i:
                x[i] -= self._below[i - 1] @ x[i - 1]
            x[i] = solve_triangular(self._factor[i], x[i], lower=True, check_finite=False)
        for i in range(last, -1, -1):
            if i < last:
                x[i] -= self._below[i].T @ x[i + 1]
            x[i] = solve_triangular(self._factor[i], x[i], lower=True, trans=1, check_finite=False)
        found = x.reshape(-1, 6, k)[self._place] / self._scale[:, :, None]
        return np.asarray(found.reshape(6 * n, k))

    def inverse_blocks(self, row: IntArray, column: IntArray) -> FloatArray:
        """(k, 6, 6) of the inverse, at poses (k,) that are linked, or the same."""
        own, below = self._inverse
        row_at, column_at = self._place[row], self._place[column]
        (i, a), (j, b) = np.divmod(row_at, self._width), np.divmod(column_at, self._width)
        out = np.empty((len(row), 6, 6))
        same, lower, upper = i == j, i > j, i < j
        out[same] = own[i[same], a[same], :, b[same], :]
        out[lower] = below[j[lower], a[lower], :, b[lower], :]
        out[upper] = np.swapaxes(below[i[upper], b[upper], :, a[upper], :], 1, 2)
        out /= self._scale[row][:, :, None] * self._scale[column][:, None, :]
        return out

    def _cut(self, matrix: bsr_matrix) -> tuple[FloatArray, FloatArray]:
        """Diagonal blocks (c, b, b) and those below them (c - 1, b, b), scaled."""
        n, width = len(self._scale), self._width
        count = -(-n // width)
        diagonal = np.zeros((count, width, 6, width, 6))
        below = np.zeros((count - 1, width, 6, width, 6))
        row = np.repeat(np.arange(n), np.diff(matrix.indptr))
        column = matrix.indices
        data = matrix.data / (self._scale[row][:, :, None] * self._scale[column][:, None, :])
        (i, a), (j, b) = np.divmod(self._place[row], width), np.divmod(self._place[column], width)
        same, lower = i == j, i > j
        diagonal[i[same], a[same], :, b[same], :] = data[same]
        below[j[lower], a[lower], :, b[lower], :] = data[lower]
        for spare in range(n - (count - 1) * width, width):
            diagonal[-1, spare, :, spare, :] = np.eye(6)
        size = 6 * width
        return diagonal.reshape(count, size, size), below.reshape(count - 1, size, size)

    def _factorise(self) -> None:
        factor, below = self._factor, self._below
        for i in range(len(factor)):
            if i:
                factor[i] -= below[i - 1] @ below[i - 1].T
            factor[i], status = lapack.dpotrf(factor[i], lower=1, clean=1)
            if status != 0:
                raise EstimatorError(_UNDETERMINED)
            if i < len(below):
                below[i] = solve_triangular(factor[i], below[i].T, lower=True, check_finite=False).T

    @cached_property
    def _inverse(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the scaled inverse, by block, place and number of row, then of column."""
        shape = (-1, self._width, 6, self._width, 6)
        own, below = np.empty_like(self._factor), np.empty_like(self._below)
        for i in range(len(own) - 1, -1, -1):
            inverse, _ = lapack.dpotri(self._factor[i], lower=1)
            own[i] = inverse + np.tril(inverse, -1).T
            if i < len(below):
                gain = solve_triangular(
                    self._factor[i], self._below[i].T, lower=True, trans=1, check_finite=False
                ).T
                below[i] = -own[i + 1] @ gain
                own[i] -= gain.T @ below[i]
        return own.reshape(shape), below.reshape(shape)


def order(links: csr_matrix) -> tuple[IntArray, int]:
    """Places (n,) of rows that keep linked ones (n, n) near, and how far apart they are at most."""
    found = reverse_cuthill_mckee(links, symmetric_mode=True).astype(np.int64)
    place = np.empty_like(found)
    place[found] = np.arange(len(found))
    row = np.repeat(np.arange(len(place)), np.diff(links.indptr))
    apart = np.abs(place[row] - place[links.indices])
    return place, int(apart.max(initial=1))
