"""The bearing log: exact round trip, damage refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from homings import trial

from fgslam.core.arrays import StateArrays
from fgslam.core.bearings import BearingLog
from fgslam.core.errors import MeasurementLogError


@pytest.fixture(scope="module")
def log() -> BearingLog:
    case = trial(3)
    return BearingLog(case.start, list(case.tracks), case.truth, {"seed": 3, "what": "simulated"})


@pytest.mark.parametrize("truth", [True, False])
def test_round_trip_is_exact(log: BearingLog, tmp_path: Path, truth: bool) -> None:
    whole = BearingLog(log.start, log.images, log.truth if truth else None, log.provenance)
    path = tmp_path / "bearings.npz"
    arrays = whole.to_arrays()
    np.savez(path, **arrays)
    back = BearingLog.load(path)
    again = back.to_arrays()
    assert list(again) == list(arrays)
    for name, array in arrays.items():
        assert again[name].dtype == array.dtype
        assert again[name].tobytes() == array.tobytes(), name
    assert back.provenance == log.provenance
    assert (back.truth is not None) == truth
    assert [len(image) for image in back.images] == [len(image) for image in log.images]


def without(arrays: StateArrays, name: str) -> StateArrays:
    return {key: value for key, value in arrays.items() if key != name}


def test_every_missing_or_damaged_array_is_refused(log: BearingLog) -> None:
    arrays = log.to_arrays()
    for name, array in arrays.items():
        with pytest.raises(MeasurementLogError):
            BearingLog.from_arrays(without(arrays, name), "a.npz")
        if name != "header":
            with pytest.raises(MeasurementLogError, match=name):
                BearingLog.from_arrays(arrays | {name: array.astype(np.complex128)}, "a.npz")


def test_disorder_is_refused(log: BearingLog) -> None:
    arrays = log.to_arrays()
    start = arrays["image_start"].copy()
    start[1], start[2] = start[2] + 1, start[1]
    with pytest.raises(MeasurementLogError, match="image_start is absent or damaged"):
        BearingLog.from_arrays(arrays | {"image_start": start}, "a.npz")
    with pytest.raises(MeasurementLogError, match="do not increase"):
        BearingLog.from_arrays(arrays | {"image_time": arrays["image_time"][::-1]}, "a.npz")


def test_foreign_and_truncated_files_are_refused(log: BearingLog, tmp_path: Path) -> None:
    arrays = log.to_arrays()
    other = arrays | {"header": np.array('{"format": "fgslam measurement log", "version": 2}')}
    with pytest.raises(MeasurementLogError, match="not an fgslam bearing log"):
        BearingLog.from_arrays(other, "a.npz")
    new = arrays | {"header": np.array('{"format": "fgslam bearing log", "version": 9}')}
    with pytest.raises(MeasurementLogError, match="made by another version"):
        BearingLog.from_arrays(new, "a.npz")
    path = tmp_path / "bearings.npz"
    np.savez(path, **arrays)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(MeasurementLogError, match=r"bearings\.npz"):
        BearingLog.load(path)
    with pytest.raises(MeasurementLogError, match="no such file"):
        BearingLog.load(tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("image_bearing", np.nan, "array image_bearing is not finite"),
        ("image_sigma_bearing", 0.0, "a deviation of a bearing is not positive"),
        ("vector_covariance", -1.0, "array vector_covariance, row 0, is no covariance"),
        ("start_time", np.nan, "array start_time is not finite"),
    ],
)
def test_values_that_no_homing_measures_are_refused(
    log: BearingLog, name: str, value: float, words: str
) -> None:
    arrays = log.to_arrays()
    spoilt = arrays[name].copy()
    spoilt[...] = value
    with pytest.raises(MeasurementLogError, match=f"a.npz: {words}"):
        BearingLog.from_arrays(arrays | {name: spoilt}, "a.npz")


def test_a_feature_that_one_image_has_twice_is_refused(log: BearingLog) -> None:
    arrays = log.to_arrays()
    ids = arrays["image_ids"].copy()
    ids[1] = ids[0]
    with pytest.raises(MeasurementLogError, match=f"image_ids holds {ids[0]} twice in part 0"):
        BearingLog.from_arrays(arrays | {"image_ids": ids}, "a.npz")
