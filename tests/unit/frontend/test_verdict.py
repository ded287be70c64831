"""Whether a pose found without a prior is believed: by what agrees there and by its rivals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgslam.core.arrays import IntArray
from fgslam.core.estimates import LandmarkMap, Verdict
from fgslam.frontend.places.relocalisation.refinement import Refined
from fgslam.frontend.places.relocalisation.settings import RelocalisationSettings
from fgslam.frontend.places.relocalisation.tentative import Tentative
from fgslam.frontend.places.relocalisation.verdict import judge

SETTINGS = RelocalisationSettings()
# A metre apart: each is a witness of its own. The first hundred stand at one place, and so on.
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
        witnesses=len(features),
        covered=covered,
        explained=1.0,
    )


def _verdict(matched: int, *poses: Refined) -> Verdict:
    return judge(_tentative(matched), list(poses), PLACES, SETTINGS).verdict


def test_a_few_matches_that_are_nearly_all_are_enough() -> None:
    """Ten of twelve features that look like landmarks, and all places in view show something."""
    assert _verdict(12, _pose(np.arange(10))) is Verdict.FOUND


def test_as_many_among_many_that_disagree_are_not() -> None:
    """Twenty of a hundred fit anywhere in a building whose walls are alike."""
    assert _verdict(100, _pose(np.arange(20))) is Verdict.CONTRADICTED
    assert _verdict(100, _pose(np.arange(SETTINGS.enough_witnesses))) is Verdict.FOUND


@pytest.mark.parametrize(
    ("agreeing", "covered", "verdict"),
    [
        (28, 0.0, Verdict.FOUND),  # what should be seen is hidden, yet all that is seen agrees
        (22, 0.0, Verdict.CONTRADICTED),
        (22, 0.5, Verdict.FOUND),
        (12, 1.0, Verdict.FOUND),
        (12, 0.5, Verdict.CONTRADICTED),
    ],
)
def test_what_is_seen_and_what_should_be_make_up_for_one_another(
    agreeing: int, covered: float, verdict: Verdict
) -> None:
    assert _verdict(30, _pose(np.arange(agreeing), covered=covered)) is verdict


def test_few_that_fit_badly_are_accidents() -> None:
    badly = _pose(np.arange(20), misfit=SETTINGS.max_misfit + 0.1)
    assert _verdict(20, badly) is Verdict.CONTRADICTED
    assert _verdict(20, replace(badly, misfit=SETTINGS.max_misfit)) is Verdict.FOUND


def test_a_twin_that_explains_the_frame_as_well_makes_it_ambiguous() -> None:
    """Half of the features by either; each has some of its own."""
    best, twin = _pose(np.arange(20)), _pose(np.arange(4, 22), place=1)
    assert _verdict(24, best, twin) is Verdict.AMBIGUOUS


@pytest.mark.parametrize("missing", [0, 1, 5, 10])
def test_so_does_a_twin_of_which_some_landmarks_are_missing(missing: int) -> None:
    """Which of two twins the map knows better does not say where the robot is."""
    best, twin = _pose(np.arange(20)), _pose(np.arange(missing, 20), place=1)
    assert _verdict(24, best, twin) is Verdict.AMBIGUOUS


def test_a_place_that_explains_the_lesser_part_of_the_same_is_no_rival() -> None:
    """Were it the right one, what stands beside the things that both have would be explained."""
    best = _pose(np.arange(24))
    assert _verdict(30, best, _pose(np.arange(12, 24), place=1)) is Verdict.AMBIGUOUS
    best = _pose(np.arange(25))
    assert _verdict(30, best, _pose(np.arange(13, 25), place=1)) is Verdict.FOUND
    # Three features of its own, against thirteen that only the best explains.
    assert _verdict(30, best, _pose(np.arange(13, 28), place=1)) is Verdict.AMBIGUOUS


def test_a_thing_carried_off_does_not_convince() -> None:
    """All that looks like a landmark agrees; but it hung on a wall that is not there."""
    thing = replace(_pose(np.arange(20), covered=0.3), explained=0.3)
    assert _verdict(21, thing) is Verdict.CONTRADICTED
    assert _verdict(21, replace(thing, explained=0.6)) is Verdict.FOUND
    assert _verdict(21, replace(thing, covered=0.6)) is Verdict.FOUND


def test_what_shares_the_matches_is_the_same_solution() -> None:
    """Two poses by the same landmarks are one, known badly; the covariance says how."""
    assert _verdict(24, _pose(np.arange(20)), _pose(np.arange(2, 20))) is Verdict.FOUND


@pytest.mark.parametrize("change", [{"covered": 0.4}, {"misfit": 1.5}])
def test_a_pose_that_is_refuted_itself_is_no_rival(change: dict[str, float]) -> None:
    twin = _pose(np.arange(2, 22), place=1)
    assert _verdict(24, _pose(np.arange(20)), twin) is Verdict.AMBIGUOUS
    assert _verdict(24, _pose(np.arange(20)), replace(twin, **change)) is Verdict.FOUND  # type: ignore[arg-type]
