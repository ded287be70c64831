"""Least-squares refinement of a homing vector on its inliers, with covariance.

The planar constraint supposes level cameras at one height. Real ones tilt by a fraction of a degree
("estimate or inflate"), which bends elevations alike over whole sides of the view; so each
view's roll and pitch and the difference of heights are estimated along with theta and psi, held by
a prior. The residual is the epipolar one with general rotations, a weighted first-order (Sampson)
distance, minimised with its noise's own slope: held, the noise that residual and derivative share
would pull towards what explains less (Kanatani 1996).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from fgslam.cameras.omni import unit_rays
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
_LEAST_VARIANCE = 1e-24  # of a residual; a ray along the leg fits any of them
_LEAST_SHARE = 0.1  # of the information that is no noise; less leaves a direction open
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


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """All matches (n) seen from parameters (c, 7).

    Attributes:
        residuals: (c, n) normalised.
        jacobian: (c, 7, n) their derivatives, sigma held.
        derivatives: (c, 7, 9) of E.
        noise: (c, 4, n) the residual's deviation by each of the four angles, not normalised.
        variance: (c, n) the sum of their squares.
    """

    residuals: FloatArray
    jacobian: FloatArray
    derivatives: FloatArray
    noise: FloatArray
    variance: FloatArray


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
        self._prior = _information_of(prior)
        right = right_probability(matches) if right is None else right
        self._odds = right / (1.0 - right)
        self._sigmas = inlier_sigmas
        self._least_parallax = least_parallax

    def held_by(self, prior: tuple[float, float]) -> HomingRefinement:
        """The same matches under a prior that is nowhere tighter, as of the constructor."""
        out = copy(self)
        out._prior = np.minimum(self._prior, _information_of(prior))
        return out

    def strain(self, solution: Refined) -> float:
        """Sum of the squared tilts and height over those of the prior."""
        return float(self._prior @ solution.parameters**2)

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
        view = self._linearised(parameters)
        weights = self._weights(parameters, view.residuals, widened)
        slope = view.jacobian - view.residuals[:, None] * self._noise_slope(view)
        gradient = (slope @ (weights * view.residuals)[:, :, None])[:, :, 0]
        gradient += self._prior * parameters
        return self._information(view.jacobian, weights), gradient

    def _information(self, jacobian: FloatArray, weights: FloatArray) -> FloatArray:
        """(c, 7, 7) of Jacobians (c, 7, n) and weights (c, n), with the prior's."""
        weighted = jacobian * weights[:, None]
        return np.asarray(weighted @ jacobian.transpose(0, 2, 1) + np.diag(self._prior))

    def _finished(self, parameters: FloatArray) -> list[Refined]:
        view = self._linearised(parameters)
        residuals = view.residuals
        inliers = self._inliers(parameters, residuals)
        weights = _told(self._weights(parameters, residuals), residuals)
        scatter = np.array([_scatter(r[kept]) for r, kept in zip(residuals, inliers, strict=True)])
        variance = scatter[:, None, None] ** 2
        noise = self._noise_information(view, weights) * variance
        covariances = _sandwich(self._information(view.jacobian, weights), noise)
        covariances *= np.maximum(variance, 1.0)
        return list(map(Refined, parameters, covariances, residuals, inliers))

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

    def _linearised(self, parameters: FloatArray) -> _Linearised:
        """All matches at parameters (c, 7)."""
        essential, derivatives = _essential(parameters)
        count = len(parameters)
        flat, by_each = essential.reshape(count, 9), derivatives.reshape(count, 7, 9)
        noise = (flat @ self._noisy.T).reshape(count, 4, -1)
        variance = np.maximum(np.einsum("ckn,ckn->cn", noise, noise), _LEAST_VARIANCE)
        sigma = np.sqrt(variance)
        residuals = flat @ self._outer.T / sigma
        jacobian = by_each @ self._outer.T / sigma[:, None]
        return _Linearised(residuals, jacobian, by_each, noise, variance)

    def _noise_slope(self, view: _Linearised) -> FloatArray:
        """(c, 7, n) derivatives of ln sigma of the residuals."""
        carried = np.einsum("ckn,kne->cen", view.noise, self._noisy.reshape(4, -1, 9))
        return np.asarray(view.derivatives @ carried / view.variance[:, None])

    def _noise_information(self, view: _Linearised, weights: FloatArray) -> FloatArray:
        """(c, 7, 7) what noise alone adds to the information: derivatives are of noisy rays.

        Noise in line with the residual moves it, and not its derivatives.
        """
        count = len(weights)
        by = (view.derivatives @ self._noisy.T).reshape(count, 7, 4, -1)
        along = np.einsum("ckn,cpkn->cpn", view.noise, by) / view.variance[:, None]
        by -= along[:, :, None] * view.noise[:, None]
        by *= np.sqrt(weights / view.variance)[:, None, None]
        flat = by.reshape(count, 7, -1)
        return np.asarray(flat @ flat.transpose(0, 2, 1))


def _information_of(prior: tuple[float, float]) -> FloatArray:
    """(7,) of the parameters, of deviations of tilts and height; theta and psi are free."""
    held = np.maximum([*[prior[0]] * 4, prior[1]], _LEAST_SIGMA)
    return np.concatenate([np.zeros(2), 1.0 / held**2])


def _told(weights: FloatArray, residuals: FloatArray) -> FloatArray:
    """(c, n) information of matches over that of right ones, by how likely they are right.

    Less what is missing as that is not known (Louis 1982).
    """
    return np.asarray(np.maximum(weights * (1.0 - (1.0 - weights) * residuals**2), 0.0))


def _sandwich(information: FloatArray, noise: FloatArray) -> FloatArray:
    """Covariances (c, 7, 7) of estimates whose information (c, 7, 7) is partly noise.

    The score's covariance is the information, its slope what is left of it without the noise:
    slope^-1 information slope^-1 (Godambe).
    """
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, _LEAST_VARIANCE))[:, None] ** -1.0
    inverse = root @ vectors.transpose(0, 2, 1)
    shares, axes = np.linalg.eigh(inverse @ noise @ inverse)
    left = np.maximum(1.0 - shares, _LEAST_SHARE)
    carried = inverse @ (axes / left[:, None])
    return np.asarray(carried @ carried.transpose(0, 2, 1))


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
    tilts = _tilt(p[:, 2:6].reshape(-1, 2))  # those of both views at once
    tilt_a, tilt_b = tilts[::2].transpose(0, 2, 1), tilts[1::2]
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
    x, y = vector.T
    half_angle = 0.5 * np.hypot(x, y)
    # sin(a) / a and (1 - cos(a)) / a^2 by half angles, also where a vanishes.
    half = np.sinc(half_angle / np.pi)
    first, second = half * np.cos(half_angle), 0.5 * half**2
    out = np.empty((len(vector), 3, 3))
    out[:, 0, 0], out[:, 1, 1] = 1.0 - second * y * y, 1.0 - second * x * x
    out[:, 0, 1] = out[:, 1, 0] = second * x * y
    out[:, 2, 2] = 1.0 - second * (x * x + y * y)
    out[:, 0, 2], out[:, 1, 2] = first * y, -first * x
    out[:, 2, 0], out[:, 2, 1] = -first * y, first * x
    return out
