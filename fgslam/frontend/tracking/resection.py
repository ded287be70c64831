"""Pose of a frame from landmarks whose identity is known, without any prior.

Three matches (two on a floor) place the camera: the triangulated points are laid onto the
landmarks. The pose that most matches agree with starts the least squares.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import EgoMotion, EgoMotionStatus, Prediction
from fgslam.core.geometry import triangulate
from fgslam.frontend.places.relocalisation.alignment import align, sample_size
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem, unmeasured

_SAMPLES = 200  # at half the matches wrong, no good triple among them once in 10^11
_START_SIGMA_RAD = 0.5  # of the pose that starts the least squares: says nothing
_START_SIGMA_M = 5.0
_NEAR = 3.0  # outlier bounds within which a match agrees with a pose from three others


class Resection:
    """Locates a frame by known landmarks."""

    def __init__(self, solver: EgoMotionSolver) -> None:
        """The solver's floor says which poses are possible."""
        self._solver = solver

    def solve(self, problem: PoseProblem) -> EgoMotion:
        """Pose, covariance and inliers as :meth:`EgoMotionSolver.solve`, status RELOCALISED.

        The same problem gives the same bits: its samples are always drawn alike.
        """
        start = self._start(problem)
        if start is None:
            nowhere = Prediction(np.eye(4), np.zeros((6, 6)))
            lost = unmeasured(nowhere, EgoMotionStatus.TOO_FEW_MATCHES)
            size = len(problem)
            return dataclasses.replace(
                lost, inliers=np.zeros(size, np.bool_), residuals=np.full(size, np.inf)
            )
        sigma = np.repeat([_START_SIGMA_RAD, _START_SIGMA_M], 3)
        found = self._solver.solve(Prediction(start, np.diag(sigma**2)), problem)
        if not found.status.measured:
            return found
        return dataclasses.replace(found, status=EgoMotionStatus.RELOCALISED)

    def _start(self, problem: PoseProblem) -> FloatArray | None:
        """The pose from a few matches that most others agree with; None of too few."""
        floor = self._solver.floor
        needed = sample_size(floor)
        if len(problem) < needed:
            return None
        rng = np.random.default_rng(len(problem))
        chosen = np.array([rng.choice(len(problem), needed, False) for _ in range(_SAMPLES)])
        local = triangulate(self._solver.sensor, problem.measurement)
        poses = align(local[chosen], problem.points[chosen], floor)
        agreeing = [self._agreeing(wTc, problem) for wTc in poses]
        return np.asarray(poses[int(np.argmax(agreeing))])

    def _agreeing(self, wTc: FloatArray, problem: PoseProblem) -> int:
        residuals = self._solver.image_residuals(wTc, problem)
        return int((residuals <= _NEAR * self._solver.farthest).sum())
