"""From features to trackable points: which point, and where it lies in the target view."""

from __future__ import annotations

import cv2
import numpy as np

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.homing import (
    BearingMatches,
    ColumnSegments,
    FeatureKind,
    OmniFeatures,
    UprightFeatures,
)
from fgslam.core.planar import wrap
from fgslam.frontend.features.omni import empty_features, empty_segments
from fgslam.frontend.homing.tracking import DISTINCT_PX, move_to_trackable
from tests.homing import make_matches
from tests.textured_room import CAMERA, angles, hits, picture

START = np.array([-1.2, 0.4, 0.3])
TARGET = np.array([0.3, 0.1, -0.5])


def view_of(pose: FloatArray) -> Image:
    """(h, period) as the tracker's stabilised view gives it."""
    return np.ascontiguousarray(picture(pose)[:, :-1, 0])


def features_at(seen: FloatArray, scale: FloatArray) -> OmniFeatures:
    n = len(seen)
    sift = UprightFeatures(
        pixels=CAMERA.pixels(
            np.column_stack([np.cos(seen[:, 0]), np.sin(seen[:, 0]), np.tan(seen[:, 1])])
        ),
        bearing=seen[:, 0],
        elevation=seen[:, 1],
        covariance=np.tile(1e-6 * np.eye(2), (n, 1, 1)),
        scale=scale,
        descriptors=np.zeros((n, 128), np.uint8),
        colour=np.zeros((n, 3)),
    )
    return OmniFeatures(sift, empty_segments())


def wall_points(count: int, seed: int) -> FloatArray:
    """(n, 3) on all walls, in sight of both poses."""
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-np.pi, np.pi, count)
    rays = np.column_stack([np.cos(bearing), np.sin(bearing), rng.uniform(-0.5, 0.5, count)])
    points = hits(START, rays)
    return np.asarray(points[np.abs(angles(TARGET, points)[:, 1]) < np.deg2rad(45.0)])


def two_views(points: FloatArray) -> tuple[BearingMatches, tuple[OmniFeatures, OmniFeatures]]:
    """Features as if found exactly at these points; scales go with one over the distance."""
    a, b = angles(START, points), wrap(angles(TARGET, points))
    a = wrap(a)
    sizes = [0.12 / np.linalg.norm(points[:, :2] - pose[:2], axis=1) for pose in (START, TARGET)]
    return make_matches(np.hstack([a, b]), 1e-4), (
        features_at(a, sizes[0]),
        features_at(b, sizes[1]),
    )


def test_points_of_planar_patches_are_mapped_within_half_a_degree() -> None:
    """On walls: against where the very point that was chosen is seen from the target."""
    matches, features = two_views(wall_points(400, 1))
    rows, pixels, moved = move_to_trackable(view_of(START), CAMERA, matches, features)
    assert len(rows) > 150
    truth = angles(TARGET, hits(START, CAMERA.rays(pixels)))
    off = wrap(np.column_stack([moved.bearing_b, moved.elevation_b]) - truth)
    assert np.median(np.abs(off)) < np.deg2rad(0.25)
    assert np.mean(np.abs(off) < np.deg2rad(0.5)) > 0.95
    # Not for nothing: the offset itself is larger than what is left of it.
    offsets = np.hypot(
        wrap(moved.bearing_b - matches.bearing_b[rows]),
        moved.elevation_b - matches.elevation_b[rows],
    )
    assert np.median(np.abs(off[:, 0])) < 0.5 * np.median(offsets)
    sigma = moved.sigma[:, 2:]
    assert np.mean(np.abs(off) < 3.0 * sigma) > 0.9


def test_the_start_sees_the_point_at_its_pixel() -> None:
    matches, features = two_views(wall_points(60, 2))
    rows, pixels, moved = move_to_trackable(view_of(START), CAMERA, matches, features)
    rays = CAMERA.rays(pixels)
    np.testing.assert_allclose(
        wrap(moved.bearing_a - np.arctan2(rays[:, 1], rays[:, 0])), 0.0, atol=1e-9
    )
    np.testing.assert_allclose(moved.elevation_a, np.arcsin(rays[:, 2]), atol=1e-9)
    np.testing.assert_array_equal(moved.kind, matches.kind[rows])
    assert (pixels[:, 0] >= 0).all()
    assert (pixels[:, 0] < CAMERA.width - 1).all()


