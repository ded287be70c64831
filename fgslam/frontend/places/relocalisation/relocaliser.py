"""The pose of a frame in a map without a prior: propose, refine, compare, accept or refuse."""

from __future__ import annotations

import numpy as np

from fgslam.core.estimates import LandmarkMap, Relocalisation, RelocalisationStatus
from fgslam.core.features import LandmarkAppearances, StereoFeatures
from fgslam.core.floor import Floor
from fgslam.core.sensors import CameraRig
from fgslam.frontend.places.relocalisation.known_map import (
    KnownMap,
    Tentative,
    gated,
    specific,
)
from fgslam.frontend.places.relocalisation.proposals import (
    Evidence,
    Proposals,
    apart,
    distinct,
    propose_by_samples,
)
from fgslam.frontend.places.relocalisation.refinement import PIECE_M, Refined, Refiner
from fgslam.frontend.places.relocalisation.residuals import Pairs, SeenPoints, log_uniform
from fgslam.frontend.settings import RelocalisationSettings

_NEIGHBOURS = 12  # stored views asked of the index for each feature
_REFINED = 4  # distinct best poses that are refined and compared
_ELSEWHERE_M = 0.5  # poses farther apart than this are different places
_ELSEWHERE_RAD = float(np.deg2rad(15.0))  # and so are poses turned by more than this
VIEW_SIGMA_PX = 0.3  # added to a feature's noise: from elsewhere it is found elsewhere
_MAX_DISPARITY_PX = 40.0  # of mistakes, spread evenly; the scores hardly depend on it


class Relocaliser:
    """Finds frames in a map that it has learnt."""

    def __init__(self, rig: CameraRig, floor: Floor, settings: RelocalisationSettings) -> None:
        """Knows no map yet; ``floor`` says which camera motions the map's robot makes."""
        self._rig = rig
        self._floor = floor
        self._settings = settings
        none = np.empty(0, np.int64)
        self._known = KnownMap.of(
            LandmarkMap(none, np.empty((0, 3)), np.empty((0, 3, 3))),
            LandmarkAppearances(
                none, np.empty((0, 128), np.uint8), np.empty(0), np.empty(0), np.empty((0, 3))
            ),
        )

    def __len__(self) -> int:
        """Landmarks known."""
        return len(self._known.landmarks)

    def learn(self, landmarks: LandmarkMap, appearances: LandmarkAppearances) -> None:
        """Replaces the map; landmarks without a stored view cannot be recognised: left out.

        Its arrays are not copied, and must not change until the next map is learnt. The very
        appearances of the last map keep their index: who is lost asks in every frame.
        """
        known = self._known
        index = known.index if known.views is appearances else None
        self._known = KnownMap.of(landmarks, appearances, self._settings.map_sigma_m, index)

    def locate(self, features: StereoFeatures, rng: np.random.Generator) -> Relocalisation:
        """The frame's pose, or why there is none to be believed.

        Args:
            features: of one frame, or of a short submap in its last camera's frame; positions
                outside the image count by their own covariances, and ``scale`` times the depth in
                that frame must be the feature's physical size.
            rng: draws the samples.
        """
        tentative = self.tentative(features)
        seen = SeenPoints.of(features, self._rig, VIEW_SIGMA_PX)
        landmarks = self._known.landmarks
        pairs = Pairs.of(seen, tentative.features, landmarks, tentative.landmarks)
        chance = log_uniform(self._rig, pairs.seen, _MAX_DISPARITY_PX, self._known.room)
        evidence = Evidence(self._rig, tentative, pairs, chance)
        proposals = propose_by_samples(evidence, self._floor, rng)
        refined = self._refine(features, seen, evidence, proposals)
        return accept(tentative, refined, landmarks, self._settings)

    def tentative(self, features: StereoFeatures) -> Tentative:
        """Matches of the features with landmarks anywhere in the map."""
        known = self._known
        looks = (known.views, known.owners)
        found = known.index.query(features.descriptors, _NEIGHBOURS)
        i, k = np.nonzero(found.rows >= 0)
        pairs = (i, found.rows[i, k])
        keep = np.zeros(found.rows.shape, np.bool_)
        keep[i, k] = gated(features, pairs, known.landmarks, looks, self._floor)
        return specific(found, keep, known.owners, known.landmarks)

    def _refine(
        self,
        features: StereoFeatures,
        seen: SeenPoints,
        evidence: Evidence,
        proposals: Proposals,
    ) -> list[Refined]:
        """The best distinct poses refined, that with most independent inliers first."""
        limits = _ELSEWHERE_M, _ELSEWHERE_RAD
        refiner = Refiner(
            self._rig, self._floor, self._known, features, seen, evidence, self._settings
        )
        out = refiner.refine(distinct(proposals, _REFINED, *limits))
        out.sort(key=lambda found: (-found.independent, -len(found)))
        first: list[Refined] = []
        for candidate in out:
            if all(apart(candidate.wTc[None], other.wTc, *limits)[0] for other in first):
                first.append(candidate)
        return first


LEAST_INLIERS = 8
"""Fewer independent inliers are no pose; at most four count of one piece of the map, which may be
one object."""
ENOUGH_INLIERS = 36  # independent inliers that only another hypothesis can call in question
MAX_MISFIT = 1.2  # mean squared normalised residual of fewer inliers; 1 where as modelled
_LEAST_AGREEMENT = 0.57  # of frame and map, with fewer inliers
_LEAST_COVERED = 0.5  # share of the pieces in view, or of the directions, in which something agrees
_AMBIGUOUS_SHARE = 0.5  # of the best pose's independent inliers that another one has, too
_AMBIGUOUS_OWN = 0.2  # features that only the other explains, for each that only the best explains


