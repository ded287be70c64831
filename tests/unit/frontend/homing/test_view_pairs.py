"""Views far apart: candidate matches, what counts as evidence, and the second look."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.homing import OmniFeatures, Refusal, TwoViewVector, UprightFeatures
from fgslam.core.planar import wrap
from fgslam.frontend.features.omni import empty_segments
from fgslam.frontend.features.settings import OmniMatchingSettings
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.homing.two_view import (
    EpipolarTest,
    Refined,
    match_sift,
    planar_distances,
    spread_over,
)
from fgslam.frontend.homing.vector import (
    Candidates,
    GuidedScore,
    candidate_matches,
    edge_likeness,
    pair_generator,
    vector_between,
)

MATCHING = OmniMatchingSettings()
SETTINGS = HomingVectorSettings(samples=1000, confidence=0.999999)
TRUE = np.array([0.7, -1.1])  # direction, rotation
SIGMA = np.deg2rad(0.25)


def view(points: FloatArray, descriptors: FloatArray, rng: np.random.Generator) -> UprightFeatures:
    """Features at points (n, 3) of the camera's frame, of sizes as distances leave them."""
    n, far = len(points), np.hypot(points[:, 0], points[:, 1])
    return UprightFeatures(
        pixels=np.zeros((n, 2)),
        bearing=wrap(np.arctan2(points[:, 1], points[:, 0]) + rng.normal(0.0, SIGMA, n)),
        elevation=np.arctan2(points[:, 2], far) + rng.normal(0.0, SIGMA, n),
        covariance=np.tile(SIGMA**2 * np.eye(2), (n, 1, 1)),
        scale=0.02 / far * np.exp(rng.normal(0.0, 0.1, n)),
        descriptors=np.clip(descriptors, 0, 255).astype(np.uint8),
        colour=np.zeros((n, 3)),
    )


def two_views(seed: int, shared: int, blur: float) -> tuple[OmniFeatures, OmniFeatures]:
    """Views of ``shared`` things among 600 others each; of each thing b has two more alike.

    ``blur`` is how far the descriptors of one thing differ from view to view, and those of its like
    no more than that: the nearest is the right one in a third of the cases.
    """
    rng = np.random.default_rng(seed)
    points = np.column_stack(
        [rng.uniform(-3.0, 3.0, (2 * shared, 2)), rng.uniform(-1.0, 1.5, 2 * shared)]
    )
    points = points[np.linalg.norm(points[:, :2], axis=1) > 0.6][:shared]
    theta, psi = TRUE
    leg = np.array([np.cos(theta), np.sin(theta), 0.0])
    turn = np.array(
        [[np.cos(psi), -np.sin(psi), 0.0], [np.sin(psi), np.cos(psi), 0.0], [0.0, 0.0, 1.0]]
    )
    looks = rng.gamma(0.6, 40.0, (len(points), 128))

    def again() -> FloatArray:
        return np.asarray(looks + rng.normal(0.0, blur, looks.shape))

    def others(count: int) -> tuple[FloatArray, FloatArray]:
        around, far = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.7, 5.0, count)
        place = np.column_stack(
            [far * np.cos(around), far * np.sin(around), rng.uniform(-0.6, 1.5, count)]
        )
        return place, rng.gamma(0.6, 40.0, (count, 128))

    extra_a, extra_b, like = others(600), others(600), others(2 * len(points))
    a = view(np.vstack([points, extra_a[0]]), np.vstack([again(), extra_a[1]]), rng)
    b = view(
        np.vstack([(points - leg) @ turn, like[0], extra_b[0]]),
        np.vstack([again(), again(), again(), extra_b[1]]),
        rng,
    )
    return OmniFeatures(a, empty_segments()), OmniFeatures(b, empty_segments())


def answer(
    views: tuple[OmniFeatures, OmniFeatures], second_look: bool = True
) -> TwoViewVector | Refusal:
    settings = replace(SETTINGS, second_look=second_look)
    return vector_between(*views, MATCHING, settings, pair_generator(0, 0, 1))[0]


def off_deg(found: TwoViewVector) -> float:
    errors = wrap(np.array([found.direction, found.rotation]) - TRUE)
    return float(np.rad2deg(np.max(np.abs(errors))))


def test_a_second_look_answers_where_the_nearest_descriptor_is_often_wrong() -> None:
    views = [two_views(seed, 45, 28.0) for seed in range(6)]
    once, twice = ([answer(v, look) for v in views] for look in (False, True))
    answered = [found for found in twice if isinstance(found, TwoViewVector)]
    assert len(answered) >= 5
    assert sum(isinstance(found, TwoViewVector) for found in once) < len(answered)
    assert max(map(off_deg, answered)) < 2.0


def test_solutions_with_nearly_as_much_evidence_are_part_of_the_uncertainty() -> None:
    def solution(theta: float, psi: float) -> Refined:
        parameters = np.array([theta, psi, 0.0, 0.0, 0.0, 0.0, 0.0])
        none = np.zeros(0)
        return Refined(parameters, 0.01**2 * np.eye(7), none, none.astype(bool))

    near = [solution(3.1, 0.0), solution(3.1 + 0.1 - 2.0 * np.pi, 0.0)]  # 0.1 on, over the seam
    equal = spread_over(near, np.array([50.0, 50.0]), 6.0)
    np.testing.assert_allclose(equal, np.diag([0.01**2 + 0.1**2 / 2, 0.01**2]), rtol=0, atol=1e-12)
    less = spread_over(near, np.array([50.0, 50.0 - 6.0 * np.log(3.0)]), 6.0)  # a third as likely
    np.testing.assert_allclose(less[0, 0], 0.01**2 + 0.1**2 / 4, rtol=0, atol=1e-12)
    far = spread_over(near, np.array([500.0, 50.0]), 6.0)
    np.testing.assert_allclose(far, 0.01**2 * np.eye(2), rtol=0, atol=1e-12)


