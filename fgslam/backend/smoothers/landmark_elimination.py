"""Normal equations with the landmarks eliminated: steps, and covariances of poses and landmarks.

Landmarks are independent of each other given the rest, so that each is a block of three rows, and
all are factored at once by plain array operations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack, solve_triangular

from fgslam.backend.smoothers.dense_cholesky import (
    UndeterminedError,
    from_cholesky,
    scaled_cholesky,
)
from fgslam.core.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """A quadratic in a corner (hidden numbers and poses) and landmarks.

    Attributes:
        corner: (c, c) information of the corner, hidden numbers first.
        corner_gradient: (c,).
        own: (m, 3, 3) each landmark's.
        gradient: (m, 3).
        coupling: (m, 3, 6n) of landmarks and the poses, which are the last of the corner.
        tied: (p,) rows of the landmarks that depend on hidden numbers, too.
        hidden: (p, 3, c - 6n) their coupling to those.
    """

    corner: FloatArray
    corner_gradient: FloatArray
    own: FloatArray
    gradient: FloatArray
    coupling: FloatArray
    tied: IntArray
    hidden: FloatArray


class UndeterminedLandmarkError(UndeterminedError):
    """A landmark's observations do not determine it; ``row`` among the landmarks."""


class Eliminated:
    """Equations factored once: the step to the minimum, and covariances there."""

    def __init__(self, equations: Equations) -> None:
        """Eliminates the landmarks and factors what is left.

        Raises:
            UndeterminedLandmarkError: one landmark is not determined.
            UndeterminedError: the corner is not.
        """
        e, self._tied = equations, equations.tied
        self._root = _roots(e.own)
        m, poses = len(e.own), e.coupling.shape[2]
        self._r: int = len(e.corner) - poses
        r = self._r
        self._by_pose = _forward(self._root, e.coupling)
        self._by_hidden = _forward(self._root[:, e.tied], e.hidden)
        half = _forward(self._root, e.gradient[:, :, None])
        flat, tied = (
            self._by_pose.reshape(3 * m, poses),
            self._by_hidden.reshape(3 * len(e.tied), r),
        )
        corner, right = e.corner.copy(), e.corner_gradient.copy()
        corner[r:, r:] -= flat.T @ flat
        corner[:r, :r] -= tied.T @ tied
        corner[:r, r:] -= tied.T @ self._by_pose[e.tied].reshape(len(tied), poses)
        corner[r:, :r] = corner[:r, r:].T
        right[r:] -= flat.T @ half.ravel()
        right[:r] -= tied.T @ half[e.tied].ravel()
        self._factor, self._size = scaled_cholesky(corner)
        self.corner = -lapack.dpotrs(self._factor, right / self._size, lower=1)[0] / self._size
        along = self._along(self.corner[:, None])
        self.points = -_backward(self._root, half + along)[:, :, 0]
        fall = e.corner_gradient @ self.corner + float((e.gradient * self.points).sum())
        self.decrement = float(np.sqrt(max(-fall, 0.0)))
        """Length of the step in its own deviations."""

    @property
    def hidden(self) -> int:
        """How many hidden numbers there are."""
        return self._r

    def pose(self, row: int) -> FloatArray:
        """(6, 6) marginal of the window's pose in a row."""
        return self.joint(row, np.empty(0, np.int64))

    def joint(self, pose: int, landmarks: IntArray) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of one pose and landmarks, by rows."""
        k, at = len(landmarks), self._r + 6 * pose + np.arange(6)
        gain = np.zeros((len(self._size), 6 + 3 * k))
        gain[at, np.arange(6)] = 1.0
        for column, row in enumerate(landmarks.tolist()):
            gain[:, 6 + 3 * column : 9 + 3 * column] = -self._follows(row).T
        half = solve_triangular(
            self._factor, gain / self._size[:, None], lower=True, check_finite=False
        )
        out = half.T @ half
        own = self._own(landmarks)
        for column in range(k):
            rows = slice(6 + 3 * column, 9 + 3 * column)
            out[rows, rows] += own[column]
        return np.asarray(0.5 * (out + out.T))

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals of all landmarks."""
        covariance = self._covariance
        r = self._r
        follows = _backward(self._root, self._by_pose)
        out = self._own(np.arange(len(follows)))
        out += follows @ covariance[r:, r:] @ np.swapaxes(follows, 1, 2)
        if len(self._tied):
            tied = _backward(self._root[:, self._tied], self._by_hidden)
            cross = tied @ covariance[:r, r:] @ np.swapaxes(follows[self._tied], 1, 2)
            own = tied @ covariance[:r, :r] @ np.swapaxes(tied, 1, 2)
            out[self._tied] += own + cross + np.swapaxes(cross, 1, 2)
        return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))

    @cached_property
    def _covariance(self) -> FloatArray:
        return from_cholesky(self._factor, self._size)

    def _own(self, landmarks: IntArray) -> FloatArray:
        """(k, 3, 3) covariances of landmarks given the corner."""
        eye = np.broadcast_to(np.eye(3), (len(landmarks), 3, 3))
        inverse = _forward(self._root[:, landmarks], eye)
        return np.asarray(np.swapaxes(inverse, 1, 2) @ inverse)

    def _follows(self, row: int) -> FloatArray:
        """(3, c) how a landmark's mean follows the corner, negated."""
        at = np.array([row])
        whole = np.zeros((1, 3, len(self._size)))
        whole[0, :, self._r :] = self._by_pose[row]
        tied = np.flatnonzero(self._tied == row)
        if len(tied):
            whole[0, :, : self._r] = self._by_hidden[tied[0]]
        return np.asarray(_backward(self._root[:, at], whole)[0])

    def _along(self, corner: FloatArray) -> FloatArray:
        """(m, 3, 1) how the landmarks' halves follow a step of the corner (c, 1)."""
        out = self._by_pose @ corner[self._r :]
        out[self._tied] += self._by_hidden @ corner[: self._r]
        return np.asarray(out)


