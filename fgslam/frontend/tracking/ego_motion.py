"""Pose of a frame by least squares on image residuals against the map (Se et al. 3.3 and 5).

Newton's method in its Gauss-Newton form with analytic Jacobians, Lowe's stabilisation towards the
odometry (Lowe 1991), Levenberg's damping where a step would raise the cost, repeated
after outliers are dropped, and capped.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows, chi_square_quantile
from fgslam.core.geometry import (
    congruence,
    in_front,
    inverse,
    inverse_spd3,
    point_pose_jacobian,
    pose,
    reorthonormalise,
    se3_exp,
    se3_log,
    so3_exp,
    transform_to_camera,
)
from fgslam.core.sensors import UNKNOWN_DISPARITY_PX, CameraRig, Observations, measures_one_image
from fgslam.core.store import Kept
from fgslam.core.types import EgoMotion, EgoMotionStatus, Floor, LandmarkMap, Prediction
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.pose_fit import ROBUST, fit_pose

_STEP_TOLERANCE = 1e-9  # radians and metres; far below anything measurable
_ROBUST_TOLERANCE = 1e-5  # the robust minimum only chooses the inliers for the exact one
_REPEATS = 10  # minimisations with the remaining matches; two suffice on all recordings tried
MAX_ITERATIONS = 15  # Newton steps of a minimisation, at most
_EXACT_SIGMA = 1e-6  # radians and metres; stands for zero where a covariance is singular
_UNKNOWN = UNKNOWN_DISPARITY_PX**2
_CAP_SIGMAS = 6.0  # deviations of the prediction that a correction may amount to
_LEAST_CURVATURE = 1e-10  # of the Hessian with unit diagonal; below it the pose is undetermined


class EgoMotionSolver:
    """Solves for ``wTc`` from matched landmarks and a predicted pose."""

    def __init__(self, sensor: CameraRig, settings: EgoMotionSettings) -> None:
        """The world's vertical is that of the robot's body in the first camera frame."""
        self.sensor = sensor
        self._settings = settings
        self.floor = Floor.under(sensor, settings.dof)
        """Which poses are allowed."""
        self._camera = np.array([sensor.fx, sensor.fy, sensor.cx, sensor.cy, sensor.baseline])
        self.noise = MatchNoise()
        """Of the measurements; the caller has it learn each frame."""
        self._judges = settings.outlier_sigmas > 0.0 and settings.weighting != "uniform"
        numbers = 3 if settings.residuals == "image_disparity" else 2
        self._median = float(chi_square_quantile(0.5, numbers))

    def solve(self, prediction: Prediction, problem: PoseProblem) -> EgoMotion:
        """Pose with covariance, inliers, residuals and a status; the odometry's where it fails."""
        prediction = Prediction(self.floor.constrain(prediction.wTc), prediction.covariance)
        start = prediction.wTc
        used = inliers = in_front(transform_to_camera(start, problem.points))
        iterations = 0
        wTc, robust = start, self._settings.kernel != "none"
        weights = self._information(wTc, problem)
        for _ in range(_REPEATS):
            if inliers.sum() < self._settings.min_matches:
                return self._fall_back(prediction, problem, EgoMotionStatus.TOO_FEW_MATCHES)
            weighted_at = wTc
            chosen = problem.select(inliers)
            minimum = self._minimise(wTc, prediction, chosen, weights[inliers], robust)
            iterations += minimum.iterations
            if not minimum.converged:
                return self._fall_back(prediction, problem, EgoMotionStatus.DIVERGED)
            wTc = minimum.wTc
            weights = self._information(wTc, problem)
            measured = self._measured(wTc, problem)
            kept = self._inliers(*measured, weights)
            if not robust and np.array_equal(kept, inliers):
                break
            used, inliers, robust = inliers, kept, False
        else:
            inliers = used  # the set did not come to rest: the pose is that of the last one used
        found = self._finish(prediction, problem, minimum, inliers, iterations)
        misfit = self._misfit(*measured, weights)
        noise = self.noise.variance
        return dataclasses.replace(found, weighted_at=weighted_at, noise=noise, misfit=misfit)

    def _information(
        self, wTc: FloatArray, problem: PoseProblem, noise: float | None = None
    ) -> FloatArray:
        """Inverse covariances (k, 3, 3) of the residuals; the disparity's row 0 if unused.

        The stated ones times ``noise``, by default as known now: landmarks are made of such
        measurements, and theirs are too small by as much.
        """
        settings = self._settings
        if settings.weighting == "uniform":
            covariance = np.tile(np.eye(3), (len(problem), 1, 1))
            covariance[measures_one_image(problem.measurement_covariance), 2, 2] = _UNKNOWN
        else:
            covariance = problem.measurement_covariance
        if settings.weighting == "landmark":
            points = transform_to_camera(wTc, problem.points)
            points[~in_front(points)] = (0.0, 0.0, 1.0)  # of no use
            jacobian = self.sensor.jacobian(points) @ wTc[:3, :3].T
            covariance = covariance + congruence(jacobian, problem.point_covariances)
        covariance = covariance * (self.noise.variance if noise is None else noise)
        if settings.residuals == "image_disparity":
            return inverse_spd3(covariance)
        out = np.zeros_like(covariance)
        out[:, :2, :2] = np.linalg.inv(covariance[:, :2, :2])
        return out

    def _minimise(
        self,
        start: FloatArray,
        prediction: Prediction,
        problem: PoseProblem,
        information: FloatArray,
        robust: bool,
    ) -> _Minimum:
        """The pose from ``start``; not converged where the matches leave it undetermined."""
        tolerance = _ROBUST_TOLERANCE if robust else _STEP_TOLERANCE
        kernel = ROBUST.index(self._settings.kernel) if robust else 0
        system, state, predicted = np.zeros((2, 7, 6)), np.zeros(2), prediction.wTc
        moved = inverse(predicted) @ start
        fit_pose(
            transform_to_camera(predicted, problem.points), problem.measurement, information,
            self._camera, self._known(prediction), self.floor.basis(predicted), kernel, tolerance,
            MAX_ITERATIONS, moved, system, state, np.zeros((7, 6, 6)),
        )  # fmt: skip
        wTc, hessian = predicted @ moved if state[1] else start, system[0, :6]
        found = bool(state[1]) and self._determined(wTc, hessian)
        return _Minimum(wTc, hessian, found, int(state[0]))

    def _known(self, prediction: Prediction) -> FloatArray:
        """Information (6, 6) of the prediction, where it has a say; else zeros.

        A direction known exactly counts as known to a micrometre.
        """
        if not self._settings.prior:
            return np.zeros((6, 6))
        try:
            return _inverse_spd(prediction.covariance)
        except np.linalg.LinAlgError:
            return _inverse_spd(prediction.covariance + _EXACT_SIGMA**2 * np.eye(6))

    def _determined(self, wTc: FloatArray, hessian: FloatArray) -> bool:
        """True if the matches (and the prior) determine all degrees of freedom."""
        basis = self.floor.basis(wTc)
        reduced = basis.T @ hessian @ basis
        size = np.sqrt(np.diagonal(reduced))
        if not (size > 0.0).all():
            return False
        return bool(np.linalg.eigvalsh(reduced / np.outer(size, size))[0] > _LEAST_CURVATURE)

    def _measured(self, wTc: FloatArray, problem: PoseProblem) -> tuple[FloatArray, FloatArray]:
        """Residuals (..., k, 3), and distances (..., k) in the image; inf if behind."""
        every = transform_to_camera(wTc, problem.points)
        points = every.reshape(-1, 3)
        behind = ~in_front(points)
        points[behind] = (0.0, 0.0, 1.0)
        measurement = np.broadcast_to(problem.measurement, every.shape).reshape(-1, 3)
        residual = self.sensor.predict(points) - measurement
        across, down = residual[:, 0], residual[:, 1]
        distance = np.where(behind, np.inf, np.sqrt(across * across + down * down))
        return residual.reshape(every.shape), distance.reshape(every.shape[:-1])

    @property
    def farthest(self) -> float:
        """Largest image residual of an inlier, pixels."""
        return self._settings.outlier_px

    def _inliers(
        self, residual: FloatArray, distance: FloatArray, information: FloatArray
    ) -> BoolArray:
        near = distance <= self.farthest  # so in front, too
        if self._judges:
            squared = _squared(residual[near], information[near])
            near[near] = squared <= self._settings.outlier_sigmas**2
        return near

    def _finish(
        self,
        prediction: Prediction,
        problem: PoseProblem,
        minimum: _Minimum,
        inliers: BoolArray,
        iterations: int,
    ) -> EgoMotion:
        correction = se3_log(inverse(prediction.wTc) @ minimum.wTc)
        allowed = self._allowed_fraction(correction, prediction.covariance)
        wTc, status = minimum.wTc, EgoMotionStatus.OK
        covariance = self._covariance(wTc, minimum.hessian)
        if allowed < 1.0:
            status = EgoMotionStatus.CAPPED
            wTc = self.floor.constrain(prediction.wTc @ se3_exp(allowed * correction))
            # The matches belong to another pose; what of it was cut off is the least we may err.
            measured = self._measured(wTc, problem)
            inliers = inliers & self._inliers(*measured, self._information(wTc, problem))
            cut_off = (1.0 - allowed) * correction
            covariance = self.floor.allowed_part(
                wTc, prediction.covariance + np.outer(cut_off, cut_off)
            )
        return EgoMotion(
            wTc=reorthonormalise(wTc),
            covariance=covariance,
            inliers=inliers,
            residuals=self.image_residuals(wTc, problem),
            status=status,
            iterations=iterations,
        )

    def _allowed_fraction(self, correction: FloatArray, predicted: FloatArray) -> float:
        """Fraction of the correction that is applied under the cap (section 5).

        The cap is the settings' own; where the prediction has a say, also what its covariance
        (6, 6) makes possible.
        """
        settings = self._settings
        size = np.linalg.norm(correction.reshape(2, 3), axis=1)
        cap = np.array([np.deg2rad(settings.max_correction_deg), settings.max_correction_m])
        if settings.prior:
            largest = np.diagonal(predicted).reshape(2, 3).max(axis=1)
            cap = np.maximum(cap, _CAP_SIGMAS * np.sqrt(largest))
        return float(min(1.0, *(cap / np.maximum(size, 1e-12))))

    def _covariance(self, wTc: FloatArray, hessian: FloatArray) -> FloatArray:
        basis = self.floor.basis(wTc)
        return congruence(basis, _inverse_spd(basis.T @ hessian @ basis))

    def _fall_back(
        self, prediction: Prediction, problem: PoseProblem, status: EgoMotionStatus
    ) -> EgoMotion:
        """The odometry as the frame's ego-motion (4.1); no match is used."""
        return EgoMotion(
            wTc=reorthonormalise(prediction.wTc),
            covariance=self.floor.allowed_part(prediction.wTc, prediction.covariance),
            inliers=np.zeros(len(problem), np.bool_),
            residuals=self.image_residuals(prediction.wTc, problem),
            status=status,
            iterations=0,
        )

    def _misfit(self, residual: FloatArray, distance: FloatArray, information: FloatArray) -> float:
        """Variance of the residuals over the stated one, by the median of their squares.

        NaN where matches are not judged by their deviations, or none is ahead.
        """
        if not self._judges:
            return math.nan
        ahead = np.isfinite(distance)
        if not ahead.any():
            return math.nan
        squared = _squared(residual[ahead], information[ahead])
        return self.noise.variance * float(np.median(squared)) / self._median

    def image_residuals(self, wTc: FloatArray, problem: PoseProblem) -> FloatArray:
        """The paper's E (..., k), distance of projection and measurement in the image; inf behind.

        Of poses (..., 4, 4), in pixels.
        """
        return self._measured(wTc, problem)[1]

    def gain(
        self, wTc: FloatArray, prediction: Prediction, problem: PoseProblem, noise: float
    ) -> tuple[FloatArray, FloatArray]:
        """How the solution follows what it is found from, to first order.

        Args:
            wTc: (4, 4) the solution.
            prediction: that it was stabilised towards.
            problem: the inliers.
            noise: variance over the stated one that they were taken to have.

        Returns:
            Derivatives of the pose's tangent vector by the prediction's (6, 6), and by the
            measurements (k, 6, 3): ``(sum J^T W J + P^-1)^-1`` times ``P^-1`` and ``J^T W``.
        """
        points = transform_to_camera(wTc, problem.points)
        jacobian = self.sensor.jacobian(points) @ point_pose_jacobian(points)
        pull = np.swapaxes(jacobian, 1, 2) @ self._information(wTc, problem, noise)
        known = self._known(prediction)
        hessian = (pull @ jacobian).sum(axis=0) + known
        covariance = self._covariance(wTc, hessian)
        return covariance @ known, covariance @ pull


