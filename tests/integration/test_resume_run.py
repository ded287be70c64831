"""A run that ends early leaves valid files, and goes on to the bytes of an uninterrupted one."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import experiment, write_calibration, write_recording
from running import (
    HANGS_AFTER_S,
    KIND,
    SAME_BYTES,
    Finished,
    assert_valid_results,
    bytes_of,
    main,
    metrics_of,
    run_values,
    start,
    stop_after,
    write_config,
)

from fgslam.core.errors import (
    ConfigError,
    DatasetError,
    MeasurementLogError,
    OdometryError,
    OutputError,
)
from fgslam.core.sensors import Odometry
from fgslam.core.store import load_arrays, write_arrays
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import ImageFolderSettings
from fgslam.runs.config import make_config
from fgslam.runs.engine import Opening, resume_command
from fgslam.runs.tasks.slam import begin, open_run

LONG = 20
"""Frames that are enough to be interrupted for certain after the fifth."""


def test_stopped_again_and_again(recording: Path, finished: Finished, tmp_path: Path) -> None:
    values = experiment(recording)
    run = run_values(values, tmp_path / "run", stopped=stop_after(1))
    assert run.result.status == metrics_of(run.folder)["status"] == "interrupted"
    assert_valid_results(run.folder, 1)
    for more, done in ((2, 3), (4, 7)):
        run = run_values(values, run.folder, "resume", stop_after(more))
        assert_valid_results(run.folder, done)
    run = run_values(values, run.folder, "resume")
    assert run.result.status == "finished"
    assert_valid_results(run.folder, 12)
    assert not (run.folder / "checkpoint.npz").exists()
    assert bytes_of(run.folder) == bytes_of(finished.folder)
    metrics = metrics_of(run.folder)
    expected = metrics_of(finished.folder)
    for name in ("status_counts", "features", "stereo_matches", "landmark_matches"):
        assert metrics[name] == expected[name]
    assert metrics["estimators"][KIND]["ate_rmse_m"] == expected["estimators"][KIND]["ate_rmse_m"]


def test_stopping_after_the_last_frame_is_finishing(recording: Path, tmp_path: Path) -> None:
    run = run_values(experiment(recording), tmp_path / "run", stopped=stop_after(12))
    assert run.result.status == "finished"


def test_resumed_without_odometry(recording: Path, tmp_path: Path) -> None:
    """The motion model's own state goes on as well."""
    dataset = {"kind": "image_folder", "path": str(recording), "stop": 8}
    values = experiment(recording, dataset=dataset, odometry={"kind": "constant_velocity"})
    straight = run_values(values, tmp_path / "straight")
    run_values(values, tmp_path / "run", stopped=stop_after(5))
    run_values(values, tmp_path / "run", "resume")
    assert bytes_of(tmp_path / "run") == bytes_of(straight.folder)


def test_fixed_lag_resumes_with_drawn_noise(recording: Path, tmp_path: Path) -> None:
    dataset = {"kind": "image_folder", "path": str(recording), "stop": 7}
    made = {"estimator": {"kind": "fixed_lag"}, "odometry": {"kind": "synthetic"}, "seed": 5}
    values = experiment(recording, dataset=dataset, **made)
    straight, run = tmp_path / "straight", tmp_path / "run"
    run_values(values, straight)
    run_values(values, run, stopped=stop_after(5))
    run_values(values, run, "resume")
    names = tuple(name.replace(KIND, "fixed_lag") for name in SAME_BYTES)
    assert bytes_of(run, names) == bytes_of(straight, names)


def test_killed_between_the_files_of_a_checkpoint(
    recording: Path, finished: Finished, tmp_path: Path
) -> None:
    """Log and results may be newer than the state: resuming starts from the state."""
    values = experiment(recording)
    older = run_values(values, tmp_path / "older", stopped=stop_after(4)).folder
    newer = run_values(values, tmp_path / "newer", stopped=stop_after(7)).folder
    (older / "checkpoint.npz").replace(newer / "checkpoint.npz")
    run_values(values, newer, "resume")
    assert bytes_of(newer) == bytes_of(finished.folder)


