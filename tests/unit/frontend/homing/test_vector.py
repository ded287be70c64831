"""The homing vector from noisy and partly wrong matches; refusals; the local map."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from homing import TwoViews, make_matches, two_views
from scipy.stats import chi2, norm

from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import (
    BearingMatches,
    LocalMap,
    OmniFeatures,
    Refusal,
    RefusalReason,
    TwoViewVector,
    UprightFeatures,
)
from fgslam.core.geometry import bearings, wrap
from fgslam.frontend.features.omni import empty_segments
from fgslam.frontend.homing.two_view import (
    EpipolarTest,
    HomingRefinement,
    Refined,
    make_local_map,
    planar_distances,
    spread_over,
    triangulable,
    triangulate,
)
from fgslam.frontend.homing.vector import (
    Candidates,
    GuidedScore,
    HomingSearch,
    SecondLook,
    candidate_matches,
    edge_likeness,
    estimate_homing_vector,
    match_cells,
    pair_generator,
    re_paired,
    vector_between,
)
from fgslam.frontend.settings import HomingVectorSettings, OmniMatchingSettings

HALF_DEGREE = np.deg2rad(0.5)
SETTINGS = HomingVectorSettings()


def answer(views: TwoViews, settings: HomingVectorSettings = SETTINGS) -> TwoViewVector | Refusal:
    return estimate_homing_vector(views.matches, settings, np.random.default_rng(7))


def error(views: TwoViews, vector: TwoViewVector) -> FloatArray:
    """(2,) radians: direction and rotation."""
    return wrap(np.array([vector.direction - views.direction, vector.rotation - views.rotation]))


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_median_error_at_half_a_degree(wrong: float) -> None:
    errors, nees, recalls = [], [], []
    for seed in range(50):
        views = two_views(seed, 30, HALF_DEGREE, wrong)
        vector = answer(views)
        if isinstance(vector, TwoViewVector):
            off = error(views, vector)
            errors.append(np.abs(off))
            nees.append(off @ np.linalg.solve(vector.covariance, off))
            recalls.append(np.mean(vector.inliers[views.right]))
    direction, rotation = np.rad2deg(np.median(errors, axis=0))
    assert direction <= 0.8
    assert rotation <= 0.4
    assert len(errors) >= 47
    assert np.mean(recalls) >= 0.98
    # Some wrong matches agree by chance and none is distinguished: the share inside is not exact.
    assert np.mean(np.array(nees) < chi2.ppf(0.95, 2)) > 0.85


def test_tilted_cameras_are_estimated() -> None:
    tilts = (np.deg2rad([2.0, -1.0]), np.deg2rad([-1.5, 1.0]))
    settings = dataclasses.replace(SETTINGS, tilt_sigma_deg=2.0)
    level, free = [], []
    for seed in range(20):
        views = two_views(seed, 50, np.deg2rad(0.2), tilts=tilts)
        for found, s in (
            (level, dataclasses.replace(SETTINGS, tilt_sigma_deg=0.0)),
            (free, settings),
        ):
            vector = answer(views, s)
            found.append(np.pi if isinstance(vector, Refusal) else abs(error(views, vector)[0]))
    assert np.rad2deg(np.median(free)) < 0.5
    assert np.median(free) < 0.3 * np.median(level)


def test_where_a_camera_is_neither_level_nor_clearly_tilted_another_solution_may_be_right() -> None:
    tilts = (np.deg2rad([2.0, -1.0]), np.deg2rad([-1.5, 1.0]))
    for tilt, even in ((None, 0), (tilts, 5)):
        answers = [answer(two_views(seed, 50, np.deg2rad(0.2), tilts=tilt)) for seed in range(10)]
        chances = [v.wrong_probability for v in answers if isinstance(v, TwoViewVector)]
        assert len(chances) >= 8
        assert (chances.count(0.5) >= 5) == bool(even)


def test_a_camera_that_is_lifted_on_the_way_is_distinguished_from_the_plane() -> None:
    """As far up or down as on, tilted by a degree: held to the plane 2 of 20 had an answer."""
    errors = []
    for seed in range(20):
        tilts = np.deg2rad(np.random.default_rng(seed + 1000).normal(size=(2, 2)))
        lift = 0.3 if seed % 2 else -0.3
        views = two_views(
            seed, 60, np.deg2rad(0.3), 0.3, leg_m=0.3, tilts=(tilts[0], tilts[1]), lift_m=lift
        )
        doubtful = dataclasses.replace(views.matches, quality=np.full(60, 0.4))
        vector = answer(dataclasses.replace(views, matches=doubtful))
        if isinstance(vector, TwoViewVector):
            errors.append(abs(error(views, vector)[0]))
    assert len(errors) >= 8
    assert np.rad2deg(np.median(errors)) < 2.0


def test_a_lead_in_one_sector_leaves_uncertainty_and_the_same_lead_all_around_does_not() -> None:
    """Eight equal matches fewer for the other solution: 8 of 1 sigma each, or one of 8."""
    bearing = np.repeat(np.deg2rad(22.5 + 45.0 * np.arange(8)), 8)
    angles = np.column_stack([bearing, np.full(64, 0.2)] * 2)
    search = HomingSearch(make_matches(angles, HALF_DEGREE), SETTINGS, np.random.default_rng(0))

    def solution(lost: list[int]) -> Refined:
        return Refined(np.zeros(7), np.eye(7), np.zeros(64), ~np.isin(np.arange(64), lost))

    best = solution([])
    everywhere, at_one_side = solution([*range(0, 64, 8)]), solution([*range(8)])
    assert search.rival_probability(best, [everywhere]) == pytest.approx(norm.sf(np.sqrt(8.0)))
    assert search.rival_probability(best, [everywhere, at_one_side]) == pytest.approx(norm.sf(1.0))
    assert search.rival_probability(best, [solution([])]) == 0.5
    assert search.rival_probability(best, []) == 0.0


def test_random_matches_are_refused() -> None:
    refused = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        angles = np.column_stack([rng.uniform(-np.pi, np.pi, 60), rng.uniform(-0.5, 0.6, 60)] * 2)
        angles[:, 2] = rng.uniform(-np.pi, np.pi, 60)
        angles[:, 3] = rng.uniform(-0.5, 0.6, 60)
        found = estimate_homing_vector(make_matches(angles, HALF_DEGREE), SETTINGS, rng)
        refused += isinstance(found, Refusal)
    assert refused == 30


def test_few_matches_are_refused_with_their_number() -> None:
    refusal = answer(two_views(0, 5, HALF_DEGREE))
    assert isinstance(refusal, Refusal)
    assert refusal.reason is RefusalReason.TOO_FEW_MATCHES
    assert "5 matches" in refusal.details


def test_both_views_from_one_place() -> None:
    views = two_views(1, 40, np.deg2rad(0.1), leg_m=0.002)
    refusal = answer(views)
    assert isinstance(refusal, Refusal)
    assert refusal.reason is RefusalReason.AT_TARGET
    assert refusal.rotation == pytest.approx(views.rotation, abs=np.deg2rad(0.2))


def test_one_thing_of_the_same_kind_elsewhere_is_no_arrival() -> None:
    """A poster that hangs in another room, too, among wrong matches: that resembles a turn."""
    reasons = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        angles = rng.uniform(-np.pi, np.pi, (80, 4))
        angles[:, 1::2] = rng.uniform(0.05, 0.6, (80, 2)) * rng.choice([-1.0, 1.0], (80, 1))
        size = np.deg2rad(2.0 if seed % 2 else 8.0)
        angles[:20, :2] = np.array([0.5, 0.2]) + rng.uniform(-size, size, (20, 2))
        angles[:20, 2:] = angles[:20, :2] + [1.0, 0.0] + rng.normal(0.0, 0.004, (20, 2))
        quality = np.where(np.arange(80) < 20, 0.7, rng.uniform(0.2, 0.5, 80))
        matches = dataclasses.replace(make_matches(angles, HALF_DEGREE), quality=quality)
        found = estimate_homing_vector(matches, SETTINGS, rng)
        reasons.append(found.reason if isinstance(found, Refusal) else None)
    assert RefusalReason.AT_TARGET not in reasons
    assert reasons.count(None) == 0  # a rigid thing fits some motion, too, and nothing else does


def test_independent_inliers_are_counted_across_the_seam() -> None:
    """What lies behind is one thing on both sides of the turn from +pi to -pi."""
    behind = np.pi - np.deg2rad([0.3, 0.6, -0.3, -0.6])
    angles = np.column_stack([wrap(behind), np.full(4, 0.2), np.full(4, 1.0), np.full(4, 0.2)])
    for turn in (0.0, 1.0):
        turned = angles + np.array([0.0, 0.0, turn, 0.0])
        assert len(np.unique(match_cells(make_matches(turned, HALF_DEGREE)))) == 1
    apart = angles + np.deg2rad(3.0) * np.arange(4)[:, None] * np.array([0.0, 1.0, 0.0, 0.0])
    assert len(np.unique(match_cells(make_matches(apart, HALF_DEGREE)))) == 4


def test_epipolar_residual_of_truth_is_zero_and_of_unit_variance_under_noise() -> None:
    exact = two_views(5, 200)
    there = (np.array([exact.direction]), np.array([exact.rotation]))
    test = EpipolarTest.of(exact.matches)
    assert np.max(np.abs(test.coefficients @ _hypothesis(*there))) < 1e-12
    noisy = [two_views(seed, 100, HALF_DEGREE) for seed in range(40)]
    residuals = [
        EpipolarTest.of(v.matches).normalised(np.array([v.direction]), np.array([v.rotation]))
        for v in noisy
    ]
    assert np.std(residuals) == pytest.approx(1.0, abs=0.05)


def test_the_printed_ratios_of_distances_agree_for_the_truth_and_not_for_swapped_matches() -> None:
    exact = two_views(5, 200)
    there = (np.array([exact.direction]), np.array([exact.rotation]))
    test = EpipolarTest.of(exact.matches)
    assert np.nanmax(np.abs(test.by_ratios(*there))) < 1e-6
    good, _ = test.inliers(*there, 3.0, 0.05, printed=True)
    assert good.all()
    m = exact.matches
    order = np.roll(np.arange(len(m)), 1)
    swapped = EpipolarTest.of(re_paired(m, np.arange(len(m)), order))
    good, _ = swapped.inliers(*there, 3.0, 0.05, printed=True)
    assert np.mean(good) < 0.2


def test_the_printed_test_leads_to_the_same_answer_with_a_third_of_wrong_matches() -> None:
    view = two_views(8, 60, HALF_DEGREE, wrong_share=0.3)
    settings = HomingVectorSettings(inliers="ratio", confidence=0.999999)
    found = estimate_homing_vector(view.matches, settings, np.random.default_rng(0))
    assert isinstance(found, TwoViewVector)
    assert abs(wrap(found.direction - view.direction)) < np.deg2rad(3.0)
    assert abs(wrap(found.rotation - view.rotation)) < np.deg2rad(3.0)


def _hypothesis(direction: FloatArray, rotation: FloatArray) -> FloatArray:
    between = rotation - direction
    return np.stack([np.sin(direction), -np.cos(direction), np.sin(between), np.cos(between)])


def test_refinement_covariance_is_that_of_monte_carlo() -> None:
    found = []
    for seed in range(150):
        views = two_views(11, 60)
        rng = np.random.default_rng(seed)
        m = views.matches
        angles = np.column_stack([m.bearing_a, m.elevation_a, m.bearing_b, m.elevation_b])
        noisy = make_matches(
            angles + rng.normal(0.0, np.deg2rad(0.2), angles.shape), np.deg2rad(0.2)
        )
        prior = (1e-6, 1e-6)
        start = np.array([[views.direction], [views.rotation]])
        refined = HomingRefinement(noisy, prior, 5.0, 0.05).refine(*start)[0]
        found.append(
            (
                *(refined.parameters[:2] - [views.direction, views.rotation]),
                *np.diag(refined.covariance)[:2],
            )
        )
    samples = np.array(found)
    np.testing.assert_allclose(
        np.var(samples[:, :2], axis=0), np.median(samples[:, 2:], axis=0), rtol=0.3
    )


def test_hypotheses_refined_side_by_side_are_refined_as_if_alone() -> None:
    """Each ends when it has converged, whatever the others do; one that is right stays."""
    views = two_views(3, 40, HALF_DEGREE, 0.3)
    refinement = HomingRefinement(views.matches, (0.02, 0.05), 3.0, 0.0)
    offsets = np.array([0.0, 0.02, 0.5, 2.0, -1.0])
    directions, rotations = views.direction + offsets, views.rotation - 0.5 * offsets
    together = refinement.refine(directions, rotations)
    for k, one in enumerate(together):
        (alone,) = refinement.refine(directions[k : k + 1], rotations[k : k + 1])
        np.testing.assert_allclose(one.parameters, alone.parameters, atol=1e-9)
        np.testing.assert_allclose(one.covariance, alone.covariance, rtol=1e-6, atol=1e-12)
        np.testing.assert_array_equal(one.inliers, alone.inliers)
    off = wrap(together[0].parameters[:2] - np.array([views.direction, views.rotation]))
    assert np.abs(off).max() < 0.05
    assert len({round(float(one.parameters[0]), 3) for one in together}) > 1


def test_local_map_covariance_is_that_of_monte_carlo() -> None:
    views = two_views(4, 40)
    sigma = np.deg2rad(0.05)
    truth = np.array([views.direction, views.rotation])
    vector_covariance = np.diag(np.deg2rad([0.1, 0.05]) ** 2)
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(3000):
        bearing_a = views.matches.bearing_a + rng.normal(0.0, sigma, 40)
        bearing_b = views.matches.bearing_b + rng.normal(0.0, sigma, 40)
        theta, psi = rng.multivariate_normal(truth, vector_covariance)
        noisy = dataclasses.replace(views.matches, bearing_a=bearing_a, bearing_b=bearing_b)
        drawn.append(triangulate(noisy, theta, psi))
    made = _map(views, sigma, vector_covariance)
    near = triangulable(made, 0.1)
    assert np.count_nonzero(near) > 20
    np.testing.assert_allclose(
        np.std(drawn, axis=0)[near], np.sqrt(made.covariance[near, 0, 0]), rtol=0.15
    )


def _map(views: TwoViews, sigma: float, covariance: FloatArray) -> LocalMap:
    noise = np.full((len(views.matches), 4), sigma)
    matches: BearingMatches = dataclasses.replace(views.matches, sigma=noise)
    inliers = np.ones(len(matches), dtype=np.bool_)
    return make_local_map(
        TwoViewVector(views.direction, views.rotation, covariance, inliers, 0), matches
    )


def test_rays_that_diverge_are_not_triangulable() -> None:
    views = two_views(2, 30)
    backwards = TwoViewVector(
        views.direction + np.pi, views.rotation, np.eye(2) * 1e-8, np.ones(30, dtype=np.bool_), 0
    )
    made = make_local_map(backwards, views.matches)
    assert not np.any(triangulable(made, 0.3))


def corridor(seed: int, leg_m: float, sigma: float) -> TwoViews:
    """Matches of points on the walls of a corridor 2.4 m wide, all right; along it."""
    rng = np.random.default_rng(seed)
    count, rotation = 120, float(rng.uniform(-np.pi, np.pi))
    points = np.column_stack([rng.uniform(-12.0, 12.0, count), rng.choice([-1.2, 1.2], count)])
    height = rng.uniform(-1.3, 1.2, count)
    poses = (np.zeros(3), np.array([leg_m, 0.1 * leg_m, rotation]))
    angles = np.column_stack(
        [
            by
            for pose in poses
            for by in (
                bearings(pose, points),
                np.arctan2(height, np.hypot(*(points - pose[:2]).T)),
            )
        ]
    )
    angles += rng.normal(0.0, sigma, angles.shape)
    direction = float(np.arctan2(0.1, 1.0))
    right = np.ones(count, np.bool_)
    return TwoViews(make_matches(angles, sigma), direction, rotation, leg_m, points, right)


def test_links_along_a_corridor_are_as_uncertain_as_they_say() -> None:
    """Error over sigma, rms; on short legs much of the derivatives is noise, too."""
    settings = HomingVectorSettings(tilt_sigma_deg=0.0, height_sigma=0.0)
    scaled = []
    for seed in range(60):
        truth = corridor(seed, 1.2, np.deg2rad(0.5))
        found = answer(truth, settings)
        assert isinstance(found, TwoViewVector)
        scaled.append(error(truth, found) / np.sqrt(np.diag(found.covariance)))
    rms = np.sqrt(np.mean(np.square(scaled), axis=0))
    assert np.all((rms >= 0.8) & (rms <= 1.2))


# --------------------------------------------------------------------------------------------
# Views far apart: candidate matches, what counts as evidence, and the second look


MATCHING = OmniMatchingSettings()
PAIR_SETTINGS = HomingVectorSettings(samples=1000, confidence=0.999999)
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


def crowded_views(seed: int, shared: int, blur: float) -> tuple[OmniFeatures, OmniFeatures]:
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
    drawn = rng.gamma(0.6, 40.0, (len(points), 128))

    def again() -> FloatArray:
        return np.asarray(drawn + rng.normal(0.0, blur, drawn.shape))

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


def pair_answer(
    views: tuple[OmniFeatures, OmniFeatures], second_look: bool = True
) -> TwoViewVector | Refusal:
    settings = replace(PAIR_SETTINGS, second_look=second_look)
    return vector_between(*views, MATCHING, settings, pair_generator(0, 0, 1))[0]


def off_deg(found: TwoViewVector) -> float:
    errors = wrap(np.array([found.direction, found.rotation]) - TRUE)
    return float(np.rad2deg(np.max(np.abs(errors))))


def test_a_second_look_answers_where_the_nearest_descriptor_is_often_wrong() -> None:
    views = [crowded_views(seed, 45, 28.0) for seed in range(6)]
    once, twice = ([pair_answer(v, look) for v in views] for look in (False, True))
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


def test_inliers_are_features_that_occur_once() -> None:
    views = crowded_views(1, 45, 28.0)
    found, matches = vector_between(*views, MATCHING, PAIR_SETTINGS, pair_generator(0, 0, 1))
    assert isinstance(found, TwoViewVector)
    kept = matches.select(found.inliers)
    assert len(np.unique(kept.index_a)) == len(np.unique(kept.index_b)) == len(kept)


@pytest.mark.parametrize("seed", range(3))
def test_a_second_motion_with_evidence_enough_for_an_answer_is_a_refusal(seed: int) -> None:
    """Sixty things, and 45 others as seen from a camera that is turned by a radian more.

    Where the images before tell which of both is the camera's, the better one is the answer.
    """
    (a, b), (c, d) = crowded_views(seed, 60, 20.0), crowded_views(seed + 100, 45, 20.0)
    turned = replace(d.sift, bearing=wrap(d.sift.bearing + 1.0))
    views = (
        OmniFeatures(a.sift.join(c.sift), empty_segments()),
        replace(b, sift=b.sift.join(turned)),
    )
    alone, among = (
        vector_between(*views, MATCHING, PAIR_SETTINGS, pair_generator(0, 0, 1), one)[0]
        for one in (True, False)
    )
    assert isinstance(alone, Refusal)
    assert alone.reason is RefusalReason.AMBIGUOUS
    assert "for a different motion" in alone.details
    assert isinstance(among, TwoViewVector)
    assert off_deg(among) < 1.0


def test_tilts_that_are_unlikely_cost_evidence() -> None:
    """The second camera is tilted by six of the prior's sigmas."""
    a, b = crowded_views(3, 45, 28.0)
    tilted = b.sift.elevation + np.deg2rad(3.0) * np.cos(b.sift.bearing)
    b = replace(b, sift=replace(b.sift, elevation=tilted))
    alone, among = (
        vector_between(a, b, MATCHING, PAIR_SETTINGS, pair_generator(0, 0, 1), one)[0]
        for one in (True, False)
    )
    assert isinstance(among, TwoViewVector)
    assert isinstance(alone, Refusal)
    assert "after its tilts" in alone.details


