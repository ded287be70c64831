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
from fgslam.backend.smoothers.block_cholesky import BlockCholesky
from fgslam.backend.smoothers.border import Bordered, Eliminated
from fgslam.backend.smoothers.marginals import (
    GraphMarginals,
    LinearSystem,
    block_diagonal,
    reduced,
    with_border,
)
from fgslam.backend.smoothers.other_factors import OtherFactors
from fgslam.backend.smoothers.sightings import StereoSightings, values_of
from fgslam.backend.smoothers.turns import TurnedStep, Turns
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.levenberg import Damping
from fgslam.core.sensors import CameraRig
from fgslam.factors.graphs import is_pose, number
from fgslam.factors.noise import kernel_losses, kernel_weights

PLAIN = KernelSettings("none")
_NONE: IntArray = np.empty(0, np.int64)
_SLOW = 0.1  # of the last step's gain: beyond, a kept system has become another
_AT_ONCE = 20_000  # observations, of which each takes some kilobytes


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Poses ``wTc`` (n, 4, 4) and landmarks (m, 3), by the keys' order; a gyroscope's biases (3q,).

    The biases are in rad/s, about the axes of the body.
    """

    poses: FloatArray
    points: FloatArray
    bias: FloatArray = dataclasses.field(default_factory=lambda: np.empty(0))

    @staticmethod
    def of(values: Any) -> State:
        """Those of GTSAM values, without biases."""
        flat = gtsam.utilities.extractPose3(values)
        poses = np.tile(np.eye(4), (len(flat), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = flat[:, :9].reshape(-1, 3, 3), flat[:, 9:]
        return State(poses, np.array(gtsam.utilities.extractPoint3(values)).reshape(-1, 3))

    def moved(self, step: FloatArray) -> State:
        """After a step (3m + 6n + 3q,) of landmarks, in the poses' tangent spaces, of biases."""
        points = 3 * len(self.points)
        end = points + 6 * len(self.poses)
        pairs = zip(self.poses, step[points:end].reshape(-1, 6), strict=True)
        poses = np.array([gtsam.Pose3(pose).retract(by).matrix() for pose, by in pairs])
        return State(poses, self.points + step[:points].reshape(-1, 3), self.bias + step[end:])


