"""What has left a window of poses and landmarks, as a quadratic over what is still in it.

A pose that leaves ties all landmarks that it saw to each other: as a matrix over them, its say is
dense, and grows with their number. Here it stays what it is: a block of each landmark's own, and a
coupling to six hidden numbers, the pose that left. So landmarks are independent given the rest,
always, and can be eliminated one by one. Hidden numbers that no landmark in the window depends on
any more are eliminated for good; what is left of them is bounded by the length of the tracks, and
by the landmarks within the window. Derivation: docs/derivations/smoothers.md.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from fgslam.backend.smoothers.dense_cholesky import scaled_cholesky
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.geometry import inverse_spd3
from fgslam.factors.landmark import LinearRows, products, summed

_UNCOUPLED = 1e-9  # of a landmark's own information: a coupling that changes it by less is none


@dataclass(frozen=True, slots=True, eq=False)
class WindowPrior:
    """Half of ``z H z`` plus ``g z``, z the change since the point where it was linearised.

    z is in this order: r hidden numbers, the tangents of the window's poses (6n), and landmarks.

    Attributes:
        corner: (r + 6n, r + 6n) H of hidden numbers and poses.
        corner_gradient: (r + 6n,) g of the same.
        variables: (p,) landmark variables that it speaks of, ascending.
        own: (p, 3, 3) H of each landmark.
        gradient: (p, 3) g of the same.
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
    def none(poses: int = 0) -> WindowPrior:
        """Says nothing about a window of some poses."""
        size = 6 * poses
        return WindowPrior(
            np.zeros((size, size)),
            np.zeros(size),
            np.empty(0, np.int64),
            np.empty((0, 3, 3)),
            np.empty((0, 3)),
            np.empty((0, 3, 0)),
            np.empty((0, 3)),
        )

    @property
    def hidden(self) -> int:
        """How many hidden numbers there are."""
        return int(self.coupling.shape[2])

    def with_pose(self) -> WindowPrior:
        """The same with one pose more in the window, of which it says nothing."""
        return self._with_corner(
            np.pad(self.corner, (0, 6)), np.pad(self.corner_gradient, (0, 6)), self.coupling
        )

    def with_leaving(self, poses: int, corner: FloatArray, gradient: FloatArray) -> WindowPrior:
        """The first poses hidden, and this added to the corner and its gradient."""
        coupling = np.pad(self.coupling, ((0, 0), (0, 0), (0, 6 * poses)))
        return self._with_corner(self.corner + corner, self.corner_gradient + gradient, coupling)

    def with_place(self) -> WindowPrior:
        """With six hidden numbers more that stay what they are, behind the others that do."""
        at = [self.kept] * 6
        corner = np.insert(np.insert(self.corner, at, 0.0, axis=0), at, 0.0, axis=1)
        coupling = np.insert(self.coupling, at, 0.0, axis=2)
        new = self._with_corner(corner, np.insert(self.corner_gradient, at, 0.0), coupling)
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
        whole[columns] += gradient
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

    def with_rows(self, landmark: IntArray, columns: IntArray, rows: LinearRows) -> WindowPrior:
        """With what observations (k,) said of landmarks, by row, and of hidden poses.

        Args:
            landmark: (k,) rows of the landmarks.
            columns: (k,) first hidden number of the pose that saw it.
            rows: linearised and weighed; what they say of poses alone is not added.
        """
        turned = np.swapaxes(rows.by_point, 1, 2)
        p, coupling = len(self.variables), self.coupling.copy()
        at = columns[:, None] + np.arange(6)
        coupling[landmark[:, None], :, at] += np.swapaxes(turned @ rows.by_pose, 1, 2)
        return dataclasses.replace(
            self,
            own=self.own + summed(landmark, turned @ rows.by_point, p),
            gradient=self.gradient + summed(landmark, products(turned, rows.residual), p),
            coupling=coupling,
        )

    def with_landmarks(self, variables: IntArray, points: FloatArray) -> WindowPrior:
        """Room for landmarks (k,) at points (k, 3), of which it says nothing yet."""
        every = np.concatenate([self.variables, variables])
        order = np.argsort(every, kind="stable")
        more = len(variables)
        own = np.concatenate([self.own, np.zeros((more, 3, 3))])[order]
        gradient = np.concatenate([self.gradient, np.zeros((more, 3))])[order]
        coupling = np.concatenate([self.coupling, np.zeros((more, 3, self.hidden))])[order]
        at = np.concatenate([self.points, points])[order]
        return dataclasses.replace(
            self,
            variables=every[order],
            own=own,
            gradient=gradient,
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
        corner_gradient[:r] -= gain.reshape(rows, r).T @ gradient.ravel()
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
        corner = self.corner[np.ix_(rest, rest)] - gone[:, :-1].T @ gone[:, :-1]
        gradient = self.corner_gradient[rest] - gone[:, :-1].T @ gone[:, -1]
        back = solve_triangular(factor, turn[:, stays], trans="T", lower=True, check_finite=False)
        coupling = np.concatenate([self.coupling[:, :, :q], self.coupling[:, :, q:] @ back], axis=2)
        order = np.r_[len(own) : len(own) + q, : len(own), len(own) + q : len(own) + len(rest)]
        whole = np.block([[np.eye(len(own)), own[:, :-1]], [own[:, :-1].T, corner]])
        return self._with_corner(
            whole[np.ix_(order, order)],
            np.concatenate([own[:, -1], gradient])[order],
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
