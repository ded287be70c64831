"""`fgslam run` with comparisons and on measurements, `fgslam compare`, trials."""

from __future__ import annotations

import csv
import shlex
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
import yaml
from recordings import experiment
from running import (
    KIND,
    main,
    metrics_of,
    run_values,
    units_in_this_process,
    write_config,
)

from fgslam.core.log import MeasurementLog
from fgslam.core.types import Trajectory, read_covariances
from fgslam.evaluation.statistics import EstimatorMetrics
from fgslam.report.formats import read_ply
from fgslam.runs.config import make_config
from fgslam.runs.run import run_experiment

CONTRACT = set(EstimatorMetrics().as_json())
FRAMES = 30
ESTIMATOR_FILES = {
    "online.tum",
    "final.tum",
    "covariance.csv",
    "map.ply",
    "frames.csv",
    "noise.csv",
}
DRIVE: dict[str, Any] = {
    "name": "short_drive",
    "dataset": {"kind": "simulated_measurements", "stop": FRAMES, "detection": {"features": 40}},
    "frontend": {"ego_motion": {"dof": 3}},
    "compare": [{"kind": "landmark_kalman", "label": "world", "update": "world"}],
}
SAME = ("final.tum", "online.tum", "covariance.csv", "map.ply")


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on simulated measurements, two estimators; read only."""
    folder = tmp_path_factory.mktemp("measured") / "run"
    with units_in_this_process():
        run_experiment(make_config(DRIVE, "test"), folder)
    return folder


@pytest.fixture(scope="module")
def plain(measured: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run, whose comparisons write no page, which takes a while."""
    folder = Path(shutil.copytree(measured, tmp_path_factory.mktemp("plain") / "run"))
    values = yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))
    values["output"]["report"] = False
    write_config(folder / "config.yaml", values)
    return folder


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


# --------------------------------------------------------------------------------------------
# fgslam run


def test_a_run_on_measurements_fills_its_folder(measured: Path) -> None:
    log = MeasurementLog.load(measured / "measurements.npz")
    assert len(log) == FRAMES
    for title in (KIND, "world"):
        folder = measured / title
        assert {file.name for file in folder.iterdir()} == ESTIMATOR_FILES
        assert len(Trajectory.load(folder / "final.tum")) == FRAMES
        assert len(read_covariances(folder / "covariance.csv")[0]) == FRAMES
        points = read_ply(folder / "map.ply")
        assert (points.colours == 128).all()
        assert points.hits.sum() > 500
        assert [row["status"] for row in rows_of(folder / "frames.csv")][:2] == ["first", "ok"]
    assert "<html" in (measured / "report.html").read_text(encoding="utf-8")[:1000]
    assert len(rows_of(measured / "timing.csv")) == 2 * FRAMES


def test_metrics_hold_the_names_of_the_contract_and_true_landmarks(measured: Path) -> None:
    document = metrics_of(measured)
    assert (document["frames"], document["status"]) == (FRAMES, "finished")
    assert list(document["estimators"]) == [KIND, "world"]
    for metrics in document["estimators"].values():
        assert set(metrics) >= CONTRACT
        assert metrics["matched_poses"] == FRAMES
        assert 0.0 < metrics["ate_rmse_m"] < 0.05
        assert 0.0 < metrics["landmark_rmse_m"] < 1.0
        assert metrics["nees_landmark"]["items"] == metrics["landmarks_with_truth"] > 50
        assert metrics["landmark_truth_sigma_m"] == 0.0
        assert metrics["update_growth"]["ratio"] > 0.0
        assert metrics["peak_memory_mb"] >= metrics["memory_before_mb"] > 20.0
        # A filter's final trajectory is its online one.
        assert metrics["online"]["ate_rmse_m"] == pytest.approx(metrics["ate_rmse_m"])
    rows = rows_of(measured / "comparison.csv")
    assert [(row["run"], row["estimator"]) for row in rows] == [
        ("short_drive", KIND),
        ("short_drive", "world"),
    ]


