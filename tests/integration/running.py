"""Runs experiments for the integration tests: in this process, or as a user would."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fgslam.cli import main as cli
from fgslam.core.log import MeasurementLog
from fgslam.core.types import Trajectory, read_covariances
from fgslam.report.formats import read_ply
from fgslam.runs.config import make_config
from fgslam.runs.engine import run_task
from fgslam.runs.folder import ExistingFolder
from fgslam.runs.tasks.slam import SlamResult, open_slam
from fgslam.runs.workers import Executor, Pool
from fgslam.slam.results import STAGES

Capture = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch
ROOT = Path(__file__).parents[2]
KIND = "landmark_kalman"
SAME_BYTES = (
    "measurements.npz",
    "ground_truth.tum",
    f"{KIND}/online.tum",
    f"{KIND}/final.tum",
    f"{KIND}/covariance.csv",
    f"{KIND}/map.ply",
    f"{KIND}/noise.csv",
)
"""What the same configuration and seed must give to the byte."""
HANGS_AFTER_S = 600.0
"""Longer than any command of these tests takes, on a machine that has other work as well."""


def copy_of_checkout(folder: Path) -> Path:
    """A copy of the checkout without what git ignores."""
    left_out = shutil.ignore_patterns(".*", "build", "dist", "runs", "*.egg-info")
    caches = shutil.ignore_patterns("__pycache__")

    def ignore(source: str, names: list[str]) -> set[str]:
        return (left_out if Path(source) == ROOT else caches)(source, names)

    return Path(shutil.copytree(ROOT, folder, ignore=ignore))


@dataclass(frozen=True)
class Finished:
    """A run, with the values that it was made from."""

    values: dict[str, Any]
    folder: Path
    result: SlamResult


def run_values(
    values: dict[str, Any],
    folder: Path,
    existing: ExistingFolder = "refuse",
    stopped: Callable[[], bool] = lambda: False,
) -> Finished:
    config = make_config(values, "test")
    return Finished(values, folder, run_task(open_slam, config, folder, existing, stopped=stopped))


def stop_after(frames: int) -> Callable[[], bool]:
    """Says stop once it has been asked for the ``frames``-th time."""
    asked = 0

    def stopped() -> bool:
        nonlocal asked
        asked += 1
        return asked >= frames

    return stopped


class Here(Pool):
    """Does units in this process; what cannot be sent to a worker and back fails as it would."""

    def run(self, function: Any, arguments: Any, stopped: Any, fresh: bool = False) -> Any:
        from distributed.protocol.pickle import dumps, loads  # half a second

        def sent(value: Any) -> Any:
            return loads(dumps(value))

        return Executor.run(self, lambda one: sent(sent(function)(sent(one))), arguments, stopped)


@contextmanager
def units_in_this_process() -> Iterator[None]:
    """The units of a run are done in this process, one after the other."""

    with pytest.MonkeyPatch.context() as patch:
        for module in ("engine", "library", "workers"):
            patch.setattr(f"fgslam.runs.{module}.Pool", Here)
        yield


def bytes_of(folder: Path, names: tuple[str, ...] = SAME_BYTES) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in names}


def metrics_of(folder: Path) -> dict[str, Any]:
    document = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    assert isinstance(document, dict)
    return document


def assert_valid_results(folder: Path, frames: int | None = None, split_saves: int = 0) -> int:
    """Every file reads back and they agree on the number of frames, which is returned.

    A kill between two files of one save (``split_saves`` 1) leaves each whole, some a frame ahead.
    """
    metrics = metrics_of(folder)
    count = int(metrics["frames"])
    assert frames in (None, count)
    allowed = range(count, count + 1 + split_saves)
    log = MeasurementLog.load(folder / "measurements.npz")
    final = Trajectory.load(folder / KIND / "final.tum")
    online = Trajectory.load(folder / KIND / "online.tum")
    stamps, covariances = read_covariances(folder / KIND / "covariance.csv")
    points = read_ply(folder / KIND / "map.ply")
    rows = (folder / "timing.csv").read_text(encoding="utf-8").splitlines()
    for length in (len(log), len(final), len(online), len(stamps)):
        assert length in allowed
    # Written after the metrics.
    assert len(rows) in {1 + len(STAGES) * (count - k) for k in range(1 + split_saves)}
    assert np.isfinite(covariances).all()
    assert len(points) > 100
    assert split_saves or len(points) == metrics["estimators"][KIND]["landmarks"]
    assert yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))["name"]
    return count


# --------------------------------------------------------------------------------------------
# The command line


def write_config(path: Path, values: Mapping[str, Any]) -> Path:
    path.write_text(yaml.safe_dump(dict(values)), encoding="utf-8")
    return path


def main(monkeypatch: Patch, *arguments: object) -> int:
    """Exit status of a command run in this process (subprocesses take seconds to import)."""
    monkeypatch.setattr(sys, "argv", ["fgslam", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    code = caught.value.code
    return code if isinstance(code, int) else 0


def mistake(capfd: Capture, monkeypatch: Patch, *arguments: object) -> str:
    """The one line that a command prints which must fail."""
    assert main(monkeypatch, *arguments) == 2
    said = capfd.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    return line


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-c", "from fgslam.cli.start import main; main()", *map(str, arguments)]


def start(*arguments: object, **environment: str) -> subprocess.Popen[str]:
    """The command as a process of its own."""
    return subprocess.Popen(  # noqa: S603
        command(*arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | environment,
    )


def call(*arguments: object, **environment: str) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of the command."""
    process = start(*arguments, **environment)
    out, error = process.communicate(timeout=HANGS_AFTER_S)
    return process.returncode, out, error
