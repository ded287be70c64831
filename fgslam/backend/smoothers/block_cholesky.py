"""Sparse systems of poses in blocks of 6 x 6: solved, and inverted where poses are linked.

Poses are eliminated in an order of least degree, so that a drive through many rooms, that comes
back again and again, leaves little that is linked by the elimination alone. Poses that then hang on
the same others form a group, and a group's elimination is a few operations on one dense matrix
(multifrontal; Duff and Reid 1983).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack, solve_triangular
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix, identity
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import splu

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError

_UNDETERMINED = "the measurements do not determine all variables; no covariances"
_SPARE = 0.3  # of a group's blocks may be zeros that a smaller group would not hold


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Poses that are eliminated together, by their places in the order.

    Attributes:
        start, stop: their places.
        rows: (r,) ascending places of the later poses that they hang on.
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
        links = csr_matrix((np.ones(len(matrix.indices)), matrix.indices, matrix.indptr), (n, n))
        self._place = least_degree(links)
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
            here = solve_triangular(own, x[at].reshape(-1, k), lower=True, check_finite=False)
            x[at] = here.reshape(-1, 6, k)
            x[group.rows] -= (below @ here).reshape(-1, 6, k)
        for group, own, below in reversed(factors):
            at = slice(group.start, group.stop)
            here = x[at].reshape(-1, k) - below.T @ x[group.rows].reshape(-1, k)
            here = solve_triangular(own, here, lower=True, trans=1, check_finite=False)
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
                among = _expanded(np.searchsorted(front, rows))
                flat[among[:, None], among] += update
            own, status = lapack.dpotrf(flat[:size, :size], lower=1, clean=1)
            if status != 0:
                raise EstimatorError(_UNDETERMINED)
            below = flat[size:, :size]
            if len(group.rows):
                below = solve_triangular(own, below.T, lower=True, check_finite=False).T
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
                among = _expanded(np.searchsorted(parent.front, group.rows))
                rest = known[group.parent][among[:, None], among]
                gain = solve_triangular(
                    self._own[number], self._below[number].T, lower=True, trans=1
                ).T
                whole[size:, size:], whole[size:, :size] = rest, -rest @ gain
                whole[:size, size:] = whole[size:, :size].T
                whole[:size, :size] -= gain.T @ whole[size:, :size]
            if first.get(group.parent) == number:  # nobody asks for it any more
                known.pop(group.parent, None)
            if number in first:
                known[number] = whole
            columns = whole.reshape(len(front), 6, len(front), 6)[:, :, : size // 6]
            blocks.append(columns.transpose(2, 0, 1, 3).reshape(-1, 6, 6))
            names.append((front[: size // 6, None] * n + front).ravel())
        return np.concatenate(names[::-1]), np.concatenate(blocks[::-1])


def _expanded(places: IntArray) -> IntArray:
    """Rows of blocks of six."""
    return (6 * places[:, None] + np.arange(6)).ravel()


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


def groups_of(links: csr_matrix, place: IntArray) -> list[Group]:
    """Groups of poses by their places, each before the group that it hangs on."""
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
    """For each place the later ones that it hangs on when all before it are eliminated."""
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
