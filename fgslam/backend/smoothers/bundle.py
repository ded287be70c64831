"""A whole graph in arrays: its cost, its linear system, and the way to its minimum.

Landmark observations, which are many, are arrays (:mod:`sightings`); the few other factors (prior,
odometry, floor, loops, what is known of single landmarks) stay GTSAM's, which linearises them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial, reduce
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from fgslam.backend.settings import KernelSettings
from fgslam.backend.smoothers.elimination import (
    Border,
    Bordered,
    GraphMarginals,
    LinearSystem,
    SolvedSystem,
    block_diagonal,
    reduced,
    with_border,
)
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import Damping, adjoint, compose_covariance, inverse
from fgslam.core.sensors import BiasEffect, Odometry
from fgslam.factors.graphs import is_landmark, is_pose, landmarks_in, nuisance_key, number
from fgslam.factors.measurement import (
    LinearRows,
    gtsam_factor,
    linearise,
    nuisance_covariance,
    residuals,
    shifted,
    whitening,
)
from fgslam.factors.noise import kernel_losses, kernel_weights, positive_definite

# ------------------------------------------------------------------------------------------
# Landmark observations of a whole graph in arrays: whitened residuals and their derivatives


@dataclass(frozen=True, slots=True, eq=False)
class Sightings(Rows):
    """Observations of landmarks by one model.

    Attributes:
        poses: keys (k,) of their poses; in a :class:`WholeGraph` their rows, in a window frames.
        points: of their landmarks, alike; in a window variables.
        measured: (k, m).
        roots: (k, m, m) square roots of their informations.
        model: of the sensor.
        xTs: (4, 4) the sensor in the frame of the poses; None where they are its own.
    """

    SHARED = frozenset({"model", "xTs"})

    poses: IntArray
    points: IntArray
    measured: FloatArray
    roots: FloatArray
    model: Any
    xTs: FloatArray | None = None

    def at_rows(self, poses: Sequence[int], landmarks: Sequence[int] | IntArray) -> Sightings:
        """By rows among these keys, which ascend."""
        of_pose = np.searchsorted(np.array(poses, np.int64), self.poses)
        of_landmark = np.searchsorted(np.array(landmarks, np.int64), self.points)
        return dataclasses.replace(self, poses=of_pose, points=of_landmark)

    def factors(self) -> Any:
        """A graph of GTSAM's, by keys."""
        out = gtsam.NonlinearFactorGraph()
        xTs = np.eye(4) if self.xTs is None else self.xTs
        more = [nuisance_key(self.model.kind)] if self.model.nuisance.size else []
        for pose, point, z, root in zip(
            self.poses.tolist(), self.points.tolist(), self.measured, self.roots, strict=True
        ):
            noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
            out.add(gtsam_factor(self.model, [pose, point, *more], z, noise, xTs))
        return out

    def of_points(self, kept: BoolArray) -> Sightings:
        """Those of some landmarks, a mask (m,), whose rows are renumbered."""
        own = self.select(kept[self.points])
        return dataclasses.replace(own, points=(np.cumsum(kept) - 1)[own.points])

    def residuals(self, poses: FloatArray, points: FloatArray) -> FloatArray:
        """Whitened residuals (k, m) at all poses (n, 4, 4) and points (p, 3)."""
        at = poses[self.poses] if self.xTs is None else poses[self.poses] @ self.xTs
        return residuals(self.model, at, points[self.points], self.measured, self.roots)

    def look(self, poses: FloatArray, points: FloatArray) -> LinearRows:
        """The same, with derivatives."""
        own, seen = poses[self.poses], points[self.points]
        return linearise(self.model, own, seen, self.measured, self.roots, self.xTs)

    def shifted(self) -> FloatArray:
        """(k, m, 3) whitened, by the sensor's nuisance parameters; (k, m, 0) without any."""
        return self.roots @ shifted(self.model, self.measured)

    def incidence(self, n: int, m: int) -> tuple[csr_matrix, csr_matrix]:
        """(n, k) and (m, k): which observation is which pose's and which landmark's."""
        every, one = np.arange(len(self)), np.ones(len(self))
        return (
            csr_matrix((one, (self.poses, every)), (n, len(self))),
            csr_matrix((one, (self.points, every)), (m, len(self))),
        )

    def joined(
        self,
        system: LinearSystem,
        rows: LinearRows,
        weights: FloatArray,
        incidence: tuple[csr_matrix, csr_matrix],
    ) -> LinearSystem:
        """Normal equations with these, linearised, with weights (k,)."""
        known = weights[:, None, None] * np.swapaxes(rows.by_pose, 1, 2)  # (k, 6, m)
        of_point = weights[:, None, None] * np.swapaxes(rows.by_point, 1, 2)
        poses, points = incidence
        column = rows.residual[:, :, None]
        blocks = _summed(poses, known @ rows.by_pose)
        of_poses = _summed(poses, known @ column).ravel()
        of_points = _summed(points, of_point @ column).ravel()
        return dataclasses.replace(
            system,
            poses=system.poses + block_diagonal(blocks),
            coupling=system.coupling + self._coupled(known @ rows.by_point, system),
            landmarks=system.landmarks + _summed(points, of_point @ rows.by_point),
            pose_gradient=system.pose_gradient + of_poses,
            landmark_gradient=system.landmark_gradient + of_points,
        )

    def _coupled(self, blocks: FloatArray, system: LinearSystem) -> bsr_matrix:
        """Sparse (6n, 3m) of each observation's block (k, 6, 3)."""
        n, m = len(system.pose_keys), len(system.landmark_keys)
        order = np.lexsort((self.points, self.poses))
        start = np.searchsorted(self.poses[order], np.arange(n + 1))
        return bsr_matrix((blocks[order], self.points[order], start), (6 * n, 3 * m))


