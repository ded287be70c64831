"""Frames located in a map without a prior."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from known_places import RIG, Place, error, floor, planar, room, seen, things
from rings import drive, error_m, on_ring, pipeline_of, seen as seen_on_ring
from simulated import RIG as SIMULATED_RIG, assert_same_bits

from fgslam.backend.settings import EstimatorSettings, Isam2Settings, LandmarkKalmanSettings
from fgslam.core import geometry
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse, pose, so3_exp
from fgslam.core.types import DegreesOfFreedom, LandmarkMap, RelocalisationStatus, StereoFeatures
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.frontend.features.matching import Neighbours
from fgslam.frontend.places import relocalisation as relocaliser
from fgslam.frontend.places.recognition import PlaceRecognition
from fgslam.frontend.places.relocalisation import (
    LEAST_INLIERS,
    Pairs,
    Proposals,
    Relocaliser,
    SeenPoints,
    covered,
    crowd,
    distinct,
    independent_inliers,
    refine,
    residuals,
    specific,
)
from fgslam.frontend.settings import FrontendSettings, RelocalisationSettings
from fgslam.frontend.tracking.ego_motion import align, align_in_space, rigid, sample_size
from fgslam.slam.build import make_motion, make_places
from fgslam.slam.pipeline import FrameReport, SlamPipeline

# ------------------------------------------------------------------------------------------
# Closed-form alignment, residuals and least squares of relocalisation against exact truth


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


@pytest.mark.parametrize("dof", [3, 6])
def test_a_sample_has_as_many_matches_as_fix_a_pose_and_no_more(
    rng: np.random.Generator, dof: DegreesOfFreedom
) -> None:
    truth, size = planar(0.7, -1.3, 0.4), sample_size(floor(dof))
    there = rng.uniform(-5.0, 5.0, (4, size, 3))
    for count, fixed in ((size, True), (size - 1, False)):
        found = align(_seen_from(truth, there[:, :count]), there[:, :count], floor(dof))
        assert np.isclose(found, truth, atol=1e-9).all(axis=(1, 2)).tolist() == 4 * [fixed]


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
    value = here if in_space else RIG.predict(here)
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


def test_covariance_is_the_scatter_of_poses() -> None:
    """NEES over many noisy frames lies in its band (three degrees of freedom)."""
    rng = np.random.default_rng(3)
    place, truth, level = room(rng, 250), planar(0.2, 0.1, 0.5), floor(3)
    landmarks, _ = place.map()
    exact = LandmarkMap(landmarks.ids, landmarks.positions, 1e-9 * landmarks.covariances)
    nees = []
    for _ in range(60):
        view = seen(place, truth, rng)
        here = RIG.predict(geometry.transform_to_camera(truth, place.points))
        nearest = np.nanargmin(
            np.linalg.norm(view.measurement[:, None] - here[None], axis=2), axis=1
        )
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


# ------------------------------------------------------------------------------------------
# The kidnapped robot: found where it is, refused where it cannot be known


DEFAULTS = RelocalisationSettings(map_sigma_m=0.001)


@pytest.fixture(autouse=True)
def _exact_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated features are where their landmarks are, from wherever they are seen."""
    monkeypatch.setattr(relocaliser, "VIEW_SIGMA_PX", 0.0)


def _relocaliser(
    place: Place, dof: int = 3, settings: RelocalisationSettings = DEFAULTS
) -> Relocaliser:
    made = Relocaliser(RIG, floor(dof), settings)  # type: ignore[arg-type]
    made.learn(*place.map())
    return made


def test_pose_on_the_floor_is_found_without_a_prior(rng: np.random.Generator) -> None:
    place, truth = room(rng), planar(1.2, -0.7, 2.1)
    view = seen(place, truth, rng, clutter=60)
    found = _relocaliser(place).locate(view, rng)
    assert found.found, found.why
    metres, degrees = error(found.wTc, truth)
    assert metres < 0.05
    assert degrees < 0.5
    assert np.array_equal(np.unique(found.ids), np.sort(found.ids))
    assert len(found.features) == len(found.ids) > 20
    assert found.wTc[1, 3] == 0.0
    assert found.covariance[4, 4] == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("dof", [5, 6])
def test_pose_in_space_is_found_in_any_orientation(rng: np.random.Generator, dof: int) -> None:
    place = things(rng, np.array([-4.0, -1.5, -4.0]), np.array([4.0, 1.0, 4.0]), 2500)
    height = 0.0 if dof == 5 else -0.4
    truth = pose(so3_exp(np.array([0.3, 1.9, -0.5])), np.array([0.5, height, 1.0]))
    view = seen(place, truth, rng, clutter=60, roll=0.5)
    found = _relocaliser(place, dof).locate(view, rng)
    assert found.found, found.why
    metres, degrees = error(found.wTc, truth)
    assert metres < 0.05
    assert degrees < 0.5


