"""Tracking and the choice of trackable points in the rendered house, against its truth."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.bearings import BearingMatches
from fgslam.core.geometry import wrap
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.homing.tracking import BearingTracker, move_to_trackable
from fgslam.frontend.homing.two_view import match_features
from fgslam.frontend.settings import OmniFeatureSettings, OmniMatchingSettings
from fgslam.worlds.house import CAMERA_HEIGHT_M, OmniWorld
from fgslam.worlds.settings import HousePathSettings, OmniHouseSettings

STEPS = 20


class Leg:
    """Images on the way to a target, and where its points really are."""

    def __init__(self) -> None:
        path = HousePathSettings(legs=1, spacing_m=2.0)
        self.world = OmniWorld(OmniHouseSettings(path=path), 1)
        self.start, self.target = self.world.reference_poses[:2]
        self.images = []
        way = self.target[:2] - self.start[:2]
        self.poses = []
        for k in range(STEPS + 1):
            turn = self.start[2] + 0.3 * np.sin(0.3 * k)
            self.poses.append(np.array([*(self.start[:2] + way * (0.02 * k)), turn]))
            self.world.put(self.poses[-1])
            self.images.append(self.world.image(0.1 * k))
        self.tracker = BearingTracker(self.world.camera)

    def matched(
        self, other: Image
    ) -> tuple[BearingMatches, BearingMatches, FloatArray, FloatArray]:
        """Matches with another image, the same moved to trackable points, and their places."""
        extractor = OmniFeatureExtractor(self.world.camera, OmniFeatureSettings())
        features = extractor.extract(self.images[0]), extractor.extract(other)
        matches = match_features(*features, OmniMatchingSettings())
        stabilised = self.tracker.stabilised
        rows, pixels, moved = move_to_trackable(
            stabilised.grey(self.images[0]), stabilised.view, matches, features
        )
        found = self.world.camera.pixels(stabilised.view.rays(pixels))
        return matches.select(rows), moved, pixels, self.world.points(self.poses[0], found)

    def angles(self, pose: FloatArray, points: FloatArray) -> FloatArray:
        """(n, 2) true bearing and elevation of points (n, 3)."""
        away = points - np.array([*pose[:2], CAMERA_HEIGHT_M])
        bearing = np.arctan2(away[:, 1], away[:, 0]) - pose[2]
        return np.column_stack([bearing, np.arctan2(away[:, 2], np.hypot(*away[:, :2].T))])


@pytest.fixture(scope="module")
def leg() -> Leg:
    return Leg()


def test_tracked_bearings_and_their_sigmas(leg: Leg) -> None:
    _, _, pixels, points = leg.matched(leg.world.targets[0])
    leg.tracker.start(leg.images[0], 0.0, np.arange(len(pixels)), pixels)
    for k in range(1, STEPS + 1):
        found = leg.tracker.track(leg.images[k], 0.1 * k)
        truth = leg.angles(leg.poses[k], points[found.ids])
        off = wrap(np.column_stack([found.bearing, found.elevation]) - truth)
        sigma = np.column_stack([found.sigma_bearing, found.sigma_elevation])
    assert len(found) > 0.7 * len(pixels)
    # After 0.8 m and turns of 17 degrees.
    assert np.median(np.abs(off)) < np.deg2rad(0.15)
    # Some corners are where a near thing ends before a far one: no place is true of them.
    within = np.abs(off) < 2.0 * sigma
    assert np.mean(within) > 0.8
    assert 0.15 < 1.48 * np.median(np.abs(off / sigma)) < 1.0


def test_mapped_bearings_of_true_matches(leg: Leg) -> None:
    """From a target half a metre off, under other light."""
    pose = leg.poses[STEPS // 2]
    matches, moved, pixels, points = leg.matched(leg.world.picture(pose, 7))
    truth = leg.angles(pose, points)
    features = leg.world.points(leg.poses[0], camera_pixels(leg, matches))
    right = np.abs(wrap(matches.bearing_b - leg.angles(pose, features)[:, 0])) < np.deg2rad(1.5)
    assert right.sum() > 40
    off = wrap(np.column_stack([moved.bearing_b, moved.elevation_b]) - truth)[right]
    assert len(pixels) == len(moved)
    assert np.median(np.abs(off[:, 0])) < np.deg2rad(0.5)
    assert np.median(np.abs(off[:, 1])) < np.deg2rad(0.5)
    assert np.mean(np.abs(off) < 3.0 * moved.sigma[right, 2:]) > 0.85


def camera_pixels(leg: Leg, matches: BearingMatches) -> FloatArray:
    """(n, 2) where the start image shows the features."""
    level = np.column_stack([np.cos(matches.bearing_a), np.sin(matches.bearing_a)])
    return leg.world.camera.pixels(np.column_stack([level, np.tan(matches.elevation_a)]))
