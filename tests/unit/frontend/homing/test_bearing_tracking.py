"""Tracking on a stabilised view: accuracy against truth, turns, light, loss, bad input."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import EstimatorError, FrameError
from fgslam.core.homing import TrackedBearings
from fgslam.core.planar import wrap
from fgslam.frontend.homing.tracking import BearingTracker, ReplenishedTracker
from tests.textured_room import CAMERA, angles, hits, picture

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
    for k, pose in enumerate(way(24)):
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
        for k, pose in enumerate(way(30)):
            found = tracker.track(picture(pose), 0.1 * (k + 1))
        drift.append(np.median(np.abs(errors(found, pose, tracker)[:, 0])))
    assert drift[0] < 0.5 * drift[1]


@pytest.mark.parametrize("turn_deg", [40.0, -40.0, 25.3])
def test_turns_between_two_images(start_image: Image, turn_deg: float) -> None:
    """As large as a turn of 40 degrees at once; points cross the seam of picture and view."""
    tracker = started(start_image)
    pose = START + np.array([0.0, 0.0, np.deg2rad(turn_deg)])
    found = tracker.track(picture(pose), 0.2)
    assert len(found) > 0.95 * len(grid(tracker))
    assert np.abs(errors(found, pose, tracker)).max() < np.deg2rad(0.3)
    back = tracker.track(start_image, 0.4)
    assert np.abs(errors(back, START, tracker)).max() < np.deg2rad(0.3)


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 25.0), (1.3, 0.0), (0.8, -15.0)])
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


def test_more_deformed_points_are_less_sure(start_image: Image) -> None:
    tracker = started(start_image)
    first = tracker.bearings().sigma_bearing
    assert np.ptp(first) == 0.0
    for k, pose in enumerate(way(12)):
        found = tracker.track(picture(pose), 0.1 * (k + 1))
    assert found.sigma_bearing.min() >= first[0]
    assert np.median(found.sigma_bearing) > 1.2 * first[0]


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


def test_same_input_same_bytes_and_arguments_untouched(start_image: Image) -> None:
    runs = []
    for _ in range(2):
        images = [start_image.copy(), *(picture(pose) for pose in way(3))]
        before = [image.copy() for image in images]
        tracker = BearingTracker(CAMERA)
        pixels, ids = grid(tracker), np.arange(len(grid(tracker)))
        kept = pixels.copy(), ids.copy()
        tracker.start(images[0], 0.0, ids, pixels)
        runs.append([tracker.track(image, 0.1 * k + 0.1) for k, image in enumerate(images[1:])])
        np.testing.assert_array_equal(pixels, kept[0])
        np.testing.assert_array_equal(ids, kept[1])
        for image, was in zip(images, before, strict=True):
            np.testing.assert_array_equal(image, was)
    for one, other in zip(*runs, strict=True):
        assert one.bearing.tobytes() == other.bearing.tobytes()
        assert one.elevation.tobytes() == other.elevation.tobytes()
        assert one.ids.tolist() == other.ids.tolist()


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
    anew = follower.take(image, 0.2)
    assert len(anew.tracked) == 60
    assert anew.tracked.ids.min() > first.tracked.ids.max()


def test_new_points_keep_away_from_those_there_are() -> None:
    image, follower = texture(), tracker()
    found = follower.take(image, 0.0)
    degrees = np.rad2deg(np.column_stack([found.tracked.bearing, found.tracked.elevation]))
    apart = np.hypot(*(degrees[:, None] - degrees[None]).transpose(2, 0, 1))
    apart[np.diag_indices(len(apart))] = np.inf
    assert apart.min() > 2.5
