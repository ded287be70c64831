"""Marginal covariances of a whole graph at once, by sparse elimination of poses and landmarks.

One by one, GTSAM's marginals of 4,000 landmarks take 25 s. Here landmarks are eliminated first, all
together (their block of the information matrix is block-diagonal, 3x3 each), the poses' sparse
system is inverted where poses are linked, and each landmark takes its own covariance back from the
poses that saw it. Where landmarks are few and seen long, they stay in that system.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.linalg import blas, block_diag, lapack, solve_triangular
from scipy.sparse import block_array, bsr_matrix, csc_matrix, csr_matrix, diags_array, identity
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import inverse_spd3
from fgslam.factors.landmark import summed

# ------------------------------------------------------------------------------------------
# Sparse systems of poses in blocks of 6 x 6: solved, and inverted where poses are linked

UNDETERMINED = "the measurements do not determine all variables; no covariances"
_ROUNDING = 16.0 * np.finfo(np.float64).eps  # a pivot that is nothing but rounding
_SPARE = 0.3  # of a group's blocks may be zeros that a smaller group would not hold


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Poses that are eliminated together, by their places in the order.

    Attributes:
        start, stop: their places.
        rows: (r,) ascending places of the later poses that they depend on.
        parent: number of the group of the first of these; -1: there is none.
    """

    start: int
    stop: int
    rows: IntArray
    parent: int

    @property
    def front(self) -> IntArray:
        """Places of all poses in the group's matrix, ascending."""
        return np.concatenate([np.arange(self.start, self.stop), self.rows])


