"""Whether the best pose is to be believed."""

from __future__ import annotations

import numpy as np

from fgslam.frontend.relocalisation.refinement import Refined
from fgslam.frontend.relocalisation.tentative import Tentative
from fgslam.map_types import Relocalisation, Verdict
from fgslam.settings.relocalisation import RelocalisationSettings
from fgslam.types import LandmarkMap


def judge(
    tentative: Tentative,
    refined: list[Refined],
    landmarks: LandmarkMap,
    settings: RelocalisationSettings,
) -> Relocalisation:
    """The best of the refined poses, and whether it is to be believed."""
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
    second = len(refined[1]) if len(refined) > 1 else 0
    verdict, why = _verdict(best, second, matched, settings)
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
    best: Refined, second: int, matched: int, settings: RelocalisationSettings
) -> tuple[Verdict, str]:
    n = len(best)
    sigma_m = float(np.sqrt(np.trace(best.covariance[3:, 3:])))
    sigma_deg = float(np.rad2deg(np.sqrt(np.trace(best.covariance[:3, :3]))))
    said = (
        f"{n} matches agree ({best.proposed} of {matched} tentative), {len(best.expected)} "
        f"landmarks expected, second-best pose {second}, sigma {sigma_m:.3f} m {sigma_deg:.2f} deg"
    )
    if n < settings.min_inliers:
        return Verdict.TOO_FEW_INLIERS, f"{said}; {settings.min_inliers} are needed"
    if second >= settings.ambiguous_share * n:
        return Verdict.AMBIGUOUS, f"{said}; another place explains the frame nearly as well"
    if sigma_m > settings.max_sigma_m or sigma_deg > settings.max_sigma_deg:
        return Verdict.INACCURATE, f"{said}; too uncertain"
    return Verdict.FOUND, said


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