@dataclass(frozen=True, eq=False)
class WholeGraph:
    """Factors, and what each observation weighs.

    Attributes:
        pose_keys, landmark_keys: of the variables, ascending.
        seen: the observations; None without any.
        weights: (k,) of the observations; 0: left out.
        rest: the other factors.
        kernel: around each observation.
    """

    pose_keys: list[int]
    landmark_keys: list[int]
    seen: StereoSightings | None
    weights: FloatArray
    rest: OtherFactors
    kernel: KernelSettings

    @staticmethod
    def of(graph: Any, values: Any, kernel: KernelSettings = PLAIN) -> tuple[WholeGraph, State]:
        """A graph of GTSAM's without empty slots, whose observations have this kernel."""
        poses, landmarks = keys_of(values)
        rows = {key: row for keys in (poses, landmarks) for row, key in enumerate(keys)}
        rest, found = gtsam.NonlinearFactorGraph(), list[tuple[Any, int, int, int]]()
        for row in range(graph.size()):
            factor = graph.at(row)
            if isinstance(factor, gtsam.GenericStereoFactor3D):
                pose, landmark = factor.keys()
                found.append((factor, row, rows[pose], rows[landmark]))
            else:
                rest.add(factor)
        seen = None
        if found:
            factors, *which = zip(*found, strict=True)
            seen = StereoSightings.of(list(factors), *(np.array(w, np.int64) for w in which))
        weights = np.ones(len(found))
        others = OtherFactors(rest, poses, landmarks)
        return WholeGraph(poses, landmarks, seen, weights, others, kernel), State.of(values)

    @staticmethod
    def of_rig(
        others: Any,
        values: Any,
        kernel: KernelSettings,
        keys: tuple[IntArray, IntArray],
        measured: tuple[FloatArray, FloatArray],
        rig: CameraRig,
    ) -> tuple[WholeGraph, State]:
        """Observations of a rig, and other factors.

        Args:
            others: GTSAM's, without empty slots.
            values: of all variables.
            kernel: around each observation.
            keys: (k,) of the observations' poses and landmarks.
            measured: (k, 3) column, row, disparity, and (k, 3, 3) roots of their information.
            rig: the cameras.
        """
        poses, landmarks = keys_of(values)
        of_pose, of_landmark = (
            np.searchsorted(np.array(have, np.int64), which).astype(np.int64)
            for have, which in zip((poses, landmarks), keys, strict=True)
        )
        rows = others.size() + np.arange(len(of_pose))
        seen = StereoSightings(rows, of_pose, of_landmark, *measured, rig) if len(rows) else None
        rest = OtherFactors(others, poses, landmarks)
        graph = WholeGraph(poses, landmarks, seen, np.ones(len(rows)), rest, kernel)
        return graph, State.of(values)

    def with_turns(
        self, steps: list[TurnedStep], state: State, persistence: float
    ) -> tuple[WholeGraph, State]:
        """With steps that a gyroscope measured, and the state with a bias for its poses."""
        turns = Turns.of(steps, [number(key) for key in self.pose_keys], persistence)
        if turns is None:
            return self, state
        rest = dataclasses.replace(self.rest, turns=turns)
        start = dataclasses.replace(state, bias=turns.start(state.poses))
        return dataclasses.replace(self, rest=rest), start

    # -- other graphs --------------------------------------------------------------------------

    def weighed(self, weights: FloatArray | BoolArray) -> WholeGraph:
        """Without kernel, its observations with weights (k,)."""
        new = np.asarray(weights, np.float64)
        return dataclasses.replace(self, weights=new, kernel=PLAIN)

    def heeding(self, rows: BoolArray) -> WholeGraph:
        """Without the other observations (k,), with its kernel."""
        return dataclasses.replace(self, weights=self.weights * rows)

    def without(self, rows: IntArray, state: State) -> tuple[WholeGraph, State]:
        """Without landmarks, by row, and their factors, at the state (of all) without them."""
        kept = np.ones(len(self.landmark_keys), np.bool_)
        kept[rows] = False
        gone = {self.landmark_keys[row] for row in rows.tolist()}
        left = dataclasses.replace(
            self,
            landmark_keys=[key for key in self.landmark_keys if key not in gone],
            seen=self.seen and self.seen.of_points(kept),
            weights=self.weights[kept[self._points]],
            rest=self.rest.without(gone),
        )
        return left, dataclasses.replace(state, points=state.points[kept])

    def plus(self, factor: Any) -> WholeGraph:
        """With one factor more, of poses alone."""
        return dataclasses.replace(self, rest=self.rest.plus(factor))

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
        if self.seen is None:
            return np.empty(0)
        residuals = self.seen.residuals(state.poses, state.points)
        return np.asarray(np.einsum("ki,ki->k", residuals, residuals))

    def cost(self, state: State) -> float:
        """Half the robust sum of squares of all that counts."""
        squared = self.weights * self.squared(state)
        losses = kernel_losses(self.kernel.name, self.kernel.width, squared)
        return float(losses.sum()) + self.rest.cost(state.poses, state.points, state.bias)

    def linear(self, state: State) -> LinearSystem:
        """Normal equations at a state, robust weights as they are there."""
        rest = self.rest.linear(state.poses, state.points, state.bias)
        if self.seen is None:
            return rest
        rows = self.seen.look(state.poses, state.points)
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
        seen = self.seen
        if seen is None:
            raise ValueError("without observations there is nothing to shift")
        rows, parts = seen.look(state.poses, state.points), []
        for few in np.array_split(np.arange(len(seen.rows)), len(seen.rows) // _AT_ONCE + 1):
            by = -seen.roots[few] @ shifts(seen.measured[few])
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
        self,
        state: State,
        iterations: int,
        tolerance: float,
        enough: float = 0.0,
        descent: Descent | None = None,
    ) -> State:
        """The state at the minimum of the cost.

        Args:
            state: where to start.
            iterations: at most.
            tolerance: the end, where the cost falls by a smaller part of it.
            enough: the end, too, where it falls by less.
            descent: goes on with this one, which has made steps on much the same graph.
        """
        descent = descent or Descent(keeps=False)
        cost, gain = self.cost(state), np.inf
        for _ in range(iterations):
            found = descent.step(self, cost, state, gain)
            if found is None:
                break
            before, (cost, state) = cost, found
            gain = before - cost
            if gain <= max(tolerance * before, enough):
                break
        return state

    # -- its parts -------------------------------------------------------------------------------

    @cached_property
    def _poses(self) -> IntArray:
        """(k,) rows of the observations' poses."""
        return _NONE if self.seen is None else self.seen.poses

    @cached_property
    def _points(self) -> IntArray:
        """(k,) rows of the observations' landmarks."""
        return _NONE if self.seen is None else self.seen.points

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


