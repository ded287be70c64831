"""Tracking on a stabilised view: accuracy against truth, turns, light, loss, bad input."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from homing import make_matches
from scipy import ndimage
from textured_room import CAMERA, angles, hits, picture

from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.bearings import (
    BearingMatches,
    ColumnSegments,
    FeatureKind,
    OmniFeatures,
    TrackedBearings,
    UprightFeatures,
)
from fgslam.core.errors import EstimatorError, FrameError
from fgslam.core.geometry import wrap
from fgslam.frontend.features.omni import empty_features, empty_segments
from fgslam.frontend.homing.tracking import (
    DISTINCT_PX,
    BearingTracker,
    ReplenishedTracker,
    move_to_trackable,
)

_MODULE = "fgslam.frontend.homing.tracking"
START = np.array([-1.2, 0.4, 0.3])


@pytest.fixture(scope="module")
def start_image() -> Image:
    return picture(START)


def grid(tracker: BearingTracker) -> FloatArray:
    """Points all around, the first ones on the seam."""
    period, height = tracker.view.width - 1, tracker.view.height
    columns, rows = np.meshgrid(np.arange(0, period, 25), np.linspace(30, height - 31, 5))
    return np.column_stack([columns.ravel(), np.round(rows.ravel())]).astype(np.float64)


def started(image: Image) -> BearingTracker:
    tracker = BearingTracker(CAMERA)
    pixels = grid(tracker)
    tracker.start(image, 0.0, np.arange(len(pixels)), pixels)
    return tracker


def errors(found: TrackedBearings, pose: FloatArray, tracker: BearingTracker) -> FloatArray:
    """(m, 2) radians: bearing and elevation against the truth."""
    points = hits(START, tracker.view.rays(grid(tracker)))
    seen = np.column_stack([found.bearing, found.elevation])
    return np.asarray(wrap(seen - angles(pose, points)[found.ids]))


def way(steps: int) -> list[FloatArray]:
    """Poses 5 cm and up to 6 degrees apart."""
    k = np.arange(1, steps + 1)
    turn = np.deg2rad(20.0) * np.sin(0.3 * k)
    return [START + np.array([0.05 * i, 0.01 * i, t]) for i, t in zip(k, turn, strict=True)]


def test_bearings_on_the_way_are_accurate_and_as_sure_as_they_say(start_image: Image) -> None:
    tracker = started(start_image)
    total = len(grid(tracker))
    for k, pose in enumerate(way(14)):
        found = tracker.track(picture(pose), 0.1 * (k + 1))
        off = errors(found, pose, tracker)
        sigmas = np.column_stack([found.sigma_bearing, found.sigma_elevation])
        assert np.median(np.abs(off)) < np.deg2rad(0.1)
        assert np.mean(np.abs(off) < 3.0 * sigmas) > 0.95
    assert len(found) > 0.5 * total
    assert np.quantile(np.abs(off), 0.95) < np.deg2rad(0.5)
    # Not overly modest either.
    assert 1.48 * np.median(np.abs(off / sigmas)) > 0.1


def test_anchoring_keeps_points_in_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """Aligned with first patches, points drift far less than from image to image alone."""
    drift = []
    for loose in (False, True):
        if loose:
            monkeypatch.setattr(f"{_MODULE}._PATCH_NOISE_GREY", 1e6)
            monkeypatch.setattr(f"{_MODULE}._MIN_CORRELATION", -1.0)
        tracker = started(picture(START))
        for k, pose in enumerate(way(20)):
            found = tracker.track(picture(pose), 0.1 * (k + 1))
        drift.append(np.median(np.abs(errors(found, pose, tracker)[:, 0])))
    assert drift[0] < 0.5 * drift[1]


@pytest.mark.parametrize("turn_deg", [40.0, -25.3])
def test_turns_between_two_images(start_image: Image, turn_deg: float) -> None:
    """As large as a turn of 40 degrees at once; points cross the seam of picture and view."""
    tracker = started(start_image)
    pose = START + np.array([0.0, 0.0, np.deg2rad(turn_deg)])
    found = tracker.track(picture(pose), 0.2)
    assert len(found) > 0.95 * len(grid(tracker))
    assert np.abs(errors(found, pose, tracker)).max() < np.deg2rad(0.3)
    back = tracker.track(start_image, 0.4)
    assert np.abs(errors(back, START, tracker)).max() < np.deg2rad(0.3)


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 25.0), (1.3, 0.0)])
def test_tracking_tolerates_gain_and_offset_of_the_image(
    start_image: Image, gain: float, offset: float
) -> None:
    tracker = started(start_image)
    pose = way(1)[0]
    image = np.clip(gain * picture(pose).astype(np.float64) + offset, 0, 255).astype(np.uint8)
    found = tracker.track(image, 0.1)
    assert len(found) > 0.8 * len(grid(tracker))
    assert np.median(np.abs(errors(found, pose, tracker))) < np.deg2rad(0.15)


def test_what_is_covered_is_lost_for_good_and_the_rest_is_not(start_image: Image) -> None:
    tracker = started(start_image)
    covered = start_image.copy()
    covered[:, 200:280] = np.random.default_rng(0).integers(0, 255, (181, 80, 3), dtype=np.uint8)
    found = tracker.track(covered, 0.1)
    columns = grid(tracker)[:, 0]
    behind = np.flatnonzero((columns > 205) & (columns < 275))
    aside = np.flatnonzero((columns < 190) | (columns > 290))
    assert not np.isin(behind, found.ids).any()
    assert np.isin(aside, found.ids).mean() > 0.95
    again = tracker.track(start_image, 0.2)
    assert np.isin(again.ids, found.ids).all()


def test_black_image_loses_all(start_image: Image) -> None:
    tracker = started(start_image)
    dark = tracker.track(np.zeros_like(start_image), 0.1)
    assert len(dark) == len(dark.bearing) == len(dark.sigma_elevation) == 0
    assert len(tracker.track(start_image, 0.2)) == 0
    tracker.add(np.array([900]), np.array([[300.0, 90.0]]))
    assert tracker.track(start_image, 0.3).ids.tolist() == [900]


def test_bad_input(start_image: Image) -> None:
    tracker = BearingTracker(CAMERA)
    with pytest.raises(EstimatorError, match="start"):
        tracker.track(start_image, 0.0)
    with pytest.raises(EstimatorError, match="start"):
        tracker.add(np.array([0]), np.array([[10.0, 90.0]]))
    with pytest.raises(FrameError, match=r"\(181, 601, 3\)"):
        tracker.start(start_image[:-1], 0.0, np.array([0]), np.array([[10.0, 90.0]]))
    tracker = started(start_image)
    tracker.track(start_image, 1.0)
    for time in (1.0, 0.5, np.nan):
        with pytest.raises(EstimatorError, match=r"order|not finite"):
            tracker.track(start_image, time)
    with pytest.raises(FrameError, match="calibration"):
        tracker.track(start_image[:, :-1], 2.0)
    with pytest.raises(FrameError, match="uint8"):
        tracker.track(start_image.astype(np.float32), 2.0)  # type: ignore[arg-type]
    assert len(tracker.track(start_image, 2.0)) > 100


# --------------------------------------------------------------------------------------------
# Points through a recording: lost ones are replaced, none is followed twice


WIDTH, HEIGHT = 361, 121
SMALL = Equirectangular(WIDTH, HEIGHT, np.pi / 3, -np.pi / 3)


def texture() -> Image:
    """Smooth noise that continues over the seam; the last column repeats the first one."""
    noise = np.random.default_rng(5).normal(size=(HEIGHT, WIDTH - 1))
    smooth = ndimage.gaussian_filter(noise, 2.0, mode=("nearest", "wrap"))
    grey = np.clip(128.0 + 40.0 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    return np.repeat(np.column_stack([grey, grey[:, :1]])[:, :, None], 3, axis=2)


def turned(image: Image, columns: int) -> Image:
    """The picture after a turn to the left by so many columns."""
    rolled = np.roll(image[:, :-1], columns, axis=1)
    return np.concatenate([rolled, rolled[:, :1]], axis=1)


def tracker() -> ReplenishedTracker:
    return ReplenishedTracker(SMALL, least=40, most=60)


def test_points_follow_a_turn_and_keep_their_names() -> None:
    image, follower = texture(), tracker()
    first = follower.take(image, 0.0)
    assert len(first.added) == len(first.tracked) == 60
    again = follower.take(turned(image, 7), 0.1)
    assert again.survivors >= 55
    assert len(again.added) == 0
    rows = np.searchsorted(first.tracked.ids, again.tracked.ids)
    change = again.tracked.bearing - first.tracked.bearing[rows]
    change = (change + np.pi) % (2.0 * np.pi) - np.pi
    # Seven columns to the right are seven degrees clockwise.
    np.testing.assert_allclose(np.rad2deg(np.median(change)), -7.0, atol=0.05)


def test_a_blank_image_loses_all_and_new_points_get_new_names() -> None:
    image, follower = texture(), tracker()
    first = follower.take(image, 0.0)
    blank = follower.take(np.zeros_like(image), 0.1)
    assert len(blank.tracked) == blank.survivors == 0
    again = follower.take(image, 0.2)
    assert len(again.tracked) == 60
    assert again.tracked.ids.min() > first.tracked.ids.max()


def test_new_points_keep_away_from_those_there_are() -> None:
    image, follower = texture(), tracker()
    found = follower.take(image, 0.0)
    degrees = np.rad2deg(np.column_stack([found.tracked.bearing, found.tracked.elevation]))
    apart = np.hypot(*(degrees[:, None] - degrees[None]).transpose(2, 0, 1))
    apart[np.diag_indices(len(apart))] = np.inf
    assert apart.min() > 2.5


# --------------------------------------------------------------------------------------------
# From features to trackable points: which point, and where it lies in the target view


POINT_START = np.array([-1.2, 0.4, 0.3])
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
    """(n, 3) on all walls, seen from both poses."""
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-np.pi, np.pi, count)
    rays = np.column_stack([np.cos(bearing), np.sin(bearing), rng.uniform(-0.5, 0.5, count)])
    points = hits(POINT_START, rays)
    return np.asarray(points[np.abs(angles(TARGET, points)[:, 1]) < np.deg2rad(45.0)])


def two_views(points: FloatArray) -> tuple[BearingMatches, tuple[OmniFeatures, OmniFeatures]]:
    """Features as if found exactly at these points; scales go with one over the distance."""
    a, b = angles(POINT_START, points), wrap(angles(TARGET, points))
    a = wrap(a)
    sizes = [
        0.12 / np.linalg.norm(points[:, :2] - pose[:2], axis=1) for pose in (POINT_START, TARGET)
    ]
    return make_matches(np.hstack([a, b]), 1e-4), (
        features_at(a, sizes[0]),
        features_at(b, sizes[1]),
    )


def test_points_of_planar_patches_are_mapped_within_half_a_degree() -> None:
    """On walls: against where the very point that was chosen is seen from the target."""
    matches, features = two_views(wall_points(400, 1))
    rows, pixels, moved = move_to_trackable(view_of(POINT_START), CAMERA, matches, features)
    assert len(rows) > 150
    truth = angles(TARGET, hits(POINT_START, CAMERA.rays(pixels)))
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


def test_a_window_separates_corners_from_edges() -> None:
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
    rows, pixels, _ = move_to_trackable(view_of(POINT_START), CAMERA, matches, features)
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
    seen = wrap(angles(POINT_START, wall_points(30, 5)))
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
    rows, _, moved = move_to_trackable(
        view_of(POINT_START), CAMERA, matches, (segments[0], segments[1])
    )
    assert len(rows) > 10
    np.testing.assert_allclose(
        wrap(moved.bearing_b - matches.bearing_b[rows]),
        2.0 * wrap(moved.bearing_a - matches.bearing_a[rows]),
        atol=1e-9,
    )


_FIELDS = (
    "index_a", "index_b", "bearing_a", "elevation_a", "bearing_b", "elevation_b", "sigma", "quality"
)  # fmt: skip
