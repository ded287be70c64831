"""Closed-form alignment, residuals and least squares of relocalisation against exact truth."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core import geometry
from fgslam.core.types import LandmarkMap, StereoFeatures
from fgslam.frontend.features.matching import Neighbours
from fgslam.frontend.places.known_map import KnownMap
from fgslam.frontend.places.relocalisation import (
    Evidence,
    Pairs,
    Proposals,
    Refiner,
    Relocaliser,
    SeenPoints,
    covered,
    crowd,
    distinct,
    independent_inliers,
    log_uniform,
    refine,
    residuals,
    specific,
)
from fgslam.frontend.settings import RelocalisationSettings
from fgslam.frontend.tracking.ego_motion import align, align_in_space, rigid
from tests.known_places import RIG, Place, error, floor, planar, room, seen


def _seen_from(truth: np.ndarray, there: np.ndarray) -> np.ndarray:
    return np.stack([geometry.transform_to_camera(truth, points) for points in there])


@pytest.mark.parametrize("count", [2, 3, 7])
def test_planar_alignment_is_exact(rng: np.random.Generator, count: int) -> None:
    """The alignment holds for two matches and for more."""
    there = rng.uniform(-5.0, 5.0, (4, count, 3))
    for yaw in (-3.0, -0.2, 0.0, 1.6, 3.1):
        truth = planar(0.7, -1.3, yaw)
        found = align(_seen_from(truth, there), there, floor(3))
        assert np.allclose(found, truth, atol=1e-12)


def test_alignment_in_space_is_exact_and_never_mirrors(rng: np.random.Generator) -> None:
    there = rng.uniform(-5.0, 5.0, (50, 3, 3))
    truth = geometry.pose(geometry.so3_exp(np.array([0.4, -1.9, 0.8])), np.array([1.0, 2.0, 3.0]))
    found = align_in_space(_seen_from(truth, there), there)
    assert np.allclose(found, truth, atol=1e-9)
    assert np.allclose(np.linalg.det(found[:, :3, :3]), 1.0)


def test_rigidity_keeps_true_samples_and_drops_stretched_and_thin_ones(
    rng: np.random.Generator,
) -> None:
    truth = planar(0.3, 0.1, 1.0)
    there = np.array([[[-1.0, 0.0, 3.0], [1.0, 0.2, 4.0], [0.0, 0.5, 6.0]]])
    here = _seen_from(truth, there)
    noise = np.tile(1e-4 * np.eye(3), (1, 3, 1, 1))
    stretched = here * 1.2
    thin = np.array([[[0.0, 0.0, 3.0], [0.0, 0.0, 4.0], [0.0, 0.01, 5.0]]])
    assert rigid(here, there, noise, floor(6))[0]
    assert rigid(here[:, :2], there[:, :2], noise[:, :2], floor(3))[0]
    assert not rigid(stretched, there, noise, floor(6))[0]
    assert not rigid(stretched[:, :2], there[:, :2], noise[:, :2], floor(3))[0]
    assert not rigid(_seen_from(truth, thin), thin, noise, floor(6))[0]


def _pairs(rng: np.random.Generator, truth: np.ndarray, in_space: bool) -> Pairs:
    points = geometry.transform_to_world(truth, rng.uniform([-1, -1, 2], [1, 1, 5], (12, 3)))
    here = geometry.transform_to_camera(truth, points)
    value = here if in_space else geometry.project(RIG, here)
    noise = np.tile((1e-4 if in_space else 0.04) * np.eye(3), (12, 1, 1))
    point = SeenPoints(np.full(12, not in_space), value, noise, here, noise)
    return Pairs(point, points, np.tile(1e-4 * np.eye(3), (12, 1, 1)))


@pytest.mark.parametrize("in_space", [False, True])
def test_residuals_are_zero_at_truth_and_their_derivatives_right(
    rng: np.random.Generator, in_space: bool
) -> None:
    truth = planar(0.5, 0.2, 0.7)
    pairs = _pairs(rng, truth, in_space)
    at = residuals(RIG, truth, pairs)
    assert np.abs(at.residual).max() < 1e-9
    step = 1e-6
    for k in range(6):
        moved = truth @ geometry.se3_exp(step * np.eye(6)[k])
        numeric = -residuals(RIG, moved, pairs).residual / step
        assert np.allclose(numeric, at.by_pose[:, :, k], rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("dof", [3, 5, 6])
@pytest.mark.parametrize("in_space", [False, True])
def test_least_squares_returns_to_truth_from_many_starts(
    rng: np.random.Generator, dof: int, in_space: bool
) -> None:
    truth = planar(0.5, 0.2, 0.7)
    pairs = _pairs(rng, truth, in_space)
    level = floor(dof)  # type: ignore[arg-type]
    starts = np.stack([planar(0.5 + d, 0.2 - d, 0.7 + d) for d in (-0.15, 0.0, 0.1)])
    rows = np.repeat(np.arange(3), len(pairs))
    poses, covariances = refine(
        RIG, level, starts, pairs.select(np.tile(np.arange(12), 3)), rows, 10
    )
    assert np.allclose(poses, truth, atol=1e-7)
    assert np.allclose(covariances[0], covariances[2], rtol=1e-4, atol=1e-12)
    assert np.linalg.matrix_rank(covariances[0], tol=1e-12) == dof


def test_degenerate_pairs_have_an_infinite_covariance(rng: np.random.Generator) -> None:
    pairs = _pairs(rng, planar(0.0, 0.0, 0.0), False).select(np.array([0]))
    start = planar(0.0, 0.0, 0.1)
    poses, covariances = refine(RIG, floor(6), start[None], pairs, np.zeros(1, np.int64), 4)
    assert np.isinf(covariances).all()
    assert np.array_equal(poses[0], start)


def test_covariance_tells_the_scatter_of_poses() -> None:
    """NEES over many noisy frames lies in its band (three degrees of freedom)."""
    rng = np.random.default_rng(3)
    place, truth, level = room(rng, 250), planar(0.2, 0.1, 0.5), floor(3)
    landmarks, _ = place.map()
    exact = LandmarkMap(landmarks.ids, landmarks.positions, 1e-9 * landmarks.covariances)
    nees = []
    for _ in range(60):
        view = seen(place, truth, rng)
        here = geometry.project(RIG, geometry.transform_to_camera(truth, place.points))
        nearest = np.argmin(np.linalg.norm(view.measurement[:, None] - here[None], axis=2), axis=1)
        pairs = Pairs.of(SeenPoints.of(view, RIG), np.arange(len(view)), exact, nearest)
        rows = np.zeros(len(view), np.int64)
        poses, covariances = refine(RIG, level, truth[None], pairs, rows, 6)
        xi = geometry.se3_log(geometry.inverse(poses[0]) @ truth)
        basis = level.basis(truth)
        small = basis.T @ covariances[0] @ basis
        nees.append(float((basis.T @ xi) @ np.linalg.solve(small, basis.T @ xi)))
    assert 2.2 < np.mean(nees) < 3.9  # 95 % of means of 60 are within 2.4 and 3.6


def test_the_best_of_each_neighbourhood_is_kept() -> None:
    poses = np.stack([planar(x, 0.0, 0.0) for x in (0.0, 0.2, 3.0, 3.1, 6.0)])
    scores = np.array([9.0, 8.0, 7.0, 6.0, 5.0])
    kept = distinct(Proposals(poses, np.zeros((5, 6, 6)), scores), 2, 0.5, 0.3)
    assert kept.scores.tolist() == [9.0, 7.0]


def test_pieces_count_objects_not_texture() -> None:
    poster = np.full((40, 3), 0.1)
    spread = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    assert independent_inliers(poster, 0.5) == 4
    assert independent_inliers(np.vstack([poster, spread + 2.0]), 0.5) == 14
    assert independent_inliers(np.empty((0, 3)), 0.5) == 0
    assert crowd(np.vstack([poster[:3], spread[5:6]]), 0.5).tolist() == [3, 3, 3, 1]
    pieces = np.repeat(spread[:4], 4, axis=0)
    assert covered(pieces, np.arange(16) < 5, 0.5) == 0.5
    assert covered(spread, np.zeros(10, np.bool_), 0.5) == 1.0


def _specific(distances: list[float], places: list[float]) -> list[int]:
    """Landmarks kept of one feature whose candidates stand at the given places on a line."""
    count = len(places)
    positions = np.column_stack([places, np.zeros(count), np.zeros(count)])
    landmarks = LandmarkMap(np.arange(count), positions, np.zeros((count, 3, 3)))
    neighbours = Neighbours(np.arange(count)[None], np.array([distances]))
    kept = specific(neighbours, np.ones((1, count), np.bool_), np.arange(count), landmarks)
    assert (kept.places == len({round(places[k]) for k in kept.landmarks})).all()
    return kept.landmarks.tolist()


def test_candidates_end_at_the_first_gap() -> None:
    assert _specific([100.0, 250.0, 260.0], [0.0, 5.0, 9.0]) == [0]
    assert _specific([100.0, 102.0, 250.0], [0.0, 5.0, 9.0]) == [0, 1]
    assert _specific([100.0, 102.0, 250.0], [0.0, 0.1, 9.0]) == [0, 1]
    many = [100.0, 101.0, 102.0, 103.0, 104.0]
    assert _specific(many, [0.0, 3.0, 6.0, 9.0, 12.0]) == []
    assert _specific([500.0, 900.0], [0.0, 5.0]) == []


@pytest.mark.parametrize("dof", [3, 6])
def test_hypotheses_refined_together_end_where_each_would_alone(
    rng: np.random.Generator, dof: int
) -> None:
    truth = planar(0.5, -0.4, 0.3)
    place = room(rng)
    refiner = _refiner(seen(place, truth, rng, clutter=20), place, dof)
    starts = [planar(0.6, -0.4, 0.3), planar(4.0, 4.0, 2.0), planar(0.5, -0.2, 0.36), truth]
    covariance = np.diag([0.02, 0.02, 0.02, 0.05, 0.05, 0.05]) ** 2
    proposals = Proposals(np.array(starts), np.tile(covariance, (4, 1, 1)), np.zeros(4))
    together = refiner.refine(proposals)
    alone = [found for k in range(4) for found in refiner.refine(proposals.select(np.array([k])))]
    assert 3 <= len(together) == len(alone)
    for one, other in zip(together, alone, strict=True):
        assert np.array_equal(one.wTc, other.wTc)
        assert np.array_equal(one.covariance, other.covariance)
        assert np.array_equal(one.landmarks, other.landmarks)
        assert np.array_equal(one.features, other.features)
    assert error(together[-1].wTc, truth)[0] < 0.02
    assert refiner.refine(Proposals.none()) == []


def _refiner(features: StereoFeatures, place: Place, dof: int) -> Refiner:
    settings = RelocalisationSettings()
    relocaliser = Relocaliser(RIG, floor(dof), settings)
    relocaliser.learn(*place.map())
    tentative, known = relocaliser.tentative(features), KnownMap.of(*place.map())
    points = SeenPoints.of(features, RIG)
    pairs = Pairs.of(points, tentative.features, known.landmarks, tentative.landmarks)
    evidence = Evidence(RIG, tentative, pairs, log_uniform(RIG, pairs.seen, 40.0, known.room))
    return Refiner(RIG, floor(dof), known, features, points, evidence, settings)
