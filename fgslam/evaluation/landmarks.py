"""Landmark errors against true positions, in the estimate's world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.geometry import transform_to_world
from fgslam.core.recordings import LandmarkTruth
from fgslam.evaluation.consistency import Nees, landmark_nees


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkErrors:
    """Distances of landmarks from where they truly are.

    Attributes:
        ids: (n,) landmarks of the map whose truth is known, ascending.
        distances_m: (n,) metres.
        nees: of each, three degrees of freedom where its covariance is known.
    """

    ids: IntArray
    distances_m: FloatArray
    nees: Nees

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def rmse_m(self) -> float | None:
        """Root mean square distance; None without a landmark."""
        return float(np.sqrt(np.mean(self.distances_m**2))) if len(self) else None

    @property
    def median_m(self) -> float | None:
        """Median distance, which a few wrong identities do not spoil; None without a landmark."""
        return float(np.median(self.distances_m)) if len(self) else None


def landmark_errors(
    landmarks: LandmarkMap, truth: LandmarkTruth, eTt: FloatArray
) -> LandmarkErrors:
    """Compares the landmarks that both know.

    Args:
        landmarks: of the estimate, in its world.
        truth: true positions in the world of the ground-truth trajectory.
        eTt: (4, 4) from the truth's world to the estimate's: with the first pose aligned, as for
            the poses' NEES (:func:`fgslam.evaluation.trajectory.estimate_from_truth`). That adds
            no uncertainty where the first pose is the gauge of the estimate's world.
    """
    ids, rows, of = np.intersect1d(landmarks.ids, truth.ids, return_indices=True)
    true = transform_to_world(eTt, truth.positions[of])
    positions = landmarks.positions[rows]
    return LandmarkErrors(
        ids=ids,
        distances_m=np.linalg.norm(positions - true, axis=1),
        nees=landmark_nees(positions, landmarks.covariances[rows], true),
    )
