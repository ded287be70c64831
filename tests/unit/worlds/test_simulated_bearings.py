"""Simulated homings: geometry, noise, and outliers as the settings say."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from fgslam.core.geometry import bearings, wrap
from fgslam.worlds.settings import SimulatedBearingsSettings
from fgslam.worlds.simulated_bearings import (
    NO_OUTLIERS,
    HomingOutliers,
    SimulatedHoming,
    simulate_homing,
)

CLEAN = SimulatedBearingsSettings(features=200, lost_per_s=0.0)


def simulate(
    settings: SimulatedBearingsSettings, seed: int = 0, outliers: HomingOutliers = NO_OUTLIERS
) -> SimulatedHoming:
    return simulate_homing(settings, np.random.default_rng(seed), outliers)


def test_same_seed_same_bytes() -> None:
    settings, some = SimulatedBearingsSettings(), HomingOutliers.of_all(0.2)
    one, other = simulate(settings, 4, some), simulate(settings, 4, some)
    assert one.matches.bearing_b.tobytes() == other.matches.bearing_b.tobytes()
    assert one.truth.robots.tobytes() == other.truth.robots.tobytes()
    for a, b in zip(one.tracks, other.tracks, strict=True):
        assert a.bearing.tobytes() == b.bearing.tobytes()


def test_noise_is_as_stated() -> None:
    homing = simulate(CLEAN)
    truth, matches = homing.truth, homing.matches
    errors = [wrap(matches.bearing_a - bearings(np.zeros(3), truth.landmarks))]
    errors.append(wrap(matches.bearing_b - bearings(truth.target, truth.landmarks)))
    for image, robot in zip(homing.tracks, truth.robots, strict=True):
        errors.append(wrap(image.bearing - bearings(robot, truth.landmarks[image.ids])))
    scaled = np.concatenate(errors) / np.deg2rad(1.0)
    assert np.std(scaled) == pytest.approx(1.0, abs=0.03)
    assert abs(np.mean(scaled)) < 0.03
    np.testing.assert_array_equal(matches.sigma, np.deg2rad(1.0))


@pytest.mark.parametrize("part", [0.8])
def test_drive_ends_after_its_part_of_the_way(part: float) -> None:
    homing = simulate(replace(CLEAN, part=part))
    left = np.linalg.norm(homing.truth.target[:2] - homing.truth.robots[:, :2], axis=1)
    assert left[-1] <= (1.0 - part) * 2.0 < left[-2]
    assert homing.truth.leg_m == pytest.approx(2.0)
    assert np.ptp(homing.truth.robots[:, 2]) > np.deg2rad(3.0)  # the way is curved


def test_outliers_have_the_configured_share() -> None:
    homing = simulate(CLEAN, outliers=HomingOutliers(wrong_matches=0.2, jumping_tracks=0.3))
    assert len(homing.matches) == 250
    assert np.count_nonzero(~homing.correct) == 50
    assert np.isnan(homing.truth.landmarks[~homing.correct]).all()
    rows = np.flatnonzero(homing.correct)
    image, robot = homing.tracks[-1], homing.truth.robots[-1]
    error = wrap(image.bearing[rows] - bearings(robot, homing.truth.landmarks[rows]))
    off = np.abs(error) > np.deg2rad(4.0)
    assert np.mean(off) == pytest.approx(0.3, abs=0.08)
    before = homing.tracks[-2]
    stays = np.abs(wrap(before.bearing[rows] - image.bearing[rows])) < np.deg2rad(8.0)
    assert np.mean(stays[off]) > 0.9


def test_gross_bearings_last_one_image() -> None:
    homing = simulate(CLEAN, outliers=HomingOutliers(gross_bearings=0.3))
    off = [
        np.abs(wrap(image.bearing - bearings(robot, homing.truth.landmarks))) > np.deg2rad(5.0)
        for image, robot in zip(homing.tracks, homing.truth.robots, strict=True)
    ]
    assert np.mean(off) == pytest.approx(0.3 * 350 / 360, abs=0.02)
    assert np.mean(np.array(off)[1:] & np.array(off)[:-1]) == pytest.approx(0.09, abs=0.02)


def test_lost_features_do_not_come_back() -> None:
    homing = simulate(replace(CLEAN, lost_per_s=0.2))
    kept = [set(image.ids.tolist()) for image in homing.tracks]
    assert all(later <= earlier for earlier, later in itertools.pairwise(kept))
    seconds = homing.tracks[-1].time
    assert len(kept[-1]) / 200 == pytest.approx(np.exp(-0.2 * seconds), abs=0.1)


def test_following_renumbers_tracks_and_truth() -> None:
    homing = simulate(replace(CLEAN, features=20, lost_per_s=0.1))
    rows = np.array([1, 4, 5, 17])
    tracks, truth = homing.followed(rows)
    np.testing.assert_array_equal(truth.landmarks, homing.truth.landmarks[rows])
    for image, whole in zip(tracks, homing.tracks, strict=True):
        np.testing.assert_array_equal(rows[image.ids], np.intersect1d(rows, whole.ids))
        at = np.searchsorted(whole.ids, rows[image.ids])
        np.testing.assert_array_equal(image.bearing, whole.bearing[at])
