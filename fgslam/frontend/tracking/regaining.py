"""The pose of a frame whose prediction failed: a sudden turn, a gap, a blurred or dark image.

It failed where too few match around it, or most of what matches contradicts the pose, or few of
the frame's features agree with it.

What was in view lately is looked for by its descriptor alone, wherever the prediction expects it.
The pose that most of it agrees with is believed where chance does not explain so many agreeing
matches (a-contrario test of Moisan and Stival, IJCV 57(3), 2004), and where no other pose has half
as many. Parts of the map that lie beside each other by a guess are looked through one by one: in
two of them a frame has two poses, and both are right.
"""

from __future__ import annotations

import math

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import EgoMotion, LandmarkMap, Prediction
from fgslam.core.features import LandmarkAppearances, StereoFeatures
from fgslam.core.sensors import CameraRig
from fgslam.frontend.features.matching import mutual_nearest
from fgslam.frontend.tracking.database import LandmarkDatabase
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem
from fgslam.frontend.tracking.map_parts import MapParts
from fgslam.frontend.tracking.resection import Resection, sample_size

LATELY = 10  # frames before the last sighting whose landmarks are looked for
_AT_LAST = 0  # likewise where that fails: among few landmarks few others look like the right one
FALSE_POSES = 1e-6  # poses by chance that are allowed in a frame


class Regainer:
    """Finds a frame by landmarks seen lately, without a prediction."""

    def __init__(
        self, rig: CameraRig, database: LandmarkDatabase, solver: EgoMotionSolver, parts: MapParts
    ) -> None:
        """Takes the tracker's own parts."""
        self._database = database
        self._solver = solver
        self._parts = parts
        self._resection = Resection(solver)
        self._by_chance = math.pi * solver.farthest**2 / (rig.width * rig.height)

    def find(self, landmarks: LandmarkMap, features: StereoFeatures) -> Prediction | None:
        """Pose and covariance; None where none is to be believed. The same input, the same bits."""
        for frames in (LATELY, _AT_LAST):
            found = self._found_by(frames, landmarks, features)
            if found is not None:
                return Prediction(found.wTc, found.covariance)
        return None

    def _found_by(
        self, frames: int, landmarks: LandmarkMap, features: StereoFeatures
    ) -> EgoMotion | None:
        """The frame by what the last frames described; None if it is not to be believed."""
        recent = np.intersect1d(self._database.described_lately(frames), landmarks.ids)
        looks = self._database.appearances(recent)
        latest = np.flatnonzero(np.diff(looks.ids, append=-1))
        part = self._parts.of(looks.ids[latest])
        within = [
            self._among(latest[part == one], looks, landmarks, features)
            for one in np.unique(part).tolist()
        ]
        found = [one for one in within if one is not None]
        return max(found, key=lambda one: int(one.inliers.sum()), default=None)

    def _among(
        self,
        rows: IntArray,
        looks: LandmarkAppearances,
        landmarks: LandmarkMap,
        features: StereoFeatures,
    ) -> EgoMotion | None:
        """The frame by some landmarks, given by rows of their looks; None if not to be believed."""
        seen = features.whole
        i, j = mutual_nearest(seen.descriptors, looks.descriptors[rows])
        observed = seen.observations(i, looks.ids[rows[j]], is_new=False)
        problem = PoseProblem.of(landmarks, observed)
        found = self._resection.solve(problem)
        if not found.status.measured or not self._certain(found, problem):
            return None
        return found

    def _certain(self, found: EgoMotion, problem: PoseProblem) -> bool:
        agreeing = places(problem.measurement[found.inliers, :2], self._solver.farthest)
        size = sample_size(self._solver.floor)
        if log_false_poses(len(problem), agreeing, size, self._by_chance) > math.log(FALSE_POSES):
            return False
        return 2 * self._resection.rival(problem, found) <= int(found.inliers.sum())


def places(pixels: FloatArray, side: float) -> int:
    """How many places of the image, squares of this side, the pixels (n, 2) lie in."""
    return len(np.unique(np.floor(pixels / side), axis=0))


def log_false_poses(matches: int, agreeing: int, sample: int, by_chance: float) -> float:
    """Logarithm of the number of poses that as many matches would agree with by chance.

    Args:
        matches: m of the frame.
        agreeing: k of them with a pose.
        sample: s that fix a pose, and agree for nothing.
        by_chance: p, probability that a wrong match agrees.

    ``(m - s) C(m, k) C(k, s) p^(k - s)``, equation 11 of Moisan and Stival.
    """
    if agreeing <= sample:
        return math.inf
    return (
        math.log(matches - sample)
        + _log_choose(matches, agreeing)
        + _log_choose(agreeing, sample)
        + (agreeing - sample) * math.log(by_chance)
    )


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
