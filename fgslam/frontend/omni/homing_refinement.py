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

from fgslam.frontend.omni.epipolar import EpipolarTest, ray_derivatives, unit_rays
from fgslam.homing_types import BearingMatches
from fgslam.planar import rotation as planar_rotation
from fgslam.planar import wrap
from fgslam.types import BoolArray, FloatArray

_ITERATIONS = 15
_CONVERGED = 1e-7  # radians; a thousandth of the best covariance's square root
_MAD_TO_SIGMA = 1.4826
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
        self._a = unit_rays(matches.bearing_a, matches.elevation_a)
        self._b = unit_rays(matches.bearing_b, matches.elevation_b)
        by_a = ray_derivatives(matches.bearing_a, matches.elevation_a)
        by_b = ray_derivatives(matches.bearing_b, matches.elevation_b)
        self._noise_a = [d * matches.sigma[:, k, None] for k, d in enumerate(by_a)]
        self._noise_b = [d * matches.sigma[:, k + 2, None] for k, d in enumerate(by_b)]
        self._test = EpipolarTest.of(matches)
        self._prior = prior.information()
        self._sigmas = inlier_sigmas
        self._least_parallax = least_parallax

    def refine(self, direction: float, rotation: float) -> Refined:
        """Gauss-Newton from a hypothesis; inliers are chosen anew in each iteration."""
        parameters = np.zeros(7)
        parameters[:2] = direction, rotation
        for _ in range(_ITERATIONS):
            residuals, jacobian = self._linearised(parameters)
            weights = self._weights(parameters, residuals)
            information = (jacobian * weights[:, None]).T @ jacobian + np.diag(self._prior)
            gradient = jacobian.T @ (weights * residuals) + self._prior * parameters
            step = np.linalg.lstsq(information, -gradient, rcond=None)[0]
            parameters = parameters + np.clip(step, -0.3, 0.3)
            if np.max(np.abs(step)) < _CONVERGED:
                break
        parameters[:2] = wrap(parameters[:2])
        return self._finished(parameters)

    def _finished(self, parameters: FloatArray) -> Refined:
        residuals, jacobian = self._linearised(parameters)
        inliers = self._inliers(parameters, residuals)
        weights = inliers.astype(np.float64)
        information = (jacobian * weights[:, None]).T @ jacobian + np.diag(self._prior)
        spread = _MAD_TO_SIGMA * float(np.median(np.abs(residuals[inliers]))) if any(inliers) else 1
        covariance = np.linalg.pinv(information) * max(1.0, spread) ** 2
        return Refined(parameters, np.asarray(covariance, dtype=np.float64), residuals, inliers)

    def _weights(self, parameters: FloatArray, residuals: FloatArray) -> FloatArray:
        """(n,) Cauchy weights of the inliers: those near the border count little."""
        inliers = self._inliers(parameters, residuals)
        return inliers / (1.0 + (residuals / 2.0) ** 2)

    def _inliers(self, parameters: FloatArray, residuals: FloatArray) -> BoolArray:
        ahead = self._test.in_front(parameters[:1], parameters[1:2], self._least_parallax)[:, 0]
        return np.asarray((np.abs(residuals) < self._sigmas) & ahead)

    def _linearised(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) normalised residuals and their (n, 7) Jacobian, noise held at the estimate."""
        leg = np.array([np.cos(p[0]), np.sin(p[0]), p[6]])
        tilt_a, tilt_b, turn = _tilt(p[2], p[3]), _tilt(p[4], p[5]), _turn(p[1])
        a, b = self._a @ tilt_a.T, self._b @ (turn @ tilt_b).T
        normal_b, normal_a = np.cross(leg, b), np.cross(a, leg)  # r = a . (leg x b) = b . (a x leg)
        residual = np.sum(a * normal_b, axis=1)
        level_b = self._b @ tilt_b.T
        by = np.stack(
            [
                np.sum(a * np.cross([-leg[1], leg[0], 0.0], b), axis=1),
                np.sum(normal_a * np.cross([0.0, 0.0, 1.0], b), axis=1),
                *(np.sum(np.cross(axis, a) * normal_b, axis=1) for axis in np.eye(3)[:2]),
                *(
                    np.sum(np.cross(axis, level_b) @ turn.T * normal_a, axis=1)
                    for axis in np.eye(3)[:2]
                ),
                np.sum(a * np.cross([0.0, 0.0, 1.0], b), axis=1),
            ],
            axis=1,
        )
        noise = [np.sum((d @ tilt_a.T) * normal_b, axis=1) for d in self._noise_a]
        noise += [np.sum((d @ (turn @ tilt_b).T) * normal_a, axis=1) for d in self._noise_b]
        sigma = np.maximum(np.linalg.norm(noise, axis=0), 1e-12)
        return residual / sigma, by / sigma[:, None]


def _turn(angle: float) -> FloatArray:
    turned = np.eye(3)
    turned[:2, :2] = planar_rotation(angle)
    return turned


def _tilt(roll: float, pitch: float) -> FloatArray:
    """Rotation by a small vector (roll, pitch, 0): Rodrigues' formula."""
    angle = float(np.hypot(roll, pitch))
    cross = np.array([[0.0, 0.0, pitch], [0.0, 0.0, -roll], [-pitch, roll, 0.0]])
    if angle < 1e-12:
        return np.eye(3) + cross
    axis = cross / angle
    turned = np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * axis @ axis
    return np.asarray(turned, dtype=np.float64)
