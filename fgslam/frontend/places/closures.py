"""A return to a mapped place: confirmed over several frames, measured, and landmarks fused.

Corridors that look alike match as well as a true return does. But the offset between map and
estimate that a true return shows stays the same from frame to frame, and is no larger than drift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import EgoMotion, LandmarkMap, Relocalisation
from fgslam.core.features import LandmarkAppearances, StereoFeatures
from fgslam.core.geometry import adjoint, congruence, inverse, se3_log
from fgslam.core.measurements import LoopClosure
from fgslam.core.store import Kept
from fgslam.frontend.features.matching import choose
from fgslam.frontend.features.settings import AppearanceSettings
from fgslam.frontend.places.sightings import SightingMemory
from fgslam.frontend.tracking.ego_motion import PoseProblem
from fgslam.frontend.tracking.resection import Resection

_AGREEMENT = 0.15, 2.0  # metres and degrees by which the offsets of two frames may differ
_WORTH = 0.03, 0.3  # metres and degrees: below both the tracker finds the old landmarks by itself
_DRIFT_M = 0.5  # drift of position that needs no way to have come about
_DRIFT_DEG = 10.0  # and of heading
_DRIFT_DEG_PER_M = 0.25  # of heading, by wheels without a gyro
_FUSED_M = 0.10  # after a closure, landmarks that look alike and lie this near become one


@dataclass(frozen=True, slots=True)
class LoopGates:
    """When a return is looked for, and what it takes to be a closure.

    Attributes:
        every: frames between searches; after a place was recognised, every frame.
        forgotten_after: frames unseen until a landmark counts as old.
        confirm: frames in a row that find the same offset.
        max_drift_share: largest drift as a share of the path since; poor wheels drift by 0.05.
        min_matches: old landmarks that must agree on the closure in the end.
        max_sigma_m: largest standard deviation of a closure's position.
        max_sigma_deg: and of its heading.
        rest: frames after a closure in which no other is looked for.
    """

    every: int = 4
    forgotten_after: int = 60
    confirm: int = 3
    max_drift_share: float = 0.08
    min_matches: int = 12
    max_sigma_m: float = 0.10
    max_sigma_deg: float = 1.0
    rest: int = 15


class Confirmation:
    """Counts frames in a row that find the same offset."""

    count: Kept[int]
    offset: Kept[FloatArray]

    def __init__(self, gates: LoopGates) -> None:
        """Has seen nothing yet."""
        self._gates = gates
        self.count = 0
        self.offset = np.eye(4)

    @property
    def begun(self) -> bool:
        """Whether a place was recognised by the last look: the next frame shall look again."""
        return self.count > 0

    def offer(self, recognised: FloatArray, estimated: FloatArray) -> bool:
        """Takes a look's result; whether enough of them agree by now.

        Args:
            recognised: (4, 4) ``wTc`` by the landmarks of the place.
            estimated: (4, 4) ``wTc`` as estimated along the way.
        """
        if self.begun and self._agrees(recognised, estimated):
            self.count += 1
        else:
            self.count = 1
        self.offset = recognised @ inverse(estimated)
        return self.count >= self._gates.confirm

    def forget(self) -> None:
        """Begins anew: a look that found nothing, or a closure."""
        self.count, self.offset = 0, np.eye(4)

    def _agrees(self, recognised: FloatArray, estimated: FloatArray) -> bool:
        """Whether the last offset leads to this pose, too."""
        expected = self.offset @ estimated
        metres, degrees = difference(expected, recognised)
        return metres <= _AGREEMENT[0] and degrees <= _AGREEMENT[1]


def difference(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses (4, 4)."""
    apart = se3_log(inverse(a) @ b)
    return (
        float(np.linalg.norm(b[:3, 3] - a[:3, 3])),
        float(np.rad2deg(np.linalg.norm(apart[:3]))),
    )


def drift_allows(
    recognised: FloatArray, estimated: FloatArray, way_m: float, gates: LoopGates
) -> bool:
    """True if the offset is worth a correction, and a drift that ``way_m`` metres allow."""
    metres, degrees = difference(estimated, recognised)
    worth = metres > _WORTH[0] or degrees > _WORTH[1]
    return worth and (
        metres <= _DRIFT_M + gates.max_drift_share * way_m
        and degrees <= _DRIFT_DEG + _DRIFT_DEG_PER_M * way_m
    )