def _squared(residual: FloatArray, information: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("ki,kij,kj->k", residual, information, residual))


def _inverse_spd(matrix: FloatArray) -> FloatArray:
    inverted = np.linalg.inv(matrix)
    return np.asarray(0.5 * (inverted + inverted.T))


def unmeasured(prediction: Prediction, status: EgoMotionStatus) -> EgoMotion:
    """Ego-motion equal to the prediction, for a frame without matches."""
    return EgoMotion(
        prediction.wTc, prediction.covariance, np.empty(0, np.bool_), np.empty(0), status, 0
    )


@dataclass(frozen=True, slots=True, eq=False)
class PoseProblem(Rows):
    """Matches of one frame: landmark positions and covariances, measurements and theirs.

    Attributes:
        points: (k, 3) world, metres.
        point_covariances: (k, 3, 3).
        measurement: (k, 3) (column, row, disparity), pixels.
        measurement_covariance: (k, 3, 3).
    """

    points: FloatArray
    point_covariances: FloatArray
    measurement: FloatArray
    measurement_covariance: FloatArray

    @staticmethod
    def of(landmarks: LandmarkMap, observed: Observations) -> PoseProblem:
        """The observations of landmarks that are in the map. KeyError for one that is not."""
        rows = landmarks.rows(observed.ids)
        return PoseProblem(
            landmarks.positions[rows],
            landmarks.covariances[rows],
            observed.measurement,
            observed.covariance,
        )

    @staticmethod
    def empty() -> PoseProblem:
        """No match at all."""
        vectors, matrices = np.empty((0, 3)), np.empty((0, 3, 3))
        return PoseProblem(vectors, matrices, vectors, matrices)