def _two_posters(rng: np.random.Generator) -> tuple[Place, Place]:
    """A poster on the north wall and the same one on the same wall, six metres to the east."""
    poster = things(rng, np.array([-3.5, -0.5, 4.99]), np.array([-2.5, 0.5, 5.0]), 60)
    return poster, poster.moved(np.array([6.0, 0.0, 0.0]))


def test_alike_places_that_fill_the_view_are_ambiguous(rng: np.random.Generator) -> None:
    west, east = _two_posters(rng)
    for truth in (planar(-3.0, 3.0, 0.0), planar(3.0, 3.0, 0.0)):
        found = _relocaliser(west.join(east)).locate(seen(west.join(east), truth, rng), rng)
        assert found.status is RelocalisationStatus.AMBIGUOUS, found.why
        assert found.second > 20


def test_alike_places_are_distinguished_by_their_surroundings(rng: np.random.Generator) -> None:
    west, east = _two_posters(rng)
    place = west.join(east).join(room(rng, 900))
    made = _relocaliser(place)
    for truth in (planar(-3.0, 1.0, 0.0), planar(3.0, 1.0, 0.0)):
        found = made.locate(seen(place, truth, rng), rng)
        assert found.found, found.why
        assert error(found.wTc, truth)[0] < 0.1


def test_a_poster_carried_elsewhere_is_refused(rng: np.random.Generator) -> None:
    """The map knows the poster and its wall; the frame shows the poster on a wall unknown."""
    poster, elsewhere = _two_posters(rng)
    wall = things(rng, np.array([-5.0, -1.5, 4.9]), np.array([-1.0, 1.0, 5.1]), 200)
    small = poster.select(np.arange(0, 60, 2))
    view = seen(elsewhere.select(np.arange(0, 60, 2)), planar(3.0, 1.0, 0.0), rng, clutter=80)
    vague = replace(DEFAULTS, max_sigma_m=1.0, max_sigma_deg=20.0)  # its covariance shall not help
    found = _relocaliser(small.join(wall), settings=vague).locate(view, rng)
    assert found.status is RelocalisationStatus.CONTRADICTED, found.why


@pytest.mark.parametrize("kept", [0.95, 0.7])
def test_alike_places_stay_ambiguous_where_one_is_better_mapped(
    rng: np.random.Generator, kept: float
) -> None:
    """The map lost some landmarks of either."""
    west, east = _two_posters(rng)
    parts = (thing.select(np.flatnonzero(rng.random(60) < kept)) for thing in (west, east))
    made = _relocaliser(next(parts).join(next(parts)))
    for thing, x in ((west, -3.0), (east, 3.0)):
        found = made.locate(seen(thing, planar(x, 2.5, 0.0), rng), rng)
        assert found.status is RelocalisationStatus.AMBIGUOUS, found.why


@pytest.mark.parametrize("count", [0, 1, 2, 3])
@pytest.mark.parametrize("dof", [3, 6])
def test_few_features_are_too_few(rng: np.random.Generator, count: int, dof: int) -> None:
    place = room(rng)
    view = seen(place, planar(0.0, 0.0, 0.0), rng)
    found = _relocaliser(place, dof).locate(_first(view, count), rng)
    assert found.status in (
        RelocalisationStatus.TOO_FEW_MATCHES,
        RelocalisationStatus.TOO_FEW_INLIERS,
    )
    assert str(LEAST_INLIERS) in found.why


def test_an_empty_map_finds_nothing(rng: np.random.Generator) -> None:
    view = seen(room(rng), planar(0.0, 0.0, 0.0), rng)
    empty = Relocaliser(RIG, floor(3), DEFAULTS)
    found = empty.locate(view, rng)
    assert found.status is RelocalisationStatus.TOO_FEW_MATCHES
    assert np.isnan(found.covariance).all()
    assert not len(found.ids)


@pytest.mark.parametrize("dof", [3, 6])
def test_landmarks_on_a_vertical_line_fix_no_pose(rng: np.random.Generator, dof: int) -> None:
    """All turns about the line see the same."""
    line = things(rng, np.array([0.5, -1.0, 4.0]), np.array([0.5, 1.0, 4.0]), 60)
    found = _relocaliser(line, dof).locate(seen(line, planar(0.0, 0.0, 0.0), rng), rng)
    assert not found.found, found.why


