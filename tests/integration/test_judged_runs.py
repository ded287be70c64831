"""`fgslam judge` on a run of ours: its own numbers, its bag, its halves, its page."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from running import Capture, Patch, main, units_in_this_process

import fgslam as fg
from fgslam.core.log import MeasurementLog
from fgslam.runs.config import make_config
from fgslam.runs.judge import part_of
from fgslam.runs.run import run_experiment

KIND = "landmark_kalman"
VALUES: dict[str, Any] = {
    "name": "drive",
    "dataset": {"kind": "simulated_measurements", "stop": 40, "detection": {"features": 40}},
    "output": {"report": False, "pictures": False},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on simulated measurements; read only."""
    folder = tmp_path_factory.mktemp("judge") / "drive"
    with units_in_this_process():
        run_experiment(make_config(VALUES, "test"), folder)
    return folder


def test_the_numbers_of_a_run_are_its_own(run: Path) -> None:
    own = json.loads((run / "metrics.json").read_text())["estimators"][KIND]
    judged = fg.judge(run, run / "ground_truth.tum")
    found = judged.values["drive"]
    assert found["nees_pose"]["per_dof"] == pytest.approx(own["nees_pose"]["per_dof"], rel=1e-5)
    assert found["nees"]["pose"]["per_dof"] == pytest.approx(own["nees_pose_per_dof"], rel=1e-5)
    assert found["ate_rmse_m"] == pytest.approx(own["ate_rmse_m"], rel=1e-5)
    assert found["nees_relative"] == own["nees_relative"]
    assert "motions are judged by the joint covariances of the run" in judged.notes


def test_the_same_estimate_in_a_bag_is_judged_alike(
    run: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    """Through an export with the axes of a robot, another world, order and tangent space."""
    bag = tmp_path / "drive.mcap"
    assert main(monkeypatch, "export", run, "--trajectory", bag) == 0
    truth = run / "ground_truth.tum"
    ours, theirs = (
        fg.judge(run, truth).table(),
        fg.judge(bag, truth, tangent="split_global").table(),
    )
    guessed = fg.judge(bag, truth)
    assert guessed.table().nees_pose.iloc[0] == pytest.approx(ours.nees_pose.iloc[0], rel=0.1)
    assert any("x, y, z are z, -x, -y of the truth (guess)" in note for note in guessed.notes)
    for name in ("nees_pose", "nees_rotation", "sigma_factor", "ate_m"):
        assert theirs.loc["drive", name] == pytest.approx(ours.loc["drive", name], rel=1e-3)


def test_a_run_has_the_graph_of_its_log(tmp_path: Path) -> None:
    values = VALUES | {"dataset": VALUES["dataset"] | {"stop": 5}}
    with units_in_this_process():
        run = run_experiment(make_config(values, "test"), tmp_path / "short")
    graph, found, poses, _ = run.graph("batch")
    assert len(poses) == 5
    assert graph.error(found) < graph.size()
    with pytest.raises(fg.errors.ConfigError, match="landmark_kalman keeps no whole graph"):
        run.graph()


def test_halves_of_the_landmarks_judge_a_run_without_truth(run: Path) -> None:
    judged = fg.judge(run)
    assert any("two halves of the landmarks" in note for note in judged.notes)
    assert 0.2 < judged.table().loc["drive", "nees_pose"] < 3.0
    with pytest.raises(fg.errors.ConfigError, match="is no run of fgslam"):
        fg.judge(run / "ground_truth.tum")


def test_an_estimator_of_a_comparison_is_judged_by_what_its_run_knows(
    run: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    drive = tmp_path / "drive"
    shutil.copytree(run, drive)
    with units_in_this_process():
        assert main(monkeypatch, "compare", drive, "--estimators", "isam2") == 0
    metrics = json.loads((drive / "compare" / "metrics.json").read_text())
    judged = fg.judge(drive / "compare" / "isam2", drive / "ground_truth.tum")
    assert (
        judged.values["isam2"]["nees_relative"] == metrics["estimators"]["isam2"]["nees_relative"]
    )
    halves = fg.judge(drive / "compare" / "isam2")
    assert any("two halves of the landmarks" in note for note in halves.notes)
    assert 0.2 < halves.table().loc["isam2", "nees_pose"] < 3.0


def test_halves_share_no_landmark_and_lose_none(run: Path) -> None:
    log = MeasurementLog.load(run / "measurements.npz")
    halves = [part_of(log, k) for k in (0, 1)]
    for whole, first, second in zip(log, *halves, strict=True):
        parts = [one.observations.ids for one in (first, second)]
        assert not np.intersect1d(*parts).size
        np.testing.assert_array_equal(
            np.sort(np.concatenate(parts)), np.sort(whole.observations.ids)
        )
        assert len(first.rejected) == len(parts[0])


def test_the_command_prints_tables_and_writes_numbers_and_page(
    run: Path, tmp_path: Path, capfd: Capture, monkeypatch: Patch
) -> None:
    out = tmp_path / "out"
    arguments = ("judge", run, "--truth", run / "ground_truth.tum", "--run", out)
    assert main(monkeypatch, *arguments) == 0
    printed = capfd.readouterr().out
    assert "sigma x" in printed
    assert "covariances are rotation_first,local (stated)" in printed
    assert json.loads((out / "metrics.json").read_text())["estimators"]["drive"]["nees"]
    assert "Are the covariances credible?" in (out / "report.html").read_text()
    assert main(monkeypatch, *arguments) == 2
    assert "add --overwrite" in capfd.readouterr().err
    assert main(monkeypatch, *arguments, "--overwrite") == 0