@dataclass(frozen=True, slots=True, eq=False)
class _Minimum:
    wTc: FloatArray
    hessian: FloatArray
    converged: bool
    iterations: int


# ------------------------------------------------------------------------------------------
# How large the errors of matches are, from how a drive's frames fit the map

_FRAMES = 30  # latest ones that count: as many sightings as the longest track that is judged
_STATED = 2  # frames that the stated noise counts for: three must contradict it
_LEAST_NOISE = 2.0
"""Variance over the stated one from which on that is rejected: a gate of four deviations loses
one right match in twenty."""


class MatchNoise:
    """Variance of a drive's measurements over the stated one."""

    _latest: Kept[deque[float]]

    def __init__(self) -> None:
        """As stated, until frames contradict it."""
        self._latest = deque(maxlen=_FRAMES)

    @property
    def variance(self) -> float:
        """Over the stated one; one where that may well be true, and never less."""
        latest = sorted([*(1.0,) * _STATED, *self._latest])
        found = latest[(len(latest) - 1) // 2]  # of two in the middle the lower
        return found if found > _LEAST_NOISE else 1.0

    def learn(self, tracking: EgoMotion) -> None:
        """Takes in a frame; one that was not measured adds nothing."""
        if not math.isnan(tracking.misfit):
            self._latest.append(tracking.misfit)


# ------------------------------------------------------------------------------------------
# Pose of a frame from landmarks whose identity is known, without any prior

_DRAWN = 4096  # at nine of ten matches wrong, no good triple among them once in 60
_SAMPLES = 200  # of those that keep their shape
_AT_ONCE = 512  # judged for that, until there are enough
_REFINED = 5  # of these; a few noisy depths make a poor pose, whose count means little
_START_SIGMA_RAD = 0.5  # of the pose that starts the least squares: next to nothing
_START_SIGMA_M = 5.0
_FEWEST_DIRECTIONS = 5  # three leave four poses at most; the others tell which
_SURE = 0.9999  # that all of a sample's matches are right once
_NEAR = 3.0  # outlier bounds within which a match agrees with a pose from three others


class Resection:
    """Locates a frame by known landmarks."""

    def __init__(self, solver: EgoMotionSolver) -> None:
        """The solver's floor states which poses are possible."""
        self._solver = solver

    def solve(self, problem: PoseProblem) -> EgoMotion:
        """Pose, covariance and inliers as :meth:`EgoMotionSolver.solve`, status RELOCALISED.

        The same problem gives the same bits: its samples are always drawn alike.
        """
        found = self._solutions(problem)
        if not found:
            nowhere = Prediction(np.eye(4), np.zeros((6, 6)))
            lost = unmeasured(nowhere, EgoMotionStatus.TOO_FEW_MATCHES)
            size = len(problem)
            return dataclasses.replace(
                lost, inliers=np.zeros(size, np.bool_), residuals=np.full(size, np.inf)
            )
        best = max(found, key=lambda one: int(one.inliers.sum()))
        if not best.status.measured:
            return best
        return dataclasses.replace(best, status=EgoMotionStatus.RELOCALISED)

    def rival(self, problem: PoseProblem, best: EgoMotion) -> int:
        """Matches that agree with another pose, of those that do not agree with the best; at most.

        Where so few are left that they could not be half as many, their number.
        """
        rest = problem.select(~self._near(best.wTc, problem))
        if 2 * len(rest) <= int(best.inliers.sum()):
            return len(rest)
        return max((int(one.inliers.sum()) for one in self._solutions(rest)), default=0)

    def _solutions(self, problem: PoseProblem) -> list[EgoMotion]:
        """Least squares from each start that has a sample of matches which no solution explains."""
        found: list[EgoMotion] = []
        explained: BoolArray = np.zeros((0, len(problem)), np.bool_)
        for start in self._starts(problem):
            agreeing = self._near(start, problem)
            new = (agreeing & ~explained).sum(axis=1)
            if (new >= sample_size(self._solver.floor)).all():
                found.append(self._solved(start, problem))
                explained = np.vstack([explained, self._near(found[-1].wTc, problem)])
        return found

    def _solved(self, start: FloatArray, problem: PoseProblem) -> EgoMotion:
        """Least squares over all matches, from a pose that only states where to start."""
        sigma = np.repeat([_START_SIGMA_RAD, _START_SIGMA_M], 3)
        return self._solver.solve(Prediction(start, np.diag(sigma**2)), problem)

    def _starts(self, problem: PoseProblem) -> FloatArray:
        """(s, 4, 4) the poses from a few matches that most others agree with, best first."""
        floor = self._solver.floor
        if len(problem) < sample_size(floor):
            return np.empty((0, 4, 4))
        if measures_one_image(problem.measurement_covariance).all():
            return self._start_of_one_image(problem)
        local = self._solver.sensor.triangulate(problem.measurement)
        chosen = self._samples(problem, local)
        poses = align(local[chosen], problem.points[chosen], floor)
        agreeing = self._near(poses, problem).sum(axis=1)
        return np.asarray(poses[np.argsort(-agreeing, kind="stable")[:_REFINED]])

    def _start_of_one_image(self, problem: PoseProblem) -> FloatArray:
        """(1 or 0, 4, 4) the pose by directions alone (Gao et al. 2003), that most agree with."""
        none = np.empty((0, 4, 4))
        if len(problem) < _FEWEST_DIRECTIONS:
            return none
        found, turn, shift, _ = cv2.solvePnPRansac(
            problem.points, problem.measurement[:, :2].copy(), self._solver.sensor.matrix, None,
            iterationsCount=_DRAWN, confidence=_SURE,
            reprojectionError=_NEAR * self._solver.farthest, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        vector = np.array([turn, shift], np.float64).reshape(2, 3)
        if not found or not np.isfinite(vector).all():
            return none
        wTc = inverse(pose(so3_exp(vector[0]), vector[1]))
        return self._solver.floor.constrain(wTc)[None]

    def _samples(self, problem: PoseProblem, local: FloatArray) -> IntArray:
        """Minimal samples (h, 2 or 3) of the matches; those that keep their shape, if any do."""
        size, sensor = sample_size(self._solver.floor), self._solver.sensor
        rng = np.random.default_rng(len(problem))
        drawn = rng.integers(0, len(problem), (_DRAWN, size))
        drawn = drawn[(np.diff(np.sort(drawn, axis=1), axis=1) > 0).all(axis=1)]
        noise = sensor.triangulation_covariance(
            problem.measurement, problem.measurement_covariance
        ) + rounded(problem.point_covariances)
        rest, kept = drawn, drawn[:0]
        while len(rest) and len(kept) < _SAMPLES:
            some, rest = rest[:_AT_ONCE], rest[_AT_ONCE:]
            keep = rigid(local[some], problem.points[some], noise[some], self._solver.floor)
            kept = np.concatenate([kept, some[keep]])
        return (kept if len(kept) else drawn)[:_SAMPLES]

    def _near(self, wTc: FloatArray, problem: PoseProblem) -> BoolArray:
        """(..., k) matches that poses (..., 4, 4) from a few others agree with."""
        residuals = self._solver.image_residuals(wTc, problem)
        return np.asarray(residuals <= _NEAR * self._solver.farthest)


_RIGID_SIGMAS = 3.0
_LEAST_SPREAD_M = 0.15  # shorter samples turn the pose by more than any measurement corrects


def sample_size(floor: Floor) -> int:
    """Matches that fix a pose: 2 on a level floor, otherwise 3."""
    return 2 if floor.rigid_dof == 3 else 3


def rounded(covariances: FloatArray) -> FloatArray:
    """Ellipsoids (k, 3, 3) as balls: the map's axes in the camera's frame are not known yet."""
    return np.asarray((np.trace(covariances, axis1=1, axis2=2) / 3.0)[:, None, None] * np.eye(3))


def rigid(here: FloatArray, there: FloatArray, covariances: FloatArray, floor: Floor) -> BoolArray:
    """Which samples keep their lengths between camera and map, and are long enough.

    Args:
        here: (h, m, 3) sampled features in the camera's frame.
        there: (h, m, 3) their landmarks in the world.
        covariances: (h, m, 3, 3) of feature and landmark together, isotropic enough for a test.
        floor: on a level one lengths are horizontal (A^2 + B^2 = C^2 + D^2).
    """
    keep = np.ones(len(here), np.bool_)
    sizes = []
    for a, b in ((0, 1), (1, 2), (2, 0))[: 1 if here.shape[1] == 2 else 3]:
        first, second = here[:, b] - here[:, a], there[:, b] - there[:, a]
        if here.shape[1] == 2:
            first, second = first @ floor.horizontal, second @ floor.horizontal
        own, other = np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)
        along = first / np.maximum(own, 1e-9)[:, None]
        if here.shape[1] == 2:
            along = along @ floor.horizontal.T
        noise = covariances[:, a] + covariances[:, b]
        variance = np.einsum("hi,hij,hj->h", along, noise, along)
        keep &= np.abs(own - other) <= _RIGID_SIGMAS * np.sqrt(variance)
        sizes.append(other)
    return np.asarray(keep & (_spread(np.array(sizes)) >= _LEAST_SPREAD_M))


def _spread(lengths: FloatArray) -> FloatArray:
    """Of pairs (1, h) their length, of triangles (3, h) the smallest altitude (Heron)."""
    if len(lengths) == 1:
        return np.asarray(lengths[0])
    half = 0.5 * lengths.sum(axis=0)
    squared = half * np.prod(half - lengths, axis=0)
    return np.asarray(
        2.0 * np.sqrt(np.maximum(squared, 0.0)) / np.maximum(lengths.max(axis=0), 1e-9)
    )


def align(here: FloatArray, there: FloatArray, floor: Floor) -> FloatArray:
    """Poses ``wTc`` (h, 4, 4) that bring the samples (h, m, 3) from camera to world best."""
    if floor.rigid_dof == 3:
        return align_planar(here, there, floor)
    poses = align_in_space(here, there)
    if floor.rigid_dof == 5:
        poses[:, :3, 3] -= (poses[:, :3, 3] @ floor.down)[:, None] * floor.down
    return poses


def floor_axes(floor: Floor) -> FloatArray:
    """(3, 2) two horizontal directions; a turn about the vertical takes the first to the second."""
    first = floor.horizontal[:, 0]
    return np.column_stack([first, np.cross(floor.down, first)])


def align_planar(here: FloatArray, there: FloatArray, floor: Floor) -> FloatArray:
    """The two-match alignment on a level floor, for any number of points: turn, then shift.

    With the differences (A, B) of the camera's and (C, D) of the map's horizontal coordinates the
    turn about the vertical is ``atan2(sum A D - B C, sum A C + B D)``.
    """
    axes = floor_axes(floor)
    a, b = here @ axes, there @ axes
    a_mean, b_mean = a.mean(axis=1), b.mean(axis=1)
    a, b = a - a_mean[:, None], b - b_mean[:, None]
    sine = (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]).sum(axis=1)
    cosine = (a * b).sum(axis=(1, 2))
    length = np.maximum(np.hypot(sine, cosine), 1e-300)
    sine, cosine = sine / length, cosine / length
    return _planar_poses(cosine, sine, a_mean, b_mean, axes, floor.down)