@pytest.mark.usefixtures("in_this_process")
def test_the_table_states_by_which_noise_each_estimator_weighed(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "out"
    chosen = ("--estimators", f"{KIND},batch,odometry", "--set", "estimators.batch.noise_factor=3")
    assert main(monkeypatch, "compare", plain, "--out", out, *chosen) == 0
    shown = capsys.readouterr().out
    assert "noise" in shown
    assert "3.00" in shown
    found = {title: one["noise_factor"] for title, one in metrics_of(out)["estimators"].items()}
    assert found == {KIND: 1.0, "batch": 3.0, "odometry": None}


@pytest.mark.usefixtures("in_this_process")
def test_a_run_replays_its_own_log_to_the_bit(recording: Path, tmp_path: Path) -> None:
    values = experiment(recording) | {
        "estimator": {"kind": KIND, "label": "live"},
        "compare": [{"kind": KIND, "label": "again"}],
    }
    run = run_values(values, tmp_path / "run")
    assert list(run.result.metrics["estimators"]) == ["live", "again"]
    for name in (*SAME[:3], "noise.csv"):
        live, again = (run.folder / title / name for title in ("live", "again"))
        assert live.read_bytes() == again.read_bytes()
    live_map, again_map = (read_ply(run.folder / title / "map.ply") for title in ("live", "again"))
    np.testing.assert_array_equal(live_map.positions, again_map.positions)
    np.testing.assert_array_equal(live_map.colours, again_map.colours)
    assert len(np.unique(live_map.colours)) > 10
    found = metrics_of(run.folder)["estimators"]
    assert list(found) == ["live", "again"]
    for name in CONTRACT - {"update_ms", "peak_memory_mb"}:
        assert found["live"][name] == found["again"][name]


# --------------------------------------------------------------------------------------------
# fgslam compare


def test_compare_gives_the_runs_own_bytes_and_a_table(
    measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "out"
    arguments = ("compare", measured, "--out", out, "--estimators", f"{KIND},world")
    own = ("--set", "estimators.world.update=half")
    assert main(monkeypatch, *arguments, *own) == 0
    shown = capsys.readouterr().out
    assert f"SE3 aligned, {FRAMES} matched poses" in shown
    assert "NEES" in shown
    assert shown.count("world") >= 3
    for name in SAME:
        assert (out / KIND / name).read_bytes() == (measured / KIND / name).read_bytes()
    assert (out / "world/final.tum").read_bytes() != (measured / "world/final.tum").read_bytes()
    written = yaml.safe_load((out / "config.yaml").read_text(encoding="utf-8"))
    assert [e["update"] for e in written["compare"]] == ["pixel", "half"]
    assert written["provenance"]["run"] == str(measured)
    assert (out / "report.html").is_file()
    rows = rows_of(out / "comparison.csv")
    assert {(row["odometry"], row["predicted_frames"]) for row in rows} == {("recorded", "0")}
    # The estimators of the configuration are the default; the second one differs from `half`.
    assert main(monkeypatch, "compare", measured, "--out", out) == 2
    assert "holds results already" in capsys.readouterr().err


@pytest.mark.usefixtures("in_this_process")
def test_one_estimator_may_fail(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A map too large for the EKF is reported; the filter beside it goes on."""
    out = tmp_path / "out"
    arguments = ("--estimators", f"ekf,{KIND}", "--set", "estimators.ekf.max_landmarks=45")
    assert main(monkeypatch, "compare", plain, "--out", out, *arguments) == 0
    found = metrics_of(out)["estimators"]
    assert found["ekf"]["failure"].startswith("frame ")
    assert found[KIND]["failure"] is None
    done = len(Trajectory.load(out / "ekf/final.tum"))
    assert 0 < done < FRAMES
    assert (
        len(Trajectory.load(out / "ekf/online.tum")) == len(rows_of(out / "ekf/frames.csv")) == done
    )
    assert found["ekf"]["frames"] == done
    assert f"failed      ekf: {found['ekf']['failure']}" in capsys.readouterr().out
    # Alone, its failure is that of the command.
    again = ("--overwrite", "--estimators", "ekf", "--set", "estimators.ekf.max_landmarks=45")
    assert main(monkeypatch, "compare", plain, "--out", out, *again) == 1


@pytest.mark.usefixtures("in_this_process")
def test_two_runs_are_compared_side_by_side(
    plain: Path, finished: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    out = tmp_path / "both"
    arguments = ("--out", out, "--estimators", "odometry", "--jobs", 2)
    assert main(monkeypatch, "compare", plain, finished.folder, *arguments) == 0
    rows = rows_of(out / "comparison.csv")
    assert [row["estimator"] for row in rows] == ["odometry", "odometry"]
    assert "final ATE, cm, SE3 aligned" in capsys.readouterr().out
    assert rows[0]["run"] != rows[1]["run"]
    twice = tmp_path / "twice"
    shutil.copytree(plain, twice)
    again = ("--out", tmp_path / "one name", "--estimators", "odometry")
    assert main(monkeypatch, "compare", plain, twice, *again) == 0
    names = [row["run"] for row in rows_of(tmp_path / "one name" / "comparison.csv")]
    assert [Path(name).name for name in names] == [plain.name, "twice"]
    assert (out / plain.name / "odometry" / "final.tum").is_file()


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(
    "existing",
    [pytest.param((), marks=pytest.mark.slow), ("--overwrite",), ("--resume",)],
)
def test_the_command_that_an_interrupted_comparison_shows_goes_on_with_it(
    plain: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    existing: tuple[str, ...],
) -> None:
    given = ("compare", plain, "--out", tmp_path / "out", "--estimators", "odometry")

    @contextmanager
    def ctrl_c_at_once() -> Iterator[Callable[[], bool]]:
        yield lambda: True

    with monkeypatch.context() as patch:
        patch.setattr("fgslam.cli.main.stop_flag", ctrl_c_at_once)
        if existing:
            assert main(monkeypatch, *given) == 130
        assert main(monkeypatch, *given, *existing) == 130
    shown = capsys.readouterr().out.splitlines()[-1].partition("go on: fgslam ")[2]
    assert shlex.split(shown) == [*map(str, given), "--resume"]
    assert main(monkeypatch, *shlex.split(shown)) == 0
    assert metrics_of(tmp_path / "out")["status"] == "finished"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--estimators", "isam3"), "no estimator 'isam3'"),
        (("--out", "RUN", "--overwrite"), "holds the run itself; choose another folder"),
        (("--seed", 3), "--seed means nothing without --trials"),
    ],
)
def test_mistakes_are_reported_in_a_line(
    plain: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    arguments: tuple[object, ...],
    words: str,
) -> None:
    given = [str(a).replace("RUN", str(plain)) for a in arguments]
    out = () if "--out" in given else ("--out", tmp_path / "out")
    assert main(monkeypatch, "compare", plain, *out, *given) == 2
    message = capsys.readouterr().err.strip()
    assert words in message
    assert "\n" not in message.replace(message.splitlines()[0], "", 1).strip()
    assert (plain / "measurements.npz").is_file()


def test_what_is_no_run_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    assert main(monkeypatch, "compare", tmp_path) == 2
    assert "not a run folder" in capsys.readouterr().err
    experiment = tmp_path / "experiment.yaml"
    experiment.write_text("name: x\n", encoding="utf-8")
    assert main(monkeypatch, "compare", experiment) == 2
    assert "give it to fgslam run first, or add --trials" in capsys.readouterr().err


@pytest.mark.parametrize(
    "option",
    ["--set x.y=1", "--out o", "--overwrite", "--resume", "--jobs 2", "--trials 3", "--seed 0"],
)
def test_what_a_graph_cannot_use_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, option: str
) -> None:
    graph = tmp_path / "a.g2o"
    graph.touch()
    assert main(monkeypatch, "compare", graph, *option.split()) == 2
    assert f"{option.split()[0]} means nothing for graphs" in capsys.readouterr().err


def test_a_damaged_truth_is_reported_before_anything_is_written(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    run, out = Path(shutil.copytree(plain, tmp_path / "run")), tmp_path / "out"
    (run / "ground_truth.tum").write_text("1 2 3\n", encoding="utf-8")
    assert main(monkeypatch, "compare", run, "--out", out) == 2
    assert "ground_truth.tum, line 1" in capsys.readouterr().err
    assert not out.exists()


# --------------------------------------------------------------------------------------------
# Trials


@pytest.mark.slow
def test_trials_repeat_to_the_byte_and_need_noise_to_vary(
    plain: Path,
    finished: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    config = write_config(tmp_path / "c.yaml", DRIVE)
    common = ("--trials", 2, "--seed", 0)
    outs = [tmp_path / "a", tmp_path / "b"]
    assert main(monkeypatch, "compare", config, *common, "--out", outs[0], "--jobs", 2) == 0
    assert "2 of 2 cases done" in capsys.readouterr().out
    with units_in_this_process():
        assert main(monkeypatch, "compare", plain, *common, "--out", outs[1]) == 0
    first, second = (pandas.read_parquet(out / "results.parquet") for out in outs)
    pandas.testing.assert_frame_equal(first, second, check_exact=True)
    assert first[["seed", "estimator"]].to_numpy().tolist() == [
        [seed, title] for seed in (0, 1) for title in (KIND, "world")
    ]
    # The first seed is the run's own.
    own = metrics_of(plain)["estimators"][KIND]["ate_rmse_m"]
    assert first.ate_final_m[0] == pytest.approx(own, rel=1e-6)
    assert first.ate_final_m[0] != first.ate_final_m[2]
    assert main(monkeypatch, "compare", finished.folder, "--trials", 2) == 2
    assert "one world of noise" in capsys.readouterr().err


@pytest.mark.usefixtures("in_this_process")
def test_trials_take_overrides_of_the_experiment_and_of_estimators(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    sets = ("--set", "dataset.stop=6", "--set", "estimators.isam2.update_every=2")
    chosen = ("--estimators", "odometry,isam2")
    assert (
        main(monkeypatch, "compare", "lab_trials", "--trials", 1, *sets, *chosen, "--out", out) == 0
    )
    found = pandas.read_parquet(out / "results.parquet")
    assert found["frames"].tolist() == [6, 6]
    assert found["estimator"].tolist() == ["odometry", "isam2"]
    assert found["estimators.isam2.update_every"].tolist() == [2, 2]


def test_export_takes_the_estimator_that_steered(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exported = tmp_path / "path.tum"
    assert len(list(plain.glob("*/final.tum"))) > 1
    assert main(monkeypatch, "export", plain, "--trajectory", exported) == 0
    steered = Trajectory.load(plain / KIND / "final.tum")
    np.testing.assert_array_equal(Trajectory.load(exported).poses, steered.poses)
