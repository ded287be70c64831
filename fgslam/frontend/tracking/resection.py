"""Pose of a frame from landmarks whose identity is known, without any prior.

Three matches (two on a floor) place the camera: the triangulated points are laid onto the
landmarks. The pose that most matches agree with starts the least squares. The closed forms serve
relocalisation and the alignment of maps, too.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import EgoMotion, EgoMotionStatus, Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import triangulate, triangulation_covariance
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem, unmeasured

_DRAWN = 4096  # at nine of ten matches wrong, no good triple among them once in 60
_SAMPLES = 200  # of those that keep their shape
_REFINED = 5  # of these; a few noisy depths make a poor pose, whose count says little
_START_SIGMA_RAD = 0.5  # of the pose that starts the least squares: says nothing
_START_SIGMA_M = 5.0
_NEAR = 3.0  # outlier bounds within which a match agrees with a pose from three others


class Resection:
    """Locates a frame by known landmarks."""

    def __init__(self, solver: EgoMotionSolver) -> None:
        """The solver's floor says which poses are possible."""
        self._solver = solver

    def solve(self, problem: PoseProblem) -> EgoMotion:
        """Pose, covariance and inliers as :meth:`EgoMotionSolver.solve`, status RELOCALISED.

        The same problem gives the same bits: its samples are always drawn alike.
        """
        found = [self._solved(start, problem) for start in self._starts(problem)]
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
        found = [int(self._solved(start, rest).inliers.sum()) for start in self._starts(rest)]
        return max(found, default=0)

    def _solved(self, start: FloatArray, problem: PoseProblem) -> EgoMotion:
        """Least squares over all matches, from a pose that says nothing but where to start."""
        sigma = np.repeat([_START_SIGMA_RAD, _START_SIGMA_M], 3)
        return self._solver.solve(Prediction(start, np.diag(sigma**2)), problem)

    def _starts(self, problem: PoseProblem) -> FloatArray:
        """(s, 4, 4) the poses from a few matches that most others agree with, best first."""
        floor = self._solver.floor
        if len(problem) < sample_size(floor):
            return np.empty((0, 4, 4))
        local = triangulate(self._solver.sensor, problem.measurement)
        chosen = self._samples(problem, local)
        poses = align(local[chosen], problem.points[chosen], floor)
        agreeing = self._near(poses, problem).sum(axis=1)
        return np.asarray(poses[np.argsort(-agreeing, kind="stable")[:_REFINED]])

    def _samples(self, problem: PoseProblem, local: FloatArray) -> IntArray:
        """Minimal samples (h, 2 or 3) of the matches; those that keep their shape, if any do."""
        size, sensor = sample_size(self._solver.floor), self._solver.sensor
        rng = np.random.default_rng(len(problem))
        drawn = rng.integers(0, len(problem), (_DRAWN, size))
        drawn = drawn[(np.diff(np.sort(drawn, axis=1), axis=1) > 0).all(axis=1)]
        noise = triangulation_covariance(
            sensor, problem.measurement, problem.measurement_covariance
        ) + rounded(problem.point_covariances)
        keep = rigid(local[drawn], problem.points[drawn], noise[drawn], self._solver.floor)
        return np.asarray(drawn[keep if keep.any() else slice(None)][:_SAMPLES])

    def _near(self, wTc: FloatArray, problem: PoseProblem) -> BoolArray:
        """(..., k) matches that poses (..., 4, 4) from a few others agree with."""
        near = _NEAR * self._solver.farthest
        return np.asarray(self._solver.image_residuals(wTc, problem) <= near)


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
    out = np.zeros((len(cosine), 4, 4))
    out[:, 3, 3] = 1.0
    out[:, :3, :3] = np.outer(down, down)
    out[:, :3, :3] += cosine[:, None, None] * (np.outer(e, e) + np.outer(f, f))
    out[:, :3, :3] += sine[:, None, None] * (np.outer(f, e) - np.outer(e, f))
    out[:, :3, 3] = shift_x[:, None] * e + shift_y[:, None] * f
    return out


def align_in_space(here: FloatArray, there: FloatArray) -> FloatArray:
    """Least squares in three dimensions (Kabsch 1976), three points or more."""
    a_mean, b_mean = here.mean(axis=1), there.mean(axis=1)
    correlation = np.swapaxes(there - b_mean[:, None], 1, 2) @ (here - a_mean[:, None])
    u, _, vt = np.linalg.svd(correlation)
    flip = np.ones((len(here), 3))
    flip[:, 2] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * flip[:, None, :]) @ vt
    out = np.zeros((len(here), 4, 4))
    out[:, 3, 3] = 1.0
    out[:, :3, :3] = rotation
    out[:, :3, 3] = b_mean - np.einsum("hij,hj->hi", rotation, a_mean)
    return out
