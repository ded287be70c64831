"""A whole graph in arrays: its cost, its linear system, and the way to its minimum.

Landmark observations, which are many, are arrays (:mod:`sightings`); the few other factors (prior,
odometry, floor, loops, what is known of single landmarks) stay GTSAM's, which linearises them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial, reduce
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from fgslam.backend.settings import KernelSettings
from fgslam.backend.smoothers.marginals import LinearSystem, block_diagonal, reduced
from fgslam.backend.smoothers.sightings import (
    FactorSightings,
    Sightings,
    StereoSightings,
    values_of,
)
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.levenberg import Damping
from fgslam.factors.graphs import is_pose
from fgslam.factors.noise import kernel_losses, kernel_weights, plain
from fgslam.factors.stacked import LinearRows

PLAIN = KernelSettings("none")
_AT_ONCE = 20_000  # observations, of which each takes some kilobytes


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Poses ``wTc`` (n, 4, 4) and landmarks (m, 3), by the keys' order."""

    poses: FloatArray
    points: FloatArray

    @staticmethod
    def of(values: Any) -> State:
        """Those of GTSAM values."""
        poses, points = keys_of(values)
        matrices = [values.atPose3(key).matrix() for key in poses]
        places = [values.atPoint3(key) for key in points]
        return State(np.array(matrices).reshape(-1, 4, 4), np.array(places).reshape(-1, 3))

    def moved(self, step: FloatArray) -> State:
        """After a step (3m + 6n,) of the landmarks and in the poses' tangent spaces."""
        points = 3 * len(self.points)
        pairs = zip(self.poses, step[points:].reshape(-1, 6), strict=True)
        poses = np.array([gtsam.Pose3(pose).retract(by).matrix() for pose, by in pairs])
        return State(poses, self.points + step[:points].reshape(-1, 3))


