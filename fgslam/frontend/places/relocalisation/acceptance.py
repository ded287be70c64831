"""Acceptance of a relocalised pose: the best hypothesis, or the reason to refuse it."""

from __future__ import annotations

import numpy as np

from fgslam.core.estimates import LandmarkMap, Relocalisation, RelocalisationStatus
from fgslam.frontend.places.relocalisation.refinement import PIECE_M, Refined
from fgslam.frontend.places.relocalisation.settings import RelocalisationSettings
from fgslam.frontend.places.relocalisation.tentative import Tentative

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
    if matched < settings.min_inliers:
        return _nothing(
            RelocalisationStatus.TOO_FEW_MATCHES,
            len(tentative),
            f"only {matched} features look like a landmark; {settings.min_inliers} are needed",
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
    if best.independent < settings.min_inliers:
        needed = f"{settings.min_inliers} independent inliers are needed"
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
