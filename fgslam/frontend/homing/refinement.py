"""Least-squares refinement of a homing vector on its inliers, with covariance.

The planar constraint supposes level cameras at one height. Real ones tilt by a fraction of a degree
("estimate or inflate"), which bends elevations alike over whole sides of the view; so each
view's roll and pitch and the difference of heights are estimated along with theta and psi, held by
a prior. The residual is the epipolar one with general rotations, a weighted first-order (Sampson)
distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.cameras.omni.camera import unit_rays
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.gauss_newton import GaussNewton, Linearised
from fgslam.core.geometry import skew
from fgslam.core.homing import BearingMatches
from fgslam.core.planar import wrap
from fgslam.frontend.homing.matching import COMMON_CHANCE, gain, right_probability
from fgslam.frontend.homing.two_view_geometry import in_front, ray_derivatives

_WIDENED = (4.0, 3.0, 2.0, 1.5)
"""Inliers' threshold in the first iterations: a hypothesis from two matches is a few degrees off,
and the matches that would pull it right are its outliers (1 to 2 degrees)."""
_MAD_TO_SIGMA = 1.4826
_SEARCH = GaussNewton(
    iterations=15,
    converged=1e-7,  # radians; a thousandth of the best covariance's square root
    settling=len(_WIDENED),
    longest=0.3,  # radians, legs
    damping=1e-3,  # of the information: a handful of inliers may leave a direction open
)
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


def spread_over(near: list[Refined], scores: FloatArray, temper: float) -> FloatArray:
    """(2, 2) covariance of direction and rotation, of the first of solutions near each other.

    Each weighs by its likelihood exp(score), tempered: residuals have common causes, so that
    ``temper`` units of the score count as one.
    """
    weights = np.exp((scores - scores[0]) / temper)
    offsets = wrap(np.array([r.parameters[:2] for r in near]) - near[0].parameters[:2])
    spread = np.array([r.covariance[:2, :2] for r in near])
    spread = spread + offsets[:, :, None] * offsets[:, None, :]
    return np.asarray(np.tensordot(weights / np.sum(weights), spread, axes=1))


class HomingRefinement:
    """The matches, prepared for refining any number of hypotheses."""

    def __init__(
        self,
        matches: BearingMatches,
        prior: tuple[float, float],
        inlier_sigmas: float,
        least_parallax: float,
        right: FloatArray | None = None,
    ) -> None:
        """Prepares the matches.

        Args:
            matches: inliers and outliers.
            prior: standard deviations of the tilts (radians) and of the height (legs).
            inlier_sigmas: largest normalised residual of an inlier.
            least_parallax: radians; below, the signs of distances are noise.
            right: (n,) probability of being right before any geometry; None: by kind and quality.
        """
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
        tilt_sigma, height_sigma = prior
        held = np.maximum([*[tilt_sigma] * 4, height_sigma], _LEAST_SIGMA)
        self._prior = np.concatenate([np.zeros(2), 1.0 / held**2])  # theta and psi are free
        right = right_probability(matches) if right is None else right
        self._odds = right / (1.0 - right)
        self._sigmas = inlier_sigmas
        self._least_parallax = least_parallax

    def refine(self, directions: FloatArray, rotations: FloatArray) -> list[Refined]:
        """Gauss-Newton from hypotheses (c,), side by side; inliers are chosen anew each time."""
        parameters = np.zeros((len(directions), 7))
        parameters[:, 0], parameters[:, 1] = directions, rotations
        parameters = _SEARCH.minimise(parameters, self._normal)
        parameters[:, :2] = wrap(parameters[:, :2])
        return self._finished(parameters)

    def _normal(self, parameters: FloatArray, iteration: int) -> Linearised:
        """Information (c, 7, 7) and gradient (c, 7) at parameters (c, 7)."""
        widened = _WIDENED[iteration] if iteration < len(_WIDENED) else 1.0
        residuals, jacobian = self._linearised(parameters)
        weights = self._weights(parameters, residuals, widened)
        gradient = (jacobian @ (weights * residuals)[:, :, None])[:, :, 0]
        gradient += self._prior * parameters
        return self._information(jacobian, weights), gradient

    def _information(self, jacobian: FloatArray, weights: FloatArray) -> FloatArray:
        """(c, 7, 7) of Jacobians (c, 7, n) and weights (c, n), with the prior's."""
        weighted = jacobian * weights[:, None]
        return np.asarray(weighted @ jacobian.transpose(0, 2, 1) + np.diag(self._prior))

    def _finished(self, parameters: FloatArray) -> list[Refined]:
        residuals, jacobian = self._linearised(parameters)
        inliers = self._inliers(parameters, residuals)
        information = self._information(jacobian, self._weights(parameters, residuals))
        covariances = np.linalg.pinv(information, hermitian=True)
        return [
            Refined(p, covariance * max(1.0, _scatter(r[kept])) ** 2, r, kept)
            for p, covariance, r, kept in zip(
                parameters, covariances, residuals, inliers, strict=True
            )
        ]

    def _weights(
        self, parameters: FloatArray, residuals: FloatArray, widened: float = 1.0
    ) -> FloatArray:
        """(c, n) probability that each match is right, given how it fits."""
        inliers = self._inliers(parameters, residuals, widened)
        likely = self._odds * gain(residuals / widened, self._sigmas, COMMON_CHANCE)
        return inliers * likely / (1.0 + likely)

    def _inliers(
        self, parameters: FloatArray, residuals: FloatArray, widened: float = 1.0
    ) -> BoolArray:
        """(c, n), of (c, n) residuals."""
        theta, psi = parameters[:, 0], parameters[:, 1]
        ahead = in_front(self._bearings, theta, psi, self._least_parallax).T
        return np.asarray((np.abs(residuals) < widened * self._sigmas) & ahead)

    def _linearised(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(c, n) normalised residuals, their (c, 7, n) Jacobians, noise held at the estimate."""
        essential, derivatives = _essential(parameters)
        count = len(parameters)
        flat = essential.reshape(count, 9)
        residual = flat @ self._outer.T
        by = (derivatives.reshape(-1, 9) @ self._outer.T).reshape(count, 7, -1)
        noise = (flat @ self._noisy.T).reshape(count, 4, -1)
        sigma = np.sqrt(np.maximum(np.einsum("ckn,ckn->cn", noise, noise), 1e-24))
        return residual / sigma, by / sigma[:, None]


def _scatter(residuals: FloatArray) -> float:
    """Robust standard deviation of inliers' residuals; 1 where there are none."""
    return _MAD_TO_SIGMA * float(np.median(np.abs(residuals))) if len(residuals) else 1.0


def _outer(a: FloatArray, b: FloatArray) -> FloatArray:
    """(n, 9) products of all coordinates of two rays (n, 3)."""
    return np.asarray((a[:, :, None] * b[:, None, :]).reshape(len(a), 9))


def _essential(p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """E (c, 3, 3) of parameters (c, 7), with a^T E b = 0, and its (c, 7, 3, 3) derivatives.

    E = A^T [t]x Rz(psi) B, with tilts A and B. Their derivatives are taken as if by a further small
    tilt, exact where the tilt itself vanishes.
    """
    c, s, none = np.cos(p[:, 0]), np.sin(p[:, 0]), np.zeros(len(p))
    tilt_a, tilt_b = _tilt(p[:, 2:4]).transpose(0, 2, 1), _tilt(p[:, 4:6])
    turn = _turn(p[:, 1])
    leg = skew(np.column_stack([c, s, p[:, 6]]))
    right, left = turn @ tilt_b, tilt_a @ leg
    middle, turned = leg @ right, left @ turn
    derivatives = np.stack(
        [
            tilt_a @ skew(np.column_stack([-s, c, none])) @ right,
            turned @ _AXES[2] @ tilt_b,
            -tilt_a @ _AXES[0] @ middle,
            -tilt_a @ _AXES[1] @ middle,
            turned @ _AXES[0] @ tilt_b,
            turned @ _AXES[1] @ tilt_b,
            tilt_a @ _AXES[2] @ right,
        ],
        axis=1,
    )
    return left @ right, derivatives


_AXES = skew(np.eye(3))


def _turn(angle: FloatArray) -> FloatArray:
    """(c, 3, 3) rotations about the vertical."""
    c, s = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
    return np.asarray(np.eye(3) + s * _AXES[2] + (1.0 - c) * (_AXES[2] @ _AXES[2]))


def _tilt(vector: FloatArray) -> FloatArray:
    """(c, 3, 3) rotations by small vectors (roll, pitch, 0), (c, 2): Rodrigues' formula."""
    angle = np.hypot(vector[:, 0], vector[:, 1])[:, None, None]
    cross = skew(np.column_stack([vector, np.zeros(len(vector))]))
    # sin(x) / x and (1 - cos(x)) / x^2, also where x vanishes.
    first, half = np.sinc(angle / np.pi), np.sinc(0.5 * angle / np.pi)
    return np.asarray(np.eye(3) + first * cross + 0.5 * half**2 * (cross @ cross))