def test_one_plane_is_enough(rng: np.random.Generator) -> None:
    wall = things(rng, np.array([-4.0, -1.5, 5.0]), np.array([4.0, 1.0, 5.0]), 300)
    truth = planar(0.3, 1.0, 0.2)
    for dof in (3, 6):
        found = _relocaliser(wall, dof).locate(seen(wall, truth, rng), rng)
        assert found.found, found.why
        assert error(found.wTc, truth)[0] < 0.05


def test_a_submap_counts_what_lies_outside_the_image(rng: np.random.Generator) -> None:
    """Features of earlier frames, in the last camera's frame, some behind it."""
    place, last = room(rng), planar(0.0, 0.0, 0.0)
    views = [seen(place, turned, rng) for turned in (planar(0.0, 0.0, 2.8), planar(0.0, 0.0, 1.6))]
    poses = [planar(0.0, 0.0, 2.8), planar(0.0, 0.0, 1.6)]
    parts = [_carried(view, at) for view, at in zip(views, poses, strict=True)]
    submap = _joined([*parts, seen(place, last, rng)])
    assert (submap.position[:, 2] < 0.0).any()
    found = _relocaliser(place).locate(submap, rng)
    assert found.found, found.why
    assert error(found.wTc, last)[0] < 0.05
    assert (submap.position[found.features, 2] < 0.0).any()


def _first(view: StereoFeatures, count: int) -> StereoFeatures:
    return view.select(np.arange(count))


def _joined(views: list[StereoFeatures]) -> StereoFeatures:
    return functools.reduce(StereoFeatures.join, views)


def _carried(view: StereoFeatures, lTc: FloatArray) -> StereoFeatures:
    """Features in the frame of another camera, where most project nowhere."""
    rotation = lTc[:3, :3]
    return replace(
        view,
        measurement=np.full_like(view.measurement, -1e4),
        position=view.position @ rotation.T + lTc[:3, 3],
        position_covariance=rotation @ view.position_covariance @ rotation.T,
    )


# ------------------------------------------------------------------------------------------
# After a gap that nothing bridges the map is begun again; recognised, its parts become one


GAP = 8
RETURN = [*range(0, 2 * GAP, 2), *range(40, 84, 2)]  # on the ring; beyond 72 it is known again
WAY = [on_ring(k) for k in RETURN]
SETTINGS = FrontendSettings()


def driven(
    estimator: EstimatorSettings, way: list[FloatArray]
) -> tuple[SlamPipeline, list[FrameReport]]:
    pipeline = pipeline_of(way, 0.0, SETTINGS, estimator)
    pipeline.motion = make_motion(SIMULATED_RIG, ConstantVelocitySettings())
    pipeline.places = make_places(SIMULATED_RIG, SETTINGS, pipeline.tracker, seed=0, joins=True)
    return pipeline, drive(pipeline, seen_on_ring(way))


@pytest.mark.parametrize("estimator", [LandmarkKalmanSettings(), Isam2Settings()])
def test_parts_are_joined_where_the_first_is_recognised(estimator: EstimatorSettings) -> None:
    pipeline, reports = driven(estimator, WAY)
    assert pipeline.places is not None
    joined = [k for k, report in enumerate(reports) if report.increment.loops]
    assert joined
    assert joined[0] > GAP
    assert pipeline.places.taken[0]
    assert pipeline.tracker.parts.connected.all()
    assert max(error_m(report, WAY[k]) for k, report in enumerate(reports) if k > joined[-1]) < 0.1
    found = pipeline.estimator.estimate().trajectory.poses
    off = [np.linalg.norm((inverse(a) @ b)[:3, 3]) for a, b in zip(WAY, found, strict=True)]
    assert max(off) < 0.15


def test_without_a_join_they_stay_apart_and_that_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PlaceRecognition, "find_join", lambda *_: None)
    pipeline, reports = driven(Isam2Settings(), WAY[: GAP + 6])
    assert pipeline.tracker.parts.connected.tolist() == [True] * GAP + [False] * 6
    later = reports[-1]
    assert error_m(later, WAY[GAP + 5]) > 1.0
    covariance = pipeline.estimator.estimate().covariances[-1]
    assert np.sqrt(covariance[3:, 3:].trace()) > 1.0


def test_the_same_drive_is_joined_to_the_bit() -> None:
    (_, one), (_, other) = (driven(LandmarkKalmanSettings(), WAY[: GAP + 13]) for _ in range(2))
    assert [k for k, report in enumerate(one) if report.increment.loops]
    np.testing.assert_array_equal(one[-1].stats.wTc, other[-1].stats.wTc)
    assert_same_bits(one[-1].increment.observations, other[-1].increment.observations)
