"""The paper's estimator expressed as factor graphs, GTSAM doing the algebra.

Equal to :class:`~fgslam.backend.filters.kalman.LandmarkKalman` up to rounding: the pose
is that of a graph on fixed landmarks (Se et al. 3.3), each landmark that of its own graph (6.4).
Which edges of the full graph are missing, and what that costs, is derived in
docs/derivations/filters.md.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import gtsam
import numpy as np

from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.filters.landmark_update import FrameUpdate, Landmarks, UpdateKind
from fgslam.backend.settings import LandmarkKalmanGraphSettings
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    congruence,
    moved_apart,
    reorthonormalise,
    transform_to_camera,
    transform_to_world,
)
from fgslam.core.sensors import CameraRig, Increment, Observations
from fgslam.core.types import (
    EgoMotion,
    EgoMotionStatus,
    Floor,
    LandmarkMap,
    Prediction,
    UpdateStats,
)
from fgslam.factors.graphs import landmark_key, pose_key
from fgslam.factors.landmark import FROM_MEASUREMENT, StereoFactors
from fgslam.factors.noise import Whitening
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import MAX_ITERATIONS

_POSE, _LANDMARK = pose_key(0), landmark_key(0)
_CONVERGED = 1e-9  # radians and metres; as the front-end's, which does not take that step either
_EXACT_SIGMA = 1e-6  # radians and metres: stands for zero where the prediction has no variance
_UNIT, _ZERO = gtsam.noiseModel.Unit.Create(3), np.zeros(3)


class FixedMapPose:
    """Solves for one frame's pose: prior at the prediction, landmarks held fixed (3.3).

    Each match is GTSAM's stereo factor whose landmark column is dropped; a landmark's uncertainty,
    where it counts, is added to the measurement's noise, at the pose that the front-end's least
    squares weighted at. So the minimum is the front-end's, found by other means.
    """

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
            wTc = moved_apart(wTc, step)
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
        roots = roots @ np.linalg.inv(FROM_MEASUREMENT)
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
        """Square roots (k, 3, 3) of the information of (column, row, disparity)."""
        settings = self._settings
        covariance = observed.covariance
        if settings.weighting == "uniform":
            covariance = np.tile(np.eye(3), (len(observed), 1, 1))
        if settings.weighting == "landmark":
            rows = landmarks.rows(observed.ids)
            points = transform_to_camera(weighted_at, landmarks.positions[rows])
            jacobian = self._rig.jacobian(points) @ weighted_at[:3, :3].T
            covariance = covariance + congruence(jacobian, landmarks.covariances[rows])
        used = 3 if settings.residuals == "image_disparity" else 2
        roots = np.zeros((len(observed), 3, 3))
        roots[:, :used, :used] = np.linalg.inv(np.linalg.cholesky(covariance[:, :used, :used]))
        return roots


def _exact_prior(prediction: Prediction) -> Any:
    """``Log(predicted^-1 wTc)`` with its whole Jacobian.

    GTSAM's own prior leaves the logarithm's out, and so stops a little off the minimum.
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
    """Eliminates landmarks of one frame, whose pose is held fixed up to its covariance.

    Every landmark is given a copy of the frame's pose of its own, whose prior is the pose's
    covariance. Eliminating the copy leaves ``R + J P J^T`` as the measurement's noise. That the
    copies know nothing of each other, nor of next frame's, is all that distinguishes the paper's
    filter from the full graph.
    """

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


