"""Invariant column segments: geometry, invariances, runs, and their distance."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.cameras.omni import Cylinder
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.bearings import ColumnSegments
from fgslam.core.geometry import wrap
from fgslam.frontend.features.omni import COVARIANCE, ColumnSegmentFinder, dct_rows, whitened
from fgslam.frontend.features.settings import (
    OmniMatchingSettings,
)
from fgslam.frontend.homing.two_view import consistent_tangents, match_columns, nearest_segments

VIEW = Cylinder(401, 401, -1.0, 1.0)
POSTS = 16
POST_WIDTH = 6


def finder() -> ColumnSegmentFinder:
    return ColumnSegmentFinder(VIEW)


def posts(distance: float = 1.0, seed: int = 4, shift: int = 0) -> tuple[Image, FloatArray]:
    """Posts around the camera with a smooth pattern between two edges, and their ends' heights."""
    rng = np.random.default_rng(seed)
    ends = np.column_stack([rng.uniform(-0.48, -0.25, POSTS), rng.uniform(0.25, 0.48, POSTS)])
    height = VIEW.tangents(np.arange(401.0)) * distance
    image = np.full((401, 401, 3), 20.0)
    for k in range(POSTS):
        part = (height - ends[k, 0]) / (ends[k, 1] - ends[k, 0])
        waves = rng.choice([-1.0, 1.0], 4) * rng.uniform(0.4, 1.0, 4) / np.arange(1, 5)
        tone = sum(w * np.cos(np.pi * (m + 1) * part) for m, w in enumerate(waves))
        tint = rng.uniform(0.5, 1.0, 3)
        inside = (part > 0.0) & (part < 1.0)
        colour = 150.0 * tint + 16.0 * tint * np.asarray(tone)[:, None]
        first = 3 + k * 25
        columns = slice(first, first + POST_WIDTH)
        image[:, columns] = np.where(inside[:, None], colour, image[:, first])[:, None]
    image[:, :400] = np.roll(image[:, :400], shift, axis=1)
    image[:, 400] = image[:, 0]
    return np.clip(np.round(image), 0, 255).astype(np.uint8), ends


def test_dct_is_orthonormal_and_blind_to_the_mean() -> None:
    rows = dct_rows(32, 7)
    np.testing.assert_allclose(rows @ rows.T, np.eye(7), atol=1e-12)
    np.testing.assert_allclose(rows @ np.ones(32), 0.0, atol=1e-12)


def test_every_post_is_found_once_at_its_place() -> None:
    image, ends = posts()
    found = finder().extract(image)
    assert len(found) == POSTS
    columns = 3 + 25 * np.arange(POSTS) + (POST_WIDTH - 1) / 2
    order = np.argsort(-found.bearing)
    expected = np.pi - columns * 2 * np.pi / 400
    pixel = 2 * np.pi / 400
    np.testing.assert_allclose(found.bearing[order], expected, atol=1.01 * pixel)
    np.testing.assert_allclose(found.tangents[order], ends, atol=1.5 * 2.0 / 400)
    low, high = found.tangents.T
    np.testing.assert_allclose(found.descriptors[:, 0], -low / (high - low), rtol=1e-12)
    assert found.descriptors.shape == (POSTS, 11)


def test_a_post_across_the_seam_is_one() -> None:
    image, _ = posts(shift=-6)  # the first post now lies on both sides
    assert len(finder().extract(image)) == POSTS


@pytest.mark.parametrize("distance", [0.5, 0.8, 1.4, 2.0])
def test_distance_leaves_descriptors_as_they_are(distance: float) -> None:
    near, far = (finder().extract(posts(d)[0]) for d in (1.0, distance))
    matches = match_columns(near, far, OmniMatchingSettings())
    assert len(matches) >= 0.8 * POSTS
    pixel = 2 * np.pi / 400
    np.testing.assert_allclose(matches.bearing_a, matches.bearing_b, atol=1.01 * pixel)
    ratio = np.tan(matches.elevation_a) / np.tan(matches.elevation_b)
    np.testing.assert_allclose(ratio, distance, rtol=0.08)
    i, j = matches.index_a, matches.index_b
    apart = whitened(near.descriptors[i]) - whitened(far.descriptors[j])
    others = whitened(near.descriptors[i]) - whitened(np.roll(far.descriptors[j], 1, axis=0))
    lengths = np.linalg.norm(apart, axis=1)
    assert np.median(lengths) < 2.0
    assert np.median(lengths) < 0.2 * np.median(np.linalg.norm(others, axis=1))


