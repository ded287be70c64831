"""metrics.json keeps its contract; timing.csv adds up."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from fgslam.core.errors import DatasetError
from fgslam.evaluation.statistics import EstimatorMetrics, UpdateTime
from fgslam.report.content import StageTime, read_metrics, write_metrics, write_timing

CONTRACT = {
    "ate_rmse_m",
    "rpe_trans_m",
    "rpe_rot_deg",
    "drift_percent",
    "end_error_m",
    "end_error_deg",
    "landmarks",
    "nees_pose_per_dof",
    "nees_landmark_per_dof",
    "update_ms",
    "peak_memory_mb",
}


def test_every_name_is_there_even_when_nothing_is_known(tmp_path: Path) -> None:
    write_metrics(tmp_path / "metrics.json", 0, {"landmark_kalman": EstimatorMetrics()})
    document = json.loads((tmp_path / "metrics.json").read_text())
    assert document["frames"] == 0
    metrics = document["estimators"]["landmark_kalman"]
    assert set(metrics) == CONTRACT
    assert metrics.pop("update_ms") == {"median": None, "p95": None, "max": None}
    assert set(metrics.values()) == {None}


def test_values_and_further_values(tmp_path: Path) -> None:
    metrics = EstimatorMetrics(
        ate_rmse_m=float(np.float64(0.012)),
        drift_percent=float("nan"),
        rpe_rot_deg=float("inf"),
        landmarks=3590,
        update_ms=UpdateTime.of(np.arange(101.0)),
        more={"alignment": "se3", "band": np.array([0.5, 1.5]), "matched_poses": np.int64(249)},
    )
    path = tmp_path / "metrics.json"
    write_metrics(path, 249, {"landmark_kalman": metrics}, {"odometry": "synthetic"})
    document = read_metrics(path)
    ours = document["estimators"]["landmark_kalman"]
    assert document["odometry"] == "synthetic"
    assert ours["ate_rmse_m"] == 0.012
    assert ours["drift_percent"] is None
    assert ours["rpe_rot_deg"] is None
    assert ours["landmarks"] == 3590
    assert ours["update_ms"] == {"median": 50.0, "p95": 95.0, "max": 100.0}
    assert ours["alignment"] == "se3"
    assert ours["band"] == [0.5, 1.5]
    assert ours["matched_poses"] == 249
    first = path.read_bytes()
    write_metrics(path, 249, {"landmark_kalman": metrics}, {"odometry": "synthetic"})
    assert path.read_bytes() == first


def test_further_values_cannot_hide_the_contract() -> None:
    with pytest.raises(ValueError, match="landmarks"):
        EstimatorMetrics(more={"landmarks": 7}).as_json()


def test_broken_metrics_files(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    with pytest.raises(DatasetError, match="No such file"):
        read_metrics(path)
    path.write_text("{")
    with pytest.raises(DatasetError, match="not JSON"):
        read_metrics(path)
    path.write_text("[]")
    with pytest.raises(DatasetError, match="holds no metrics"):
        read_metrics(path)


def test_timing_is_plain_csv(tmp_path: Path) -> None:
    times = [StageTime(0, 0.5, "sift", 12.34567), StageTime(0, 0.5, "match", 1.0)]
    write_timing(tmp_path / "timing.csv", times)
    with (tmp_path / "timing.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["stage"] for row in rows] == ["sift", "match"]
    assert rows[0] == {
        "frame": "0",
        "timestamp": "0.500000000",
        "stage": "sift",
        "milliseconds": "12.3457",
    }