def test_views_that_share_nothing_are_refused() -> None:
    for seed in range(6):
        a, _ = two_views(seed, 45, 28.0)
        _, b = two_views(seed + 50, 45, 28.0)
        assert not answer((a, b))


def test_a_clear_answer_is_that_of_the_matches() -> None:
    views = two_views(3, 300, 2.0)
    alone, matches = vector_between(
        *views, MATCHING, replace(SETTINGS, second_look=False), pair_generator(0, 0, 1)
    )
    assert isinstance(alone, TwoViewVector)
    again = answer(views)
    assert isinstance(again, TwoViewVector)
    assert len(again.inliers) == len(matches)
    assert again.direction == alone.direction


def test_inliers_are_features_that_occur_once() -> None:
    views = two_views(1, 45, 28.0)
    found, matches = vector_between(*views, MATCHING, SETTINGS, pair_generator(0, 0, 1))
    assert isinstance(found, TwoViewVector)
    kept = matches.select(found.inliers)
    assert len(np.unique(kept.index_a)) == len(np.unique(kept.index_b)) == len(kept)


# --------------------------------------------------------------------------------------------
# What counts as evidence


def candidates_of(a: UprightFeatures, b: UprightFeatures) -> Candidates:
    """Candidate matches by the distances of two views' descriptors."""
    return candidate_matches(a, b, planar_distances(a, b, MATCHING))


def test_candidates_are_the_five_nearest_of_either_view() -> None:
    a, b = (views.sift for views in two_views(3, 40, 20.0))
    squared = planar_distances(a, b, MATCHING)
    before = squared.copy()
    found = candidate_matches(a, b, squared).matches
    order, back = np.argsort(before, axis=1), np.argsort(before, axis=0)
    nearest = {(i, j) for i in range(len(a)) for j in order[i, :5].tolist()}
    nearest |= {(i, j) for j in range(len(b)) for i in back[:5, j].tolist()}
    pairs = set(zip(found.index_a.tolist(), found.index_b.tolist(), strict=True))
    assert pairs
    assert pairs <= nearest
    np.testing.assert_array_equal(squared, before)


def test_distances_that_are_known_give_the_same_matches_and_stay_as_they_are() -> None:
    a, b = (views.sift for views in two_views(4, 40, 5.0))
    squared = planar_distances(a, b, MATCHING)
    squared[7] = np.inf  # nothing may be like it
    before = squared.copy()
    known, anew = match_sift(a, b, MATCHING, squared), match_sift(a, b, MATCHING)
    candidate_matches(a, b, squared)
    np.testing.assert_array_equal(squared, before)
    others = anew.index_a != 7
    assert np.count_nonzero(others) > 20
    np.testing.assert_array_equal(known.index_a, anew.index_a[others])
    np.testing.assert_array_equal(known.index_b, anew.index_b[others])


def test_gradients_along_one_line_are_an_edge() -> None:
    edge, all_around = np.zeros((1, 16, 8)), np.ones((1, 16, 8))
    edge[:, :8, 1], edge[:, 8:, 5] = 90.0, 40.0  # both sides of it
    cross = np.zeros((1, 16, 8))
    cross[..., 0] = cross[..., 2] = 50.0
    likeness = edge_likeness(
        np.concatenate([edge, all_around, cross]).reshape(3, 128).astype(np.uint8)
    )
    np.testing.assert_allclose(likeness, [1.0, 0.0, 0.0], rtol=0, atol=1e-12)


def test_edges_and_the_floor_at_the_feet_are_no_candidates() -> None:
    a, b = two_views(2, 60, 5.0)
    whole = candidates_of(a.sift, b.sift)
    flat = replace(a.sift, descriptors=np.tile(a.sift.descriptors[:, :1], 128) * 0)
    flat.descriptors[:, ::8] = 200  # all gradients point one way
    low = replace(a.sift, elevation=np.full(len(a.sift), np.deg2rad(-50.0)))
    assert len(whole)
    assert not len(candidates_of(flat, b.sift))
    assert not len(candidates_of(low, b.sift))


@pytest.mark.parametrize("width", [np.deg2rad(3.0), np.pi])
def test_things_in_one_place_say_less_than_things_all_around(width: float) -> None:
    """The score of 30 exact candidates: of all in one block, and spread over the view."""
    rng = np.random.default_rng(0)
    around = np.deg2rad(5.0) + rng.uniform(-width, width, 30) * 0.99
    points = np.column_stack(
        [2.0 * np.cos(around), 2.0 * np.sin(around), rng.uniform(0.2, 0.3, 30)]
    )
    looks = rng.gamma(0.6, 40.0, (30, 128))
    theta, psi = TRUE
    leg = np.array([np.cos(theta), np.sin(theta), 0.0])
    turn = np.array(
        [[np.cos(psi), -np.sin(psi), 0.0], [np.sin(psi), np.cos(psi), 0.0], [0.0, 0.0, 1.0]]
    )
    a, b = view(points, looks, rng), view((points - leg) @ turn, looks, rng)
    candidates = candidates_of(a, b)
    good, residuals = EpipolarTest.of(candidates.matches).inliers(TRUE[:1], TRUE[1:], 3.0, 0.05)
    score, rows = GuidedScore(candidates).of(
        theta, psi, np.where(good, residuals, np.nan)[:, 0], 3.0
    )
    assert len(rows) >= 5
    assert (score > 60.0) == (width > 1.0)