# --------------------------------------------------------------------------------------------
# What is refused


def test_another_configuration_or_recording_is_refused(own_recording: Path, tmp_path: Path) -> None:
    values = experiment(own_recording)
    run = run_values(values, tmp_path / "run", stopped=stop_after(3))
    with pytest.raises(ConfigError, match="differs from the configuration given") as caught:
        run_values(values | {"seed": 1}, run.folder, "resume")
    assert resume_command(run.folder) in str(caught.value)
    write_calibration(own_recording, baseline_m=0.11)
    with pytest.raises(DatasetError, match="the recording has changed since"):
        run_values(values, run.folder, "resume")
    assert_valid_results(run.folder, 3)


def test_other_versions_are_refused(recording: Path, tmp_path: Path) -> None:
    """They would not give the bytes of an uninterrupted run."""
    dataset = {"kind": "image_folder", "path": str(recording), "stop": 4}
    values = experiment(recording, dataset=dataset)
    run = run_values(values, tmp_path / "run", stopped=stop_after(3))
    config = run.folder / "config.yaml"
    text = config.read_text()
    assert f"numpy: {np.__version__}" in text
    config.write_text(text.replace(f"numpy: {np.__version__}", "numpy: 1.0.0"))
    with pytest.raises(ConfigError, match=r"started with other versions \(numpy 1\.0\.0 -> "):
        run_values(values, run.folder, "resume")
    config.write_text(text)
    assert run_values(values, run.folder, "resume").result.status == "finished"


def test_a_finished_run_and_no_run_at_all(finished: Finished, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"nothing to resume .* has finished"):
        run_values(finished.values, finished.folder, "resume")
    with pytest.raises(OutputError, match="it holds no run"):
        run_values(finished.values, tmp_path / "absent", "resume")
    assert not (tmp_path / "absent").exists()


def test_a_checkpoint_that_does_not_fit_is_refused(recording: Path, tmp_path: Path) -> None:
    """It lacks an array of one part."""
    values = experiment(recording)
    run = run_values(values, tmp_path / "run", stopped=stop_after(2)).folder
    whole = load_arrays(run / "checkpoint.npz")
    opened = open_run(make_config(values, "test"), Opening(run, True, lambda *_: None))
    one_of_each = {name.partition("/")[0]: name for name in whole}
    assert len(one_of_each) > 5
    for name in one_of_each.values():
        others = {key: array for key, array in whole.items() if key != name}
        write_arrays(run / "checkpoint.npz", others)
        with pytest.raises(OutputError, match="not a state that this fgslam wrote") as caught:
            begin(opened, lambda *_: None)
        assert "\n" not in str(caught.value)
    with pytest.raises(OutputError, match="not a state that this fgslam wrote"):
        run_values(values, run, "resume")
    (run / "checkpoint.npz").write_bytes(b"PK\x03\x04 half a file")
    with pytest.raises(MeasurementLogError, match=r"checkpoint\.npz: not a readable"):
        run_values(values, run, "resume")
    assert_valid_results(run, 2)


def test_a_log_that_lacks_frames_is_refused(recording: Path, tmp_path: Path) -> None:
    values = experiment(recording)
    short = run_values(values, tmp_path / "short", stopped=stop_after(3)).folder
    run = run_values(values, tmp_path / "run", stopped=stop_after(5)).folder
    (short / "measurements.npz").replace(run / "measurements.npz")
    with pytest.raises(OutputError, match="holds 3 frames, the checkpoint 5"):
        run_values(values, run, "resume")


def test_refusals_come_before_the_recording_is_opened(finished: Finished, tmp_path: Path) -> None:
    """Rendering takes minutes; a run folder that exists is known at once."""
    values = experiment(tmp_path / "no such recording")
    with pytest.raises(OutputError, match="holds a run already"):
        run_values(values, finished.folder)
    with pytest.raises(OutputError, match="nothing to resume"):
        run_values(values, finished.folder, "resume")


