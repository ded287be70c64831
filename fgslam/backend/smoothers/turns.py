"""Turns of a gyroscope in a whole graph, whose bias is a variable of it.

The bias walks: it is linear in time between nodes, and the nodes are a random walk. A node lies
wherever the walk would come out of the white noise; a drive of any length has few, so they are the
graph's border (:mod:`border`). docs/derivations/gyroscope.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix

from fgslam.backend.smoothers.border import Border
from fgslam.backend.smoothers.marginals import LinearSystem
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.geometry import adjoint, compose_covariance, inverse
from fgslam.core.measurements import BiasEffect, Odometry
from fgslam.factors.noise import positive_definite
from fgslam.factors.stacked import whitening

_MOST_NODES = 17  # a bound for the work: every two minutes in a drive of half an hour


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """What a bias does to a step of the graph, which may be of several frames.

    Attributes:
        jacobian: (6, 3) of the step's tangent vector, at its end, by the bias.
        applied: (6,) what the step's motion contains of that.
        unknown: (6, 6) what the step's covariance contains of it.
        start_variance, walk: as :class:`fgslam.core.measurements.BiasEffect`.
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
        noise = [scale[:, None] * (s.step.covariance - s.turn.unknown) * scale for s in steps]
        jacobians = np.array([s.turn.jacobian for s in steps])
        nodes, known = _nodes([s.turn for s in steps], np.array([n[:3, :3] for n in noise]))
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
        """(3q,) the likeliest bias for these poses."""
        none = np.zeros(len(self.known))
        by_bias = self._by_bias()
        gradient = by_bias.T @ self.residuals(poses, none).ravel()
        return np.asarray(-np.linalg.solve(by_bias.T @ by_bias + self.known, gradient))

    def joined(self, system: LinearSystem, poses: FloatArray, bias: FloatArray) -> LinearSystem:
        """Normal equations with these steps, at a state; derivatives as of a small residual."""
        k, n = len(self.before), len(poses)
        back = adjoint(inverse(poses[self.after]) @ poses[self.before])
        blocks = np.stack([-self.roots @ back, self.roots], axis=1).reshape(-1, 6, 6)
        columns = np.column_stack([self.before, self.after]).ravel()
        by_pose = bsr_matrix((blocks, columns, 2 * np.arange(k + 1)), (6 * k, 6 * n)).tocsr()
        residual, by_bias = self.residuals(poses, bias).ravel(), self._by_bias()
        border = Border(
            by_pose.T @ by_bias,
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


def _nodes(turns: Sequence[Turn], noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights (k, q) of the nodes in each step, and (3q, 3q) what is known of them beforehand.

    After a time of sqrt(3) times white noise over walk, the random walk is as large as the mean of
    the white noise (where their Allan deviations cross); two nodes lie in each such time.
    """
    duration = np.array([np.linalg.norm(turn.jacobian[:3]) for turn in turns]) / np.sqrt(3.0)
    end, walk = np.cumsum(duration), sum(turn.walk for turn in turns)
    white = float(np.trace(noise, axis1=1, axis2=2).sum()) / 3.0
    crossing = np.sqrt(3.0 * white / walk) if walk > 0.0 else np.inf
    first = np.eye(3) / turns[0].start_variance
    intervals = int(min(np.ceil(2.0 * end[-1] / crossing), _MOST_NODES - 1))
    if not intervals:
        return np.ones((len(turns), 1)), first
    at = intervals * (end - 0.5 * duration) / end[-1]
    nodes = np.maximum(1.0 - np.abs(at[:, None] - np.arange(intervals + 1)), 0.0)
    steps = np.diff(np.eye(intervals + 1), axis=0) * np.sqrt(intervals / walk)
    known = np.kron(steps.T @ steps, np.eye(3))
    known[:3, :3] += first
    return nodes, known