def close_loop(
    memory: SightingMemory,
    landmarks: LandmarkMap,
    features: StereoFeatures,
    found: Relocalisation,
    partners: IntArray,
    resection: Resection,
) -> LoopClosure | None:
    """The closure that a frame's sighting of old landmarks means; None where it is too weak.

    Both frames are located by the same old landmarks, each alone, so that neither the drift between
    them nor any estimator's past has a say in what is measured. Of a map that the run began in, the
    two may see different parts: it is held still, and the earlier frame is where it was entered.

    Args:
        memory: who saw what.
        landmarks: the map.
        features: the present frame's.
        found: which of them are which old landmarks.
        partners: (n,) the identity that each feature has got since the drift, -1 for none.
        resection: locates a frame by known landmarks.
    """
    earlier = memory.best_view_of(found.ids, landmarks)
    if earlier < 0:
        return None
    seen = features.observations(found.features, found.ids, is_new=False)
    there = resection.solve(PoseProblem.of(landmarks, memory.view(earlier, found.ids, landmarks)))
    here = resection.solve(PoseProblem.of(landmarks, seen))
    if not (there.status.measured and here.status.measured):
        return None
    taken_for = partners[found.features[here.inliers]]
    kept = seen.select(here.inliers)
    # A landmark of the given map ends as no other's double: it has not been made by the drift.
    twice = (taken_for >= 0) & (taken_for != kept.ids) & ~memory.of_given(taken_for)
    return LoopClosure(
        frame=earlier,
        oTc=inverse(there.wTc) @ here.wTc,
        covariance=_relative_covariance(there, here),
        observations=kept,
        merged=np.column_stack([taken_for, kept.ids])[twice],
    )


def is_sharp(closure: LoopClosure, gates: LoopGates) -> bool:
    """Whether a closure rests on enough landmarks, and says where the frame is."""
    sigma = np.sqrt(np.diagonal(closure.covariance))
    return bool(
        len(closure.observations) >= gates.min_matches
        and sigma[3:].max() <= gates.max_sigma_m
        and np.rad2deg(sigma[:3].max()) <= gates.max_sigma_deg
    )


def _relative_covariance(there: EgoMotion, here: EgoMotion) -> FloatArray:
    """Of ``oTc`` in the tangent space at it: both poses' own, as if independent."""
    carried = adjoint(inverse(inverse(there.wTc) @ here.wTc))
    return np.asarray(here.covariance + congruence(carried, there.covariance))


def duplicates(
    landmarks: LandmarkMap,
    looks: LandmarkAppearances,
    sides: tuple[IntArray, IntArray],
    appearance: AppearanceSettings,
) -> IntArray:
    """Pairs (m, 2) of identities (that ends, that stays) near each other that look alike.

    Args:
        landmarks: the map, corrected: what is one lies in one place.
        looks: stored views of the landmarks on both sides.
        sides: (a,) identities that may end, (b,) identities that may stay; none in both.
        appearance: how alike; each must be the other's closest, clearly.
    """
    (new, new_at), (old, old_at) = (_one_view_each(looks, ids) for ids in sides)
    if not len(new) or not len(old):
        return np.empty((0, 2), np.int64)
    i, j = _near(_positions(landmarks, new), _positions(landmarks, old), _FUSED_M)
    i, j = choose(i, j, (looks.descriptors[new_at], looks.descriptors[old_at]), appearance)
    return np.column_stack([new[i], old[j]]).astype(np.int64)


def _one_view_each(looks: LandmarkAppearances, ids: IntArray) -> tuple[IntArray, IntArray]:
    """Identities with a stored view, and the row of the first one of each."""
    known, first = np.unique(looks.ids, return_index=True)
    chosen = np.isin(known, ids)
    return known[chosen], first[chosen]


def _positions(landmarks: LandmarkMap, ids: IntArray) -> FloatArray:
    return np.asarray(landmarks.positions[landmarks.rows(ids)])


def _near(a: FloatArray, b: FloatArray, within_m: float) -> tuple[IntArray, IntArray]:
    """All pairs (k,), (k,) of rows within a distance, ascending in the first."""
    found = cKDTree(b).query_ball_point(a, within_m, return_sorted=True)
    counts = np.array([len(near) for near in found])
    j = np.concatenate([np.array(near, np.int64) for near in found])
    return np.repeat(np.arange(len(a)), counts), j
