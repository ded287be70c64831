"""A landmark's Kalman update as a factor graph: prior and measurement, eliminated by GTSAM.

Every landmark is given a copy of the frame's pose of its own, whose prior is the pose's covariance.
Eliminating the copy leaves ``R + J P J^T`` as the measurement's noise. That the copies know nothing
of each other, nor of next frame's, is all that distinguishes the paper's filter from the full
graph; see docs/derivations/landmark_filter_as_graph.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.factors.keys import landmark_key, pose_key

_POSE, _LANDMARK = pose_key(0), landmark_key(0)
_UNIT, _ZERO = gtsam.noiseModel.Unit.Create(3), np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """Landmarks after their graphs' elimination.

    Attributes:
        steps: (k, 3) their offsets from the points of linearisation, metres.
        covariances: (k, 3, 3) metres squared.
        misfit: what remains of the squared whitened residuals: the innovations squared, summed.
    """

    steps: FloatArray
    covariances: FloatArray
    misfit: float


class LandmarkElimination:
    """Eliminates landmarks of one frame, whose pose is held fixed up to its covariance."""

    def __init__(self, pose_covariance: FloatArray | None) -> None:
        """``pose_covariance`` (6, 6) may be singular; None takes the pose as exact."""
        self._root = np.empty((6, 0)) if pose_covariance is None else _root(pose_covariance)
        self._rank = self._root.shape[1]
        self._order = gtsam.Ordering()
        if self._rank:
            self._order.push_back(_POSE)
        self._order.push_back(_LANDMARK)
        self._by_itself = np.eye(self._rank), np.zeros(self._rank)
        self._unit_pose = gtsam.noiseModel.Unit.Create(self._rank)

    def observed(self, linear: list[Any], priors: FloatArray | None) -> Eliminated:
        """A factor of pose and landmark, and the landmark's prior, for each of them.

        Args:
            linear: GTSAM's factors between ``pose_key(0)`` and ``landmark_key(0)``, linearised
                at the pose, and at the landmark where its prior is centred.
            priors: (k, 3, 3) covariances of the landmarks; None for new ones.
        """
        systems = [factor.jacobian() for factor in linear]
        matrices = np.array([a for a, _ in systems]).reshape(-1, 3, 9)
        by_pose = matrices[:, :, :6] @ self._root
        known = [None] * len(linear) if priors is None else whitening(priors)
        given = zip(by_pose, matrices[:, :, 6:], (b for _, b in systems), known, strict=True)
        return _eliminated([self._graph(*of_one) for of_one in given], self._order)

    def _graph(
        self,
        by_pose: FloatArray,
        by_landmark: FloatArray,
        rhs: FloatArray,
        known: FloatArray | None,
    ) -> Any:
        graph = gtsam.GaussianFactorGraph()
        if self._rank:
            matrix, zero = self._by_itself
            graph.add(_POSE, matrix, zero, self._unit_pose)
            graph.add(_POSE, by_pose, _LANDMARK, by_landmark, rhs, _UNIT)
        else:
            graph.add(_LANDMARK, by_landmark, rhs, _UNIT)
        if known is not None:
            graph.add(_LANDMARK, known, _ZERO, _UNIT)
        return graph


def fused(priors: FloatArray, offsets: FloatArray, noise: FloatArray) -> Eliminated:
    """Landmarks' priors, and positions measured ``offsets`` (k, 3) from them with ``noise``."""
    values = gtsam.Values()
    values.insert(_LANDMARK, _ZERO)
    order = gtsam.Ordering()
    order.push_back(_LANDMARK)
    model = gtsam.noiseModel.Gaussian.SqrtInformation
    graphs = []
    for known, offset, measured in zip(whitening(priors), offsets, whitening(noise), strict=True):
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.PriorFactorPoint3(_LANDMARK, _ZERO, model(known)))
        graph.add(gtsam.PriorFactorPoint3(_LANDMARK, offset, model(measured)))
        graphs.append(graph.linearize(values))
    return _eliminated(graphs, order)


def whitening(covariance: FloatArray) -> FloatArray:
    """Upper triangular W with ``W^T W`` the inverse of positive definite covariances (..., n, n).

    Upper, because GTSAM's ``SqrtInformation`` takes a lower triangular matrix for its diagonal.
    """
    upper = np.linalg.cholesky(covariance[..., ::-1, ::-1])[..., ::-1, ::-1]
    return np.asarray(np.linalg.inv(upper))


def _eliminated(graphs: list[Any], order: Any) -> Eliminated:
    """By QR, the landmark last, so that its rows stand on their own.

    Cholesky would square the condition of a far landmark's long ellipsoid.
    """
    roots, kept, misfit = np.empty((len(graphs), 3, 3)), np.empty((len(graphs), 3)), 0.0
    for i, graph in enumerate(graphs):
        joint = gtsam.JacobianFactor(graph, order)
        conditional, _ = joint.eliminate(order)
        rhs, left = joint.getb(), conditional.d()
        roots[i], kept[i] = conditional.R()[-3:, -3:], left[-3:]
        # Q is orthogonal: what the right-hand side lost in length is the residual at the minimum.
        misfit += max(float(rhs @ rhs - left @ left), 0.0)
    inverse = np.linalg.inv(roots)
    steps = (inverse @ kept[:, :, None])[:, :, 0]
    return Eliminated(steps, np.asarray(inverse @ np.swapaxes(inverse, 1, 2)), misfit)


def _root(covariance: FloatArray) -> FloatArray:
    """(6, r) with ``S S^T`` the covariance of rank r."""
    variances, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    kept = variances > 1e-15 * max(variances[-1], 1e-300)
    return np.asarray(directions[:, kept] * np.sqrt(variances[kept]))
