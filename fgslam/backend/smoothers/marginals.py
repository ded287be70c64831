"""Marginal covariances of a whole graph at once, from its reduced pose system.

One by one, GTSAM's marginals of 4,000 landmarks take 25 s. Here landmarks are eliminated first, all
together (their block of the information matrix is block-diagonal, 3x3 each), the poses' dense
system is inverted, and each landmark takes its own covariance back from the poses that saw it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, lapack, solve_triangular
from scipy.sparse import csc_matrix, csr_matrix

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import inverse_spd3
from fgslam.factors.graphs import is_pose

_UNDETERMINED = "the measurements do not determine all variables; no covariances"


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """A linearised graph: sparse information matrix, landmarks before poses, keys ascending."""

    pose_keys: IntArray
    landmark_keys: IntArray
    information: csr_matrix

    @property
    def columns(self) -> int:
        """How many rows and columns are landmarks'."""
        return 3 * len(self.landmark_keys)

    @staticmethod
    def of(graph: Any, values: Any) -> LinearSystem:
        """Linearises a nonlinear graph at ``values``; robust kernels weigh as they do there."""
        keys = np.array(list(values.keys()), np.uint64)
        poses = np.array([is_pose(int(key)) for key in keys], np.bool_)
        size = 3 * int((~poses).sum()) + 6 * int(poses.sum())
        information = _information(graph.linearize(values), size)
        return LinearSystem(
            keys[poses].astype(np.int64), keys[~poses].astype(np.int64), information
        )


def marginals_of(graph: Any, values: Any) -> GraphMarginals | ChainMarginals:
    """Marginals of a graph of poses in a chain and landmarks; the larger group goes first.

    Raises:
        EstimatorError: the measurements do not determine all variables.
    """
    system = LinearSystem.of(graph, values)
    if 6 * len(system.pose_keys) > system.columns:
        return ChainMarginals.of(system)
    return GraphMarginals.of(system)


@dataclass(frozen=True, eq=False)
class GraphMarginals:
    """Covariances of poses and landmarks of a linearised graph.

    Attributes:
        pose_keys, landmark_keys: ascending.
        landmark_information: (m, 3, 3) each landmark's own block.
        coupling: (6n, 3m) sparse block of poses and landmarks.
        pose_information: (6n, 6n) reduced: landmarks eliminated.
    """

    pose_keys: IntArray
    landmark_keys: IntArray
    landmark_information: FloatArray
    coupling: csc_matrix
    pose_information: FloatArray

    @staticmethod
    def of(system: LinearSystem) -> GraphMarginals:
        """Eliminates the landmarks.

        Raises:
            EstimatorError: a landmark is not determined by its observations.
        """
        columns, information = system.columns, system.information
        own = _diagonal_blocks(information[:columns, :columns])
        if information[:columns, :columns].nnz > 9 * len(own):
            raise EstimatorError("landmarks depend on each other directly; no joint elimination")
        coupling = information[columns:, :columns].tocsc()
        reduced = information[columns:, columns:].toarray()
        with np.errstate(all="ignore"):
            inverse = inverse_spd3(own)
        if not np.isfinite(inverse).all():
            raise EstimatorError("a landmark's observations do not determine it; no covariances")
        if columns:
            eliminated = coupling @ _block_diagonal(inverse) @ coupling.T
            reduced -= eliminated.toarray()
        return GraphMarginals(system.pose_keys, system.landmark_keys, own, coupling, reduced)

    @cached_property
    def pose_covariance(self) -> FloatArray:
        """(6n, 6n) joint covariance of all poses.

        Raises:
            EstimatorError: the poses are not determined.
        """
        return _from_cholesky(*_scaled_cholesky(self.pose_information))

    def poses(self) -> FloatArray:
        """(n, 6, 6) marginals, in the order of ``pose_keys``."""
        n = len(self.pose_keys)
        blocks = self.pose_covariance.reshape(n, 6, n, 6)
        every = np.arange(n)
        return np.asarray(blocks[every, :, every, :])

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals, in the order of ``landmark_keys``."""
        inverse = inverse_spd3(self.landmark_information)
        out = inverse.copy()
        covariance, start = self.pose_covariance, self.coupling.indptr
        for m in range(len(out)):
            rows, seen = self._seen_by(start, m)
            if len(rows):
                gain = seen @ inverse[m]
                out[m] += gain.T @ covariance[rows[:, None], rows] @ gain
        return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))

    def joint(self, pose: int, landmarks: IntArray) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of one pose and landmarks, by row of the key lists."""
        k = len(landmarks)
        columns = (3 * landmarks[:, None] + np.arange(3)).ravel()
        rows = 6 * pose + np.arange(6)
        inverse = inverse_spd3(self.landmark_information[landmarks])
        gain = np.zeros((6 * len(self.pose_keys), 6 + 3 * k))
        gain[rows, np.arange(6)] = 1.0
        seen = self.coupling[:, columns].toarray().reshape(len(gain), k, 3)
        gain[:, 6:] = -np.einsum("pki,kij->pkj", seen, inverse).reshape(len(gain), 3 * k)
        out = gain.T @ self.pose_covariance @ gain
        at = 6 + 3 * np.arange(k)[:, None] + np.arange(3)
        out[at[:, :, None], at[:, None, :]] += inverse
        return np.asarray(0.5 * (out + out.T))

    def _seen_by(self, start: IntArray, m: int) -> tuple[IntArray, FloatArray]:
        """Rows of the poses that saw landmark ``m``, and their coupling (rows, 3)."""
        low, high = start[3 * m], start[3 * m + 3]
        rows, at = np.unique(self.coupling.indices[low:high], return_inverse=True)
        column = np.repeat(np.arange(3), np.diff(start[3 * m : 3 * m + 4]))
        seen = np.zeros((len(rows), 3))
        seen[at, column] = self.coupling.data[low:high]
        return rows, seen