class Descent:
    """Steps towards the minimum, Gauss and Newton's or damped.

    Near the minimum the poses' own system hardly changes from step to step: where it is kept, the
    landmarks are eliminated anew, and its factor, which is most of the work, serves on.
    """

    def __init__(self, keeps: bool = True) -> None:
        """No step yet; whether it keeps the poses' system."""
        self._keeps = keeps
        self._damping = Damping()
        self._factor: BlockCholesky | None = None

    def step(
        self, graph: WholeGraph, cost: float, state: State, last_gain: float
    ) -> tuple[float, State] | None:
        """Cost and state after one step that does not raise the cost; None where none does.

        Args:
            graph: what is minimised.
            cost: at the state.
            state: before.
            last_gain: by how much the step before lowered the cost; a kept system goes on as long
                as each step gains a small part of that.
        """
        system = graph.linear(state)
        if self._factor is not None:
            found = self._kept(graph, state, system, self._factor)
            if found is not None and 0.0 <= cost - found[0] <= _SLOW * last_gain:
                return found
            self._factor = None
        return self._damping.step(cost, partial(self._tried, graph, state, system))

    def _kept(
        self, graph: WholeGraph, state: State, system: LinearSystem, factor: BlockCholesky
    ) -> tuple[float, State] | None:
        """The step by a kept system; None where a landmark has become undetermined."""
        try:
            kept = GraphMarginals.of(system.damped(0.0), factor)
            return _after(graph, state, with_border(kept))
        except EstimatorError:
            return None

    def _tried(
        self, graph: WholeGraph, state: State, system: LinearSystem, damping: float
    ) -> tuple[float, State]:
        solved = reduced(system.damped(damping))
        held = solved.held if isinstance(solved, Bordered) else solved
        if self._keeps and damping == 0.0 and isinstance(held, GraphMarginals):
            self._factor = held.factor
        return _after(graph, state, solved)


def _after(graph: WholeGraph, state: State, solved: Eliminated) -> tuple[float, State]:
    ahead = state.moved(solved.step())
    return graph.cost(ahead), ahead


def keys_of(values: Any) -> tuple[list[int], list[int]]:
    """Keys of the poses and of the landmarks among GTSAM values, ascending."""
    poses: list[int] = []
    landmarks: list[int] = []
    for key in values.keys():  # noqa: SIM118 - GTSAM's values do not iterate
        (poses if is_pose(key) else landmarks).append(key)
    return poses, landmarks


def _summed(incidence: csr_matrix, each: FloatArray) -> FloatArray:
    """Sums (g, ...) of what each observation (k, ...) adds to its group, one after another."""
    found = incidence @ each.reshape(len(each), -1)
    return np.asarray(found.reshape(-1, *each.shape[1:]))
