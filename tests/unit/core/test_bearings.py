"""The bearing log keeps every bit, and what no homing measures is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from homings import trial
from simulated import assert_same_value

from fgslam.core.bearings import BearingLog, among
from fgslam.core.errors import MeasurementLogError


@pytest.fixture
def log() -> BearingLog:
    case = trial(3)
    return BearingLog(case.start, list(case.tracks), case.truth, {"seed": 3, "what": "simulated"})


@pytest.mark.parametrize("truth", [True, False])
def test_every_bit_survives(log: BearingLog, tmp_path: Path, truth: bool) -> None:
    log.truth = log.truth if truth else None
    log.save(tmp_path / "bearings.npz")
    assert_same_value(BearingLog.load(tmp_path / "bearings.npz"), log)


def start_at_nan(log: BearingLog) -> None:
    log.start = replace(log.start, time=np.nan)


def negative_covariance(log: BearingLog) -> None:
    log.start = replace(log.start, vector=replace(log.start.vector, covariance=-np.eye(2)))


def nan_bearing(log: BearingLog) -> None:
    log.images[1] = replace(log.images[1], bearing=log.images[1].bearing * np.nan)


def no_deviation(log: BearingLog) -> None:
    log.images[1] = replace(log.images[1], sigma_bearing=log.images[1].sigma_bearing * 0.0)


def one_twice(log: BearingLog) -> None:
    log.images[1] = replace(log.images[1], ids=log.images[1].ids * 0)


def one_too_few(log: BearingLog) -> None:
    log.images[1] = replace(log.images[1], bearing=log.images[1].bearing[1:])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (start_at_nan, "times of the images: a number is not finite"),
        (negative_covariance, "vector: number 0 is no covariance"),
        (nan_bearing, "bearings of image 1: a number is not finite"),
        (no_deviation, "image 1: a deviation of a bearing is no positive number"),
        (one_twice, "image 1 shows a feature twice"),
        (one_too_few, "image 1: its arrays differ in length"),
        (lambda log: log.images.reverse(), "times of the images is out of order"),
    ],
)
def test_values_that_no_homing_measures_are_refused(
    log: BearingLog, tmp_path: Path, spoil: Callable[[BearingLog], None], words: str
) -> None:
    spoil(log)
    log.save(tmp_path / "a.npz")
    with pytest.raises(MeasurementLogError, match=rf"a\.npz: {words}; run again"):
        BearingLog.load(tmp_path / "a.npz")


@pytest.mark.parametrize("seed", [0, 1, 7, 12, 19])
def test_identities_are_looked_up(seed: int) -> None:
    """Beyond either end, none, all, and with none to look up or to be found."""
    rng = np.random.default_rng(seed)
    ids = rng.integers(0, 30, seed)
    others = np.unique(rng.integers(5, 25, (3 * seed) % 25))
    np.testing.assert_array_equal(among(ids, others), np.isin(ids, others))
