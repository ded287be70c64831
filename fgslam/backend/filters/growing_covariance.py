"""The joint covariance of a pose and many landmarks, updated in place.

Only the lower triangle is kept, so the matrix is symmetric by construction, an update costs half
of a full product, and a landmark comes or goes by touching its own rows and columns alone.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray

FRONT = 6
"""The pose's rows and columns come first."""
BLOCK = 3
"""Rows and columns of a landmark."""
_SLAB = 192  # rows updated at once: large enough for the product's speed, small enough for cache
_GROWTH = 1.2


class GrowingCovariance:
    """Symmetric (n, n) matrix with n = 6 + 3 blocks; blocks are numbered from 0."""

    def __init__(self, front: FloatArray) -> None:
        """Starts with the pose's block (6, 6) alone."""
        self._buffer = np.zeros((FRONT, FRONT))
        self._size = 0
        self.reserve(20)
        self._size = FRONT
        self._buffer[:FRONT, :FRONT] = front

    @property
    def blocks(self) -> int:
        """Number of landmarks."""
        return (self._size - FRONT) // BLOCK

    def reserve(self, blocks: int) -> None:
        """Makes room for so many landmarks, and some more; may raise MemoryError."""
        needed = FRONT + BLOCK * blocks
        if needed <= len(self._buffer):
            return
        n, room = self._size, int(_GROWTH * needed)
        # Never read above the diagonal, yet a slab's update takes it along: memory as it comes may
        # hold signalling NaNs.
        larger = np.zeros((room, room))
        larger[:n, :n] = self._buffer[:n, :n]
        self._buffer = larger
        self._scratch = np.empty(_SLAB * room)

    def front(self) -> FloatArray:
        """(n, 6) the pose's columns."""
        out = self._buffer[: self._size, :FRONT].copy()
        out[:FRONT] = _mirrored(out[:FRONT])
        return out

    def columns(self, index: IntArray) -> FloatArray:
        """(n, k) the columns of these rows."""
        n = self._size
        below, above = self._buffer[:n].take(index, axis=1), self._buffer[index, :n].T
        return np.where(np.arange(n)[:, None] >= index, below, above)

    def diagonal_blocks(self, blocks: IntArray) -> FloatArray:
        """(k, 3, 3) the landmarks' own covariances."""
        at = rows_of(blocks)
        return _mirrored(self._buffer[at[:, :, None], at[:, None, :]])

    def square(self, index: IntArray) -> FloatArray:
        """(k, k) the rows and columns of these indices, in their order."""
        low, high = np.minimum(index, index[:, None]), np.maximum(index, index[:, None])
        return np.asarray(self._buffer[high, low])

    def set_front(self, front: FloatArray) -> None:
        """Replaces the pose's columns (n, 6), and so its rows."""
        self._buffer[: self._size, :FRONT] = front

    def subtract(self, a: FloatArray, b: FloatArray) -> None:
        """Takes ``a b^T + b a^T`` off, of (n, m) each: BLAS's syr2k, slab by slab."""
        left, right = np.hstack([a, b]), np.hstack([b, a])
        for start in range(0, self._size, _SLAB):
            stop = min(start + _SLAB, self._size)
            product = self._scratch[: (stop - start) * stop].reshape(stop - start, stop)
            np.matmul(left[start:stop], right[:stop].T, out=product)
            self._buffer[start:stop, :stop] -= product

    def append(self, cross: FloatArray, square: FloatArray) -> None:
        """Adds landmarks: covariances with all so far (n, k) and with each other (k, k)."""
        n, k = self._size, len(square)
        self.reserve((n + k - FRONT) // BLOCK)
        self._buffer[n : n + k, :n] = cross.T
        self._buffer[n : n + k, n : n + k] = square
        self._size = n + k

    def append_independent(self, blocks: FloatArray) -> None:
        """Adds landmarks (k, 3, 3) that are correlated with nothing."""
        n, k = self._size, BLOCK * len(blocks)
        self.reserve((n + k - FRONT) // BLOCK)
        self._buffer[n : n + k, : n + k] = 0.0
        at = n + BLOCK * np.arange(len(blocks))[:, None] + np.arange(BLOCK)
        self._buffer[at[:, :, None], at[:, None, :]] = blocks
        self._size = n + k

    def drop(self, blocks: IntArray) -> IntArray:
        """Removes landmarks; the last ones move into their places.

        Returns:
            (m,) for each remaining block, the number that it had before.
        """
        number = np.arange(self.blocks)
        for hole in sorted(blocks.tolist(), reverse=True):
            self._size -= BLOCK
            number[hole] = number[self.blocks]
            self._move(self._size, FRONT + BLOCK * hole)
        return number[: self.blocks]

    def _move(self, old: int, new: int) -> None:
        """Copies the last block, at row ``old``, over the one at row ``new``."""
        if old == new:
            return
        matrix, end = self._buffer, new + BLOCK
        source = matrix[old : old + BLOCK]
        matrix[new:end, :new] = source[:, :new]
        matrix[new:end, new:end] = source[:, old : old + BLOCK]
        matrix[end:old, new:end] = source[:, end:old].T

    def packed(self) -> FloatArray:
        """The lower triangle, row after row."""
        return np.concatenate([self._buffer[i, : i + 1] for i in range(self._size)])

    @staticmethod
    def unpacked(packed: FloatArray) -> GrowingCovariance:
        """Back from :meth:`packed`."""
        size = (int(np.sqrt(8 * len(packed) + 1)) - 1) // 2
        out = GrowingCovariance(np.zeros((FRONT, FRONT)))
        out.reserve((size - FRONT) // BLOCK)
        out._size = size
        ends = np.cumsum(np.arange(1, size + 1))
        for i, end in enumerate(ends.tolist()):
            out._buffer[i, : i + 1] = packed[end - i - 1 : end]
        return out


def rows_of(blocks: IntArray) -> IntArray:
    """(k, 3) rows of landmark blocks (k,)."""
    return np.asarray(FRONT + BLOCK * np.asarray(blocks)[:, None] + np.arange(BLOCK))


def _mirrored(lower: FloatArray) -> FloatArray:
    """Square matrices (..., k, k) of which the lower triangles count."""
    strict = np.tril(lower, -1)
    return np.asarray(np.tril(lower) + np.swapaxes(strict, -1, -2))
