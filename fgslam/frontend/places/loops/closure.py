"""A recognised place as a measurement: where the frame stands beside an earlier one."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import EgoMotion, LandmarkMap, Relocalisation
from fgslam.core.features import StereoFeatures
from fgslam.core.geometry import adjoint, congruence, inverse
from fgslam.core.measurements import LoopClosure
from fgslam.frontend.places.loops.memory import SightingMemory
from fgslam.frontend.places.settings import LoopSettings
from fgslam.frontend.tracking.ego_motion import PoseProblem
from fgslam.frontend.tracking.resection import Resection


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


def is_sharp(closure: LoopClosure, settings: LoopSettings) -> bool:
    """Whether a closure rests on enough landmarks, and says where the frame is."""
    sigma = np.sqrt(np.diagonal(closure.covariance))
    return bool(
        len(closure.observations) >= settings.min_matches
        and sigma[3:].max() <= settings.max_sigma_m
        and np.rad2deg(sigma[:3].max()) <= settings.max_sigma_deg
    )


def _relative_covariance(there: EgoMotion, here: EgoMotion) -> FloatArray:
    """Of ``oTc`` in the tangent space at it: both poses' own, as if independent."""
    carried = adjoint(inverse(inverse(there.wTc) @ here.wTc))
    return np.asarray(here.covariance + congruence(carried, there.covariance))
