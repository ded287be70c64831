"""The joint filter with right-invariant errors: it learns nothing of what no landmark can show.

Barrau and Bonnabel (2015), Zhang et al. (2017). Where the whole world turns and moves, pose and
landmarks alike, nothing is measured. The errors of the `ekf` describe that motion by the estimate,
which each correction moves, so that it gains information that was never there. Here all errors
are those of one motion on the left,

    wRc <- Exp(t) wRc,    p <- Exp(t) p + V(t) e_p,    l_i <- Exp(t) l_i + V(t) e_i,

with t = wRc w of the step (w, v, d_i) in the `ekf`'s errors, e_p = wRc v - t x p, e_i = d_i - t x
l_i and V the left Jacobian. With V(t) [t]x = Exp(t) - I this is

    wTc <- wTc Exp(w, v),    l_i <- l_i + V(t) d_i                          (_retracted)

and the covariance stays as it is in those errors, so that the `ekf`'s, in which all else is
written, change at the state moved to (primes) by

    (w, v) <- Ad(wTc'^-1 wTc) (w, v),    d_i <- d_i + [l_i - l_i']x wRc w   (_change)

Derivation: docs/derivations/filters.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from fgslam.backend.filters.ekf import FRONT, FullEkf, Matches
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import adjoint, congruence, inverse, se3_exp, skew, so3_left_jacobian


class InvariantEkf(FullEkf):
    """Estimator of kind ``invariant_ekf``, on :class:`fgslam.backend.protocol.Estimator`."""

    kind: ClassVar[str] = "invariant_ekf"

    def _retracted(
        self, wTc: FloatArray, positions: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Pose and landmarks moved along one motion of all."""
        turned = so3_left_jacobian(wTc[:3, :3] @ step[:3])
        moved = wTc @ se3_exp(step[:FRONT])
        if self._floor.rigid_dof < 6:
            moved = self._floor.constrain(moved)
        by, fixed = step[FRONT:].reshape(-1, 3), self._ids < 0  # nuisance parameters do not turn
        return moved, positions + np.where(fixed[:, None], by, by @ turned.T)

    def _carry_errors(self, wTc: FloatArray, moved: FloatArray, positions: FloatArray) -> None:
        """The covariance in the errors of the state moved to."""
        of_pose, by_turn = self._change(wTc, self._positions, moved, positions)
        by_turn = by_turn.reshape(-1, 3)
        front = self._covariance.front()
        gained, half = np.zeros((2, len(front), 3))
        gained[FRONT:] = -by_turn
        half[FRONT:] = front[FRONT:, :3] + 0.5 * by_turn @ front[:3, :3]
        self._covariance.subtract(gained, half)
        front[FRONT:] = (front[FRONT:] + by_turn @ front[:3]) @ of_pose.T
        front[:FRONT] = congruence(of_pose, front[:FRONT])
        self._covariance.set_front(front)

    def _by_errors_before(
        self, matches: Matches, step: FloatArray, moved: FloatArray, positions: FloatArray
    ) -> Matches:
        """Matches linearised where a step (n,) leads, by the step; half way stands for the mean."""
        half_way = self._retracted(self._wTc, self._positions, 0.5 * step)
        of_pose, by_turn = self._change(*half_way, moved, positions)
        by_pose = matches.by_pose @ of_pose
        by_pose[:, :, :3] += matches.by_landmark @ by_turn[matches.blocks]
        turned = half_way[0][:3, :3] @ self._wTc[:3, :3].T
        return replace(matches, by_pose=by_pose, by_landmark=matches.by_landmark @ turned)

    def _change(
        self, wTc: FloatArray, points: FloatArray, moved: FloatArray, positions: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The pose's errors (6, 6) by those before, and landmarks' (n, 3, 3) by its turn."""
        of_pose = adjoint(inverse(moved) @ wTc)
        if self._floor.rigid_dof < 6:
            basis = self._floor.basis(moved)
            of_pose = basis @ (basis.T @ of_pose)
        apart = np.where((self._ids < 0)[:, None], 0.0, points - positions)
        return of_pose, skew(apart) @ wTc[:3, :3]
