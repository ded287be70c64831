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

from fgslam.backend.smoothers.marginals import scaled_cholesky
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.geometry import inverse_spd3
from fgslam.factors.stacked import LinearRows, products, summed

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
    """

    corner: FloatArray
    corner_gradient: FloatArray
    variables: IntArray
    own: FloatArray
    gradient: FloatArray
    coupling: FloatArray
    points: FloatArray

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
        return WindowPrior(
            self.corner, self.corner_gradient, every[order], own, gradient, coupling, at
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
        kept = ~gone
        return WindowPrior(
            corner,
            corner_gradient,
            self.variables[kept],
            self.own[kept],
            self.gradient[kept],
            self.coupling[kept],
            self.points[kept],
        )

    def compressed(self) -> WindowPrior:
        """The same with no more hidden numbers than the landmarks depend on.

        Hidden numbers are turned so that each has unit information and a coupling of its own
        strength, the singular values of the whitened coupling; those without one are eliminated.
        """
        r = self.hidden
        if r == 0:
            return self
        factor, size = scaled_cholesky(self.corner[:r, :r])
        factor = size[:, None] * np.tril(factor)
        by_landmark = self._whitened(factor)
        strength, turn = np.linalg.eigh(by_landmark.T @ by_landmark)
        rest, gradient = self.corner[:r, r:], self.corner_gradient[:r]
        turned = turn.T @ solve_triangular(
            factor, np.column_stack([rest, gradient]), lower=True, check_finite=False
        )
        kept = strength > _UNCOUPLED
        gone = turned[~kept]
        corner = self.corner[r:, r:] - gone[:, :-1].T @ gone[:, :-1]
        corner_gradient = self.corner_gradient[r:] - gone[:, :-1].T @ gone[:, -1]
        kept_rest, kept_gradient = turned[kept, :-1], turned[kept, -1]
        back = solve_triangular(factor, turn[:, kept], trans="T", lower=True, check_finite=False)
        return self._with_corner(
            np.block([[np.eye(int(kept.sum())), kept_rest], [kept_rest.T, corner]]),
            np.concatenate([kept_gradient, corner_gradient]),
            self.coupling @ back,
        )

    def _whitened(self, factor: FloatArray) -> FloatArray:
        """(3p, r) coupling of landmarks and hidden numbers, both of unit information."""
        root = np.linalg.cholesky(self.own)
        half = np.linalg.solve(root, self.coupling).reshape(3 * len(root), self.hidden)
        whitened = solve_triangular(factor, half.T, lower=True, check_finite=False)
        return np.asarray(whitened.T)

    def _with_corner(
        self, corner: FloatArray, gradient: FloatArray, coupling: FloatArray
    ) -> WindowPrior:
        return dataclasses.replace(self, corner=corner, corner_gradient=gradient, coupling=coupling)
