"""`fgslam sweep` and `fgslam.sweep`: many cases, failed ones, interrupted ones, workers that go."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pandas
import pytest
import yaml
from running import HANGS_AFTER_S, main

import fgslam
from fgslam.core.errors import ConfigError, OutputError
from fgslam.runs.sweep import SweepResult, make_plan, run_sweep
from fgslam.runs.workers import Executor

DRIVE: dict[str, Any] = {
    "name": "short_drive",
    "dataset": {
        "kind": "simulated_measurements",
        "stop": 4,
        "world": {"landmarks": 300},
        "detection": {"features": 30},
    },
    "frontend": {"ego_motion": {"dof": 3}},
    "estimator": {"kind": "odometry"},
}
HOMINGS: dict[str, Any] = {
    "task": "homing_trials",
    "name": "few_homings",
    "trials": 1,
    "outliers": [0.0],
    "estimator": {"kind": "homing_ekf"},
    "dataset": {"images_per_s": 2.0},
}


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    path = tmp_path / "drive.yaml"
    path.write_text(yaml.safe_dump(DRIVE))
    return path


def do(
    source: Path, sets: list[str], out: Path, existing: Any = "refuse", stopped: Any = None
) -> SweepResult:
    plan = make_plan([source], sets)
    stop = stopped or (lambda: False)
    return run_sweep(plan, out, nullcontext(Executor()), existing, stopped=stop)


@pytest.mark.usefixtures("in_this_process")
def test_a_sweep_from_the_command_line_and_from_python_gives_the_same_bytes(
    drive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = [tmp_path / "a", tmp_path / "b"]
    sets = ("--set", "seed=0:2", "--set", "dataset.stop=3,4", "--estimators", "odometry,ekf")
    assert main(monkeypatch, "sweep", drive, *sets, "--out", out[0]) == 0
    said = capsys.readouterr().out
    assert "4 of 4 cases done" in said
    result = fgslam.sweep(
        drive,
        {"seed": range(2), "dataset.stop": [3, 4]},
        out[1],
        estimators=["odometry", "ekf"],
    )
    assert (out[0] / "results.parquet").read_bytes() == (out[1] / "results.parquet").read_bytes()
    table = result.table()
    assert table[["seed", "dataset.stop", "estimator"]].to_numpy().tolist() == [
        [seed, stop, title] for seed in (0, 1) for stop in (3, 4) for title in ("odometry", "ekf")
    ]
    assert table.ate_final_m.nunique() == 8
    assert table.frames.tolist() == table["dataset.stop"].tolist()
    # A case is what the experiment gives by itself.
    fgslam.run(drive, {"seed": 1, "dataset.stop": 3}, tmp_path / "alone")
    alone = json.loads((tmp_path / "alone" / "metrics.json").read_text(encoding="utf-8"))
    assert alone["estimators"]["odometry"]["ate_rmse_m"] == pytest.approx(
        table.ate_final_m[4], rel=1e-12
    )
    assert "ate_final_m over dataset.stop" in (out[0] / "report.html").read_text(encoding="utf-8")


def test_an_interrupted_sweep_has_a_table_and_goes_on_with_what_is_missing(
    drive: Path, tmp_path: Path
) -> None:
    straight = do(drive, ["seed=0:5"], tmp_path / "straight")
    out = tmp_path / "out"
    asked: list[int] = []

    def stopped() -> bool:
        asked.append(0)
        return len(asked) > 5 + 2  # once for each case that is checked, then before each

    first = do(drive, ["seed=0:5"], out, stopped=stopped)
    assert (first.status, first.done, first.cases) == ("interrupted", 2, 5)
    assert first.table().seed.tolist() == [0, 1]
    kept = (out / "cases.jsonl").read_bytes()
    with pytest.raises(OutputError, match="add --overwrite or --resume"):
        do(drive, ["seed=0:5"], out)
    second = do(drive, ["seed=0:5"], out, "resume")
    assert (second.status, second.done) == ("finished", 5)
    assert (out / "cases.jsonl").read_bytes().startswith(kept)
    table = (out / "results.parquet").read_bytes()
    assert table == (straight.folder / "results.parquet").read_bytes()
    # Finished, it goes on with axes that have become longer.
    lines = (out / "cases.jsonl").read_bytes().count(b"\n")
    assert do(drive, ["seed=0:7"], out, "resume").table().seed.tolist() == list(range(7))
    assert (out / "cases.jsonl").read_bytes().count(b"\n") == lines + 2


def test_failed_cases_are_told_and_done_again_on_resuming(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fgslam.runs import sweep

    real = sweep.perform_trial

    def failing(config: Any, estimators: Any) -> Any:
        if config.seed == 1:
            raise OSError("no space left on device")
        return real(config, estimators)

    monkeypatch.setattr(sweep, "perform_trial", failing)
    found = do(drive, ["seed=0:3"], tmp_path / "out")
    assert found.status == "finished"
    assert found.failed
    assert found.failures == {1: "OSError: no space left on device"}
    assert ("failed", "case 1: OSError: no space left on device") in found.particulars
    assert found.table().failure.isna().tolist() == [True, False, True]
    monkeypatch.setattr(sweep, "perform_trial", real)
    again = do(drive, ["seed=0:3"], tmp_path / "out", "resume")
    assert not again.failed
    assert again.table().failure.isna().all()


def test_homings_are_swept_as_well(tmp_path: Path) -> None:
    path = tmp_path / "homings.yaml"
    path.write_text(yaml.safe_dump(HOMINGS))
    table = do(path, ["seed=0:2"], tmp_path / "out").table()
    assert table.seed.tolist() == [0, 1]
    assert table.estimator.tolist() == ["homing_ekf"] * 2
    assert any(name.startswith("outliers.0.") for name in table.columns)
    assert not any("_ms" in name for name in table.columns)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--set", "seed=0:2", "--set", "dataset.stp=3"), "unknown key dataset.stp; did you mean"),
        (("--set", "seed"), "not of the form KEY=VALUES"),
        (("--set", "seed=0:2", "--estimators", "isam3"), "no estimator 'isam3'"),
        (("--jobs", 2, "--scheduler", "tcp://localhost:1"), "leave it out with --scheduler"),
        (("--set", "seed=0,1", "--resume"), "cannot resume"),
        (("--set", "dataset.stop=3,-1"), "dataset.stop = -1 is not usable"),
    ],
)
def test_mistakes_are_reported_in_a_line_before_anything_is_done(
    arguments: tuple[Any, ...],
    words: str,
    drive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    assert main(monkeypatch, "sweep", drive, *arguments, "--out", out) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_another_experiment_and_another_folder_are_refused(drive: Path, tmp_path: Path) -> None:
    do(drive, ["seed=0"], tmp_path / "out")
    other = tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump(DRIVE | {"name": "other"}))
    with pytest.raises(ConfigError, match="is a sweep of short_drive, not of other"):
        do(other, ["seed=0"], tmp_path / "out", "resume")
    again = do(drive, ["seed=3"], tmp_path / "out", "overwrite")
    assert (again.table().seed.tolist(), done(tmp_path / "out")) == ([3], 1)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    with pytest.raises(OutputError, match="holds something else than a sweep"):
        do(drive, ["seed=0"], tmp_path / "mine", "overwrite")


# --------------------------------------------------------------------------------------------
# Processes

SWEEP = [sys.executable, "-m", "fgslam", "sweep"]


@pytest.fixture
def started() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts a process that is ended with the test."""
    processes: list[subprocess.Popen[str]] = []

    def start(*command: object) -> subprocess.Popen[str]:
        found = subprocess.Popen(  # noqa: S603
            list(map(str, command)),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            start_new_session=True,
        )
        processes.append(found)
        return found

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def when(ready: Callable[[], bool]) -> None:
    """Waits until it is true."""
    end = time.monotonic() + HANGS_AFTER_S
    while not ready():
        assert time.monotonic() < end, "it hangs"
        time.sleep(0.02)


