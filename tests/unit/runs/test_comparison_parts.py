"""Choosing estimators, tables, and files of a comparison."""

from __future__ import annotations

import csv
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from simulated import RIG, Drive, simulate

from fgslam.backend.settings import Isam2Settings, LandmarkKalmanSettings
from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.log import LandmarkTruth, MeasurementLog, read_landmark_truth, write_landmark_truth
from fgslam.core.types import LandmarkMap
from fgslam.evaluation.judging import Answer, seen_often
from fgslam.evaluation.statistics import EstimatorMetrics, value_at
from fgslam.report.content import TextTable
from fgslam.report.formats import MapPoints
from fgslam.runs.compare import Choice, all_kinds, choose
from fgslam.runs.config import ExperimentConfig, make_config
from fgslam.runs.slam_comparison import judged_apart, named
from fgslam.runs.tables import (
    RESULT_COLUMNS,
    TIME_COLUMNS,
    ate_table,
    comparison_particulars,
    comparison_tables,
    marked,
    page_tables,
    points_from_log,
    write_comparison_csv,
)

LAB: dict[str, Any] = {"name": "x", "dataset": {"kind": "rendered_lab"}}


def config(**more: Any) -> ExperimentConfig:
    return make_config(LAB | more, "test")


# --------------------------------------------------------------------------------------------
# Which estimators


def test_what_is_not_all_there_is_marked_in_every_table() -> None:
    whole = EstimatorMetrics(ate_rmse_m=0.01, more={"frames": 30, "predicted_frames": 0})
    ended = EstimatorMetrics(ate_rmse_m=0.02, more={"frames": 12, "failure": "no solution"})
    bridged = EstimatorMetrics(ate_rmse_m=0.03, more={"frames": 30, "predicted_frames": 8})
    values = {
        "ekf": whole.as_json(),
        "isam2": ended.as_json(),
        "batch": bridged.as_json(),
    }
    titles = ["ekf", "isam2 (failed, 12 of 30 frames)", "batch (8 poses predicted)"]
    for table in comparison_tables("drive", 30, values):
        assert [name for name, _ in table.rows] == titles
    on_page = marked(values, "synthetic odometry", say_failed=False)
    for table in page_tables(on_page):
        assert [name for name, _ in table.rows] == [
            "ekf (synthetic odometry)",
            "isam2 (12 of 30 frames, synthetic odometry)",
            "batch (8 poses predicted, synthetic odometry)",
        ]
    cells = dict(ate_table([("drive", values)]).rows)
    assert cells["isam2"] == ("2.00 (failed, 12 of 30 frames)",)
    assert cells["ekf"] == ("1.00",)


def test_synthetic_odometry_stands_over_every_table() -> None:
    guessed = config(odometry={"kind": "synthetic"})
    assert named(guessed) == "x (synthetic odometry)"
    assert named(config()) == "x"


def test_one_log_has_one_noise_model() -> None:
    """An estimator that the configuration does not name weighs the log as those that it does."""
    weighed = config(compare=[{"kind": "isam2", "noise_factor": 2.5}])
    chosen = choose(weighed, Choice(("isam2", "batch", "fixed_lag", "ekf")))
    assert [getattr(s, "noise_factor", None) for s in chosen] == [2.5, 2.5, 2.5, None]
    asked = Choice(("isam2", "batch"), ("estimators.batch.noise_factor=4",))
    assert [s.noise_factor for s in choose(weighed, asked)] == [2.5, 4.0]
    assert choose(config(), Choice(("batch",))) == (all_kinds()["batch"],)


def test_dead_reckoning_without_odometry_is_no_row_of_a_comparison() -> None:
    guessed = config(odometry={"kind": "constant_velocity"}, compare=["odometry", "isam2"])
    assert [one.kind for one in choose(guessed, Choice())] == ["landmark_kalman", "isam2"]
    assert [one.kind for one in judged_apart(guessed, guessed.estimators[1:])] == ["isam2"]
    with pytest.raises(ConfigError, match="--estimators odometry: the run had no odometry"):
        choose(guessed, Choice(("odometry", "isam2")))
    measured = config(compare=["odometry", "isam2"])
    assert "odometry" in [one.kind for one in choose(measured, Choice())]


def test_the_configurations_estimators_are_the_default() -> None:
    named = {"kind": "isam2", "label": "often", "update_every": 1}
    chosen = choose(config(compare=["landmark_kalman", "batch", named]), Choice())
    assert [s.title for s in chosen] == ["landmark_kalman", "batch", "often"]


def test_without_any_every_kind_is_compared_the_live_one_as_it_was_set() -> None:
    chosen = choose(config(estimator={"update": "world"}), Choice())
    assert [s.kind for s in chosen] == list(all_kinds())
    assert LandmarkKalmanSettings(update="world") in chosen