@dataclass(frozen=True, eq=False)
class WholeGraph:
    """Factors, and what each observation weighs.

    Attributes:
        graph: all factors, as GTSAM has them.
        pose_keys, landmark_keys: of the variables, ascending.
        kinds: the observations.
        weights: (k,) of all observations, in the order of ``kinds``; 0: left out.
        rest: the other factors.
        kernel: around each observation.
    """

    graph: Any
    pose_keys: list[int]
    landmark_keys: list[int]
    kinds: list[Sightings]
    weights: FloatArray
    rest: Any
    kernel: KernelSettings

    @staticmethod
    def of(graph: Any, values: Any, kernel: KernelSettings = PLAIN) -> tuple[WholeGraph, State]:
        """A graph without empty slots, whose observations have this kernel, and its values."""
        poses, landmarks = keys_of(values)
        rows = {key: row for keys in (poses, landmarks) for row, key in enumerate(keys)}
        rest = gtsam.NonlinearFactorGraph()
        found: dict[Any, list[tuple[Any, int, int, int]]] = {
            StereoSightings: [],
            FactorSightings: [],
        }
        for row in range(graph.size()):
            factor = graph.at(row)
            keys = list(factor.keys())
            if not (_observes(keys) and factor.dim() == 3):
                rest.add(factor)
                continue
            kind = StereoSightings if _is_of_rig(factor) else FactorSightings
            found[kind].append((factor, row, rows[keys[0]], rows[keys[1]]))
        kinds = []
        for kind, each in ((kind, each) for kind, each in found.items() if each):
            factors, *which = zip(*each, strict=True)
            kinds.append(kind.of(list(factors), *(np.array(w, np.int64) for w in which)))
        weights = np.ones(sum(len(kind.rows) for kind in kinds))
        whole = WholeGraph(graph, poses, landmarks, kinds, weights, rest, kernel)
        return whole, State.of(values)

    # -- other graphs --------------------------------------------------------------------------

    def weighed(self, weights: FloatArray | BoolArray) -> WholeGraph:
        """Without kernel, its observations with weights (k,)."""
        new = np.asarray(weights, np.float64)
        return dataclasses.replace(self, weights=new, kernel=PLAIN)

    def without(self, rows: IntArray, state: State) -> tuple[WholeGraph, State]:
        """Without landmarks, by row, and their factors, at the state (of all) without them."""
        gone = {self.landmark_keys[row] for row in rows.tolist()}
        graph = gtsam.NonlinearFactorGraph()
        for row in range(self.graph.size()):
            if gone.isdisjoint(self.graph.at(row).keys()):
                graph.add(self.graph.at(row))
        values = self.values(state)
        for key in gone:
            values.erase(key)
        found, left = WholeGraph.of(graph, values, self.kernel)
        weights = self.weights[~np.isin(self._points, rows)]
        return dataclasses.replace(found, weights=weights), left

    def plus(self, factor: Any) -> WholeGraph:
        """With one factor more, of poses alone."""
        graph, rest = self.graph.clone(), self.rest.clone()
        graph.add(factor)
        rest.add(factor)
        return dataclasses.replace(self, graph=graph, rest=rest)

    def kept(self) -> Any:
        """GTSAM's factors that count, without kernels where this graph has none."""
        left = np.zeros(self.graph.size(), np.bool_)
        left[np.concatenate([kind.rows for kind in self.kinds])[self.weights <= 0.0]] = True
        out = gtsam.NonlinearFactorGraph()
        for row in np.flatnonzero(~left).tolist():
            factor = self.graph.at(row)
            bare = self.kernel.name == "none" and _observes(list(factor.keys()))
            out.add(plain(factor) if bare else factor)
        return out

    def unseen(self) -> IntArray:
        """Rows of the landmarks of which no observation counts."""
        return np.setdiff1d(np.arange(len(self.landmark_keys)), self._points[self.weights > 0.0])

    # -- at a state ------------------------------------------------------------------------------

    def values(self, state: State) -> Any:
        """GTSAM values of all variables."""
        keys = [*enumerate(self.pose_keys), *enumerate(self.landmark_keys)]
        return values_of({key: row for row, key in keys}, state.poses, state.points)

    def squared(self, state: State) -> FloatArray:
        """(k,) squared whitened residuals of the observations, without weights and kernel."""
        if not self.kinds:
            return np.empty(0)
        found = [kind.residuals(state.poses, state.points) for kind in self.kinds]
        return np.concatenate([np.einsum("ki,ki->k", r, r) for r in found])

    def cost(self, state: State) -> float:
        """Half the robust sum of squares of all that counts."""
        squared = self.weights * self.squared(state)
        losses = kernel_losses(self.kernel.name, self.kernel.width, squared)
        return float(losses.sum()) + float(self.rest.error(self._of_rest(state)))

    def linear(self, state: State) -> LinearSystem:
        """Normal equations at a state, robust weights as they are there."""
        rest = self._linear_rest(state)
        looks = [kind.look(state.poses, state.points) for kind in self.kinds]
        if not looks:
            return rest
        rows = reduce(LinearRows.join, looks)
        residual, by_pose, by_point = rows.residual, rows.by_pose, rows.by_point
        squared = self.weights * np.einsum("ki,ki->k", residual, residual)
        weights = self.weights * kernel_weights(self.kernel.name, self.kernel.width, squared)
        known = weights[:, None, None] * np.swapaxes(by_pose, 1, 2)  # (k, 6, 3)
        of_point = weights[:, None, None] * np.swapaxes(by_point, 1, 2)
        poses, points = self._incidence
        column = residual[:, :, None]
        blocks = _summed(poses, known @ by_pose)
        return dataclasses.replace(
            rest,
            poses=rest.poses + block_diagonal(blocks),
            coupling=rest.coupling + self._coupled(known @ by_point),
            landmarks=rest.landmarks + _summed(points, of_point @ by_point),
            pose_gradient=rest.pose_gradient + _summed(poses, known @ column).ravel(),
            landmark_gradient=rest.landmark_gradient + _summed(points, of_point @ column).ravel(),
        )

    def pulled(
        self, state: State, shifts: Callable[[FloatArray], FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """What shifts of a rig's measurements do to the normal equations at a state.

        Args:
            state: where to linearise.
            shifts: from measurements (k, 3) to their displacements by p parameters (k, 3, p).

        Returns:
            Gradients (3m + 6n, p) by the parameters, and the parameters' own information (p, p).
        """
        (kind,) = self.kinds
        if not isinstance(kind, StereoSightings):
            raise TypeError("only a rig's measurements are shifted")
        rows, parts = kind.look(state.poses, state.points), []
        for few in np.array_split(np.arange(len(kind.rows)), len(kind.rows) // _AT_ONCE + 1):
            by = -kind.roots[few] @ shifts(kind.measured[few])
            known = self.weights[few, None, None] * by
            poses, points = (which[:, few] for which in self._incidence)
            of_points = _summed(points, np.swapaxes(rows.by_point[few], 1, 2) @ known)
            of_poses = _summed(poses, np.swapaxes(rows.by_pose[few], 1, 2) @ known)
            own = np.einsum("kip,kiq->pq", by, known)
            parts.append(np.concatenate([*of_points, *of_poses, own]))
        found = reduce(np.add, parts)
        p = found.shape[1]
        return found[:-p], found[-p:]

    def minimum(
        self, state: State, iterations: int, tolerance: float, enough: float = 0.0
    ) -> State:
        """The state at the minimum of the cost.

        Args:
            state: where to start.
            iterations: at most.
            tolerance: the end, where the cost falls by a smaller part of it.
            enough: the end, too, where it falls by less.
        """
        damping = Damping()
        cost = self.cost(state)
        for _ in range(iterations):
            system = self.linear(state)
            found = damping.step(cost, partial(self._tried, system, state))
            if found is None:
                break
            before, (cost, state) = cost, found
            if before - cost <= max(tolerance * before, enough):
                break
        return state

    def _tried(self, system: LinearSystem, state: State, damping: float) -> tuple[float, State]:
        ahead = state.moved(reduced(system.damped(damping)).step())
        return self.cost(ahead), ahead

    # -- its parts -------------------------------------------------------------------------------

    @cached_property
    def _poses(self) -> IntArray:
        """(k,) rows of the observations' poses."""
        return _joined([kind.poses for kind in self.kinds])

    @cached_property
    def _points(self) -> IntArray:
        """(k,) rows of the observations' landmarks."""
        return _joined([kind.points for kind in self.kinds])

    @cached_property
    def _incidence(self) -> tuple[csr_matrix, csr_matrix]:
        """(n, k) and (m, k): which observation is which pose's and which landmark's."""
        every, k = np.arange(len(self._poses)), len(self._poses)
        one = np.ones(k)
        return (
            csr_matrix((one, (self._poses, every)), (len(self.pose_keys), k)),
            csr_matrix((one, (self._points, every)), (len(self.landmark_keys), k)),
        )

    def _coupled(self, blocks: FloatArray) -> bsr_matrix:
        """Sparse (6n, 3m) of each observation's block (k, 6, 3)."""
        n, m = len(self.pose_keys), len(self.landmark_keys)
        order = np.lexsort((self._points, self._poses))
        start = np.searchsorted(self._poses[order], np.arange(n + 1))
        return bsr_matrix((blocks[order], self._points[order], start), (6 * n, 3 * m))

    @cached_property
    def _rest_rows(self) -> dict[int, int]:
        """Rows of the variables of the other factors, by key, ascending."""
        rows = {key: row for row, key in enumerate(self.landmark_keys)}
        rows |= {key: row for row, key in enumerate(self.pose_keys)}
        return {key: rows[key] for key in sorted(self.rest.keyVector())}

    def _linear_rest(self, state: State) -> LinearSystem:
        """Normal equations of the other factors alone, by GTSAM."""
        n, m = len(self.pose_keys), len(self.landmark_keys)
        linear = self.rest.linearize(values_of(self._rest_rows, state.poses, state.points))
        row, column, value = linear.sparseJacobian_()
        places = [
            3 * m + 6 * row + np.arange(6) if is_pose(key) else 3 * row + np.arange(3)
            for key, row in self._rest_rows.items()
        ]
        # GTSAM counts from 1 and puts the right-hand side in the last column.
        place = np.concatenate([*places, [3 * m + 6 * n]])
        at = row.astype(np.int64) - 1, place[column.astype(np.int64) - 1]
        rows = int(row.max(initial=0))
        whole = csr_matrix((value, at), (rows, 3 * m + 6 * n + 1))
        jacobian, right = whole[:, :-1], whole[:, [-1]].toarray()[:, 0]
        information = (jacobian.T @ jacobian).tocsr()
        gradient = -(jacobian.T @ right)
        own, links = _apart(information[: 3 * m, : 3 * m])
        coupling = information[3 * m :, : 3 * m]
        return LinearSystem(
            np.array(self.pose_keys, np.int64),
            np.array(self.landmark_keys, np.int64),
            information[3 * m :, 3 * m :],
            coupling.tobsr((6, 3)) if n and m else bsr_matrix((6 * n, 3 * m), blocksize=(6, 3)),
            own,
            links,
            gradient[3 * m :],
            gradient[: 3 * m],
        )

    def _of_rest(self, state: State) -> Any:
        return values_of(self._rest_rows, state.poses, state.points)


def keys_of(values: Any) -> tuple[list[int], list[int]]:
    """Keys of the poses and of the landmarks among GTSAM values, ascending."""
    keys = list(values.keys())
    poses = [key for key in keys if is_pose(key)]
    return poses, [key for key in keys if not is_pose(key)]


def _observes(keys: list[int]) -> bool:
    """Whether a factor of these variables is an observation of a landmark from a pose."""
    return len(keys) == 2 and is_pose(keys[0]) and not is_pose(keys[1])


def _is_of_rig(factor: Any) -> bool:
    """Whether a factor is a rig's, not the camera that stands in for a range and a bearing."""
    return isinstance(factor, gtsam.GenericStereoFactor3D) and factor.calibration().fx() != 1.0


def _joined(arrays: list[IntArray]) -> IntArray:
    return np.concatenate(arrays) if arrays else np.empty(0, np.int64)


def _summed(incidence: csr_matrix, each: FloatArray) -> FloatArray:
    """Sums (g, ...) of what each observation (k, ...) adds to its group, one after another."""
    found = incidence @ each.reshape(len(each), -1)
    return np.asarray(found.reshape(-1, *each.shape[1:]))


def _apart(matrix: csr_matrix) -> tuple[FloatArray, csr_matrix]:
    """The (m, 3, 3) diagonal blocks of a sparse matrix (3m, 3m), and what is beside them."""
    entries = matrix.tocoo()
    own = np.zeros((matrix.shape[0] // 3, 3, 3))
    inside = entries.row // 3 == entries.col // 3
    row, column = entries.row[inside], entries.col[inside]
    own[row // 3, row % 3, column % 3] = entries.data[inside]
    beside = entries.data[~inside], (entries.row[~inside], entries.col[~inside])
    return own, csr_matrix(beside, matrix.shape)
