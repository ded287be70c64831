"""The pose of a frame in a map without a prior: propose, refine, compare, judge."""

from __future__ import annotations

import numpy as np

from fgslam.core.errors import ConfigError
from fgslam.core.estimates import LandmarkMap, Relocalisation
from fgslam.core.features import LandmarkAppearances, StereoFeatures
from fgslam.core.floor import Floor
from fgslam.core.sensors import CameraRig
from fgslam.frontend.places.relocalisation import hough, ransac
from fgslam.frontend.places.relocalisation.acceptance import accept
from fgslam.frontend.places.relocalisation.known_map import KnownMap
from fgslam.frontend.places.relocalisation.proposals import Evidence, Proposals, apart, distinct
from fgslam.frontend.places.relocalisation.refinement import Refined, Refiner
from fgslam.frontend.places.relocalisation.residuals import Pairs, SeenPoints, log_uniform
from fgslam.frontend.places.relocalisation.settings import RelocalisationSettings
from fgslam.frontend.places.relocalisation.tentative import Tentative, gated, specific, unspecific

_NEIGHBOURS = 12  # stored views asked of the index for each feature
_REFINED = 4  # distinct best poses that are refined and compared
_ELSEWHERE_M = 0.5  # poses farther apart than this are different places
_ELSEWHERE_RAD = float(np.deg2rad(15.0))  # and so are poses turned by more than this
_MAX_DISPARITY_PX = 40.0  # of mistakes, spread evenly; the scores hardly depend on it


class Relocaliser:
    """Finds frames in a map that it has learnt."""

    def __init__(self, rig: CameraRig, floor: Floor, settings: RelocalisationSettings) -> None:
        """Knows no map yet; ``floor`` says which camera motions the map's robot makes."""
        if settings.method == "hough" and floor.rigid_dof != 3:
            raise ConfigError(
                "frontend.relocalisation.method hough votes on a level floor alone; choose ransac, "
                "or set frontend.ego_motion.dof to 3"
            )
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

        Its arrays are not copied, and must not change until the next map is learnt.
        """
        self._known = KnownMap.of(landmarks, appearances, self._settings.map_sigma_m)

    def locate(self, features: StereoFeatures, rng: np.random.Generator) -> Relocalisation:
        """The frame's pose, or why there is none to be believed.

        Args:
            features: of one frame, or of a short submap in its last camera's frame; positions
                outside the image count by their own covariances, and ``scale`` times the depth in
                that frame must be the feature's physical size.
            rng: draws the samples.
        """
        tentative = self.tentative(features)
        seen = SeenPoints.of(features, self._rig, self._settings.view_sigma_px)
        evidence = self._evidence(seen, tentative)
        if self._settings.method == "hough":
            proposals = hough.propose(evidence, self._floor)
        else:
            proposals = ransac.propose(evidence, self._floor, self._settings, rng)
        refined = self._refine(features, seen, evidence, proposals)
        return accept(tentative, refined, self._known.landmarks, self._settings)

    def tentative(self, features: StereoFeatures) -> Tentative:
        """Matches of the features with landmarks anywhere in the map."""
        known = self._known
        looks = (known.views, known.owners)
        if not self._settings.descriptors:
            return unspecific(features, known.landmarks, looks, self._floor)
        found = known.index.query(features.descriptors, _NEIGHBOURS)
        i, k = np.nonzero(found.rows >= 0)
        pairs = (i, found.rows[i, k])
        keep = np.zeros(found.rows.shape, np.bool_)
        keep[i, k] = gated(features, pairs, known.landmarks, looks, self._floor)
        return specific(found, keep, known.owners, known.landmarks)

    def _evidence(self, seen: SeenPoints, tentative: Tentative) -> Evidence:
        landmarks = self._known.landmarks
        pairs = Pairs.of(seen, tentative.features, landmarks, tentative.landmarks)
        chance = log_uniform(self._rig, pairs.seen, _MAX_DISPARITY_PX, self._known.room)
        return Evidence(self._rig, tentative, pairs, chance)

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