def test_names_are_labels_or_kinds() -> None:
    run = config(compare=[{"kind": "isam2", "label": "often", "update_every": 1}])
    chosen = choose(run, Choice(("often", " isam2", "often")))
    assert chosen == (Isam2Settings(label="often", update_every=1), Isam2Settings())
    with pytest.raises(ConfigError, match=r"no estimator 'isam3'; give --estimators with some of"):
        choose(run, Choice(("isam3",)))
    with pytest.raises(ConfigError, match="no estimator named"):
        choose(run, Choice(("",)))


def test_overrides_reach_one_estimator() -> None:
    run = config(compare=["isam2", {"kind": "isam2", "label": "a.b"}])
    wanted = ("estimators.isam2.update_every=7", "estimators.a.b.kernel.width=2.5")
    live, isam2, dotted = choose(run, Choice(None, wanted))
    assert live == LandmarkKalmanSettings()
    assert isam2 == Isam2Settings(update_every=7)
    assert isinstance(dotted, Isam2Settings)
    assert (dotted.title, dotted.kernel.width, dotted.update_every) == ("a.b", 2.5, 5)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("estimators.batch.method=gnc", "NAME one of landmark_kalman, isam2"),
        ("isam2.update_every=3", "estimators.NAME.key=value with NAME one of landmark_kalman"),
        ("dataset.stop=3", "what was measured stays as it is; .* or --trials to run"),
        ("estimators.isam2.updat_every=3", "did you mean estimators.isam2.update_every"),
        ("estimators.isam2.update_every=0", "is not usable"),
        ("estimators.isam2.kind=batch", "the kind is what names it"),
    ],
)
def test_overrides_that_are_none(override: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        choose(config(compare=["isam2"]), Choice(None, (override,)))


def test_overrides_of_estimators_and_of_the_experiment_are_distinguished() -> None:
    of_estimators = ("estimators.isam2.update_every=7", " estimators.batch.method=gnc")
    choice = Choice(("isam2",), (of_estimators[0], "dataset.stop=3", of_estimators[1], "seed=1"))
    assert choice.of_experiment == ("dataset.stop=3", "seed=1")
    assert choice.of_estimators == Choice(("isam2",), of_estimators)


# --------------------------------------------------------------------------------------------
# Files


TIMES = {"median": 1.0, "p95": 2.0, "max": 3.0}
METRICS = EstimatorMetrics(
    ate_rmse_m=0.0123,
    update_ms=TIMES,
    nees_pose_per_dof=2.0,
    more={
        "kind": "isam2",
        "landmark_rmse_m": float("nan"),
        "online": {"ate_rmse_m": 0.02},
        "failure": "frame 3, twice: no",
    },
)


def test_the_table_has_a_row_for_every_estimator_and_run(tmp_path: Path) -> None:
    path = tmp_path / "comparison.csv"
    rows = {"x": METRICS.as_json(), "y": EstimatorMetrics().as_json()}
    write_comparison_csv(path, [("a", rows), ("b", {})])
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    assert [(row["run"], row["estimator"]) for row in rows] == [("a", "x"), ("a", "y")]
    first = rows[0]
    assert list(first) == ["run", "estimator", *(n for n, _ in (*RESULT_COLUMNS, *TIME_COLUMNS))]
    assert (first["ate_final_m"], first["ate_online_m"]) == ("0.0123", "0.02")
    assert (first["update_p95_ms"], first["landmark_rmse_m"]) == ("2", "")
    assert first["failure"] == "frame 3, twice: no"
    assert set(rows[1].values()) == {"a", "y", ""}
    assert value_at(METRICS.as_json(), "online.ate_rmse_m.more") is None


def tables(metrics: dict[str, EstimatorMetrics]) -> tuple[TextTable, ...]:
    return comparison_tables("drive", 9, {title: one.as_json() for title, one in metrics.items()})


def particulars(metrics: dict[str, EstimatorMetrics]) -> tuple[tuple[str, str], ...]:
    values = {title: one.as_json() for title, one in metrics.items()}
    return comparison_particulars(values, Path("drive/compare"))


def consistent(lower: float, upper: float) -> EstimatorMetrics:
    band = {"lower": lower, "upper": upper, "verdict": "consistent"}
    return EstimatorMetrics(nees_pose_per_dof=1.1, more={"nees_pose": band})


def test_consistency_table_says_which_estimator_each_band_is_of() -> None:
    three, six = consistent(0.07, 3.12), consistent(0.21, 2.41)
    (table, *_) = tables({"ekf": three, "isam2": six, "batch": six})
    bands = "95 % bands of the pose NEES: 0.07-3.12 of ekf; 0.21-2.41 of isam2, batch"
    assert table.heading == f"drive: consistency (1 is right; {bands})"
    (table, *_) = tables({"isam2": six, "batch": six})
    assert table.heading.endswith("(1 is right; 95 % band of the pose NEES 0.21-2.41)")


def test_columns_that_no_estimator_fills_are_left_out_with_the_reason() -> None:
    untrue = {"isam2": EstimatorMetrics(update_ms=TIMES)}
    (table,) = tables(untrue)  # accuracy and consistency would be empty
    assert [column.name.split("\n")[0] for column in table.columns] == ["update ms"]
    assert table.rows == (("isam2", ("1.00 2.00 3.0",)),)
    reasons = [text for label, text in particulars(untrue) if label == "left out"]
    assert any(r.startswith("ATE final cm, ") and "no ground truth" in r for r in reasons)


def test_a_column_that_one_estimator_fills_stays() -> None:
    some = {"a": EstimatorMetrics(ate_rmse_m=0.01), "b": EstimatorMetrics()}
    (table,) = tables(some)
    assert table.rows == (("a", ("1.00",)), ("b", ("-",)))
    assert ("-", "ATE final cm: no ground truth, or fewer than three poses matched") in (
        particulars(some)
    )


def test_landmark_truth_reads_back(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "truth.csv"
    truth = LandmarkTruth(np.array([2, 5, 9]), rng.normal(size=(3, 3)))
    write_landmark_truth(path, truth, np.array([0.0, 0.001, 0.5]))
    found, sigma = read_landmark_truth(path)
    np.testing.assert_array_equal(found.ids, truth.ids)
    np.testing.assert_allclose(found.positions, truth.positions, atol=1e-9)
    np.testing.assert_array_equal(sigma, [0.0, 0.001, 0.5])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("x,y\n", "line 1: not 'id,x,y,z,sigma_m'"),
        ("id,x,y,z,sigma_m\n1,0,0,0,0\n2,0,zero,0,0\n", "line 3: could not convert"),
        ("id,x,y,z,sigma_m\n2,0,0,0,0\n1,0,0,0,0\n", "ids do not increase"),
        ("id,x,y,z,sigma_m\n1.5,0,0,0,0\n", "ids do not increase by whole numbers"),
        ("id,x,y,z,sigma_m\n2,0,nan,0,0\n", "not finite"),
    ],
)
def test_damaged_landmark_truth_is_refused(content: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(DatasetError, match=words):
        read_landmark_truth(path)


def a_log() -> MeasurementLog:
    simulation = simulate(Drive(frames=10), np.random.default_rng(4))
    return MeasurementLog(RIG, {}, simulation.increments)


def test_hits_and_misses_are_counted_from_the_log() -> None:
    log = a_log()
    log.increments[3].rejected[:2] = True
    ids = np.arange(40)
    landmarks = LandmarkMap(ids, np.zeros((40, 3)), np.zeros((40, 3, 3)))
    look = MapPoints(
        ids=np.array([3]),
        positions=np.zeros((1, 3)),
        covariances=np.zeros((1, 3, 3)),
        colours=np.array([[1, 2, 3]], np.uint8),
        hits=np.zeros(1, np.int64),
        misses=np.zeros(1, np.int64),
        valid=np.ones(1, np.bool_),
        permanent=np.ones(1, np.bool_),
    )
    points = points_from_log(landmarks, log, look)
    for k in ids:
        seen = sum(int((i.observations.ids[~i.rejected] == k).sum()) for i in log)
        assert points.hits[k] == seen
        assert points.misses[k] == sum(int((i.missed_ids == k).sum()) for i in log)
        assert points.valid[k] == (seen >= 3)
    assert points.misses.sum() > 0
    assert points.colours[3].tolist() == [1, 2, 3]
    assert set(points.colours[[0, 39]].ravel().tolist()) == {128}


def test_landmarks_seen_twice_are_not_judged() -> None:
    log = a_log()
    count = 1 + max(int(i.observations.ids.max()) for i in log)
    truth = LandmarkTruth(np.arange(count), np.zeros((count, 3)))
    judged = seen_often(log, truth)
    seen = np.concatenate([i.observations.ids[~i.rejected] for i in log])
    expected = [k for k in range(count) if (seen == k).sum() >= 3]
    assert judged.ids.tolist() == expected
    assert 0 < len(expected) < count


@pytest.mark.parametrize(("kind", "predicted"), [("isam2", 2), ("odometry", 0)])
def test_poses_of_dead_reckoning_are_not_marked_as_predicted(kind: str, predicted: int) -> None:
    """None of them is measured; a mark on those that tracking would not have measured misleads."""
    columns = {"status": np.array(["first", "ok", "too_few_matches", "diverged"])}
    empty = np.zeros(4)
    replayed = SimpleNamespace(
        kind=kind,
        estimate=None,
        online=None,
        online_covariances=np.zeros((4, 6, 6)),
        column=lambda name: columns.get(name, empty),
        peak_memory_mb=1.0,
    )
    assert Answer.of(cast("Any", replayed)).predicted.sum() == predicted