# --------------------------------------------------------------------------------------------
# A recording that fails in mid-run


def test_a_recording_that_fails_loses_nothing(
    recording: Path, finished: Finished, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a reader would that decodes its odometry on the way: frames so far are kept."""
    probe = open_recording(ImageFolderSettings(path=str(recording)))
    intact = type(probe).odometry

    def broken(self: Recording, i: int) -> Odometry | None:
        if i == 6:
            raise OdometryError("odometry.txt, line 7: speed is not finite; correct the line")
        return intact(self, i)

    values = experiment(recording)
    with monkeypatch.context() as patch:
        patch.setattr(Recording, "odometry", broken)
        with pytest.raises(OdometryError, match="line 7"):
            run_values(values, tmp_path / "run")
    assert_valid_results(tmp_path / "run", 6)
    run_values(values, tmp_path / "run", "resume")
    assert bytes_of(tmp_path / "run") == bytes_of(finished.folder)


# --------------------------------------------------------------------------------------------
# Signals


def wait_for_frames(folder: Path, frames: int, process: subprocess.Popen[str]) -> None:
    """Until the run has written results of so many frames."""
    deadline = time.monotonic() + HANGS_AFTER_S
    while time.monotonic() < deadline:
        if (folder / "metrics.json").is_file() and metrics_of(folder)["frames"] >= frames:
            return
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.005)
    raise AssertionError(f"no {frames} frames, and no end")


@pytest.fixture(scope="module")
def long_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Long enough to be interrupted for certain."""
    return write_recording(tmp_path_factory.mktemp("recordings") / "long", frames=LONG)


@pytest.fixture(scope="module")
def long_values(long_recording: Path) -> dict[str, Any]:
    output = {"pictures": False, "report": False, "checkpoint_seconds": 0.0}
    return experiment(long_recording, output=output)


@pytest.fixture(scope="module")
def long_bytes(
    long_values: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, bytes]:
    return bytes_of(run_values(long_values, tmp_path_factory.mktemp("runs") / "long").folder)


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_signals(
    number: signal.Signals,
    long_values: dict[str, Any],
    long_bytes: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "a run"
    process = start("run", write_config(tmp_path / "c.yaml", long_values), "--out", folder)
    wait_for_frames(folder, 5, process)
    os.kill(process.pid, number)
    out, error = process.communicate(timeout=HANGS_AFTER_S)
    assert "Traceback" not in error
    done = assert_valid_results(folder)
    assert 5 <= done < LONG
    assert process.returncode == 128 + number
    assert metrics_of(folder)["status"] == "interrupted"
    assert f"interrupted after {done} frames; go on: {resume_command(folder)}" in out
    # The printed command's own words: the run folder's config.yaml is enough to go on.
    assert main(monkeypatch, "run", folder / "config.yaml", "--out", folder, "--resume") == 0
    assert f"{LONG} of {LONG}" in capfd.readouterr().out
    assert bytes_of(folder) == long_bytes
    assert not list(folder.rglob("*partial*"))


def test_a_second_interrupt_ends_the_run_at_once(
    long_values: dict[str, Any], tmp_path: Path
) -> None:
    """Whatever it hits, files are whole and the run can go on."""
    folder = tmp_path / "run"
    process = start("run", write_config(tmp_path / "c.yaml", long_values), "--out", folder)
    wait_for_frames(folder, 3, process)
    for _ in range(3):
        process.send_signal(signal.SIGINT)
        time.sleep(0.001)
    _, error = process.communicate(timeout=HANGS_AFTER_S)
    assert process.returncode == 130
    assert "Traceback" not in error
    done = assert_valid_results(folder, split_saves=1)
    resumed = run_values(long_values, folder, "resume", stop_after(1))
    # The state may be one save behind the results.
    assert done <= assert_valid_results(resumed.folder) <= done + 1
