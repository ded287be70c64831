"""Whether much of what a frame shows moves rigidly, but otherwise than its pose says.

Something large that passes makes two rigid motions of one scene, and the pose follows whichever
matches more. So the features that the map does not explain are matched with those of the frame
before, and the motion that most of them agree with, against that of the pose, is believed where
chance does not explain it (a-contrario test of Moisan and Stival, IJCV 57(3), 2004).
docs/derivations/camera_faults.md.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import ByteArray, FloatArray, IntArray, Rows
from fgslam.core.estimates import EgoMotion, EgoMotionStatus
from fgslam.core.features import StereoFeatures
from fgslam.core.geometry import rotate_covariances, transform_to_world
from fgslam.core.sensors import CameraRig
from fgslam.core.store import Kept
from fgslam.frontend.features.matching import mutual_nearest
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem
from fgslam.frontend.tracking.regaining import FALSE_POSES, log_false_poses, places
from fgslam.frontend.tracking.resection import Resection, sample_size

_FEWEST = 15  # matches that move otherwise; chance is judged besides
_SHARE = 0.1  # of those that the pose follows
_FRAMES, _WINDOW = 3, 10  # so many of so many described frames: no wrong match, no blurred frame
_LARGEST = 300  # features of each frame that are matched: the time is that of their square


@dataclass(frozen=True, slots=True, eq=False)
class _Unexplained(Rows):
    """Features (n,) of a frame that no landmark known before it explains.

    ``ids`` are the landmarks that they began, -1 for none; ``positions`` (n, 3) and
    ``covariances`` (n, 3, 3) in the world, by that frame's pose, metres.
    """

    ids: IntArray
    descriptors: ByteArray
    positions: FloatArray
    covariances: FloatArray

    @staticmethod
    def none() -> _Unexplained:
        return _Unexplained(
            np.empty(0, np.int64),
            np.empty((0, 128), np.uint8),
            np.empty((0, 3)),
            np.empty((0, 3, 3)),
        )

    @staticmethod
    def of(features: StereoFeatures, ids: IntArray, wTc: FloatArray) -> _Unexplained:
        return _Unexplained(
            ids,
            features.descriptors,
            transform_to_world(wTc, features.position),
            rotate_covariances(wTc[:3, :3], features.position_covariance),
        )


class OtherMotion:
    """Remembers the frames of a drive that show a second rigid motion."""

    _before: Kept[_Unexplained]
    _latest: Kept[deque[tuple[int, float]]]
    _doubted: Kept[dict[int, float]]

    def __init__(self, rig: CameraRig, solver: EgoMotionSolver) -> None:
        """Nothing seen yet."""
        self._solver = solver
        self._resection = Resection(solver)
        self._by_chance = math.pi * solver.farthest**2 / (rig.width * rig.height)
        self._before = _Unexplained.none()
        self._latest = deque(maxlen=_WINDOW)
        self._doubted = {}

    def look(
        self,
        index: int,
        features: StereoFeatures,
        known: tuple[IntArray, IntArray],
        tracking: EgoMotion,
        wTc: FloatArray,
    ) -> None:
        """Takes in a frame whose features were found.

        Args:
            index: its number.
            features: (n,) those found in every image.
            known: (n,) the landmark that each is taken for, -1 for none, and the identities of
                those among them that were known before.
            tracking: its pose, as it was tracked.
            wTc: (4, 4) the same after the update, from which the next frame is told.
        """
        partners, old = known
        left = np.flatnonzero(~np.isin(partners, old))
        left = left[np.argsort(-features.scale[left], kind="stable")[:_LARGEST]]
        share = self._share(features, left, old, tracking) if tracking.status.measured else 0.0
        self._latest.append((index, share))
        seen = [one for one in self._latest if one[1] > _SHARE]
        if len(seen) >= _FRAMES:
            self._doubted.update(seen)
        followed = tracking.status.measured or tracking.status is EgoMotionStatus.FIRST
        self._before = _Unexplained.none()
        if followed:
            self._before = _Unexplained.of(features.select(left), partners[left], wTc)

    def remarks(self) -> tuple[str, ...]:
        """What is to be said of the frames with two motions."""
        if not self._doubted:
            return ()
        frames, most = sorted(self._doubted), max(self._doubted.values())
        # The pose follows the fewer matches only where odometry, or the map, says so.
        or_odometry = (
            ", or the odometry is wrong (its unit or clock, the camera's place on the robot)"
            if most > 1.0
            else ""
        )
        return (
            f"in {len(frames)} frames, from {frames[0]} to {frames[-1]}, something else moves "
            f"rigidly, with up to {100.0 * most:.0f} % as many matches as the pose follows: "
            f"something large passes{or_odometry}. Without odometry that tells which is which the "
            "pose is in doubt where that fills more of the view than the scene, for it may follow "
            "what passes (leave these frames out: --start, --stop)",
        )

    def _share(
        self, features: StereoFeatures, left: IntArray, old: IntArray, tracking: EgoMotion
    ) -> float:
        """Matches that agree with another motion over those of the pose; zero where none is."""
        before = self._before.select(~np.isin(self._before.ids, old))
        if min(len(left), len(before)) < _FEWEST:
            return 0.0
        i, j = mutual_nearest(features.descriptors[left], before.descriptors)
        problem = PoseProblem(
            before.positions[j],
            before.covariances[j],
            features.measurement[left[i]],
            features.measurement_covariance[left[i]],
        )
        against = self._solver.image_residuals(tracking.wTc, problem) > self._solver.farthest
        if against.sum() < _FEWEST:
            return 0.0
        rest = problem.select(against)
        found = self._resection.solve(rest)
        agreeing = int(found.inliers.sum()) if found.status.measured else 0
        if agreeing < _FEWEST or not self._certain(found, rest, len(problem)):
            return 0.0
        return agreeing / max(int(tracking.inliers.sum()), 1)

    def _certain(self, found: EgoMotion, problem: PoseProblem, matches: int) -> bool:
        agreeing = places(problem.measurement[found.inliers, :2], self._solver.farthest)
        size = sample_size(self._solver.floor)
        return log_false_poses(matches, agreeing, size, self._by_chance) <= math.log(FALSE_POSES)

    # ----------------------------------------------------------------------------------------