def done(out: Path) -> int:
    path = out / "cases.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


@pytest.mark.slow
def test_workers_come_and_go_and_each_case_is_in_the_table_once(
    drive: Path, tmp_path: Path, started: Callable[..., subprocess.Popen[str]]
) -> None:
    address = tmp_path / "scheduler.json"
    scheduler = started(
        *(sys.executable, "-m", "dask", "scheduler", "--host", "127.0.0.1", "--port", 0),
        *("--no-dashboard", "--scheduler-file", address),
    )
    when(address.exists)

    def worker() -> subprocess.Popen[str]:
        limits = ("--nthreads", 1, "--no-nanny", "--no-dashboard")
        command = (sys.executable, "-m", "dask", "worker", "--scheduler-file", address)
        return started(*command, *limits, "--local-directory", tmp_path)

    first, _ = worker(), worker()
    out, sets = tmp_path / "out", ("--set", "seed=0:60")
    sweep = started(*SWEEP, drive, *sets, "--scheduler", address, "--out", out)
    when(lambda: done(out) >= 5)
    first.kill()
    worker()
    said, _ = sweep.communicate(timeout=HANGS_AFTER_S)
    assert sweep.returncode == 0, said
    assert pandas.read_parquet(out / "results.parquet").seed.tolist() == list(range(60))
    assert done(out) == 60
    expected = do(drive, ["seed=0:60"], tmp_path / "here")
    table = (out / "results.parquet").read_bytes()
    assert table == (expected.folder / "results.parquet").read_bytes()

    sets = ("--set", "seed=0:200")
    sweep = started(*SWEEP, drive, *sets, "--scheduler", address, "--out", out, "--resume")
    when(lambda: done(out) >= 65)
    scheduler.kill()
    said, _ = sweep.communicate(timeout=HANGS_AFTER_S)
    assert sweep.returncode == 130
    assert "scheduler   it has gone" in said
    assert do(drive, ["seed=0:200"], out, "resume").table().seed.tolist() == list(range(200))
    assert done(out) == 200


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_sweep_that_is_ended_leaves_no_worker_and_goes_on(
    number: signal.Signals,
    drive: Path,
    tmp_path: Path,
    started: Callable[..., subprocess.Popen[str]],
) -> None:
    out = tmp_path / "out"
    sweep = started(*SWEEP, drive, "--set", "seed=0:300", "--jobs", 2, "--out", out)
    when(lambda: done(out) >= 5)
    workers = children(sweep.pid)
    assert len(workers) == 2
    os.killpg(sweep.pid, number)
    said, _ = sweep.communicate(timeout=HANGS_AFTER_S)
    if number == signal.SIGINT:
        assert sweep.returncode == 130
        assert "--resume" in said
        assert len(pandas.read_parquet(out / "results.parquet")) == done(out)
    when(lambda: not any(Path("/proc", pid).exists() for pid in workers))
    plan = make_plan([drive], ["seed=0:40"])
    assert run_sweep(plan, out, nullcontext(Executor()), "resume").done == 40


def children(parent: int) -> list[str]:
    """Of a process, those that work for a scheduler; any of its threads may have started them."""
    lists = Path(f"/proc/{parent}/task").glob("*/children")
    found = [pid for path in lists for pid in path.read_text(encoding="utf-8").split()]
    lines = {pid: Path("/proc", pid, "cmdline").read_bytes() for pid in found}
    return [pid for pid, line in lines.items() if b"spawn_main" in line]
