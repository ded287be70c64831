"""Matches spoiled on purpose: as many as asked for, the same for a seed, no feature twice."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[3]))

from benchmarks.evidence.false_matches import EVERY_FRAME, KINDS, FalseMatches, Kind, drive
from benchmarks.runs import experiment, find_features
from fgslam.core.types import StereoFeatures
from fgslam.frontend.tracking.map_matching import MapMatches

LAB = experiment("lab_loop")
MATCHED = 500
FEATURES = 800


def _scene() -> tuple[MapMatches, StereoFeatures]:
    rng = np.random.default_rng(3)
    many = StereoFeatures.empty().join(
        StereoFeatures(
            measurement=rng.uniform(0.0, 200.0, (FEATURES, 3)),
            measurement_covariance=np.tile(np.eye(3), (FEATURES, 1, 1)),
            scale=np.ones(FEATURES),
            orientation=np.zeros(FEATURES),
            descriptors=np.zeros((FEATURES, 128), np.uint8),
            position=np.ones((FEATURES, 3)),
            position_covariance=np.tile(np.eye(3), (FEATURES, 1, 1)),
            pixels=np.zeros((FEATURES, 3, 2)),
        )
    )
    features = rng.permutation(FEATURES)[:MATCHED]
    return MapMatches(np.arange(MATCHED), features, np.ones(FEATURES, np.bool_)), many


@pytest.mark.parametrize("kind", KINDS)
def test_so_many_matches_are_false_and_no_feature_is_used_twice(kind: Kind) -> None:
    found, features = _scene()
    spoiled = FalseMatches(LAB, 0.2, kind, 0).spoiled(found, features)
    changed = spoiled.features != found.features
    # 100 of 500 are expected; four standard deviations of a binomial.
    assert abs(int(changed.sum()) - 100) <= 36
    assert len(np.unique(spoiled.features)) == MATCHED
    assert not np.isin(spoiled.features[changed], found.features).any()
    again = FalseMatches(LAB, 0.2, kind, 0).spoiled(found, features)
    np.testing.assert_array_equal(again.features, spoiled.features)
    other = FalseMatches(LAB, 0.2, kind, 1).spoiled(found, features)
    assert (other.features != spoiled.features).any()


def test_nearest_is_the_nearest_that_nothing_matched() -> None:
    found, features = _scene()
    spoiled = FalseMatches(LAB, 0.1, "nearest", 0).spoiled(found, features)
    k = np.flatnonzero(spoiled.features != found.features)[0]
    free = np.setdiff1d(np.arange(FEATURES), found.features)
    away = features.measurement[free, :2] - features.measurement[found.features[k], :2]
    assert spoiled.features[k] == free[np.hypot(*away.T).argmin()]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_drive_withstands_a_fifth_of_false_matches(kind: Kind) -> None:
    """ATE may double; 30 frames, of which nothing is lost; and the drive is not the clean one."""
    config = experiment("lab_loop", [EVERY_FRAME, "dataset.stop=30"])
    found = find_features(config)
    clean, spoiled = (drive(found, config, (share, kind, 0)) for share in (0.0, 0.2))
    assert spoiled.located == clean.located == 30
    assert clean.ate_cm != spoiled.ate_cm <= 2.0 * clean.ate_cm
    assert clean.right > 0.95
    assert spoiled.right >= clean.right - 0.05