def _roots(own: FloatArray) -> FloatArray:
    """(6, m) entries 00, 10, 11, 20, 21, 22 of the lower Cholesky factors of (m, 3, 3)."""
    out = np.empty((6, len(own)))
    with np.errstate(all="ignore"):
        out[0] = np.sqrt(own[:, 0, 0])
        out[1], out[3] = own[:, 1, 0] / out[0], own[:, 2, 0] / out[0]
        out[2] = np.sqrt(own[:, 1, 1] - out[1] ** 2)
        out[4] = (own[:, 2, 1] - out[3] * out[1]) / out[2]
        out[5] = np.sqrt(own[:, 2, 2] - out[3] ** 2 - out[4] ** 2)
    bad = ~np.isfinite(out).all(axis=0) | ~(out[[0, 2, 5]] > 0.0).all(axis=0)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise UndeterminedLandmarkError(row, "a landmark's observations do not determine it")
    return out


def _forward(root: FloatArray, right: FloatArray) -> FloatArray:
    """(m, 3, c) solutions of lower triangular systems."""
    a, b, c, d, e, f = root[:, :, None]
    out = np.empty(right.shape)
    out[:, 0] = right[:, 0] / a
    out[:, 1] = (right[:, 1] - b * out[:, 0]) / c
    out[:, 2] = (right[:, 2] - d * out[:, 0] - e * out[:, 1]) / f
    return out


def _backward(root: FloatArray, right: FloatArray) -> FloatArray:
    """(m, 3, c) solutions of the transposed systems."""
    a, b, c, d, e, f = root[:, :, None]
    out = np.empty(right.shape)
    out[:, 2] = right[:, 2] / f
    out[:, 1] = (right[:, 1] - e * out[:, 2]) / c
    out[:, 0] = (right[:, 0] - b * out[:, 1] - d * out[:, 2]) / a
    return out
