"""A few numbers on which all poses of a graph may depend: its border.

The rest is solved for with each of them held; what is left is a small dense system (the Schur
complement of the rest). So the sparse part stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError


@dataclass(frozen=True, slots=True, eq=False)
class Border:
    """What the p numbers add to the normal equations.

    Attributes:
        by_pose: (6n, p) their coupling to the poses.
        own: (p, p) their information.
        gradient: (p,).
    """

    by_pose: FloatArray
    own: FloatArray
    gradient: FloatArray

    def damped(self, by: float) -> Border:
        """With so many times the diagonal added to itself."""
        return replace(self, own=self.own + by * np.diag(np.diagonal(self.own)))


class Eliminated(Protocol):
    """A solved system, landmarks (3m) before poses (6n)."""

    @property
    def system(self) -> Any:
        """The normal equations (``LinearSystem``)."""
        ...

    def step(self) -> FloatArray:
        """From where the graph was linearised to its minimum; (3m + 6n,), then a border."""
        ...

    def solve(self, gradients: FloatArray) -> FloatArray:
        """The steps for other gradients (3m + 6n, c)."""
        ...

    def poses(self) -> FloatArray:
        """(n, 6, 6) marginals."""
        ...

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals."""
        ...

    def joint(self, pose: int, landmarks: IntArray) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of one pose and landmarks."""
        ...


@dataclass(frozen=True, eq=False)
class Bordered:
    """A solved system with a border more.

    Attributes:
        held: the same with the border held as it is.
        gain: (3m + 6n, p) how landmarks and poses follow the border; then how a border does that
            ``held`` has itself.
        covariance: (p, p) of the border.
        moved: (p,) its step; zero of one that is considered, not estimated.
    """

    held: Eliminated
    gain: FloatArray
    covariance: FloatArray
    moved: FloatArray

    @staticmethod
    def of(held: Eliminated, gradient: FloatArray, border: Border) -> Bordered:
        """A solved system (its gradient (3m + 6n,)) with the border that was held.

        Raises:
            EstimatorError: the border is not determined.
        """
        p, columns = len(border.gradient), held.system.columns
        coupling = np.concatenate([np.zeros((columns, p)), border.by_pose])
        gain = held.solve(coupling)
        information = border.own + coupling.T @ gain
        try:
            root = np.linalg.inv(np.linalg.cholesky(0.5 * (information + information.T)))
        except np.linalg.LinAlgError:
            raise EstimatorError("the measurements do not determine a gyroscope's bias") from None
        covariance = root.T @ root
        return Bordered(held, gain, covariance, -covariance @ (border.gradient + gain.T @ gradient))

    def step(self) -> FloatArray:
        """(3m + 6n + p,) from where the graph was linearised to its minimum."""
        return np.concatenate([self.held.step() + self.gain @ self.moved, self.moved])

    def solve(self, gradients: FloatArray) -> FloatArray:
        """(3m + 6n + p, c) the steps for other gradients (3m + 6n, c), none of the border's own."""
        moved = -self.covariance @ (self.gain.T @ gradients)
        return np.concatenate([self.held.solve(gradients) + self.gain @ moved, moved])

    def poses(self) -> FloatArray:
        """(n, 6, 6) marginals, in the order of ``pose_keys``."""
        found, first = self.held.poses(), self.held.system.columns
        return found + self._of(self.gain[first : first + 6 * len(found)], 6)

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals, in the order of ``landmark_keys``."""
        return self.held.landmarks() + self._of(self.gain[: self.held.system.columns], 3)

    def joint(self, pose: int, landmarks: IntArray) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of one pose and landmarks, by row of the key lists."""
        at = self.held.system.columns + 6 * pose + np.arange(6)
        rows = np.concatenate([at, (3 * landmarks[:, None] + np.arange(3)).ravel()])
        gain = self.gain[rows]
        return np.asarray(self.held.joint(pose, landmarks) + gain @ self.covariance @ gain.T)

    @property
    def estimated(self) -> FloatArray:
        """(b, b) covariance of the border that the system itself has."""
        if not isinstance(self.held, Bordered):
            return self.covariance
        gain = self.gain[-len(self.held.covariance) :]
        return np.asarray(self.held.estimated + gain @ self.covariance @ gain.T)

    @property
    def system(self) -> Any:
        """The normal equations."""
        return self.held.system

    def _of(self, gain: FloatArray, size: int) -> FloatArray:
        """(k, size, size) what the border's covariance is in rows (size k, p)."""
        gain = gain.reshape(-1, size, len(self.covariance))
        return np.asarray(gain @ self.covariance @ np.swapaxes(gain, 1, 2))