def _planar_poses(
    cosine: FloatArray,
    sine: FloatArray,
    here: FloatArray,
    there: FloatArray,
    axes: FloatArray,
    down: FloatArray,
) -> FloatArray:
    """Poses turned about the vertical that bring (h, 2) ``here`` onto ``there``."""
    shift_x = there[:, 0] - cosine * here[:, 0] + sine * here[:, 1]
    shift_y = there[:, 1] - sine * here[:, 0] - cosine * here[:, 1]
    e, f = axes[:, 0], axes[:, 1]
    rotation = np.outer(down, down) + cosine[:, None, None] * (np.outer(e, e) + np.outer(f, f))
    rotation += sine[:, None, None] * (np.outer(f, e) - np.outer(e, f))
    return pose(rotation, shift_x[:, None] * e + shift_y[:, None] * f)


def align_in_space(here: FloatArray, there: FloatArray) -> FloatArray:
    """Least squares in three dimensions (Kabsch 1976), three points or more."""
    a_mean, b_mean = here.mean(axis=1), there.mean(axis=1)
    correlation = np.swapaxes(there - b_mean[:, None], 1, 2) @ (here - a_mean[:, None])
    u, _, vt = np.linalg.svd(correlation)
    flip = np.ones((len(here), 3))
    flip[:, 2] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * flip[:, None, :]) @ vt
    return pose(rotation, b_mean - np.einsum("hij,hj->hi", rotation, a_mean))