def test_gain_and_offset_leave_the_profile() -> None:
    image, _ = posts()
    changed = np.round(0.75 * image + 30.0).astype(np.uint8)
    gained = np.round(0.75 * image).astype(np.uint8)
    before = finder().extract(image)
    spread = np.sqrt(np.diag(COVARIANCE))
    for other, elements in ((changed, slice(4, 11)), (gained, slice(1, 11))):
        after = finder().extract(other)
        gap = np.abs(wrap(before.bearing[:, None] - after.bearing)) + np.abs(
            before.tangents[:, None] - after.tangents
        ).sum(axis=2)
        same = gap.min(axis=1) < 0.02
        assert same.sum() >= POSTS - 3
        now = after.descriptors[gap.argmin(axis=1)]
        change = (before.descriptors[same] - now[same])[:, elements] / spread[elements]
        assert np.sqrt(np.mean(change**2, axis=1)).max() < 0.5, "against the spread of two views"


def test_blank_and_wide_things_are_no_segments() -> None:
    assert len(finder().extract(np.zeros((401, 401, 3), np.uint8))) == 0
    table = np.full((401, 401, 3), 40, np.uint8)
    table[180:260] = np.linspace(90, 200, 80)[:, None, None].astype(np.uint8)
    assert len(finder().extract(table)) == 0, "a band all around has no bearing"


def test_unseen_parts_hold_no_segments() -> None:
    image, _ = posts()
    seen = np.ones((401, 401), np.bool_)
    seen[:, 200:] = False
    image[:, 200:] = 0
    found = ColumnSegmentFinder(VIEW, seen).extract(image)
    assert 0 < len(found) <= POSTS // 2
    assert np.all(found.bearing > 0.0)


def test_kd_tree_equals_brute_force() -> None:
    rng = np.random.default_rng(8)
    a, b = rng.normal(size=(60, 11)), rng.normal(size=(50, 11))
    i, j, distance, ratio = nearest_segments(a, b)
    every = np.linalg.norm(a[:, None] - b[None], axis=2)
    nearest = every.argmin(axis=1)
    mutual = every.argmin(axis=0)[nearest] == np.arange(60)
    np.testing.assert_array_equal(i, np.flatnonzero(mutual))
    np.testing.assert_array_equal(j, nearest[mutual])
    two = np.sort(every, axis=1)[mutual, :2]
    np.testing.assert_allclose(distance, two[:, 0], rtol=1e-12)
    np.testing.assert_allclose(ratio, two[:, 0] / two[:, 1], rtol=1e-12)


def test_whitened_distance_is_mahalanobis() -> None:
    assert np.linalg.eigvalsh(COVARIANCE).min() > 0.0
    rng = np.random.default_rng(9)
    d = rng.normal(size=(2, 11))
    even = d.copy()
    even[:, 0] = np.arcsinh(d[:, 0] - 0.5)
    gap = even[0] - even[1]
    expected = np.sqrt(gap @ np.linalg.solve(COVARIANCE, gap))
    white = whitened(d)
    assert np.linalg.norm(white[0] - white[1]) == pytest.approx(expected, rel=1e-9)


def test_tangents_of_both_ends_give_one_ratio() -> None:
    a = np.array([[-0.4, 0.3], [0.0, 0.5], [-0.6, 0.01], [0.2, 0.7]])
    rho = np.array([0.5, 0.8, 1.3, 2.0])
    one, two, factor = consistent_tangents(a, a / rho[:, None])
    np.testing.assert_allclose(one / two, rho, rtol=1e-12)
    np.testing.assert_allclose(one, a[np.arange(4), np.abs(a).argmax(axis=1)], rtol=1e-12)
    assert np.all((factor > 1 / np.sqrt(2) - 1e-12) & (factor <= 1.0))


def test_the_ratio_of_both_ends_is_better_than_that_of_one() -> None:
    rng = np.random.default_rng(10)
    true = np.tile([-0.3, 0.35], (4000, 1))
    a, b = (true + rng.normal(0, 0.01, true.shape) for _ in range(2))
    one, two, factor = consistent_tangents(a, b)
    both, single = np.std(np.log(one / two)), np.std(np.log(a[:, 1] / b[:, 1]))
    assert both < 0.85 * single
    # The stated deviation is that of the tangents' difference.
    assert np.std(one - two) == pytest.approx(np.sqrt(2) * 0.01 * factor.mean(), rel=0.05)


def test_few_segments_match_nothing() -> None:
    image, _ = posts()
    some = finder().extract(image)
    none = finder().extract(np.zeros_like(image))
    assert isinstance(none, ColumnSegments)
    assert len(match_columns(some, none, OmniMatchingSettings())) == 0
    assert len(match_columns(none, some, OmniMatchingSettings())) == 0


def test_two_equal_segments_compete_for_a_third_equal_one() -> None:
    one = np.array([[1.0, 2.0], [5.0, 5.0]])
    i, j, distance, ratio = nearest_segments(one, np.array([[1.0, 2.0], [1.0, 2.0], [5.0, 6.0]]))
    assert i.tolist() == [0, 1]
    assert distance.tolist() == [0.0, 1.0]
    assert ratio[0] == 1.0
    assert ratio[1] == pytest.approx(0.2)
    assert j[1] == 2
