"""Marginal covariances of a whole graph at once, from its reduced pose system.

One by one, GTSAM's marginals of 4,000 landmarks take 25 s. Here landmarks are eliminated first, all
together (their block of the information matrix is block-diagonal, 3x3 each), the poses' dense
system is inverted, and each landmark takes its own covariance back from the poses that saw it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_array, bsr_matrix, csr_matrix, diags_array

from fgslam.backend.smoothers.block_cholesky import BlockCholesky, order
from fgslam.backend.smoothers.border import Border, Bordered
from fgslam.backend.smoothers.dense_cholesky import DenseFactor
from fgslam.backend.smoothers.stretches import Stretch
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import inverse_spd3
from fgslam.factors.landmark import summed

_POSES_A_LANDMARK = 4
"""How many times more numbers landmarks have than the poses that cut a long chain: cuts make each
stretch see little, and the system that is left larger."""
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

    @property
    def information(self) -> csr_matrix:
        """All of it, landmarks before poses."""
        own = block_diagonal(self.landmarks) + self.links
        coupling = self.coupling.tocsr()
        return block_array([[own, coupling.T], [coupling, self.poses]], format="csr")

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


def reduced(system: LinearSystem) -> GraphMarginals | ChainMarginals | Bordered:
    """The system with one group of variables eliminated, whichever leaves less to do.

    Raises:
        EstimatorError: the measurements do not determine all variables.
    """
    band = 12 * order(_seen_together(system))[1]
    chain = system.links.nnz or min(band, 6 * len(system.pose_keys)) > system.columns
    return with_border(ChainMarginals.of(system) if chain else GraphMarginals.of(system))


def with_border(
    held: GraphMarginals | ChainMarginals,
) -> GraphMarginals | ChainMarginals | Bordered:
    """The system with its border, where it has one.

    Raises:
        EstimatorError: the border is not determined.
    """
    border = held.system.border
    return held if border is None else Bordered.of(held, held.system.gradient, border)


@dataclass(frozen=True, eq=False)
class GraphMarginals:
    """A linearised graph without its landmarks: its solution, and covariances.

    Attributes:
        system: the graph.
        inverse: (m, 3, 3) of each landmark's own block.
        factor: of the poses' information (6n, 6n), reduced.
    """

    system: LinearSystem
    inverse: FloatArray
    factor: BlockCholesky

    @staticmethod
    def of(system: LinearSystem, factor: BlockCholesky | None = None) -> GraphMarginals:
        """Eliminates the landmarks.

        Args:
            system: the graph.
            factor: that of a system much like it, where steps are all that is asked for.

        Raises:
            EstimatorError: a landmark is not determined by its observations, or the poses are not.
        """
        if system.links.nnz:
            raise EstimatorError("landmarks depend on each other directly; no joint elimination")
        with np.errstate(all="ignore"):
            inverse = inverse_spd3(system.landmarks)
        if not (np.isfinite(inverse).all() and (inverse[:, [0, 1, 2], [0, 1, 2]] > 0.0).all()):
            raise EstimatorError("a landmark's observations do not determine it; no covariances")
        if factor is not None:
            return GraphMarginals(system, inverse, factor)
        information = system.poses.tobsr((6, 6))
        if system.coupling.nnz:
            information = information - _times(system.coupling, inverse) @ system.coupling.T
        return GraphMarginals(system, inverse, BlockCholesky(information))

    def step(self) -> FloatArray:
        """(3m + 6n,) from where the graph was linearised to its minimum, the border held."""
        return self.solve(self.system.gradient[:, None])[:, 0]

    def solve(self, gradients: FloatArray) -> FloatArray:
        """(3m + 6n, c) the steps for other gradients (3m + 6n, c), the border held."""
        s, m, c = self.system, self.system.columns, gradients.shape[1]
        own = "mij,mjc->mic", self.inverse
        pull = np.einsum(*own, gradients[:m].reshape(-1, 3, c)).reshape(m, c)
        poses = -self.factor.solve(gradients[m:] - s.coupling @ pull)
        follows = (s.coupling.T @ poses).reshape(-1, 3, c)
        landmarks = -pull - np.einsum(*own, follows).reshape(m, c)
        return np.concatenate([landmarks, poses])

    def poses(self) -> FloatArray:
        """(n, 6, 6) marginals, in the order of ``pose_keys``."""
        every = np.arange(len(self.system.pose_keys))
        return self.factor.inverse_blocks(every, every)

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals, in the order of ``landmark_keys``."""
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

    def joint(self, pose: int, landmarks: IntArray) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of one pose and landmarks, by row of the key lists."""
        k, s = len(landmarks), self.system
        gain = np.zeros((6 * len(s.pose_keys), 6 + 3 * k))
        gain[6 * pose + np.arange(6), np.arange(6)] = 1.0
        columns = (3 * landmarks[:, None] + np.arange(3)).ravel()
        seen = s.coupling.tocsc()[:, columns].toarray().reshape(len(gain), k, 3)
        inverse = self.inverse[landmarks]
        gain[:, 6:] = -np.einsum("pki,kij->pkj", seen, inverse).reshape(len(gain), 3 * k)
        out = gain.T @ self.factor.solve(gain)
        at = 6 + 3 * np.arange(k)[:, None] + np.arange(3)
        out[at[:, :, None], at[:, None, :]] += inverse
        return np.asarray(0.5 * (out + out.T))


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


@dataclass(frozen=True, eq=False)
class ChainMarginals:
    """The same where poses are many and landmarks few: the poses are eliminated first.

    Poses are tied to their neighbours by odometry, so their block is a band, and its Cholesky
    decomposition and the diagonal blocks of its inverse cost a constant a pose. The few poses to
    which a loop leads back are kept with the landmarks instead: without them the rest is a chain.
    Some more are kept that cut it into stretches, each of which hangs on the landmarks seen from
    there and on no others.

    Attributes:
        system: the graph.
        stretches: poses that are eliminated.
        kept: (3m + 6k,) rows in the system's information of all landmarks and the k poses kept.
        border: their information.
    """

    system: LinearSystem
    stretches: list[Stretch]
    kept: IntArray
    border: DenseFactor

    @staticmethod
    def of(system: LinearSystem) -> ChainMarginals:
        """Eliminates the poses.

        Raises:
            EstimatorError: the poses are not determined.
        """
        columns, information, n = system.columns, system.information, len(system.pose_keys)
        among = information[columns:, columns:]
        cuts = np.arange(n)[:: _POSES_A_LANDMARK * 6 * n // max(columns, 1) + 2][1:]
        apart = np.union1d(_led_back_to(among), cuts)
        rows = np.arange(6 * n).reshape(-1, 6)
        kept = np.concatenate([np.arange(columns), columns + rows[apart].ravel()])
        coupling = information[columns:][:, kept]
        border = information[kept][:, kept].toarray()
        left = np.delete(np.arange(n), apart)
        stretches = []
        for chosen in np.split(left, np.flatnonzero(np.diff(left) > 1) + 1):
            if not len(chosen):
                continue
            own = rows[chosen].ravel()
            stretch, taken = Stretch.of(own, among[own][:, own], coupling[own])
            border[np.ix_(stretch.columns, stretch.columns)] -= taken
            stretches.append(stretch)
        return ChainMarginals(system, stretches, kept, DenseFactor(border))

    def step(self) -> FloatArray:
        """(3m + 6n,) from where the graph was linearised to its minimum, the border held."""
        return self.solve(self.system.gradient[:, None])[:, 0]

    def solve(self, gradients: FloatArray) -> FloatArray:
        """(3m + 6n, c) the steps for other gradients (3m + 6n, c), the border held."""
        of_poses, pull = gradients[self.system.columns :], gradients[self.kept]
        for stretch in self.stretches:
            pull[stretch.columns] -= stretch.gain.T @ of_poses[stretch.rows]
        moved = -self.border.solve(pull)
        out = np.empty_like(gradients)
        out[self.kept] = moved
        for stretch in self.stretches:
            alone = stretch.alone(of_poses[stretch.rows])
            out[self.system.columns + stretch.rows] = alone - stretch.gain @ moved[stretch.columns]
        return out

    def poses(self) -> FloatArray:
        """(n, 6, 6) marginals, in the order of ``pose_keys``."""
        columns, covariance = self.system.columns, self.border.inverse
        out = np.empty((len(self.system.pose_keys), 6, 6))
        out[(self.kept[columns::6] - columns) // 6] = _diagonal(covariance[columns:, columns:], 6)
        for stretch in self.stretches:
            gain = stretch.gain.reshape(len(stretch.own), 6, -1)
            among = covariance[np.ix_(stretch.columns, stretch.columns)]
            out[stretch.rows[::6] // 6] = stretch.own + gain @ among @ np.swapaxes(gain, 1, 2)
        return out

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals, in the order of ``landmark_keys``."""
        columns = self.system.columns
        return _diagonal(self.border.inverse[:columns, :columns], 3)

    def joint(self, pose: int, landmarks: IntArray) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of one pose and landmarks, by row of the key lists."""
        columns = (3 * landmarks[:, None] + np.arange(3)).ravel()
        on, gain, alone = self._hangs(pose)
        covariance = self.border.inverse
        cross = -(gain @ covariance[np.ix_(on, columns)])
        own = alone + gain @ covariance[np.ix_(on, on)] @ gain.T
        return np.block([[own, cross], [cross.T, covariance[np.ix_(columns, columns)]]])

    def _hangs(self, pose: int) -> tuple[IntArray, FloatArray, FloatArray]:
        """What of the kept a pose hangs on, how (6, c), and its covariance if that is held."""
        for stretch in self.stretches:
            at = np.flatnonzero(stretch.rows == 6 * pose)
            if len(at):
                first = int(at[0])
                return stretch.columns, stretch.gain[first : first + 6], stretch.own[first // 6]
        first = int(np.searchsorted(self.kept, self.system.columns + 6 * pose))
        return first + np.arange(6), -np.eye(6), np.zeros((6, 6))


def _diagonal(matrix: FloatArray, size: int) -> FloatArray:
    """(k, size, size) blocks on the diagonal of a matrix (k size, k size)."""
    k = len(matrix) // size
    every = np.arange(k)
    return np.asarray(matrix.reshape(k, size, k, size)[every, :, every, :])


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
