"""One landmark's Kalman update as a factor graph: prior and measurement, eliminated by GTSAM.

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

from fgslam.factors.keys import landmark_key, pose_key
from fgslam.types import FloatArray

_POSE, _LANDMARK = pose_key(0), landmark_key(0)


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """A landmark after its graph's elimination.

    Attributes:
        step: (3,) its offset from the point of linearisation, metres.
        covariance: (3, 3) metres squared.
        misfit: what remains of the squared whitened residual: the innovation squared.
    """

    step: FloatArray
    covariance: FloatArray
    misfit: float


class LandmarkElimination:
    """Eliminates landmarks of one frame, whose pose is held fixed up to its covariance."""

    def __init__(self, pose_covariance: FloatArray | None) -> None:
        """``pose_covariance`` (6, 6) may be singular; None takes the pose as exact."""
        self._root = np.empty((6, 0)) if pose_covariance is None else _root(pose_covariance)
        self._order = gtsam.Ordering()
        if self._root.shape[1]:
            self._order.push_back(_POSE)
        self._order.push_back(_LANDMARK)

    def observed(self, factor: Any, values: Any, prior: FloatArray | None) -> Eliminated:
        """A factor of pose and landmark, and the landmark's prior.

        Args:
            factor: GTSAM's, between ``pose_key(0)`` and ``landmark_key(0)``.
            values: the pose, and the landmark where the prior is centred.
            prior: (3, 3) covariance of the landmark; None for a new one.
        """
        a, b = factor.linearize(values).jacobian()
        return self._eliminate(a[:, :6] @ self._root, a[:, 6:], b, prior)

    def _eliminate(
        self,
        by_pose: FloatArray,
        by_landmark: FloatArray,
        rhs: FloatArray,
        prior: FloatArray | None,
    ) -> Eliminated:
        graph = gtsam.GaussianFactorGraph()
        rank = by_pose.shape[1]
        unit = gtsam.noiseModel.Unit.Create
        if rank:
            graph.add(_POSE, np.eye(rank), np.zeros(rank), unit(rank))
            graph.add(_POSE, by_pose, _LANDMARK, by_landmark, rhs, unit(3))
        else:
            graph.add(_LANDMARK, by_landmark, rhs, unit(3))
        if prior is not None:
            graph.add(_LANDMARK, whitening(prior), np.zeros(3), unit(3))
        return _eliminated(gtsam.JacobianFactor(graph, self._order), self._order)


def fused(prior: FloatArray, offset: FloatArray, noise: FloatArray) -> Eliminated:
    """A landmark's prior and a position measured ``offset`` (3,) from it with ``noise`` (3, 3)."""
    values = gtsam.Values()
    values.insert(_LANDMARK, np.zeros(3))
    graph = gtsam.NonlinearFactorGraph()
    for centre, covariance in ((np.zeros(3), prior), (offset, noise)):
        model = gtsam.noiseModel.Gaussian.SqrtInformation(whitening(covariance))
        graph.add(gtsam.PriorFactorPoint3(_LANDMARK, centre, model))
    order = gtsam.Ordering()
    order.push_back(_LANDMARK)
    return _eliminated(gtsam.JacobianFactor(graph.linearize(values), order), order)


def whitening(covariance: FloatArray) -> FloatArray:
    """Upper triangular W with ``W^T W`` the inverse of a positive definite covariance (n, n).

    Upper, because GTSAM's ``SqrtInformation`` takes a lower triangular matrix for its diagonal.
    """
    upper = np.linalg.cholesky(covariance[::-1, ::-1])[::-1, ::-1]
    return np.asarray(np.linalg.inv(upper))


def _eliminated(joint: Any, order: Any) -> Eliminated:
    """By QR, the landmark last, so that its rows stand on their own.

    Cholesky would square the condition of a far landmark's long ellipsoid.
    """
    conditional, _ = joint.eliminate(order)
    inverse, rhs, kept = np.linalg.inv(conditional.R()[-3:, -3:]), joint.getb(), conditional.d()
    # Q is orthogonal: what the right-hand side lost in length is the residual at the minimum.
    misfit = max(float(rhs @ rhs - kept @ kept), 0.0)
    return Eliminated(inverse @ kept[-3:], inverse @ inverse.T, misfit)


def _root(covariance: FloatArray) -> FloatArray:
    """(6, r) with ``S S^T`` the covariance of rank r."""
    variances, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    kept = variances > 1e-15 * max(variances[-1], 1e-300)
    return np.asarray(directions[:, kept] * np.sqrt(variances[kept]))
