"""Geometry of what is drawn, and files of numbers."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from fgslam.core.arrays import thinned
from fgslam.core.errors import DatasetError, OutputError
from fgslam.evaluation.statistics import EstimatorMetrics, spread
from fgslam.report.content import (
    SIGMAS,
    Column,
    TextTable,
    exaggeration,
    level_axes,
    outlines,
    peaks,
    read_metrics,
    read_table,
    write_csv,
    write_json,
    write_metrics,
    write_timing,
)


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.1, -0.9, 0.4), (1.0, 0.0, 0.0)])
def test_level_axes_are_a_rotation_with_up_last(up: tuple[float, ...]) -> None:
    level = level_axes(np.array(up))
    np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(level) == pytest.approx(1.0)
    np.testing.assert_allclose(level @ np.array(up), [0, 0, np.linalg.norm(up)], atol=1e-12)
    np.testing.assert_array_equal(level_axes(np.array([0, -1.0, 0])) @ [1, 2, 3], [1, 3, -2])


def test_thinning_keeps_ends_and_peaks() -> None:
    assert thinned(3, 10).tolist() == [0, 1, 2]
    rows = thinned(2500, 100)
    assert (rows[0], rows[-1], len(rows)) == (0, 2499, 100)
    values = np.zeros(1000)
    values[[17, 333, 998]] = 5.0
    values[500:520] = np.nan
    kept = peaks(values, 50)
    assert len(kept) == 50
    assert (np.diff(kept) > 0).all()
    assert {17, 333, 998} <= set(kept.tolist())


def test_an_ellipse_lies_at_its_deviations() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    outline = outlines(np.array([[1.0, -1.0]]), covariance[None])[0] - [1.0, -1.0]
    distance = np.einsum("ni,ij,nj->n", outline, np.linalg.inv(covariance), outline)
    np.testing.assert_allclose(distance, SIGMAS**2, rtol=1e-12)
    assert np.isnan(outlines(np.zeros((1, 2)), np.full((1, 2, 2), np.nan))).all()


@pytest.mark.parametrize("sigma", [1e-5, 1e-3, 0.02, 1.0])
def test_pose_ellipses_are_enlarged_just_enough(sigma: float) -> None:
    factor = exaggeration(np.tile(sigma**2 * np.eye(2), (10, 1, 1)), span=10.0)
    width = 2 * SIGMAS * sigma
    assert factor == 1000 or factor * width >= 0.2
    assert factor == 1 or (factor / 2.5) * width < 0.2
    assert exaggeration(np.zeros((3, 2, 2)), span=10.0) == 1


# --------------------------------------------------------------------------------------------
# Tables and documents


def test_a_table_is_text_that_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    rows = [
        [1, np.int64(2), 1.0 / 3.0, True],
        [None, float("nan"), np.float64("inf"), np.bool_(False)],
        ['a "b", c', -0.5, 1e-12, 12345678901],
    ]
    write_csv(path, ("a", "b", "c", "d"), rows)
    assert path.read_text(encoding="utf-8") == (
        'a,b,c,d\n1,2,0.3333333333,true\n,,,false\n"a ""b"", c",-0.5,1e-12,12345678901\n'
    )
    table = read_table(path, ("b", "c"), ("a", "d"))
    np.testing.assert_array_equal(table["b"], [2.0, np.nan, -0.5])
    assert table["a"].tolist() == ["1", "", 'a "b", c']


@pytest.mark.parametrize(
    ("text", "why"),
    [("a,b\n1,2\n", "lacks column t"), ("t\nx\n", "line 2: t is 'x', not a number"),
     ("t\n1\n\xff\n", "line 3: t is"), ("a,t\n1,2\n1\n", "line 3: ends before column t"),
     ("t\n\n1.5\n", "not a number")],
)  # fmt: skip
def test_a_damaged_table_is_refused_in_a_line(tmp_path: Path, text: str, why: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DatasetError, match=f"t.csv.*{why}.*; run the experiment again") as caught:
        read_table(path, ("t",), whole=("t",))
    assert "\n" not in str(caught.value)
    path.write_bytes(b"t\n\xff\n")
    with pytest.raises(DatasetError, match="cannot be read"):
        read_table(path)


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="1 cells in a table of 2 columns"):
        write_csv(tmp_path / "t.csv", ("a", "b"), [[1]])
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputError, match="does not exist"):
        write_csv(tmp_path / "no" / "t.csv", ("a",), [])
    with pytest.raises(ValueError, match="row: 2 values in a table of 1 columns"):
        TextTable("k", "h", "f", (Column("a", "b"),), (("row", ("1", "2")),))


def test_what_is_not_finite_is_null(tmp_path: Path) -> None:
    write_json(tmp_path / "m.json", {"a": float("nan"), "b": [np.float64(1.5), np.inf]})
    text = (tmp_path / "m.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"a": None, "b": [1.5, None]}


# --------------------------------------------------------------------------------------------
# metrics.json and timing.csv

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


def test_every_metric_is_there_even_when_nothing_is_known(tmp_path: Path) -> None:
    write_metrics(tmp_path / "metrics.json", 0, {"landmark_kalman": EstimatorMetrics()})
    document = read_metrics(tmp_path / "metrics.json")
    assert document["frames"] == 0
    metrics = document["estimators"]["landmark_kalman"]
    assert set(metrics) == CONTRACT
    assert metrics.pop("update_ms") == {"median": None, "p95": None, "max": None}
    assert set(metrics.values()) == {None}


def test_values_and_further_values(tmp_path: Path) -> None:
    metrics = EstimatorMetrics(
        ate_rmse_m=float(np.float64(0.012)),
        drift_percent=float("nan"),
        landmarks=3590,
        update_ms=spread(np.arange(101.0)),
        more={"alignment": "se3", "band": np.array([0.5, 1.5]), "matched_poses": np.int64(249)},
    )
    path = tmp_path / "metrics.json"
    write_metrics(path, 249, {"landmark_kalman": metrics}, {"odometry": "synthetic"})
    document = read_metrics(path)
    assert document["odometry"] == "synthetic"
    expected = {
        "ate_rmse_m": 0.012,
        "drift_percent": None,
        "landmarks": 3590,
        "update_ms": {"median": 50.0, "p95": 95.0, "max": 100.0},
        "alignment": "se3",
        "band": [0.5, 1.5],
        "matched_poses": 249,
    }
    assert expected.items() <= document["estimators"]["landmark_kalman"].items()
    first = path.read_bytes()
    write_metrics(path, 249, {"landmark_kalman": metrics}, {"odometry": "synthetic"})
    assert path.read_bytes() == first


def test_further_values_cannot_hide_the_contract() -> None:
    with pytest.raises(ValueError, match="landmarks"):
        EstimatorMetrics(more={"landmarks": 7}).as_json()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (None, "No such file"),
        ("{", "not JSON"),
        ("[]", "holds no metrics"),
        ('{"estimators": []}', "holds no metrics"),
        ('{"estimators": {"ekf": 1}}', "holds no metrics"),
    ],
)
def test_broken_metrics_files(tmp_path: Path, text: str | None, why: str) -> None:
    path = tmp_path / "metrics.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(DatasetError, match=why):
        read_metrics(path)


def test_timing_is_plain_csv(tmp_path: Path) -> None:
    times = [(0, 0.5, "sift", 12.34567), (0, 0.5, "match", 1.0)]
    write_timing(tmp_path / "timing.csv", times)
    with (tmp_path / "timing.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert list(first.values()) == ["0", "0.500000000", "sift", "12.3457"]
    assert second["stage"] == "match"
