"""Whether the best pose is to be believed."""

from __future__ import annotations

import numpy as np

from fgslam.core.estimates import LandmarkMap, Relocalisation, Verdict
from fgslam.frontend.places.relocalisation.refinement import PIECE_M, Refined
from fgslam.frontend.places.relocalisation.settings import RelocalisationSettings
from fgslam.frontend.places.relocalisation.tentative import Tentative

_ENOUGH = 36  # independent inliers that only another hypothesis can call in question
_MAX_MISFIT = 1.2  # mean squared normalised residual of fewer inliers; 1 where as modelled
_LEAST_AGREEMENT = 0.57  # of frame and map, with fewer inliers
_LEAST_COVERED = 0.5  # share of the pieces in view, or of the directions, in which something agrees
_AMBIGUOUS_SHARE = 0.5  # of the best pose's independent inliers that another one has, too
_AMBIGUOUS_OWN = 0.2  # features that only the other explains, for each that only the best explains


def judge(
    tentative: Tentative,
    refined: list[Refined],
    landmarks: LandmarkMap,
    settings: RelocalisationSettings,
) -> Relocalisation:
    """The best of the refined poses, and whether it is to be believed.

    Args:
        tentative: the frame's matches by appearance.
        refined: poses that lie apart, that with most witnesses first.
        landmarks: the map.
        settings: what it takes.
    """
    matched = len(np.unique(tentative.features))
    if matched < settings.min_inliers:
        return _nothing(
            Verdict.TOO_FEW_MATCHES,
            len(tentative),
            f"only {matched} features look like a landmark; {settings.min_inliers} are needed",
        )
    if not refined:
        return _nothing(
            Verdict.TOO_FEW_INLIERS, len(tentative), f"{matched} features match, no two agree"
        )
    best = refined[0]
    rivals = [
        (other.unshared(best, landmarks.positions, PIECE_M), other)
        for other in refined[1:]
        if _rivals(other, best, settings)
    ]
    votes, rival = max(rivals, key=lambda pair: pair[0], default=(0, None))
    second = 0 if rival is None else len(rival)
    verdict, why = _verdict(best, votes, matched, settings)
    return Relocalisation(
        verdict=verdict,
        wTc=best.wTc,
        covariance=best.covariance,
        features=best.features,
        ids=landmarks.ids[best.landmarks],
        candidates=len(tentative),
        expected=len(best.expected),
        residual_px=best.residual_px,
        second=second,
        why=why,
    )


def _verdict(
    best: Refined, rival: int, matched: int, settings: RelocalisationSettings
) -> tuple[Verdict, str]:
    n = len(best)
    sigma_m = float(np.sqrt(np.trace(best.covariance[3:, 3:])))
    sigma_deg = float(np.rad2deg(np.sqrt(np.trace(best.covariance[:3, :3]))))
    said = (
        f"{n} matches agree ({best.proposed} of {matched} tentative), {best.witnesses} witnesses, "
        f"elsewhere {rival}; {len(best.expected)} landmarks expected, {best.covered:.0%} of their "
        f"places seen; known in {best.explained:.0%} of the directions; "
        f"misfit {best.misfit:.2f}; sigma {sigma_m:.3f} m {sigma_deg:.2f} deg"
    )
    if best.witnesses < settings.min_inliers:
        return Verdict.TOO_FEW_INLIERS, f"{said}; {settings.min_inliers} witnesses are needed"
    if rival >= _AMBIGUOUS_SHARE * best.witnesses:
        return Verdict.AMBIGUOUS, f"{said}; another place explains the frame nearly as well"
    if _contradicted(best, matched, settings):
        return (
            Verdict.CONTRADICTED,
            f"{said}; too few for how they fit, or for what does not agree beside them",
        )
    if sigma_m > settings.max_sigma_m or sigma_deg > settings.max_sigma_deg:
        return Verdict.INACCURATE, f"{said}; too uncertain"
    return Verdict.FOUND, said


def _contradicted(pose: Refined, matched: int, settings: RelocalisationSettings) -> bool:
    """Whether few things agree, and those badly, or beside much that does not.

    Matches that agree by accident fill their gates; right ones lie in the middle. And where the
    robot is somewhere else, most of what looks like a landmark disagrees, and most of what should
    be seen is missing. Of a thing that was carried off, all that looks like a landmark agrees; but
    what surrounded it is missing, and what surrounds it is unknown.
    """
    if pose.witnesses >= _ENOUGH:
        return False
    agreement = (2.0 * pose.proposed / max(matched, 1) + pose.covered) / 3.0
    amid_strangers = max(pose.covered, pose.explained) < _LEAST_COVERED
    misfits = pose.misfit > _MAX_MISFIT
    return misfits or agreement < _LEAST_AGREEMENT or amid_strangers


def _rivals(other: Refined, best: Refined, settings: RelocalisationSettings) -> bool:
    """Whether another pose may be the right one.

    Not if what should be seen there is not. Nor if it explains less than half of what the best
    explains, and hardly anything beside it: were it the right one, it would explain what stands
    beside the things that both places have. (A twin explains more than half, even where a third of
    its landmarks are missing.)
    """
    refuted = other.misfit > _MAX_MISFIT or other.covered < _LEAST_COVERED
    if refuted and other.witnesses < _ENOUGH:
        return False
    lost, own = best.explains_beside(other), other.explains_beside(best)
    return 2 * lost <= len(best) or own >= _AMBIGUOUS_OWN * lost


def _nothing(verdict: Verdict, candidates: int, why: str) -> Relocalisation:
    none = np.empty(0, np.int64)
    return Relocalisation(
        verdict=verdict,
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