def test_a_clear_answer_stands_unless_the_candidates_speak_for_another_one() -> None:
    a, b = crowded_views(1, 45, 20.0)
    look = SecondLook(candidates_of(a.sift, b.sift), PAIR_SETTINGS)
    theta, psi = TRUE
    right = TwoViewVector(theta, psi, np.eye(2) * 1e-4, np.zeros(0, np.bool_), 0)
    wrong = replace(right, direction=theta + 1.0)
    hypotheses = np.array([TRUE, [theta + 1.0, psi]])
    assert look.confirmed(right, hypotheses) is right
    refusal = look.confirmed(wrong, hypotheses)
    assert isinstance(refusal, Refusal)
    assert refusal.reason is RefusalReason.AMBIGUOUS


# --------------------------------------------------------------------------------------------
# What counts as evidence


def candidates_of(a: UprightFeatures, b: UprightFeatures) -> Candidates:
    """Candidate matches by the distances of two views' descriptors."""
    return candidate_matches(a, b, planar_distances(a, b, MATCHING))


def test_candidates_are_the_five_nearest_of_either_view() -> None:
    a, b = (views.sift for views in crowded_views(3, 40, 20.0))
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
    a, b = crowded_views(2, 60, 5.0)
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
    drawn = rng.gamma(0.6, 40.0, (30, 128))
    theta, psi = TRUE
    leg = np.array([np.cos(theta), np.sin(theta), 0.0])
    turn = np.array(
        [[np.cos(psi), -np.sin(psi), 0.0], [np.sin(psi), np.cos(psi), 0.0], [0.0, 0.0, 1.0]]
    )
    a, b = view(points, drawn, rng), view((points - leg) @ turn, drawn, rng)
    candidates = candidates_of(a, b)
    good, residuals = EpipolarTest.of(candidates.matches).inliers(TRUE[:1], TRUE[1:], 3.0, 0.05)
    score, rows = GuidedScore(candidates).of(
        theta, psi, np.where(good, residuals, np.nan)[:, 0], 3.0
    )
    assert len(rows) >= 5
    assert (score > 60.0) == (width > 1.0)