def by_kind(parts: Iterable[Sightings]) -> dict[str, Sightings]:
    """Those of each kind of model joined, in their order."""
    joined: dict[str, Sightings] = {}
    for one in parts:
        kind = one.model.kind
        joined[kind] = joined[kind].join(one) if kind in joined else one
    return joined


def values_of(keys: dict[int, int], poses: FloatArray, points: FloatArray) -> Any:
    """GTSAM values of variables, given by their rows among poses (n, 4, 4) and points (m, 3)."""
    values = gtsam.Values()
    for key, row in keys.items():
        values.insert(key, gtsam.Pose3(poses[row]) if is_pose(key) else points[row])
    return values


# ------------------------------------------------------------------------------------------
# Turns of a gyroscope in a whole graph, whose bias is a variable of it

_MOST_NODES = 17  # a bound for the work: every two minutes in a drive of half an hour
_NO_WALK = 0.01  # of the time after which the walk counts: less than 1e-4 of the variance is its


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """What a bias does to a step of the graph, which may be of several frames.

    Attributes:
        jacobian: (6, 3) of the step's tangent vector, at its end, by the bias.
        applied: (6,) what the step's motion contains of that.
        unknown: (6, 6) what the step's covariance contains of it.
        start_variance, walk: as :class:`fgslam.core.sensors.BiasEffect`.
    """

    jacobian: FloatArray
    applied: FloatArray
    unknown: FloatArray
    start_variance: float
    walk: float

    @staticmethod
    def of(steps: Sequence[Odometry | None]) -> Turn | None:
        """Of consecutive steps; None where a bias plays no part."""
        biases = [step.bias for step in steps if step is not None and step.bias is not None]
        if not biases:
            return None
        jacobian, applied, unknown = np.zeros((6, 3)), np.zeros(6), np.zeros((6, 6))
        for step in steps:
            if step is None:
                continue
            back, own = adjoint(inverse(step.motion)), _by_bias(step.bias)
            left = np.zeros((3, 3)) if step.bias is None else step.bias.left
            unknown = compose_covariance(step.motion, unknown, own @ left @ own.T)
            bias = np.zeros(3) if step.bias is None else step.bias.applied
            jacobian, applied = back @ jacobian + own, back @ applied + own @ bias
        walk = float(sum(bias.walk for bias in biases))
        return Turn(jacobian, applied, unknown, biases[0].start_variance, walk)


def _by_bias(bias: BiasEffect | None) -> FloatArray:
    """(6, 3) of a single step."""
    return np.zeros((6, 3)) if bias is None else np.pad(bias.jacobian, ((0, 3), (0, 0)))


