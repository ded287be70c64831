"""Least-squares refinement of a homing vector on its inliers, with covariance.

The planar constraint supposes level cameras at one height. Real ones tilt by a fraction of a degree
(D6: "estimate or inflate"), which bends elevations alike over whole sides of the view; so each
view's roll and pitch and the difference of heights are estimated along with theta and psi, held by
a prior. The residual is the epipolar one with general rotations, a weighted first-order (Sampson)
distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.frontend.omni.epipolar import in_front, ray_derivatives
from fgslam.frontend.omni.match_odds import COMMON_CHANCE, gain, right_probability
from fgslam.homing_types import BearingMatches
from fgslam.omni_cameras.bearing_measurement import unit_rays
from fgslam.planar import rotation as planar_rotation
from fgslam.planar import wrap
from fgslam.types import BoolArray, FloatArray

_WIDENED = (4.0, 3.0, 2.0, 1.5)
"""Inliers' threshold in the first iterations: a hypothesis from two matches is a few degrees off,
and the matches that would pull it right are its outliers (D7: 1 to 2 degrees)."""
_ITERATIONS = 15
_CONVERGED = 1e-7  # radians; a thousandth of the best covariance's square root
_MAD_TO_SIGMA = 1.4826
_DAMPING = 1e-3  # of the information: a handful of inliers may leave a direction open
_LEAST_SIGMA = 1e-6  # of a parameter that is not to be estimated; less spoils the conditioning


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A refined solution.

    Attributes:
        parameters: (7,) theta, psi, roll and pitch of a, roll and pitch of b (radians, about each
            camera's x and y axis), height of b above a in legs.
        covariance: (7, 7), widened by the residuals' scatter where that exceeds the stated noise.
        residuals: (n,) of all matches, normalised.
        inliers: (n,).
    """

    parameters: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    inliers: BoolArray


@dataclass(frozen=True, slots=True)
class RefinementPrior:
    """Standard deviations of the nuisance parameters: tilt in radians, height in legs."""

    tilt_sigma: float
    height_sigma: float

    def information(self) -> FloatArray:
        """(7,) diagonal; theta and psi have none."""
        held = np.array([*[self.tilt_sigma] * 4, self.height_sigma])
        return np.concatenate([np.zeros(2), 1.0 / np.maximum(held, _LEAST_SIGMA) ** 2])


