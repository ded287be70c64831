"""The homing vector from the features of two images, near or far apart.

The matches decide where many of them agree. Where they do not, or barely, their best hypotheses are
looked at again with all candidate matches (:mod:`.candidates`): refined on them, scored by them,
and answered if the score is beyond what views reach that share nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.homing import BearingMatches, OmniFeatures, Refusal, RefusalReason, TwoViewVector
from fgslam.core.planar import wrap
from fgslam.frontend.features.settings import OmniMatchingSettings
from fgslam.frontend.homing.candidates import (
    BLOCK_FULL,
    Candidates,
    GuidedScore,
    candidate_matches,
)
from fgslam.frontend.homing.homing_vector import INLIER_SIGMAS, LEAST_PARALLAX, HomingSearch
from fgslam.frontend.homing.matching import match_features, planar_distances
from fgslam.frontend.homing.refinement import HomingRefinement, Refined, spread_over
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.homing.two_view_geometry import EpipolarTest

_CLEAR_SUPPORT = 50  # independent inliers of an answer that needs no second look
_CLEAR_SIGMA = np.deg2rad(0.5)  # of its direction: beyond, the matches leave a valley
_HYPOTHESES = 80  # that are scored again
_REFINED = 24  # of them are refined
_WIDENED = 2.0  # times as far a candidate may lie from a hypothesis that is not refined

_LEAST_SCORE = 35.0
_LEAST_LEAD, _LEAST_LEAD_PART = 7.0, 0.09
"""Of the score over any different solution's, and as part of it. Scores grow with how alike places
are to each other, and so do their differences. Among the 120 pairs of ``omni_home`` the largest
lead of a wrong solution is 6, with a score of 35; in rendered rooms that hold the same furniture
seven of ten wrong ones have less than 0.08 of scores up to 194."""


def vector_between(
    present: OmniFeatures,
    target: OmniFeatures,
    matching: OmniMatchingSettings,
    settings: HomingVectorSettings,
    rng: np.random.Generator,
) -> tuple[TwoViewVector | Refusal, BearingMatches]:
    """The homing vector from one image's place to another's, and the tentative matches.

    Args:
        present: features of the image where the robot is.
        target: of the one where it is to go.
        matching: of features.
        settings: of the search, and when it refuses.
        rng: chooses RANSAC's samples.
    """
    distances = planar_distances(present.sift, target.sift, matching)
    matches = match_features(present, target, matching, distances)
    search = HomingSearch(matches, settings, rng)
    answer = search.answer()
    if not settings.second_look or _is_final(answer, search):
        return answer, matches
    candidates = candidate_matches(present.sift, target.sift, distances)
    hypotheses = search.different(_HYPOTHESES)
    if len(candidates) < settings.min_inliers or not len(hypotheses):
        return answer, matches
    return SecondLook(candidates, settings).answer(hypotheses), candidates.matches


def pair_generator(seed: int, a: int, b: int) -> np.random.Generator:
    """What RANSAC draws from for the pair of images (a, b), whichever process and order."""
    return np.random.default_rng((seed, a, b))


def _is_final(answer: TwoViewVector | Refusal, search: HomingSearch) -> bool:
    if isinstance(answer, Refusal):
        return answer.reason in (RefusalReason.AT_TARGET, RefusalReason.TOO_FEW_MATCHES)
    clear = search.independent_inliers(answer.inliers) >= _CLEAR_SUPPORT
    return clear and search.direction_sigma < _CLEAR_SIGMA


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """A refined hypothesis, its score, and the candidates (k,) that it is made of."""

    refined: Refined
    score: float
    rows: IntArray


class SecondLook:
    """All candidate matches of two views, against hypotheses of their homing vector."""

    def __init__(self, candidates: Candidates, settings: HomingVectorSettings) -> None:
        """Prepares test, refinement and score."""
        self._settings = settings
        self._count = len(candidates)
        tilt = np.deg2rad(settings.tilt_sigma_deg)
        self._test = EpipolarTest.of(candidates.matches, tilt)
        self._score = GuidedScore(candidates)
        self._refinement = HomingRefinement(
            candidates.matches,
            (tilt, settings.height_sigma),
            INLIER_SIGMAS,
            LEAST_PARALLAX,
            candidates.right,
        )

    def answer(self, hypotheses: FloatArray) -> TwoViewVector | Refusal:
        """The best of hypotheses (c, 2), direction and rotation, or why none is the answer."""
        best, *others = self._solutions(hypotheses)
        rivals = [other for other in others if self._differ(best, other)]
        covariance = self._covariance(best, others)
        refusal = self._refusal(best, rivals[0].score if rivals else 0.0, covariance)
        if refusal is not None:
            return refusal
        theta, psi = (float(v) for v in best.refined.parameters[:2])
        floor = np.deg2rad([self._settings.direction_floor_deg, self._settings.rotation_floor_deg])
        inliers = np.zeros(self._count, np.bool_)
        inliers[best.rows] = True
        return TwoViewVector(
            theta,
            psi,
            covariance + np.diag(floor**2),
            inliers,
            len(rivals[0].rows) if rivals else 0,
        )

    def _solutions(self, hypotheses: FloatArray) -> list[_Solution]:
        """The most promising ones, refined, the best first."""
        promise = np.array(self._promise(hypotheses))
        chosen = hypotheses[np.argsort(-promise, kind="stable")[:_REFINED]]
        found = [
            _Solution(refined, *self._scored(refined))
            for refined in self._refinement.refine(chosen[:, 0], chosen[:, 1])
        ]
        return sorted(found, key=lambda s: -s.score)

    def _promise(self, hypotheses: FloatArray) -> list[float]:
        """(c,) scores of hypotheses that are a few degrees off."""
        theta, psi = hypotheses.T
        good, residuals = self._test.inliers(theta, psi, _WIDENED * INLIER_SIGMAS, LEAST_PARALLAX)
        residuals = np.where(good, residuals / _WIDENED, np.nan)
        return [
            self._score.of(theta[k], psi[k], residuals[:, k], INLIER_SIGMAS)[0]
            for k in range(len(hypotheses))
        ]

    def _scored(self, refined: Refined) -> tuple[float, IntArray]:
        residuals = np.where(refined.inliers, refined.residuals, np.nan)
        theta, psi = refined.parameters[:2]
        return self._score.of(theta, psi, residuals, INLIER_SIGMAS)

    def _differ(self, one: _Solution, other: _Solution) -> bool:
        apart = np.abs(wrap(one.refined.parameters[:2] - other.refined.parameters[:2]))
        return bool(np.max(apart) > np.deg2rad(self._settings.rival_angle_deg))

    def _covariance(self, best: _Solution, others: list[_Solution]) -> FloatArray:
        """(2, 2) of the best solution, widened by those near it with nearly as much evidence.

        What less than a block's evidence tells apart is undecided: its full evidence is the unit.
        """
        near = [best, *(other for other in others if not self._differ(best, other))]
        scores = np.array([solution.score for solution in near])
        return spread_over([solution.refined for solution in near], scores, BLOCK_FULL)

    def _refusal(self, best: _Solution, rival: float, covariance: FloatArray) -> Refusal | None:
        sigma = float(np.rad2deg(np.sqrt(covariance[0, 0])))
        support = len(best.rows)
        if support < self._settings.min_inliers or best.score < _LEAST_SCORE:
            reason = RefusalReason.TOO_FEW_INLIERS
            text = f"{support} inliers, evidence of {best.score:.0f}, of {_LEAST_SCORE:.0f} needed"
        elif best.score - rival < max(_LEAST_LEAD, _LEAST_LEAD_PART * best.score):
            reason = RefusalReason.AMBIGUOUS
            text = f"evidence of {best.score:.0f}, {rival:.0f} for a different solution"
        elif sigma > self._settings.max_direction_sigma_deg:
            reason = RefusalReason.UNCERTAIN
            text = f"direction is uncertain by {sigma:.1f} deg"
        else:
            return None
        return Refusal(reason, text)