@dataclass(frozen=True, slots=True, eq=False)
class TurnedStep:
    """A step between two frames of the graph, and what a bias does to it."""

    before: int
    after: int
    step: Odometry
    turn: Turn


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """All k steps of a graph that a gyroscope measured; its bias is at q nodes.

    Attributes:
        before, after: (k,) rows of their poses.
        motions: (k, 4, 4) by the bias that was applied.
        applied: (k, 6) its effect.
        jacobians: (k, 6, 3) by the bias.
        roots: (k, 6, 6) whitening of what is no bias.
        nodes: (k, q) weights of the nodes in the bias of each step.
        known: (3q, 3q) information of the nodes beforehand, about zero.
    """

    before: IntArray
    after: IntArray
    motions: FloatArray
    applied: FloatArray
    jacobians: FloatArray
    roots: FloatArray
    nodes: FloatArray
    known: FloatArray

    @staticmethod
    def of(steps: Sequence[TurnedStep], frames: Sequence[int], persistence: float) -> Turns | None:
        """Of a graph's steps in time order; None where there are none.

        Args:
            steps: with noise as stated.
            frames: of the graph's poses, ascending.
            persistence: multiplies the variance of their translation, which matches made.
        """
        if not steps:
            return None
        scale = np.sqrt(np.repeat([1.0, persistence], 3))
        white = np.array([s.step.covariance - s.turn.unknown for s in steps])
        jacobians = np.array([s.turn.jacobian for s in steps])
        nodes, known, between = _nodes([s.turn for s in steps], jacobians, white)
        noise = scale[:, None] * white * scale + between
        return Turns(
            np.searchsorted(frames, [s.before for s in steps]).astype(np.int64),
            np.searchsorted(frames, [s.after for s in steps]).astype(np.int64),
            np.array([s.step.motion for s in steps]),
            np.array([s.turn.applied for s in steps]),
            jacobians,
            whitening(np.array([positive_definite(each) for each in noise])),
            nodes,
            known,
        )

    def cost(self, poses: FloatArray, bias: FloatArray) -> float:
        """Half the sum of squares, with what is known of the bias (3q,) beforehand."""
        residuals = self.residuals(poses, bias)
        return 0.5 * float((residuals**2).sum() + bias @ self.known @ bias)

    def residuals(self, poses: FloatArray, bias: FloatArray) -> FloatArray:
        """(k, 6) whitened: how far each pose (n, 4, 4) is off from where its step leads."""
        from scipy.spatial.transform import Rotation

        rates = self.nodes @ bias.reshape(-1, 3)
        by = np.einsum("kij,kj->ki", self.jacobians, rates) - self.applied
        stepped = np.array(self.motions)
        turned = Rotation.from_rotvec(by[:, :3]).as_matrix()
        stepped[:, :3, 3] += np.einsum("kij,kj->ki", stepped[:, :3, :3], by[:, 3:])
        stepped[:, :3, :3] = stepped[:, :3, :3] @ turned
        off = inverse(stepped) @ inverse(poses[self.before]) @ poses[self.after]
        angles = Rotation.from_matrix(off[:, :3, :3]).as_rotvec()
        apart = np.concatenate([angles, off[:, :3, 3]], axis=1)
        return np.asarray(np.einsum("kij,kj->ki", self.roots, apart))

    def start(self, poses: FloatArray) -> FloatArray:
        """(3q,) the likeliest bias for these poses.

        Raises:
            EstimatorError: the noise that is stated for the gyroscope leaves it open.
        """
        none = np.zeros(len(self.known))
        by_bias = self._by_bias()
        gradient = by_bias.T @ self.residuals(poses, none).ravel()
        try:
            return np.asarray(-np.linalg.solve(by_bias.T @ by_bias + self.known, gradient))
        except np.linalg.LinAlgError:
            raise EstimatorError(
                "the gyroscope's bias is not determined by its stated noise; correct "
                "gyroscope_noise_density and gyroscope_random_walk of its file"
            ) from None

    def joined(self, system: LinearSystem, poses: FloatArray, bias: FloatArray) -> LinearSystem:
        """Normal equations with these steps, at a state; derivatives as of a small residual."""
        k, n = len(self.before), len(poses)
        back = adjoint(inverse(poses[self.after]) @ poses[self.before])
        blocks = np.stack([-self.roots @ back, self.roots], axis=1).reshape(-1, 6, 6)
        columns = np.column_stack([self.before, self.after]).ravel()
        by_pose = bsr_matrix((blocks, columns, 2 * np.arange(k + 1)), (6 * k, 6 * n)).tocsr()
        residual, by_bias = self.residuals(poses, bias).ravel(), self._by_bias()
        border = Border(
            np.concatenate([np.zeros((system.columns, len(bias))), by_pose.T @ by_bias]),
            by_bias.T @ by_bias + self.known,
            by_bias.T @ residual + self.known @ bias,
        )
        return dataclasses.replace(
            system,
            poses=system.poses + (by_pose.T @ by_pose).tocsr(),
            pose_gradient=system.pose_gradient + by_pose.T @ residual,
            border=border,
        )

    def _by_bias(self) -> FloatArray:
        """(6k, 3q) of all residuals by the nodes."""
        whitened = -self.roots @ self.jacobians
        spread = whitened[:, :, None, :] * self.nodes[:, None, :, None]
        return np.asarray(spread.reshape(6 * len(whitened), -1))


