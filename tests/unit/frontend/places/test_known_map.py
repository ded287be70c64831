"""The map as relocalisation knows it: whose views are whose, and what is in view."""

from __future__ import annotations

import numpy as np
import pytest
from known_places import RIG, planar, random_descriptors

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.geometry import transform_to_camera
from fgslam.core.types import LandmarkAppearances, LandmarkMap
from fgslam.frontend.places.known_map import KnownMap

SIGMA_M = 0.02


def _landmarks(ids: IntArray, positions: FloatArray) -> LandmarkMap:
    return LandmarkMap(ids, positions, np.tile(1e-4 * np.eye(3), (len(ids), 1, 1)))


def _views(ids: IntArray, rng: np.random.Generator) -> LandmarkAppearances:
    direction = rng.standard_normal((len(ids), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction[rng.random(len(ids)) < 0.2] = np.nan
    size = rng.uniform(1.0, 30.0, len(ids))
    return LandmarkAppearances(
        ids, random_descriptors(rng, len(ids)), size, np.zeros(len(ids)), direction
    )


@pytest.fixture
def known(rng: np.random.Generator) -> KnownMap:
    """Two thousand landmarks all around, one to three views each."""
    ids = 5 + 2 * np.arange(2000)
    positions = rng.uniform([-9.0, -2.0, -9.0], [9.0, 2.0, 9.0], (2000, 3))
    return KnownMap.of(
        _landmarks(ids, positions), _views(np.repeat(ids, rng.integers(1, 4, 2000)), rng)
    )


def test_landmarks_without_views_and_views_without_landmark_are_left_out(
    rng: np.random.Generator,
) -> None:
    ids, viewed = np.array([2, 4, 6, 9]), np.array([1, 2, 2, 6, 7, 9, 9, 9, 12])
    landmarks, views = _landmarks(ids, rng.standard_normal((4, 3))), _views(viewed, rng)
    known = KnownMap.of(landmarks, views, SIGMA_M)
    kept = np.isin(viewed, ids)
    assert known.landmarks.ids.tolist() == [2, 6, 9]
    assert np.array_equal(known.landmarks.positions, landmarks.positions[[0, 2, 3]])
    assert np.allclose(known.landmarks.covariances, (1e-4 + SIGMA_M**2) * np.eye(3), rtol=1e-12)
    assert known.owners.tolist() == [0, 0, 1, 2, 2, 2]
    assert np.array_equal(known.views.descriptors, views.descriptors[kept])
    assert known.largest.tolist() == [views.size[viewed == i].max() for i in (2, 6, 9)]
    assert len(known.index) == 6


def test_nothing_in_common_is_an_empty_map(rng: np.random.Generator) -> None:
    landmarks = _landmarks(np.array([2, 4]), np.ones((2, 3)))
    known = KnownMap.of(landmarks, _views(np.array([1, 3, 5]), rng))
    assert len(known.landmarks) == len(known.views) == len(known.index) == len(known.owners) == 0
    assert known.room == 1.0
    assert len(known.in_view(RIG, np.eye(4))[0]) == 0


def test_views_of_landmarks_are_reported_landmark_by_landmark(
    known: KnownMap, rng: np.random.Generator
) -> None:
    rows = np.sort(rng.choice(2000, 70, replace=False))
    views, at = known.views_of(rows)
    assert np.array_equal(views, np.flatnonzero(np.isin(known.owners, rows)))
    assert np.array_equal(known.owners[views], rows[at])


@pytest.mark.parametrize("farthest", [np.inf, 4.0])
def test_what_is_in_view_is_what_projects_into_all_images(known: KnownMap, farthest: float) -> None:
    for yaw in (0.0, 1.0, 3.0, -2.0):
        wTc = planar(1.0, -2.0, yaw)
        points = transform_to_camera(wTc, known.landmarks.positions)
        front = (points[:, 2] > 0.3) & (points[:, 2] <= farthest)
        column, row, disparity = RIG.predict(np.where(front[:, None], points, 1.0)).T
        baselines = (RIG.vertical_baseline or 0.0) / RIG.baseline
        up = disparity * RIG.fy * baselines / RIG.fx
        inside = front & (column >= 0) & (column + disparity <= RIG.width - 1)
        inside &= (row >= 0) & (row + up <= RIG.height - 1)
        rows, local = known.in_view(RIG, wTc, farthest)
        assert len(rows) > 15
        assert np.array_equal(rows, np.flatnonzero(inside))
        np.testing.assert_allclose(local, points[rows], atol=1e-12)


def test_recognisable_is_what_has_a_view_of_like_direction_and_scale(known: KnownMap) -> None:
    scales, angle = (1.5, 6.0), 0.8
    wTc = planar(-1.0, 2.0, 0.5)
    rows, points = known.in_view(RIG, wTc)
    wanted = []
    for row, distance in zip(rows.tolist(), points[:, 2], strict=True):
        ray = known.landmarks.positions[row] - wTc[:3, 3]
        for view in np.flatnonzero(known.owners == row):
            cosine = ray @ known.views.direction[view] / np.linalg.norm(ray)
            alike = np.isnan(cosine) or cosine >= np.cos(angle)
            if alike and scales[0] <= known.views.size[view] / distance <= scales[1]:
                wanted.append(row)
                break
    found = known.recognisable(RIG, wTc, angle, scales)
    assert 0 < len(wanted) < len(rows)
    assert found.tolist() == wanted
