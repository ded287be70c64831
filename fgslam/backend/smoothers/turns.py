"""Turns of a gyroscope in a whole graph, whose bias is a variable of it.

The bias walks: it is linear in time between nodes, and the nodes are a random walk. A node lies
wherever the walk would come out of the white noise; a drive of any length has few, so they are the
graph's border (:mod:`border`). How far the walk is off that line between two nodes is white noise
more, which says what it is where the drive is long. docs/derivations/gyroscope.md.
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
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import adjoint, compose_covariance, inverse
from fgslam.core.measurements import BiasEffect, Odometry
from fgslam.factors.landmark import whitening
from fgslam.factors.noise import positive_definite

_MOST_NODES = 17  # a bound for the work: every two minutes in a drive of half an hour
_NO_WALK = 0.01  # of the time after which the walk counts: less than 1e-4 of the variance is its


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