def _nodes(
    turns: Sequence[Turn], jacobians: FloatArray, white: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weights (k, q) of the nodes in each step, what is known of them, what they leave open.

    After a time of sqrt(3) times white noise over walk, the random walk is as large as the mean of
    the white noise (where their Allan deviations cross); two nodes lie in each such time.

    Args:
        turns: k of them, in time order.
        jacobians: (k, 6, 3) theirs.
        white: (k, 6, 6) noise of the steps that is no bias.

    Returns:
        Weights (k, q), information (3q, 3q) of the nodes beforehand, and (k, 6, 6) by how much the
        walk between two nodes adds to the steps' noise.
    """
    duration = np.linalg.norm(jacobians[:, :3], axis=(1, 2)) / np.sqrt(3.0)
    end, walk = np.cumsum(duration), sum(turn.walk for turn in turns)
    noise = float(np.trace(white[:, :3, :3], axis1=1, axis2=2).sum()) / 3.0
    first = np.eye(3) / turns[0].start_variance
    if end[-1] ** 2 * walk <= _NO_WALK**2 * 3.0 * noise:
        return np.ones((len(turns), 1)), first, np.zeros_like(white)
    most = end[-1] / (_MOST_NODES - 1)
    intervals = int(np.ceil(end[-1] / max(0.5 * np.sqrt(3.0 * noise / walk), most)))
    at = intervals * (end - 0.5 * duration) / end[-1]
    nodes = np.maximum(1.0 - np.abs(at[:, None] - np.arange(intervals + 1)), 0.0)
    steps = np.diff(np.eye(intervals + 1), axis=0) * np.sqrt(intervals / walk)
    known = np.kron(steps.T @ steps, np.eye(3))
    known[:3, :3] += first
    return nodes, known, _between(jacobians, duration, walk * end[-1] / intervals**2)


def _between(jacobians: FloatArray, duration: FloatArray, walk: float) -> FloatArray:
    """(k, 6, 6) what a walk between nodes adds to the noise of steps, as if new in each.

    There it is a Brownian bridge; over an interval L its integral has the variance K^2 L^3 / 12, as
    white noise of the density K^2 L^2 / 12 has (at most a sixteenth of the gyroscope's own, where
    the number of nodes is not bounded). Over parts of the interval that is more than the truth.

    Args:
        jacobians: (k, 6, 3) of the steps by the bias.
        duration: (k,) of the steps, seconds.
        walk: K^2 L^2.
    """
    each = walk / 12.0 / np.maximum(duration, np.finfo(np.float64).tiny)
    return np.asarray(each[:, None, None] * (jacobians @ np.swapaxes(jacobians, 1, 2)))


# ------------------------------------------------------------------------------------------
# The factors of a whole graph that are no observations: GTSAM's, and a gyroscope's turns


@dataclass(frozen=True, eq=False)
class OtherFactors:
    """Prior, odometry, floor, loops, what is known of single landmarks.

    Attributes:
        graph: GTSAM's, without empty slots.
        pose_keys, landmark_keys: of all variables, ascending.
        turns: odometry of a gyroscope; None where there is none.
        measured: landmarks by other sensors than the camera, their noise as stated.
    """

    graph: Any
    pose_keys: list[int]
    landmark_keys: list[int]
    turns: Turns | None = None
    measured: tuple[Sightings, ...] = ()

    def plus(self, factor: Any) -> OtherFactors:
        """With one more."""
        graph = self.graph.clone()
        graph.add(factor)
        return dataclasses.replace(self, graph=graph)

    def without(self, gone: set[int]) -> OtherFactors:
        """Without landmarks, by key, and what is measured of them."""
        graph = gtsam.NonlinearFactorGraph()
        for row in range(self.graph.size()):
            if gone.isdisjoint(self.graph.at(row).keys()):
                graph.add(self.graph.at(row))
        left = [key for key in self.landmark_keys if key not in gone]
        kept = np.array([key not in gone for key in self.landmark_keys], np.bool_)
        measured = tuple(one.of_points(kept) for one in self.measured)
        return dataclasses.replace(self, graph=graph, landmark_keys=left, measured=measured)

    def cost(self, poses: FloatArray, points: FloatArray, bias: FloatArray) -> float:
        """Half the sum of squares at poses (n, 4, 4), points (m, 3) and biases (3q,)."""
        cost = float(self.graph.error(values_of(self._rows, poses, points)))
        turns = 0 if self.turns is None else len(self.turns.known)
        for one, known, values in self.nuisances(bias):
            off = one.residuals(poses, points) + one.shifted() @ values
            cost += 0.5 * float((off**2).sum() + values @ known @ values)
        return cost if self.turns is None else cost + self.turns.cost(poses, bias[:turns])

    def nuisances(self, bias: FloatArray) -> Iterator[tuple[Sightings, FloatArray, FloatArray]]:
        """Each sensor's measurements, information of its nuisance parameters, and their values."""
        at = 0 if self.turns is None else len(self.turns.known)
        for one in self.measured:
            known = np.asarray(np.linalg.inv(nuisance_covariance(one.model)), np.float64)
            yield one, known, bias[at : at + len(known)]
            at += len(known)

    def linear(self, poses: FloatArray, points: FloatArray, bias: FloatArray) -> LinearSystem:
        """Their normal equations there."""
        system, borders = self._linear(poses, points), list[Border]()
        for one, known, values in self.nuisances(bias):
            rows, incidence = one.look(poses, points), one.incidence(len(poses), len(points))
            weights, by = np.ones(len(one)), one.shifted()
            rows = dataclasses.replace(rows, residual=rows.residual + by @ values)
            system = one.joined(system, rows, weights, incidence)
            if len(known):
                pull = _pulled(rows, by, weights, incidence)
                gradient = np.einsum("kip,ki->p", by, rows.residual) + known @ values
                borders.append(Border(pull[:-3], pull[-3:] + known, gradient))
        if self.turns is not None:
            system = self.turns.joined(system, poses, bias[: len(self.turns.known)])
        for border in borders:
            system = dataclasses.replace(system, border=border.plus(system.border))
        return system

    @cached_property
    def _rows(self) -> dict[int, int]:
        """Rows of the variables of GTSAM's factors, by key, ascending."""
        rows = {key: row for row, key in enumerate(self.landmark_keys)}
        rows |= {key: row for row, key in enumerate(self.pose_keys)}
        return {key: rows[key] for key in sorted(self.graph.keyVector())}

    def _linear(self, poses: FloatArray, points: FloatArray) -> LinearSystem:
        """Those of GTSAM."""
        n, m = len(self.pose_keys), len(self.landmark_keys)
        linear = self.graph.linearize(values_of(self._rows, poses, points))
        row, column, value = linear.sparseJacobian_()
        places = [
            3 * m + 6 * row + np.arange(6) if is_pose(key) else 3 * row + np.arange(3)
            for key, row in self._rows.items()
        ]
        # GTSAM counts from 1 and puts the right-hand side in the last column.
        place = np.concatenate([*places, [3 * m + 6 * n]])
        at = row.astype(np.int64) - 1, place[column.astype(np.int64) - 1]
        rows = int(row.max(initial=0))
        whole = csr_matrix((value, at), (rows, 3 * m + 6 * n + 1))
        jacobian, right = whole[:, :-1], whole[:, [-1]].toarray()[:, 0]
        information = (jacobian.T @ jacobian).tocsr()
        gradient = -(jacobian.T @ right)
        own, links = _diagonal_blocks(information[: 3 * m, : 3 * m])
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


def _diagonal_blocks(matrix: csr_matrix) -> tuple[FloatArray, csr_matrix]:
    """The (m, 3, 3) diagonal blocks of a sparse matrix (3m, 3m), and what is off them."""
    entries = matrix.tocoo()
    own = np.zeros((matrix.shape[0] // 3, 3, 3))
    inside = entries.row // 3 == entries.col // 3
    row, column = entries.row[inside], entries.col[inside]
    own[row // 3, row % 3, column % 3] = entries.data[inside]
    off = entries.data[~inside], (entries.row[~inside], entries.col[~inside])
    return own, csr_matrix(off, matrix.shape)


PLAIN = KernelSettings("none")
_FAR = 0.3  # of the cost: a step that gains as much has made another system of a kept one
_AT_ONCE = 20_000  # observations, of which each takes some kilobytes
_PARTS = 5  # at least, of a drive's: memory that is used again is faster than new


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
        return State(poses, landmarks_in(values)[1])

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
        seen: the observations.
        weights: (k,) of the observations; 0: left out.
        rest: the other factors.
        kernel: around each observation.
    """

    pose_keys: list[int]
    landmark_keys: list[int]
    seen: Sightings
    weights: FloatArray
    rest: OtherFactors
    kernel: KernelSettings

    @staticmethod
    def of(
        others: Any,
        values: Any,
        kernel: KernelSettings,
        seen: Sightings,
        measured: Iterable[Sightings] = (),
    ) -> tuple[WholeGraph, State]:
        """Observations, and other factors.

        Args:
            others: GTSAM's, without empty slots.
            values: of all variables.
            kernel: around each of the camera's observations.
            seen: these.
            measured: those of other sensors.
        """
        keys = poses, landmarks = keys_of(values)
        more = tuple(one.at_rows(*keys) for one in measured)
        rest = OtherFactors(others, poses, landmarks, measured=more)
        weights = np.ones(len(seen))
        graph = WholeGraph(poses, landmarks, seen.at_rows(*keys), weights, rest, kernel)
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

    def masked(self, rows: BoolArray) -> WholeGraph:
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
            seen=self.seen.of_points(kept),
            weights=self.weights[kept[self.seen.points]],
            rest=self.rest.without(gone),
        )
        return left, dataclasses.replace(state, points=state.points[kept])

    def plus(self, factor: Any) -> WholeGraph:
        """With one factor more, of poses alone."""
        return dataclasses.replace(self, rest=self.rest.plus(factor))

    def unseen(self) -> IntArray:
        """Rows of the landmarks of which no observation counts."""
        seen = [self.seen.points[self.weights > 0.0], *(one.points for one in self.rest.measured)]
        return np.setdiff1d(np.arange(len(self.landmark_keys)), np.concatenate(seen))

    # -- at a state ------------------------------------------------------------------------------

    def values(self, state: State) -> Any:
        """GTSAM values of all variables."""
        keys = [*enumerate(self.pose_keys), *enumerate(self.landmark_keys)]
        values = values_of({key: row for row, key in keys}, state.poses, state.points)
        for one, known, found in self.rest.nuisances(state.bias):
            if len(known):
                values.insert(nuisance_key(one.model.kind), found)
        return values

    def squared(self, state: State) -> FloatArray:
        """(k,) squared whitened residuals of the observations, without weights and kernel."""
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
        rows = self.seen.look(state.poses, state.points)
        squared = self.weights * np.einsum("ki,ki->k", rows.residual, rows.residual)
        weights = self.weights * kernel_weights(self.kernel.name, self.kernel.width, squared)
        return self.seen.joined(rest, rows, weights, self._incidence)

    def pulled(
        self, state: State, shifts: Callable[[IntArray], FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """What shifts of a rig's measurements do to the normal equations at a state.

        Args:
            state: where to linearise.
            shifts: from rows (k,) of measurements to displacements by p parameters (k, 3, p).

        Returns:
            Gradients (3m + 6n, p) by the parameters, and the parameters' own information (p, p).
        """
        seen, rows = self.seen, self.seen.look(state.poses, state.points)

        def of(few: IntArray) -> FloatArray:
            by = -seen.roots[few] @ shifts(few)
            incidence = (self._incidence[0][:, few], self._incidence[1][:, few])
            return _pulled(rows.select(few), by, self.weights[few], incidence)

        parts = max(_PARTS, len(seen) // _AT_ONCE + 1)
        found = reduce(np.add, map(of, np.array_split(np.arange(len(seen)), parts)))
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
    def _incidence(self) -> tuple[csr_matrix, csr_matrix]:
        """Of the observations."""
        return self.seen.incidence(len(self.pose_keys), len(self.landmark_keys))


class Descent:
    """Steps towards the minimum, Gauss and Newton's or damped.

    Near the minimum the system hardly changes from step to step: where it is kept, its factor,
    which is most of the work, serves on, for conjugate gradients.
    """

    def __init__(self, keeps: bool = True) -> None:
        """No step yet; whether it keeps the system."""
        self._keeps = keeps
        self._damping = Damping()
        self._held: GraphMarginals | None = None

    def step(
        self, graph: WholeGraph, cost: float, state: State, last_gain: float
    ) -> tuple[float, State] | None:
        """Cost and state after one step that does not raise the cost; None where none does.

        Args:
            graph: what is minimised.
            cost: at the state.
            state: before.
            last_gain: by how much the step before lowered the cost; infinite: there was none.
        """
        system = graph.linear(state)
        if self._held is not None and not _FAR * cost < last_gain < np.inf:
            found = self._kept(graph, state, system, self._held)
            if found is not None and found[0] <= cost:
                return found
        self._held = None
        return self._damping.step(cost, partial(self._tried, graph, state, system))

    def _kept(
        self,
        graph: WholeGraph,
        state: State,
        system: LinearSystem,
        held: GraphMarginals,
    ) -> tuple[float, State] | None:
        """The step by a kept system; None where a landmark has become undetermined."""
        try:
            return _after(graph, state, with_border(held.stepping(system.damped(0.0))))
        except EstimatorError:
            return None

    def _tried(
        self, graph: WholeGraph, state: State, system: LinearSystem, damping: float
    ) -> tuple[float, State]:
        solved = reduced(system.damped(damping))
        held = solved.held if isinstance(solved, Bordered) else solved
        if self._keeps and damping == 0.0 and not isinstance(held, Bordered):
            self._held = held
        return _after(graph, state, solved)


def _after(graph: WholeGraph, state: State, solved: SolvedSystem) -> tuple[float, State]:
    ahead = state.moved(solved.step())
    return graph.cost(ahead), ahead


def keys_of(values: Any) -> tuple[list[int], list[int]]:
    """Keys of the poses and of the landmarks among GTSAM values, ascending."""
    keys = list(values.keys())
    return [key for key in keys if is_pose(key)], [key for key in keys if is_landmark(key)]


def _pulled(
    rows: LinearRows, by: FloatArray, weights: FloatArray, incidence: tuple[csr_matrix, csr_matrix]
) -> FloatArray:
    """(3m + 6n + p, p) of landmarks, poses and p numbers that shift residuals by (k, m, p)."""
    known, (poses, points) = weights[:, None, None] * by, incidence
    of_points = _summed(points, np.swapaxes(rows.by_point, 1, 2) @ known)
    of_poses = _summed(poses, np.swapaxes(rows.by_pose, 1, 2) @ known)
    p = by.shape[2]
    own = by.reshape(-1, p).T @ known.reshape(-1, p)
    return np.concatenate([*of_points, *of_poses, own])


def _summed(incidence: csr_matrix, each: FloatArray) -> FloatArray:
    """Sums (g, ...) of what each observation (k, ...) adds to its group, one after another."""
    found = incidence @ each.reshape(len(each), math.prod(each.shape[1:]))
    return np.asarray(found.reshape(-1, *each.shape[1:]))
