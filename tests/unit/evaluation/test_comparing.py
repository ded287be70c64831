"""Estimators side by side as a data frame."""

from __future__ import annotations

import numpy as np
import pytest
from reports import landmark_map, loop
from simulated import RIG, Drive, simulate

from fgslam.backend.settings import DeadReckoningSettings, EkfSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError
from fgslam.core.estimates import Estimate, Trajectory
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.recordings import LandmarkTruth
from fgslam.evaluation.judging import COLUMNS, Answer, compare
from fgslam.runs.library import replay


def estimate(shift_m: float, frames: int = 40) -> Estimate:
    """The loop with the later half of it shifted sideways, and a covariance of that size."""
    truth = loop(frames)
    poses = truth.poses.copy()
    poses[frames // 2 :, 0, 3] += shift_m
    covariances = np.tile(0.05**2 * np.eye(6), (frames, 1, 1))
    landmarks = landmark_map(12, np.random.default_rng(0))
    return Estimate(Trajectory(truth.timestamps, poses), covariances, landmarks)


def with_times(found: Estimate, update_ms: FloatArray) -> Answer:
    nothing = np.full(len(update_ms), np.nan)
    dof = np.zeros(len(update_ms), np.int64)
    return Answer(found, found.trajectory, found.covariances, nothing, dof, update_ms)


def test_each_estimator_has_a_row_in_the_order_given() -> None:
    table = compare({"worse": estimate(0.4), "better": estimate(0.1)}, loop(40), full=True)
    assert table.index.tolist() == ["worse", "better"]
    assert table.columns.tolist() == [name for name, _ in COLUMNS]
    assert table.loc["better", "ate_m"] == pytest.approx(table.loc["worse", "ate_m"] / 4, rel=0.05)
    assert table.loc["worse", "end_error_m"] == pytest.approx(0.4)
    assert table.loc["worse", "frames"] == 40
    assert table["failure"].tolist() == ["", ""]


def test_what_a_person_compares_fits_a_terminal() -> None:
    table = compare({"landmark_kalman": estimate(0.4), "isam2": estimate(0.1)}, loop(40))
    assert table.columns.tolist() == ["ate_m", "rpe_trans_m", "rpe_rot_deg", "nees", "ms"]
    assert max(map(len, table.to_string().splitlines())) <= 80


def test_a_failure_is_never_left_out() -> None:
    log = MeasurementLog(RIG, {}, simulate(Drive(frames=6), np.random.default_rng(4)).increments)
    answers = {
        "ends": replay(log, EkfSettings(max_landmarks=3)),
        "goes_on": replay(log, DeadReckoningSettings()),
    }
    table = compare(answers)
    assert table.columns[-1] == "failure"
    assert table.loc["ends", "failure"].startswith("frame ")
    assert table.loc["goes_on", "failure"] == ""


def test_consistency_follows_the_size_of_the_error() -> None:
    table = compare({"sure": estimate(2.0), "right": estimate(0.05)}, loop(40), full=True)
    assert table["consistency"].tolist()[0] == "overconfident"
    assert table.loc["sure", "nees"] > 100.0 * table.loc["right", "nees"]


def test_times_and_online_poses_come_from_the_answer() -> None:
    answer = with_times(estimate(0.1), np.linspace(1.0, 40.0, 40))
    table = compare({"timed": answer, "untimed": estimate(0.1)}, loop(40), full=True)
    assert table.loc["timed", "ms"] == pytest.approx(20.5)
    assert table.loc["timed", "ate_online_m"] == pytest.approx(table.loc["timed", "ate_m"])
    assert np.isnan(table.loc["untimed", "ms"])
    assert np.isnan(table.loc["untimed", "ate_online_m"])


def test_without_truth_the_errors_are_not_known() -> None:
    table = compare({"a": estimate(0.1)}, full=True)
    assert np.isnan(table.loc["a", "ate_m"])
    assert table.loc["a", "consistency"] == ""
    assert table.loc["a", "landmarks"] == 12


def test_landmarks_are_compared_with_their_true_positions() -> None:
    found = estimate(0.0)
    off = found.landmarks.positions + np.array([0.0, 0.0, 0.3])
    table = compare({"a": found}, loop(40), LandmarkTruth(found.landmarks.ids, off), full=True)
    assert table.loc["a", "landmark_rmse_m"] == pytest.approx(0.3)


def test_what_is_no_result_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="filter: int is no estimator's result; give what replay"):
        compare({"filter": 3}, loop(40))  # type: ignore[dict-item]
