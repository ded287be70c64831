"""Points through a recording: lost ones are replaced, none is followed twice."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from fgslam.cameras.omni.panoramas import Equirectangular
from fgslam.core.arrays import Image
from fgslam.frontend.homing.bearing_tracking import ReplenishedTracker

WIDTH, HEIGHT = 361, 121
CAMERA = Equirectangular(WIDTH, HEIGHT, np.pi / 3, -np.pi / 3)


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
    return ReplenishedTracker(CAMERA, least=40, most=60)


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