class HomingRefinement:
    """The matches, prepared for refining any number of hypotheses."""

    def __init__(
        self,
        matches: BearingMatches,
        prior: RefinementPrior,
        inlier_sigmas: float,
        least_parallax: float,
    ) -> None:
        a = unit_rays(matches.bearing_a, matches.elevation_a)
        b = unit_rays(matches.bearing_b, matches.elevation_b)
        by_a = ray_derivatives(matches.bearing_a, matches.elevation_a)
        by_b = ray_derivatives(matches.bearing_b, matches.elevation_b)
        # a^T E b is linear in E: one product of matrices gives all residuals and derivatives.
        self._outer = _outer(a, b)
        noisy = [_outer(d * matches.sigma[:, k, None], b) for k, d in enumerate(by_a)]
        noisy += [_outer(a, d * matches.sigma[:, k + 2, None]) for k, d in enumerate(by_b)]
        self._noisy = np.concatenate(noisy)
        self._bearings = matches.bearing_a, matches.bearing_b
        self._prior = prior.information()
        right = right_probability(matches)
        self._odds = right / (1.0 - right)
        self._sigmas = inlier_sigmas
        self._least_parallax = least_parallax

    def refine(self, direction: float, rotation: float) -> Refined:
        """Gauss-Newton from a hypothesis; inliers are chosen anew in each iteration."""
        parameters = np.zeros(7)
        parameters[:2] = direction, rotation
        for k in range(_ITERATIONS):
            residuals, jacobian = self._linearised(parameters)
            widened = _WIDENED[k] if k < len(_WIDENED) else 1.0
            weights = self._weights(parameters, residuals, widened)
            information = (jacobian * weights[:, None]).T @ jacobian + np.diag(self._prior)
            gradient = jacobian.T @ (weights * residuals) + self._prior * parameters
            step = np.linalg.solve(information + _DAMPING * np.eye(7), -gradient)
            parameters = parameters + np.clip(step, -0.3, 0.3)
            if k >= len(_WIDENED) and np.max(np.abs(step)) < _CONVERGED:
                break
        parameters[:2] = wrap(parameters[:2])
        return self._finished(parameters)

    def _finished(self, parameters: FloatArray) -> Refined:
        residuals, jacobian = self._linearised(parameters)
        inliers = self._inliers(parameters, residuals)
        weights = self._weights(parameters, residuals)
        information = (jacobian * weights[:, None]).T @ jacobian + np.diag(self._prior)
        spread = _MAD_TO_SIGMA * float(np.median(np.abs(residuals[inliers]))) if any(inliers) else 1
        covariance = np.linalg.pinv(information) * max(1.0, spread) ** 2
        return Refined(parameters, np.asarray(covariance, dtype=np.float64), residuals, inliers)

    def _weights(
        self, parameters: FloatArray, residuals: FloatArray, widened: float = 1.0
    ) -> FloatArray:
        """(n,) probability that each match is right, given how it fits."""
        inliers = self._inliers(parameters, residuals, widened)
        likely = self._odds * gain(residuals / widened, self._sigmas, COMMON_CHANCE)
        return inliers * likely / (1.0 + likely)

    def _inliers(
        self, parameters: FloatArray, residuals: FloatArray, widened: float = 1.0
    ) -> BoolArray:
        theta, psi = parameters[:1], parameters[1:2]
        ahead = in_front(self._bearings, theta, psi, self._least_parallax)[:, 0]
        return np.asarray((np.abs(residuals) < widened * self._sigmas) & ahead)

    def _linearised(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) normalised residuals and their (n, 7) Jacobian, noise held at the estimate."""
        essential, derivatives = _essential(p)
        residual = self._outer @ essential.ravel()
        by = self._outer @ derivatives.reshape(7, 9).T
        noise = (self._noisy @ essential.ravel()).reshape(4, -1)
        sigma = np.sqrt(np.maximum(np.sum(noise**2, axis=0), 1e-24))
        return residual / sigma, by / sigma[:, None]


def _outer(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, 9) products of all coordinates of two rays (n, 3)."""
    return np.asarray((a[:, :, None] * b[:, None, :]).reshape(len(a), 9))


def _essential(p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """E (3, 3) with a^T E b = 0, and its (7, 3, 3) derivatives.

    E = A^T [t]x Rz(psi) B, with tilts A and B. Their derivatives are taken as if by a further small
    tilt, exact where the tilt itself vanishes.
    """
    c, s = np.cos(p[0]), np.sin(p[0])
    tilt_a, tilt_b, turn = _tilt(p[2], p[3]).T, _tilt(p[4], p[5]), _turn(p[1])
    right = turn @ tilt_b
    left = tilt_a @ _skew(c, s, p[6])
    middle = _skew(c, s, p[6]) @ right
    derivatives = np.stack(
        [
            tilt_a @ _skew(-s, c, 0.0) @ right,
            left @ turn @ _AXES[2] @ tilt_b,
            -tilt_a @ _AXES[0] @ middle,
            -tilt_a @ _AXES[1] @ middle,
            left @ turn @ _AXES[0] @ tilt_b,
            left @ turn @ _AXES[1] @ tilt_b,
            tilt_a @ _AXES[2] @ right,
        ]
    )
    return left @ right, derivatives


def _skew(x: float, y: float, z: float) -> FloatArray:
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


_AXES = (_skew(1.0, 0.0, 0.0), _skew(0.0, 1.0, 0.0), _skew(0.0, 0.0, 1.0))


def _turn(angle: float) -> FloatArray:
    turned: FloatArray = np.eye(3)
    turned[:2, :2] = planar_rotation(angle)
    return turned


def _tilt(roll: float, pitch: float) -> FloatArray:
    """Rotation by a small vector (roll, pitch, 0): Rodrigues' formula."""
    angle = float(np.hypot(roll, pitch))
    cross = _skew(roll, pitch, 0.0)
    if angle < 1e-12:
        return np.eye(3) + cross
    axis = cross / angle
    turned = np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * axis @ axis
    return np.asarray(turned, dtype=np.float64)
