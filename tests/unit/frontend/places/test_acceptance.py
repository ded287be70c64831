"""Acceptance of a pose found without a prior: its inliers, and competing hypotheses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgslam.core.arrays import IntArray
from fgslam.core.types import LandmarkMap, RelocalisationStatus
from fgslam.frontend.places.known_map import Tentative
from fgslam.frontend.places.relocalisation import (
    ENOUGH_INLIERS,
    MAX_MISFIT,
    Refined,
    accept,
)
from fgslam.frontend.settings import RelocalisationSettings

SETTINGS = RelocalisationSettings()
# A metre apart: each is an independent inlier. The first hundred stand at one place, and so on.
PLACES = LandmarkMap(
    np.arange(300),
    np.arange(300)[:, None] * [1.0, 0.0, 0.0],
    np.tile(1e-6 * np.eye(3), (300, 1, 1)),
)


def _tentative(matched: int) -> Tentative:
    every = np.arange(matched)
    return Tentative(every, every, np.zeros(matched), np.ones(matched, np.int64))


def _pose(features: IntArray, place: int = 0, covered: float = 1.0, misfit: float = 0.6) -> Refined:
    """A pose that explains some features by landmarks of its own place."""
    return Refined(
        wTc=np.eye(4),
        covariance=1e-6 * np.eye(6),
        features=features,
        landmarks=features + 100 * place,
        residual_px=0.5,
        misfit=misfit,
        proposed=len(features),
        expected=np.arange(50),
        independent=len(features),
        covered=covered,
        explained=1.0,
    )


def _status(matched: int, *poses: Refined) -> RelocalisationStatus:
    return accept(_tentative(matched), list(poses), PLACES, SETTINGS).status


def test_few_inliers_are_accepted_where_nearly_all_matches_agree() -> None:
    """Ten of twelve features that look like landmarks, and all places in view show somecarried."""
    assert _status(12, _pose(np.arange(10))) is RelocalisationStatus.FOUND


def test_few_inliers_among_many_outliers_are_refused() -> None:
    """Twenty of a hundred fit anywhere in a building whose walls are alike."""
    assert _status(100, _pose(np.arange(20))) is RelocalisationStatus.CONTRADICTED
    assert _status(100, _pose(np.arange(ENOUGH_INLIERS))) is RelocalisationStatus.FOUND


@pytest.mark.parametrize(
    ("agreeing", "covered", "status"),
    [
        # What should be seen is hidden, yet all that is seen agrees.
        (28, 0.0, RelocalisationStatus.FOUND),
        (22, 0.0, RelocalisationStatus.CONTRADICTED),
        (22, 0.5, RelocalisationStatus.FOUND),
        (12, 1.0, RelocalisationStatus.FOUND),
        (12, 0.5, RelocalisationStatus.CONTRADICTED),
    ],
)
def test_inlier_ratio_and_landmarks_seen_are_weighed_together(
    agreeing: int, covered: float, status: RelocalisationStatus
) -> None:
    assert _status(30, _pose(np.arange(agreeing), covered=covered)) is status


def test_few_inliers_with_a_large_residual_are_refused() -> None:
    badly = _pose(np.arange(20), misfit=MAX_MISFIT + 0.1)
    assert _status(20, badly) is RelocalisationStatus.CONTRADICTED
    assert _status(20, replace(badly, misfit=MAX_MISFIT)) is RelocalisationStatus.FOUND


def test_another_place_that_explains_the_frame_as_well_makes_it_ambiguous() -> None:
    """Half of the features by either; each has some of its own."""
    best, other = _pose(np.arange(20)), _pose(np.arange(4, 22), place=1)
    assert _status(24, best, other) is RelocalisationStatus.AMBIGUOUS


@pytest.mark.parametrize("missing", [0, 1, 5, 10])
def test_an_aliased_place_with_missing_landmarks_still_makes_it_ambiguous(missing: int) -> None:
    """Which of two alike places the map knows better does not say where the robot is."""
    best, other = _pose(np.arange(20)), _pose(np.arange(missing, 20), place=1)
    assert _status(24, best, other) is RelocalisationStatus.AMBIGUOUS


def test_a_place_that_explains_less_than_half_does_not_compete() -> None:
    """Were it the right one, what stands beside the objects that both have would be explained."""
    best = _pose(np.arange(24))
    assert _status(30, best, _pose(np.arange(12, 24), place=1)) is RelocalisationStatus.AMBIGUOUS
    best = _pose(np.arange(25))
    assert _status(30, best, _pose(np.arange(13, 25), place=1)) is RelocalisationStatus.FOUND
    # Three features of its own, against thirteen that only the best explains.
    assert _status(30, best, _pose(np.arange(13, 28), place=1)) is RelocalisationStatus.AMBIGUOUS


def test_an_object_carried_off_is_refused() -> None:
    """All that looks like a landmark agrees; but it hung on a wall that is not there."""
    carried = replace(_pose(np.arange(20), covered=0.3), explained=0.3)
    assert _status(21, carried) is RelocalisationStatus.CONTRADICTED
    assert _status(21, replace(carried, explained=0.6)) is RelocalisationStatus.FOUND
    assert _status(21, replace(carried, covered=0.6)) is RelocalisationStatus.FOUND


def test_hypotheses_that_share_their_inliers_do_not_compete() -> None:
    """Two poses by the same landmarks are one, known badly; the covariance says how."""
    assert _status(24, _pose(np.arange(20)), _pose(np.arange(2, 20))) is RelocalisationStatus.FOUND


@pytest.mark.parametrize("change", [{"covered": 0.4}, {"misfit": 1.5}])
def test_a_hypothesis_that_fits_badly_does_not_compete(change: dict[str, float]) -> None:
    other = _pose(np.arange(2, 22), place=1)
    assert _status(24, _pose(np.arange(20)), other) is RelocalisationStatus.AMBIGUOUS
    refuted = replace(other, **change)  # type: ignore[arg-type]
    assert _status(24, _pose(np.arange(20)), refuted) is RelocalisationStatus.FOUND
