"""Folders of measurements as recordings: the folder of a run, whole and in part, and damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fgslam.core.errors import ConfigError, DatasetError, MeasurementLogError
from fgslam.core.log import MeasurementLog, MeasurementRecording
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import (
    ConstantVelocitySettings,
    MeasurementFilesSettings,
    SyntheticOdometrySettings,
)
from fgslam.runs.tasks.slam_measurements import write_log_and_truth
from fgslam.worlds.settings import SimulatedMeasurementsSettings


@pytest.fixture
def simulated() -> MeasurementRecording:
    return open_measurements(SimulatedMeasurementsSettings(stop=12), 0)


@pytest.fixture
def folder(simulated: MeasurementRecording, tmp_path: Path) -> Path:
    write_log_and_truth(tmp_path, simulated)
    return tmp_path


def settings(folder: Path, stop: int | None = None) -> MeasurementFilesSettings:
    return MeasurementFilesSettings(path=str(folder), stop=stop)


@pytest.mark.parametrize("stop", [None, 5, 100])
def test_a_run_s_measurements_are_a_recording(
    simulated: MeasurementRecording, folder: Path, stop: int | None
) -> None:
    found = open_measurements(settings(folder, stop), 0)
    expected = simulated.log.increments[:stop]
    assert len(found.log) == len(expected)
    for a, b in zip(found.log, expected, strict=True):
        np.testing.assert_array_equal(a.observations.ids, b.observations.ids)
        np.testing.assert_array_equal(a.observations.measurement, b.observations.measurement)
    assert found.log.motion_model == simulated.log.motion_model
    assert found.ground_truth is not None
    assert simulated.ground_truth is not None
    true = simulated.ground_truth.poses[: len(expected)]
    np.testing.assert_allclose(found.ground_truth.poses, true, atol=1e-11)
    assert found.landmark_truth is not None
    assert simulated.landmark_truth is not None
    np.testing.assert_array_equal(found.landmark_truth.ids, simulated.landmark_truth.ids)


def test_truth_is_optional_and_its_content_is_part_of_the_identity(folder: Path) -> None:
    whole = open_measurements(settings(folder), 0)
    for path in folder.glob("ground_truth*"):
        path.unlink()
    bare = open_measurements(settings(folder), 0)
    assert bare.ground_truth is None
    assert bare.landmark_truth is None
    assert bare.identity != whole.identity


def test_odometry_may_be_left_out_but_not_made(folder: Path) -> None:
    velocity = open_measurements(settings(folder), 0, ConstantVelocitySettings())
    assert all(increment.odometry is None for increment in velocity.log)
    with pytest.raises(ConfigError, match="needs a recording of images"):
        open_measurements(settings(folder), 0, SyntheticOdometrySettings())


@pytest.mark.parametrize("selection", [{"start": 1}, {"stride": 2}])
def test_frames_without_those_before_them_are_refused(
    folder: Path, selection: dict[str, int]
) -> None:
    part = MeasurementFilesSettings(path=str(folder), **selection)
    with pytest.raises(ConfigError, match=r"set dataset\.stop alone"):
        open_measurements(part, 0)


def test_an_absent_folder_a_damaged_and_an_empty_log_are_refused(folder: Path) -> None:
    with pytest.raises(DatasetError, match=r"does not exist; check dataset\.path"):
        open_measurements(settings(folder / "absent"), 0)
    log = MeasurementLog.load(folder / "measurements.npz")
    (folder / "measurements.npz").write_bytes(b"no log")
    with pytest.raises(MeasurementLogError):
        open_measurements(settings(folder), 0)
    MeasurementLog(log.rig, log.motion_model).save(folder / "measurements.npz")
    with pytest.raises(DatasetError, match="has no frame at all"):
        open_measurements(settings(folder), 0)
