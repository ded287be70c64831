"""What every homing estimator promises (fgslam/backend/homing/parts.py)."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import replace

import numpy as np
import pytest
from homings import Trial, trial

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.backend.homing.parts import HomingEstimator
from fgslam.backend.settings import (
    AverageLandmarkVectorSettings,
    HomingEkfSettings,
    HomingEstimatorSettings,
    HomingGraphSettings,
    PaperEkfSettings,
    SnapshotSettings,
)
from fgslam.core.bearings import HomingEstimate, TrackedBearings
from fgslam.core.errors import EstimatorError
from fgslam.worlds.settings import SimulatedBearingsSettings

EVERY: list[HomingEstimatorSettings] = [
    PaperEkfSettings(),
    HomingEkfSettings(),
    HomingGraphSettings(),
    HomingGraphSettings(solver="batch", label="batch"),
    AverageLandmarkVectorSettings(),
    SnapshotSettings(),
]
MAPPING = EVERY[:4]
SETTINGS = SimulatedBearingsSettings(images_per_s=4.0, part=0.6, lost_per_s=0.1)


@pytest.fixture(scope="module")
def case() -> Trial:
    return trial(11, SETTINGS)


every_kind = pytest.mark.parametrize("settings", EVERY, ids=lambda s: s.title)
every_map = pytest.mark.parametrize("settings", MAPPING, ids=lambda s: s.title)


def started(case: Trial, settings: HomingEstimatorSettings, images: int) -> HomingEstimator:
    estimator = make_homing_estimator(case.start, settings)
    for image in case.tracks[:images]:
        estimator.update(image)
    return estimator


def contents(value: object) -> list[bytes]:
    """All arrays within nested dataclasses, as bytes."""
    if dataclasses.is_dataclass(value):
        names = [f.name for f in dataclasses.fields(value)]
        return [part for name in names for part in contents(getattr(value, name))]
    return [np.asarray(value).tobytes()]


def nothing(time: float) -> TrackedBearings:
    none = np.empty(0)
    return TrackedBearings(time, np.empty(0, np.int64), none, none, none, none)


@every_kind
def test_time_must_increase_and_leaves_the_state(
    case: Trial, settings: HomingEstimatorSettings
) -> None:
    estimator = started(case, settings, 3)
    before = contents(estimator.estimate())
    with pytest.raises(EstimatorError, match="does not come after"):
        estimator.update(case.tracks[2])
    assert contents(estimator.estimate()) == before
    estimator.update(case.tracks[3])
    assert estimator.estimate().time == case.tracks[3].time


@every_kind
def test_unknown_identities_are_refused(case: Trial, settings: HomingEstimatorSettings) -> None:
    estimator = started(case, settings, 2)
    before = contents(estimator.estimate())
    image = case.tracks[2]
    with pytest.raises(EstimatorError, match="is not in the local map"):
        estimator.update(replace(image, ids=image.ids + 1000))
    with pytest.raises(EstimatorError, match="no finite bearing"):
        estimator.update(replace(image, bearing=np.full(len(image), np.nan)))
    assert contents(estimator.estimate()) == before


@every_kind
def test_arguments_are_not_mutated_and_answers_repeat(
    case: Trial, settings: HomingEstimatorSettings
) -> None:
    before = contents(case.start), [contents(image) for image in case.tracks]
    first = started(case, settings, len(case.tracks))
    assert (contents(case.start), [contents(image) for image in case.tracks]) == before
    once = contents(first.estimate())
    assert contents(first.estimate()) == once
    assert contents(started(case, settings, len(case.tracks)).estimate()) == once


@every_kind
def test_home_is_found(case: Trial, settings: HomingEstimatorSettings) -> None:
    home = started(case, settings, len(case.tracks)).estimate().home()
    robot = case.truth.robots[-1]
    offset = case.truth.target[:2] - robot[:2]
    direction = np.arctan2(offset[1], offset[0]) - robot[2]
    limit = 25.0 if settings.kind in ("alv", "snapshot", "paper_ekf") else 6.0
    assert abs(np.rad2deg(home.direction - direction)) < limit
    if settings in MAPPING and settings.kind != "paper_ekf":
        assert home.distance == pytest.approx(np.hypot(*offset) / case.truth.leg_m, abs=0.04)


@every_map
def test_lost_features_leave_for_good(case: Trial, settings: HomingEstimatorSettings) -> None:
    estimator = started(case, settings, 2)
    image = case.tracks[2]
    kept = image.ids[::2]
    estimator.update(image.select(np.isin(image.ids, kept)))
    left = estimator.estimate().ids
    assert len(left) > 5
    assert np.isin(left, kept).all()
    estimator.update(case.tracks[3])
    assert np.isin(estimator.estimate().ids, kept).all()


@every_map
def test_without_features_the_robot_goes_on_with_growing_uncertainty(
    case: Trial, settings: HomingEstimatorSettings
) -> None:
    estimator = started(case, settings, 8)
    last = case.tracks[7].time
    estimates: list[HomingEstimate] = [estimator.estimate()]
    for k in range(1, 5):
        estimator.update(nothing(last + 0.25 * k))
        estimates.append(estimator.estimate())
    spread = [np.trace(e.covariance[:2, :2]) for e in estimates]
    assert (np.diff(spread) > 0.0).all()
    assert len(estimates[-1].ids) == 0
    moved = [np.hypot(*(b.robot - a.robot)[:2]) for a, b in itertools.pairwise(estimates)]
    assert all(0.5 < length / moved[0] < 2.0 for length in moved)
    # A graph goes on converging, by less than what it knows.
    sigma = np.sqrt(np.diagonal(estimates[0].covariance)[3:])
    assert (np.abs(estimates[-1].target - estimates[0].target) <= 0.3 * sigma + 1e-4).all()


@every_map
def test_covariances_are_symmetric_and_positive(
    case: Trial, settings: HomingEstimatorSettings
) -> None:
    estimate = started(case, settings, len(case.tracks)).estimate()
    np.testing.assert_allclose(estimate.covariance, estimate.covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(estimate.covariance).min() > -1e-10
    assert np.linalg.eigvalsh(estimate.landmark_covariances).min() > -1e-10
    assert estimate.landmarks.shape == (len(estimate.ids), 2)


@every_map
def test_features_without_elevations_are_estimated_by_their_bearings(
    case: Trial, settings: HomingEstimatorSettings
) -> None:
    """A height that no view shows is no variable; the others keep theirs."""
    matches = case.start.matches
    unknown = np.arange(len(matches)) % 2 == 0
    up = [np.where(unknown, np.nan, e) for e in (matches.elevation_a, matches.elevation_b)]
    some = replace(matches, elevation_a=up[0], elevation_b=up[1])
    estimator = make_homing_estimator(replace(case.start, matches=some), settings)
    for image in case.tracks:
        estimator.update(image)
    found = estimator.estimate()
    assert np.isfinite(found.covariance).all()
    assert len(found.ids) > 0
    assert np.isfinite(found.landmark_covariances).all()


def test_start_must_fit_together(case: Trial) -> None:
    start = replace(case.start, matches=case.start.matches.select(np.arange(3)))
    with pytest.raises(EstimatorError, match="3 matches for"):
        make_homing_estimator(start, HomingEkfSettings())