@dataclass(frozen=True, eq=False)
class ChainMarginals:
    """The same where poses are many and landmarks few: the chain of poses is eliminated first.

    Poses are tied to their neighbours by odometry, so their block is a band, and its Cholesky
    decomposition and the diagonal blocks of its inverse cost a constant a pose. The few poses to
    which a loop leads back are kept with the landmarks instead: without them the rest is a chain.

    Attributes:
        pose_keys, landmark_keys: ascending.
        own: (n, 6, 6) covariances of the poses given the landmarks and the poses kept with them.
        gain: (6n, 3m + 6k) how the poses' mean follows those, negated.
        kept_covariance: (3m + 6k, 3m + 6k) joint of all landmarks and the k poses kept.
    """

    pose_keys: IntArray
    landmark_keys: IntArray
    own: FloatArray
    gain: FloatArray
    kept_covariance: FloatArray

    @staticmethod
    def of(system: LinearSystem) -> ChainMarginals:
        """Eliminates the poses.

        Raises:
            EstimatorError: the poses are not determined.
        """
        columns, information = system.columns, system.information
        apart = _led_back_to(information[columns:, columns:])
        poses = columns + np.arange(6 * len(system.pose_keys)).reshape(-1, 6)
        chain = np.delete(poses, apart, axis=0).ravel()
        kept = np.concatenate([np.arange(columns), poses[apart].ravel()])
        band, size = _scaled_band(information[chain][:, chain])
        try:
            factor = cholesky_banded(band, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            raise EstimatorError(_UNDETERMINED) from None
        coupling = information[chain][:, kept].toarray() / size[:, None]
        gain = cho_solve_banded((factor, True), coupling, check_finite=False)
        reduced = information[kept][:, kept].toarray() - coupling.T @ gain
        covariance = np.empty((0, 0))
        if len(kept):
            covariance = _from_cholesky(*_scaled_cholesky(reduced))
        blocks = size.reshape(-1, 6)
        own = np.zeros((len(poses), 6, 6))
        own[np.delete(np.arange(len(poses)), apart)] = _inverse_blocks(factor) / (
            blocks[:, :, None] * blocks[:, None, :]
        )
        follows = np.zeros((6 * len(poses), len(kept)))
        follows[chain - columns] = gain / size[:, None]
        follows[poses[apart].ravel() - columns, np.arange(columns, len(kept))] = -1.0
        return ChainMarginals(system.pose_keys, system.landmark_keys, own, follows, covariance)

    def poses(self) -> FloatArray:
        """(n, 6, 6) marginals, in the order of ``pose_keys``."""
        gain = self.gain.reshape(len(self.own), 6, -1)
        return np.asarray(self.own + gain @ self.kept_covariance @ np.swapaxes(gain, 1, 2))

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals, in the order of ``landmark_keys``."""
        m = len(self.landmark_keys)
        every = np.arange(m)
        among = self.kept_covariance[: 3 * m, : 3 * m]
        return np.asarray(among.reshape(m, 3, m, 3)[every, :, every, :])

    def joint(self, pose: int, landmarks: IntArray) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of one pose and landmarks, by row of the key lists."""
        columns = (3 * landmarks[:, None] + np.arange(3)).ravel()
        gain = self.gain[6 * pose : 6 * pose + 6]
        cross = -(gain @ self.kept_covariance[:, columns])
        own = self.own[pose] + gain @ self.kept_covariance @ gain.T
        among = self.kept_covariance[np.ix_(columns, columns)]
        return np.block([[own, cross], [cross.T, among]])


class UndeterminedError(EstimatorError):
    """The measurements do not determine all variables; ``row`` of the first one's, as ordered."""

    def __init__(self, row: int, message: str) -> None:
        """Row of the information matrix and the message."""
        super().__init__(message)
        self.row = row


class DenseMarginals:
    """Covariances of a small graph, whatever its factors: one dense Cholesky decomposition."""

    def __init__(self, graph: Any, values: Any) -> None:
        """Linearises a graph at ``values``.

        Raises:
            EstimatorError: the variables are not determined.
        """
        information, _ = graph.linearize(values).hessian()
        self._start: dict[int, int] = {}
        rows = 0
        for key in list(values.keys()):  # ascending, as the rows of the information matrix
            self._start[key] = rows
            rows += 6 if is_pose(key) else 3
        try:
            self._factor, self._size = _scaled_cholesky(information)
        except UndeterminedError as error:
            near = max(key for key, start in self._start.items() if start <= error.row)
            raise UndeterminedError(error.row, f"indeterminate near variable {near}") from None

    def pose(self, key: int) -> FloatArray:
        """(6, 6) marginal of a pose."""
        return self.joint(key, [])

    def landmarks(self, keys: list[int]) -> FloatArray:
        """(k, 3, 3) marginals of landmarks."""
        at = np.array([self._start[key] for key in keys], np.int64)[:, None] + np.arange(3)
        covariance = _from_cholesky(self._factor, self._size)
        return np.asarray(covariance[at[:, :, None], at[:, None, :]])

    def joint(self, pose: int, landmarks: list[int]) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of a pose and landmarks, in that order."""
        rows = [np.arange(6) + self._start[pose]]
        rows += [np.arange(3) + self._start[key] for key in landmarks]
        at = np.concatenate(rows)
        unit = np.zeros((len(self._size), len(at)))
        unit[at, np.arange(len(at))] = 1.0 / self._size[at]
        half = solve_triangular(self._factor, unit, lower=True, check_finite=False)
        return np.asarray(half.T @ half)


def _led_back_to(matrix: csr_matrix) -> IntArray:
    """Poses that share a factor with one that is no neighbour: the earlier one of each pair."""
    entries = matrix.tocoo()
    one, other = entries.row // 6, entries.col // 6
    return np.unique(np.minimum(one, other)[np.abs(one - other) > 1]).astype(np.int64)


def _scaled_band(matrix: csr_matrix) -> tuple[FloatArray, FloatArray]:
    """Lower band (12, 6n) of a chain's information, scaled to a unit diagonal, and the scale."""
    entries = matrix.tocoo()
    distance = entries.row - entries.col
    size = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
    if not (size > 0.0).all():
        raise EstimatorError(_UNDETERMINED)
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


def _scaled_cholesky(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lower Cholesky factor of a positive definite matrix scaled to a unit diagonal, and the scale.

    Without the scaling, digits would be lost beside poses that are held stiffly.
    """
    size = np.sqrt(np.maximum(np.diagonal(information), 0.0))
    if not (size > 0.0).all():
        raise UndeterminedError(int(np.argmin(size > 0.0)), _UNDETERMINED)
    factor, status = lapack.dpotrf(information / np.outer(size, size), lower=1, overwrite_a=1)
    if status != 0:
        raise UndeterminedError(int(status) - 1, _UNDETERMINED)
    return factor, size


def _from_cholesky(factor: FloatArray, size: FloatArray) -> FloatArray:
    """The inverse of the matrix that :func:`_scaled_cholesky` took apart."""
    inverse, _ = lapack.dpotri(factor, lower=1)
    lower = np.tril(inverse)
    return np.asarray((lower + np.tril(inverse, -1).T) / np.outer(size, size))


def _information(linear: Any, columns: int) -> csr_matrix:
    """Sparse information matrix of a Gaussian graph; columns in the order of the keys."""
    row, column, value = linear.sparseJacobian_()
    rows = int(row.max()) if len(row) else 0
    # GTSAM counts from 1 and puts the right-hand side in the last column.
    inside = column <= columns
    shape = (rows, columns)
    jacobian = csr_matrix(
        (value[inside], (row[inside].astype(np.int64) - 1, column[inside].astype(np.int64) - 1)),
        shape,
    )
    return (jacobian.T @ jacobian).tocsr()


def _diagonal_blocks(matrix: csr_matrix) -> FloatArray:
    """The (m, 3, 3) diagonal blocks of a sparse matrix (3m, 3m)."""
    entries = matrix.tocoo()
    out = np.zeros((matrix.shape[0] // 3, 3, 3))
    inside = entries.row // 3 == entries.col // 3
    row, column = entries.row[inside], entries.col[inside]
    out[row // 3, row % 3, column % 3] = entries.data[inside]
    return out


def _block_diagonal(blocks: FloatArray) -> csr_matrix:
    """Sparse (3m, 3m) matrix of diagonal blocks (m, 3, 3)."""
    m = len(blocks)
    columns = (3 * np.arange(m)[:, None, None] + np.arange(3)[None, None, :]).repeat(3, axis=1)
    return csr_matrix((blocks.ravel(), columns.ravel(), 3 * np.arange(3 * m + 1)), (3 * m, 3 * m))