def test_a_window_tells_corners_from_edges() -> None:
    """Eq. 2 of a single pixel has rank 1 everywhere; summed over a window only on edges."""
    grey = np.full((CAMERA.height, CAMERA.width - 1), 60, np.uint8)
    grey[:90, 300:] = 200  # one corner at (300, 90); edges up, and to the right
    gradients = [cv2.Sobel(grey, cv2.CV_64F, *order) for order in ((1, 0), (0, 1))]
    single = np.stack([[g * h for g in gradients] for h in gradients]).transpose(2, 3, 0, 1)
    assert np.abs(np.linalg.eigvalsh(single)[..., 0]).max() < 1e-6 * single.max()
    corner, edge = place(300, 90), place(300, 45)
    for seen, found in ((corner, 1), (edge, 0)):
        matches = make_matches(np.hstack([seen, seen]), 1e-4)
        features = features_at(seen, np.array([0.02]))
        rows, pixels, _ = move_to_trackable(grey, CAMERA, matches, (features,) * 2)
        assert len(rows) == found
        assert np.all(np.abs(pixels - [300, 90]) <= 4.0)


def place(column: float, row: float) -> FloatArray:
    """(1, 2) bearing and elevation of a pixel."""
    ray = CAMERA.rays(np.array([[column, row]], dtype=np.float64))
    return np.array([[np.arctan2(ray[0, 1], ray[0, 0]), np.arcsin(ray[0, 2])]])


def test_points_near_the_seam() -> None:
    """A feature just left of the seam may find its point just right of it."""
    grey = np.full((CAMERA.height, CAMERA.width - 1), 60, np.uint8)
    grey[:90, 3:60] = 200
    seen = place(CAMERA.width - 2, 90)
    features = features_at(seen, np.array([np.deg2rad(4.0)]))
    matches = make_matches(np.hstack([seen, seen]), 1e-4)
    rows, pixels, moved = move_to_trackable(grey, CAMERA, matches, (features,) * 2)
    assert rows.tolist() == [0]
    assert 0 <= pixels[0, 0] <= 8
    assert abs(wrap(moved.bearing_b - seen[0, 0])[0]) < np.deg2rad(6.0)


def test_features_with_the_same_point_give_it_once() -> None:
    points = wall_points(40, 3)
    matches, features = two_views(np.repeat(points, 2, axis=0))
    rows, pixels, _ = move_to_trackable(view_of(START), CAMERA, matches, features)
    apart = np.hypot(*(pixels[:, None] - pixels[None]).transpose(2, 0, 1))
    apart[np.diag_indices(len(apart))] = np.inf
    assert apart.min() >= DISTINCT_PX
    assert (rows % 2 == 0).all()  # of equals the first


def test_nothing_to_track() -> None:
    grey = np.full((CAMERA.height, CAMERA.width - 1), 90, np.uint8)
    matches, features = two_views(wall_points(30, 4))
    rows, pixels, moved = move_to_trackable(grey, CAMERA, matches, features)
    assert len(rows) == len(pixels) == len(moved) == 0
    none = matches.select(np.empty(0, dtype=np.int64))
    rows, pixels, moved = move_to_trackable(grey, CAMERA, none, features)
    assert rows.shape == (0,)
    assert pixels.shape == (0, 2)
    assert len(moved) == 0


def test_column_segments_scale_by_their_length() -> None:
    """A column feature's point moves in the target by the ratio of the lengths."""
    seen = wrap(angles(START, wall_points(30, 5)))
    n = len(seen)
    segments = []
    for ratio in (1.0, 2.0):
        length = 0.2 * ratio
        tangents = np.tan(seen[:, 1:]) + np.array([-0.5, 0.5]) * length
        segments.append(
            OmniFeatures(
                empty_features(),
                ColumnSegments(
                    seen[:, 0], np.full(n, 1e-3), tangents, np.full((n, 2), 1e-3), np.zeros((n, 11))
                ),
            )
        )
    plain = make_matches(np.hstack([seen, seen]), 1e-4)
    columns = np.full(n, int(FeatureKind.COLUMN), dtype=np.int64)
    matches = BearingMatches(columns, *(getattr(plain, f) for f in _FIELDS))
    rows, _, moved = move_to_trackable(view_of(START), CAMERA, matches, (segments[0], segments[1]))
    assert len(rows) > 10
    np.testing.assert_allclose(
        wrap(moved.bearing_b - matches.bearing_b[rows]),
        2.0 * wrap(moved.bearing_a - matches.bearing_a[rows]),
        atol=1e-9,
    )


_FIELDS = (
    "index_a", "index_b", "bearing_a", "elevation_a", "bearing_b", "elevation_b", "sigma", "quality"
)  # fmt: skip
