"""The paper's pose as a factor graph: prior at the prediction, landmarks held fixed (3.3).

Each match is GTSAM's stereo factor whose landmark column is dropped; a landmark's uncertainty,
where it counts, is added to the measurement's noise, at the pose that the front-end's least
squares weighted at. So the minimum is the front-end's, found by other means.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.backend.filters.landmark_elimination import whitening
from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import LandmarkMap, Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    congruence,
    pose,
    projection_jacobian,
    reorthonormalise,
    so3_exp,
    transform_to_camera,
)
from fgslam.core.measurements import Observations
from fgslam.core.sensors import CameraRig
from fgslam.factors.keys import landmark_key, pose_key
from fgslam.factors.noise import Whitening
from fgslam.factors.stereo import FROM_MEASUREMENT, StereoFactors
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import MAX_ITERATIONS

_POSE = pose_key(0)
_CONVERGED = 1e-9  # radians and metres; as the front-end's, which does not take that step either
_EXACT_SIGMA = 1e-6  # radians and metres: stands for zero where the prediction has no variance


class FixedMapPose:
    """Solves for one frame's pose."""

    def __init__(self, rig: CameraRig, settings: EgoMotionSettings) -> None:
        """``settings`` are the front-end's, so that both minimise the same cost."""
        self._rig = rig
        self._settings = settings
        self._floor = Floor.under(rig, settings.dof)
        self._factors = StereoFactors(rig, Whitening())

    def solve(
        self,
        prediction: Prediction,
        weighted_at: FloatArray,
        landmarks: LandmarkMap,
        observed: Observations,
    ) -> Prediction:
        """Gauss-Newton on the floor, from ``weighted_at``; pose and covariance at the minimum."""
        graph = self._graph(prediction, weighted_at, landmarks, observed)
        values = gtsam.Values()
        rows = landmarks.rows(observed.ids)
        for i, position in enumerate(landmarks.positions[rows]):
            values.insert(landmark_key(i), position)
        values.insert(_POSE, gtsam.Pose3(weighted_at))
        wTc = weighted_at
        for _ in range(MAX_ITERATIONS):
            basis = self._floor.basis(wTc)
            step, covariance = _solved(_pose_columns(graph.linearize(values)), basis)
            if np.abs(step).max() < _CONVERGED:
                break
            wTc = pose(wTc[:3, :3] @ so3_exp(step[:3]), wTc[:3, 3] + wTc[:3, :3] @ step[3:])
            values.update(_POSE, gtsam.Pose3(wTc))
        return Prediction(reorthonormalise(wTc), covariance)

    def _graph(
        self,
        prediction: Prediction,
        weighted_at: FloatArray,
        landmarks: LandmarkMap,
        observed: Observations,
    ) -> Any:
        graph = gtsam.NonlinearFactorGraph()
        roots = self._roots(weighted_at, landmarks, observed)
        for i, (measured, root) in enumerate(zip(observed.measurement, roots, strict=True)):
            model = gtsam.noiseModel.Gaussian.SqrtInformation(root)
            graph.add(self._factors.with_model(_POSE, landmark_key(i), measured, model))
        if self._settings.prior:
            wTp = Prediction(self._floor.constrain(prediction.wTc), prediction.covariance)
            graph.add(_exact_prior(wTp))
        return graph

    def _roots(
        self, weighted_at: FloatArray, landmarks: LandmarkMap, observed: Observations
    ) -> FloatArray:
        """Square roots (k, 3, 3) of the information of (u_left, u_right, v)."""
        settings = self._settings
        covariance = observed.covariance
        if settings.weighting == "uniform":
            covariance = np.tile(np.eye(3), (len(observed), 1, 1))
        if settings.weighting == "landmark":
            rows = landmarks.rows(observed.ids)
            points = transform_to_camera(weighted_at, landmarks.positions[rows])
            jacobian = projection_jacobian(self._rig, points) @ weighted_at[:3, :3].T
            covariance = covariance + congruence(jacobian, landmarks.covariances[rows])
        used = 3 if settings.residuals == "image_disparity" else 2
        roots = np.zeros((len(observed), 3, 3))
        roots[:, :used, :used] = np.linalg.inv(np.linalg.cholesky(covariance[:, :used, :used]))
        return np.asarray(roots @ np.linalg.inv(FROM_MEASUREMENT))


def _exact_prior(prediction: Prediction) -> Any:
    """``Log(predicted^-1 wTc)`` with its whole Jacobian.

    GTSAM's own prior leaves the logarithm's out, and so stops a little beside the minimum.
    """
    predicted = gtsam.Pose3(prediction.wTc).inverse()
    covariance = 0.5 * (prediction.covariance + prediction.covariance.T)
    try:
        root = whitening(covariance)
    except np.linalg.LinAlgError:
        root = whitening(covariance + _EXACT_SIGMA**2 * np.eye(6))
    model = gtsam.noiseModel.Gaussian.SqrtInformation(root)

    def error(factor: Any, values: Any, jacobians: Any) -> FloatArray:
        deviation = predicted.compose(values.atPose3(factor.keys()[0]))
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(gtsam.Pose3.LogmapDerivative(deviation))
        return np.asarray(gtsam.Pose3.Logmap(deviation))

    return gtsam.CustomFactor(model, [_POSE], error)


def _pose_columns(linear: Any) -> tuple[FloatArray, FloatArray]:
    """Whitened Jacobian (m, 6) and right-hand side (m,); the landmarks' columns are dropped."""
    parts = [linear.at(i).jacobian() for i in range(linear.size())]
    return np.concatenate([a[:, :6] for a, _ in parts]), np.concatenate([b for _, b in parts])


def _solved(
    system: tuple[FloatArray, FloatArray], basis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Step (6,) and covariance (6, 6) within the floor's directions; GTSAM eliminates by QR."""
    matrix, rhs = system
    unit = gtsam.noiseModel.Unit.Create(len(rhs))
    order = gtsam.Ordering()
    order.push_back(_POSE)
    factor = gtsam.JacobianFactor(_POSE, matrix @ basis, rhs, unit)
    conditional, _ = factor.eliminate(order)
    root = basis @ np.linalg.inv(conditional.R())
    return root @ conditional.d(), root @ root.T
