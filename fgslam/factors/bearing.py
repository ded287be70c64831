"""Factors of homing: bearings, elevations, the leg, its measured direction, and motion.

Variables: planar poses of the start, of every image on the way and of the target (``Pose2``),
velocities in the robot's axes, and landmarks in the plane. GTSAM's own factors serve wherever there
is one; residuals are specified in :mod:`fgslam.factors.bearing`. Derivation:
docs/derivations/homing_estimators.md.
"""

from __future__ import annotations

import math
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import bearings, rotation, unit, wrap
from fgslam.factors.noise import KernelName, Whitening

# ------------------------------------------------------------------------------------------
# Bearings, elevations and motion in the plane, as pure functions with their derivatives

ComplexArray = npt.NDArray[np.complex128]

_SMALL = 1e-2  # radians: below it the series of the cotangent is exact to rounding


def bearing(pose: FloatArray, points: FloatArray, measured: FloatArray) -> FloatArray:
    """(n,) residuals, wrapped, of bearings (n,) to points (n, 2) from a pose (eqs 7, 9)."""
    return wrap(bearings(pose, points) - measured)


def bearing_jacobians(pose: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of bearings by the pose, (n, 3), and by their points, (n, 2)."""
    offset = points - pose[:2]
    squared = np.einsum("ij,ij->i", offset, offset)
    by_pose, across = np.empty((len(points), 3)), np.empty((len(points), 2))
    np.divide(-offset[:, 1], squared, out=across[:, 0])
    np.divide(offset[:, 0], squared, out=across[:, 1])
    by_pose[:, :2], by_pose[:, 2] = -across, -1.0
    return by_pose, across


def polar_points(polar: FloatArray) -> FloatArray:
    """(n, 2) points of (distance, bearing) rows (n, 2): P = d u(delta)."""
    return np.asarray(polar[:, :1] * unit(polar[:, 1]))


def polar_jacobians(polar: FloatArray) -> FloatArray:
    """(n, 2, 2) derivatives of :func:`polar_points` by (distance, bearing)."""
    along = unit(polar[:, 1])
    out = np.empty((len(polar), 2, 2))
    out[:, :, 0] = along
    out[:, 0, 1], out[:, 1, 1] = -polar[:, 0] * along[:, 1], polar[:, 0] * along[:, 0]
    return out


def target_pose(target: FloatArray) -> FloatArray:
    """(3,) pose (x_t, y_t, psi_t) of (D_t, theta_t, psi_t): what eq. 9 leaves unsaid."""
    distance, direction, turn = target.tolist()
    return np.array([distance * math.cos(direction), distance * math.sin(direction), turn])


def target_jacobian(target: FloatArray) -> FloatArray:
    """(3, 3) derivative of :func:`target_pose`."""
    distance, direction, _ = target.tolist()
    c, s = math.cos(direction), math.sin(direction)
    return np.array([[c, -distance * s, 0.0], [s, distance * c, 0.0], [0.0, 0.0, 1.0]])


def elevation(
    pose: FloatArray, points: FloatArray, heights: FloatArray, measured: FloatArray
) -> FloatArray:
    """(n,) residuals of elevations of points (n, 2) at heights (n,) above the camera's plane."""
    distance = np.linalg.norm(points - pose[:2], axis=1)
    return np.asarray(np.arctan2(heights, distance) - measured)


def elevation_jacobians(
    pose: FloatArray, points: FloatArray, heights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivatives by the pose, (n, 3), by the points, (n, 2), and by the heights, (n,)."""
    offset = points - pose[:2]
    distance = np.linalg.norm(offset, axis=1)
    squared = distance**2 + heights**2
    by_point = -(heights / (squared * distance))[:, None] * offset
    return np.column_stack([-by_point, np.zeros(len(points))]), by_point, distance / squared


def elevation_pair(
    target: FloatArray, point: FloatArray, elevations: FloatArray
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Elevation from the target of a landmark whose height the one from the start gives.

    The height d tan(alpha) is put in, d the distance from the start: the two elevations' factors
    with the height eliminated, to first order.

    Args:
        target: (3,) pose; the start is the origin.
        point: (2,) landmark.
        elevations: (2,) measured from start and target, radians.

    Returns:
        Residual, radians; its derivatives by target (3,), point (2,) and both elevations (2,).
    """
    pose, tangent = np.asarray(target), np.tan(elevations[0])
    distance = np.hypot(*point)
    height = np.array([distance * tangent])
    by_pose, by_point, by_height = elevation_jacobians(pose, point[None], height)
    residual = elevation(pose, point[None], height, elevations[1:])[0]
    raised = by_height[0] * tangent / distance * point
    by_elevations = np.array([by_height[0] * distance * (1.0 + tangent**2), -1.0])
    return float(residual), by_pose[0], by_point[0] + raised, by_elevations


def direction_and_turn(
    target: FloatArray, direction: float, turn: float
) -> tuple[FloatArray, FloatArray]:
    """What the initialisation measured of the target's pose (III-B): residual and derivative.

    Args:
        target: (3,) pose in the start frame.
        direction: theta, radians.
        turn: psi, radians.

    Returns:
        (2,) wrapped residuals and (2, 3) derivative.
    """
    x, y, psi = target.tolist()
    residual = wrap(np.array([math.atan2(y, x) - direction, psi - turn]))
    squared = x**2 + y**2
    return residual, np.array([[-y / squared, x / squared, 0.0], [0.0, 0.0, 1.0]])


# --------------------------------------------------------------------------------------------
# Many views of the same points


def offsets(views: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(v, m) of points from views, along x and y."""
    return points[:, 0] - views[:, :1], points[:, 1] - views[:, 1:2]


def bearings_from_views(dx: FloatArray, dy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(v, m, 3) and (v, m, 2) derivatives of bearings by poses and points, of offsets (v, m)."""
    squared = dx**2 + dy**2
    by_pose, by_point = np.empty((*dx.shape, 3)), np.empty((*dx.shape, 2))
    by_point[..., 0], by_point[..., 1] = -dy / squared, dx / squared
    by_pose[..., :2], by_pose[..., 2] = -by_point, -1.0
    return by_pose, by_point


# --------------------------------------------------------------------------------------------
# Triangulation from start and target (III-C)


def triangulated(
    vector: tuple[float, float], start: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances from the start, in legs, and their derivatives.

    Args:
        vector: (theta, psi).
        start: (n,) delta, bearings from the start.
        target: (n,) delta', bearings from the target.

    Returns:
        (n,) distances d, not positive where the rays do not meet; (n, 4) derivatives by (theta,
        psi, delta, delta'). Parallel rays give values that are not finite.
    """
    theta, psi = vector
    seen = target + psi
    with np.errstate(divide="ignore", invalid="ignore"):
        sine = np.sin(seen - start)
        distance = np.sin(seen - theta) / sine
        by_target = np.sin(theta - start) / sine**2
        by_start = distance * np.cos(seen - start) / sine
        by_direction = -np.cos(seen - theta) / sine
    return distance, np.column_stack([by_direction, by_target, by_start, by_target])


# --------------------------------------------------------------------------------------------
# Motion: constant velocity between many poses at once; GTSAM's factor is WnoaMotionFactorPose2


class ChainMotion:
    """Motion along a chain of poses against constant velocity: residuals, and their derivatives.

    Places and velocities are complex numbers here: a rotation and [a, -b; b, a] are products.

    Attributes:
        residual: (n, 6).
    """

    def __init__(self, poses: FloatArray, speeds: FloatArray, steps: FloatArray) -> None:
        """The residuals.

        Args:
            poses: (n + 1, 3) in the order of time.
            speeds: (n + 1, 3) velocities there, in the robot's own axes: forward, left, turning.
            steps: (n,) seconds between them.
        """
        place, velocity = poses[:, 0] + 1j * poses[:, 1], speeds[:, 0] + 1j * speeds[:, 1]
        self._back, turn = np.exp(-1j * poses[:-1, 2]), wrap(np.diff(poses[:, 2]))
        self._moved, self._rate = self._back * np.diff(place), speeds[1:, 2]
        self._log = _LogTerms(turn)
        # Log m = (M(w) t, w) of the motion m = (t, w); its rate J v, J = [M R(w), M' t; 0, 1].
        self._turn = np.exp(1j * turn)
        self._ahead = self._turn * velocity[1:]
        self._bent = self._log.slope * self._moved
        self._gone = self._log.straight * self._moved
        self._steps = steps
        self.residual = np.empty((len(steps), 6))
        self.residual[:, :2] = _parts(self._gone - steps * velocity[:-1])
        self.residual[:, 2] = turn - steps * speeds[:-1, 2]
        changed = self._log.straight * self._ahead + self._bent * self._rate - velocity[:-1]
        self.residual[:, 3:5] = _parts(changed)
        self.residual[:, 5] = self._rate - speeds[:-1, 2]

    def derivatives(self) -> tuple[FloatArray, FloatArray]:
        """(n, 6, 6) by (pose, velocity) before and after each step."""
        before, after = np.zeros((2, len(self._steps), 6, 6))
        straight, slope, rate = self._log.straight, self._log.slope, self._rate
        by_turn = (slope + 1j * straight) * self._ahead + self._log.curve() * self._moved * rate
        _put_product(after[:, :2, :2], straight * self._back)
        _put_product(after[:, 3:5, :2], slope * rate * self._back)
        _put_product(after[:, 3:5, 3:5], straight * self._turn)
        after[:, :2, 2] = after[:, 3:5, 5] = _parts(self._bent)
        after[:, 3:5, 2] = _parts(by_turn)
        after[:, 2, 2] = after[:, 5, 5] = 1.0
        before[:, :, :3] = -after[:, :, :3]
        before[:, :2, 2] -= _parts(1j * self._gone)
        before[:, 3:5, 2] -= _parts(1j * rate * self._bent)
        every = np.arange(3)
        before[:, every, 3 + every] = -self._steps[:, None]
        before[:, 3 + every, 3 + every] = -1.0
        return before, after


def _parts(numbers: ComplexArray) -> FloatArray:
    """(n, 2) real and imaginary parts of (n,)."""
    return numbers.view(np.float64).reshape(-1, 2)


def _put_product(out: FloatArray, factors: ComplexArray) -> None:
    """Writes the matrices [a, -b; b, a] of factors a + ib (n,) into (n, 2, 2)."""
    out[:, :, 0], out[:, :, 1] = _parts(factors), _parts(1j * factors)


def motion_informations(steps: FloatArray, density: FloatArray) -> FloatArray:
    """(n, 6, 6) inverse covariances, of steps (n,) and the accelerations' densities (3,)."""
    place, cross, speed = 12.0 / steps**3, -6.0 / steps**2, 4.0 / steps
    powers = np.stack([place, cross, cross, speed], axis=-1).reshape(-1, 2, 2)
    return np.asarray(np.einsum("nab,ij->naibj", powers, np.diag(1.0 / density)).reshape(-1, 6, 6))


class _LogTerms:
    """M(w) = k - iw/2, k = w/2 cot(w/2), its derivative M' and k''; each (n,)."""

    def __init__(self, w: FloatArray) -> None:
        self._half = half = 0.5 * w
        self._small = np.abs(half) < _SMALL
        self._safe = np.where(self._small, 1.0, half)
        self._square = square = half**2
        self._cotangent, self._cosecant = 1.0 / np.tan(self._safe), np.sin(self._safe) ** -2.0
        k = self._safe * self._cotangent
        k = np.where(self._small, 1.0 - square / 3.0 - square**2 / 45.0, k)
        series = -half / 3.0 - 2.0 / 45.0 * half * square
        slope = 0.5 * (self._cotangent - self._safe * self._cosecant)
        self.straight = k - 1j * half
        self.slope = np.where(self._small, series, slope) - 0.5j

    def curve(self) -> FloatArray:
        """K'' (n,)."""
        curve = 0.5 * (self._safe * self._cotangent - 1.0) * self._cosecant
        return np.where(self._small, -1.0 / 6.0 - self._square / 15.0, curve)


STIFF = 1e-4
"""Deviation, legs and radians, of what defines the frame: the start's pose, and the leg's length.
Constrained models would be exact and make GTSAM fall back to QR, several times slower."""


class BearingFactors:
    """Makes the factors of measured bearings and elevations, robust or not."""

    def __init__(self, kernel: KernelName = "none", width: float = 1.0) -> None:
        """``width`` is the kernel's scale in standard deviations."""
        self._whitening = Whitening(kernel, width)

    def bearing(self, pose: int, landmark: int, measured: float, sigma: float) -> Any:
        """Bearing of a landmark from a pose; radians (eqs 7, 9)."""
        return gtsam.BearingFactor2D(pose, landmark, gtsam.Rot2(measured), self._model(sigma))

    def elevation_pair(
        self,
        target: int,
        landmark: int,
        measured: FloatArray,
        sigmas: FloatArray,
        first: FloatArray,
    ) -> Any:
        """Elevations (2,) of a landmark from start and target without its height; radians.

        Their deviations (2,) are brought together at first guesses of target and landmark, (5,).
        """
        _, _, _, by_elevations = elevation_pair(first[:3], first[3:], measured)
        sigma = float(np.linalg.norm(by_elevations * sigmas))
        tangent, up = math.tan(measured[0]), float(measured[1])

        # As the specification, in plain numbers: five times faster, and called for each landmark
        # in every step of a solver.
        def error(_: Any, values: Any, jacobians: list[FloatArray] | None) -> FloatArray:
            at, (x, y) = values.atPose2(target), values.atPoint2(landmark).tolist()
            dx, dy = x - at.x(), y - at.y()
            near, far = math.hypot(dx, dy), math.hypot(x, y)
            height = tangent * far
            if jacobians is not None:
                squared = near**2 + height**2
                down, raised = height / (squared * near), near / squared * tangent / far
                c, s = math.cos(at.theta()), math.sin(at.theta())
                jacobians[0] = np.array([[down * (c * dx + s * dy), down * (c * dy - s * dx), 0.0]])
                jacobians[1] = np.array([[raised * x - down * dx, raised * y - down * dy]])
            return np.array([math.atan2(height, near) - up])

        return gtsam.CustomFactor(self._model(sigma), [target, landmark], error)

    def _model(self, sigma: float) -> Any:
        return self._whitening.model(np.array([[sigma**2]]))


def start_prior(pose: int) -> Any:
    """The start is the frame's origin."""
    return gtsam.PriorFactorPose2(pose, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, STIFF))


def leg_factor(start: int, target: int) -> Any:
    """The distance from start to target is the unit of length (R = 1, III-B)."""
    return gtsam.RangeFactorPose2(start, target, 1.0, gtsam.noiseModel.Isotropic.Sigma(1, STIFF))


def vector_factor(target: int, direction: float, turn: float, covariance: FloatArray) -> Any:
    """The initialisation's (theta, psi) with its covariance (2, 2), on the target's pose."""

    def error(_: Any, values: Any, jacobians: list[FloatArray] | None) -> FloatArray:
        at = values.atPose2(target)
        place = np.array([at.x(), at.y(), at.theta()])
        residual, derivative = direction_and_turn(place, direction, turn)
        if jacobians is not None:
            jacobians[0] = derivative @ tangent_to_pose(place)
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(covariance), [target], error)


def velocity_prior(velocity: int, mean: FloatArray, sigmas: FloatArray) -> Any:
    """Prior (3,) on a velocity: forward, left, turning."""
    return gtsam.PriorFactorVector(velocity, mean, gtsam.noiseModel.Diagonal.Sigmas(sigmas))


def motion_factor(
    before: tuple[int, int, float], after: tuple[int, int, float], density: FloatArray
) -> Any:
    """Constant velocity up to white noise on the acceleration (eq 4 and 5, corrected).

    Args:
        before: keys of pose and of velocity, and time in seconds.
        after: the same, later.
        density: (3,) of the accelerations' noise, forward, left and turning.
    """
    return gtsam.WnoaMotionFactorPose2(
        gtsam.StateData(*before), gtsam.StateData(*after), np.asarray(density)
    )


def weak_landmark_prior(landmark: int, position: FloatArray, sigma: float) -> Any:
    """Keeps a landmark determined when too few bearings say where it is."""
    return gtsam.PriorFactorPoint2(landmark, position, gtsam.noiseModel.Isotropic.Sigma(2, sigma))


def tangent_to_pose(pose: FloatArray) -> FloatArray:
    """(3, 3) derivative of a pose's (x, y, psi) by GTSAM's tangent, which is in its own axes."""
    out = np.eye(3)
    out[:2, :2] = rotation(float(pose[2]))
    return out