def accept(
    tentative: Tentative,
    refined: list[Refined],
    landmarks: LandmarkMap,
    settings: RelocalisationSettings,
) -> Relocalisation:
    """The best of the refined poses, and whether it is accepted.

    Args:
        tentative: the frame's matches by appearance.
        refined: poses of different places, that with most independent inliers first.
        landmarks: the map.
        settings: what it takes.
    """
    matched = len(np.unique(tentative.features))
    if matched < LEAST_INLIERS:
        return _nothing(
            RelocalisationStatus.TOO_FEW_MATCHES,
            len(tentative),
            f"only {matched} features look like a landmark; {LEAST_INLIERS} are needed",
        )
    if not refined:
        return _nothing(
            RelocalisationStatus.TOO_FEW_INLIERS,
            len(tentative),
            f"{matched} features match, no two agree",
        )
    best = refined[0]
    competing = [
        (other.unshared(best, landmarks.positions, PIECE_M), other)
        for other in refined[1:]
        if _competes(other, best)
    ]
    votes, second = max(competing, key=lambda pair: pair[0], default=(0, None))
    status, why = _status(best, votes, matched, settings)
    return Relocalisation(
        status=status,
        wTc=best.wTc,
        covariance=best.covariance,
        features=best.features,
        ids=landmarks.ids[best.landmarks],
        candidates=len(tentative),
        expected=len(best.expected),
        residual_px=best.residual_px,
        second=0 if second is None else len(second),
        why=why,
    )


def _status(
    best: Refined, competing: int, matched: int, settings: RelocalisationSettings
) -> tuple[RelocalisationStatus, str]:
    """Status of the best pose and the reason.

    ``competing`` is the number of independent inliers of the strongest competing hypothesis that
    the best one does not share.
    """
    n = len(best)
    sigma_m = float(np.sqrt(np.trace(best.covariance[3:, 3:])))
    sigma_deg = float(np.rad2deg(np.sqrt(np.trace(best.covariance[:3, :3]))))
    said = (
        f"{n} matches agree ({best.proposed} of {matched} tentative), {best.independent} "
        f"independent inliers, elsewhere {competing}; {len(best.expected)} landmarks expected, "
        f"{best.covered:.0%} of their places seen; known in {best.explained:.0%} of the "
        f"directions; misfit {best.misfit:.2f}; sigma {sigma_m:.3f} m {sigma_deg:.2f} deg"
    )
    if best.independent < LEAST_INLIERS:
        needed = f"{LEAST_INLIERS} independent inliers are needed"
        return RelocalisationStatus.TOO_FEW_INLIERS, f"{said}; {needed}"
    if competing >= _AMBIGUOUS_SHARE * best.independent:
        return (
            RelocalisationStatus.AMBIGUOUS,
            f"{said}; another place explains the frame nearly as well",
        )
    if _contradicted(best, matched):
        return (
            RelocalisationStatus.CONTRADICTED,
            f"{said}; too few for how they fit, or for what does not agree beside them",
        )
    if sigma_m > settings.max_sigma_m or sigma_deg > settings.max_sigma_deg:
        return RelocalisationStatus.INACCURATE, f"{said}; too uncertain"
    return RelocalisationStatus.FOUND, said


def _contradicted(pose: Refined, matched: int) -> bool:
    """True if the pose has few inliers that fit badly, or whose surroundings do not fit.

    Accidental inliers fill their gates; correct ones lie in the middle. Where the robot is
    somewhere else, most tentative matches are outliers and most landmarks expected in view are not
    seen. An object that was carried off brings inliers alone; but its former surroundings are not
    seen, and its present ones are unmapped.
    """
    if pose.independent >= ENOUGH_INLIERS:
        return False
    agreement = (2.0 * pose.proposed / max(matched, 1) + pose.covered) / 3.0
    surroundings_unmapped = max(pose.covered, pose.explained) < _LEAST_COVERED
    misfits = pose.misfit > MAX_MISFIT
    return misfits or agreement < _LEAST_AGREEMENT or surroundings_unmapped


def _competes(other: Refined, best: Refined) -> bool:
    """True if another pose may be the right one.

    Not if landmarks expected there are not seen. Nor if it explains less than half of the best
    one's features and hardly any other: the right pose would also explain what stands beside the
    objects that both places have. (Under perceptual aliasing the other place explains more than
    half, even where a third of its landmarks are missing.)
    """
    refuted = other.misfit > MAX_MISFIT or other.covered < _LEAST_COVERED
    if refuted and other.independent < ENOUGH_INLIERS:
        return False
    lost, own = best.explains_beside(other), other.explains_beside(best)
    return 2 * lost <= len(best) or own >= _AMBIGUOUS_OWN * lost


def _nothing(status: RelocalisationStatus, candidates: int, why: str) -> Relocalisation:
    none = np.empty(0, np.int64)
    return Relocalisation(
        status=status,
        wTc=np.eye(4),
        covariance=np.full((6, 6), np.nan),
        features=none,
        ids=none,
        candidates=candidates,
        expected=0,
        residual_px=float("nan"),
        second=0,
        why=why,
    )