class BlockCholesky:
    """Cholesky factor of a symmetric positive definite matrix, scaled to a unit diagonal.

    Without the scaling, digits would be lost next to poses that are held stiffly.
    """

    def __init__(self, matrix: bsr_matrix, first: IntArray | None = None) -> None:
        """Takes a matrix (6n, 6n) in blocks of 6 x 6 apart.

        Args:
            matrix: what is factored.
            first: (k,) rows of blocks that are eliminated before all others, in this order.

        Raises:
            EstimatorError: it is not positive definite.
        """
        n = matrix.shape[0] // 6
        diagonal = matrix.diagonal()
        if not (diagonal > 0.0).all():
            raise EstimatorError(UNDETERMINED)
        self._scale = np.sqrt(diagonal).reshape(n, 6)
        links = csr_matrix((np.ones(len(matrix.indices)), matrix.indices, matrix.indptr), (n, n))
        self._place = least_degree(links) if first is None else _least_degree_after(first, links)
        self._groups = groups_of(links, self._place)
        self._own: list[FloatArray] = []
        self._below: list[FloatArray] = []
        self._factorise(matrix)

    def solve(self, right: FloatArray) -> FloatArray:
        """(6n, k) the matrix' inverse times (6n, k)."""
        n, k = len(self._place), right.shape[1]
        x = np.empty((n, 6, k))
        x[self._place] = right.reshape(n, 6, k) / self._scale[:, :, None]
        factors = list(zip(self._groups, self._own, self._below, strict=True))
        for group, own, below in factors:
            at = slice(group.start, group.stop)
            here = blas.dtrsm(1.0, own, x[at].reshape(-1, k), lower=1)
            x[at] = here.reshape(-1, 6, k)
            x[group.rows] -= (below @ here).reshape(-1, 6, k)
        for group, own, below in reversed(factors):
            at = slice(group.start, group.stop)
            here = x[at].reshape(-1, k) - below.T @ x[group.rows].reshape(-1, k)
            here = blas.dtrsm(1.0, own, here, lower=1, trans_a=1)
            x[at] = here.reshape(-1, 6, k)
        return np.asarray((x[self._place] / self._scale[:, :, None]).reshape(6 * n, k))

    def inverse_blocks(self, row: IntArray, column: IntArray) -> FloatArray:
        """(k, 6, 6) of the inverse, at poses (k,) that are linked, or the same."""
        names, blocks = self._inverse
        one, other = self._place[row], self._place[column]
        name = np.minimum(one, other) * len(self._place) + np.maximum(one, other)
        out = blocks[np.searchsorted(names, name)]
        turned = one < other
        out[turned] = np.swapaxes(out[turned], 1, 2)
        out /= self._scale[row][:, :, None] * self._scale[column][:, None, :]
        return out

    def _factorise(self, matrix: bsr_matrix) -> None:
        row, column, data, start = self._entries(matrix)
        waiting: dict[int, list[tuple[IntArray, FloatArray]]] = {}
        for number, group in enumerate(self._groups):
            front, size = group.front, 6 * (group.stop - group.start)
            full = np.zeros((len(front), 6, len(front), 6))
            some = slice(start[group.start], start[group.stop])
            at = np.searchsorted(front, row[some])
            full[at, :, column[some] - group.start, :] = data[some]
            flat = full.reshape(6 * len(front), 6 * len(front))
            for rows, update in waiting.pop(number, []):
                for own_row, row_there, own_column, column_there in _slices(front, rows):
                    flat[row_there, column_there] += update[own_row, own_column]
            own, status = lapack.dpotrf(flat[:size, :size], lower=1, clean=1)
            if status != 0 or own.diagonal().min() ** 2 < _ROUNDING:
                raise EstimatorError(UNDETERMINED)
            below = flat[size:, :size]
            if len(group.rows):
                below = blas.dtrsm(1.0, own, below.T, lower=1).T
                update = flat[size:, size:] - below @ below.T
                waiting.setdefault(group.parent, []).append((group.rows, update))
            self._own.append(own)
            self._below.append(np.ascontiguousarray(below))

    def _entries(self, matrix: bsr_matrix) -> tuple[IntArray, IntArray, FloatArray, IntArray]:
        """Lower blocks by places, scaled, column after column, and where each column starts."""
        n = len(self._place)
        of_row = np.repeat(np.arange(n), np.diff(matrix.indptr))
        row, column = self._place[of_row], self._place[matrix.indices]
        chosen = np.flatnonzero(row >= column)
        chosen = chosen[np.argsort(column[chosen], kind="stable")]
        by_row, by_column = self._scale[of_row[chosen]], self._scale[matrix.indices[chosen]]
        data = matrix.data[chosen] / (by_row[:, :, None] * by_column[:, None, :])
        start = np.searchsorted(column[chosen], np.arange(n + 1)).astype(np.int64)
        return row[chosen], column[chosen], data, start

    @cached_property
    def _inverse(self) -> tuple[IntArray, FloatArray]:
        """Names (k,) ascending, of column and row, and blocks (k, 6, 6) of the scaled inverse."""
        n, known = len(self._place), dict[int, FloatArray]()
        names, blocks = [], []
        first = {group.parent: k for k, group in reversed(list(enumerate(self._groups)))}
        for number in range(len(self._groups) - 1, -1, -1):
            group, front = self._groups[number], self._groups[number].front
            size = 6 * (group.stop - group.start)
            whole = np.empty((6 * len(front), 6 * len(front)))
            inverse, _ = lapack.dpotri(self._own[number], lower=1)
            whole[:size, :size] = inverse + np.tril(inverse, -1).T
            if len(group.rows):
                parent = self._groups[group.parent]
                rest, there = whole[size:, size:], known[group.parent]
                for own_row, row_there, own_column, column_there in _slices(
                    parent.front, group.rows
                ):
                    rest[own_row, own_column] = there[row_there, column_there]
                    rest[own_column, own_row] = there[column_there, row_there]
                gain = blas.dtrsm(
                    1.0, self._own[number], self._below[number].T, lower=1, trans_a=1
                ).T
                whole[size:, :size] = -rest @ gain
                whole[:size, size:] = whole[size:, :size].T
                whole[:size, :size] -= gain.T @ whole[size:, :size]
            if first.get(group.parent) == number:  # no group needs it any more
                known.pop(group.parent, None)
            if number in first:
                known[number] = whole
            columns = whole.reshape(len(front), 6, len(front), 6)[:, :, : size // 6]
            blocks.append(columns.transpose(2, 0, 1, 3).reshape(-1, 6, 6))
            names.append((front[: size // 6, None] * n + front).ravel())
        return np.concatenate(names[::-1]), np.concatenate(blocks[::-1])


def _slices(front: IntArray, rows: IntArray) -> Iterator[tuple[slice, slice, slice, slice]]:
    """Where poses (r,) are in a front: pieces of their matrix in one piece there, but those above.

    Of each: own rows, rows there, own columns, columns there.
    """
    at, runs = np.searchsorted(front, rows), list[tuple[slice, slice]]()
    for run in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(at) != 1) + 1):
        first, last, there = int(run[0]), int(run[-1]) + 1, int(at[run[0]])
        runs.append((slice(6 * first, 6 * last), slice(6 * there, 6 * (there + last - first))))
    for number, row in enumerate(runs):
        for column in runs[: number + 1]:
            yield *row, *column


def least_degree(links: csr_matrix) -> IntArray:
    """Places (n,) of rows in an order of least degree of their links (n, n).

    SuperLU finds it; what it takes apart for that is a matrix of ones.
    """
    n = links.shape[0]
    pattern = csc_matrix((-np.ones(links.nnz), links.indices, links.indptr), (n, n))
    found = splu(
        csc_matrix(pattern + 2.0 * n * identity(n)),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.asarray(found.perm_c, np.int64)


def _least_degree_after(first: IntArray, links: csr_matrix) -> IntArray:
    """The same of what is left when rows (k,) have come first."""
    place, chosen = np.empty(links.shape[0], np.int64), links[first]
    rest = np.setdiff1d(np.arange(len(place)), first)
    # A row that is linked with the next one depends on what that depends on.
    alone = np.cumsum(np.append(True, chosen[:, first].diagonal(1)[: len(first) - 1] == 0.0)) - 1
    joined = csr_matrix((np.ones(len(first)), (alone, np.arange(len(first)))))
    seen = (joined @ chosen)[:, rest]
    place[first] = np.arange(len(first))
    place[rest] = len(first) + least_degree((links[rest][:, rest] + seen.T @ seen).tocsr())
    return place


def groups_of(links: csr_matrix, place: IntArray) -> list[Group]:
    """Groups of poses by their places, each before the group that it depends on."""
    hang = _hanging(links, place)
    starts, held = [0], 0
    for j in range(1, len(hang)):
        held += len(hang[j - 1]) + 1
        width = j + 1 - starts[-1]
        filled = width * (len(hang[j]) + 1) + width * (width - 1) // 2
        follows = len(hang[j - 1]) > 0 and hang[j - 1][0] == j
        if not follows or filled > (1.0 + _SPARE) * (held + len(hang[j]) + 1):
            starts.append(j)
            held = 0
    stops = [*starts[1:], len(hang)]
    number = np.repeat(np.arange(len(starts)), np.subtract(stops, starts))
    out = []
    for start, stop in zip(starts, stops, strict=True):
        rows = hang[stop - 1]
        out.append(Group(start, stop, rows, int(number[rows[0]]) if len(rows) else -1))
    return out


def _hanging(links: csr_matrix, place: IntArray) -> list[IntArray]:
    """For each place the later ones that it depends on when all before it are eliminated."""
    n = len(place)
    row = place[np.repeat(np.arange(n), np.diff(links.indptr))]
    column = place[links.indices]
    later = row > column
    order = np.lexsort((row[later], column[later]))
    row, column = row[later][order], column[later][order]
    start = np.searchsorted(column, np.arange(n + 1))
    children: list[list[IntArray]] = [[] for _ in range(n)]
    out: list[IntArray] = []
    for j in range(n):
        own = row[start[j] : start[j + 1]]
        found = np.unique(np.concatenate([own, *children[j]])).astype(np.int64)
        out.append(found)
        if len(found):
            children[found[0]].append(found[1:])
        children[j] = []
    return out


def order(links: csr_matrix) -> tuple[IntArray, int]:
    """Places (n,) of rows that keep linked ones (n, n) near, and how far apart they are at most."""
    found = reverse_cuthill_mckee(links, symmetric_mode=True).astype(np.int64)
    place = np.empty_like(found)
    place[found] = np.arange(len(found))
    row = np.repeat(np.arange(len(place)), np.diff(links.indptr))
    apart = np.abs(place[row] - place[links.indices])
    return place, int(apart.max(initial=1))


# ------------------------------------------------------------------------------------------
# A few numbers on which all poses of a graph may depend: its border


@dataclass(frozen=True, slots=True, eq=False)
class Border:
    """What the p numbers add to the normal equations.

    Attributes:
        coupling: (3m + 6n, p) theirs to the landmarks and poses.
        own: (p, p) their information.
        gradient: (p,).
    """

    coupling: FloatArray
    own: FloatArray
    gradient: FloatArray

    def plus(self, other: Border | None) -> Border:
        """With those of another one before them."""
        if other is None:
            return self
        return Border(
            np.hstack([other.coupling, self.coupling]),
            np.asarray(block_diag(other.own, self.own)),
            np.concatenate([other.gradient, self.gradient]),
        )

    def damped(self, by: float) -> Border:
        """With so many times the diagonal added to itself."""
        return replace(self, own=self.own + by * np.diag(np.diagonal(self.own)))


@dataclass(frozen=True, eq=False)
class Bordered:
    """A solved system with a border more.

    Attributes:
        held: the same with the border held as it is.
        gain: (3m + 6n, p) how landmarks and poses follow the border; then how a border does that
            ``held`` has itself.
        covariance: (p, p) of the border.
        moved: (p,) its step; zero of one that is considered, not estimated.
    """

    held: SolvedSystem
    gain: FloatArray
    covariance: FloatArray
    moved: FloatArray

    @staticmethod
    def of(held: SolvedSystem, gradient: FloatArray, border: Border) -> Bordered:
        """A solved system (its gradient (3m + 6n,)) with the border that was held.

        Raises:
            EstimatorError: the border is not determined.
        """
        gain = held.solve(border.coupling)
        information = border.own + border.coupling.T @ gain
        try:
            root = np.linalg.inv(np.linalg.cholesky(0.5 * (information + information.T)))
        except np.linalg.LinAlgError:
            raise EstimatorError(
                "the measurements do not determine a gyroscope's bias, or nuisance parameters"
            ) from None
        covariance = root.T @ root
        return Bordered(held, gain, covariance, -covariance @ (border.gradient + gain.T @ gradient))

    def step(self) -> FloatArray:
        """(3m + 6n + p,) from where the graph was linearised to its minimum."""
        return np.concatenate([self.held.step() + self.gain @ self.moved, self.moved])

    def solve(self, gradients: FloatArray) -> FloatArray:
        """(3m + 6n + p, c) the steps for other gradients (3m + 6n, c), none of the border's own."""
        moved = -self.covariance @ (self.gain.T @ gradients)
        return np.concatenate([self.held.solve(gradients) + self.gain @ moved, moved])

    def poses(self) -> FloatArray:
        """(n, 6, 6) marginals, in the order of ``pose_keys``."""
        found, first = self.held.poses(), self.held.system.columns
        return found + self._of(self.gain[first : first + 6 * len(found)], 6)

    def pose_columns(self, rows: IntArray) -> FloatArray:
        """(6n, 6k) covariances of all poses and some, by row of ``pose_keys``."""
        held, first = self.held.pose_columns(rows), self.held.system.columns
        gain = self.gain[first : first + len(held)]
        return np.asarray(held + gain @ self.covariance @ gain[_entries_of(rows)].T)

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals, in the order of ``landmark_keys``."""
        return self.held.landmarks() + self._of(self.gain[: self.held.system.columns], 3)

    @property
    def estimated(self) -> FloatArray:
        """(b, b) covariance of the border that the system itself has."""
        if not isinstance(self.held, Bordered):
            return self.covariance
        gain = self.gain[-len(self.held.covariance) :]
        return np.asarray(self.held.estimated + gain @ self.covariance @ gain.T)

    @property
    def system(self) -> LinearSystem:
        """The normal equations."""
        return self.held.system

    def _of(self, gain: FloatArray, size: int) -> FloatArray:
        """(k, size, size) what the border's covariance is in rows (size k, p)."""
        gain = gain.reshape(-1, size, len(self.covariance))
        return np.asarray(gain @ self.covariance @ np.swapaxes(gain, 1, 2))


# ------------------------------------------------------------------------------------------
# Dense symmetric systems: a scaled Cholesky factor, and the inverse


class UndeterminedError(EstimatorError):
    """The measurements do not determine all variables."""


def scaled_cholesky(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lower Cholesky factor of a positive definite matrix scaled to a unit diagonal, and the scale.

    Without the scaling, digits would be lost next to poses that are held stiffly.
    """
    size = np.sqrt(np.maximum(np.diagonal(information), 0.0))
    if not (size > 0.0).all():
        raise UndeterminedError(UNDETERMINED)
    scaled = information / size[:, None] / size
    factor, status = lapack.dpotrf(scaled.T, lower=1, overwrite_a=1)
    if status != 0:
        raise UndeterminedError(UNDETERMINED)
    pivots = np.diagonal(factor)
    if len(pivots) and pivots.min() ** 2 < _ROUNDING:
        raise UndeterminedError(UNDETERMINED)
    return factor, size


def from_cholesky(factor: FloatArray, size: FloatArray) -> FloatArray:
    """The inverse of the matrix that :func:`scaled_cholesky` took apart."""
    if not len(size):  # LAPACK would complain on the terminal
        return np.zeros((0, 0))
    inverse, _ = lapack.dpotri(factor, lower=1)
    return np.asarray((inverse + np.tril(inverse, -1).T) / size[:, None] / size)


# ------------------------------------------------------------------------------------------
# Normal equations with the landmarks eliminated: steps, and covariances of poses and landmarks


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
    """Observations do not determine landmarks: rows (k,) among them."""

    def __init__(self, rows: IntArray) -> None:
        """Rows of the landmarks."""
        super().__init__("a landmark's observations do not determine it")
        self.rows = rows


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
        at = self._r + 6 * row + np.arange(6)
        unit = np.zeros((len(self._size), 6))
        unit[at, np.arange(6)] = 1.0 / self._size[at]
        half = solve_triangular(self._factor, unit, lower=True, check_finite=False)
        out = half.T @ half
        return np.asarray(0.5 * (out + out.T))

    def poses(self, rows: list[int]) -> FloatArray:
        """(6k, 6k) joint covariance of the window's poses in some rows."""
        at = (self._r + 6 * np.array(rows)[:, None] + np.arange(6)).ravel()
        return self._covariance[np.ix_(at, at)]

    def hidden_numbers(self, at: IntArray) -> tuple[FloatArray, FloatArray]:
        """Some of them (k,), and their covariance (k, k)."""
        return self.corner[at], self._covariance[np.ix_(at, at)]

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
        raise UndeterminedLandmarkError(np.flatnonzero(bad))
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


_SEGMENT = 8  # poses of a drive that are eliminated at once, before landmarks
_MOST_TURNS, _EXACT = 12, 0.03  # of conjugate gradients; of the step's length in its deviations
_LEAST = 1e-300
_PAIRS_AT_ONCE = 1 << 16
"""Of poses that see one landmark: a bound for memory."""


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """Normal equations of a graph: half the Hessian of its cost, and the gradient.

    Attributes:
        pose_keys, landmark_keys: ascending.
        poses: (6n, 6n) sparse block of the poses.
        coupling: (6n, 3m) of poses and landmarks, in blocks of 6 x 3.
        landmarks: (m, 3, 3) each landmark's own block.
        links: (3m, 3m) of landmarks and each other, empty but for odd graphs.
        pose_gradient, landmark_gradient: (6n,) and (3m,).
        border: a few numbers that all poses may depend on; None: there are none.
    """

    pose_keys: IntArray
    landmark_keys: IntArray
    poses: csr_matrix
    coupling: bsr_matrix
    landmarks: FloatArray
    links: csr_matrix
    pose_gradient: FloatArray
    landmark_gradient: FloatArray
    border: Border | None = None

    @property
    def columns(self) -> int:
        """How many rows and columns are landmarks'."""
        return 3 * len(self.landmark_keys)

    def times(self) -> Callable[[FloatArray], FloatArray]:
        """The information's product with (3m + 6n, c)."""
        transposed = self.coupling.T

        def product(x: FloatArray) -> FloatArray:
            points, poses = x[: self.columns], x[self.columns :]
            own = (self.landmarks @ points.reshape(-1, 3, x.shape[1])).reshape(points.shape)
            own += transposed @ poses + self.links @ points
            return np.concatenate([own, self.poses @ poses + self.coupling @ points])

        return product

    @property
    def in_pairs(self) -> bsr_matrix:
        """All of the information, in blocks of 6 x 6: landmarks two by two, before poses."""
        own, links, coupling = self.landmarks, self.links.copy(), self.coupling.tocsr(copy=True)
        if len(own) % 2:  # one more, on which nothing depends
            own = np.concatenate([own, np.eye(3)[None]])
            links.resize(3 * len(own), 3 * len(own))
            coupling.resize(coupling.shape[0], 3 * len(own))
        among = block_diagonal(own) + links
        whole = block_array([[among, coupling.T], [coupling, self.poses]], format="csr")
        return whole.tobsr((6, 6))

    def damped(self, by: float) -> LinearSystem:
        """With so many times the diagonal added to itself; unseen landmarks are held."""
        own = self.landmarks.copy()
        every = np.arange(3)
        own[:, every, every] *= 1.0 + by
        own[~own.any(axis=(1, 2))] = np.eye(3)
        poses = self.poses + diags_array(by * self.poses.diagonal()) if by else self.poses
        border = None if self.border is None else self.border.damped(by)
        return replace(self, landmarks=own, poses=poses, border=border)

    @property
    def gradient(self) -> FloatArray:
        """(3m + 6n,) landmarks before poses."""
        return np.concatenate([self.landmark_gradient, self.pose_gradient])


def reduced(system: LinearSystem) -> SolvedSystem:
    """The system with landmarks or poses eliminated first, whichever leaves less to do.

    Raises:
        EstimatorError: the measurements do not determine all variables.
    """
    band = 12 * order(_seen_together(system))[1]
    poses_first = system.links.nnz or min(band, 6 * len(system.pose_keys)) > system.columns
    return with_border(GraphMarginals.of(system, landmarks_first=not poses_first))


def with_border(held: GraphMarginals) -> SolvedSystem:
    """The system with its border, where it has one.

    Raises:
        EstimatorError: the border is not determined.
    """
    border = held.system.border
    return held if border is None else Bordered.of(held, held.system.gradient, border)


@dataclass(frozen=True, eq=False)
class GraphMarginals:
    """A linearised graph: its solution, and covariances.

    Landmarks are eliminated first, each by itself, or poses are: where these are many and landmarks
    few, since a pose depends on what is seen from there and on its neighbours.

    Attributes:
        system: the graph.
        inverse: (m, 3, 3) of each landmark's own block; None where poses are eliminated first.
        factor: of the poses' information (6n, 6n), reduced; or of all of it, in pairs.
        near: the factor is that of another system, much like this one.
    """

    system: LinearSystem
    inverse: FloatArray | None
    factor: BlockCholesky
    near: bool = False

    @staticmethod
    def of(system: LinearSystem, landmarks_first: bool = True) -> GraphMarginals:
        """Eliminates all variables.

        Raises:
            EstimatorError: a landmark is not determined by its observations, or the poses are not.
        """
        if not landmarks_first:
            n, pairs = len(system.pose_keys), (len(system.landmark_keys) + 1) // 2
            kept = np.union1d(_led_back_to(system.poses), np.arange(_SEGMENT, n, _SEGMENT + 1))
            first = pairs + np.setdiff1d(np.arange(n), kept)
            return GraphMarginals(system, None, BlockCholesky(system.in_pairs, first))
        if system.links.nnz:
            raise EstimatorError("landmarks depend on each other directly; no joint elimination")
        inverse = _own_inverses(system)
        information = system.poses.tobsr((6, 6))
        if system.coupling.nnz:
            information = information - _times(system.coupling, inverse) @ system.coupling.T
        return GraphMarginals(system, inverse, BlockCholesky(information))

    def stepping(self, system: LinearSystem) -> GraphMarginals:
        """Another system much like it, by the factor of this one: for steps alone.

        Raises:
            EstimatorError: a landmark is not determined by its observations.
        """
        inverse = None if self.inverse is None else _own_inverses(system)
        return GraphMarginals(system, inverse, self.factor, near=True)

    @property
    def _before(self) -> int:
        """How many blocks of the factor are no poses."""
        return 0 if self.inverse is not None else (len(self.system.landmark_keys) + 1) // 2

    def step(self) -> FloatArray:
        """(3m + 6n,) from where the graph was linearised to its minimum, the border held."""
        return self.solve(self.system.gradient[:, None])[:, 0]

    def solve(self, gradients: FloatArray) -> FloatArray:
        """(3m + 6n, c) the steps for other gradients (3m + 6n, c), the border held.

        Raises:
            EstimatorError: the factor is of a system too unlike this one.
        """
        if not self.near:
            return self._by_factor(gradients)
        times, x, left = self.system.times(), np.zeros_like(gradients), -gradients
        ahead = along = -self._by_factor(left)
        size = first = (left * ahead).sum(axis=0)
        for _ in range(_MOST_TURNS):
            pull = times(along)
            length = size / np.maximum((along * pull).sum(axis=0), _LEAST)
            x, left = x + length * along, left - length * pull
            ahead = -self._by_factor(left)
            size, before = (left * ahead).sum(axis=0), size
            if (size <= _EXACT**2 * first).all():
                return np.asarray(x)
            along = ahead + size / np.maximum(before, _LEAST) * along
        raise EstimatorError("no step by the factor of another system")

    def _by_factor(self, gradients: FloatArray) -> FloatArray:
        """The same of the system whose factor it is, the other's landmarks as they are."""
        s, m, c = self.system, self.system.columns, gradients.shape[1]
        if self.inverse is None:
            none = np.zeros((m % 2 * 3, c))  # of the landmark that makes the last pair
            found = self.factor.solve(np.concatenate([gradients[:m], none, gradients[m:]]))
            return -np.concatenate([found[:m], found[m + len(none) :]])
        own = "mij,mjc->mic", self.inverse
        pull = np.einsum(*own, gradients[:m].reshape(-1, 3, c)).reshape(m, c)
        poses = -self.factor.solve(gradients[m:] - s.coupling @ pull)
        follows = (s.coupling.T @ poses).reshape(-1, 3, c)
        landmarks = -pull - np.einsum(*own, follows).reshape(m, c)
        return np.concatenate([landmarks, poses])

    def poses(self) -> FloatArray:
        """(n, 6, 6) marginals, in the order of ``pose_keys``."""
        every = self._before + np.arange(len(self.system.pose_keys))
        return self.factor.inverse_blocks(every, every)

    def pose_columns(self, rows: IntArray) -> FloatArray:
        """(6n, 6k) covariances of all poses and some, by row of ``pose_keys``."""
        first = 6 * self._before
        unit = np.zeros((first + 6 * len(self.system.pose_keys), 6 * len(rows)))
        unit[first + _entries_of(rows), np.arange(6 * len(rows))] = 1.0
        return self.factor.solve(unit)[first:]

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals, in the order of ``landmark_keys``."""
        if self.inverse is None:
            every = np.arange(self._before)
            pairs = self.factor.inverse_blocks(every, every)
            own = np.stack([pairs[:, :3, :3], pairs[:, 3:, 3:]], axis=1).reshape(-1, 3, 3)
            return own[: len(self.system.landmark_keys)]
        coupling = _times(self.system.coupling, self.inverse)
        pose = np.repeat(np.arange(len(self.system.pose_keys)), np.diff(coupling.indptr))
        order = np.argsort(coupling.indices, kind="stable")
        pose, point, gain = pose[order], coupling.indices[order], coupling.data[order]
        half, m = np.zeros_like(self.inverse), len(self.inverse)
        for one, other in _pairs(point, m):
            covariance = self.factor.inverse_blocks(pose[one], pose[other])
            covariance[one == other] *= 0.5
            half += summed(point[one], np.swapaxes(gain[one], 1, 2) @ covariance @ gain[other], m)
        return np.asarray(self.inverse + half + np.swapaxes(half, 1, 2))


def _own_inverses(system: LinearSystem) -> FloatArray:
    """(m, 3, 3) of each landmark's own block."""
    with np.errstate(all="ignore"):
        inverse = inverse_spd3(system.landmarks)
    if not (np.isfinite(inverse).all() and (inverse[:, [0, 1, 2], [0, 1, 2]] > 0.0).all()):
        raise EstimatorError("a landmark's observations do not determine it; no covariances")
    return inverse


def _seen_together(system: LinearSystem) -> csr_matrix:
    """(n, n) which poses are linked, by a factor or by a landmark."""
    seen, own = system.coupling, system.poses.tobsr((6, 6))
    n, m = len(system.pose_keys), len(system.landmark_keys)
    by = csr_matrix((np.ones(len(seen.indices)), seen.indices, seen.indptr), (n, m))
    return by @ by.T + csr_matrix((np.ones(len(own.indices)), own.indices, own.indptr), (n, n))


def _times(coupling: bsr_matrix, blocks: FloatArray) -> bsr_matrix:
    """Blocks of 6 x 3, each times its landmark's (m, 3, 3)."""
    data = coupling.data @ blocks[coupling.indices]
    return bsr_matrix((data, coupling.indices, coupling.indptr), coupling.shape)


def _pairs(group: IntArray, groups: int) -> Iterator[tuple[IntArray, IntArray]]:
    """Pairs of rows of one group, each once, and each row with itself; a few groups a time.

    Groups (k,) are in ascending order; the first row of a pair is not after the second.
    """
    size = np.bincount(group, minlength=groups)
    first = np.concatenate([[0], np.cumsum(size)])
    until = np.cumsum(size * (size + 1) // 2)
    low = 0
    while low < groups:
        done = until[low - 1] if low else 0
        high = max(low + 1, int(np.searchsorted(until, done + _PAIRS_AT_ONCE, "right")))
        rows = np.arange(first[low], first[high])
        repeated = first[group[rows] + 1] - rows
        one = np.repeat(rows, repeated)
        yield one, one + np.arange(len(one)) - np.repeat(np.cumsum(repeated) - repeated, repeated)
        low = high


def _entries_of(rows: IntArray) -> IntArray:
    """(6k,) entries of poses (k,)."""
    return np.asarray((6 * rows[:, None] + np.arange(6)).ravel())


def _led_back_to(matrix: csr_matrix) -> IntArray:
    """Poses that share a factor with one that is no neighbour: the earlier one of each pair."""
    entries = matrix.tocoo()
    one, other = entries.row // 6, entries.col // 6
    return np.unique(np.minimum(one, other)[np.abs(one - other) > 1]).astype(np.int64)


def block_diagonal(blocks: FloatArray) -> csr_matrix:
    """Sparse (sm, sm) matrix of diagonal blocks (m, s, s)."""
    m, size, _ = blocks.shape
    if not m:
        return csr_matrix((0, 0))
    return bsr_matrix((blocks, np.arange(m), np.arange(m + 1)), (size * m, size * m)).tocsr()


SolvedSystem: TypeAlias = GraphMarginals | Bordered
"""A solved system, landmarks (3m) before poses (6n), then a border where it has one."""
