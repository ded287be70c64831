"""A window of poses and landmarks: a Gauss-Newton step a frame, with the landmarks eliminated.

What leaves is kept as a :class:`~fgslam.backend.smoothers.window.WindowPrior`. What that
depends on is linearised once and for all where it was when it first did (first-estimate
Jacobians, Huang et al. 2010): linearised in two places, prior and measurements would together
claim to know what neither measured, above all the heading. A kernel weighs an observation where it
is linearised: judged where it has itself pulled the estimate to, a wrong match weighs more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.linalg import block_diag, solve_triangular

from fgslam.backend.considered import fused, pixels_of
from fgslam.backend.loops import home_changes, rotated, transported
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import KernelSettings
from fgslam.backend.smoothers.admission import LEAST_PARALLAX
from fgslam.backend.smoothers.bundle import Sightings, by_kind
from fgslam.backend.smoothers.elimination import (
    Eliminated,
    Equations,
    UndeterminedError,
    UndeterminedLandmarkError,
    scaled_cholesky,
)
from fgslam.backend.smoothers.graph import parallax
from fgslam.core.arrays import (
    BoolArray,
    FloatArray,
    GrowingColumns,
    IntArray,
    Rows,
    chi_square_quantile,
)
from fgslam.core.correction import displacements, term_names
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    adjoint,
    in_front,
    inverse,
    inverse_spd3,
    point_pose_jacobian,
    reorthonormalise,
    se3_exp,
    transform_to_camera,
    transform_to_world,
)
from fgslam.core.sensors import CameraRig
from fgslam.factors.graphs import landmark_key, number, pose_key
from fgslam.factors.landmark import summed, weighed
from fgslam.factors.measurement import LinearRows, nuisance_covariance, products, whitening
from fgslam.factors.noise import kernel_weights

# ------------------------------------------------------------------------------------------
# What a window of poses and landmarks is made of, and what it answers


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks(Rows):
    """Landmarks of the window (m, ...): variables ascending, places, what was known beforehand.

    That is a mean and its information (3, 3), zero where nothing was known.
    """

    variables: IntArray
    points: FloatArray
    mean: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """Observations (k,) as they are linearised now: rows of their poses and landmarks, and theirs.

    Residuals are those of the estimate, weights (in the rows) those of where it is linearised.
    ``pulls`` (k, m, 1 + q) are the residuals, then their derivatives by the rig's correction.
    ``shifted`` (k, m, 3) are those by the sensor's nuisance parameters, where it has any: hidden
    numbers, of which ``nuisance`` (3,) are the places. Residuals are those without them.
    """

    pose: IntArray
    point: IntArray
    rows: LinearRows
    pulls: FloatArray
    shifted: FloatArray
    nuisance: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """The window's normal equations at its solution, and what their rows are."""

    eliminated: Eliminated
    frames: list[int]
    variables: IntArray

    def rows(self, variables: list[int]) -> IntArray:
        """Rows of landmark variables."""
        return np.searchsorted(self.variables, variables).astype(np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """How a place that has left a window is off: by a motion in the axes of the first pose.

    Attributes:
        follows: another place by which it is known; None: the first pose.
        gain: (6, 6) by how much it is off where the other is, in the same axes.
        information: (6, 6) inverse covariance of the rest.
    """

    follows: int | None
    gain: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class WindowValues:
    """What is asked of GTSAM's values between two frames, by key: poses (4, 4) and points (3,)."""

    poses: dict[int, FloatArray]
    points: dict[int, FloatArray]

    def exists(self, key: int) -> bool:
        """Whether the window holds a variable."""
        return key in self.points or key in self.poses

    def landmarks(self) -> tuple[IntArray, FloatArray]:
        """As :func:`fgslam.factors.graphs.landmarks_in`."""
        keys = np.fromiter(self.points, np.int64, len(self.points))
        places = np.array(list(self.points.values())).reshape(-1, 3)
        order = np.argsort(keys)
        return keys[order] - landmark_key(0), places[order]

    def atPose3(self, key: int) -> Any:
        """A pose."""
        return gtsam.Pose3(self.poses[key])


# ------------------------------------------------------------------------------------------
# Landmarks of a whole drive: where each was when it left a window, and what was known of it


class HeldLandmarks(GrowingColumns):
    """By variable: place, mean and information given the poses, frame with which it is off.

    Attributes:
        points: (m, 3) places.
        mean, information: (m, 3) and (m, 3, 3) what is known given the poses.
        homes: (m,) the last frame that saw each before it left a window; -1: it never did.
        saved: (m,) whether it is known from a saved map, which no change of this drive moves.
    """

    points: FloatArray
    mean: FloatArray
    information: FloatArray
    homes: IntArray
    saved: BoolArray

    def __init__(self) -> None:
        """None yet."""
        super().__init__(
            points=np.empty((0, 3)),
            mean=np.empty((0, 3)),
            information=np.empty((0, 3, 3)),
            homes=np.empty(0, np.int64),
            saved=np.empty(0, np.bool_),
        )

    def enter(self, points: FloatArray) -> None:
        """New variables at points (k, 3), of which nothing is known."""
        k = len(points)
        known = {"points": points, "mean": points, "information": np.zeros((k, 3, 3))}
        self.append(known | {"homes": np.full(k, -1), "saved": np.zeros(k, np.bool_)})

    def know(self, variable: int, mean: FloatArray, covariance: FloatArray, saved: bool) -> None:
        """What is known of a new variable beforehand, from a ``saved`` map or from this drive."""
        self.mean[variable] = mean
        self.information[variable] = np.linalg.inv(covariance)
        self.saved[variable] = saved

    def begin(self, variables: IntArray, points: FloatArray) -> None:
        """They are elsewhere, at points (k, 3): what was known of them was of others."""
        self.points[variables] = self.mean[variables] = points
        self.information[variables] = 0.0
        self.homes[variables] = -1
        self.saved[variables] = False

    def carried_along(self, by_frame: FloatArray) -> None:
        """Moves each with the frame with which it is off, by motions of the world (n, 4, 4)."""
        by = home_changes(np.where(self.saved, -1, self.homes), by_frame)
        self.points[:] = transported(by, self.points)
        self.information[:] = rotated(by, self.information)

    def of(self, variables: IntArray) -> Landmarks:
        """Some of them, for a window."""
        known = self.points, self.mean, self.information
        return Landmarks(variables, *(column[variables] for column in known))

    def left(self, landmarks: Landmarks, home: int) -> None:
        """Takes back what has left a window, last seen in a frame."""
        at = landmarks.variables
        self.points[at], self.mean[at] = landmarks.points, landmarks.mean
        self.information[at] = landmarks.information
        self.homes[at] = home


# ------------------------------------------------------------------------------------------
# Landmarks seen again after they left a window: which of them are surely back

LEAST = 6  # landmarks that agree: as many as join two parts of a map
_FITS = float(chi_square_quantile(0.999, 3))
_ROUNDS = 3  # of who fits all that fit, after who fits one


@dataclass(frozen=True, slots=True, eq=False)
class SeenAgain(Rows):
    """Landmarks (k,) where an observation of each has them: points (k, 3) and covariances.

    Of one whose depth the observation does not tell (``near`` False) they are of first order about
    the depth that it was known to have.
    """

    variables: IntArray
    points: FloatArray
    covariances: FloatArray
    near: BoolArray

    @staticmethod
    def of(
        sensor: CameraRig,
        known: Landmarks,
        poses: FloatArray,
        measured: FloatArray,
        noise: FloatArray,
    ) -> SeenAgain:
        """From measurements (n, 3) at poses (n, 4, 4), of landmarks that were known before."""
        poses = poses.reshape(-1, 4, 4)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            local = sensor.triangulate(measured)
            covariances = sensor.triangulation_covariance(measured, noise)
        near = in_front(local) & np.isfinite(covariances).all(axis=(1, 2))
        near[near] = parallax(local[near], covariances[near]) >= LEAST_PARALLAX
        before = ((known.points - poses[:, :3, 3])[:, None] @ poses[:, :3, :3])[:, 0]
        far = ~near & in_front(before)
        about = _at_known_depth(sensor, before[far], measured[far], noise[far])
        local[far], covariances[far] = about
        kept = near | far
        poses, turned = poses[kept], poses[kept, :3, :3]
        points = (turned @ local[kept, :, None])[:, :, 0] + poses[:, :3, 3]
        across = turned @ covariances[kept] @ np.swapaxes(turned, 1, 2)
        return SeenAgain(known.variables[kept], points, across, near[kept])

    def returned(self, known: Landmarks, wTf: FloatArray, drift: FloatArray) -> BoolArray:
        """(k,) which are surely the same, at a place that has drifted.

        Args:
            known: the landmarks as they left.
            wTf: (4, 4) frame in which the drift is a motion.
            drift: (6, 6) its covariance.
        """
        here = transform_to_camera(wTf, known.points)
        off = _Off(
            wTf[:3, :3] @ -point_pose_jacobian(here),
            self.points - known.points,
            self.covariances + inverse_spd3(known.information),
        )
        alone = off.fit_with(np.zeros(len(self), np.bool_), drift)
        surely = alone & off.outweigh(drift)
        together = off.agreeing(alone, drift)
        return np.asarray(surely | together)


def _at_known_depth(
    sensor: CameraRig, before: FloatArray, measured: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Points (k, 3) of measurements, and covariances, to first order about the depths of others.

    A far point itself is not normally distributed; what it is measured by is.
    """
    expected = measured.copy()
    expected[:, 2] = sensor.predict(before)[:, 2]
    points = sensor.triangulate(expected)
    jacobian = sensor.jacobian(points)
    step = np.linalg.solve(jacobian, (measured - expected)[:, :, None])[:, :, 0]
    return points + step, sensor.triangulation_covariance(expected, noise)


@dataclass(frozen=True, slots=True, eq=False)
class _Off(Rows):
    """How far landmarks (k,) are off (k, 3): by a motion (k, 3, 6), and noise (k, 3, 3)."""

    by_motion: FloatArray
    off: FloatArray
    noise: FloatArray

    def outweigh(self, drift: FloatArray) -> BoolArray:
        """(k,) which the drift moves by no more than a deviation of their own noise."""
        moved = np.linalg.solve(self.noise, self._spread(drift))
        return np.asarray(np.trace(moved, axis1=1, axis2=2) <= 1.0)

    def agreeing(self, alone: BoolArray, drift: FloatArray) -> BoolArray:
        """(k,) those that agree on one motion; none where they are fewer than LEAST.

        As many as fit next to one of them that fits ``alone``, then those that fit next to all.
        """
        none = best = np.zeros(len(self), np.bool_)
        for row in np.flatnonzero(alone).tolist():
            of_one = np.arange(len(self)) == row
            found = self.fit_with(of_one, drift) | of_one
            best = found if found.sum() > best.sum() else best
        for _ in range(_ROUNDS):
            if best.sum() < LEAST:
                return none
            best = self.fit_with(best, drift)
        return best if best.sum() >= LEAST else none

    def fit_with(self, chosen: BoolArray, drift: FloatArray) -> BoolArray:
        """(k,) which fit the motion as the chosen ones measure it (a Kalman update)."""
        k = int(chosen.sum())
        by = self.by_motion[chosen].reshape(3 * k, 6)
        innovation = by @ drift @ by.T
        innovation.reshape(k, 3, k, 3)[np.arange(k), :, np.arange(k)] += self.noise[chosen]
        gain = np.linalg.solve(innovation, by @ drift).T
        off = self.off - self.by_motion @ (gain @ self.off[chosen].ravel())
        covariance = self._spread(drift - gain @ by @ drift) + self.noise
        solved = np.linalg.solve(covariance, off[:, :, None])[:, :, 0]
        return np.asarray(np.einsum("ki,ki->k", off, solved) <= _FITS)

    def _spread(self, drift: FloatArray) -> FloatArray:
        return np.asarray(self.by_motion @ drift @ np.swapaxes(self.by_motion, 1, 2))


# ------------------------------------------------------------------------------------------
# What has left a window of poses and landmarks, as a quadratic over what is still in it

_OPEN = 1e-13
"""Of a measurement's information: what is left to directions that it leaves open. It adds up over
the drive, and a stiff measurement (a height of 0.1 mm) has 1e8 times the others' information."""
_UNCOUPLED = 1e-9  # of a landmark's own information: a coupling that changes it by less is none


@dataclass(frozen=True, slots=True, eq=False)
class WindowPrior:
    """Half of ``z H z`` plus ``g z``, z the change since the point where it was linearised.

    z is in this order: r hidden numbers, the tangents of the window's poses (6n), and landmarks.
    Gradients have 1 + q columns: g, then its derivatives by the rig's correction, so that what has
    left follows a rig that calibrates itself as if it were measured again.

    Attributes:
        corner: (r + 6n, r + 6n) H of hidden numbers and poses.
        corner_gradient: (r + 6n, 1 + q) g of the same.
        variables: (p,) landmark variables that it speaks of, ascending.
        own: (p, 3, 3) H of each landmark.
        gradient: (p, 3, 1 + q) g of the same.
        coupling: (p, 3, r) H between landmarks and hidden numbers.
        points: (p, 3) where the landmarks were linearised.
        kept: so many of the hidden numbers, the first, stay what they are.
    """

    corner: FloatArray
    corner_gradient: FloatArray
    variables: IntArray
    own: FloatArray
    gradient: FloatArray
    coupling: FloatArray
    points: FloatArray
    kept: int = 0

    @staticmethod
    def none(terms: int, poses: int = 0) -> WindowPrior:
        """Says nothing about a window of some poses, by a rig's correction of so many terms."""
        size = 6 * poses
        return WindowPrior(
            np.zeros((size, size)),
            np.zeros((size, 1 + terms)),
            np.empty(0, np.int64),
            np.empty((0, 3, 3)),
            np.empty((0, 3, 1 + terms)),
            np.empty((0, 3, 0)),
            np.empty((0, 3)),
        )

    @property
    def hidden(self) -> int:
        """How many hidden numbers there are."""
        return int(self.coupling.shape[2])

    def with_pose(self) -> WindowPrior:
        """The same with one pose more in the window, of which it measures nothing."""
        gradient = np.pad(self.corner_gradient, ((0, 6), (0, 0)))
        return self._with_corner(np.pad(self.corner, (0, 6)), gradient, self.coupling)

    def recalibrated(self, values: FloatArray, same: bool) -> WindowPrior:
        """Of the measurements as they are with the rig's correction changed by ``values`` (q,).

        That of another rig than it is the ``same`` no longer depends on the correction.
        """
        corner, gradient = self.corner_gradient.copy(), self.gradient.copy()
        for pull in (corner, gradient):
            if same:
                pull[..., 0] += pull[..., 1:] @ values
            else:
                pull[..., 1:] = 0.0
        return dataclasses.replace(self, corner_gradient=corner, gradient=gradient)

    def with_leaving(self, poses: int, corner: FloatArray, gradient: FloatArray) -> WindowPrior:
        """The first poses hidden, and this added to the corner and its gradient."""
        coupling = np.pad(self.coupling, ((0, 0), (0, 0), (0, 6 * poses)))
        return self._with_corner(self.corner + corner, self.corner_gradient + gradient, coupling)

    def with_place(self) -> WindowPrior:
        """With six hidden numbers more that stay what they are, behind the others that do."""
        at = [self.kept] * 6
        corner = np.insert(np.insert(self.corner, at, 0.0, axis=0), at, 0.0, axis=1)
        coupling = np.insert(self.coupling, at, 0.0, axis=2)
        new = self._with_corner(corner, np.insert(self.corner_gradient, at, 0.0, axis=0), coupling)
        return dataclasses.replace(new, kept=self.kept + 6)

    def with_known(
        self, landmark: IntArray, information: FloatArray, place: int, by_place: FloatArray
    ) -> WindowPrior:
        """With what is known of landmarks that lie where they were linearised, but for a place.

        Args:
            landmark: (k,) their rows.
            information: (k, 3, 3) of each, given the place.
            place: first of its hidden numbers.
            by_place: (k, 3, 6) how they move along with it.
        """
        moving, at = information @ by_place, slice(place, place + 6)
        corner, coupling = self.corner.copy(), self.coupling.copy()
        corner[at, at] += (np.swapaxes(by_place, 1, 2) @ moving).sum(axis=0)
        coupling[landmark, :, at] -= moving
        own = self.own + summed(landmark, information, len(self.variables))
        found = self._with_corner(corner, self.corner_gradient, coupling)
        return dataclasses.replace(found, own=own)

    def with_tie(
        self, columns: IntArray, information: FloatArray, gradient: FloatArray
    ) -> WindowPrior:
        """With a quadratic (k, k) and (k,) more over some of the corner."""
        corner, whole = self.corner.copy(), self.corner_gradient.copy()
        corner[np.ix_(columns, columns)] += information
        whole[columns, 0] += gradient
        return self._with_corner(corner, whole, self.coupling)

    def without_place(self, place: int) -> WindowPrior:
        """A place's six hidden numbers are like any others."""
        order = np.arange(len(self.corner))
        order[place : self.kept] = np.roll(order[place : self.kept], -6)
        found = self._with_corner(
            self.corner[np.ix_(order, order)],
            self.corner_gradient[order],
            self.coupling[:, :, order[: self.hidden]],
        )
        return dataclasses.replace(found, kept=self.kept - 6)

    def with_rows(self, landmark: IntArray, columns: IntArray, look: Look) -> WindowPrior:
        """With what observations (k,) measured of landmarks, by row, and of hidden poses.

        Args:
            landmark: (k,) rows of the landmarks.
            columns: (k,) first hidden number of the pose that saw it.
            look: linearised and weighed; what they say of poses alone is not added.
        """
        rows, turned = look.rows, np.swapaxes(look.rows.by_point, 1, 2)
        p, coupling = len(self.variables), self.coupling.copy()
        at, own = columns[:, None] + np.arange(6), turned @ rows.by_point
        if rows.residual.shape[1] < 3:  # such a block has no inverse
            own += _OPEN * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        coupling[landmark[:, None], :, at] += np.swapaxes(turned @ rows.by_pose, 1, 2)
        coupling[:, :, look.nuisance] += summed(landmark, turned @ look.shifted, p)
        return dataclasses.replace(
            self,
            own=self.own + summed(landmark, own, p),
            gradient=self.gradient + summed(landmark, turned @ look.pulls, p),
            coupling=coupling,
        )

    def with_landmarks(self, variables: IntArray, points: FloatArray) -> WindowPrior:
        """Room for landmarks (k,) at points (k, 3), of which it measures nothing yet."""
        every = np.concatenate([self.variables, variables])
        order = np.argsort(every, kind="stable")
        more = len(variables)
        own = np.concatenate([self.own, np.zeros((more, 3, 3))])[order]
        gradient = np.concatenate([self.gradient, np.zeros((more, *self.gradient.shape[1:]))])
        coupling = np.concatenate([self.coupling, np.zeros((more, 3, self.hidden))])[order]
        at = np.concatenate([self.points, points])[order]
        return dataclasses.replace(
            self,
            variables=every[order],
            own=own,
            gradient=gradient[order],
            coupling=coupling,
            points=at,
        )

    def without(self, gone: BoolArray) -> WindowPrior:
        """Landmarks eliminated, by a mask (p,): what they say about the rest stays."""
        own, coupling, gradient = self.own[gone], self.coupling[gone], self.gradient[gone]
        gain = inverse_spd3(own) @ coupling
        r = self.hidden
        corner, corner_gradient = self.corner.copy(), self.corner_gradient.copy()
        rows = 3 * len(own)
        less = coupling.reshape(rows, r).T @ gain.reshape(rows, r)
        corner[:r, :r] -= 0.5 * (less + less.T)
        corner_gradient[:r] -= gain.reshape(rows, r).T @ gradient.reshape(rows, gradient.shape[2])
        left = ~gone
        return dataclasses.replace(
            self._with_corner(corner, corner_gradient, self.coupling[left]),
            variables=self.variables[left],
            own=self.own[left],
            gradient=self.gradient[left],
            points=self.points[left],
        )

    def compressed(self) -> WindowPrior:
        """The same with no more hidden numbers than the landmarks depend on.

        Hidden numbers are turned so that each has unit information and a coupling of its own
        strength, the singular values of the whitened coupling; those without one are eliminated.
        """
        q, r = self.kept, self.hidden
        if r == q:
            return self
        rest = np.r_[:q, r : len(self.corner)]
        factor, size = scaled_cholesky(self.corner[q:r, q:r])
        factor = size[:, None] * np.tril(factor)
        by_landmark = self._whitened(factor)
        strength, turn = np.linalg.eigh(by_landmark.T @ by_landmark)
        right = np.column_stack([self.corner[q:r, rest], self.corner_gradient[q:r]])
        turned = turn.T @ solve_triangular(factor, right, lower=True, check_finite=False)
        stays = strength > _UNCOUPLED
        gone, own = turned[~stays], turned[stays]
        (gone, gone_pull), (own, own_pull) = (
            np.split(of, [len(rest)], axis=1) for of in (gone, own)
        )
        corner = self.corner[np.ix_(rest, rest)] - gone.T @ gone
        gradient = self.corner_gradient[rest] - gone.T @ gone_pull
        back = solve_triangular(factor, turn[:, stays], trans="T", lower=True, check_finite=False)
        flat = self.coupling.reshape(-1, r)  # one product: three rows a landmark are slow
        coupling = np.hstack([flat[:, :q], flat[:, q:] @ back])
        coupling = coupling.reshape(len(self.own), 3, q + len(own))
        order = np.r_[len(own) : len(own) + q, : len(own), len(own) + q : len(own) + len(rest)]
        whole = np.block([[np.eye(len(own)), own], [own.T, corner]])
        return self._with_corner(
            whole[np.ix_(order, order)],
            np.concatenate([own_pull, gradient])[order],
            coupling,
        )

    def _whitened(self, factor: FloatArray) -> FloatArray:
        """(3p, r) coupling of landmarks and hidden numbers, both of unit information."""
        root = np.linalg.cholesky(self.own)
        half = np.linalg.solve(root, self.coupling[:, :, self.kept :])
        half = half.reshape(3 * len(root), self.hidden - self.kept)
        whitened = solve_triangular(factor, half.T, lower=True, check_finite=False)
        return np.asarray(whitened.T)

    def _with_corner(
        self, corner: FloatArray, gradient: FloatArray, coupling: FloatArray
    ) -> WindowPrior:
        return dataclasses.replace(self, corner=corner, corner_gradient=gradient, coupling=coupling)


_SHORT = 0.01
"""Radians and metres of a pose, iSAM2's threshold of relinearising: covariances are those of
within it."""
_NONE = np.empty(0, np.int64)
_STEPS = 3  # with a frame: what is left after them is gone with the next frame
_REPAIRS = 20  # times that landmarks are taken out before the graph itself must be wrong
_LEAST_SHARE = 0.1  # of a step
_LEFT_BETWEEN = 5  # poses that leave until their hidden numbers are looked through again


class Window:
    """Poses of consecutive frames, the landmarks seen from them, and what has left.

    Attributes:
        frames: of the poses.
        poses: (n, 4, 4) ``wTc``.
        landmarks: seen from them.
        observed: by the camera from these poses.
        measured: by other sensors, by kind.
        factors: GTSAM's graph on these poses alone.
        prior: what has left.
        places: where they began, (4, 4): of landmarks that came back, in the order of the prior's.
            Among them, by their kind, nuisance parameters of a sensor and three unused numbers.
        kernel: around each observation.
    """

    def __init__(self, sensor: CameraRig, kernel: KernelSettings) -> None:
        """Empty."""
        self.kernel = kernel
        self.frames: list[int] = []
        self.poses = np.empty((0, 4, 4))
        none = np.empty(0, np.int64)
        self.landmarks = Landmarks(none, np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3)))
        self.observed = Sightings(none, none, np.empty((0, 3)), np.empty((0, 3, 3)), sensor)
        self.measured: dict[str, Sightings] = {}
        self.factors = gtsam.NonlinearFactorGraph()
        self._terms = len(term_names(sensor))
        self._rig_since = 0  # first frame of the rig as it is now
        self.prior = WindowPrior.none(self._terms)
        self.places: dict[Any, FloatArray] = {}
        self._anchors: dict[int, FloatArray] = {}
        self._shift = np.empty((0, 6))
        self._least_hidden = 0

    # -- what comes in -----------------------------------------------------------------------

    def add_pose(self, frame: int, wTc: FloatArray, factors: Any) -> None:
        """A frame's pose, and the graph of the factors on it and the poses before."""
        self.frames.append(frame)
        self.poses = np.concatenate([self.poses, wTc[None]])
        self._shift = np.concatenate([self._shift, np.zeros((1, 6))])
        self.factors.push_back(factors)
        self.prior = self.prior.with_pose()

    def add_landmarks(self, new: Landmarks) -> None:
        """Landmarks that are not in the window."""
        joined = self.landmarks.join(new)
        self.landmarks = joined.select(np.argsort(joined.variables, kind="stable"))

    def observe(
        self, frame: IntArray, variable: IntArray, measurement: FloatArray, noise: FloatArray
    ) -> None:
        """Observations (k,) of landmarks of the window from its frames; noise (k, 3, 3)."""
        new = Sightings(frame, variable, measurement, whitening(noise), self.observed.model)
        self.observed = self.observed.join(new)

    def measure(self, seen: Sightings) -> None:
        """What another sensor measured of landmarks of the window."""
        frame, variable = seen.poses - pose_key(0), seen.points - landmark_key(0)
        new = dataclasses.replace(seen, poses=frame, points=variable)
        self.measured = by_kind([*self.measured.values(), new])
        if seen.model.nuisance.size and seen.model.kind not in self.places:
            self._add_nuisance(seen.model)

    def _add_nuisance(self, model: Any) -> None:
        """A sensor's nuisance parameters, with what is known of them beforehand."""
        columns, self.places[model.kind] = self.prior.kept + np.arange(6), np.eye(4)
        known = block_diag(np.linalg.inv(nuisance_covariance(model)), np.eye(3))
        self.prior = self.prior.with_place().with_tie(columns, known, np.zeros(6))

    def nuisance(self, model: Any) -> IntArray:
        """(3,) places of a sensor's nuisance parameters among the hidden numbers; (0,) of none."""
        if not len(model.nuisance):
            return _NONE
        return 6 * list(self.places).index(model.kind) + np.arange(3)

    def remeasure(self, change: RigChange) -> None:
        """Corrects the observations of the frames that the change is of, and what has left."""
        seen = self.observed
        same = change.since == self._rig_since
        self.prior = self.prior.recalibrated(change.values, same)
        self._rig_since = change.since
        late = (seen.poses >= change.since)[:, None]
        again = np.where(late, change.measured(seen.measured), seen.measured)
        self.observed = dataclasses.replace(seen, measured=again)

    # -- the solution ------------------------------------------------------------------------

    def solve(self) -> Solved:
        """Gauss-Newton steps until one is short, and the equations that the last was taken by.

        Of a step after which cameras have landmarks behind them, a half or less is taken.

        Raises:
            UndeterminedLandmarkError: a landmark is not determined by its observations.
            UndeterminedError: a pose is not.
        """
        solution = Eliminated(self.equations())
        for _ in range(_STEPS):
            eliminated, share = solution, 1.0
            self._move(eliminated)
            if np.abs(eliminated.corner[eliminated.hidden :]).max() < _SHORT:
                break
            while solution is eliminated:
                try:
                    solution = Eliminated(self.equations())
                except UndeterminedLandmarkError:
                    if share < _LEAST_SHARE:
                        raise
                    share *= 0.5
                    self._move(eliminated, -share)
        return Solved(eliminated, list(self.frames), self.landmarks.variables)

    def repaired(
        self, take_out: Callable[[int], None], failed: Callable[[Exception], Exception]
    ) -> Solved:
        """The solution without landmarks on which it fails.

        Args:
            take_out: takes a landmark variable out of the window.
            failed: the error to raise where that is no cure.
        """
        for _ in range(_REPAIRS):
            try:
                return self.solve()
            except UndeterminedLandmarkError as error:
                for variable in self.landmarks.variables[error.rows].tolist():
                    take_out(variable)
            except (UndeterminedError, np.linalg.LinAlgError) as error:
                raise failed(error) from None
        raise failed(EstimatorError("too many landmarks left it indeterminate"))

    def values(self) -> WindowValues:
        """The window's poses and landmarks as they are now."""
        known = self.landmarks
        return WindowValues(
            dict(zip(map(pose_key, self.frames), self.poses, strict=True)),
            dict(zip(map(landmark_key, known.variables.tolist()), known.points, strict=True)),
        )

    def _move(self, step: Eliminated, share: float = 1.0) -> None:
        by = share * step.corner[step.hidden :].reshape(-1, 6)
        self._shift = self._shift + np.where(self._fixed()[:, None], by, 0.0)
        poses = [
            self._anchors[frame] @ se3_exp(shift) if frame in self._anchors else wTc @ se3_exp(own)
            for frame, wTc, shift, own in zip(self.frames, self.poses, self._shift, by, strict=True)
        ]
        self.poses = np.array(poses)
        points = self.landmarks.points + share * step.points
        self.landmarks = dataclasses.replace(self.landmarks, points=points)

    def _fixed(self) -> BoolArray:
        """(n,) which poses are linearised once and for all."""
        return np.array([frame in self._anchors for frame in self.frames], np.bool_)

    # -- linearising -------------------------------------------------------------------------

    def _tied(self) -> IntArray:
        """(p,) rows of the landmarks that the prior speaks of."""
        return np.searchsorted(self.landmarks.variables, self.prior.variables).astype(np.int64)

    def linearise(self, observed: Sightings, leaving: bool = False) -> Look:
        """Some of the window's observations; a kernel weighs each where it is linearised.

        Of those that are ``leaving`` with their derivatives by the rig's correction.
        """
        seen, kernel = observed.at_rows(self.frames, self.landmarks.variables), self.kernel
        pose, point, (at, places) = seen.poses, seen.points, self._where_linearised()
        rows = seen.look(at, places)
        squared = np.einsum("ki,ki->k", rows.residual, rows.residual)
        name = kernel.name if seen.model is self.observed.model else "none"  # stated noise is true
        weight = kernel_weights(name, kernel.width, squared)
        residual = rows.residual + products(rows.by_point, (self.landmarks.points - places)[point])
        residual += products(rows.by_pose, self._shift[pose])
        rows = weighed(dataclasses.replace(rows, residual=residual), weight)
        pulls = rows.residual[:, :, None]
        if leaving:
            pulls = np.pad(pulls, ((0, 0), (0, 0), (0, self._terms)))
            if seen.model is self.observed.model:
                root = np.sqrt(weight * (observed.poses >= self._rig_since))
                rig = seen.model
                shift = fused(rig, displacements(rig, pixels_of(rig, seen.measured)))
                pulls[:, :, 1:] = root[:, None, None] * (seen.roots @ shift)
        return Look(pose, point, rows, pulls, seen.shifted(), self.nuisance(seen.model))

    def _where_linearised(self) -> tuple[FloatArray, FloatArray]:
        """Poses and points, those on which the prior depends where they were when it first did."""
        poses, points = self.poses.copy(), self.landmarks.points.copy()
        for row, frame in enumerate(self.frames):
            if frame in self._anchors:
                poses[row] = self._anchors[frame]
        points[self._tied()] = self.prior.points
        return poses, points

    def equations(self) -> Equations:
        """Normal equations of all that the window holds, where it is linearised."""
        n, m, p = len(self.frames), len(self.landmarks.variables), self.prior
        tied, r, weak = self._tied(), p.hidden, self.landmarks
        coupling, own = np.zeros((m, 3, n, 6)), weak.information.copy()
        gradient = products(weak.information, weak.points - weak.mean)
        evaluated = [self.linearise(observed) for observed in self._every]
        for look in evaluated:  # a landmark once a frame by each
            pose, point, rows = look.pose, look.point, look.rows
            turned = np.swapaxes(rows.by_point, 1, 2)
            coupling[point, :, pose, :] += turned @ rows.by_pose
            own += summed(point, turned @ rows.by_point, m)
            gradient += summed(point, products(turned, rows.residual), m)
        by = weak.points[tied] - p.points
        own[tied] += p.own
        gradient[tied] += p.gradient[:, :, 0] + products(p.own, by)
        corner, (right,) = self._corner_of(evaluated, n, r)
        self._add_factors(corner, right, self.factors, self._shift)
        corner += p.corner
        right += p.corner_gradient[:, 0] + p.corner[:, r:] @ self._shift.ravel()
        right[:r] += p.coupling.reshape(by.size, r).T @ by.ravel()
        tied, hidden = self._by_hidden(evaluated)
        return Equations(corner, right, own, gradient, coupling.reshape(m, 3, 6 * n), tied, hidden)

    def _by_hidden(self, evaluated: list[Look]) -> tuple[IntArray, FloatArray]:
        """Rows (p,) of landmarks that depend on hidden numbers, and their coupling (p, 3, r)."""
        tied, coupling = self._tied(), self.prior.coupling
        for look in evaluated:
            if len(look.nuisance):
                every = np.union1d(tied, look.point)
                more = np.zeros((len(every), *coupling.shape[1:]))
                more[np.searchsorted(every, tied)] = coupling
                by = np.swapaxes(look.rows.by_point, 1, 2) @ look.shifted
                rows = np.searchsorted(every, look.point)
                more[:, :, look.nuisance] += summed(rows, by, len(every))
                tied, coupling = every, more
        return tied, coupling

    @property
    def _every(self) -> list[Sightings]:
        """The observations of all sensors."""
        return [self.observed, *self.measured.values()]

    def _corner_of(self, evaluated: list[Look], n: int, r: int) -> tuple[FloatArray, FloatArray]:
        """What observations say of poses alone: (r + 6n, r + 6n), and pulls (1 + q, r + 6n)."""
        columns = evaluated[0].pulls.shape[2]
        corner, right = np.zeros((r + 6 * n, r + 6 * n)), np.zeros((columns, r + 6 * n))
        at = r + 6 * np.arange(n)[:, None] + np.arange(6)
        for look in evaluated:
            pose, rows = look.pose, look.rows
            turned = np.swapaxes(rows.by_pose, 1, 2)
            corner[at[:, :, None], at[:, None, :]] += summed(pose, turned @ rows.by_pose, n)
            right[:, at] += np.moveaxis(summed(pose, turned @ look.pulls, n), 2, 0)
            by, own = np.swapaxes(look.shifted, 1, 2), look.nuisance[:, None]
            cross = np.moveaxis(summed(pose, by @ rows.by_pose, n), 0, 1).reshape(len(own), 6 * n)
            corner[own, at.ravel()] += cross
            corner[at.ravel(), own] += cross
            corner[own, own.T] += (by @ look.shifted).sum(axis=0)
            right[:, own[:, 0]] += (by @ look.pulls).sum(axis=0).T
        return corner, right

    def _add_factors(
        self, corner: FloatArray, right: FloatArray, factors: Any, shift: FloatArray
    ) -> None:
        """Adds GTSAM's factors on poses to a corner and its gradient, shifted by (n, 6)."""
        frames = sorted({number(key) for key in factors.keyVector()})
        if not frames:
            return
        r = len(right) - 6 * len(self.frames)
        values = self._values(self._where_linearised()[0])
        information, pull = factors.linearize(values).hessian()  # rows by ascending keys
        rows = np.searchsorted(self.frames, frames)
        at = (6 * rows[:, None] + np.arange(6)).ravel()
        corner[np.ix_(r + at, r + at)] += information
        right[r + at] += information @ shift.ravel()[at] - pull

    def _values(self, poses: FloatArray) -> Any:
        values = gtsam.Values()
        for frame, wTc in zip(self.frames, poses, strict=True):
            values.insert(pose_key(frame), gtsam.Pose3(wTc))
        return values

    # -- what leaves -------------------------------------------------------------------------

    def let_go_before(self, first: int, staying: Collection[int] = ()) -> Landmarks:
        """Marginalises poses before a frame, and landmarks that only they saw, but some variables.

        Returns:
            The latter, with what was known of them given the poses.
        """
        leaving = int(np.searchsorted(self.frames, first))
        if not leaving:
            return self.landmarks.select(np.empty(0, np.int64))
        touched, untouched = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        for row in range(self.factors.size()):
            factor = self.factors.at(row)
            earliest = min(number(key) for key in list(factor.keys()))
            (touched if earliest < first else untouched).add(factor)
        gone = [self.linearise(one.select(one.poses < first), leaving=True) for one in self._every]
        self._into_prior(gone, touched, leaving)
        self.factors = untouched
        self._keep(lambda one: one.poses >= first)
        for frame in self.frames[:leaving]:
            self._anchors.pop(frame, None)
        self.frames = self.frames[leaving:]
        self.poses, self._shift = self.poses[leaving:], self._shift[leaving:]
        left = [*(one.points for one in self._every), np.array([*staying], np.int64)]
        return self._eliminate(~np.isin(self.landmarks.variables, np.concatenate(left)))

    def _keep(self, which: Callable[[Sightings], BoolArray]) -> None:
        """Those observations alone that a mask chooses."""
        self.observed = self.observed.select(which(self.observed))
        self.measured = {kind: one.select(which(one)) for kind, one in self.measured.items()}

    def _into_prior(self, evaluated: list[Look], factors: Any, leaving: int) -> None:
        """Adds what the first poses measured to the prior, and hides them there."""
        variables, points = self.landmarks.variables, self.landmarks.points
        there = [self._where_derived(look) for look in evaluated]
        seen = np.concatenate([variables[look.point] for look in there])
        new = np.setdiff1d(seen, self.prior.variables)
        prior = self.prior.with_landmarks(new, points[np.searchsorted(variables, new)])
        n, r = len(self.frames), prior.hidden
        corner, right = self._corner_of(there, n, r)
        self._add_factors(corner, right[0], factors, np.zeros_like(self._shift))
        prior = prior.with_leaving(leaving, corner, right.T)
        for look in there:
            tied = np.searchsorted(prior.variables, variables[look.point])
            prior = prior.with_rows(tied, r + 6 * look.pose, look)
        self.prior = prior
        for key in factors.keyVector():
            row = self.frames.index(number(key))
            self._anchors.setdefault(number(key), self.poses[row])

    def _where_derived(self, look: Look) -> Look:
        """Those that count, with residuals as they would be where the derivatives were taken."""
        counts: BoolArray = np.asarray(look.rows.by_point.any(axis=(1, 2)))
        pose, point, rows = look.pose[counts], look.point[counts], look.rows.select(counts)
        pulls, shifted = look.pulls[counts], look.shifted[counts]
        moved = (self.landmarks.points - self._where_linearised()[1])[point]
        residual = rows.residual - products(rows.by_point, moved)
        residual -= products(rows.by_pose, self._shift[pose])
        pulls[:, :, 0] = residual
        return Look(pose, point, rows, pulls, shifted, look.nuisance)

    def _eliminate(self, gone: BoolArray) -> Landmarks:
        """Takes landmarks (by a mask of all) out of the window; what they measured stays."""
        prior, weak = self.prior, self.landmarks
        tied = self._tied()
        known = weak.information.copy()
        known[tied] += prior.own
        left = dataclasses.replace(weak, mean=weak.points, information=known).select(gone)
        leaving = gone[tied]
        own = prior.own + np.where(leaving[:, None, None], weak.information[tied], 0.0)
        off = prior.points - weak.mean[tied]
        pull = products(weak.information[tied], off)
        gradient = prior.gradient.copy()
        gradient[:, :, 0] += np.where(leaving[:, None], pull, 0.0)
        prior = dataclasses.replace(prior, own=own, gradient=gradient)
        self.prior = prior.without(leaving)
        self.landmarks = weak.select(~gone)
        self._leave_places()
        if self.prior.hidden >= self._least_hidden + 6 * _LEFT_BETWEEN:
            self.prior = self.prior.compressed()
            self._least_hidden = self.prior.hidden
        return left

    def bring_back(self, known: Landmarks, place: int, tie: Tie | None) -> None:
        """Landmarks that had left come back, with what was known of them given the poses.

        Those of a place are off together, by one motion of it.

        Args:
            known: the landmarks, where they left.
            place: its number.
            tie: what is known of its motion, where the place is new.
        """
        none = np.zeros_like(known.information)
        if tie is not None:
            self._add_place(place, tie)
        row = list(self.places).index(place)
        at = self.places[place]
        by_place = at[:3, :3] @ -point_pose_jacobian(transform_to_camera(at, known.points))
        self.add_landmarks(dataclasses.replace(known, information=none))
        prior = self.prior.with_landmarks(known.variables, known.points)
        rows = np.searchsorted(prior.variables, known.variables).astype(np.int64)
        self.prior = prior.with_known(rows, known.information, 6 * row, by_place)

    def _add_place(self, place: int, tie: Tie) -> None:
        """A place whose motion follows another's, or the window's first pose."""
        self.prior, new = self.prior.with_place(), self.prior.kept
        first = self.frames[0]
        self._anchors.setdefault(first, self.poses[0])
        self.places[place] = at = self._anchors[first]
        if tie.follows is None:
            to, shift, carried = self.prior.hidden, self._shift[0], np.eye(6)
        else:
            to, shift = 6 * list(self.places).index(tie.follows), np.zeros(6)
            carried = adjoint(inverse(at) @ self.places[tie.follows])
        both = np.hstack([np.eye(6), -tie.gain @ carried])
        information = both.T @ tie.information @ both
        columns = np.concatenate([new + np.arange(6), to + np.arange(6)])
        self.prior = self.prior.with_tie(columns, information, -information[:, 6:] @ shift)

    def _leave_places(self) -> None:
        """Places on which no landmark depends any more are like any pose that left."""
        for place in list(self.places):
            at = 6 * list(self.places).index(place)
            left = not self.prior.coupling[:, :, at : at + 6].any()
            if left and place not in self.measured:
                self.prior = self.prior.without_place(at)
                del self.places[place]

    def take_out(self, variable: int) -> None:
        """Takes a landmark out, with what the window's poses saw of it."""
        self._keep(lambda one: one.points != variable)
        self._eliminate(self.landmarks.variables == variable)

    def carried_along(self, by: FloatArray, prior: Any, saved: IntArray = _NONE) -> None:
        """Moves everything by a motion of the world (4, 4); what has left gives way to a factor.

        What is known of ``saved`` landmark variables stays where it is: it is not of this drive.
        """
        self.poses = reorthonormalise(by @ self.poses)
        weak = self.landmarks
        stays = np.isin(weak.variables, saved)[:, None]
        turned = by[:3, :3] @ weak.information @ by[:3, :3].T
        turned = np.where(stays[:, None], weak.information, turned)
        points = transform_to_world(by, weak.points)
        mean = np.where(stays, weak.mean, transform_to_world(by, weak.mean))
        self.landmarks = Landmarks(weak.variables, points, mean, turned)
        self.prior, self._least_hidden = WindowPrior.none(self._terms, len(self.frames)), 0
        self.places = {}
        for model in (one.model for one in self.measured.values() if one.model.nuisance.size):
            self._add_nuisance(model)
        self._anchors, self._shift = {}, np.zeros((len(self.frames), 6))
        self.factors.add(prior)
