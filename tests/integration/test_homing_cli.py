"""Homing at the command line: runs, folders, comparisons, and one line for each mistake."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PictureFile
from running import main, mistake, units_in_this_process, write_config

from fgslam.core.bearings import BearingLog
from fgslam.core.errors import DatasetError
from fgslam.runs.config import load_experiment, make_experiment
from fgslam.runs.folder import RUN_MARKER
from fgslam.runs.report import report_from_folder
from fgslam.runs.run import run_experiment

Capture = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch
TRIALS: dict[str, Any] = {
    "task": "homing_trials",
    "name": "few_trials",
    "jobs": 1,
    "trials": 2,
    "outliers": [0.0],
    "estimator": "homing_ekf",
    "compare": ["alv"],
    "dataset": {"images_per_s": 4.0},
    "output": {"logs": 1},
}


def values_of(run: Path) -> dict[str, Any]:
    document = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    assert isinstance(document, dict)
    return document


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("homing") / "run"
    values = TRIALS | {"estimator": {"kind": "homing_ekf"}}
    with units_in_this_process():
        run_experiment(make_experiment(values, "test"), folder)
    return folder


def test_trials_leave_a_whole_folder(trials: Path) -> None:
    found = {path.relative_to(trials).as_posix() for path in trials.rglob("*") if path.is_file()}
    assert found == {
        "config.yaml",
        "metrics.json",
        "report.html",
        "trials.csv",
        "trials_timing.csv",
        "logs/outliers_00_trial_0000.npz",
    }
    config = load_experiment(trials / RUN_MARKER)
    assert config.provenance is not None
    assert "gtsam" in config.provenance["versions"]
    rows = list(csv.DictReader((trials / "trials.csv").read_text(encoding="utf-8").splitlines()))
    assert [(row["trial"], row["estimator"]) for row in rows] == [
        ("0", "homing_ekf"),
        ("0", "alv"),
        ("1", "homing_ekf"),
        ("1", "alv"),
    ]
    assert all(abs(float(row["direction_error_deg"])) < 30.0 for row in rows[::2])
    assert rows[1]["distance_error_legs"] == ""  # averaging knows no distance
    numbers = values_of(trials)
    assert numbers["status"] == "finished"
    assert numbers["estimators"]["homing_ekf"]["outliers"]["0"]["trials"] == 2
    assert numbers["estimators"]["alv"]["outliers"]["0"]["nees_home_per_dof"] is None


def test_the_log_has_the_truth_and_all_images(trials: Path) -> None:
    log = BearingLog.load(trials / "logs" / "outliers_00_trial_0000.npz")
    assert log.truth is not None
    assert len(log.truth.robots) == len(log.images) >= 10
    assert log.truth.leg_m == pytest.approx(2.0)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not(
    trials: Path, tmp_path: Path
) -> None:
    config = load_experiment(trials / RUN_MARKER, ["trials=1"])
    again = tmp_path / "again"
    run_experiment(config, again)
    first = (trials / "trials.csv").read_text(encoding="utf-8").splitlines()
    assert (again / "trials.csv").read_text(encoding="utf-8").splitlines() == first[:3]
    name = "logs/outliers_00_trial_0000.npz"
    assert (again / name).read_bytes() == (trials / name).read_bytes()


@pytest.mark.usefixtures("in_this_process")
def test_logs_are_compared(
    trials: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    out = tmp_path / "compared"
    override = "estimators.paper_ekf.gate_sigmas=2.5"
    arguments = ("compare", trials, "--estimators", "paper_ekf", "--set", override, "--out", out)
    assert main(monkeypatch, *arguments) == 0
    assert "paper_ekf" in capfd.readouterr().out
    (compared,) = load_experiment(out / RUN_MARKER).estimators
    assert (compared.title, compared.gate_sigmas) == ("paper_ekf", 2.5)
    rows = list(csv.DictReader((out / "estimates.csv").read_text(encoding="utf-8").splitlines()))
    log = BearingLog.load(trials / "logs" / "outliers_00_trial_0000.npz")
    assert [float(row["time"]) for row in rows] == [image.time for image in log.images]
    numbers = values_of(out)["estimators"]["paper_ekf"]
    assert numbers["trials"] == 1
    assert numbers["direction_median_deg"] is not None
    assert (out / "report.html").is_file()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--estimators", "isam2"), "no estimator 'isam2'; give --estimators with some of homing_"),
        (("--set", "estimators.alv.gate=1"), "unknown key estimators.alv.gate"),
        (("--set", "gate=1"), "what was measured stays as it is; estimators.NAME.key=value"),
        (("--out", "{run}"), "holds the run itself"),
    ],
)
def test_mistakes_in_comparing(
    options: tuple[str, ...], words: str, trials: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    given = [option.format(run=trials) for option in options]
    assert words in mistake(capfd, monkeypatch, "compare", trials, *given)


@pytest.mark.usefixtures("in_this_process")
def test_trials_repeat_simulated_homings_with_other_noise(
    trials: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    out = tmp_path / "trials"
    arguments = ("--trials", 3, "--seed", 7, "--estimators", "homing_ekf,alv", "--out", out)
    assert main(monkeypatch, "compare", trials, *arguments) == 0
    numbers = values_of(out)
    assert (numbers["trials"], list(numbers["estimators"])) == (3, ["homing_ekf", "alv"])
    assert load_experiment(out / RUN_MARKER).seed == 7


def test_other_commands_say_that_it_is_homing(
    trials: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    line = mistake(capfd, monkeypatch, "inspect", trials / RUN_MARKER)
    assert "task homing_trials is a homing experiment" in line
    line = mistake(capfd, monkeypatch, "export", trials, "--graph", trials / "x.g2o")
    assert "is a run of task homing_trials, not of SLAM" in line
    named = line.partition("as they are: ")[2].strip().split(", ")
    assert set(named) == {"metrics.json", "trials.csv", "trials_timing.csv", "logs/*.npz"}


def test_the_page_of_slam_never_takes_the_place_of_homing_s(trials: Path) -> None:
    page = (trials / "report.html").read_bytes()
    with pytest.raises(DatasetError, match=r"is a homing run \(homing_trials\)"):
        report_from_folder(trials)
    assert (trials / "report.html").read_bytes() == page


def test_stopped_at_once_the_files_are_valid(tmp_path: Path) -> None:
    values = TRIALS | {"estimator": {"kind": "homing_ekf"}}
    result = run_experiment(make_experiment(values, "test"), tmp_path / "run", stopped=lambda: True)
    assert result.status == "interrupted"
    assert values_of(tmp_path / "run")["status"] == "interrupted"
    assert len((tmp_path / "run" / "trials.csv").read_text(encoding="utf-8").splitlines()) == 1


def test_a_run_without_logs_cannot_be_compared(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    values = TRIALS | {"estimator": {"kind": "homing_ekf"}}
    run = tmp_path / "run"
    run.mkdir()
    write_config(run / RUN_MARKER, values)
    assert "has no bearing logs" in mistake(capfd, monkeypatch, "compare", run)


# --------------------------------------------------------------------------------------------
# Bad input


def panoramas(folder: Path, sizes: tuple[tuple[int, int], ...]) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k, (width, height) in enumerate(sizes):
        grey = rng.integers(0, 255, (height, width, 3), dtype=np.uint8)
        PictureFile.fromarray(grey).save(folder / f"view_{k}.png")
    return folder


def refused(tmp_path: Path, dataset: dict[str, Any], **more: Any) -> Path:
    values = {"task": "homing_pairs", "name": "x", "jobs": 1, "dataset": dataset, **more}
    return write_config(tmp_path / "c.yaml", values)


def test_a_missing_folder_is_reported_before_anything_is_written(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    config = refused(tmp_path, {"kind": "panoramas", "path": str(tmp_path / "absent")})
    line = mistake(capfd, monkeypatch, "run", config, "--out", tmp_path / "run")
    assert "absent" in line
    assert "dataset.path" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("in_this_process")
def test_an_image_of_another_size_is_reported(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    folder = panoramas(tmp_path / "pictures", ((64, 32), (48, 24)))
    config = refused(tmp_path, {"kind": "panoramas", "path": str(folder)})
    status = main(monkeypatch, "run", config, "--out", tmp_path / "run")
    assert status == 2
    assert "restore the right file" in capfd.readouterr().err.splitlines()[-1]


def test_an_unknown_task_and_an_unknown_route_are_reported(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    folder = panoramas(tmp_path / "pictures", ((64, 32), (64, 32)))
    config = refused(tmp_path, {"kind": "panoramas", "path": str(folder)})
    line = mistake(capfd, monkeypatch, "run", config, "--set", "task=homing_pair")
    assert "task is 'homing_pair'; did you mean homing_pairs?" in line
    values = {"task": "topological_map", "name": "x", "dataset": {"kind": "panoramas"}}
    values["dataset"]["path"] = str(folder)  # type: ignore[index]
    config = write_config(tmp_path / "m.yaml", values | {"routes": [[0, 9]]})
    line = mistake(capfd, monkeypatch, "run", config, "--out", tmp_path / "run")
    assert "routes: there is no view 9" in line
