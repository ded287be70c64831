"""Landmarks seen again after they left a window: which of them are surely back.

One that was long out of view was found again by its looks and by where the drifted camera expected
it, and the more the camera may have drifted, the more it may be another one. A wrong one alone says
where the camera is as well as a right one: so it takes several that agree on how their place is
off, unless drift is less than what each is uncertain by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.backend.smoothers.admission import LEAST_PARALLAX
from fgslam.backend.smoothers.graph_builder import parallax
from fgslam.backend.smoothers.window_parts import Landmarks
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows
from fgslam.core.geometry import (
    in_front,
    inverse_spd3,
    point_pose_jacobian,
    project,
    projection_jacobian,
    transform_to_camera,
    triangulate,
    triangulation_covariance,
)
from fgslam.core.quantiles import chi_square_quantile
from fgslam.core.sensors import CameraRig

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
            local = triangulate(sensor, measured)
            covariances = triangulation_covariance(sensor, measured, noise)
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
        alone = off.fit_beside(np.zeros(len(self), np.bool_), drift)
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
    expected[:, 2] = project(sensor, before)[:, 2]
    points = triangulate(sensor, expected)
    jacobian = projection_jacobian(sensor, points)
    step = np.linalg.solve(jacobian, (measured - expected)[:, :, None])[:, :, 0]
    return points + step, triangulation_covariance(sensor, expected, noise)


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

        As many as fit beside one of them that fits ``alone``, then those that fit beside all.
        """
        none = best = np.zeros(len(self), np.bool_)
        for row in np.flatnonzero(alone).tolist():
            of_one = np.arange(len(self)) == row
            found = self.fit_beside(of_one, drift) | of_one
            best = found if found.sum() > best.sum() else best
        for _ in range(_ROUNDS):
            if best.sum() < LEAST:
                return none
            best = self.fit_beside(best, drift)
        return best if best.sum() >= LEAST else none

    def fit_beside(self, chosen: BoolArray, drift: FloatArray) -> BoolArray:
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
