"""A window of poses and landmarks: a Gauss-Newton step a frame, with the landmarks eliminated.

What leaves is kept as a :class:`~fgslam.backend.smoothers.window_prior.WindowPrior`. What that
depends on is linearised once and for all where it was when it first did (first-estimate
Jacobians, Huang et al. 2010): linearised in two places, prior and measurements would together
claim to know what neither measured, above all the heading. A kernel weighs an observation where it
is linearised: judged where it has itself pulled the estimate to, a wrong match weighs more.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from fgslam.backend.settings import KernelSettings
from fgslam.backend.smoothers.dense_cholesky import UndeterminedError
from fgslam.backend.smoothers.landmark_elimination import (
    Eliminated,
    Equations,
    UndeterminedLandmarkError,
)
from fgslam.backend.smoothers.window_parts import (
    Landmarks,
    LandmarkUndeterminedError,
    Look,
    Observed,
    Solved,
    Tie,
    WindowValues,
)
from fgslam.backend.smoothers.window_prior import WindowPrior
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    adjoint,
    inverse,
    point_pose_jacobian,
    reorthonormalise,
    se3_exp,
    transform_to_camera,
    transform_to_world,
)
from fgslam.core.sensors import CameraRig
from fgslam.factors.graphs import landmark_key, number, pose_key
from fgslam.factors.landmark import (
    LinearRows,
    linearised,
    products,
    summed,
    weighed,
    whitening,
)
from fgslam.factors.noise import kernel_weights

_SHORT = 0.01
"""Radians and metres of a pose, iSAM2's threshold of linearising anew: covariances are those of
within it."""
_NONE = np.empty(0, np.int64)
_STEPS = 3  # with a frame: what is left after them is gone with the next frame
_REPAIRS = 20  # landmarks taken out in one solution before the graph itself must be wrong
_LEFT_BETWEEN = 5  # poses that leave until their hidden numbers are looked through again


class Window:
    """Poses of consecutive frames, the landmarks seen from them, and what has left.

    Attributes:
        frames: of the poses.
        poses: (n, 4, 4) ``wTc``.
        landmarks: seen from them.
        observed: from these poses.
        factors: GTSAM's graph on these poses alone.
        prior: what has left.
        places: where they began, (4, 4): of landmarks that came back, in the order of the prior's.
        kernel: around each observation.
    """

    def __init__(self, sensor: CameraRig, kernel: KernelSettings) -> None:
        """Empty."""
        self._sensor, self.kernel = sensor, kernel
        self.frames: list[int] = []
        self.poses = np.empty((0, 4, 4))
        none = np.empty(0, np.int64)
        self.landmarks = Landmarks(none, np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3)))
        self.observed = Observed(none, none, np.empty((0, 3)), np.empty((0, 3, 3)))
        self.factors = gtsam.NonlinearFactorGraph()
        self.prior = WindowPrior.none()
        self.places: dict[int, FloatArray] = {}
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
        new = Observed(frame, variable, measurement, whitening(noise))
        self.observed = self.observed.join(new)

    def remeasure(self, measured: Callable[[FloatArray], FloatArray]) -> None:
        """Replaces the numbers (k, 3) of all observations by a function of them."""
        anew = measured(self.observed.measurement)
        self.observed = dataclasses.replace(self.observed, measurement=anew)

    # -- the solution ------------------------------------------------------------------------

    def solve(self) -> Solved:
        """Gauss-Newton steps until one is short, and the equations that the last was taken by.

        Raises:
            LandmarkUndeterminedError: a landmark is not determined by its observations.
            UndeterminedError: a pose is not.
        """
        for _ in range(_STEPS):
            eliminated = self._eliminated(self.equations())
            self._move(eliminated)
            if np.abs(eliminated.corner[eliminated.hidden :]).max() < _SHORT:
                break
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
            except LandmarkUndeterminedError as error:
                take_out(error.variable)
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

    def _eliminated(self, equations: Equations) -> Eliminated:
        try:
            return Eliminated(equations)
        except UndeterminedLandmarkError as error:
            variable = int(self.landmarks.variables[error.row])
            raise LandmarkUndeterminedError(variable, str(error)) from None

    def _move(self, step: Eliminated) -> None:
        by = step.corner[step.hidden :].reshape(-1, 6)
        self._shift = self._shift + np.where(self._fixed()[:, None], by, 0.0)
        poses = [
            self._anchors[frame] @ se3_exp(shift) if frame in self._anchors else wTc @ se3_exp(own)
            for frame, wTc, shift, own in zip(self.frames, self.poses, self._shift, by, strict=True)
        ]
        self.poses = np.array(poses)
        points = self.landmarks.points + step.points
        self.landmarks = dataclasses.replace(self.landmarks, points=points)

    def _fixed(self) -> BoolArray:
        """(n,) which poses are linearised once and for all."""
        return np.array([frame in self._anchors for frame in self.frames], np.bool_)

    # -- linearising -------------------------------------------------------------------------

    def _rows(self, observed: Observed) -> tuple[IntArray, IntArray]:
        """Rows of the observations' poses and landmarks."""
        pose = np.searchsorted(self.frames, observed.frame).astype(np.int64)
        return pose, np.searchsorted(self.landmarks.variables, observed.variable).astype(np.int64)

    def _tied(self) -> IntArray:
        """(p,) rows of the landmarks that the prior speaks of."""
        return np.searchsorted(self.landmarks.variables, self.prior.variables).astype(np.int64)

    def linearise(self, observed: Observed) -> Look:
        """Some of the window's observations; a kernel weighs each where it is linearised."""
        (pose, point), o, kernel = self._rows(observed), observed, self.kernel
        at, places = self._where_linearised()
        rows = linearised(self._sensor, at[pose], places[point], o.measurement, o.root)
        squared = np.einsum("ki,ki->k", rows.residual, rows.residual)
        weight = kernel_weights(kernel.name, kernel.width, squared)
        residual = rows.residual + products(rows.by_point, (self.landmarks.points - places)[point])
        residual += products(rows.by_pose, self._shift[pose])
        return Look(pose, point, weighed(dataclasses.replace(rows, residual=residual), weight))

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
        look = self.linearise(self.observed)
        pose, point, rows = look.pose, look.point, look.rows
        n, m, p = len(self.frames), len(self.landmarks.variables), self.prior
        tied, r, weak = self._tied(), p.hidden, self.landmarks
        turned = np.swapaxes(rows.by_point, 1, 2)
        coupling = np.zeros((m, 3, n, 6))
        coupling[point, :, pose, :] = turned @ rows.by_pose
        own = weak.information + summed(point, turned @ rows.by_point, m)
        gradient = products(weak.information, weak.points - weak.mean)
        gradient += summed(point, products(turned, rows.residual), m)
        by = weak.points[tied] - p.points
        own[tied] += p.own
        gradient[tied] += p.gradient + products(p.own, by)
        corner, right = self._corner_of(pose, rows, n, r)
        self._add_factors(corner, right, self.factors, self._shift)
        corner += p.corner
        right += p.corner_gradient + p.corner[:, r:] @ self._shift.ravel()
        right[:r] += p.coupling.reshape(by.size, r).T @ by.ravel()
        return Equations(
            corner, right, own, gradient, coupling.reshape(m, 3, 6 * n), tied, p.coupling
        )

    def _corner_of(
        self, pose: IntArray, rows: LinearRows, n: int, r: int
    ) -> tuple[FloatArray, FloatArray]:
        """What observations say of poses alone: (r + 6n, r + 6n) and (r + 6n,)."""
        turned = np.swapaxes(rows.by_pose, 1, 2)
        corner, right = np.zeros((r + 6 * n, r + 6 * n)), np.zeros(r + 6 * n)
        at = r + 6 * np.arange(n)[:, None] + np.arange(6)
        corner[at[:, :, None], at[:, None, :]] = summed(pose, turned @ rows.by_pose, n)
        right[at] = summed(pose, products(turned, rows.residual), n)
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

    def let_go_before(self, first: int) -> Landmarks:
        """Marginalises poses before a frame, and landmarks that only they saw.

        Returns:
            The latter, with what was known of them given the poses.
        """
        leaving = int(np.searchsorted(self.frames, first))
        if not leaving:
            return self.landmarks.select(np.empty(0, np.int64))
        gone = self.observed.frame < first
        touched, untouched = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        for row in range(self.factors.size()):
            factor = self.factors.at(row)
            earliest = min(number(key) for key in list(factor.keys()))
            (touched if earliest < first else untouched).add(factor)
        self._into_prior(self.linearise(self.observed.select(gone)), touched, leaving)
        self.factors = untouched
        self.observed = self.observed.select(~gone)
        self._drop_poses(leaving)
        return self._eliminate(~np.isin(self.landmarks.variables, self.observed.variable))

    def _into_prior(self, look: Look, factors: Any, leaving: int) -> None:
        """Adds what the first poses said to the prior, and hides them there."""
        said: BoolArray = np.asarray(look.rows.by_point.any(axis=(1, 2)))
        pose, point = look.pose[said], look.point[said]
        rows = look.rows.select(said)
        variables, points = self.landmarks.variables, self.landmarks.points
        new = np.setdiff1d(variables[point], self.prior.variables)
        prior = self.prior.with_landmarks(new, points[np.searchsorted(variables, new)])
        tied, n, r = (
            np.searchsorted(prior.variables, variables[point]),
            len(self.frames),
            prior.hidden,
        )
        # Residuals as they would be where the derivatives were taken.
        by = points[point] - prior.points[tied]
        there = rows.residual - products(rows.by_point, by)
        there -= products(rows.by_pose, self._shift[pose])
        rows = dataclasses.replace(rows, residual=there)
        corner, right = self._corner_of(pose, rows, n, r)
        self._add_factors(corner, right, factors, np.zeros_like(self._shift))
        self.prior = prior.with_leaving(leaving, corner, right).with_rows(tied, r + 6 * pose, rows)
        for key in factors.keyVector():
            row = self.frames.index(number(key))
            self._anchors.setdefault(number(key), self.poses[row])

    def _drop_poses(self, leaving: int) -> None:
        for frame in self.frames[:leaving]:
            self._anchors.pop(frame, None)
        self.frames = self.frames[leaving:]
        self.poses, self._shift = self.poses[leaving:], self._shift[leaving:]

    def _eliminate(self, gone: BoolArray) -> Landmarks:
        """Takes landmarks (by a mask of all) out of the window; what they said stays."""
        prior, weak = self.prior, self.landmarks
        tied = self._tied()
        known = weak.information.copy()
        known[tied] += prior.own
        left = dataclasses.replace(weak, mean=weak.points, information=known).select(gone)
        leaving = gone[tied]
        own = prior.own + np.where(leaving[:, None, None], weak.information[tied], 0.0)
        off = prior.points - weak.mean[tied]
        pull = products(weak.information[tied], off)
        gradient = prior.gradient + np.where(leaving[:, None], pull, 0.0)
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
            if not self.prior.coupling[:, :, at : at + 6].any():
                self.prior = self.prior.without_place(at)
                del self.places[place]

    def take_out(self, variable: int) -> None:
        """Takes a landmark out, with what the window's poses saw of it."""
        self.observed = self.observed.select(self.observed.variable != variable)
        self._eliminate(self.landmarks.variables == variable)

    def carried_along(self, by: FloatArray, prior: Any, saved: IntArray = _NONE) -> None:
        """Moves everything by a motion of the world (4, 4); what has left gives way to a factor.

        What is known of ``saved`` landmark variables stays where it is: it is not of this drive.
        """
        self.poses = np.array([reorthonormalise(by @ pose) for pose in self.poses])
        weak = self.landmarks
        stays = np.isin(weak.variables, saved)[:, None]
        turned = by[:3, :3] @ weak.information @ by[:3, :3].T
        turned = np.where(stays[:, None], weak.information, turned)
        points = transform_to_world(by, weak.points)
        mean = np.where(stays, weak.mean, transform_to_world(by, weak.mean))
        self.landmarks = Landmarks(weak.variables, points, mean, turned)
        self.prior, self._least_hidden = WindowPrior.none(len(self.frames)), 0
        self.places = {}
        self._anchors, self._shift = {}, np.zeros((len(self.frames), 6))
        self.factors.add(prior)
