"""Two `fgslam run` commands and one folder: one of them writes, the other says so in a line."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from recordings import experiment
from running import (
    HANGS_AFTER_S,
    Finished,
    assert_valid_results,
    bytes_of,
    main,
    start,
    write_config,
)

from fgslam.runs.folder import OWNER_NAME

pytestmark = pytest.mark.slow


def test_of_two_that_begin_at_once_one_finishes_and_one_is_refused(
    recording: Path, finished: Finished, tmp_path: Path
) -> None:
    config, folder = write_config(tmp_path / "c.yaml", experiment(recording)), tmp_path / "run"
    both = [start("run", config, "--out", folder) for _ in range(2)]
    said = [process.communicate(timeout=HANGS_AFTER_S) for process in both]
    assert sorted(process.returncode for process in both) == [0, 2], said
    _, line = said[0 if both[0].returncode == 2 else 1]
    assert line.count("\n") == 1
    assert "is writing there" in line or "exists already" in line or "holds a run" in line, line
    assert_valid_results(folder, 12)
    assert bytes_of(folder) == bytes_of(finished.folder)


def test_a_second_waits_for_no_owner_and_the_folder_of_a_dead_one_is_taken_over_with_a_word(
    recording: Path,
    finished: Finished,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    config, folder = write_config(tmp_path / "c.yaml", experiment(recording)), tmp_path / "run"
    with start("run", config, "--out", folder) as first:
        until = time.monotonic() + HANGS_AFTER_S
        while not (folder / "config.yaml").exists():
            assert first.poll() is None
            assert time.monotonic() < until
            time.sleep(0.005)
        os.kill(first.pid, signal.SIGSTOP)
        assert (folder / OWNER_NAME).exists(), "it has finished before it could be stopped"
        for existing in ("--resume", "--overwrite"):
            assert main(monkeypatch, "run", config, "--out", folder, existing) == 2
            (line,) = capfd.readouterr().err.splitlines()
            assert f"process {first.pid} on " in line
            assert "is writing there; wait for it to end, or choose another --out" in line
        first.kill()
        first.communicate(timeout=HANGS_AFTER_S)
    assert main(monkeypatch, "run", config, "--out", folder, "--resume") == 0
    out = " ".join(capfd.readouterr().out.split())
    assert f"taken over from process {first.pid} on " in out
    assert "which had ended without finishing" in out
    assert not (folder / OWNER_NAME).exists()
    assert bytes_of(folder) == bytes_of(finished.folder)