# --------------------------------------------------------------------------------------------
# A second motion among the matches: a mirror, a room like another one


def turned_in_part(degrees: float, share: float) -> tuple[TwoViews, BearingMatches]:
    """Two views, in the second of which a share of the things moves as if that was turned."""
    views = two_views(seed=3, count=240, sigma=np.deg2rad(0.1))
    turned = np.random.default_rng(0).permutation(240)[: int(share * 240)]
    bearing_b = views.matches.bearing_b.copy()
    bearing_b[turned] = wrap(bearing_b[turned] - np.deg2rad(degrees))
    return views, replace(views.matches, bearing_b=bearing_b)


@pytest.mark.parametrize(("share", "refused"), [(0.0, False), (0.2, False), (0.42, True)])
def test_a_second_motion_that_is_supported_alike_is_a_refusal(share: float, refused: bool) -> None:
    _, matches = turned_in_part(60.0, share)
    found = estimate_homing_vector(matches, SETTINGS, np.random.default_rng(7))
    assert isinstance(found, Refusal) == refused
    if isinstance(found, Refusal):
        assert found.reason is RefusalReason.AMBIGUOUS
        assert "move alike in a different way" in found.details


def test_the_sigma_covers_a_second_motion_near_the_first() -> None:
    """10 degrees are less than two solutions must differ by; either may be the right one."""
    views, matches = turned_in_part(10.0, 0.42)
    found = estimate_homing_vector(matches, SETTINGS, np.random.default_rng(7))
    assert isinstance(found, TwoViewVector)
    sigma = np.sqrt(found.covariance[1, 1])
    for rotation in (views.rotation, views.rotation + np.deg2rad(10.0)):
        assert abs(wrap(np.array(found.rotation - rotation))) < 1.5 * sigma
    assert sigma < np.deg2rad(20.0)