class EliminatedUpdate(FrameUpdate):
    """The updates by elimination, of one graph for each landmark."""

    def update_by_pixels(self, known: Landmarks, observed: Observations) -> Landmarks:
        """Stereo factor and prior of each landmark, linearised at the landmark."""
        return _moved(known, self._eliminated(known.positions, known.covariances, observed))

    def update_by_positions(self, known: Landmarks, observed: Observations) -> Landmarks:
        """Two priors on each landmark: what was known, and the position observed."""
        positions, noise = self.place(observed)
        return _moved(known, fused(known.covariances, positions - known.positions, noise))

    def update_average(
        self, known: Landmarks, observed: Observations, kind: UpdateKind, counts: FloatArray
    ) -> Landmarks:
        """Equal weights: what was known counts as its sightings (or as one), the new one as one.

        The minimum's curvature is then the weights', not the errors'. The elimination gives the
        gain, which carries the errors' covariances; the innovation is weighed by these.
        """
        positions, noise = self.place(observed)
        offsets = positions - known.positions
        one = np.tile(np.eye(3), (len(offsets), 1, 1))
        weights = counts if kind == "running_mean" else np.ones(len(offsets))
        mean = fused(one / weights[:, None, None], offsets, one)
        gain = mean.covariances  # the new sighting's information is the identity
        return Landmarks(
            known.positions + mean.steps,
            congruence(one - gain, known.covariances) + congruence(gain, noise),
            fused(known.covariances, offsets, noise).misfit,
        )

    def place(self, observed: Observations) -> tuple[FloatArray, FloatArray]:
        """A stereo factor alone, eliminated where it is met exactly."""
        points = self.rig.triangulate(observed.measurement)
        positions = transform_to_world(self.wTc, points)
        return positions, self._eliminated(positions, None, observed).covariances

    def _eliminated(
        self, positions: FloatArray, priors: FloatArray | None, observed: Observations
    ) -> Eliminated:
        factors = StereoFactors(self.rig, Whitening())
        values = gtsam.Values()
        values.insert(_POSE, gtsam.Pose3(self.wTc))
        values.insert(_LANDMARK, np.zeros(3))
        linear = []
        for position, measured, noise in zip(
            positions, observed.measurement, observed.covariance, strict=True
        ):
            values.update(_LANDMARK, position)
            linear.append(factors.factor(_POSE, _LANDMARK, measured, noise).linearize(values))
        return LandmarkElimination(self.pose_covariance).observed(linear, priors)


def _moved(known: Landmarks, found: Eliminated) -> Landmarks:
    return Landmarks(known.positions + found.steps, found.covariances, found.misfit)


class LandmarkKalmanGraph(LandmarkKalman):
    """Estimator of kind ``landmark_kalman_graph``; all but the updates is the closed form's."""

    kind: ClassVar[str] = "landmark_kalman_graph"
    updates: ClassVar[type[FrameUpdate]] = EliminatedUpdate

    def __init__(
        self,
        rig: CameraRig,
        settings: LandmarkKalmanGraphSettings,
        prior: Prediction,
        ego_motion: EgoMotionSettings,
    ) -> None:
        """Starts at the prior pose with an empty map.

        Args:
            rig: the cameras.
            settings: which update, and its noise.
            prior: pose of the first frame and its covariance.
            ego_motion: the front-end's, whose cost the pose's graph repeats.
        """
        super().__init__(rig, settings, prior, ego_motion)
        self._pose_graph = FixedMapPose(rig, ego_motion)

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """As the closed form, with the frame's pose from its graph.

        Where the tracking found no minimum (first frame, too few matches, capped, no image), the
        pose is the tracking's.
        """
        _require_depth(increment, tracking.inliers, self._settings.update != "pixel")
        if tracking.status is EgoMotionStatus.OK and tracking.weighted_at is not None:
            matched = increment.observations.select(~increment.observations.is_new)
            found = self._pose_graph.solve(
                self.predict(increment.odometry),
                tracking.weighted_at,
                self.landmarks(),
                matched.select(tracking.inliers),
            )
            tracking = dataclasses.replace(tracking, wTc=found.wTc, covariance=found.covariance)
        return super().update(increment, tracking)


def _require_depth(increment: Increment, inliers: BoolArray, world: bool) -> None:
    """A factor of a point at infinity or behind constrains nothing: there is nothing to invert.

    Where observed positions are fused (all but ``pixel``), this goes for matches, too.
    """
    seen = increment.observations
    placed = seen.is_new.copy()
    if world:
        placed[~seen.is_new] = inliers
    without = seen.ids[placed & (seen.measurement[:, 2] <= 0.0)]
    if len(without):
        raise EstimatorError(
            f"frame {increment.index}: landmark {without[0]} has no positive disparity; leave "
            "such observations out of the log"
        )
